//! The tables of `rig.toml` as they are in the file: degrees and millimetres, every key with its unit.

use crate::Prior;
use crate::corrections_table::CorrectionsTable;
use serde::{Deserialize, Serialize};
use skclam_geometry::DISTORTION_COEFFICIENTS;
use skclam_kinematics::JointKind;

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RigFile {
    #[serde(default)]
    pub(super) name: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) robot: Option<RobotTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) joint_corrections: Option<CorrectionsTable>,
    pub(super) mount: TransformTable,
    pub(super) color: CameraTable,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) depth: Option<DepthTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) board: Option<BoardTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) prior: Option<Prior>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RobotTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) convention: Option<Convention>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) urdf: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) base_link: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) tip_link: Option<String>,
    /// Fixed transform before the first link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) base_from_first: Option<TransformTable>,
    /// Fixed transform after the last link.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) last_from_flange: Option<TransformTable>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) joint: Vec<JointTable>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Convention {
    ModifiedDh,
    StandardDh,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JointTable {
    pub(super) name: String,
    #[serde(rename = "type", default, skip_serializing_if = "is_revolute")]
    pub(super) kind: JointKind,
    /// Overrides the robot's convention for this joint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) convention: Option<Convention>,
    pub(super) alpha_deg: f64,
    pub(super) a_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) d_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) beta_deg: Option<f64>,
    pub(super) theta_offset_deg: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) limits_deg: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) limits_mm: Option<[f64; 2]>,
}

pub(super) fn is_revolute(kind: &JointKind) -> bool {
    *kind == JointKind::Revolute
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TransformTable {
    pub(super) translation_mm: [f64; 3],
    pub(super) quaternion_xyzw: [f64; 4],
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraTable {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) fx: f64,
    pub(super) fy: f64,
    pub(super) cx: f64,
    pub(super) cy: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) distortion: Option<[f64; DISTORTION_COEFFICIENTS]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mask: Option<String>,
}

/// A depth camera without a bias needs no line for it.
pub(super) fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct DepthTable {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) fx: f64,
    pub(super) fy: f64,
    pub(super) cx: f64,
    pub(super) cy: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) distortion: Option<[f64; DISTORTION_COEFFICIENTS]>,
    pub(super) unit_mm: f64,
    #[serde(default, skip_serializing_if = "is_zero")]
    pub(super) offset_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) mask: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) color_from_depth: Option<TransformTable>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BoardTable {
    pub(super) kind: BoardKind,
    pub(super) columns: u32,
    pub(super) rows: u32,
    pub(super) square_mm: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) dictionary: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) marker_mm: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum BoardKind {
    Checkerboard,
    Charuco,
}
