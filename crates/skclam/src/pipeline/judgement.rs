//! The traffic light of a run with its reasons: the worst that anything calls for that was looked at.

use super::VerdictGrade;
use super::verdict::UNEXPLAINED_PX;
use crate::summary::Summary;
use serde::{Deserialize, Serialize};
use skclam_calibration::StopReason;

/// One thing that was looked at, and what it calls for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reason {
    /// What it calls for.
    pub grade: VerdictGrade,
    /// What was seen.
    pub text: String,
}

/// From this ratio on the depth images are said to agree less, or more.
const WORSE_AGREEMENT: f64 = 1.05;
/// More outliers than this are many.
const MANY_OUTLIERS: f64 = 0.2;
/// Held-out residuals beyond so many times the fitted ones, and beyond this many px, show errors that the parameters do not cover.
const SYSTEMATIC: (f64, f64) = (4.0, 1.0);

/// Reasons, worst first, for a run whose estimate and held-out postures alone call for `own`.
pub fn judge(summary: &Summary, own: VerdictGrade) -> Vec<Reason> {
    let mut reasons = Vec::new();
    {
        let mut tell = |grade, text: String| reasons.push(Reason { grade, text });
        fit(summary, own, &mut tell);
        surfaces(summary, &mut tell);
        estimate(summary, &mut tell);
    }
    // Stable: among equals, the order in which they were looked at.
    reasons.sort_by_key(|reason| std::cmp::Reverse(reason.grade));
    reasons
}

/// The worst of the reasons, but at least `own`.
pub fn worst(reasons: &[Reason], own: VerdictGrade) -> VerdictGrade {
    reasons.iter().map(|reason| reason.grade).fold(own, VerdictGrade::max)
}

fn fit(summary: &Summary, own: VerdictGrade, tell: &mut dyn FnMut(VerdictGrade, String)) {
    let calibration = &summary.calibration;
    let (before, after) = (&calibration.epipolar_before, &calibration.epipolar_after);
    if after.matches > 0 {
        if after.median_px > UNEXPLAINED_PX {
            tell(
                VerdictGrade::Bad,
                format!(
                    "The calibrated rig does not explain the images: matches stay {:.1} px from their lines in the median.",
                    after.median_px
                ),
            );
        } else if after.median_px >= before.median_px && before.median_px > 0.0 {
            tell(own.max(VerdictGrade::Caution), "The matches fit no better than with the nominal rig.".to_owned());
        }
    }
    let told = match &summary.held_out {
        None => "It was not tried on postures that it was not fitted to (no held-out test).",
        Some(held_out) if !held_out.beats_nominal() => {
            "On postures that it was not fitted to (held out) it is no better than the nominal rig."
        }
        Some(held_out) if held_out.beats_mount_only() == Some(false) => {
            "On postures that it was not fitted to (held out), correcting the mount alone does as well as correcting the arm."
        }
        Some(_) if own == VerdictGrade::Good => "It holds on postures that it was not fitted to (held out).",
        // What is wrong then is said by another reason.
        Some(_) => "It is better than the nominal rig on postures that it was not fitted to (held out).",
    };
    let beaten = summary
        .held_out
        .as_ref()
        .is_some_and(|held_out| held_out.beats_nominal() && held_out.beats_mount_only() != Some(false));
    tell(if beaten { VerdictGrade::Good } else { own }, told.to_owned());
    if let (Some(held_out), Some(fitted)) = (&summary.held_out, &calibration.reprojection_after) {
        let px = held_out.metric_px.calibrated;
        if held_out.metric.starts_with("reprojection") && px > SYSTEMATIC.1 && px > SYSTEMATIC.0 * fitted.rms_px {
            let text = format!(
                "Held-out postures stay {px:.1} px off, fitted ones {:.1} px: something is wrong that is not among the free parameters, or the postures are too few.",
                fitted.rms_px
            );
            tell(VerdictGrade::Caution, text);
        }
    }
    if calibration.outlier_fraction > MANY_OUTLIERS {
        let text = format!("{:.0} % of the correspondences do not fit.", calibration.outlier_fraction * 100.0);
        tell(VerdictGrade::Caution, text);
    }
}

fn surfaces(summary: &Summary, tell: &mut dyn FnMut(VerdictGrade, String)) {
    let agreement = summary.map.and_then(|map| Some((map.agreement_nominal?, map.agreement_calibrated?)));
    let Some((before, after)) = agreement.map(|(before, after)| (before.median_mm, after.median_mm)) else { return };
    if after > before * WORSE_AGREEMENT {
        let text = format!(
            "The depth images agree less than before ({before:.1} mm to {after:.1} mm apart): matches and depth contradict each other."
        );
        tell(VerdictGrade::Caution, text);
    } else if after * WORSE_AGREEMENT < before {
        tell(VerdictGrade::Good, "The surfaces of the depth images agree better than before.".to_owned());
    } else {
        tell(VerdictGrade::Good, "The surfaces of the depth images agree as well as before.".to_owned());
    }
}

fn estimate(summary: &Summary, tell: &mut dyn FnMut(VerdictGrade, String)) {
    let calibration = &summary.calibration;
    if let Some(suspicion) = summary.scale.suspicion() {
        let mut text = suspicion.text;
        text.replace_range(..1, "A");
        tell(if suspicion.certain { VerdictGrade::Bad } else { VerdictGrade::Caution }, format!("{text}."));
    }
    let no_sigma = summary.recorded_poses.as_ref().is_none_or(|poses| poses.camera_sigma_mm.is_none());
    if no_sigma {
        let text = "How far off the camera still is was not estimated: this estimator gives no standard deviations.";
        tell(VerdictGrade::Caution, text.to_owned());
    }
    if matches!(calibration.termination.reason, StopReason::IterationLimit { .. }) {
        let text = "The solver stopped at its limit of iterations before it converged.";
        tell(VerdictGrade::Caution, text.to_owned());
    }
    let unseen = calibration.not_identifiable.len();
    if unseen > 0 {
        let what = if unseen == 1 { "combination of parameters is" } else { "combinations of parameters are" };
        let text = format!("{unseen} {what} not seen by the data; see \u{201c}What the data cannot tell\u{201d}.");
        tell(VerdictGrade::Caution, text);
    }
    if !calibration.arm {
        let text = "Only flange poses are known: the mount is calibrated, the arm is not.";
        tell(VerdictGrade::Caution, text.to_owned());
    }
    let suspects = summary.warnings.iter();
    let suspects = suspects.filter(|text| text.starts_with("posture ") && text.contains("does not fit")).count();
    let alone = summary.warnings.iter().filter(|text| text.contains("no usable correspondence")).count();
    if suspects > 0 {
        let what = if suspects == 1 { "posture does" } else { "postures do" };
        tell(VerdictGrade::Caution, format!("{suspects} {what} not fit the others; see the warnings."));
    }
    if alone > 0 {
        let what = if alone == 1 { "posture shares" } else { "postures share" };
        tell(VerdictGrade::Caution, format!("{alone} {what} no usable view with the others; see the warnings."));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reason(grade: VerdictGrade) -> Reason {
        Reason { grade, text: String::new() }
    }

    #[test]
    fn the_worst_reason_decides_and_grades_are_ordered() {
        use VerdictGrade::{Bad, Caution, Good};
        assert!(Good < Caution && Caution < Bad);
        assert_eq!(worst(&[reason(Good), reason(Caution)], Good), Caution);
        assert_eq!(worst(&[reason(Good)], Bad), Bad);
        assert_eq!(worst(&[], Good), Good);
    }
}
