//! Errors of single postures as random effects: how many unknowns they are, and what the data say of their variances.
//!
//! A joint is off its reading in every posture anew (encoder, backlash, bending under load), a controller's flange pose
//! is off by six numbers. All observations of an image share these errors: they do not average out with the number of
//! its features, so they are always in the model, with variances estimated by marginal likelihood.

use crate::bundle::adjust::{Adjustment, inverse};
use crate::bundle::solve::BundleAdjuster;
use crate::bundle::state::{PostureErrorSigmas, State};
use crate::camera_kinematics::CameraKinematics;
use crate::prior::{PriorGroup, Priors, likeliest_sigma};
use crate::robust::median;
use crate::{BundleOptions, CalibrationError, PostureErrorPolicy, Warning};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use skclam_kinematics::JointKind;
use skclam_rig::Rig;

/// Sigma of a joint's error before the data are used, rad (0.003 deg): a good encoder.
const FIRST_JOINT: f64 = 5.2e-5;
/// The same of a prismatic joint, m.
const FIRST_SLIDE: f64 = 3e-5;
/// Of a controller's flange pose, whose errors are those of the nominal arm: rad and m.
const FIRST_POSE: PostureErrorSigmas = PostureErrorSigmas { angular: 1e-3, linear: 5e-4 };
/// A posture whose errors are so many times as large as those of the median posture carries no information about the
/// others.
const FAR_OFF: f64 = 5.0;

/// Whether a number is an angle or a length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorKind {
    /// Radians.
    Angular,
    /// Metres.
    Linear,
}

/// What the error of one posture consists of.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PostureErrorModel {
    /// One a component: a joint, or the six of a flange pose.
    pub kinds: Vec<ErrorKind>,
    /// Sigmas before the data are used.
    pub first: PostureErrorSigmas,
    /// Whether the sigma of angular, of linear components is estimated.
    pub estimated: [bool; 2],
}

/// What the data say of the posture errors.
pub(super) struct PostureErrorEstimate {
    /// The likeliest sigmas; those that are not estimated stay.
    pub sigmas: PostureErrorSigmas,
    /// How many of the errors are determined by the data rather than by their prior.
    pub determined: f64,
    /// Degrees of freedom of the sigmas' estimate.
    pub dof: f64,
    /// Postures whose errors are far larger than the others' and than the sigma held until now.
    pub far_off: Vec<usize>,
}

impl PostureErrorModel {
    /// Postures are exact.
    pub(crate) fn none() -> Self {
        PostureErrorModel { kinds: Vec::new(), first: FIRST_POSE, estimated: [false; 2] }
    }

    /// What may be off in the postures of a recording.
    pub(crate) fn new(
        nominal: &Rig,
        motion: &CameraKinematics,
        options: &BundleOptions,
        warnings: &mut Vec<Warning>,
    ) -> Self {
        let kinds = error_kinds(nominal, motion);
        let stated = nominal.prior.joint_error_deg.filter(|_| motion.has_joints()).map(f64::to_radians);
        let joints = PostureErrorSigmas { angular: FIRST_JOINT, linear: FIRST_SLIDE };
        let first = if motion.has_joints() { joints } else { FIRST_POSE };
        let fixed = match options.posture_errors {
            PostureErrorPolicy::Off => return Self::none(),
            PostureErrorPolicy::SigmaDeg(deg) => Some(deg.to_radians()),
            PostureErrorPolicy::Estimated => stated,
        };
        let unknowns = kinds.len() * motion.len();
        if fixed.is_some_and(|sigma| sigma <= 0.0) || kinds.is_empty() {
            return Self::none();
        }
        if unknowns > options.max_posture_errors {
            warnings.push(Warning::PostureErrorsOff { unknowns, limit: options.max_posture_errors });
            return Self::none();
        }
        let first = fixed.map_or(first, |angular| PostureErrorSigmas { angular, ..first });
        PostureErrorModel { kinds, first, estimated: [fixed.is_none(), true] }
    }

    /// Whether any sigma is estimated.
    pub(crate) fn is_estimated(&self) -> bool {
        self.kinds.iter().any(|&kind| self.estimated[kind as usize])
    }

    /// The prior sigma of every error, posture by posture.
    pub(crate) fn sigma_of<'a>(&'a self, sigmas: &'a PostureErrorSigmas) -> impl Fn(usize) -> f64 + 'a {
        move |k| sigmas.of(self.kinds[k % self.kinds.len()])
    }
}

