//! What can go wrong with a chain.

use crate::ParameterId;

/// Why a chain could not be made or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KinematicsError {
    /// The number of joint values is not the number of joints.
    #[error("the chain has {need} joints, got {got} joint values")]
    JointCount {
        /// Joints of the chain.
        need: usize,
        /// Values given.
        got: usize,
    },
    /// A parameter or joint value is infinite or not a number.
    #[error("{what} is {value}; a finite number is needed")]
    NotFinite {
        /// What the value belongs to.
        what: String,
        /// The value as text.
        value: String,
    },
    /// The link form has no such parameter.
    #[error("joint {} has no parameter {parameter}", parameter.joint + 1)]
    NoSuchParameter {
        /// The parameter asked for.
        parameter: ParameterId,
    },
    /// A Hayati link cannot carry a prismatic joint: it has no translation along its axis.
    #[error("joint {joint} is prismatic, and the Hayati form has no translation along the axis; use a DH form")]
    PrismaticHayati {
        /// Joint, counted from 1.
        joint: usize,
    },
    /// Lower limit above the upper one.
    #[error("joint {joint}: the lower limit {lower} is above the upper limit {upper}")]
    Limits {
        /// Joint, counted from 1.
        joint: usize,
        /// Lower limit, rad or m.
        lower: f64,
        /// Upper limit, rad or m.
        upper: f64,
    },
    /// The geometry has no closed-form inverse kinematics here.
    #[error(
        "no closed-form inverse kinematics: {reason}; needed are six revolute joints, axes 2 and 3 parallel, \
         axes 4, 5 and 6 through one point (refine a nearby solution instead)"
    )]
    NoClosedForm {
        /// What is missing, with its number.
        reason: String,
    },
    /// A URDF cannot be read as a chain, or a chain not be written into it.
    #[error("URDF, line {line}: {problem}")]
    Urdf {
        /// Line in the text, from 1.
        line: u32,
        /// What is wrong and what was expected.
        problem: String,
    },
    /// A chain or a transform has no place in a file format.
    #[error("cannot be exported: {problem}")]
    Export {
        /// What the format lacks or needs.
        problem: String,
    },
    /// An option that has to be positive and finite is not.
    #[error("{option} is {value}; a positive finite number is needed")]
    Option {
        /// The option's name.
        option: &'static str,
        /// The value as text.
        value: String,
    },
}
