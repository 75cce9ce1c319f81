//! What an estimator hands back.

use crate::bundle::PosteriorInputs;
use crate::{EpipolarStatistics, Identifiability, Model, Parameter, PatternFinding, PriorGroup, Termination, Warning};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

/// A calibrated model and all that is known about it.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The calibrated rig and corrections.
    pub model: Model,
    /// The free parameters, in their order.
    pub parameters: Vec<ParameterEstimate>,
    /// Covariance of the free parameters in their order and units (rad, m, px ...), the data and the priors together.
    /// `None` for Nelder-Mead, which has none.
    pub covariance: Option<DMatrix<f64>>,
    /// What the covariance is made of; `None` but for the bundle adjustment.
    pub(crate) posterior: Option<PosteriorInputs>,
    /// Which parameters are identifiable. `None` for Nelder-Mead.
    pub identifiability: Option<Identifiability>,
    /// Epipolar distances of the pair matches under the nominal rig.
    pub epipolar_before: EpipolarStatistics,
    /// The same under the calibrated model.
    pub epipolar_after: EpipolarStatistics,
    /// Reprojection under the nominal rig, points re-triangulated; bundle adjustment only.
    pub reprojection_before: Option<ReprojectionStatistics>,
    /// The same under the calibrated model.
    pub reprojection_after: Option<ReprojectionStatistics>,
    /// The noise that the residuals imply.
    pub noise: Noise,
    /// One a posture: how well it fits.
    pub postures: Vec<PostureFit>,
    /// The standard of length that no residual tests; `None` where there is none.
    pub ruler: Option<Ruler>,
    /// Prior sigmas of the arm's parameters that the evidence chose.
    pub prior_scales: Vec<PriorScale>,
    /// What each joint was off its value (rad or m), or a flange pose its own (m, then rad), posture by posture; empty
    /// where it was not estimated.
    pub posture_errors: Vec<Vec<f64>>,
    /// The same with its covariance; `None` where it was not estimated.
    pub posture_error_knowledge: Option<PostureErrorKnowledge>,
    /// What the errors of the postures have in common, what explains most first.
    pub error_patterns: Vec<PatternFinding>,
    /// How the solver ended.
    pub termination: Termination,
    /// What a user should know.
    pub warnings: Vec<Warning>,
}

/// The standard of length of a calibration: its own error is in no residual.
#[derive(Debug, Clone, PartialEq)]
pub struct Ruler {
    /// The scale of the board's squares, or of the depth.
    pub parameter: Parameter,
    /// How well it is known beforehand: a fraction.
    pub prior_sigma: f64,
    /// How much larger than nominal it is, as the data, the arm's nominal lengths and its own tolerance together have
    /// it: a fraction.
    pub mean: f64,
    /// Sigma of that.
    pub sigma: f64,
    /// Whether the estimate takes it as exact all the same, since nothing contradicts that.
    pub held: bool,
    /// What of the covariance it makes.
    pub covariance: DMatrix<f64>,
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
    /// The covariance without what the standard of length makes of it; `None` where there is none.
    pub fn covariance_without_ruler(&self) -> Option<DMatrix<f64>> {
        let covariance = self.covariance.as_ref()?;
        Some(match &self.ruler {
            Some(ruler) => covariance - &ruler.covariance,
            None => covariance.clone(),
        })
    }

    /// Makes the covariance such as it would be if the observations were worth less by a factor (above 1) of their
    /// variance, and the sigmas with it: what is reported is never below what the data show. Priors stay.
    pub fn widen(&mut self, variance_factor: f64) {
        let Some(inputs) = self.posterior.as_ref().filter(|_| variance_factor > 1.0 && variance_factor.is_finite())
        else {
            return;
        };
        let Some(wider) = inputs.tempered(variance_factor).posterior() else { return };
        let mut covariance = wider.own;
        if let (Some(ruler), Some(own)) = (&mut self.ruler, wider.ruler) {
            // The estimate stays where it is; how far the standard of length may be from it was known before.
            let of_mean = if ruler.held { ruler.mean * ruler.mean } else { 0.0 };
            let factor = 1.0 + of_mean / (own.sigma * own.sigma);
            let part = own.covariance * ((own.sigma * own.sigma) / (own.sigma * own.sigma + own.away_squared));
            covariance += &part * (factor - 1.0);
            ruler.sigma = own.sigma;
            ruler.covariance = part * factor;
        }
        for (k, estimate) in self.parameters.iter_mut().enumerate() {
            if let Some(sigma) = &mut estimate.sigma {
                *sigma = covariance[(k, k)].max(0.0).sqrt();
            }
        }
        self.covariance = Some(covariance);
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

/// The noise that the residuals imply.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Noise {
    /// Sigma of a pixel coordinate (of a Sampson distance for pairwise estimators), times each observation's own sigma.
    pub pixel: f64,
    /// `s` of `sigma = s z^2` of the measured depth, 1/m; `None` without depth.
    pub depth_sigma_per_m2: Option<f64>,
    /// Sigma of the angular errors of single postures (revolute joints, or the rotation of a flange pose), rad; `None`
    /// where they were not estimated.
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
