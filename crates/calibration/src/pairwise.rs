//! Robust least squares on signed Sampson distances over all matches: the paper's pairs, at first-order maximum
//! likelihood.
//!
//! The chain rule works at the level of the pair: every match adds to the 6 x 6 normal matrix of its pair's relative
//! twist (15 x 15 with free intrinsics), and one product a pair takes that to the parameters, so that the cost a match
//! does not depend on how many are free. A search on a sample of the matches finds the basin (Tukey's biweight,
//! narrowing with the smallest third of the residuals, from several widths); then all matches are fitted, and the scale
//! of the loss is that of the residuals that fit, round by round until it settles.

use crate::camera_kinematics::CameraKinematics;
use crate::error_function::{SMALLEST_BASELINE_M, UndistortedPairs, epipolar_statistics};
use crate::identifiability::identify;
use crate::levenberg_marquardt::{
    Minimization, MinimizationLimits, Proposal, damped_solve, minimize, predicted_gain, scaled_norm,
};
use crate::pairwise_system::{Linearized, PairwiseSystem};
use crate::prior::Priors;
use crate::robust::{coarse_scale, median, noise_scale};
use crate::{
    Calibration, CalibrationError, Correspondences, Free, Loss, Model, Noise, PairMatches, Parameter, PostureFit,
    PriorPolicy, Termination, Warning, uncertainty,
};
use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use skclam_rig::Rig;

/// Whether the pairwise estimator looks for its basin first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Search {
    /// On a sample of the matches, with losses of several widths: for starts degrees off and for many wrong matches.
    #[default]
    Widths,
    /// Minimises from the start at once.
    Off,
}

/// Settings of the pairwise estimator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairwiseOptions {
    /// What is free.
    pub free: Free,
    /// Which priors are used.
    pub priors: PriorPolicy,
    /// The loss of the last rounds; its constant in sigmas.
    pub loss: Loss,
    /// Whether the basin is looked for first.
    pub search: Search,
    /// Iterations of one round at most.
    pub max_iterations: usize,
    /// Rounds at most.
    pub max_rounds: usize,
    /// A round has ended when a step changes the cost by less than this fraction.
    pub cost_tolerance: f64,
    /// Pairs with fewer matches are named in a warning.
    pub few_matches: usize,
}

impl Default for PairwiseOptions {
    fn default() -> Self {
        PairwiseOptions {
            free: Free::Auto,
            priors: PriorPolicy::Auto,
            loss: Loss::Tukey(7.0),
            search: Search::Widths,
            max_iterations: 60,
            max_rounds: 25,
            cost_tolerance: 1e-10,
            few_matches: 8,
        }
    }
}

/// Noise below this is taken for rounding, px.
const EXACT_PX: f64 = 1e-7;

/// A round's noise has settled when it changes by less than this fraction.
const SETTLED: f64 = 0.01;
/// Rounds and iterations of the search.
const SEARCH_ROUNDS: usize = 10;
const SEARCH_ITERATIONS: usize = 12;
/// Matches that the search looks at.
const SEARCH_MATCHES: usize = 6000;
/// Constants of Tukey's loss with which the search starts, in units of the residuals' scale at the start. Wide ones
/// come far when most matches are right, narrow ones when many are wrong.
const SEARCH_WIDTHS: [f64; 4] = [4.0, 2.0, 1.0, 0.5];

#[derive(Debug, Clone, Copy)]
struct Round {
    loss: Loss,
    sigma: f64,
}

/// A state with its cost and normal equations, priors included.
struct Prepared {
    state: Model,
    normal: DMatrix<f64>,
    rhs: DVector<f64>,
    cost: f64,
}

#[derive(Debug, Default)]
struct Effort {
    iterations: usize,
    evaluations: usize,
    rounds: usize,
}

struct Problem<'a> {
    nominal: &'a Rig,
    parameters: &'a [Parameter],
    priors: &'a Priors,
    tolerance: f64,
}

