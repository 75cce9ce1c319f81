//! One sentence that a person who is no expert understands, and a traffic light.

use super::{HeldOutSummary, PoseSigmaSummary};
use crate::dataset::Dataset;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Correspondences, Parameter, Warning};
use skclam_kinematics::ParameterKind;
use std::fmt;

/// A traffic light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
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

/// Where lengths come from: images alone have no scale.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ScaleSource {
    /// The squares of the board.
    Board,
    /// The depth images.
    Depth,
    /// The positions that the controller gives.
    FlangePoses,
    /// Lengths that were not free.
    NominalLengths,
    /// Priors about nominal lengths.
    Priors,
}

impl fmt::Display for ScaleSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ScaleSource::Board => "the scale comes from the board",
            ScaleSource::Depth => "the scale comes from the depth images",
            ScaleSource::FlangePoses => "the scale comes from the controller's poses",
            ScaleSource::NominalLengths => "the scale comes from the nominal lengths that were held",
            ScaleSource::Priors => "the scale comes from the nominal lengths within their tolerances",
        })
    }
}

impl ScaleSource {
    /// What tells lengths in this calibration.
    pub fn of(dataset: &Dataset, data: &Correspondences, calibration: &Calibration) -> Self {
        let is_free = |kind: ParameterKind| {
            let of_kind = |parameter| matches!(parameter, Parameter::Chain(id) if id.kind == kind);
            calibration.parameters.iter().any(|estimate| of_kind(estimate.parameter))
        };
        if !data.boards.is_empty() {
            ScaleSource::Board
        } else if !dataset.has_joints() {
            ScaleSource::FlangePoses
        } else if !is_free(ParameterKind::A) && !is_free(ParameterKind::D) {
            ScaleSource::NominalLengths
        } else if calibration.noise.depth_per_m.is_some() {
            ScaleSource::Depth
        } else {
            ScaleSource::Priors
        }
    }
}

/// Matches that keep farther from their lines than this in the median are not explained by the rig, px: keypoints are
/// found to a fraction of a pixel, and poor intrinsics add a pixel or so.
const UNEXPLAINED_PX: f64 = 2.0;

impl Verdict {
    /// Of a calibration, how it fares on held-out postures, and what is known of the camera's poses.
    pub fn of(
        calibration: &Calibration,
        held_out: Option<&HeldOutSummary>,
        poses: Option<&PoseSigmaSummary>,
        scale: ScaleSource,
    ) -> Self {
        let (before, after) = (&calibration.epipolar_before, &calibration.epipolar_after);
        let told = |grade, sentence| Verdict { grade, sentence };
        let fitted = format!(
            "the median distance of a match to its epipolar line went from {:.2} to {:.2} px",
            before.median_px, after.median_px
        );
        // Without matches of natural features (a board alone) there are no epipolar distances.
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
                    "DO NOT TRUST this calibration: even the sights that fit are {sigma:.1} px off. \
                     Do matches contradict each other (repeated texture, a scene that moved)? Are enough parameters free?"
                ),
            );
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
        let px = &held_out.figure_px;
        let figure = &held_out.figure;
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
            None => format!("The calibrated rig is better {seen}; {scale}."),
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
