//! The covariance of the parameters with everything in it that is not known: the scale of the arm's priors and the size
//! of the standard of length, integrated over.
//!
//! About the optimum the likelihood of the data (posture errors, board and scene points eliminated) is a normal
//! distribution of the parameters. For any sigmas of the prior groups its product with the prior, and the evidence for
//! those sigmas, are then closed forms, and the covariance is that of the mixture over a grid of them, about the
//! optimum that is reported. The standard of length (the board's squares, or the depth's scale) may have been held
//! there: how far the posterior moves it is then part of the covariance.

use crate::Parameter;
use crate::bundle::adjust::inverse;
use crate::prior::{LOG_SPREAD, PriorGroup, Priors};
use nalgebra::{DMatrix, DVector};

/// Nodes of the grid over the logarithm of a group's sigma, and how far they reach in standard deviations of its prior.
const NODES: usize = 9;
const REACH: f64 = 2.4;

/// The likelihood of the data by the parameters, everything else eliminated, about an optimum.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Likelihood {
    /// Normal matrix.
    pub normal: DMatrix<f64>,
    /// Negative gradient at the optimum.
    pub gradient: DVector<f64>,
    /// The optimum: parameters less their nominal values.
    pub offsets: DVector<f64>,
}

/// All that a posterior is made of.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct PosteriorInputs {
    pub likelihood: Likelihood,
    /// What priors add to the normal matrix (the mount's rotations are curved).
    pub prior_normal: DMatrix<f64>,
    pub priors: Priors,
    /// The position of the standard of length, which has a prior.
    pub ruler: Option<usize>,
    /// Whether it is held at its place.
    pub held: bool,
}

impl PosteriorInputs {
    pub(crate) fn posterior(&self) -> Option<Posterior> {
        posterior(&self.likelihood, &self.prior_normal, &self.priors, self.ruler, self.held)
    }

    /// Normal matrix of the data and of the tolerances of cameras and board: what can be identified with instruments as
    /// good as such devices are.
    pub(crate) fn with_instruments(&self, parameters: &[Parameter]) -> DMatrix<f64> {
        let mut normal = self.likelihood.normal.clone();
        for (k, parameter) in parameters.iter().enumerate() {
            if let (true, Some(sigma)) = (parameter.is_nuisance(), self.priors.sigmas[k]) {
                normal[(k, k)] += sigma.powi(-2);
            }
        }
        normal
    }

    /// The covariance to be expected before anything was measured: the average over what arms may be made to.
    pub(crate) fn expected_covariance(&self) -> Option<DMatrix<f64>> {
        let weight = |sigma: Option<f64>| sigma.map_or(0.0, |sigma| sigma.powi(-2));
        let count = self.likelihood.offsets.len();
        let (mut sum, mut total) = (DMatrix::zeros(count, count), 0.0);
        for (angles, lengths) in grid(&self.priors) {
            let mut these = self.priors.clone();
            let mut log_weight = 0.0;
            for (group, sigma) in [(PriorGroup::Angles, angles), (PriorGroup::Lengths, lengths)] {
                let Some(sigma) = sigma else { continue };
                these.set_group_sigma(group, sigma);
                log_weight -= 0.5 * ((sigma / group.median()).ln() / LOG_SPREAD).powi(2);
            }
            let change = DVector::from_fn(count, |k, _| weight(these.sigmas[k]) - weight(self.priors.sigmas[k]));
            let precision = &self.likelihood.normal + &self.prior_normal + DMatrix::from_diagonal(&change);
            sum += inverse(&precision)? * log_weight.exp();
            total += log_weight.exp();
        }
        Some(sum / total)
    }

    /// The same with observations that are worth less by a factor of their variance: what a parameter is known to
    /// beyond its prior, it is known to less.
    pub(crate) fn tempered(&self, variance_factor: f64) -> Self {
        let mut tempered = self.clone();
        tempered.likelihood.normal /= variance_factor;
        tempered.likelihood.gradient /= variance_factor;
        tempered
    }
}

/// What is known of the parameters in the end.
pub(crate) struct Posterior {
    /// Second moments about the optimum, which is what is reported, in the parameters' order and units.
    pub covariance: DMatrix<f64>,
    /// Covariance about its own mean.
    pub own: DMatrix<f64>,
    /// Of the standard of length, if there is one.
    pub ruler: Option<RulerPosterior>,
}

/// What is known of the standard of length.
pub(crate) struct RulerPosterior {
    /// Mean less nominal.
    pub mean: f64,
    pub sigma: f64,
    /// Square of the way from its mean to where it is held; 0 where it is not.
    pub away_squared: f64,
    /// Its part of the covariance.
    pub covariance: DMatrix<f64>,
}

