//! What is known at an optimum, and the result that is made of it.

use crate::bundle::adjust::Adjustment;
use crate::bundle::causes::error_patterns;
use crate::bundle::noise::{self, OUTLIER_SIGMAS};
use crate::bundle::posterior::{PosteriorInputs, RulerPosterior};
use crate::bundle::residuals::ResidualSize;
use crate::bundle::ruler::grown_together;
use crate::bundle::solve::{Adjusted, BundleAdjuster};
use crate::bundle::state::State;
use crate::error_function::epipolar_statistics;
use crate::prior::{PriorGroup, Priors};
use crate::robust::median;
use crate::uncertainty::{covariance, describe};
use crate::{
    Calibration, CalibrationError, Correspondences, Model, Noise, PostureErrorKnowledge, PostureFit, PriorScale,
    ReprojectionStatistics, Ruler, Warning, arm_positions,
};
use nalgebra::{DMatrix, DVector};

/// No feature is so bad, in units of the sigma that it came with.
const LARGE_SIGMA: f64 = 5.0;

impl BundleAdjuster<'_> {
    pub(super) fn known(&self, adjusted: &Adjusted) -> Result<Known, CalibrationError> {
        let Adjusted { state, noise, priors, observations, balance, .. } = adjusted;
        let adjustment = self.adjustment(observations, priors, *noise, self.options.loss, *balance);
        let likelihood = self.likelihood(&adjustment, state, self.widening(&adjustment, state)?)?;
        let count = self.parameters.len();
        let mut prior_normal = DMatrix::zeros(count, count);
        priors.add_to(self.nominal, &state.model, self.parameters, &mut prior_normal, &mut DVector::zeros(count));
        let inputs = PosteriorInputs {
            likelihood,
            prior_normal,
            priors: priors.clone(),
            ruler: self.ruler,
            held: self.held.is_some(),
        };
        let (covariance, ruler) = match inputs.posterior() {
            Some(known) => (known.covariance, known.ruler),
            None => (covariance(&(&inputs.likelihood.normal + &inputs.prior_normal), self.parameters), None),
        };
        let errors = self.posture_error_knowledge(&adjustment, state)?;
        Ok(Known { inputs, covariance, ruler, errors })
    }

    pub(super) fn conclude(
        &self,
        data: &Correspondences,
        adjusted: Adjusted,
        known: Known,
        fits: Vec<PostureFit>,
        mut warnings: Vec<Warning>,
    ) -> Result<Calibration, CalibrationError> {
        let Adjusted { state, noise, priors, observations, sizes, termination, .. } = adjusted;
        if !termination.reason.is_converged() {
            warnings.push(Warning::NotConverged { reason: termination.reason.to_string() });
        }
        let (identifiability, estimates) = describe(
            self.nominal,
            &state.model,
            &data.postures,
            self.parameters,
            &priors,
            &known.inputs.with_instruments(self.parameters),
            &known.covariance,
        );
        let outliers = sizes.iter().filter(|size| size.pixel >= OUTLIER_SIGMAS).count();
        let outlier_fraction = outliers as f64 / sizes.len().max(1) as f64;
        if outlier_fraction > 0.5 {
            warnings.push(Warning::ManyOutliers { fraction: outlier_fraction });
        }
        if noise.pixel > LARGE_SIGMA {
            warnings.push(Warning::LargeResiduals { sigma: noise.pixel });
        }
        let ruler = self.ruler.zip(known.ruler).map(|(at, ruler)| Ruler {
            parameter: self.parameters[at],
            prior_sigma: priors.sigmas[at].unwrap_or(f64::INFINITY),
            mean: ruler.mean,
            sigma: ruler.sigma,
            held: self.held.is_some(),
            covariance: ruler.covariance,
        });
        let contradicted = warnings.iter().any(|warning| matches!(warning, Warning::RulerContradicted { .. }));
        if let (Some(ruler), false) = (&ruler, contradicted) {
            warnings.extend(grown_together(&estimates, ruler));
        }
        warnings.extend(beyond_prior(&estimates, &priors, &known.covariance));
        let nominal_model = Model::new(self.nominal.clone());
        let before = self.evaluate(&nominal_model, &[], &observations, noise, Some(&state))?;
        let components = self.errors.kinds.len();
        Ok(Calibration {
            parameters: estimates,
            covariance: Some(known.covariance),
            posterior: Some(known.inputs),
            identifiability: Some(identifiability),
            epipolar_before: epipolar_statistics(&nominal_model, data)?,
            epipolar_after: epipolar_statistics(&state.model, data)?,
            reprojection_before: Some(over_inliers(&before.sizes, &sizes)),
            reprojection_after: Some(noise::statistics(&sizes)),
            noise: Noise {
                pixel: noise.pixel,
                depth_sigma_per_m2: (observations.depth_count() > 0).then_some(noise.depth),
                posture_angular: (components > 0).then_some(noise.posture.angular),
                posture_linear: self.errors.kinds.contains(&crate::ErrorKind::Linear).then_some(noise.posture.linear),
                outlier_fraction,
            },
            ruler,
            prior_scales: PriorGroup::ALL
                .into_iter()
                .filter_map(|group| Some(PriorScale { group, sigma: priors.group_sigma(group)? }))
                .collect(),
            postures: fits,
            posture_errors: state.posture_errors.chunks(components.max(1)).map(<[f64]>::to_vec).collect(),
            error_patterns: match &known.errors {
                Some(errors) => error_patterns(&state.model, self.motion, errors, &arm_positions(&data.postures))?,
                None => Vec::new(),
            },
            posture_error_knowledge: known.errors,
            termination,
            warnings,
            model: state.model,
        })
    }

    /// A sigma that was estimated with few degrees of freedom makes of the normal distribution one of Student's, whose
    /// covariance is wider: by this factor.
    fn widening(&self, adjustment: &Adjustment<'_>, state: &State) -> Result<f64, CalibrationError> {
        if !self.errors.is_estimated() {
            return Ok(1.0);
        }
        let dof = self.posture_error_estimate(adjustment, state)?.map(|estimate| estimate.dof.max(4.0));
        Ok(dof.map_or(1.0, |dof| (dof / (dof - 2.0)).sqrt()))
    }

    /// Mean and covariance of the posture errors with everything else unknown: what tests of causes are made of.
    fn posture_error_knowledge(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
    ) -> Result<Option<PostureErrorKnowledge>, CalibrationError> {
        let components = self.errors.kinds.len();
        if components == 0 {
            return Ok(None);
        }
        let sigmas = adjustment.noise.posture;
        let mut normal = adjustment.normal_matrix(state, &sigmas)?;
        let mut ignored = DVector::zeros(normal.nrows());
        adjustment.priors.add_to(self.nominal, &state.model, self.parameters, &mut normal, &mut ignored);
        let Some(covariance) = crate::bundle::adjust::inverse(&normal) else { return Ok(None) };
        let count = state.posture_errors.len();
        let first = normal.nrows() - count;
        let sigma = self.errors.sigma_of(&sigmas);
        Ok(Some(PostureErrorKnowledge {
            components,
            mean: DVector::from_column_slice(&state.posture_errors),
            covariance: covariance.view((first, first), (count, count)).into_owned(),
            sigmas: (0..count).map(&sigma).collect(),
        }))
    }
}