impl Problem<'_> {
    fn cost(&self, system: &PairwiseSystem<'_>, model: &Model, round: &Round) -> Result<f64, CalibrationError> {
        Ok(system.cost(model, round.loss, round.sigma)? + self.priors.cost(self.nominal, model, self.parameters))
    }

    fn minimize(
        &self,
        system: &PairwiseSystem<'_>,
        model: &Model,
        round: &Round,
        max_iterations: usize,
        effort: &mut Effort,
    ) -> Result<Minimization<Model>, CalibrationError> {
        let limits = MinimizationLimits {
            max_iterations,
            cost_tolerance: self.tolerance,
            step_tolerance: 1e-10,
            sigma_tolerance: 0.0,
        };
        // One pass over the matches gives a state's cost and its normal equations: those of the state that was left,
        // for another damping, and those of the state that was tried.
        let prepare = |state: &Model| -> Result<Prepared, CalibrationError> {
            let Linearized { mut normal, mut rhs, cost } = system.linearize(state, round.loss, round.sigma)?;
            self.priors.add_to(self.nominal, state, self.parameters, &mut normal, &mut rhs);
            let cost = cost + self.priors.cost(self.nominal, state, self.parameters);
            Ok(Prepared { state: state.clone(), normal, rhs, cost })
        };
        let mut left = prepare(model)?;
        let mut tried: Option<Prepared> = None;
        let cost = left.cost;
        let minimization = minimize(model.clone(), cost, limits, |state, damping| {
            if let Some(tried) = tried.take().filter(|tried| tried.state == *state) {
                left = tried;
            }
            let step = damped_solve(&left.normal, &left.rhs, self.parameters, damping)?;
            let moved = prepare(&state.stepped(self.parameters, step.as_slice())?)?;
            let proposal = Proposal {
                cost: moved.cost,
                state: moved.state.clone(),
                step: scaled_norm(self.parameters, &step),
                sigmas: f64::INFINITY,
                predicted: predicted_gain(&left.normal, &left.rhs, &step),
            };
            tried = Some(moved);
            Ok(proposal)
        })?;
        effort.iterations += minimization.iterations;
        effort.evaluations += minimization.evaluations;
        effort.rounds += 1;
        Ok(minimization)
    }

    /// Most of the way on a sample of the matches, where there are many: only the last steps need all of them.
    fn approach(
        &self,
        start: &Model,
        pairs: &[PairMatches],
        motion: &CameraKinematics,
        loss: Loss,
        effort: &mut Effort,
    ) -> Result<Model, CalibrationError> {
        let sample = sample(pairs);
        let system = PairwiseSystem::new(&sample, motion, self.parameters);
        let round = Round { loss, sigma: noise_scale(&system.residuals(start)?).max(EXACT_PX) };
        let mut ahead = Effort::default();
        let minimization = self.minimize(&system, start, &round, SEARCH_ITERATIONS, &mut ahead)?;
        effort.iterations += ahead.iterations;
        effort.evaluations += ahead.evaluations;
        Ok(minimization.state)
    }

    /// Finds the basin on a sample of the matches: from each width the loss narrows with the residuals, and the model
    /// whose smallest third of residuals is smallest wins. Returns it with the scale of its noise.
    fn search(
        &self,
        start: &Model,
        pairs: &[PairMatches],
        motion: &CameraKinematics,
        effort: &mut Effort,
    ) -> Result<(Model, f64), CalibrationError> {
        let sample = sample(pairs);
        let system = PairwiseSystem::new(&sample, motion, self.parameters);
        let mut best: Option<(f64, Model)> = None;
        for width in SEARCH_WIDTHS {
            let mut model = start.clone();
            let mut scale = coarse_scale(&system.residuals(&model)?);
            for _ in 0..SEARCH_ROUNDS {
                let round = Round { loss: Loss::Tukey(width), sigma: scale.max(EXACT_PX) };
                model = self.minimize(&system, &model, &round, SEARCH_ITERATIONS, effort)?.state;
                let next = coarse_scale(&system.residuals(&model)?);
                let settled = (next / scale - 1.0).abs() < 0.05 || next <= EXACT_PX;
                scale = next;
                if settled {
                    break;
                }
            }
            if best.as_ref().is_none_or(|(least, _)| scale < *least) {
                best = Some((scale, model));
            }
        }
        let (scale, model) = best.unwrap_or_else(|| (EXACT_PX, start.clone()));
        let sigma = noise_scale(&system.residuals(&model)?);
        Ok((model, if sigma > 0.0 { sigma } else { scale }))
    }
}

