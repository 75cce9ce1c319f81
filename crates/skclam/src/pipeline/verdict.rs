//! One sentence that a person who is no expert understands, and a traffic light.

use super::{HeldOutSummary, PoseSigmaSummary, Scale};
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Warning};

/// A traffic light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VerdictGrade {
    /// Better than the nominal rig on postures that the fit did not see.
    Good,
    /// It may be better, but something was not measured or only a part of it helps.
    Caution,
    /// Keep the nominal rig.
    Bad,
}

/// The judgement of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// The traffic light.
    pub grade: VerdictGrade,
    /// The sentence.
    pub sentence: String,
}

/// Matches that keep farther from their lines than this in the median are not explained by the rig, px: keypoints are
/// found to a fraction of a pixel, and poor intrinsics add a pixel or so.
pub(super) const UNEXPLAINED_PX: f64 = 2.0;

/// Whether a calibration does not even explain the postures that it was fitted to.
pub(super) fn unexplained(calibration: &Calibration) -> bool {
    // Without matches of natural features (a board alone) there are no epipolar distances.
    let lines = &calibration.epipolar_after;
    let contradicted = |warning: &Warning| matches!(warning, Warning::LargeResiduals { .. });
    lines.matches > 0 && lines.median_px > UNEXPLAINED_PX || calibration.warnings.iter().any(contradicted)
}

impl Verdict {
    /// Of a calibration, how it fares on held-out postures, and what is known of the camera's poses.
    pub fn of(
        calibration: &Calibration,
        held_out: Option<&HeldOutSummary>,
        poses: Option<&PoseSigmaSummary>,
        scale: &Scale,
    ) -> Self {
        let (before, after) = (&calibration.epipolar_before, &calibration.epipolar_after);
        let told = |grade, sentence| Verdict { grade, sentence };
        let fitted = format!(
            "the median distance of a match to its epipolar line went from {:.2} to {:.2} px",
            before.median_px, after.median_px
        );
        if after.matches > 0 && after.median_px > UNEXPLAINED_PX {
            return told(
                VerdictGrade::Bad,
                format!(
                    "DO NOT TRUST this calibration: {fitted}, and above {UNEXPLAINED_PX} px the rig does not fit the images. \
                     Do images and joint values belong together? Are the intrinsics right? Are enough parameters free?"
                ),
            );
        }
        let contradiction = calibration.warnings.iter().find_map(|warning| match warning {
            Warning::LargeResiduals { sigma } => Some(*sigma),
            _ => None,
        });
        if let Some(sigma) = contradiction {
            return told(
                VerdictGrade::Bad,
                format!(
                    "DO NOT TRUST this calibration: even the sights that fit are {sigma:.1} times as far off as features are uncertain. \
                     Are the intrinsics right? Do matches contradict each other (repeated texture, a scene that moved)? Are enough parameters free?"
                ),
            );
        }
        if let Some(suspicion) = scale.suspicion().filter(|suspicion| suspicion.certain) {
            return told(VerdictGrade::Bad, format!("DO NOT TRUST this calibration: {}.", suspicion.text));
        }
        let Some(held_out) = held_out else {
            return if after.median_px < before.median_px {
                let sentence = format!(
                    "The calibrated rig explains the images better: {fitted}. It was NOT checked on held-out postures."
                );
                told(VerdictGrade::Caution, sentence)
            } else {
                let sentence = format!(
                    "The calibrated rig explains the images NO better than the nominal one: {fitted}. Keep the nominal rig."
                );
                told(VerdictGrade::Bad, sentence)
            };
        };
        let px = &held_out.metric_px;
        let figure = &held_out.metric;
        if !held_out.beats_nominal() {
            let sentence = format!(
                "This calibration does NOT beat the nominal rig on held-out postures ({figure}: nominal {:.2} px, calibrated {:.2} px). \
                 Keep the nominal rig.",
                px.nominal, px.calibrated
            );
            return told(VerdictGrade::Bad, sentence);
        }
        let seen = format!("on held-out postures: {:.2} to {:.2} px, {figure}", px.nominal, px.calibrated);
        if let (Some(false), Some(mount_only)) = (held_out.beats_mount_only(), px.mount_only) {
            let sentence = format!(
                "Correcting the mount helps, correcting the arm does not ({figure} on held-out postures: nominal {:.2} px, mount alone {:.2} px, \
                 everything {:.2} px). Use --free mount.",
                px.nominal, mount_only, px.calibrated
            );
            return told(VerdictGrade::Caution, sentence);
        }
        let sigma = poses.and_then(|poses| Some((poses.camera_change_mm.mean, poses.camera_sigma_mm?.mean)));
        let sentence = match sigma {
            Some((change_mm, sigma_mm)) => format!(
                "The camera's position error over your postures fell from about {} to about {} mm (estimated; {seen}); {scale}.",
                short(change_mm),
                short(sigma_mm)
            ),
            None => {
                let sentence = format!(
                    "The calibrated rig is better {seen}, but how far off the camera still is was not estimated; {scale}."
                );
                return told(VerdictGrade::Caution, sentence);
            }
        };
        told(VerdictGrade::Good, sentence)
    }
}

/// Two digits that say something.
fn short(mm: f64) -> String {
    let decimals = if mm >= 10.0 {
        0
    } else if mm >= 1.0 {
        1
    } else if mm >= 0.1 {
        2
    } else {
        3
    };
    format!("{mm:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_as_short_as_they_are_known() {
        assert_eq!([12.34, 4.77, 0.456, 0.0468].map(short), ["12", "4.8", "0.46", "0.047"]);
    }
}
