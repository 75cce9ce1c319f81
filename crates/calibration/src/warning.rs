//! What a user should know, though it is no error.

use crate::Parameter;
use serde::{Deserialize, Serialize};
use std::fmt;

/// A condition that a user should know of, with its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Warning {
    /// Two postures of a pair lie so close together that there is no epipolar geometry; the pair was skipped.
    NoBaseline {
        /// Position of the first posture.
        a: usize,
        /// Position of the second posture.
        b: usize,
        /// Distance of the camera centres, metres.
        baseline_m: f64,
    },
    /// A pair has hardly any matches.
    FewMatches {
        /// Position of the first posture.
        a: usize,
        /// Position of the second posture.
        b: usize,
        /// How many matches it has.
        matches: usize,
    },
    /// More than half of the correspondences do not fit.
    ManyOutliers {
        /// Fraction that does not fit.
        fraction: f64,
    },
    /// A posture fits far worse than the others: wrong joints, a displaced camera, a moved scene.
    OutlierPosture {
        /// Position of the posture.
        posture: usize,
        /// Its index in the recording.
        index: u64,
        /// Fraction of its observations that do not fit.
        outlier_fraction: f64,
        /// Median residual of the posture, in units of the common sigma.
        median_sigmas: f64,
        /// Whether it was left out of the estimate.
        excluded: bool,
    },
    /// A posture is seen by no usable correspondence.
    UnobservedPosture {
        /// Position of the posture.
        posture: usize,
        /// Its index in the recording.
        index: u64,
    },
    /// Only flange poses are known, so the arm's parameters cannot be had.
    FlangePosesOnly,
    /// Tracks that name a posture twice lost the later observations.
    RepeatedPosture {
        /// Number of observations that were dropped.
        observations: usize,
    },
    /// Errors of single postures were not estimated because there are too many postures.
    PostureErrorsOff {
        /// Number of unknowns it would have taken.
        unknowns: usize,
        /// The limit.
        limit: usize,
    },
    /// The data moved a parameter far out of its prior.
    BeyondPrior {
        /// Which.
        parameter: Parameter,
        /// From its nominal value, in its unit.
        change: f64,
        /// Sigma of its prior, in its unit.
        prior_sigma: f64,
    },
    /// The arm's nominal lengths and the standard of length contradict each other; it was estimated beside them.
    RulerContradicted {
        /// The scale of the board's squares, or of the depth.
        parameter: Parameter,
        /// How much larger than nominal it seems to be: a fraction.
        mean: f64,
        /// Sigma of that.
        sigma: f64,
    },
    /// What does not count as an outlier is far off all the same: matches that contradict each other, or too little is
    /// free to explain them.
    LargeResiduals {
        /// Sigma of a coordinate in units of what its observation says of itself (px where that is 1).
        sigma: f64,
    },
    /// The solver did not converge.
    NotConverged {
        /// How it ended.
        reason: String,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Warning::NoBaseline { a, b, baseline_m } => write!(
                f,
                "postures {a} and {b} are {:.2} mm apart: no epipolar geometry, the pair was skipped; move the arm further",
                baseline_m * 1e3
            ),
            Warning::FewMatches { a, b, matches } => {
                write!(f, "postures {a} and {b} share only {matches} matches; more overlap or texture would help")
            }
            Warning::ManyOutliers { fraction } => {
                write!(
                    f,
                    "{:.0} % of the correspondences do not fit; check the matches and the nominal rig",
                    fraction * 100.0
                )
            }
            Warning::OutlierPosture { posture, index, outlier_fraction, median_sigmas, excluded } => write!(
                f,
                "posture {posture} (index {index}) does not fit: {:.0} % outliers, median {median_sigmas:.1} sigma; {}; check its joint values and the camera's seat",
                outlier_fraction * 100.0,
                if *excluded { "left out" } else { "down-weighted" }
            ),
            Warning::UnobservedPosture { posture, index } => {
                write!(f, "posture {posture} (index {index}) has no usable correspondence")
            }
            Warning::FlangePosesOnly => {
                write!(f, "only flange poses are known: the mount can be calibrated, the arm's parameters cannot")
            }
            Warning::RepeatedPosture { observations } => {
                write!(f, "{observations} observations were dropped because their track names a posture twice")
            }
            Warning::PostureErrorsOff { unknowns, limit } => {
                write!(
                    f,
                    "the errors of single postures were left at zero: {unknowns} unknowns exceed the limit of {limit}"
                )
            }
            Warning::BeyondPrior { parameter, change, prior_sigma } => {
                let (factor, unit) = parameter.unit().of_files();
                write!(
                    f,
                    "{parameter} moved by {:+.3} {unit}, {:.1} times what is expected of it ({:.3} {unit})",
                    change * factor,
                    change.abs() / prior_sigma,
                    prior_sigma * factor
                )
            }
            Warning::RulerContradicted { parameter, mean, sigma } => {
                let what = if *parameter == Parameter::BoardScale {
                    "the board's squares (square_mm)"
                } else {
                    "the depth camera's scale (unit_mm)"
                };
                write!(
                    f,
                    "the arm's nominal lengths contradict {what}: {:+.2} % off with a sigma of {:.2} %; both were weighed by their tolerances",
                    mean * 100.0,
                    sigma * 100.0
                )
            }
            Warning::LargeResiduals { sigma } => write!(
                f,
                "even the observations that fit are {sigma:.1} times as far off as features are uncertain: matches contradict each other (repeated texture, a scene that moved), or the nominal rig is wrong in what is not free; do not trust this calibration"
            ),
            Warning::NotConverged { reason } => write!(f, "the solver {reason}"),
        }
    }
}
