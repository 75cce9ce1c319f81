//! What can go wrong in the virtual cell.

use skclam_kinematics::KinematicsError;
use skclam_rig::RigError;

/// Why a simulation could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulationError {
    /// The camera has no or too many pixels, or its intrinsics are no use.
    #[error(
        "a camera of {width} x {height} pixels with focal lengths {fx} and {fy} px cannot be rendered; \
         at least 1 and at most 2^27 pixels and positive finite intrinsics are needed"
    )]
    Camera {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Focal length along x, px.
        fx: f64,
        /// Focal length along y, px.
        fy: f64,
    },
    /// The distortion folds back within the image.
    #[error(
        "the distortion {distortion:?} (k1 k2 p1 p2 k3) folds back within the image, so that some pixels see nothing"
    )]
    Distortion {
        /// The coefficients.
        distortion: [f64; 5],
    },
    /// An option is out of its range.
    #[error("{option} is {value}; {need}")]
    Option {
        /// Its name.
        option: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        need: &'static str,
    },
    /// A rig without an arm.
    #[error("the rig has no [robot]; a simulation needs an arm to carry the camera")]
    NoRobot,
    /// A rig without a depth camera where one is needed.
    #[error("the rig has no [depth] camera")]
    NoDepthCamera,
    /// The flange pose has fewer inverse kinematics solutions than the plan needs.
    #[error(
        "the flange pose has {got} inverse kinematics solutions, {need} are needed; choose a pose well within reach"
    )]
    Solutions {
        /// Needed.
        need: usize,
        /// Found.
        got: usize,
    },
    /// No posture was found that sees the scene.
    #[error(
        "found only {got} of {need} postures that see the scene and overlap with their neighbours in {tries} tries"
    )]
    Postures {
        /// Needed.
        need: usize,
        /// Found.
        got: usize,
        /// Draws made.
        tries: usize,
    },
    /// The arm refused.
    #[error(transparent)]
    Kinematics(#[from] KinematicsError),
    /// The rig refused a posture.
    #[error(transparent)]
    Rig(#[from] RigError),
}
