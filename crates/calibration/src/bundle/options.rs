//! Settings of the bundle adjustment.

use crate::{Free, Loss, PriorPolicy};
use serde::{Deserialize, Serialize};

/// What is done about joints that stand off their values.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviationPolicy {
    /// Joint values are exact.
    Off,
    /// They deviate with this sigma, degrees.
    SigmaDeg(f64),
    /// They deviate; the rig's `joint_deviation_deg` is their sigma, or it is estimated.
    #[default]
    Estimated,
}

/// Settings of the bundle adjustment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleOptions {
    /// What is free.
    pub free: Free,
    /// Which priors are heard.
    pub priors: PriorPolicy,
    /// The loss; its constant in sigmas.
    pub loss: Loss,
    /// What is done about joints that stand off their values.
    pub deviations: DeviationPolicy,
    /// Iterations of one round at most.
    pub max_iterations: usize,
    /// Rounds (re-estimations of the noise) at most.
    pub max_rounds: usize,
    /// Unknown deviations at most; beyond, they are left at zero with a warning.
    pub max_deviations: usize,
    /// Whether postures that do not fit are left out, or only named.
    pub leave_out_suspects: bool,
}

impl Default for BundleOptions {
    fn default() -> Self {
        BundleOptions {
            free: Free::Auto,
            priors: PriorPolicy::Auto,
            loss: Loss::Tukey(7.0),
            deviations: DeviationPolicy::Estimated,
            max_iterations: 100,
            max_rounds: 12,
            max_deviations: 1200,
            leave_out_suspects: true,
        }
    }
}
