//! The covariance of the parameters with everything in it that is not known: the scale of the arm's priors integrated over, the standard of length considered.
//!
//! About the optimum the likelihood of the data (posture errors, board and scene points eliminated) is a normal distribution of the parameters. For any sigmas of the
//! prior groups its product with the prior, and the evidence for those sigmas, are then closed forms, and the covariance is that of the mixture over a grid of them.

use crate::bundle::adjust::inverse;
use crate::prior::{LOG_SPREAD, PriorGroup, Priors};
use nalgebra::{DMatrix, DVector};

/// Nodes of the grid over the logarithm of a group's sigma, and how far they reach in standard deviations of its prior.
const NODES: usize = 9;
const REACH: f64 = 2.4;

/// What is known of the parameters in the end.
pub(super) struct Posterior {
    /// Of the parameters, in their order and units.
    pub covariance: DMatrix<f64>,
    /// What of it comes from the considered parameter.
    pub considered: Option<DMatrix<f64>>,
}

/// `normal`: of the data by the parameters, everything else eliminated. `prior_normal`: what priors add to it (the mount's rotations are curved). `offsets`: the
/// parameters less their nominal values at the optimum under `priors`. `held`: the parameter that was held there, with its own sigma.
pub(super) fn posterior(
    normal: &DMatrix<f64>,
    prior_normal: &DMatrix<f64>,
    offsets: &DVector<f64>,
    priors: &Priors,
    held: Option<(usize, f64)>,
) -> Option<Posterior> {
    let count = offsets.len();
    let kept: Vec<usize> = (0..count).filter(|&k| held.is_none_or(|(at, _)| at != k)).collect();
    let data = normal.select_rows(&kept).select_columns(&kept);
    let prior = prior_normal.select_rows(&kept).select_columns(&kept);
    let at_optimum = offsets.select_rows(&kept);
    // Where the likelihood alone would have the optimum: `data * center = right`.
    let right = (&data + &prior) * &at_optimum;
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
        let change = DVector::from_iterator(
            kept.len(),
            kept.iter().map(|&k| {
                let weight = |sigma: Option<f64>| sigma.map_or(0.0, |sigma| sigma.powi(-2));
                weight(these.sigmas[k]) - weight(priors.sigmas[k])
            }),
        );
        let precision = &data + &prior + DMatrix::from_diagonal(&change);
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
    let mut mixed = DMatrix::zeros(kept.len(), kept.len());
    for (log_weight, mean, covariance) in &nodes {
        // About what is reported, which is the optimum of the likeliest sigmas.
        let away = mean - &at_optimum;
        mixed += (covariance + &away * away.transpose()) * ((log_weight - greatest).exp() / total);
    }
    let mut whole = DMatrix::zeros(count, count);
    let scatter = |whole: &mut DMatrix<f64>, part: &DMatrix<f64>| {
        for (i, &row) in kept.iter().enumerate() {
            for (j, &column) in kept.iter().enumerate() {
                whole[(row, column)] = part[(i, j)];
            }
        }
    };
    scatter(&mut whole, &mixed);
    let considered = held.map(|(at, sigma)| {
        // x = x_hat - A^-1 A_xp (p - p_0).
        let nearest = inverse(&(&data + &prior)).unwrap_or_else(|| mixed.clone());
        let gain = nearest * normal.column(at).select_rows(&kept);
        let mut direction = DVector::zeros(count);
        kept.iter().zip(gain.iter()).for_each(|(&k, value)| direction[k] = -value);
        direction[at] = 1.0;
        &direction * direction.transpose() * (sigma * sigma)
    });
    if let Some(considered) = &considered {
        whole += considered;
    }
    Some(Posterior { covariance: whole, considered })
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
