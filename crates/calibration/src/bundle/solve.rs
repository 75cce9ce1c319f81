//! The estimator from start to result: start pairwise, screen for outlier postures, adjust everything, estimate the
//! noise, conclude.

use crate::bundle::adjust::{Adjustment, marginal_equations, posed_state};
use crate::bundle::causes::error_patterns;
use crate::bundle::correlation::weigh_by_correlation;
use crate::bundle::noise::{self, LossCorrection, OUTLIER_SIGMAS, posture_fits, rescaled};
use crate::bundle::observations::Observations;
use crate::bundle::outliers::{judged, outlier_postures, remove_biased_depths};
use crate::bundle::posterior::{Likelihood, PosteriorInputs, RulerPosterior};
use crate::bundle::random_effects::{PostureErrorModel, likeliest_groups};
use crate::bundle::residuals::ResidualSize;
use crate::bundle::ruler::grown_together;
use crate::bundle::start::{start, triangulate_all};
use crate::bundle::state::{NoiseScales, PostureErrorSigmas, State};
use crate::camera_kinematics::CameraKinematics;
use crate::error_function::epipolar_statistics;
use crate::prior::{PriorGroup, Priors};
use crate::robust::median;
use crate::uncertainty::{covariance, describe};
use crate::{
    BundleOptions, Calibration, CalibrationError, Correspondences, Loss, Model, Noise, Parameter,
    PostureErrorKnowledge, PostureFit, PriorScale, ReprojectionStatistics, Ruler, RulerPolicy, Termination, Warning,
    arm_positions, free,
};
use nalgebra::{DMatrix, DVector};
use skclam_rig::Rig;
use std::cell::Cell;

/// Observations that the minimisation uses until it has settled; then all.
const SAMPLE_OBSERVATIONS: usize = 60_000;
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
/// Times that the sample is searched for postures that are wrong.
const MAX_SCREENING_ROUNDS: usize = 3;
/// `s` of `sigma = s z^2` before the data are used, 1/m.
const FIRST_DEPTH: f64 = 0.01;
/// Fewer observations of a kind do not determine its noise.
const MIN_OF_A_KIND: usize = 50;
/// No feature is so bad, in units of the sigma that it came with.
const LARGE_SIGMA: f64 = 5.0;
/// The noise has settled when it changes by less than this fraction.
const SETTLED: f64 = 0.01;

struct Adjusted {
    state: State,
    noise: NoiseScales,
    priors: Priors,
    observations: Observations,
    sizes: Vec<ResidualSize>,
    balance: LossCorrection,
    termination: Termination,
}

/// Residuals of a fixed model.
pub(crate) struct Evaluated {
    pub sizes: Vec<ResidualSize>,
    pub state: State,
    /// What could be triangulated.
    pub observations: Observations,
}

/// No posture errors.
const NO_ERRORS: PostureErrorSigmas = PostureErrorSigmas { angular: 1.0, linear: 1.0 };

/// Residuals of two models on the same observations, whose pixels have noise of `sigma_px`: points and the board are
/// fitted to each model's cameras, nothing else moves.
pub(crate) fn compare(
    nominal: &Model,
    calibrated: &Model,
    motion: &CameraKinematics,
    observations: &Observations,
    sigma_px: f64,
) -> Result<(Evaluated, Evaluated), CalibrationError> {
    let noise = NoiseScales { pixel: sigma_px.max(1e-6), depth: FIRST_DEPTH, posture: NO_ERRORS };
    let options = BundleOptions::default();
    let errors = PostureErrorModel::none();
    let adjuster = BundleAdjuster {
        nominal: &nominal.rig,
        motion,
        parameters: &[],
        errors: &errors,
        options: &options,
        ruler: None,
        held: None,
        spent: Cell::new(0),
    };
    let after = adjuster.evaluate(calibrated, &[], observations, noise, None)?;
    let before = adjuster.evaluate(nominal, &[], &after.observations, noise, Some(&after.state))?;
    Ok((before, after))
}