/// Every k-th match, so that about [`SEARCH_MATCHES`] are left.
fn sample(pairs: &[PairMatches]) -> Vec<PairMatches> {
    let total: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    let stride = total.div_ceil(SEARCH_MATCHES).max(1);
    let thinned = |pair: &PairMatches| pair.matches.iter().copied().step_by(stride).collect();
    pairs.iter().map(|pair| PairMatches { a: pair.a, b: pair.b, matches: thinned(pair) }).collect()
}

/// Minimises robust Sampson distances over the free parameters.
pub fn calibrate_pairwise(
    nominal: &Rig,
    data: &Correspondences,
    options: &PairwiseOptions,
) -> Result<Calibration, CalibrationError> {
    calibrate_pairwise_from(&Model::new(nominal.clone()), nominal, data, options)
}

/// As [`calibrate_pairwise`], starting elsewhere than at the nominal rig (priors still refer to that).
pub fn calibrate_pairwise_from(
    start: &Model,
    nominal: &Rig,
    data: &Correspondences,
    options: &PairwiseOptions,
) -> Result<Calibration, CalibrationError> {
    data.check()?;
    let motion = CameraKinematics::new(nominal, &data.postures)?;
    let parameters = free_parameters(&options.free, nominal, &motion)?;
    let priors = Priors::new(nominal, &options.free, options.priors, &parameters);
    let mut warnings = Vec::new();
    if !motion.has_joints() && parameters.iter().all(|parameter| !parameter.needs_joints()) {
        warnings.push(Warning::FlangePosesOnly);
    }
    let nominal_poses = motion.poses(&Model::new(nominal.clone()), &[])?;
    let undistorted = UndistortedPairs::new(nominal, data, &nominal_poses, &mut warnings);
    let seen = |a: usize, b: usize| {
        (nominal_poses[a].translation.vector - nominal_poses[b].translation.vector).norm() >= SMALLEST_BASELINE_M
    };
    let pairs: Vec<_> = data.pairs.iter().filter(|pair| seen(pair.a, pair.b)).cloned().collect();
    let few = pairs.iter().filter(|pair| pair.matches.len() < options.few_matches);
    warnings.extend(few.map(|pair| Warning::FewMatches { a: pair.a, b: pair.b, matches: pair.matches.len() }));
    let mut touched = vec![false; data.postures.len()];
    pairs.iter().filter(|pair| !pair.matches.is_empty()).for_each(|pair| {
        touched[pair.a] = true;
        touched[pair.b] = true;
    });
    let unobserved = data.postures.iter().enumerate().filter(|(posture, _)| !touched[*posture]);
    warnings.extend(unobserved.map(|(posture, p)| Warning::UnobservedPosture { posture, index: p.index }));
    let matches: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    let need = (2 * parameters.len()).max(8);
    if matches < need {
        let what = "pair matches".to_owned();
        return Err(CalibrationError::TooFew { what, need, got: matches, parameters: parameters.len() });
    }

    let problem = Problem { nominal, parameters: &parameters, priors: &priors, tolerance: options.cost_tolerance };
    let system = PairwiseSystem::new(&pairs, &motion, &parameters);
    let mut effort = Effort::default();
    let (mut model, sigma) = match options.search {
        Search::Widths => problem.search(start, &pairs, &motion, &mut effort)?,
        Search::Off if matches > 2 * SEARCH_MATCHES => {
            let near = problem.approach(start, &pairs, &motion, options.loss, &mut effort)?;
            let sigma = noise_scale(&system.residuals(&near)?);
            (near, sigma)
        }
        Search::Off => (start.clone(), noise_scale(&system.residuals(start)?)),
    };
    let dof = dof_factor(matches, parameters.len());
    let mut round = Round { loss: options.loss, sigma: (sigma * dof).max(EXACT_PX) };
    let initial_cost = problem.cost(&system, start, &round)?;
    let (residuals, reason, final_cost) = loop {
        let minimization = problem.minimize(&system, &model, &round, options.max_iterations, &mut effort)?;
        model = minimization.state;
        let residuals = system.residuals(&model)?;
        let next = (noise_scale(&residuals) * dof).max(EXACT_PX);
        if (next / round.sigma - 1.0).abs() < SETTLED || effort.rounds >= options.max_rounds {
            break (residuals, minimization.reason, minimization.cost);
        }
        round.sigma = next;
    };
    if !reason.is_converged() {
        warnings.push(Warning::NotConverged { reason: reason.to_string() });
    }

    let normal = system.linearize(&model, round.loss, round.sigma)?.normal;
    let factor = efficiency_factor(&residuals, round.loss, round.sigma);
    let mut posterior = &normal / factor;
    priors.add_to(nominal, &model, &parameters, &mut posterior, &mut DVector::zeros(parameters.len()));
    let covariance = uncertainty::covariance(&posterior, &parameters);
    let identifiability = identify(&model, &data.postures, &parameters, &normal);
    let estimates = uncertainty::estimates(nominal, &model, &parameters, &priors.sigmas, &covariance, &identifiability);

    let gate = 4.0 * round.sigma;
    let outliers = residuals.iter().filter(|r| r.abs() > gate).count();
    let outlier_fraction = outliers as f64 / residuals.len() as f64;
    if outlier_fraction > 0.5 {
        warnings.push(Warning::ManyOutliers { fraction: outlier_fraction });
    }
    let mut sizes: Vec<Vec<f64>> = vec![Vec::new(); data.postures.len()];
    let ends = pairs.iter().flat_map(|pair| std::iter::repeat_n((pair.a, pair.b), pair.matches.len()));
    for ((a, b), r) in ends.zip(&residuals) {
        sizes[a].push(r.abs());
        sizes[b].push(r.abs());
    }
    let postures = sizes
        .iter_mut()
        .map(|sizes| PostureFit {
            observations: sizes.len(),
            outliers: sizes.iter().filter(|size| **size > gate).count(),
            median_sigmas: median(sizes) / round.sigma,
        })
        .collect();
    // The pixels without distortion serve the calibrated rig too if its camera is still the same.
    let epipolar_after = if model.rig.color == nominal.color && pairs.len() == data.pairs.len() {
        undistorted.statistics(&model.rig, &motion.poses(&model, &[])?)
    } else {
        epipolar_statistics(&model, data)?
    };
    Ok(Calibration {
        parameters: estimates,
        covariance: Some(covariance),
        identifiability: Some(identifiability),
        epipolar_before: undistorted.statistics(nominal, &nominal_poses),
        epipolar_after,
        reprojection_before: None,
        reprojection_after: None,
        noise: Noise { pixel: round.sigma, outlier_fraction, ..Noise::default() },
        postures,
        posterior: None,
        ruler: None,
        prior_scales: Vec::new(),
        posture_errors: Vec::new(),
        posture_error_knowledge: None,
        error_patterns: Vec::new(),
        termination: Termination {
            reason,
            iterations: effort.iterations,
            evaluations: effort.evaluations,
            rounds: effort.rounds,
            initial_cost,
            final_cost,
        },
        warnings,
        model,
    })
}

