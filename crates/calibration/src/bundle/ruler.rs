//! A standard of length that is wrong beyond every tolerance: a slip of the pen in `square_mm` or `unit_mm`.
//!
//! Such a slip is less likely than any tolerance has it, so that the evidence prefers an arm whose lengths are all
//! wrong. But then they are wrong by the same factor, and lengths that are wrong by themselves are not.

use crate::{Parameter, ParameterEstimate, Ruler, Unit, Warning};

/// Lengths that grew by the same factor, in standard errors of that factor by their own scatter about it.
const TOGETHER_SIGMAS: f64 = 6.0;
/// And by how many tolerances of the standard.
const BEYOND_TOLERANCE: f64 = 2.0;
/// Fewer lengths do not show that.
const MIN_LENGTHS: usize = 5;

/// Names the standard of length where all lengths of the arm grew by a factor that neither chance nor its tolerance
/// explains.
pub(super) fn grown_together(estimates: &[ParameterEstimate], ruler: &Ruler) -> Option<Warning> {
    let (scale_error, sigma) = common_scale_error(estimates)?;
    let together =
        scale_error.abs() > TOGETHER_SIGMAS * sigma && scale_error.abs() > BEYOND_TOLERANCE * ruler.prior_sigma;
    // The standard is as much larger than it is said to be as lengths came out too small.
    together.then_some(Warning::RulerContradicted { parameter: ruler.parameter, mean: -scale_error, sigma })
}

/// The common factor less 1 by which the arm's lengths grew, and its standard error from how they scatter about it.
fn common_scale_error(estimates: &[ParameterEstimate]) -> Option<(f64, f64)> {
    let is_length =
        |e: &&ParameterEstimate| matches!(e.parameter, Parameter::Chain(_)) && e.parameter.unit() == Unit::Metre;
    let lengths: Vec<(f64, f64)> =
        estimates.iter().filter(is_length).map(|e| (e.nominal, e.value - e.nominal)).collect();
    let weight: f64 = lengths.iter().map(|(length, _)| length * length).sum();
    if lengths.len() < MIN_LENGTHS || weight <= 0.0 {
        return None;
    }
    let scale_error = lengths.iter().map(|(length, change)| length * change).sum::<f64>() / weight;
    let squares: f64 = lengths.iter().map(|(length, change)| (change - scale_error * length).powi(2)).sum();
    Some((scale_error, (squares / (lengths.len() - 1) as f64 / weight).sqrt()))
}
