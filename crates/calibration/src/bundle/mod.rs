//! Kinematic bundle adjustment: the estimator that reaches the Cramer-Rao bound.
//!
//! Camera poses are functions of the free parameters, so that after the scene points are eliminated the normal equations are as small as the parameters (and
//! the joint deviations, six a posture). Residuals: reprojection, measured depth whose sigma grows with the square of the depth, board
//! corners, priors, joint deviations about zero. The cost is linear in the number of sights.

mod adjust;
mod deviations;
mod expected;
mod noise;
mod observations;
mod options;
mod pose_system;
mod reduced;
mod residuals;
mod solve;
mod start;
mod state;
mod suspects;
#[cfg(test)]
mod tests;
mod triangulate;
mod unknowns;
mod view;

pub use expected::{ExpectationOptions, ExpectedCalibration, expected_calibration};
pub(crate) use noise::OUTLIER_SIGMAS;
pub(crate) use observations::Observations;
pub use options::{BundleOptions, DeviationPolicy};
pub use solve::calibrate_bundle;
pub(crate) use solve::compare;