/// See [`PosteriorInputs`].
pub(crate) fn posterior(
    likelihood: &Likelihood,
    prior_normal: &DMatrix<f64>,
    priors: &Priors,
    ruler: Option<usize>,
    held: bool,
) -> Option<Posterior> {
    let Likelihood { normal, gradient, offsets } = likelihood;
    let count = offsets.len();
    // Where the likelihood alone would have the optimum: `normal * center = right`.
    let right = normal * offsets + gradient;
    let weight = |sigma: Option<f64>| sigma.map_or(0.0, |sigma| sigma.powi(-2));
    let mut nodes = Vec::new();
    for (angles, lengths) in grid(priors) {
        let mut these = priors.clone();
        let mut log_weight = 0.0;
        for (group, sigma) in [(PriorGroup::Angles, angles), (PriorGroup::Lengths, lengths)] {
            let (Some(sigma), members) = (sigma, these.members(group)) else { continue };
            these.set_group_sigma(group, sigma);
            log_weight -= 0.5 * ((sigma / group.median()).ln() / LOG_SPREAD).powi(2);
            log_weight -= members.len() as f64 * sigma.ln();
        }
        let change = DVector::from_fn(count, |k, _| weight(these.sigmas[k]) - weight(priors.sigmas[k]));
        let precision = normal + prior_normal + DMatrix::from_diagonal(&change);
        let Some(covariance) = inverse(&precision) else { continue };
        let Some(factor) = precision.cholesky() else { continue };
        let log_determinant = 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let mean = &covariance * &right;
        log_weight += 0.5 * right.dot(&mean) - 0.5 * log_determinant;
        nodes.push((log_weight, mean, covariance));
    }
    let greatest = nodes.iter().map(|node| node.0).fold(f64::NEG_INFINITY, f64::max);
    let total: f64 = nodes.iter().map(|node| (node.0 - greatest).exp()).sum();
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let fraction = |log_weight: f64| (log_weight - greatest).exp() / total;
    let mean = nodes.iter().map(|(w, mean, _)| mean * fraction(*w)).sum::<DVector<f64>>();
    let about = |center: &DVector<f64>| {
        let mut moments = DMatrix::zeros(count, count);
        for (log_weight, mean, covariance) in &nodes {
            let away = mean - center;
            moments += (covariance + &away * away.transpose()) * fraction(*log_weight);
        }
        moments
    };
    let own = about(&mean);
    let covariance = about(offsets);
    let Some(at) = ruler else { return Some(Posterior { covariance, own, ruler: None }) };
    let variance = own[(at, at)];
    // What the other parameters do where the standard of length is off: the regression on it.
    let direction = own.column(at) / variance;
    let away = if held { mean[at] - offsets[at] } else { 0.0 };
    let moved = variance + away * away;
    Some(Posterior {
        covariance,
        ruler: Some(RulerPosterior {
            mean: mean[at],
            sigma: variance.sqrt(),
            away_squared: away * away,
            covariance: &direction * direction.transpose() * moved,
        }),
        own,
    })
}

