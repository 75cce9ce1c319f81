//! How a solver ended, with its numbers.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Why a solver stopped. Each case carries what was reached and the threshold that it was compared with.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum StopReason {
    /// The relative change of the cost fell below its threshold.
    CostConverged {
        /// Relative change in the last step.
        relative_change: f64,
        /// What it had to fall below.
        threshold: f64,
    },
    /// The step fell below its threshold (in units of each parameter's scale).
    StepConverged {
        /// Norm of the last step.
        step: f64,
        /// What it had to fall below.
        threshold: f64,
    },
    /// The last step was short beside the standard deviations.
    SigmasConverged {
        /// Length of the step in the norm of the normal matrix: sigmas, all unknowns together.
        sigmas: f64,
        /// What it had to fall below.
        threshold: f64,
    },
    /// The gradient fell below its threshold (scaled, dimensionless).
    GradientConverged {
        /// Largest component.
        gradient: f64,
        /// What it had to fall below.
        threshold: f64,
    },
    /// Nelder-Mead: a restart with a fresh simplex improved the cost by less than its threshold.
    RestartsConverged {
        /// Relative improvement of the last restart.
        relative_improvement: f64,
        /// What it had to fall below.
        threshold: f64,
    },
    /// The number of iterations ran out.
    IterationLimit {
        /// The limit.
        limit: usize,
    },
    /// No step, however short, lowered the cost.
    NoProgress {
        /// The damping at which the solver gave up.
        damping: f64,
    },
}

/// How a solver ended.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Termination {
    /// Why.
    pub reason: StopReason,
    /// Iterations over all rounds.
    pub iterations: usize,
    /// Evaluations of the cost.
    pub evaluations: usize,
    /// Rounds: re-estimations of the noise (least squares), or simplexes (Nelder-Mead).
    pub rounds: usize,
    /// Cost at the start, in the estimator's own unit.
    pub initial_cost: f64,
    /// Cost at the end. Under a loss whose scale is re-estimated it is not comparable with the cost at the start.
    pub final_cost: f64,
}

impl Termination {
    /// Counts the effort of an earlier stage.
    pub(crate) fn add_effort(&mut self, earlier: &Termination) {
        self.iterations += earlier.iterations;
        self.evaluations += earlier.evaluations;
        self.rounds += earlier.rounds;
        self.initial_cost = earlier.initial_cost;
    }
}

impl StopReason {
    /// Whether a threshold was reached (and not a limit).
    pub fn is_converged(&self) -> bool {
        !matches!(self, StopReason::IterationLimit { .. } | StopReason::NoProgress { .. })
    }
}

impl fmt::Display for StopReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            StopReason::CostConverged { relative_change, threshold } => {
                write!(f, "converged: the cost changed by {relative_change:.1e} of itself, below {threshold:.1e}")
            }
            StopReason::StepConverged { step, threshold } => {
                write!(f, "converged: the last step was {step:.1e}, below {threshold:.1e}")
            }
            StopReason::SigmasConverged { sigmas, threshold } => {
                write!(f, "converged: the last step was {sigmas:.1e} sigma long, below {threshold:.1e}")
            }
            StopReason::GradientConverged { gradient, threshold } => {
                write!(f, "converged: the gradient was {gradient:.1e}, below {threshold:.1e}")
            }
            StopReason::RestartsConverged { relative_improvement, threshold } => {
                write!(f, "converged: a fresh simplex gained {relative_improvement:.1e}, below {threshold:.1e}")
            }
            StopReason::IterationLimit { limit } => write!(f, "not converged: {limit} iterations were not enough"),
            StopReason::NoProgress { damping } => {
                write!(f, "not converged: no step lowered the cost, even at a damping of {damping:.1e}")
            }
        }
    }
}

impl fmt::Display for Termination {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({} iterations, {} rounds)", self.reason, self.iterations, self.rounds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_not_convergence() {
        assert!(StopReason::StepConverged { step: 0.0, threshold: 1.0 }.is_converged());
        assert!(!StopReason::IterationLimit { limit: 3 }.is_converged());
        assert!(StopReason::IterationLimit { limit: 3 }.to_string().contains('3'));
    }
}
