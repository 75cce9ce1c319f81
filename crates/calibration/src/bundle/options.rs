//! Settings of the bundle adjustment.

use crate::{Free, Loss, PriorPolicy};
use serde::{Deserialize, Serialize};

/// What is done about joints (or flange poses) that are off in every posture anew.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PostureErrorPolicy {
    /// Joint values are exact.
    Off,
    /// They are off with this sigma, degrees.
    SigmaDeg(f64),
    /// They are off; the rig's `joint_error_deg` is their sigma, or it is estimated.
    #[default]
    Estimated,
}

/// What becomes of the scale of the standard of length: the board's squares, or the depth's own scale where there is no
/// board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RulerPolicy {
    /// It is a parameter like the others: where the arm's nominal lengths and the standard disagree, their tolerances
    /// decide.
    Estimated,
    /// It is held, and its tolerance goes into the covariance: a considered parameter (Schmidt, "Application of
    /// state-space methods to navigation problems", 1966).
    #[default]
    Considered,
}

/// Settings of the bundle adjustment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleOptions {
    /// What is free.
    pub free: Free,
    /// Which priors are used.
    pub priors: PriorPolicy,
    /// The loss; its constant in sigmas.
    pub loss: Loss,
    /// What is done about joints (or flange poses) that are off in every posture anew.
    pub posture_errors: PostureErrorPolicy,
    /// Iterations of one round at most.
    pub max_iterations: usize,
    /// Rounds (re-estimations of the noise) at most.
    pub max_rounds: usize,
    /// Unknown posture errors at most; beyond, they are left at zero with a warning.
    pub max_posture_errors: usize,
    /// Whether the standard of length that the data bring (board, else depth) is taken as exact, and only its tolerance
    /// put into the covariance.
    pub ruler: RulerPolicy,
    /// Whether postures that do not fit are left out, or only named.
    pub exclude_outlier_postures: bool,
}

impl Default for BundleOptions {
    fn default() -> Self {
        BundleOptions {
            free: Free::Auto,
            priors: PriorPolicy::Auto,
            loss: Loss::Tukey(7.0),
            posture_errors: PostureErrorPolicy::Estimated,
            max_iterations: 100,
            max_rounds: 12,
            max_posture_errors: 1800,
            ruler: RulerPolicy::default(),
            exclude_outlier_postures: true,
        }
    }
}
