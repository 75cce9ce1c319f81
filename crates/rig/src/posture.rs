//! The posture of the arm when an image was taken.

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
    /// How fast the joints moved, radians or metres a second; empty where it is not known. See
    /// [`crate::fill_joint_rates`].
    pub joint_rates: Vec<f64>,
}

impl Posture {
    /// Without a timestamp, at rest.
    pub fn new(index: u64, state: PostureState) -> Self {
        Posture { index, timestamp_s: None, state, joint_rates: Vec::new() }
    }

    /// The same at a time, seconds.
    pub fn at(self, timestamp_s: Option<f64>) -> Self {
        Posture { timestamp_s, ..self }
    }
}
