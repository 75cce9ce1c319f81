//! One adjustment in rounds: minimise, estimate the noise anew, until that has settled.

use crate::bundle::adjust::{Adjustment, marginal_equations, posed_state};
use crate::bundle::noise::{LossCorrection, rescaled};
use crate::bundle::observations::Observations;
use crate::bundle::posterior::Likelihood;
use crate::bundle::random_effects::likeliest_groups;
use crate::bundle::residuals::ResidualSize;
use crate::bundle::solve::{Adjusted, BundleAdjuster};
use crate::bundle::state::{NoiseScales, PostureErrorSigmas, State};
use crate::prior::{PriorGroup, Priors};
use crate::{CalibrationError, Loss, Model, Termination};
use nalgebra::{DMatrix, DVector};

/// Bounds of the sigma of a joint's error, rad (or m): below 0.0003 deg nothing moves by what can be measured, and
/// joints that are off by more than half a degree are no random effect: something else is wrong, and posture errors
/// must not swallow it.
const POSTURE_ERROR_BOUNDS: [f64; 2] = [5e-6, 8.7e-3];
/// Iterations of one adjustment, and of all adjustments of a calibration, in those of one round: a model that cannot
/// fit the data is not worth more.
const ITERATION_BUDGET: [usize; 2] = [2, 4];
/// Data as good as this (sigma beside what they say of themselves) are synthetic, and are minimised to rounding.
const EXACT_SIGMA: f64 = 1e-2;
/// What an adjustment is left with when the budget has run out.
const MIN_ITERATIONS: usize = 10;
/// Fewer observations of a kind do not determine its noise.
const MIN_OF_A_KIND: usize = 50;
/// The noise has settled when it changes by less than this fraction.
const SETTLED: f64 = 0.01;

