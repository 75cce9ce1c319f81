//! The damped minimisation that both least-squares estimators use.
//!
//! Marquardt's damping by the diagonal of the normal matrix, driven by the ratio of gained to predicted cost (Madsen,
//! Nielsen and Tingleff, "Methods for non-linear least squares problems", 2004, section 3.2). What a step is, and what
//! it costs, is the caller's.

use crate::{CalibrationError, Parameter, StopReason};
use nalgebra::{DMatrix, DVector};

/// When the minimisation stops.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MinimizationLimits {
    pub max_iterations: usize,
    /// Relative change of the cost.
    pub cost_tolerance: f64,
    /// Norm of a step in units of the parameters' scales.
    pub step_tolerance: f64,
    /// Length of a step in sigmas; 0 for none.
    pub sigma_tolerance: f64,
}

/// A step that was tried.
pub(crate) struct Proposal<S> {
    pub state: S,
    pub cost: f64,
    /// Norm of the step in units of the parameters' scales.
    pub step: f64,
    /// Length of the step in sigmas, all unknowns together.
    pub sigmas: f64,
    /// Decrease of the cost that the linear model promises.
    pub predicted: f64,
}

/// Where the minimisation ended.
pub(crate) struct Minimization<S> {
    pub state: S,
    pub cost: f64,
    pub initial_cost: f64,
    pub iterations: usize,
    pub evaluations: usize,
    pub reason: StopReason,
}

const FIRST_DAMPING: f64 = 1e-4;
const SMALLEST_DAMPING: f64 = 1e-9;
/// A diagonal entry below this fraction of the greatest (in units of the parameters' scales) is rounding.
const UNOBSERVABLE: f64 = 1e-14;
const GREATEST_DAMPING: f64 = 1e10;
/// Equations that cannot be solved with this damping have no solution.
const SINGULAR_DAMPING: f64 = 1.0;

/// Minimises from `state`. `propose(state, damping)` solves for a step and evaluates it.
pub(crate) fn minimize<S>(
    mut state: S,
    mut cost: f64,
    limits: MinimizationLimits,
    mut propose: impl FnMut(&S, f64) -> Result<Proposal<S>, CalibrationError>,
) -> Result<Minimization<S>, CalibrationError> {
    let mut damping = FIRST_DAMPING;
    let initial_cost = cost;
    let (mut iterations, mut evaluations) = (0, 1);
    let reason = loop {
        if iterations >= limits.max_iterations {
            break StopReason::IterationLimit { limit: limits.max_iterations };
        }
        let proposal = match propose(&state, damping) {
            // Rounding made of a matrix that is barely definite one that is not: a shorter step has a better one.
            Err(CalibrationError::Singular { .. }) if damping < SINGULAR_DAMPING => {
                iterations += 1;
                damping = (damping * 10.0).max(1e-6);
                continue;
            }
            // No step improves the cost: what was reached is kept, and does not count as converged.
            Err(CalibrationError::Singular { .. }) if iterations > 0 => break StopReason::NoProgress { damping },
            other => other?,
        };
        iterations += 1;
        evaluations += 1;
        let gain = cost - proposal.cost;
        let small_step = proposal.step <= limits.step_tolerance;
        if gain.is_finite() && gain >= 0.0 {
            let relative_change = gain / cost.max(f64::MIN_POSITIVE);
            let ratio = gain / proposal.predicted.max(f64::MIN_POSITIVE);
            (state, cost) = (proposal.state, proposal.cost);
            if small_step {
                break StopReason::StepConverged { step: proposal.step, threshold: limits.step_tolerance };
            }
            // A small gain under heavy damping is a short step, not convergence.
            if relative_change <= limits.cost_tolerance && damping <= 1e-2 {
                break StopReason::CostConverged { relative_change, threshold: limits.cost_tolerance };
            }
            if proposal.sigmas <= limits.sigma_tolerance && damping <= 1e-2 {
                break StopReason::SigmasConverged { sigmas: proposal.sigmas, threshold: limits.sigma_tolerance };
            }
            if ratio > 0.75 {
                damping = (damping * 0.1).max(SMALLEST_DAMPING);
            } else if ratio < 0.25 {
                damping *= 4.0;
            }
        } else {
            if small_step {
                break StopReason::StepConverged { step: proposal.step, threshold: limits.step_tolerance };
            }
            // At the bottom rounding decides between gain and loss.
            if gain.abs() <= 1e-13 * cost && proposal.predicted <= limits.cost_tolerance * cost {
                let relative_change = gain.abs() / cost.max(f64::MIN_POSITIVE);
                break StopReason::CostConverged { relative_change, threshold: limits.cost_tolerance };
            }
            damping = (damping * 8.0).max(1e-6);
            if damping > GREATEST_DAMPING {
                break StopReason::NoProgress { damping };
            }
        }
    };
    Ok(Minimization { state, cost, initial_cost, iterations, evaluations, reason })
}

