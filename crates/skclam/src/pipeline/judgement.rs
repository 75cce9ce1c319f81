//! The checks of a run, each with what it calls for; the status is the worst of them.

use super::sentences::check_text;
use super::{Cause, Evidence, Status, VerdictCase};
use crate::summary::Summary;
use serde::{Deserialize, Serialize};
use skclam_calibration::{StopReason, Warning};

/// One thing that was looked at, with its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "check", rename_all = "snake_case")]
pub enum Check {
    /// The case of the verdict.
    Verdict {
        /// Which.
        case: VerdictCase,
    },
    /// Something that does not fit, by name.
    Cause {
        /// Which.
        cause: Cause,
    },
    /// Better than the nominal rig, and than its mount alone fitted, on held-out postures.
    HeldOutBetter {
        /// Nominal, px.
        nominal_px: f64,
        /// Calibrated, px.
        calibrated_px: f64,
    },
    /// Held-out postures are far more off than fitted ones.
    Systematic {
        /// Over held-out postures, px.
        held_out_px: f64,
        /// Over those that were fitted, px.
        fitted_px: f64,
    },
    /// Many observations do not fit.
    Outliers {
        /// Their part.
        fraction: f64,
    },
    /// How far apart the surfaces of overlapping depth images are, point to plane.
    DepthConsistency {
        /// At the nominal poses, mm.
        nominal_mm: f64,
        /// At the calibrated poses, mm.
        calibrated_mm: f64,
    },
    /// The scatter of the held-out fits made every sigma wider.
    SigmaWidened {
        /// As the noise alone would have it, mm.
        claimed_mm: f64,
        /// As the fits scatter, mm.
        scattered_mm: f64,
    },
    /// The solver stopped early.
    NotConverged,
    /// Combinations of parameters that the data do not determine.
    NotIdentifiable {
        /// How many.
        combinations: usize,
    },
    /// There is no arm to calibrate.
    FlangePosesOnly,
    /// Postures that do not fit the others.
    OutlierPostures {
        /// The recording's indices.
        indices: Vec<u64>,
    },
    /// Postures that share nothing with the others.
    UnobservedPostures {
        /// The recording's indices.
        indices: Vec<u64>,
    },
}

/// A check, what it calls for, and its words.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckResult {
    /// What it calls for.
    pub status: Status,
    /// What was seen.
    pub check: Check,
    /// The same in words.
    pub text: String,
}

impl From<Check> for CheckResult {
    fn from(check: Check) -> Self {
        CheckResult { status: check.status(), text: check_text(&check), check }
    }
}

/// From this ratio on the depth images are said to be less consistent.
const WORSE_CONSISTENCY: f64 = 1.05;
/// More outliers than this are many.
const MANY_OUTLIERS: f64 = 0.2;
/// Held-out residuals beyond so many times the fitted ones, and beyond this many px, show errors that the parameters do
/// not cover.
const SYSTEMATIC: (f64, f64) = (10.0, 2.0);
/// A sigma that had to be widened by more than this factor points to errors that the model of the noise does not have.
const MUCH_WIDER: f64 = 2.0;

impl Check {
    /// What it calls for.
    pub fn status(&self) -> Status {
        match self {
            Check::Verdict { case } => case.status(),
            Check::Cause { cause } => cause.status(),
            Check::HeldOutBetter { .. } => Status::Good,
            Check::DepthConsistency { nominal_mm, calibrated_mm } => {
                if *calibrated_mm > nominal_mm * WORSE_CONSISTENCY { Status::Caution } else { Status::Good }
            }
            // It was dealt with: the sigmas are as wide as the data show.
            Check::SigmaWidened { .. } => Status::Good,
            Check::Systematic { .. }
            | Check::Outliers { .. }
            | Check::NotConverged
            | Check::NotIdentifiable { .. }
            | Check::FlangePosesOnly
            | Check::OutlierPostures { .. }
            | Check::UnobservedPostures { .. } => Status::Caution,
        }
    }
}

