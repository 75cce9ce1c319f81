//! The paper's estimator (section 3.3): Eq. (7) minimised by Nelder-Mead.
//!
//! One simplex does not reach the minimum: it flattens and stalls, and by the spread of its values alone it looks
//! converged (at 500 iterations the angles are still more than a degree off). So each simplex runs until its values
//! agree to `simplex_tolerance`, then a fresh one is spread around its best vertex: along the axes at first, then along
//! other orthogonal directions, because a kink of the unsquared distances that stops one simplex lets another pass. The
//! search ends when several restarts in a row gain less than `restart_tolerance` of the value.

use crate::camera_kinematics::CameraKinematics;
use crate::error_function::{UndistortedPairs, epipolar_statistics};
use crate::{
    Calibration, CalibrationError, Correspondences, Free, Model, Noise, Parameter, ParameterEstimate, StopReason,
    Termination, Unit,
};
use argmin::core::{CostFunction, Error, Executor, State};
use argmin::solver::neldermead::NelderMead;
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};
use skclam_rig::Rig;
use std::cell::Cell;

/// Settings of the paper's estimator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NelderMeadOptions {
    /// What is free; the paper's ten angles (section 3.1).
    pub free: Free,
    /// First edge of the simplex for angles, degrees.
    pub angle_step_deg: f64,
    /// First edge for lengths, millimetres.
    pub length_step_mm: f64,
    /// Iterations of one simplex at most.
    pub max_iterations: u64,
    /// Simplexes at most.
    pub max_restarts: usize,
    /// A simplex has settled when the standard deviation of its values falls below this fraction of the value.
    pub simplex_tolerance: f64,
    /// The search has ended when a fresh simplex gains less than this fraction of the value.
    pub restart_tolerance: f64,
}

impl Default for NelderMeadOptions {
    fn default() -> Self {
        NelderMeadOptions {
            free: Free::Angles,
            angle_step_deg: 1.0,
            length_step_mm: 2.0,
            max_iterations: 3000,
            max_restarts: 40,
            simplex_tolerance: 1e-9,
            restart_tolerance: 1e-6,
        }
    }
}

/// Tolerances are relative to the value of Eq. (7), but never to less than this: exact data have the value 0.
const NO_ERROR_PX: f64 = 1e-3;

/// Edges of the simplexes, in turn, in units of the options' steps: long ones leave shallow local minima.
const EDGES: [f64; 4] = [1.0, -1.0, 3.0, -0.3];

/// Restarts without gain after which the search has ended.
const IDLE_RESTARTS: usize = 3;

/// Orthonormal columns: the axes in the first two rounds, then others that depend on the round alone.
fn simplex_directions(count: usize, round: usize) -> DMatrix<f64> {
    if round < 2 {
        return DMatrix::identity(count, count);
    }
    // Splitmix64: any fixed sequence without structure will do.
    let mut state = round as u64;
    let mut next = || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) as f64 / u64::MAX as f64 - 0.5
    };
    DMatrix::from_fn(count, count, |_, _| next()).qr().q()
}

struct Problem<'a> {
    nominal: &'a Model,
    parameters: &'a [Parameter],
    scales: &'a [f64],
    motion: &'a CameraKinematics,
    pairs: &'a UndistortedPairs,
    evaluations: &'a Cell<usize>,
}

impl CostFunction for Problem<'_> {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, unscaled: &Vec<f64>) -> Result<f64, Error> {
        self.evaluations.set(self.evaluations.get() + 1);
        let delta: Vec<f64> = unscaled.iter().zip(self.scales).map(|(x, scale)| x * scale).collect();
        let model = self.nominal.stepped(self.parameters, &delta)?;
        let poses = self.motion.poses(&model, &[])?;
        Ok(self.pairs.error_function(&model.rig, &poses))
    }
}

