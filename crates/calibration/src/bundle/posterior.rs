//! The covariance of the parameters with everything in it that is not known: the scale of the arm's priors and the size of the standard of length, integrated over.
//!
//! About the optimum the likelihood of the data (posture errors, board and scene points eliminated) is a normal distribution of the parameters. For any sigmas of the
//! prior groups its product with the prior, and the evidence for those sigmas, are then closed forms, and the covariance is that of the mixture over a grid of them,
//! about the optimum that is reported. The standard of length (the board's squares, or the depth's scale) may have been held there: how far the posterior moves it is then
//! part of the covariance.

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

    /// Normal matrix of the data and of the tolerances of cameras and board: what can be identified with instruments as good as such devices are.
    pub(crate) fn with_instruments(&self, parameters: &[Parameter]) -> DMatrix<f64> {
        let mut normal = self.likelihood.normal.clone();
        for (k, parameter) in parameters.iter().enumerate() {
            if let (true, Some(sigma)) = (parameter.is_nuisance(), self.priors.sigmas[k]) {
                normal[(k, k)] += sigma.powi(-2);
            }
        }
        normal
    }

    /// The same with observations that are worth less by a factor of their variance: what a parameter is known to beyond its prior, it is known to less.
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
    let share = |log_weight: f64| (log_weight - greatest).exp() / total;
    let mean = nodes.iter().map(|(w, mean, _)| mean * share(*w)).sum::<DVector<f64>>();
    let about = |center: &DVector<f64>| {
        let mut moments = DMatrix::zeros(count, count);
        for (log_weight, mean, covariance) in &nodes {
            let away = mean - center;
            moments += (covariance + &away * away.transpose()) * share(*log_weight);
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
