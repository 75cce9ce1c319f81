//! Where lengths come from, and what it means if that is wrong: images alone have no scale.

use super::PoseSigma;
use super::pose_sigmas::PostureSource;
use crate::dataset::Dataset;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Correspondences, Parameter, default_sigma, stated_sigma};
use skclam_kinematics::ParameterKind;
use skclam_rig::Rig;
use std::fmt;

/// What tells lengths.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
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

/// The scale of a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// What tells lengths.
    pub source: ScaleSource,
    /// The factor less 1 by which the arm's free lengths grew together, %; `null` where none is free.
    pub growth_percent: Option<f64>,
    /// How much of that tolerances of manufacture explain (sigma), %.
    pub growth_sigma_percent: Option<f64>,
    /// What 0.1 % of the scale is at the camera, mm (root of the mean square over the recorded postures).
    pub camera_mm_per_permille: f64,
}

/// Growth beyond so many sigmas of manufacture is worth a look.
const REMARKABLE: f64 = 3.0;
/// Growth beyond so many is no tolerance.
const IMPOSSIBLE: f64 = 6.0;

impl ScaleSource {
    /// Of a calibration.
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

impl Scale {
    /// Of a calibration that has been judged posture by posture.
    pub fn of(dataset: &Dataset, data: &Correspondences, calibration: &Calibration, poses: &[PoseSigma]) -> Self {
        let growth = growth(&dataset.rig, calibration);
        let recorded = poses.iter().filter(|pose| pose.source == PostureSource::Recorded).map(|pose| pose.camera_mm);
        let cameras: Vec<[f64; 3]> = recorded.collect();
        let count = cameras.len().max(1) as f64;
        let height = cameras.iter().map(|camera| camera[2]).sum::<f64>() / count;
        // The base's own turn and height are free.
        let squares = cameras.iter().map(|[x, y, z]| x * x + y * y + (z - height).powi(2)).sum::<f64>();
        Scale {
            source: ScaleSource::of(dataset, data, calibration),
            growth_percent: growth.map(|(growth, _)| 100.0 * growth),
            growth_sigma_percent: growth.map(|(_, sigma)| 100.0 * sigma),
            camera_mm_per_permille: 1e-3 * (squares / count).sqrt(),
        }
    }

    /// What to think of lengths that grew together: nothing, or how sure it is that the scale is wrong.
    pub(crate) fn suspicion(&self) -> Option<ScaleSuspicion> {
        let told_by_data = matches!(self.source, ScaleSource::Board | ScaleSource::Depth);
        let (growth, sigma) = self.growth_percent.zip(self.growth_sigma_percent).filter(|_| told_by_data)?;
        let ratio = growth.abs() / sigma;
        if ratio < REMARKABLE {
            return None;
        }
        let cause = match self.source {
            ScaleSource::Board => "the board's square_mm",
            _ => "the depth camera's unit_mm and calibration",
        };
        let (verb, percent) = if growth > 0.0 { ("grew", growth) } else { ("shrank", -growth) };
        Some(ScaleSuspicion {
            certain: ratio > IMPOSSIBLE,
            text: format!(
                "all lengths of the arm {verb} together by {percent:.2} %, where manufacture explains {sigma:.2} %: check {cause}"
            ),
        })
    }
}

/// A scale that is likely wrong.
pub(crate) struct ScaleSuspicion {
    /// Beyond any tolerance.
    pub certain: bool,
    /// Why.
    pub text: String,
}

/// The common factor less 1 of the free lengths, weighted by their tolerances, and its sigma.
fn growth(nominal: &Rig, calibration: &Calibration) -> Option<(f64, f64)> {
    let lengths = calibration.parameters.iter().filter(
        |estimate| matches!(estimate.parameter, Parameter::Chain(id) if matches!(id.kind, ParameterKind::A | ParameterKind::D)),
    );
    let (mut moment, mut weight) = (0.0, 0.0);
    for length in lengths {
        let sigma = stated_sigma(nominal, length.parameter).unwrap_or_else(|| default_sigma(nominal, length.parameter));
        let scaled = length.nominal / sigma;
        moment += scaled * (length.value - length.nominal) / sigma;
        weight += scaled * scaled;
    }
    (weight > 0.0).then(|| (moment / weight, weight.sqrt().recip()))
}

impl fmt::Display for Scale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.source {
            ScaleSource::Board => "the scale comes from the board",
            ScaleSource::Depth => "the scale comes from the depth images",
            ScaleSource::FlangePoses => "the scale comes from the controller's poses",
            ScaleSource::NominalLengths => "the scale comes from the nominal lengths that were held",
            ScaleSource::Priors => "the scale comes from the nominal lengths within their tolerances",
        })?;
        // An error of the ruler is in no residual and in no sigma.
        if matches!(self.source, ScaleSource::Board | ScaleSource::Depth) {
            write!(
                f,
                ", and each 0.1 % that it is off moves the camera by {:.2} mm more",
                self.camera_mm_per_permille
            )?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(source: ScaleSource, growth: f64) -> Scale {
        Scale { source, growth_percent: Some(growth), growth_sigma_percent: Some(0.25), camera_mm_per_permille: 0.6 }
    }

    #[test]
    fn lengths_that_grow_together_are_suspected_of_the_ruler() {
        assert!(scale(ScaleSource::Depth, 0.5).suspicion().is_none());
        let remarkable = scale(ScaleSource::Depth, -1.0).suspicion().unwrap();
        assert!(!remarkable.certain && remarkable.text.contains("shrank together by 1.00 %"), "{}", remarkable.text);
        let wrong = scale(ScaleSource::Board, 10.0).suspicion().unwrap();
        assert!(wrong.certain && wrong.text.contains("square_mm"), "{}", wrong.text);
        assert!(scale(ScaleSource::Priors, 10.0).suspicion().is_none(), "priors hold lengths, no ruler");
        assert!(scale(ScaleSource::Depth, 0.0).to_string().contains("0.60 mm"));
    }
}
