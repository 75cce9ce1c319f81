//! How far a parameter may be from its nominal value, in physical units, before the data are used.

use serde::{Deserialize, Serialize};

/// Standard deviations of free parameters about their nominal values. `None`: the estimator's own default.
///
/// The units of the file are in the names; `[prior]` in `rig.toml`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Prior {
    /// Angles of the arm, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub angle_deg: Option<f64>,
    /// Lengths of the arm, millimetres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub length_mm: Option<f64>,
    /// Rotation of the mount, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mount_rotation_deg: Option<f64>,
    /// Translation of the mount, millimetres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mount_translation_mm: Option<f64>,
    /// Focal lengths, as a fraction of themselves.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_relative: Option<f64>,
    /// Principal point, pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub principal_point_px: Option<f64>,
    /// Distortion coefficients.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub distortion: Option<f64>,
    /// Depth scale, as a fraction.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_scale_relative: Option<f64>,
    /// Depth offset, millimetres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth_offset_mm: Option<f64>,
    /// Rotation of the depth camera beside the colour camera, degrees.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color_from_depth_rotation_deg: Option<f64>,
    /// Translation of the depth camera beside the colour camera, millimetres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color_from_depth_translation_mm: Option<f64>,
    /// Size of the board's squares, as a fraction.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub board_scale_relative: Option<f64>,
    /// Error of a revolute joint's value in one posture (encoder noise, backlash), degrees.
    #[serde(alias = "joint_deviation_deg", skip_serializing_if = "Option::is_none")]
    pub joint_error_deg: Option<f64>,
    /// Time offset between joints and images, seconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub time_offset_s: Option<f64>,
}

impl Prior {
    /// Every entry with the name that it has in the file.
    pub fn entries(&self) -> [(&'static str, Option<f64>); 14] {
        [
            ("angle_deg", self.angle_deg),
            ("length_mm", self.length_mm),
            ("mount_rotation_deg", self.mount_rotation_deg),
            ("mount_translation_mm", self.mount_translation_mm),
            ("focal_relative", self.focal_relative),
            ("principal_point_px", self.principal_point_px),
            ("distortion", self.distortion),
            ("depth_scale_relative", self.depth_scale_relative),
            ("depth_offset_mm", self.depth_offset_mm),
            ("color_from_depth_rotation_deg", self.color_from_depth_rotation_deg),
            ("color_from_depth_translation_mm", self.color_from_depth_translation_mm),
            ("board_scale_relative", self.board_scale_relative),
            ("joint_error_deg", self.joint_error_deg),
            ("time_offset_s", self.time_offset_s),
        ]
    }
}