/// Solves `(H + damping diag(H)) x = g` for a symmetric positive semidefinite `H`; unknowns that nothing sees stay.
pub(crate) fn damped_solve(
    normal_matrix: &DMatrix<f64>,
    rhs: &DVector<f64>,
    parameters: &[Parameter],
    damping: f64,
) -> Result<DVector<f64>, CalibrationError> {
    let count = rhs.len();
    // Unknowns behind the parameters (board, joint errors) are radians and metres too.
    let unit = |k: usize| parameters.get(k).map_or(1e-2, |parameter| parameter.scale()).powi(2);
    let greatest = (0..count).map(|k| normal_matrix[(k, k)] * unit(k)).fold(0.0, f64::max);
    // Jacobi scaling: the factorisation then sees a unit diagonal whatever the units.
    let scale = DVector::from_fn(count, |k, _| {
        let diagonal = normal_matrix[(k, k)];
        if diagonal * unit(k) > UNOBSERVABLE * greatest { 1.0 / diagonal.sqrt() } else { 0.0 }
    });
    let scaled = DMatrix::from_fn(count, count, |i, j| {
        let value = normal_matrix[(i, j)] * scale[i] * scale[j];
        if i != j {
            value
        } else if scale[i] == 0.0 {
            1.0
        } else {
            1.0 + damping
        }
    });
    let right = rhs.component_mul(&scale);
    let mut extra = 1e-14;
    while extra < 1e3 {
        let mut attempt = scaled.clone();
        for k in 0..count {
            attempt[(k, k)] += extra;
        }
        if let Some(factor) = attempt.cholesky() {
            let solution = factor.solve(&right).component_mul(&scale);
            if solution.iter().all(|x| x.is_finite()) {
                return Ok(solution);
            }
        }
        extra *= 100.0;
    }
    Err(CalibrationError::Singular { parameters: count })
}

/// Norm of a step in units of the parameters' scales; further unknowns are left out.
pub(crate) fn scaled_norm(parameters: &[Parameter], step: &DVector<f64>) -> f64 {
    parameters.iter().zip(step.iter()).map(|(parameter, x)| (x / parameter.scale()).powi(2)).sum::<f64>().sqrt()
}

/// What the linear model promises: `g x - x H x / 2`.
pub(crate) fn predicted_gain(normal_matrix: &DMatrix<f64>, rhs: &DVector<f64>, step: &DVector<f64>) -> f64 {
    rhs.dot(step) - 0.5 * step.dot(&(normal_matrix * step))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rosenbrocks_valley_is_followed_to_its_end() {
        // r = (1 - x, 10 (y - x^2)).
        let residuals = |x: &DVector<f64>| DVector::from_vec(vec![1.0 - x[0], 10.0 * (x[1] - x[0] * x[0])]);
        let cost = |x: &DVector<f64>| 0.5 * residuals(x).norm_squared();
        let start = DVector::from_vec(vec![-1.2, 1.0]);
        let limits = MinimizationLimits {
            max_iterations: 200,
            cost_tolerance: 1e-14,
            step_tolerance: 1e-12,
            sigma_tolerance: 0.0,
        };
        let result = minimize(start.clone(), cost(&start), limits, |x, damping| {
            let jacobian = DMatrix::from_row_slice(2, 2, &[-1.0, 0.0, -20.0 * x[0], 10.0]);
            let (h, g) = (jacobian.transpose() * &jacobian, -jacobian.transpose() * residuals(x));
            let step = damped_solve(&h, &g, &[], damping)?;
            let state = x + &step;
            Ok(Proposal {
                cost: cost(&state),
                predicted: predicted_gain(&h, &g, &step),
                step: step.norm(),
                sigmas: 1.0,
                state,
            })
        })
        .unwrap();
        assert!((result.state - DVector::from_vec(vec![1.0, 1.0])).norm() < 1e-6);
        assert!(result.reason.is_converged());
    }

    #[test]
    fn what_nothing_sees_stays() {
        let h = DMatrix::from_row_slice(2, 2, &[4.0, 0.0, 0.0, 0.0]);
        let step = damped_solve(&h, &DVector::from_vec(vec![2.0, 0.0]), &[], 0.0).unwrap();
        assert!((step[0] - 0.5).abs() < 1e-9);
        assert_eq!(step[1], 0.0);
    }
}
