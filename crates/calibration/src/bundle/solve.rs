//! The estimator from start to result: find the way pairwise, adjust everything, estimate the noise, leave out what does not belong.

use crate::bundle::adjust::{Adjustment, marginal, posed_state};
use crate::bundle::deviations::deviation_unknowns;
use crate::bundle::noise::{self, Balance, OUTLIER_SIGMAS, posture_fits, rescaled};
use crate::bundle::observations::Observations;
use crate::bundle::residuals::ResidualSize;
use crate::bundle::start::{start, triangulate_all};
use crate::bundle::state::{NoiseScales, State};
use crate::bundle::suspects::{judged, suspects};
use crate::error_function::epipolar_statistics;
use crate::motion::Motion;
use crate::prior::{self, Priors};
use crate::robust::median;
use crate::uncertainty::{Told, tell};
use crate::{
    BundleOptions, Calibration, CalibrationError, Correspondences, DeviationPolicy, Loss, Model, Noise, Parameter,
    PostureFit, ReprojectionStatistics, Termination, Warning,
};
use skclam_rig::Rig;
use std::cell::Cell;

/// Sights that the descent looks at until it has settled; then all.
const SAMPLE_SIGHTS: usize = 60_000;
/// Deviations below this (0.0003 deg) move no pixel by what can be measured, rad.
const LEAST_DEVIATION: f64 = 5e-6;
/// Joints that stand farther off their values (sigma, rad; half a degree) are no encoders' noise: something else is wrong, and deviations must not swallow it.
const LARGEST_DEVIATION: f64 = 8.7e-3;
/// Iterations of one adjustment, and of all adjustments of a calibration, in those of one round: a model that cannot fit the data is not worth more.
const PATIENCE: [usize; 2] = [2, 4];
/// Data as good as this (sigma beside what they say of themselves) are synthetic, and descend to rounding.
const EXACT_SIGMA: f64 = 1e-2;
/// What an adjustment is left with when patience has run out.
const LEAST_ITERATIONS: usize = 10;
/// Times that the sample is searched for postures that are wrong.
const EARLY_LOOKS: usize = 3;
/// `s` of `sigma = s z^2` before the data are heard, 1/m.
const FIRST_DEPTH: f64 = 0.01;
/// Fewer sights of a kind do not tell its noise.
const LEAST_OF_A_KIND: usize = 50;
/// No feature is so bad, in units of the sigma that it came with.
const LARGE_SIGMA: f64 = 5.0;
/// The noise has settled when it changes by less than this fraction.
const SETTLED: f64 = 0.01;

struct Adjusted {
    state: State,
    noise: NoiseScales,
    observations: Observations,
    sizes: Vec<ResidualSize>,
    balance: Balance,
    termination: Termination,
}

/// Residuals of a fixed model.
pub(crate) struct Evaluated {
    pub sizes: Vec<ResidualSize>,
    pub state: State,
    /// What could be triangulated.
    pub observations: Observations,
}

/// Residuals of two models on the same sights, whose pixels have noise of `sigma_px`: points and the board are fitted to each model's cameras, nothing else moves.
pub(crate) fn compare(
    nominal: &Model,
    calibrated: &Model,
    motion: &Motion,
    observations: &Observations,
    sigma_px: f64,
) -> Result<(Evaluated, Evaluated), CalibrationError> {
    let noise = NoiseScales { pixel: sigma_px.max(1e-6), depth: FIRST_DEPTH, deviation: 1.0 };
    let priors = Priors { sigmas: Vec::new() };
    let options = BundleOptions::default();
    let solve = Solve {
        nominal: &nominal.rig,
        motion,
        parameters: &[],
        priors: &priors,
        options: &options,
        spent: Cell::new(0),
    };
    let after = solve.evaluate(calibrated, &[], observations, noise, None)?;
    let before = solve.evaluate(nominal, &[], &after.observations, noise, Some(&after.state))?;
    Ok((before, after))
}

