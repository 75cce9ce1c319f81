//! Where the arm stood when an image was taken.

use skclam_geometry::Isometry3;

/// What is known of the arm at a posture.
#[derive(Debug, Clone, PartialEq)]
pub enum PostureState {
    /// Joint values as commanded or as the encoders said: radians, or metres for a prismatic joint.
    Joints(Vec<f64>),
    /// Only the controller's flange pose, `base_from_flange`: the arm's parameters cannot be had from it.
    FlangePose(Isometry3),
}

/// One line of `postures.csv`.
#[derive(Debug, Clone, PartialEq)]
pub struct Posture {
    /// Whole number that rises from posture to posture.
    pub index: u64,
    /// Seconds, where it is known.
    pub timestamp_s: Option<f64>,
    /// Joints or flange pose.
    pub state: PostureState,
}