impl BundleAdjuster<'_> {
    /// Triangulates, then minimises in rounds until the noise has settled. A `rough` adjustment holds the variance
    /// components of posture errors and arm.
    pub(super) fn adjust(
        &self,
        start: &Model,
        posture_errors: Vec<f64>,
        mut noise: NoiseScales,
        mut priors: Priors,
        mut observations: Observations,
        rough: bool,
    ) -> Result<Adjusted, CalibrationError> {
        let loss = self.options.loss;
        let mut state = posed_state(start, posture_errors, self.motion, &observations, &noise, loss)?;
        let points =
            self.adjustment(&observations, &priors, noise, Loss::Cauchy(2.0), LossCorrection::EVEN).triangulate(&state);
        observations.retain_tracks(&points.iter().map(Option::is_some).collect::<Vec<_>>());
        state.points = points.into_iter().flatten().collect();
        let mut sizes =
            self.adjustment(&observations, &priors, noise, loss, LossCorrection::EVEN).residual_sizes(&state);
        noise = rescaled(&sizes, &noise, 1.0);
        let mut balance = LossCorrection::EVEN;
        let mut effort = Effort::default();
        let mut initial_cost = None;
        let [one, all] = ITERATION_BUDGET.map(|rounds| rounds * self.options.max_iterations);
        let allowed = one.min(all.saturating_sub(self.spent.get())).max(MIN_ITERATIONS);
        let (reason, final_cost) = loop {
            effort.rounds += 1;
            let adjustment = self.adjustment(&observations, &priors, noise, loss, balance);
            let limit = self.options.max_iterations.min(allowed.saturating_sub(effort.wasted).max(1));
            let minimization = adjustment.minimize(state, limit)?;
            effort.iterations += minimization.iterations;
            effort.evaluations += minimization.evaluations;
            initial_cost.get_or_insert(minimization.initial_cost);
            state = minimization.state;
            sizes = adjustment.residual_sizes(&state);
            let next_balance = LossCorrection::of(&sizes, loss);
            let adjustment = Adjustment { balance: next_balance, ..adjustment };
            let next = self.reestimated(&adjustment, &state, &sizes, rough)?;
            if noise.pixel > EXACT_SIGMA {
                effort.wasted += minimization.iterations;
            }
            let settled = next.is_settled(&noise, &priors, rough)
                && (self.errors.kinds.is_empty() || change(balance.prior_weight, next_balance.prior_weight) < SETTLED);
            if settled || effort.rounds >= self.options.max_rounds || effort.wasted >= allowed {
                break (minimization.reason, minimization.cost);
            }
            noise = next.noise;
            priors = next.priors;
            observations.scale_corner_sigma(next.corner_factor);
            balance = next_balance;
        };
        self.spent.set(self.spent.get() + effort.wasted);
        let initial_cost = initial_cost.unwrap_or_default();
        let Effort { iterations, evaluations, rounds, .. } = effort;
        let termination = Termination { reason, iterations, evaluations, rounds, initial_cost, final_cost };
        Ok(Adjusted {
            state,
            noise,
            priors,
            observations,
            balance: LossCorrection::of(&sizes, loss),
            sizes,
            termination,
        })
    }

    /// Noise and prior sigmas as the residuals and errors at an optimum have them.
    fn reestimated(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
        sizes: &[ResidualSize],
        rough: bool,
    ) -> Result<Reestimated, CalibrationError> {
        let Adjustment { observations, noise, priors, .. } = *adjustment;
        let estimate = match self.errors.kinds.is_empty() || rough {
            true => None,
            false => self.posture_error_estimate(adjustment, state)?,
        };
        let unknown_count = self.parameters.len() + 6 * usize::from(state.base_from_board.is_some());
        let taken = unknown_count as f64 + estimate.as_ref().map_or(0.0, |estimate| estimate.determined);
        let dof: f64 = sizes.iter().map(|s| s.pixel_dof + s.depth.map_or(0.0, |(_, f)| f)).sum();
        let left = 1.0 - taken / dof.max(1.0);
        let mut next = rescaled(sizes, &noise, left);
        // How sure corners are beside other observations is not known beforehand either: each kind has its own noise.
        let (of_tracks, of_corners) = sizes.split_at(observations.observations.len().min(sizes.len()));
        let mut corner_factor = 1.0;
        if of_tracks.len().min(of_corners.len()) >= MIN_OF_A_KIND {
            next = rescaled(of_tracks, &noise, left);
            corner_factor = (rescaled(of_corners, &noise, left).pixel / next.pixel).clamp(0.1, 10.0);
        }
        if let (Some(estimate), true) = (&estimate, self.errors.is_estimated()) {
            // The fixed point is approached by small factors; their square halves the number of rounds.
            let [low, high] = POSTURE_ERROR_BOUNDS;
            let toward = |now: f64, then: f64| (now * (then / now).clamp(0.3, 3.0).powi(2)).clamp(low, high);
            let (now, then) = (noise.posture, estimate.sigmas);
            let of = |now: f64, then: f64| if now == then { now } else { toward(now, then) };
            next.posture =
                PostureErrorSigmas { angular: of(now.angular, then.angular), linear: of(now.linear, then.linear) };
        }
        let mut next_priors = priors.clone();
        if !rough && PriorGroup::ALL.iter().any(|&group| priors.group_sigma(group).is_some()) {
            let Likelihood { normal, offsets, .. } = self.likelihood(adjustment, state, 1.0)?;
            next_priors = likeliest_groups(&self.without_held(normal), &offsets, priors);
        }
        Ok(Reestimated { noise: next, priors: next_priors, corner_factor })
    }

    /// A normal matrix in which the held parameter is known.
    fn without_held(&self, mut normal: DMatrix<f64>) -> DMatrix<f64> {
        if let Some(held) = self.held {
            normal.row_mut(held).fill(0.0);
            normal.column_mut(held).fill(0.0);
        }
        normal
    }

    /// The likelihood of the parameters about an optimum, board and posture errors eliminated; `wider`: a factor on the
    /// sigmas of the posture errors.
    pub(super) fn likelihood(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
        wider: f64,
    ) -> Result<Likelihood, CalibrationError> {
        let PostureErrorSigmas { angular, linear } = adjustment.noise.posture;
        let sigmas = PostureErrorSigmas { angular: angular * wider, linear: linear * wider };
        let (normal, gradient) = adjustment.normal_equations(state, &sigmas)?;
        let count = self.parameters.len();
        let (normal, gradient) = marginal_equations(&normal, &gradient, count);
        let offsets = DVector::from_vec(Priors::offsets(self.nominal, &state.model, self.parameters));
        Ok(Likelihood { normal, gradient, offsets })
    }
}

#[derive(Default)]
struct Effort {
    iterations: usize,
    evaluations: usize,
    rounds: usize,
    /// Iterations on data that are not exact.
    wasted: usize,
}

struct Reestimated {
    noise: NoiseScales,
    priors: Priors,
    corner_factor: f64,
}

fn change(old: f64, new: f64) -> f64 {
    (new / old - 1.0).abs()
}

impl Reestimated {
    fn is_settled(&self, noise: &NoiseScales, priors: &Priors, rough: bool) -> bool {
        let floor = POSTURE_ERROR_BOUNDS[0];
        let posture =
            |old: f64, new: f64| new == old || new <= floor && old <= floor || change(old, new) < 5.0 * SETTLED;
        let group = |group: PriorGroup| match (priors.group_sigma(group), self.priors.group_sigma(group)) {
            (Some(old), Some(new)) => change(old, new) < 5.0 * SETTLED,
            _ => true,
        };
        change(noise.pixel, self.noise.pixel) < SETTLED
            && change(noise.depth, self.noise.depth) < SETTLED
            && change(self.corner_factor, 1.0) < 5.0 * SETTLED
            && (rough
                || posture(noise.posture.angular, self.noise.posture.angular)
                    && posture(noise.posture.linear, self.noise.posture.linear)
                    && PriorGroup::ALL.into_iter().all(group))
    }
}