/// Minimises Eq. (7) over the free parameters of arm and mount. It has no covariance and uses no priors.
pub fn calibrate_nelder_mead(
    nominal: &Rig,
    data: &Correspondences,
    options: &NelderMeadOptions,
) -> Result<Calibration, CalibrationError> {
    data.check()?;
    let start = Model::new(nominal.clone());
    let motion = CameraKinematics::new(nominal, &data.postures)?;
    let mut parameters = options.free.candidates(nominal, motion.has_joints(), false)?;
    if options.free.is_open() {
        parameters.retain(|parameter| parameter.moves_camera());
    }
    if let Some(&parameter) = parameters.iter().find(|parameter| !parameter.moves_camera()) {
        let reason = "Eq. (7) is minimised over what moves the camera".to_owned();
        return Err(CalibrationError::NoSuchParameter { parameter, reason });
    }
    if parameters.is_empty() {
        return Err(CalibrationError::NothingFree);
    }
    let mut warnings = Vec::new();
    let poses = motion.poses(&start, &[])?;
    let pairs = UndistortedPairs::new(nominal, data, &poses, &mut warnings);
    let need = parameters.len();
    if pairs.matches < need {
        let what = "pair matches".to_owned();
        return Err(CalibrationError::TooFew { what, need, got: pairs.matches, parameters: parameters.len() });
    }
    let scales: Vec<f64> = parameters
        .iter()
        .map(|parameter| match parameter.unit() {
            Unit::Radian => options.angle_step_deg.to_radians(),
            Unit::Metre => options.length_step_mm * 1e-3,
            _ => parameter.scale(),
        })
        .collect();
    let evaluations = Cell::new(0);
    let problem = || Problem {
        nominal: &start,
        parameters: &parameters,
        scales: &scales,
        motion: &motion,
        pairs: &pairs,
        evaluations: &evaluations,
    };
    let failed = |error: Error| match error.downcast::<CalibrationError>() {
        Ok(error) => error,
        Err(_) => CalibrationError::Singular { parameters: parameters.len() },
    };
    let initial_cost = problem().cost(&vec![0.0; need]).map_err(failed)?;
    let (mut best, mut cost) = (vec![0.0; need], initial_cost);
    let (mut iterations, mut rounds) = (0, 0);
    let (mut edge, mut idle) = (EDGES[0], 0);
    let reason = loop {
        let mut simplex = vec![best.clone()];
        let directions = simplex_directions(need, rounds);
        simplex.extend(directions.column_iter().map(|direction| {
            best.iter().zip(direction.iter()).map(|(value, component)| value + edge * component).collect()
        }));
        let tolerance = options.simplex_tolerance * cost.max(NO_ERROR_PX);
        let solver = NelderMead::new(simplex).with_sd_tolerance(tolerance).map_err(failed)?;
        let result = Executor::new(problem(), solver)
            .configure(|state| state.max_iters(options.max_iterations))
            .run()
            .map_err(failed)?;
        let state = result.state();
        iterations += state.get_iter() as usize;
        rounds += 1;
        let found = state.get_best_cost();
        let relative_improvement = (cost - found) / cost.max(NO_ERROR_PX);
        if let Some(vertex) = state.get_best_param().filter(|_| found < cost) {
            best.clone_from(vertex);
            cost = found;
        }
        if relative_improvement < options.restart_tolerance && idle >= IDLE_RESTARTS {
            let threshold = options.restart_tolerance;
            break StopReason::RestartsConverged { relative_improvement: relative_improvement.max(0.0), threshold };
        }
        if rounds >= options.max_restarts {
            break StopReason::IterationLimit { limit: options.max_restarts * options.max_iterations as usize };
        }
        idle = if relative_improvement < options.restart_tolerance { idle + 1 } else { 0 };
        edge = EDGES[rounds % EDGES.len()];
    };
    let delta: Vec<f64> = best.iter().zip(&scales).map(|(x, scale)| x * scale).collect();
    let model = start.stepped(&parameters, &delta)?;
    let estimates = parameters.iter().map(|&parameter| ParameterEstimate {
        parameter,
        nominal: start.value(nominal, parameter).unwrap_or_default(),
        value: model.value(nominal, parameter).unwrap_or_default(),
        sigma: None,
        note: Some("Nelder-Mead has no covariance".to_owned()),
    });
    let epipolar_after = epipolar_statistics(&model, data)?;
    Ok(Calibration {
        parameters: estimates.collect(),
        covariance: None,
        identifiability: None,
        epipolar_before: pairs.statistics(nominal, &poses),
        epipolar_after,
        reprojection_before: None,
        reprojection_after: None,
        noise: Noise { pixel: epipolar_after.median_sampson_px * 1.4826, ..Noise::default() },
        postures: Vec::new(),
        posterior: None,
        ruler: None,
        prior_scales: Vec::new(),
        posture_errors: Vec::new(),
        posture_error_knowledge: None,
        error_patterns: Vec::new(),
        termination: Termination {
            reason,
            iterations,
            evaluations: evaluations.get(),
            rounds,
            initial_cost,
            final_cost: cost,
        },
        warnings,
        model,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        Errors, Sensing, camera_error, diverse_postures, fresh_pairs, half_pixel, hp3j, neighbours, paper_postures,
        perturbed, seeded,
    };

    fn one_degree() -> Errors {
        Errors { angle: 1f64.to_radians(), length: 0.0, mount_angle: 0.0, mount_length: 0.0, fixed_size: true }
    }

    #[test]
    fn the_papers_problem_is_solved_to_the_bottom() {
        let nominal = hp3j();
        let mut rng = seeded(11);
        let truth = perturbed(&nominal, &Free::Angles, one_degree(), &mut rng);
        let postures = paper_postures(&nominal);
        let exact = Sensing { sigma_px: 0.0, ..half_pixel() };
        let pairs = fresh_pairs(&truth, &postures, &neighbours(73), 30, exact, &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let result = calibrate_nelder_mead(&nominal, &data, &NelderMeadOptions::default()).unwrap();
        assert!(result.termination.reason.is_converged(), "{}", result.termination);
        for estimate in &result.parameters {
            let expected = Model::new(truth.clone()).value(&nominal, estimate.parameter).unwrap();
            let error_deg = (estimate.value - expected).to_degrees().abs();
            assert!(error_deg < 0.005, "{} is {error_deg} deg off: {}", estimate.parameter, result.termination);
        }
        assert!(result.termination.final_cost < 0.02 * result.termination.initial_cost);
    }

    #[test]
    fn too_few_matches_are_counted() {
        let nominal = hp3j();
        let mut rng = seeded(12);
        let postures = diverse_postures(&nominal, 3, &mut rng);
        let pairs = fresh_pairs(&nominal, &postures, &neighbours(3), 2, half_pixel(), &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let error = calibrate_nelder_mead(&nominal, &data, &NelderMeadOptions::default()).unwrap_err();
        assert!(matches!(error, CalibrationError::TooFew { need: 10, got: 0..=4, .. }), "{error}");
        assert!(camera_error(&nominal, &nominal, &data.postures) < 1e-12);
    }
}
