//! What an estimator hands back.

use crate::{EpipolarStatistics, Identifiability, Model, Parameter, Termination, Warning};
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

/// A calibrated model and all that is known about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The calibrated rig and corrections.
    pub model: Model,
    /// The free parameters, in their order.
    pub parameters: Vec<ParameterEstimate>,
    /// Covariance of the free parameters in their order and units (rad, m, px ...), the data and the priors together. `None` for
    /// Nelder-Mead, which has none.
    pub covariance: Option<DMatrix<f64>>,
    /// What the data can tell. `None` for Nelder-Mead.
    pub identifiability: Option<Identifiability>,
    /// Epipolar distances of the pair matches under the nominal rig.
    pub epipolar_before: EpipolarStatistics,
    /// The same under the calibrated model.
    pub epipolar_after: EpipolarStatistics,
    /// Reprojection under the nominal rig, points re-triangulated; bundle adjustment only.
    pub reprojection_before: Option<ReprojectionStatistics>,
    /// The same under the calibrated model.
    pub reprojection_after: Option<ReprojectionStatistics>,
    /// The noise that the residuals tell of.
    pub noise: Noise,
    /// One a posture: how well it fits.
    pub postures: Vec<PostureFit>,
    /// What each joint stood off its value, rad or m, posture by posture; empty where it was not estimated.
    pub joint_deviations: Vec<Vec<f64>>,
    /// How the solver ended.
    pub termination: Termination,
    /// What a person should hear of.
    pub warnings: Vec<Warning>,
}

/// A free parameter before and after.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterEstimate {
    /// Which.
    pub parameter: Parameter,
    /// Nominal value in its unit.
    pub nominal: f64,
    /// Calibrated value in its unit.
    pub value: f64,
    /// Standard deviation, where the data contribute to it.
    pub sigma: Option<f64>,
    /// Why there is no sigma.
    pub note: Option<String>,
}

/// Distances between measured and predicted pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ReprojectionStatistics {
    /// Root of the mean of the squared distances of those that fit, px.
    pub rms_px: f64,
    /// Median distance of all, px.
    pub median_px: f64,
    /// Observations.
    pub observations: usize,
    /// Those that fit.
    pub inliers: usize,
}

/// The noise that the residuals tell of.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Noise {
    /// Sigma of a pixel coordinate (of a Sampson distance for pairwise estimators), times each observation's own sigma.
    pub pixel: f64,
    /// `s` of `sigma = s z^2` of the measured depth, 1/m; `None` without depth.
    pub depth_per_m: Option<f64>,
    /// Sigma of the joint deviations, rad; `None` where they were not estimated.
    pub joint_deviation: Option<f64>,
    /// Fraction of the correspondences that do not fit.
    pub outlier_fraction: f64,
}

/// How well a posture fits.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PostureFit {
    /// Correspondences that name it.
    pub observations: usize,
    /// Those that do not fit.
    pub outliers: usize,
    /// Median size of its residuals in units of the common sigma.
    pub median_sigmas: f64,
}