/// The checks of a run, worst first. `warnings`: of its calibration.
pub fn judge(summary: &Summary, evidence: &Evidence, case: &VerdictCase, warnings: &[Warning]) -> Vec<CheckResult> {
    let mut checks = vec![Check::Verdict { case: case.clone() }];
    let in_case = match case {
        VerdictCase::Unexplained { cause, .. } => cause.as_ref(),
        VerdictCase::BetterWithCause { cause, .. } => Some(cause),
        _ => None,
    };
    let others = summary.causes.iter().filter(|cause| in_case != Some(cause));
    checks.extend(others.map(|cause| Check::Cause { cause: cause.clone() }));
    checks.extend(held_out(evidence, summary));
    if let Some((nominal_mm, calibrated_mm)) = summary
        .map
        .and_then(|map| Some((map.depth_consistency_nominal?.median_mm, map.depth_consistency_calibrated?.median_mm)))
    {
        checks.push(Check::DepthConsistency { nominal_mm, calibrated_mm });
    }
    checks.extend(estimate(summary, warnings));
    let mut checks: Vec<CheckResult> = checks.into_iter().map(CheckResult::from).collect();
    // Stable: among equals, the order in which they were looked at.
    checks.sort_by_key(|check| std::cmp::Reverse(check.status));
    checks
}

fn held_out(evidence: &Evidence, summary: &Summary) -> Vec<Check> {
    let mut checks = Vec::new();
    let Some(px) = evidence.held_out_px else { return checks };
    if px.calibrated < px.nominal && px.mount_only.is_none_or(|mount_only| px.calibrated < mount_only) {
        checks.push(Check::HeldOutBetter { nominal_px: px.nominal, calibrated_px: px.calibrated });
    }
    let (times, least) = SYSTEMATIC;
    if let Some(fitted_px) = evidence.reprojection_px.filter(|fitted| px.calibrated > (times * fitted).max(least)) {
        checks.push(Check::Systematic { held_out_px: px.calibrated, fitted_px });
    }
    let jackknife = summary.held_out.as_ref().and_then(|held_out| held_out.jackknife);
    if let Some(jackknife) = jackknife.filter(|found| found.scattered_m > MUCH_WIDER * found.claimed_m) {
        checks.push(Check::SigmaWidened {
            claimed_mm: jackknife.claimed_m * 1e3,
            scattered_mm: jackknife.scattered_m * 1e3,
        });
    }
    checks
}

fn estimate(summary: &Summary, warnings: &[Warning]) -> Vec<Check> {
    let mut checks = Vec::new();
    let calibration = &summary.calibration;
    if calibration.outlier_fraction > MANY_OUTLIERS {
        checks.push(Check::Outliers { fraction: calibration.outlier_fraction });
    }
    if matches!(calibration.termination.reason, StopReason::IterationLimit { .. }) {
        checks.push(Check::NotConverged);
    }
    let combinations = calibration.not_identifiable.len();
    if combinations > 0 {
        checks.push(Check::NotIdentifiable { combinations });
    }
    if !calibration.arm {
        checks.push(Check::FlangePosesOnly);
    }
    let outliers = warnings.iter().filter_map(|warning| match warning {
        Warning::OutlierPosture { index, .. } => Some(*index),
        _ => None,
    });
    let indices: Vec<u64> = outliers.collect();
    if !indices.is_empty() {
        checks.push(Check::OutlierPostures { indices });
    }
    let unobserved = warnings.iter().filter_map(|warning| match warning {
        Warning::UnobservedPosture { index, .. } => Some(*index),
        _ => None,
    });
    let indices: Vec<u64> = unobserved.collect();
    if !indices.is_empty() {
        checks.push(Check::UnobservedPostures { indices });
    }
    checks
}

/// The worst of the checks.
pub fn worst(checks: &[CheckResult]) -> Status {
    checks.iter().map(|check| check.status).max().unwrap_or(Status::Caution)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_check_decides_and_statuses_are_ordered() {
        use Status::{Bad, Caution, Good};
        assert!(Good < Caution && Caution < Bad);
        let better = Check::HeldOutBetter { nominal_px: 2.0, calibrated_px: 1.0 };
        let worse = Check::DepthConsistency { nominal_mm: 1.0, calibrated_mm: 2.0 };
        let same = Check::DepthConsistency { nominal_mm: 1.0, calibrated_mm: 1.04 };
        assert_eq!([&better, &worse, &same].map(Check::status), [Good, Caution, Good]);
        let checks: Vec<CheckResult> = vec![better.into(), worse.into(), same.into()];
        assert_eq!(worst(&checks), Caution);
        assert_eq!(worst(&[]), Caution, "nothing was looked at");
    }
}