/// Sigmas of the two groups to be tried; `None` for a group that is not estimated.
fn grid(priors: &Priors) -> Vec<(Option<f64>, Option<f64>)> {
    let nodes = |group: PriorGroup| -> Vec<Option<f64>> {
        if priors.group_sigma(group).is_none() {
            return vec![None];
        }
        let at = |k: usize| (2.0 * k as f64 / (NODES - 1) as f64 - 1.0) * REACH * LOG_SPREAD;
        (0..NODES).map(|k| Some(group.median() * at(k).exp())).collect()
    };
    let lengths = nodes(PriorGroup::Lengths);
    nodes(PriorGroup::Angles).into_iter().flat_map(|a| lengths.iter().map(move |&l| (a, l))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::hp3j;
    use crate::{Free, MountComponent, PriorPolicy};
    use nalgebra::{Matrix2, Vector2};

    /// An angle of the arm, whose sigma is not known, and one of the mount, whose is.
    fn priors() -> Priors {
        let angle = Free::Angles.candidates(&hp3j(), true, false).unwrap()[0];
        let parameters = [angle, Parameter::Mount(MountComponent::RotationX)];
        let mut rig = hp3j();
        rig.prior.mount_rotation_deg = Some(0.2);
        let priors = Priors::new(&rig, &Free::Auto, PriorPolicy::Auto, &parameters);
        assert_eq!(priors.members(PriorGroup::Angles), [0]);
        priors
    }

    /// Second moments about `center` of two parameters and the logarithm of the sigma of the first, summed over a fine
    /// grid.
    fn integrated(normal: &Matrix2<f64>, mode: &Vector2<f64>, known: f64, center: &Vector2<f64>) -> Matrix2<f64> {
        let median = PriorGroup::Angles.median();
        let reach = 12.0 * median;
        let (mut total, mut moments) = (0.0, Matrix2::zeros());
        for log in (0..160).map(|k| -4.0 * LOG_SPREAD + 8.0 * LOG_SPREAD * (f64::from(k) + 0.5) / 160.0) {
            let sigma = median * log.exp();
            let own = (-0.5 * (log / LOG_SPREAD).powi(2)).exp() / sigma;
            for (i, j) in (0..240).flat_map(|i| (0..240).map(move |j| (i, j))) {
                // Finer about nothing, where the prior of a small sigma peaks.
                let t = [i, j].map(|k: i32| 2.0 * (f64::from(k) + 0.5) / 240.0 - 1.0);
                let x = Vector2::new(reach * t[0].powi(3), reach * t[1]);
                let jacobian = 3.0 * t[0] * t[0];
                let off = x - mode;
                let exponent = (off.transpose() * normal * off)[0] + (x.x / sigma).powi(2) + (x.y / known).powi(2);
                let density = own * jacobian * (-0.5 * exponent).exp();
                total += density;
                moments += (x - center) * (x - center).transpose() * density;
            }
        }
        moments / total
    }

    #[test]
    fn the_mixture_has_the_moments_of_the_integral() {
        let priors = priors();
        let median = PriorGroup::Angles.median();
        let known = priors.sigmas[1].unwrap();
        for (sigma, mode) in [([1.0, 0.8], [2.0, -1.0]), ([3.0, 2.0], [1.0, 1.0]), ([0.4, 1.5], [0.3, 0.0])] {
            let roots = Vector2::new(1.0 / (sigma[0] * median), 1.0 / (sigma[1] * median));
            let normal =
                Matrix2::new(roots.x * roots.x, 0.7 * roots.x * roots.y, 0.7 * roots.x * roots.y, roots.y * roots.y);
            let mode = Vector2::from(mode) * median;
            let offsets = (normal + Matrix2::from_diagonal(&Vector2::new(median.powi(-2), known.powi(-2))))
                .try_inverse()
                .unwrap()
                * (normal * mode);
            let dynamic = |m: &Matrix2<f64>| DMatrix::from_fn(2, 2, |i, j| m[(i, j)]);
            let vector = |v: Vector2<f64>| DVector::from_column_slice(v.as_slice());
            let likelihood = Likelihood {
                normal: dynamic(&normal),
                gradient: vector(normal * (mode - offsets)),
                offsets: vector(offsets),
            };
            let prior_normal = DMatrix::from_diagonal(&DVector::from_vec(vec![median.powi(-2), known.powi(-2)]));
            let found = posterior(&likelihood, &prior_normal, &priors, None, false).unwrap().covariance;
            let expected = integrated(&normal, &mode, known, &offsets);
            let unit = median * median;
            for (i, j) in [(0, 0), (0, 1), (1, 1)] {
                let size = (expected[(i, i)] * expected[(j, j)]).sqrt();
                let error = (found[(i, j)] - expected[(i, j)]).abs() / size;
                assert!(error < 0.03, "({i}, {j}): {} {}", found[(i, j)] / unit, expected[(i, j)] / unit);
            }
        }
    }

    #[test]
    fn a_held_standard_of_length_adds_how_far_it_is_from_its_mean() {
        let priors = Priors::none(2);
        let prior_normal = DMatrix::from_diagonal(&DVector::from_vec(vec![0.0, 4.0]));
        let normal = DMatrix::from_row_slice(2, 2, &[3.0, 1.0, 1.0, 2.0]);
        // Held at zero, where the data would have it at (0.7, 0.5).
        let mode = DVector::from_vec(vec![0.7, 0.5]);
        let right = &normal * &mode;
        let offsets = DVector::from_vec(vec![right[0] / normal[(0, 0)], 0.0]);
        let gradient = &right - &normal * &offsets;
        let likelihood = Likelihood { normal: normal.clone(), gradient, offsets: offsets.clone() };
        let found = posterior(&likelihood, &prior_normal, &priors, Some(1), true).unwrap();
        let precision = &normal + &prior_normal;
        let own = precision.clone().try_inverse().unwrap();
        let mean = &own * &right;
        let ruler = found.ruler.unwrap();
        assert!((ruler.mean - mean[1]).abs() < 1e-9 && (ruler.sigma - own[(1, 1)].sqrt()).abs() < 1e-9);
        assert!((ruler.away_squared - mean[1] * mean[1]).abs() < 1e-9);
        let away = &mean - &offsets;
        assert!((&found.covariance - (&own + &away * away.transpose())).amax() < 1e-9);
        // Without it: the first parameter with the second known.
        let rest = &found.covariance - &ruler.covariance;
        assert!((rest[(0, 0)] - 1.0 / normal[(0, 0)]).abs() < 1e-9 && rest[(1, 1)].abs() < 1e-9, "{rest}");
    }
}
