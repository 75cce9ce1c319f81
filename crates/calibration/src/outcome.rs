//! What an estimator hands back.

use crate::{EpipolarStatistics, Identifiability, Model, Parameter, PriorGroup, Termination, Warning};
use nalgebra::{DMatrix, DVector};
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
    /// The standard of length that no residual tests; `None` where there is none.
    pub ruler: Option<Ruler>,
    /// Prior sigmas of the arm's parameters that the evidence chose.
    pub prior_scales: Vec<PriorScale>,
    /// What each joint was off its value (rad or m), or a flange pose its own (m, then rad), posture by posture; empty where it was not estimated.
    pub posture_errors: Vec<Vec<f64>>,
    /// The same with its covariance; `None` where it was not estimated.
    pub posture_error_knowledge: Option<PostureErrorKnowledge>,
    /// How the solver ended.
    pub termination: Termination,
    /// What a person should hear of.
    pub warnings: Vec<Warning>,
}

/// The standard of length of a calibration: its own error is in no residual.
#[derive(Debug, Clone, PartialEq)]
pub struct Ruler {
    /// The scale of the board's squares, or of the depth.
    pub parameter: Parameter,
    /// How well it is known beforehand: a fraction.
    pub sigma: f64,
    /// What of the covariance it makes; `None` where it was estimated like the others.
    pub covariance: Option<DMatrix<f64>>,
}

/// A prior sigma that the evidence chose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PriorScale {
    /// Of which parameters.
    pub group: PriorGroup,
    /// In their unit, rad or m.
    pub sigma: f64,
}

/// The errors of single postures as the data have them: normal, with everything else unknown.
#[derive(Debug, Clone, PartialEq)]
pub struct PostureErrorKnowledge {
    /// Components of one posture's error.
    pub components: usize,
    /// Component by component, posture by posture, rad or m.
    pub mean: DVector<f64>,
    /// Of the mean.
    pub covariance: DMatrix<f64>,
    /// Prior sigma of each.
    pub sigmas: Vec<f64>,
}

impl Calibration {
    /// Makes the covariance (but for the part of the standard of length) wider by a ratio of variances above 1, and the sigmas with it: what is reported is never below what
    /// the data show.
    pub fn widen(&mut self, ratio: f64) {
        let Some(covariance) = &mut self.covariance else { return };
        if !(ratio > 1.0 && ratio.is_finite()) {
            return;
        }
        let considered = self.ruler.as_ref().and_then(|ruler| ruler.covariance.clone());
        let considered = considered.unwrap_or_else(|| DMatrix::zeros(covariance.nrows(), covariance.ncols()));
        *covariance = (&*covariance - &considered) * ratio + considered;
        for (k, estimate) in self.parameters.iter_mut().enumerate() {
            if let Some(sigma) = &mut estimate.sigma {
                *sigma = covariance[(k, k)].max(0.0).sqrt();
            }
        }
    }
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
    /// Sigma of the angular errors of single postures (revolute joints, or the rotation of a flange pose), rad; `None` where they were not estimated.
    pub posture_angular: Option<f64>,
    /// The same of the linear ones (prismatic joints, or the translation of a flange pose), m.
    pub posture_linear: Option<f64>,
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
