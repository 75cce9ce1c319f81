//! Where lengths come from, and what it means if that is wrong: images alone have no scale.

use super::PoseSigma;
use super::pose_sigmas::PostureSource;
use crate::dataset::Dataset;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Calibration, Correspondences, Parameter};
use skclam_kinematics::ParameterKind;

/// What determines lengths.
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
    /// What determines lengths.
    pub source: ScaleSource,
    /// The standard of length, whose own error no residual shows; `null` where there is none.
    pub ruler: Option<RulerSummary>,
    /// What 0.1 % of the scale is at the camera, mm (root of the mean square over the recorded postures).
    pub sensitivity_mm_per_permille: f64,
}

/// How well the standard of length (the board's squares, or the depth's scale) is known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RulerSummary {
    /// Its tolerance (sigma) before anything was measured, %.
    pub tolerance_percent: f64,
    /// How much larger than nominal it is, as the arm's nominal lengths and its tolerance together have it, %.
    pub scale_error_percent: f64,
    /// Sigma of that, %.
    pub sigma_percent: f64,
    /// Whether the estimate takes it as exact, since nothing contradicts that.
    pub held: bool,
}

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
        } else if calibration.noise.depth_sigma_per_m2.is_some() {
            ScaleSource::Depth
        } else {
            ScaleSource::Priors
        }
    }
}

impl Scale {
    /// Of a calibration that has been judged posture by posture.
    pub fn of(dataset: &Dataset, data: &Correspondences, calibration: &Calibration, poses: &[PoseSigma]) -> Self {
        let recorded = poses.iter().filter(|pose| pose.source == PostureSource::Recorded).map(|pose| pose.camera_mm);
        let cameras: Vec<[f64; 3]> = recorded.collect();
        let count = cameras.len().max(1) as f64;
        let height = cameras.iter().map(|camera| camera[2]).sum::<f64>() / count;
        // The base's own turn and height are free.
        let squares = cameras.iter().map(|[x, y, z]| x * x + y * y + (z - height).powi(2)).sum::<f64>();
        Scale {
            source: ScaleSource::of(dataset, data, calibration),
            ruler: calibration.ruler.as_ref().map(|ruler| RulerSummary {
                tolerance_percent: ruler.prior_sigma * 100.0,
                scale_error_percent: ruler.mean * 100.0,
                sigma_percent: ruler.sigma * 100.0,
                held: ruler.held,
            }),
            sensitivity_mm_per_permille: 1e-3 * (squares / count).sqrt(),
        }
    }
}
