//! Kinematic bundle adjustment: the estimator that reaches the Cramer-Rao bound.
//!
//! Camera poses are functions of the free parameters, so that after the scene points are eliminated the normal
//! equations are as small as the parameters (and the joint errors, six a posture). Residuals: reprojection, measured
//! depth whose sigma grows with the square of the depth, board corners, priors, joint errors about zero. The cost is
//! linear in the number of observations.

mod adjust;
mod causes;
mod conclusion;
mod correlation;
mod expected;
mod noise;
mod observations;
mod options;
mod outliers;
mod pose_system;
mod posterior;
mod predicted;
mod projection_model;
mod random_effects;
mod reduced;
mod residuals;
mod rounds;
mod ruler;
mod solve;
mod start;
mod state;
#[cfg(test)]
mod tests;
mod triangulate;
mod unknowns;

pub use causes::{ErrorPattern, PatternFinding};
pub use expected::{ExpectationOptions, ExpectedCalibration, expected_calibration};
pub(crate) use noise::OUTLIER_SIGMAS;
pub(crate) use observations::Observations;
pub use options::{BundleOptions, PostureErrorPolicy, RulerPolicy};
pub(crate) use posterior::PosteriorInputs;
pub(crate) use predicted::{Predicted, predicted_distances};
pub use random_effects::ErrorKind;
pub use solve::calibrate_bundle;
pub(crate) use solve::compare;