fn error_kinds(nominal: &Rig, motion: &CameraKinematics) -> Vec<ErrorKind> {
    let components = motion.error_components();
    match &nominal.robot {
        Some(robot) if motion.has_joints() => robot
            .joints()
            .iter()
            .map(|joint| if joint.kind == JointKind::Prismatic { ErrorKind::Linear } else { ErrorKind::Angular })
            .collect(),
        _ if components == 6 => [[ErrorKind::Linear; 3], [ErrorKind::Angular; 3]].concat(),
        _ => Vec::new(),
    }
}

impl BundleAdjuster<'_> {
    /// What the data say of the posture errors; `None` where their covariance cannot be had.
    ///
    /// The sigma is the one under which the data are most likely (MacKay, "Bayesian interpolation", 1992): squared
    /// errors over the number of them that the data determine, beside a wide prior of its own.
    pub(super) fn posture_error_estimate(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
    ) -> Result<Option<PostureErrorEstimate>, CalibrationError> {
        let sigmas = adjustment.noise.posture;
        let components = self.errors.kinds.len();
        let mut normal = adjustment.normal_matrix(state, &sigmas)?;
        let mut ignored = DVector::zeros(normal.nrows());
        adjustment.priors.add_to(self.nominal, &state.model, self.parameters, &mut normal, &mut ignored);
        let Some(covariance) = inverse(&normal) else { return Ok(None) };
        let count = state.posture_errors.len();
        let first = normal.nrows() - count;
        let prior = self.errors.sigma_of(&sigmas);
        let determined = |k: usize| (1.0 - covariance[(first + k, first + k)] / prior(k).powi(2)).clamp(0.0, 1.0);
        let whitened = |k: usize| (state.posture_errors[k] / prior(k)).powi(2);
        // One that is far off (a displaced camera, wrong joints) is no noise.
        let ratio = |posture: usize| {
            let range = posture * components..(posture + 1) * components;
            range.clone().map(whitened).sum::<f64>() / range.map(determined).sum::<f64>().max(1e-3)
        };
        let ratios: Vec<f64> = (0..self.motion.len()).map(ratio).collect();
        let limit = FAR_OFF * FAR_OFF * median(&mut ratios.clone());
        let kept = |k: usize| ratios[k / components] <= limit;
        let far_off = (0..ratios.len()).filter(|&at| ratios[at] > limit.max(FAR_OFF * FAR_OFF)).collect();
        let of_kind = |kind: ErrorKind| {
            let chosen = (0..count).filter(|&k| self.errors.kinds[k % components] == kind && kept(k));
            let (squares, known) = chosen.fold((0.0, 0.0), |(squares, known), k| {
                (squares + state.posture_errors[k].powi(2), known + determined(k))
            });
            if !self.errors.estimated[kind as usize] || known < 0.5 {
                return sigmas.of(kind);
            }
            likeliest_sigma(squares, known, self.errors.first.of(kind))
        };
        let estimated = PostureErrorSigmas { angular: of_kind(ErrorKind::Angular), linear: of_kind(ErrorKind::Linear) };
        // Twice the information about the logarithm of the variance: the squared norm of `1 - covariance / prior`.
        let block = covariance.view((first, first), (count, count));
        let whitened_norm: f64 = (0..count)
            .flat_map(|i| (0..count).map(move |j| (i, j)))
            .map(|(i, j)| (block[(i, j)] / (prior(i) * prior(j))).powi(2))
            .sum();
        let traced: f64 = (0..count).map(|k| 1.0 - 2.0 * block[(k, k)] / prior(k).powi(2)).sum();
        Ok(Some(PostureErrorEstimate {
            sigmas: estimated,
            determined: (0..count).map(determined).sum(),
            dof: traced + whitened_norm,
            far_off,
        }))
    }
}

