//! What a person should hear of, though it is no error.

use serde::{Deserialize, Serialize};
use std::fmt;

/// A condition that a person should hear of, with its numbers.
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
    /// A posture fits far worse than the others: wrong joints, a bumped camera, a moved scene.
    SuspectPosture {
        /// Position of the posture.
        posture: usize,
        /// Its index in the recording.
        index: u64,
        /// Fraction of its observations that do not fit.
        outlier_fraction: f64,
        /// Median residual of the posture, in units of the common sigma.
        median_sigmas: f64,
        /// Whether it was left out of the estimate.
        left_out: bool,
    },
    /// A posture is seen by no usable correspondence.
    UnseenPosture {
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
    /// Joint deviations were not estimated because there are too many postures.
    DeviationsOff {
        /// Number of unknowns it would have taken.
        unknowns: usize,
        /// The limit.
        limit: usize,
    },
    /// Joints seemed to deviate by more than encoders do, and held-out postures are predicted better without deviations: they were left at zero.
    DeviationsRefused {
        /// The sigma that seemed likeliest, degrees.
        sigma_deg: f64,
        /// Held-out figure with deviations, px; `None` where there are too few postures to hold some out.
        with_px: Option<f64>,
        /// The same without.
        without_px: Option<f64>,
    },
    /// What does not count as an outlier is far off all the same: matches that contradict each other, or too little is free to explain them.
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
            Warning::SuspectPosture { posture, index, outlier_fraction, median_sigmas, left_out } => write!(
                f,
                "posture {posture} (index {index}) does not fit: {:.0} % outliers, median {median_sigmas:.1} sigma; {}; check its joint values and the camera's seat",
                outlier_fraction * 100.0,
                if *left_out { "left out" } else { "down-weighted" }
            ),
            Warning::UnseenPosture { posture, index } => {
                write!(f, "posture {posture} (index {index}) has no usable correspondence")
            }
            Warning::FlangePosesOnly => {
                write!(f, "only flange poses are known: the mount can be calibrated, the arm's parameters cannot")
            }
            Warning::RepeatedPosture { observations } => {
                write!(f, "{observations} observations were dropped because their track names a posture twice")
            }
            Warning::DeviationsOff { unknowns, limit } => {
                write!(f, "joint deviations were left at zero: {unknowns} unknowns exceed the limit of {limit}")
            }
            Warning::DeviationsRefused { sigma_deg, with_px, without_px } => {
                write!(
                    f,
                    "joints seemed to stand {sigma_deg:.4} deg off their values, more than encoders do: errors of the arm in disguise; "
                )?;
                match (with_px, without_px) {
                    (Some(with), Some(without)) => {
                        write!(
                            f,
                            "held-out postures fit to {without:.2} px without such deviations, {with:.2} px with; "
                        )?;
                    }
                    _ => write!(f, "there are too few postures to test that on held-out ones; ")?,
                }
                write!(f, "they were left at zero")
            }
            Warning::LargeResiduals { sigma } => write!(
                f,
                "even the sights that fit are {sigma:.1} times as far off as features are uncertain: matches contradict each other (repeated texture, a scene that moved), or the nominal rig is wrong in what is not free; do not trust this calibration"
            ),
            Warning::NotConverged { reason } => write!(f, "the solver {reason}"),
        }
    }
}
