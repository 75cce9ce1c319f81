//! Whether two calibrations of one arm agree within what they claim.

use crate::gauge::quadratic;
use anyhow::{Context, Result, ensure};
use nalgebra::{DMatrix, DVector};
use skclam::calibration::{Calibration, Parameter};

/// Chi squared of the difference of the arm's parameters that both calibrations freed, with the two covariances summed,
/// and their number. The base's gauge is not free and not among them; the mounts are each day's own.
///
/// # Errors
/// No covariance, or no shared parameter.
pub fn disagreement(first: &Calibration, second: &Calibration) -> Result<(f64, usize)> {
    let at = |calibration: &Calibration, wanted: Parameter| {
        calibration.parameters.iter().position(|estimate| estimate.parameter == wanted)
    };
    let shared: Vec<(usize, usize)> = first
        .parameters
        .iter()
        .enumerate()
        .filter(|(_, estimate)| matches!(estimate.parameter, Parameter::Chain(_)))
        .filter_map(|(k, estimate)| Some((k, at(second, estimate.parameter)?)))
        .collect();
    ensure!(!shared.is_empty(), "the two calibrations share no parameter of the arm");
    let none = "the estimator gives no covariance";
    let (a, b) = (first.covariance.as_ref().context(none)?, second.covariance.as_ref().context(none)?);
    let count = shared.len();
    let sum = DMatrix::from_fn(count, count, |i, j| a[(shared[i].0, shared[j].0)] + b[(shared[i].1, shared[j].1)]);
    let difference =
        DVector::from_fn(count, |k, _| first.parameters[shared[k].0].value - second.parameters[shared[k].1].value);
    Ok((quadratic(&sum, &difference)?, count))
}