/// Adjusts the free parameters, the scene points, the board's pose and the errors of single postures together.
pub fn calibrate_bundle(
    nominal: &Rig,
    data: &Correspondences,
    options: &BundleOptions,
) -> Result<Calibration, CalibrationError> {
    data.check()?;
    let mut warnings = Vec::new();
    let motion = CameraKinematics::new(nominal, &data.postures)?;
    let all = Observations::new(nominal, data, &|_| true, &mut warnings)?;
    let parameters = free_parameters(nominal, &motion, &all, options)?;
    if !motion.has_joints() {
        warnings.push(Warning::FlangePosesOnly);
    }
    let errors = PostureErrorModel::new(nominal, &motion, options, &mut warnings);
    let ruler = free::ruler(nominal, &options.free, &parameters, motion.has_joints());
    let ruler = ruler.and_then(|ruler| parameters.iter().position(|parameter| *parameter == ruler));
    let adjuster = BundleAdjuster {
        nominal,
        motion: &motion,
        parameters: &parameters,
        errors: &errors,
        options,
        ruler,
        held: ruler.filter(|_| options.ruler == RulerPolicy::Considered),
        spent: Cell::new(0),
    };
    let priors = Priors::new(nominal, &options.free, options.priors, &parameters);
    let (start, pixel) = start(nominal, data, &all, &parameters)?;
    let noise = NoiseScales { pixel, depth: FIRST_DEPTH, posture: errors.first };
    let screened = adjuster.screen(data, &start, noise, priors, all)?;
    let (adjusted, fits) = adjuster.without_outliers(data, screened, &mut warnings)?;
    let known = adjuster.known(&adjusted)?;
    match known.contradicted_ruler() {
        Some((mean, sigma)) if adjuster.held.is_some() => {
            // The arm's lengths and the standard of length cannot both be right: their tolerances decide.
            let weighing = BundleAdjuster { held: None, ..adjuster };
            let observations = adjusted.observations.clone();
            let adjusted = weighing.again(&adjusted, observations)?;
            let known = weighing.known(&adjusted)?;
            if let Some(at) = ruler {
                warnings.push(Warning::RulerContradicted { parameter: parameters[at], mean, sigma });
            }
            weighing.conclude(data, adjusted, known, fits, warnings)
        }
        _ => adjuster.conclude(data, adjusted, known, fits, warnings),
    }
}

/// What is free, if the observations are enough for it.
fn free_parameters(
    nominal: &Rig,
    motion: &CameraKinematics,
    all: &Observations,
    options: &BundleOptions,
) -> Result<Vec<Parameter>, CalibrationError> {
    let has_board = !all.corners.is_empty();
    let mut parameters = options.free.candidates(nominal, motion.has_joints(), all.depth_count() > 0)?;
    if options.free.is_open() && !has_board {
        // A board that no image shows has no size to be wrong about.
        parameters.retain(|parameter| *parameter != Parameter::BoardScale);
    }
    if parameters.is_empty() {
        return Err(CalibrationError::NothingFree);
    }
    let residuals = 2 * all.observations.len() + all.depth_count() + 2 * all.corners.len();
    let got = residuals.saturating_sub(3 * all.track_count() + if has_board { 6 } else { 0 });
    let need = 2 * parameters.len();
    if got < need {
        let what = "residuals of tracks and board corners (beyond those that their own points take)".to_owned();
        return Err(CalibrationError::TooFew { what, need, got, parameters: parameters.len() });
    }
    Ok(parameters)
}

/// Everything that an adjustment needs and that stays the same.
pub(super) struct BundleAdjuster<'a> {
    pub nominal: &'a Rig,
    pub motion: &'a CameraKinematics,
    pub parameters: &'a [Parameter],
    pub errors: &'a PostureErrorModel,
    pub options: &'a BundleOptions,
    /// Position of the standard of length, whose own error no residual shows.
    pub ruler: Option<usize>,
    /// Its position where it is held.
    pub held: Option<usize>,
    /// Iterations of all adjustments so far on data that are not exact.
    pub spent: Cell<usize>,
}

/// The adjustment on everything, and the postures that were excluded on the way.
struct Screened {
    adjusted: Adjusted,
    excluded: Vec<usize>,
}