/// What is known at an optimum.
pub(super) struct Known {
    inputs: PosteriorInputs,
    covariance: DMatrix<f64>,
    ruler: Option<RulerPosterior>,
    errors: Option<PostureErrorKnowledge>,
}

/// Lengths and the standard of length contradict each other when this many sigmas lie between them.
const CONTRADICTION_SIGMAS: f64 = 3.0;
impl Known {
    pub(super) fn contradicted_ruler(&self) -> Option<(f64, f64)> {
        let ruler = self.ruler.as_ref()?;
        (ruler.mean.abs() > CONTRADICTION_SIGMAS * ruler.sigma).then_some((ruler.mean, ruler.sigma))
    }
}

/// A parameter that leaves its prior by so many sigmas is named.
const BEYOND_PRIOR_SIGMAS: f64 = 3.0;
/// Parameters that the data moved far out of their priors: no chance, but something that the prior did not expect.
fn beyond_prior(estimates: &[crate::ParameterEstimate], priors: &Priors, covariance: &DMatrix<f64>) -> Vec<Warning> {
    let of = |(k, estimate): (usize, &crate::ParameterEstimate)| {
        let prior = priors.sigmas[k]?;
        let change = estimate.value - estimate.nominal;
        let sigmas = change.abs() / prior;
        // What is not known to be away from nominal is no statement.
        let known = change.abs() > BEYOND_PRIOR_SIGMAS * covariance[(k, k)].max(0.0).sqrt();
        (sigmas > BEYOND_PRIOR_SIGMAS && known).then_some(Warning::BeyondPrior {
            parameter: estimate.parameter,
            change,
            prior_sigma: prior,
        })
    };
    estimates.iter().enumerate().filter_map(of).collect()
}

/// RMS over the observations that fit the calibrated model, so that before and after are over the same observations;
/// median over all.
fn over_inliers(before: &[ResidualSize], after: &[ResidualSize]) -> ReprojectionStatistics {
    let kept = before.iter().zip(after).filter(|(b, a)| a.pixel < OUTLIER_SIGMAS && b.distance_px().is_finite());
    let squares: Vec<f64> = kept.map(|(b, _)| b.residual_px.norm_squared()).collect();
    ReprojectionStatistics {
        rms_px: (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt(),
        median_px: median(&mut before.iter().map(ResidualSize::distance_px).collect::<Vec<_>>()),
        observations: before.len(),
        inliers: squares.len(),
    }
}