/// Adjusts the free parameters, the scene points, the board's pose and the joint deviations together.
pub fn calibrate_bundle(
    nominal: &Rig,
    data: &Correspondences,
    options: &BundleOptions,
) -> Result<Calibration, CalibrationError> {
    data.check()?;
    let mut warnings = Vec::new();
    let motion = Motion::new(nominal, &data.postures)?;
    let all = Observations::new(nominal, data, &|_| true, &mut warnings)?;
    let parameters = options.free.candidates(nominal, motion.has_joints(), all.depth_count() > 0)?;
    if parameters.is_empty() {
        return Err(CalibrationError::NothingFree);
    }
    if !motion.has_joints() {
        warnings.push(Warning::FlangePosesOnly);
    }
    let residuals = 2 * all.sightings.len() + all.depth_count() + 2 * all.corners.len();
    let freedom = residuals.saturating_sub(3 * all.track_count() + if all.corners.is_empty() { 0 } else { 6 });
    let need = 2 * parameters.len();
    if freedom < need {
        let what = "residuals of tracks and board corners (beyond those that their own points take)".to_owned();
        return Err(CalibrationError::TooFew { what, need, got: freedom, parameters: parameters.len() });
    }
    let priors = Priors { sigmas: prior::sigmas(nominal, &options.free, options.priors, &parameters) };
    let (joints, first_deviation) = deviation_unknowns(nominal, &motion, options, &mut warnings);

    let (start, pixel) = start(nominal, data, &all, &parameters)?;
    let noise = NoiseScales { pixel, depth: FIRST_DEPTH, deviation: first_deviation };
    let solve =
        Solve { nominal, motion: &motion, parameters: &parameters, priors: &priors, options, spent: Cell::new(0) };
    let none = vec![0.0; joints * motion.len()];
    let without = |out: &[usize]| {
        let keep = |posture: usize| !out.contains(&posture);
        Observations::new(nominal, data, &keep, &mut Vec::new())
    };
    // Most of the way on a sample, the last steps on everything. The sigma of the joints' deviations is held at first: estimated beside a posture that is wrong, it would grow
    // until deviations explain anything.
    let stride = all.sightings.len().div_ceil(SAMPLE_SIGHTS).max(1);
    let mut sample = solve.adjust(&start, none, noise, all.sampled(stride), true)?;
    let mut early = Vec::new();
    for _ in 0..EARLY_LOOKS {
        // The worst hide the less bad: look again without them.
        let mut found = suspects(&judged(&sample.sizes, &sample.observations));
        if joints > 0 {
            found.extend(solve.far_off(&sample)?);
            found.sort_unstable();
            found.dedup();
            found.truncate((motion.len() / 5).saturating_sub(early.len()));
        }
        if found.is_empty() || !options.leave_out_suspects {
            break;
        }
        early.extend(found);
        let rest = without(&early)?.sampled(stride);
        let Adjusted { state, noise, termination, .. } = sample;
        sample = solve.adjust(&state.model, state.deviations, noise, rest, true)?;
        sample.termination.add_effort(&termination);
    }
    let everything = if early.is_empty() { all } else { without(&early)? };
    let mut adjusted = if stride == 1 && early.is_empty() && joints == 0 {
        sample
    } else {
        let Adjusted { state, noise, .. } = &sample;
        let mut rest = solve.adjust(&state.model, state.deviations.clone(), *noise, everything, false)?;
        rest.termination.add_effort(&sample.termination);
        rest
    };
    let again = |from: &Adjusted, observations: Observations| -> Result<Adjusted, CalibrationError> {
        let deviations = from.state.deviations.clone();
        let mut next = solve.adjust(&from.state.model, deviations, from.noise, observations, false)?;
        next.termination.add_effort(&from.termination);
        Ok(next)
    };
    let mut fits = posture_fits(&adjusted.sizes, data.postures.len());
    let mut suspects = suspects(&judged(&adjusted.sizes, &adjusted.observations));
    let found_late = !suspects.is_empty();
    suspects.extend(early);
    suspects.sort_unstable();
    suspects.dedup();
    if !suspects.is_empty() && options.leave_out_suspects {
        if found_late {
            adjusted = again(&adjusted, without(&suspects)?)?;
        }
        // A wrong posture spoils those that share its tracks: each is heard again beside those that are right.
        let all_out = suspects.clone();
        let mut told = Vec::new();
        for &posture in &all_out {
            let others: Vec<usize> = all_out.iter().copied().filter(|other| *other != posture).collect();
            let beside = without(&others)?;
            let Adjusted { state, noise, .. } = &adjusted;
            let heard = solve.evaluate(&state.model, &state.deviations, &beside, *noise, None)?;
            let beside = judged(&heard.sizes, &heard.observations);
            if crate::bundle::suspects::suspects(&beside).contains(&posture) {
                told.push(beside[posture]);
            } else {
                suspects.retain(|suspect| *suspect != posture);
            }
        }
        if suspects.len() < all_out.len() {
            adjusted = again(&adjusted, without(&suspects)?)?;
        }
        fits = posture_fits(&adjusted.sizes, data.postures.len());
        suspects.iter().zip(told).for_each(|(&posture, fit)| fits[posture] = fit);
    }
    warnings.extend(suspects.iter().map(|&posture| Warning::SuspectPosture {
        posture,
        index: data.postures[posture].index,
        outlier_fraction: fits[posture].outliers as f64 / fits[posture].observations.max(1) as f64,
        median_sigmas: fits[posture].median_sigmas,
        left_out: options.leave_out_suspects,
    }));
    let unseen = fits.iter().enumerate().filter(|(_, fit)| fit.observations == 0);
    warnings.extend(unseen.map(|(posture, _)| Warning::UnseenPosture { posture, index: data.postures[posture].index }));
    solve.conclude(data, adjusted, fits, joints, warnings)
}