impl BundleAdjuster<'_> {
    fn adjustment<'b>(
        &'b self,
        observations: &'b Observations,
        priors: &'b Priors,
        noise: NoiseScales,
        loss: Loss,
        balance: LossCorrection,
    ) -> Adjustment<'b> {
        Adjustment {
            nominal: self.nominal,
            motion: self.motion,
            observations,
            parameters: self.parameters,
            priors,
            loss,
            noise,
            errors: self.errors,
            balance,
            held: self.held,
        }
    }

    fn observations_without(&self, data: &Correspondences, out: &[usize]) -> Result<Observations, CalibrationError> {
        Observations::new(self.nominal, data, &|posture| !out.contains(&posture), &mut Vec::new())
    }

    /// Most of the way on a sample, the last steps on everything. The sigma of the posture errors is held at first:
    /// estimated beside a posture that is wrong, it would grow until such errors explain anything.
    fn screen(
        &self,
        data: &Correspondences,
        start: &Model,
        noise: NoiseScales,
        priors: Priors,
        all: Observations,
    ) -> Result<Screened, CalibrationError> {
        let components = self.errors.kinds.len();
        let none = vec![0.0; components * self.motion.len()];
        let stride = all.observations.len().div_ceil(SAMPLE_OBSERVATIONS).max(1);
        let mut sample = self.adjust(start, none, noise, priors, all.sampled(stride), true)?;
        let mut excluded = Vec::new();
        for _ in 0..MAX_SCREENING_ROUNDS {
            // The worst hide the less bad: look again without them.
            let mut found = outlier_postures(&judged(&sample.sizes, &sample.observations));
            if components > 0 {
                found.extend(self.far_off(&sample)?);
                found.sort_unstable();
                found.dedup();
                found.truncate((self.motion.len() / 5).saturating_sub(excluded.len()));
            }
            if found.is_empty() || !self.options.exclude_outlier_postures {
                break;
            }
            excluded.extend(found);
            let rest = self.observations_without(data, &excluded)?.sampled(stride);
            let Adjusted { state, noise, priors, termination, .. } = sample;
            sample = self.adjust(&state.model, state.posture_errors, noise, priors, rest, true)?;
            sample.termination.add_effort(&termination);
        }
        if stride == 1 && excluded.is_empty() && components == 0 {
            return Ok(Screened { adjusted: sample, excluded });
        }
        let everything = if excluded.is_empty() { all } else { self.observations_without(data, &excluded)? };
        Ok(Screened { adjusted: self.again(&sample, everything)?, excluded })
    }

    /// The same from where an adjustment ended, on other observations, without the depths that are biased there.
    fn again(&self, from: &Adjusted, mut observations: Observations) -> Result<Adjusted, CalibrationError> {
        let errors = from.state.posture_errors.clone();
        let Evaluated { sizes, observations: found, .. } =
            self.evaluate(&from.state.model, &errors, &observations, from.noise, None)?;
        observations = found;
        remove_biased_depths(&mut observations, &sizes);
        weigh_by_correlation(&mut observations, &sizes, f64::from(self.nominal.color.width));
        let mut next = self.adjust(&from.state.model, errors, from.noise, from.priors.clone(), observations, false)?;
        next.termination.add_effort(&from.termination);
        Ok(next)
    }

    /// Excludes the postures that still do not fit, readmits those that do, and reports both.
    fn without_outliers(
        &self,
        data: &Correspondences,
        screened: Screened,
        warnings: &mut Vec<Warning>,
    ) -> Result<(Adjusted, Vec<PostureFit>), CalibrationError> {
        let Screened { mut adjusted, excluded } = screened;
        let exclude = self.options.exclude_outlier_postures;
        let mut fits = posture_fits(&adjusted.sizes, data.postures.len());
        let mut outliers = outlier_postures(&judged(&adjusted.sizes, &adjusted.observations));
        let found_late = !outliers.is_empty();
        outliers.extend(excluded);
        outliers.sort_unstable();
        outliers.dedup();
        if !outliers.is_empty() && exclude {
            if found_late {
                adjusted = self.again(&adjusted, self.observations_without(data, &outliers)?)?;
            }
            let own_fits = self.readmitted(data, &adjusted, &mut outliers)?;
            if own_fits.readmitted {
                adjusted = self.again(&adjusted, self.observations_without(data, &outliers)?)?;
            }
            fits = posture_fits(&adjusted.sizes, data.postures.len());
            outliers.iter().zip(own_fits.fits).for_each(|(&posture, fit)| fits[posture] = fit);
        }
        warnings.extend(outliers.iter().map(|&posture| Warning::OutlierPosture {
            posture,
            index: data.postures[posture].index,
            outlier_fraction: fits[posture].outliers as f64 / fits[posture].observations.max(1) as f64,
            median_sigmas: fits[posture].median_sigmas,
            excluded: exclude,
        }));
        let unobserved = fits.iter().enumerate().filter(|(_, fit)| fit.observations == 0);
        warnings.extend(
            unobserved.map(|(posture, _)| Warning::UnobservedPosture { posture, index: data.postures[posture].index }),
        );
        Ok((adjusted, fits))
    }

    /// A wrong posture spoils those that share its tracks: each is tried again beside those that are right.
    fn readmitted(
        &self,
        data: &Correspondences,
        adjusted: &Adjusted,
        outliers: &mut Vec<usize>,
    ) -> Result<Readmission, CalibrationError> {
        let all_out = outliers.clone();
        let mut fits = Vec::new();
        for &posture in &all_out {
            let others: Vec<usize> = all_out.iter().copied().filter(|other| *other != posture).collect();
            let beside = self.observations_without(data, &others)?;
            let Adjusted { state, noise, .. } = adjusted;
            let evaluated = self.evaluate(&state.model, &state.posture_errors, &beside, *noise, None)?;
            let beside = judged(&evaluated.sizes, &evaluated.observations);
            if outlier_postures(&beside).contains(&posture) {
                fits.push(beside[posture]);
            } else {
                outliers.retain(|outlier| *outlier != posture);
            }
        }
        Ok(Readmission { readmitted: outliers.len() < all_out.len(), fits })
    }

    /// Residuals of a model: points and the board are fitted to its cameras, nothing else moves. Tracks that cannot be
    /// triangulated take the point of `fallback`, or are left out.
    fn evaluate(
        &self,
        model: &Model,
        posture_errors: &[f64],
        observations: &Observations,
        noise: NoiseScales,
        fallback: Option<&State>,
    ) -> Result<Evaluated, CalibrationError> {
        let mut observations = observations.clone();
        let priors = Priors::none(0);
        let loss = Loss::Cauchy(20.0);
        let mut state = posed_state(model, posture_errors.to_vec(), self.motion, &observations, &noise, loss)?;
        state.posture_errors = Vec::new();
        let known = fallback.map(|known| &known.points[..]);
        let mut points = triangulate_all(&observations, &state.view(&noise, loss), known);
        match fallback {
            Some(known) => {
                points.iter_mut().zip(&known.points).for_each(|(point, known)| *point = point.or(Some(*known)));
                state.base_from_board = state.base_from_board.or(known.base_from_board);
            }
            None => observations.retain_tracks(&points.iter().map(Option::is_some).collect::<Vec<_>>()),
        }
        state.points = points.into_iter().flatten().collect();
        let adjustment = Adjustment {
            parameters: &[],
            held: None,
            ..self.adjustment(&observations, &priors, noise, loss, LossCorrection::EVEN)
        };
        let state = match (posture_errors.is_empty(), state.base_from_board) {
            (true, Some(_)) => adjustment.minimize(state, 50)?.state,
            _ => state,
        };
        let sizes = adjustment.residual_sizes(&state);
        Ok(Evaluated { sizes, state, observations })
    }

    /// Triangulates, then minimises in rounds until the noise has settled. A `rough` adjustment holds the variance
    /// components of posture errors and arm.
    fn adjust(
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

    /// Postures whose joints would have to be off far more than those of the others.
    fn far_off(&self, adjusted: &Adjusted) -> Result<Vec<usize>, CalibrationError> {
        let Adjusted { state, noise, priors, observations, balance, .. } = adjusted;
        let adjustment = self.adjustment(observations, priors, *noise, self.options.loss, *balance);
        Ok(self.posture_error_estimate(&adjustment, state)?.map_or_else(Vec::new, |estimate| estimate.far_off))
    }

    /// The likelihood of the parameters about an optimum, board and posture errors eliminated; `wider`: a factor on the
    /// sigmas of the posture errors.
    fn likelihood(
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

    fn known(&self, adjusted: &Adjusted) -> Result<Known, CalibrationError> {
        let Adjusted { state, noise, priors, observations, balance, .. } = adjusted;
        let adjustment = self.adjustment(observations, priors, *noise, self.options.loss, *balance);
        let likelihood = self.likelihood(&adjustment, state, self.widening(&adjustment, state)?)?;
        let count = self.parameters.len();
        let mut prior_normal = DMatrix::zeros(count, count);
        priors.add_to(self.nominal, &state.model, self.parameters, &mut prior_normal, &mut DVector::zeros(count));
        let inputs = PosteriorInputs {
            likelihood,
            prior_normal,
            priors: priors.clone(),
            ruler: self.ruler,
            held: self.held.is_some(),
        };
        let (covariance, ruler) = match inputs.posterior() {
            Some(known) => (known.covariance, known.ruler),
            None => (covariance(&(&inputs.likelihood.normal + &inputs.prior_normal), self.parameters), None),
        };
        let errors = self.posture_error_knowledge(&adjustment, state)?;
        Ok(Known { inputs, covariance, ruler, errors })
    }

    fn conclude(
        &self,
        data: &Correspondences,
        adjusted: Adjusted,
        known: Known,
        fits: Vec<PostureFit>,
        mut warnings: Vec<Warning>,
    ) -> Result<Calibration, CalibrationError> {
        let Adjusted { state, noise, priors, observations, sizes, termination, .. } = adjusted;
        if !termination.reason.is_converged() {
            warnings.push(Warning::NotConverged { reason: termination.reason.to_string() });
        }
        let (identifiability, estimates) = describe(
            self.nominal,
            &state.model,
            &data.postures,
            self.parameters,
            &priors,
            &known.inputs.with_instruments(self.parameters),
            &known.covariance,
        );
        let outliers = sizes.iter().filter(|size| size.pixel >= OUTLIER_SIGMAS).count();
        let outlier_fraction = outliers as f64 / sizes.len().max(1) as f64;
        if outlier_fraction > 0.5 {
            warnings.push(Warning::ManyOutliers { fraction: outlier_fraction });
        }
        if noise.pixel > LARGE_SIGMA {
            warnings.push(Warning::LargeResiduals { sigma: noise.pixel });
        }
        let ruler = self.ruler.zip(known.ruler).map(|(at, ruler)| Ruler {
            parameter: self.parameters[at],
            prior_sigma: priors.sigmas[at].unwrap_or(f64::INFINITY),
            mean: ruler.mean,
            sigma: ruler.sigma,
            held: self.held.is_some(),
            covariance: ruler.covariance,
        });
        let contradicted = warnings.iter().any(|warning| matches!(warning, Warning::RulerContradicted { .. }));
        if let (Some(ruler), false) = (&ruler, contradicted) {
            warnings.extend(grown_together(&estimates, ruler));
        }
        warnings.extend(beyond_prior(&estimates, &priors, &known.covariance));
        let nominal_model = Model::new(self.nominal.clone());
        let before = self.evaluate(&nominal_model, &[], &observations, noise, Some(&state))?;
        let components = self.errors.kinds.len();
        Ok(Calibration {
            parameters: estimates,
            covariance: Some(known.covariance),
            posterior: Some(known.inputs),
            identifiability: Some(identifiability),
            epipolar_before: epipolar_statistics(&nominal_model, data)?,
            epipolar_after: epipolar_statistics(&state.model, data)?,
            reprojection_before: Some(over_inliers(&before.sizes, &sizes)),
            reprojection_after: Some(noise::statistics(&sizes)),
            noise: Noise {
                pixel: noise.pixel,
                depth_sigma_per_m2: (observations.depth_count() > 0).then_some(noise.depth),
                posture_angular: (components > 0).then_some(noise.posture.angular),
                posture_linear: self.errors.kinds.contains(&crate::ErrorKind::Linear).then_some(noise.posture.linear),
                outlier_fraction,
            },
            ruler,
            prior_scales: PriorGroup::ALL
                .into_iter()
                .filter_map(|group| Some(PriorScale { group, sigma: priors.group_sigma(group)? }))
                .collect(),
            postures: fits,
            posture_errors: state.posture_errors.chunks(components.max(1)).map(<[f64]>::to_vec).collect(),
            error_patterns: match &known.errors {
                Some(errors) => error_patterns(&state.model, self.motion, errors, &arm_positions(&data.postures))?,
                None => Vec::new(),
            },
            posture_error_knowledge: known.errors,
            termination,
            warnings,
            model: state.model,
        })
    }

    /// A sigma that was estimated with few degrees of freedom makes of the normal distribution one of Student's, whose
    /// covariance is wider: by this factor.
    fn widening(&self, adjustment: &Adjustment<'_>, state: &State) -> Result<f64, CalibrationError> {
        if !self.errors.is_estimated() {
            return Ok(1.0);
        }
        let dof = self.posture_error_estimate(adjustment, state)?.map(|estimate| estimate.dof.max(4.0));
        Ok(dof.map_or(1.0, |dof| (dof / (dof - 2.0)).sqrt()))
    }

    /// Mean and covariance of the posture errors with everything else unknown: what tests of causes are made of.
    fn posture_error_knowledge(
        &self,
        adjustment: &Adjustment<'_>,
        state: &State,
    ) -> Result<Option<PostureErrorKnowledge>, CalibrationError> {
        let components = self.errors.kinds.len();
        if components == 0 {
            return Ok(None);
        }
        let sigmas = adjustment.noise.posture;
        let mut normal = adjustment.normal_matrix(state, &sigmas)?;
        let mut ignored = DVector::zeros(normal.nrows());
        adjustment.priors.add_to(self.nominal, &state.model, self.parameters, &mut normal, &mut ignored);
        let Some(covariance) = crate::bundle::adjust::inverse(&normal) else { return Ok(None) };
        let count = state.posture_errors.len();
        let first = normal.nrows() - count;
        let sigma = self.errors.sigma_of(&sigmas);
        Ok(Some(PostureErrorKnowledge {
            components,
            mean: DVector::from_column_slice(&state.posture_errors),
            covariance: covariance.view((first, first), (count, count)).into_owned(),
            sigmas: (0..count).map(&sigma).collect(),
        }))
    }
}

/// What is known at an optimum.
struct Known {
    inputs: PosteriorInputs,
    covariance: DMatrix<f64>,
    ruler: Option<RulerPosterior>,
    errors: Option<PostureErrorKnowledge>,
}

/// Lengths and the standard of length contradict each other when this many sigmas lie between them.
const CONTRADICTION_SIGMAS: f64 = 3.0;

impl Known {
    fn contradicted_ruler(&self) -> Option<(f64, f64)> {
        let ruler = self.ruler.as_ref()?;
        (ruler.mean.abs() > CONTRADICTION_SIGMAS * ruler.sigma).then_some((ruler.mean, ruler.sigma))
    }
}

/// What became of excluded postures that were tried again.
struct Readmission {
    readmitted: bool,
    /// Fits of those that stay out.
    fits: Vec<PostureFit>,
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

/// A parameter that leaves its prior by so many sigmas is named.
const BEYOND_PRIOR_SIGMAS: f64 = 3.0;

/// Parameters that the data moved far out of their priors: no chance, but something that the prior did not expect.
fn beyond_prior(estimates: &[crate::ParameterEstimate], priors: &Priors, covariance: &DMatrix<f64>) -> Vec<Warning> {
    let of = |(k, estimate): (usize, &crate::ParameterEstimate)| {
        let prior = priors.sigmas[k]?;
        let change = estimate.value - estimate.nominal;
        let sigmas = change.abs() / prior;
        // What is not known to be away from nominal is no statement.
        let known = change.abs() > BEYOND_PRIOR_SIGMAS * covariance[(k, k)].max(0.0).sqrt();
        (sigmas > BEYOND_PRIOR_SIGMAS && known).then_some(Warning::BeyondPrior {
            parameter: estimate.parameter,
            change,
            prior_sigma: prior,
        })
    };
    estimates.iter().enumerate().filter_map(of).collect()
}

/// RMS over the observations that fit the calibrated model, so that before and after are over the same observations;
/// median over all.
fn over_inliers(before: &[ResidualSize], after: &[ResidualSize]) -> ReprojectionStatistics {
    let kept = before.iter().zip(after).filter(|(b, a)| a.pixel < OUTLIER_SIGMAS && b.distance_px().is_finite());
    let squares: Vec<f64> = kept.map(|(b, _)| b.residual_px.norm_squared()).collect();
    ReprojectionStatistics {
        rms_px: (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt(),
        median_px: median(&mut before.iter().map(ResidualSize::distance_px).collect::<Vec<_>>()),
        observations: before.len(),
        inliers: squares.len(),
    }
}
