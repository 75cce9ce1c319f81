//! Why a calibration could not be made at all. Not converging is no error: see [`Termination`](crate::Termination).

use crate::{Parameter, ParseFreeError};
use skclam_kinematics::KinematicsError;
use skclam_rig::RigError;

/// Why a calibration could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// A correspondence names a posture that is not there.
    #[error("{what} names posture {got}, but there are {count} postures (counted from 0)")]
    NoSuchPosture {
        /// Which correspondence.
        what: String,
        /// The position it names.
        got: usize,
        /// Number of postures.
        count: usize,
    },
    /// A pair matches an image with itself.
    #[error("pair {pair} matches posture {posture} with itself; two different postures are needed")]
    SamePosture {
        /// Position of the pair.
        pair: usize,
        /// The posture.
        posture: usize,
    },
    /// A number is infinite or not a number.
    #[error("{what} holds {value}; a finite number is needed")]
    NotFinite {
        /// Where.
        what: String,
        /// The value as text.
        value: String,
    },
    /// A sigma, covariance or depth is not positive.
    #[error("{what} holds {value}; a standard deviation, covariance or depth must be above zero")]
    NotPositive {
        /// Where.
        what: String,
        /// The value.
        value: f64,
    },
    /// Too few usable correspondences for the free parameters.
    #[error("{got} usable {what} for {parameters} free parameters; at least {need} are needed")]
    TooFew {
        /// What was counted.
        what: String,
        /// How many are needed.
        need: usize,
        /// How many there are.
        got: usize,
        /// Number of free parameters.
        parameters: usize,
    },
    /// Nothing is free.
    #[error("no parameter is free: there is nothing to calibrate")]
    NothingFree,
    /// A free parameter does not exist in this rig.
    #[error("parameter {parameter} does not exist in this rig: {reason}")]
    NoSuchParameter {
        /// The parameter.
        parameter: Parameter,
        /// Why.
        reason: String,
    },
    /// A parameter is listed twice.
    #[error("parameter {parameter} is listed twice")]
    Duplicate {
        /// The parameter.
        parameter: Parameter,
    },
    /// The list of free parameters cannot be read.
    #[error(transparent)]
    Free(#[from] ParseFreeError),
    /// The normal equations could not be solved, even heavily damped.
    #[error("the normal equations of {parameters} parameters could not be solved; is any of them seen by the data?")]
    Singular {
        /// Number of unknowns.
        parameters: usize,
    },
    /// An option is out of range.
    #[error("option {name} is {value}; {expected}")]
    Option {
        /// Name of the option.
        name: &'static str,
        /// Its value as text.
        value: String,
        /// What would be right.
        expected: &'static str,
    },
    /// Board corners were given, but the rig has no board, or not one so large.
    #[error("board corners in posture {posture}: {reason}")]
    Board {
        /// Position of the posture.
        posture: usize,
        /// What is wrong.
        reason: String,
    },
    /// A pose could not be computed.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The chain refused a parameter.
    #[error(transparent)]
    Kinematics(#[from] KinematicsError),
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
}