pub(super) struct Solve<'a> {
    pub nominal: &'a Rig,
    pub motion: &'a Motion,
    pub parameters: &'a [Parameter],
    pub priors: &'a Priors,
    pub options: &'a BundleOptions,
    /// Iterations of all adjustments so far on data that are not exact.
    pub spent: Cell<usize>,
}

impl Solve<'_> {
    fn adjustment<'b>(
        &'b self,
        observations: &'b Observations,
        noise: NoiseScales,
        loss: Loss,
        balance: Balance,
    ) -> Adjustment<'b> {
        Adjustment {
            nominal: self.nominal,
            motion: self.motion,
            observations,
            parameters: self.parameters,
            priors: self.priors,
            loss,
            noise,
            balance,
        }
    }

    /// Residuals of a model: points and the board are fitted to its cameras, nothing else moves. Tracks that cannot be triangulated take
    /// the point of `fallback`, or are left out.
    fn evaluate(
        &self,
        model: &Model,
        deviations: &[f64],
        observations: &Observations,
        noise: NoiseScales,
        fallback: Option<&State>,
    ) -> Result<Evaluated, CalibrationError> {
        let mut observations = observations.clone();
        let priors = Priors { sigmas: Vec::new() };
        let loss = Loss::Cauchy(20.0);
        let mut state = posed_state(model, deviations.to_vec(), self.motion, &observations, &noise, loss)?;
        state.deviations = Vec::new();
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
            nominal: self.nominal,
            motion: self.motion,
            observations: &observations,
            parameters: &[],
            priors: &priors,
            loss,
            noise,
            balance: Balance::EVEN,
        };
        let state = match (deviations.is_empty(), state.base_from_board) {
            (true, Some(_)) => adjustment.descend(state, 50)?.state,
            _ => state,
        };
        let sizes = adjustment.residual_sizes(&state);
        Ok(Evaluated { sizes, state, observations })
    }

    fn estimates_deviations(&self) -> bool {
        self.options.deviations == DeviationPolicy::Estimated && self.nominal.prior.joint_deviation_deg.is_none()
    }

    /// Triangulates, then descends in rounds until the noise has settled. A `rough` adjustment holds the sigma of the deviations.
    fn adjust(
        &self,
        start: &Model,
        deviations: Vec<f64>,
        mut noise: NoiseScales,
        mut observations: Observations,
        rough: bool,
    ) -> Result<Adjusted, CalibrationError> {
        let loss = self.options.loss;
        let joints = deviations.len();
        let mut state = posed_state(start, deviations, self.motion, &observations, &noise, loss)?;
        let points = self.adjustment(&observations, noise, Loss::Cauchy(2.0), Balance::EVEN).triangulate(&state);
        observations.retain_tracks(&points.iter().map(Option::is_some).collect::<Vec<_>>());
        state.points = points.into_iter().flatten().collect();
        let unknown_count = self.parameters.len() + 6 * usize::from(state.base_from_board.is_some());
        let mut sizes = self.adjustment(&observations, noise, loss, Balance::EVEN).residual_sizes(&state);
        noise = rescaled(&sizes, &noise, 1.0);
        let mut balance = Balance::EVEN;
        let (mut iterations, mut evaluations, mut rounds, mut vain) = (0, 0, 0, 0);
        let mut initial_cost = None;
        let [one, all] = PATIENCE.map(|rounds| rounds * self.options.max_iterations);
        let allowed = one.min(all.saturating_sub(self.spent.get())).max(LEAST_ITERATIONS);
        let (reason, final_cost) = loop {
            rounds += 1;
            let adjustment = self.adjustment(&observations, noise, loss, balance);
            let limit = self.options.max_iterations.min(allowed.saturating_sub(vain).max(1));
            let descent = adjustment.descend(state, limit)?;
            iterations += descent.iterations;
            evaluations += descent.evaluations;
            initial_cost.get_or_insert(descent.initial_cost);
            state = descent.state;
            sizes = adjustment.residual_sizes(&state);
            let freedom: f64 = sizes.iter().map(|s| s.pixel_freedom + s.depth.map_or(0.0, |(_, f)| f)).sum();
            let next_balance = Balance::of(&sizes, loss);
            let told = if joints > 0 && !rough {
                self.deviations_told(&Adjustment { balance: next_balance, ..adjustment }, &state)?
            } else {
                None
            };
            let taken = unknown_count as f64 + told.as_ref().map_or(0.0, |told| told.determined);
            let left = 1.0 - taken / freedom.max(1.0);
            let mut next = rescaled(&sizes, &noise, left);
            // How sure corners are beside other sights is not known beforehand either: each kind tells its own noise.
            let (of_tracks, of_corners) = sizes.split_at(observations.sightings.len().min(sizes.len()));
            let mut corner_factor = 1.0;
            if of_tracks.len().min(of_corners.len()) >= LEAST_OF_A_KIND {
                next = rescaled(of_tracks, &noise, left);
                corner_factor = (rescaled(of_corners, &noise, left).pixel / next.pixel).clamp(0.1, 10.0);
            }
            if let (Some(sigma), true) = (told.and_then(|told| told.sigma), self.estimates_deviations()) {
                // The fixed point is approached by small factors; their square halves the number of rounds.
                let factor = (sigma / noise.deviation).clamp(0.3, 3.0);
                next.deviation = (noise.deviation * factor * factor).clamp(LEAST_DEVIATION, LARGEST_DEVIATION);
            }
            if noise.pixel > EXACT_SIGMA {
                vain += descent.iterations;
            }
            let change = |old: f64, new: f64| (new / old - 1.0).abs();
            let deviation_settled = next.deviation == noise.deviation
                || next.deviation <= LEAST_DEVIATION && noise.deviation <= LEAST_DEVIATION
                || change(noise.deviation, next.deviation) < 5.0 * SETTLED;
            let settled = change(noise.pixel, next.pixel) < SETTLED
                && change(noise.depth, next.depth) < SETTLED
                && change(corner_factor, 1.0) < 5.0 * SETTLED
                && deviation_settled
                && (joints == 0 || change(balance.prior_weight, next_balance.prior_weight) < SETTLED);
            if settled || rounds >= self.options.max_rounds || vain >= allowed {
                break (descent.reason, descent.cost);
            }
            noise = next;
            observations.scale_corner_sigma(corner_factor);
            balance = next_balance;
        };
        self.spent.set(self.spent.get() + vain);
        let initial_cost = initial_cost.unwrap_or_default();
        let termination = Termination { reason, iterations, evaluations, rounds, initial_cost, final_cost };
        Ok(Adjusted { state, noise, observations, balance: Balance::of(&sizes, loss), sizes, termination })
    }

    /// Postures whose joints would have to deviate far more than those of the others.
    fn far_off(&self, adjusted: &Adjusted) -> Result<Vec<usize>, CalibrationError> {
        let Adjusted { state, noise, observations, balance, .. } = adjusted;
        let adjustment = self.adjustment(observations, *noise, self.options.loss, *balance);
        Ok(self.deviations_told(&adjustment, state)?.map_or_else(Vec::new, |told| told.far_off))
    }

    fn conclude(
        &self,
        data: &Correspondences,
        adjusted: Adjusted,
        fits: Vec<PostureFit>,
        joints: usize,
        mut warnings: Vec<Warning>,
    ) -> Result<Calibration, CalibrationError> {
        let Adjusted { state, noise, observations, sizes, balance, termination } = adjusted;
        let loss = self.options.loss;
        if !termination.reason.is_converged() {
            warnings.push(Warning::NotConverged { reason: termination.reason.to_string() });
        }
        let count = self.parameters.len();
        let adjustment = self.adjustment(&observations, noise, loss, balance);
        let told = match joints > 0 && self.estimates_deviations() {
            true => self.deviations_told(&adjustment, &state)?,
            false => None,
        };
        // A sigma that was estimated with few degrees of freedom makes of the normal distribution one of Student's, whose covariance is wider.
        let wider = told.map_or(1.0, |told| (told.freedom.max(4.0) / (told.freedom.max(4.0) - 2.0)).sqrt());
        let information = marginal(&adjustment.information(&state, noise.deviation * wider)?, count);
        let Told { covariance, identifiability, parameters: estimates } =
            tell(self.nominal, &state.model, &data.postures, self.parameters, self.priors, &information, 1.0);
        let outliers = sizes.iter().filter(|size| size.pixel >= OUTLIER_SIGMAS).count();
        let outlier_fraction = outliers as f64 / sizes.len().max(1) as f64;
        if outlier_fraction > 0.5 {
            warnings.push(Warning::ManyOutliers { fraction: outlier_fraction });
        }
        if noise.pixel > LARGE_SIGMA {
            warnings.push(Warning::LargeResiduals { sigma: noise.pixel });
        }
        let nominal_model = Model::new(self.nominal.clone());
        let before = self.evaluate(&nominal_model, &[], &observations, noise, Some(&state))?;
        Ok(Calibration {
            parameters: estimates,
            covariance: Some(covariance),
            identifiability: Some(identifiability),
            epipolar_before: epipolar_statistics(&nominal_model, data)?,
            epipolar_after: epipolar_statistics(&state.model, data)?,
            reprojection_before: Some(over_inliers(&before.sizes, &sizes)),
            reprojection_after: Some(noise::statistics(&sizes)),
            noise: Noise {
                pixel: noise.pixel,
                depth_per_m: (observations.depth_count() > 0).then_some(noise.depth),
                joint_deviation: (joints > 0).then_some(noise.deviation),
                outlier_fraction,
            },
            postures: fits,
            joint_deviations: state.deviations.chunks(joints.max(1)).map(<[f64]>::to_vec).collect(),
            termination,
            warnings,
            model: state.model,
        })
    }
}

/// RMS over the sights that fit the calibrated model, so that before and after speak of the same; median over all.
fn over_inliers(before: &[ResidualSize], after: &[ResidualSize]) -> ReprojectionStatistics {
    let kept = before.iter().zip(after).filter(|(b, a)| a.pixel < OUTLIER_SIGMAS && b.distance_px().is_finite());
    let squares: Vec<f64> = kept.map(|(b, _)| b.way_px.norm_squared()).collect();
    ReprojectionStatistics {
        rms_px: (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt(),
        median_px: median(&mut before.iter().map(ResidualSize::distance_px).collect::<Vec<_>>()),
        observations: before.len(),
        inliers: squares.len(),
    }
}