/// The likeliest sigmas of the arm's prior groups, from the data's normal matrix of the parameters (everything else
/// eliminated) and the parameters' offsets from nominal at the optimum under `priors`.
pub(super) fn likeliest_groups(normal: &DMatrix<f64>, offsets: &DVector<f64>, priors: &Priors) -> Priors {
    const ROUNDS: usize = 40;
    let weights = |priors: &Priors| {
        DVector::from_iterator(offsets.len(), priors.sigmas.iter().map(|s| s.map_or(0.0, |s| s.powi(-2))))
    };
    // Where the likelihood alone would have the optimum: `normal * center = right`.
    let right = normal * offsets + weights(priors).component_mul(offsets);
    let mut found = priors.clone();
    for _ in 0..ROUNDS {
        let posterior = normal + DMatrix::from_diagonal(&weights(&found));
        let Some(covariance) = inverse(&posterior) else { return priors.clone() };
        let mean = &covariance * &right;
        let mut change = 0.0f64;
        for group in PriorGroup::ALL {
            let (members, Some(sigma)) = (found.members(group), found.group_sigma(group)) else { continue };
            let squares: f64 = members.iter().map(|&k| mean[k] * mean[k]).sum();
            let determined: f64 =
                members.iter().map(|&k| (1.0 - covariance[(k, k)] / (sigma * sigma)).clamp(0.0, 1.0)).sum();
            let next = likeliest_sigma(squares, determined, group.median());
            change = change.max((next / sigma).ln().abs());
            found.set_group_sigma(group, next);
        }
        if change < 1e-3 {
            break;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prior::LOG_SPREAD;
    use crate::synthetic::{hp3j, normal, seeded};
    use crate::{Free, Parameter, PriorPolicy};

    fn arm() -> (Vec<Parameter>, Priors) {
        let parameters: Vec<Parameter> =
            Free::Auto.candidates(&hp3j(), true, false).unwrap().into_iter().filter(|p| p.needs_joints()).collect();
        let priors = Priors::new(&hp3j(), &Free::Auto, PriorPolicy::Auto, &parameters);
        (parameters, priors)
    }

    /// Independent measurements of the parameters with sigmas of `noise` times the group's median, of truths that are
    /// `size` times it.
    fn measured(priors: &Priors, noise: f64, size: f64, seed: u64) -> (DVector<f64>, DVector<f64>) {
        let mut rng = seeded(seed);
        let count = priors.sigmas.len();
        let median = DVector::from_fn(count, |k, _| priors.sigmas[k].unwrap());
        let sigma = &median * noise;
        let value = DVector::from_fn(count, |k, _| size * median[k] * normal(&mut rng) + sigma[k] * normal(&mut rng));
        (sigma, value)
    }

    fn found(priors: &Priors, sigma: &DVector<f64>, value: &DVector<f64>) -> Priors {
        let normal = DMatrix::from_diagonal(&sigma.map(|s| s.powi(-2)));
        // The optimum under the priors from which the search begins.
        let shrunk = |k: usize| value[k] / (1.0 + (sigma[k] / priors.sigmas[k].unwrap()).powi(2));
        likeliest_groups(&normal, &DVector::from_fn(value.len(), |k, _| shrunk(k)), priors)
    }

    #[test]
    fn the_sigmas_of_the_groups_have_the_greatest_marginal_likelihood() {
        let (_, priors) = arm();
        for (noise, size, seed) in [(0.3, 3.0, 1), (1.0, 0.5, 2), (0.01, 0.1, 3)] {
            let (sigma, value) = measured(&priors, noise, size, seed);
            let found = found(&priors, &sigma, &value);
            for group in PriorGroup::ALL {
                let members = priors.members(group);
                assert!(members.len() > 5);
                // Measurements are normal about zero with both variances together.
                let cost = |log: f64| {
                    let own = |&k: &usize| {
                        let variance = sigma[k].powi(2) + (2.0 * log).exp();
                        0.5 * variance.ln() + 0.5 * value[k].powi(2) / variance
                    };
                    members.iter().map(own).sum::<f64>() + 0.5 * ((log - group.median().ln()) / LOG_SPREAD).powi(2)
                };
                let grid = (0..16_000).map(|k| group.median().ln() - 8.0 + 1e-3 * f64::from(k));
                let best = grid.min_by(|a, b| cost(*a).total_cmp(&cost(*b))).unwrap().exp();
                let sigma = found.group_sigma(group).unwrap();
                assert!((sigma / best - 1.0).abs() < 0.01, "{group:?}: {sigma} {best}");
            }
        }
    }

    #[test]
    fn silent_data_leave_the_groups_at_their_medians() {
        let (_, priors) = arm();
        let (sigma, value) = measured(&priors, 1e3, 0.0, 4);
        let found = found(&priors, &sigma, &value);
        for group in PriorGroup::ALL {
            let sigma = found.group_sigma(group).unwrap();
            assert!((sigma / group.median() - 1.0).abs() < 0.01, "{group:?}: {sigma}");
        }
    }
}
