//! The estimator from start to result: start pairwise, screen for outlier postures, adjust everything, estimate the
//! noise, conclude.

use crate::bundle::adjust::{Adjustment, posed_state};
use crate::bundle::correlation::weigh_by_correlation;
use crate::bundle::noise::{LossCorrection, posture_fits};
use crate::bundle::observations::Observations;
use crate::bundle::outliers::{judged, outlier_postures, remove_biased_depths};
use crate::bundle::random_effects::PostureErrorModel;
use crate::bundle::residuals::ResidualSize;
use crate::bundle::start::{start, triangulate_all};
use crate::bundle::state::{NoiseScales, PostureErrorSigmas, State};
use crate::camera_kinematics::CameraKinematics;
use crate::prior::Priors;
use crate::{
    BundleOptions, Calibration, CalibrationError, Correspondences, Loss, Model, Parameter, PostureFit, RulerPolicy,
    Termination, Warning, free,
};
use skclam_rig::Rig;
use std::cell::Cell;

/// Observations that the minimisation uses until it has settled; then all.
const SAMPLE_OBSERVATIONS: usize = 60_000;
/// Times that the sample is searched for postures that are wrong.
const MAX_SCREENING_ROUNDS: usize = 3;
/// `s` of `sigma = s z^2` before the data are used, 1/m.
const FIRST_DEPTH: f64 = 0.01;

pub(super) struct Adjusted {
    pub state: State,
    pub noise: NoiseScales,
    pub priors: Priors,
    pub observations: Observations,
    pub sizes: Vec<ResidualSize>,
    pub balance: LossCorrection,
    pub termination: Termination,
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
    pub(super) fn adjustment<'b>(
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
    pub(super) fn evaluate(
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

    /// Postures whose joints would have to be off far more than those of the others.
    fn far_off(&self, adjusted: &Adjusted) -> Result<Vec<usize>, CalibrationError> {
        let Adjusted { state, noise, priors, observations, balance, .. } = adjusted;
        let adjustment = self.adjustment(observations, priors, *noise, self.options.loss, *balance);
        Ok(self.posture_error_estimate(&adjustment, state)?.map_or_else(Vec::new, |estimate| estimate.far_off))
    }
}

/// What became of excluded postures that were tried again.
struct Readmission {
    readmitted: bool,
    /// Fits of those that stay out.
    fits: Vec<PostureFit>,
}