/// The selection without what Sampson distances do not use: depth.
fn free_parameters(free: &Free, nominal: &Rig, motion: &CameraKinematics) -> Result<Vec<Parameter>, CalibrationError> {
    let mut parameters = free.candidates(nominal, motion.has_joints(), false)?;
    let blind = |p: &Parameter| !p.moves_camera() && !matches!(p, Parameter::Intrinsic(_));
    if free.is_open() {
        parameters.retain(|parameter| !blind(parameter));
    }
    if let Some(&parameter) = parameters.iter().find(|p| blind(p)) {
        let reason = "epipolar distances depend on neither depth nor board; use the bundle adjustment".to_owned();
        return Err(CalibrationError::NoSuchParameter { parameter, reason });
    }
    if parameters.is_empty() {
        return Err(CalibrationError::NothingFree);
    }
    Ok(parameters)
}

fn dof_factor(residuals: usize, parameters: usize) -> f64 {
    (residuals as f64 / residuals.saturating_sub(parameters).max(1) as f64).sqrt()
}

/// By how much the covariance of an M-estimator exceeds the inverse of its weighted normal matrix:
/// `mean(psi^2) mean(w) / mean(psi')^2` (Huber and Ronchetti, section 7.6).
fn efficiency_factor(residuals: &[f64], loss: Loss, sigma: f64) -> f64 {
    let (mut psi2, mut weight, mut curvature) = (0.0, 0.0, 0.0);
    for r in residuals {
        let u = r / sigma;
        let w = loss.weight(u);
        psi2 += (w * u).powi(2);
        weight += w;
        curvature += loss.curvature(u);
    }
    if curvature <= 0.0 || weight <= 0.0 { 1.0 } else { psi2 * weight / (curvature * curvature) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        Errors, Sensing, camera_error, diverse_postures, fresh_pairs, half_pixel, hp3j, manufacture, neighbours,
        paper_postures, perturbed, seeded,
    };
    use crate::{MountComponent, UnobservableCause};

    fn one_degree() -> Errors {
        Errors { angle: 1f64.to_radians(), length: 0.0, mount_angle: 0.0, mount_length: 0.0, fixed_size: true }
    }

    fn paper_data(truth: &Rig, sensing: Sensing, per_pair: usize, seed: u64) -> Correspondences {
        let postures = paper_postures(&hp3j());
        let pairs = fresh_pairs(truth, &postures, &neighbours(73), per_pair, sensing, &mut seeded(seed));
        Correspondences { postures, pairs, ..Default::default() }
    }

    fn angles() -> PairwiseOptions {
        PairwiseOptions { free: Free::Angles, ..Default::default() }
    }

    fn worst_deg(result: &Calibration, truth: &Rig) -> f64 {
        let truth = Model::new(truth.clone());
        let error = |e: &crate::ParameterEstimate| (e.value - truth.value(&hp3j(), e.parameter).unwrap()).abs();
        result.parameters.iter().map(error).fold(0.0, f64::max).to_degrees()
    }

    #[test]
    fn exact_data_are_fitted_exactly() {
        let truth = perturbed(&hp3j(), &Free::Angles, one_degree(), &mut seeded(1));
        let data = paper_data(&truth, Sensing { sigma_px: 0.0, ..half_pixel() }, 30, 1);
        let result = calibrate_pairwise(&hp3j(), &data, &angles()).unwrap();
        assert!(worst_deg(&result, &truth) < 1e-7, "{}: {}", worst_deg(&result, &truth), result.termination);
        assert!(result.epipolar_after.rms_px < 1e-6);
        assert_eq!(result.identifiability.unwrap().rank, 10);
    }

    #[test]
    fn forty_percent_of_outliers_do_not_move_it() {
        let truth = perturbed(&hp3j(), &Free::Angles, one_degree(), &mut seeded(2));
        let clean = paper_data(&truth, half_pixel(), 100, 3);
        let dirty = paper_data(&truth, Sensing { outliers: 0.4, ..half_pixel() }, 167, 3);
        let of_clean = calibrate_pairwise(&hp3j(), &clean, &angles()).unwrap();
        let of_dirty = calibrate_pairwise(&hp3j(), &dirty, &angles()).unwrap();
        assert!(worst_deg(&of_clean, &truth) < 0.05);
        assert!(worst_deg(&of_dirty, &truth) < 0.06, "{}", worst_deg(&of_dirty, &truth));
        assert!((of_dirty.noise.pixel - 0.5).abs() < 0.05, "{:?}", of_dirty.noise);
        assert!((of_dirty.noise.outlier_fraction - 0.4).abs() < 0.05, "{:?}", of_dirty.noise);
        assert!((of_clean.noise.pixel - 0.5).abs() < 0.02, "{:?}", of_clean.noise);
    }

    #[test]
    fn all_free_without_priors_names_gauge_and_scale() {
        let mut rng = seeded(4);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 40, &mut rng);
        let all: Vec<(usize, usize)> = (0..40).flat_map(|a| (a + 1..40).map(move |b| (a, b))).collect();
        let pairs = fresh_pairs(&truth, &postures, &all, 10, half_pixel(), &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let free = Free::parse("arm,mount", &hp3j()).unwrap();
        let options = PairwiseOptions { free, priors: PriorPolicy::Never, ..Default::default() };
        let result = calibrate_pairwise(&hp3j(), &data, &options).unwrap();
        let identifiability = result.identifiability.as_ref().unwrap();
        assert_eq!(
            identifiability.rank, 23,
            "30 less 6 of the gauge and the scale: {:?}",
            identifiability.singular_values
        );
        let causes = |cause| identifiability.unobservable.iter().filter(|direction| direction.cause == cause).count();
        let reasons: Vec<_> = identifiability.unobservable.iter().map(|direction| &direction.reason).collect();
        assert_eq!(causes(UnobservableCause::BaseGauge), 4, "{reasons:#?}");
        assert_eq!(causes(UnobservableCause::ToolGauge), 2, "{reasons:#?}");
        assert_eq!(causes(UnobservableCause::Scale), 1, "{reasons:#?}");
        let theta_6 = result.parameters.iter().find(|e| e.parameter.to_string() == "theta_offset_6").unwrap();
        assert_eq!(theta_6.sigma, None);
        assert!(theta_6.note.as_ref().unwrap().contains("mount"), "{theta_6:?}");
    }

    #[test]
    fn flange_poses_give_the_mount() {
        let mut rng = seeded(6);
        let mut nominal = hp3j();
        let robot = nominal.robot.take().unwrap();
        let mut postures = diverse_postures(&hp3j(), 12, &mut rng);
        for posture in &mut postures {
            let skclam_rig::PostureState::Joints(joints) = &posture.state else { panic!() };
            posture.state = skclam_rig::PostureState::FlangePose(robot.base_from_flange(joints).unwrap());
        }
        let mut truth = nominal.clone();
        truth.flange_from_color.translation.vector.x += 0.01;
        truth.flange_from_color *= nalgebra::UnitQuaternion::from_euler_angles(0.03, -0.02, 0.05);
        truth.color.fx += 4.0;
        let all: Vec<(usize, usize)> = (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))).collect();
        let pairs = fresh_pairs(&truth, &postures, &all, 40, half_pixel(), &mut rng);
        let data = Correspondences { postures: postures.clone(), pairs, ..Default::default() };
        let free = Free::parse("mount,focal", &nominal).unwrap();
        let result = calibrate_pairwise(&nominal, &data, &PairwiseOptions { free, ..Default::default() }).unwrap();
        assert!(result.warnings.contains(&Warning::FlangePosesOnly));
        assert!(camera_error(&truth, &result.model.rig, &postures) < 1e-3, "{:?}", result.parameters);
        let mount_x = Parameter::Mount(MountComponent::TranslationX);
        let estimate = result.parameters.iter().find(|e| e.parameter == mount_x).unwrap();
        assert!((estimate.value - truth.flange_from_color.translation.vector.x).abs() < 5.0 * estimate.sigma.unwrap());
        let arm = Free::Angles;
        assert!(calibrate_pairwise(&nominal, &data, &PairwiseOptions { free: arm, ..Default::default() }).is_err());
    }

    #[test]
    fn one_thread_or_two_give_the_same_bytes() {
        let truth = perturbed(&hp3j(), &Free::Angles, one_degree(), &mut seeded(7));
        let data = paper_data(&truth, half_pixel(), 100, 7);
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| calibrate_pairwise(&hp3j(), &data, &angles()).unwrap())
        };
        assert_eq!(on(1), on(2));
    }
}
