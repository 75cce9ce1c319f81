//! One minimisation over everything that moves, and the covariance at its end.

use crate::bundle::noise::LossCorrection;
use crate::bundle::observations::Observations;
use crate::bundle::random_effects::PostureErrorModel;
use crate::bundle::reduced::{Chunk, corner_cost, follow, reduce, track_chunks, track_cost};
use crate::bundle::residuals::{ResidualSize, residual_sizes};
use crate::bundle::start::{place_board, triangulate_all};
use crate::bundle::state::{NoiseScales, PostureErrorSigmas, State};
use crate::bundle::unknowns::Unknowns;
use crate::camera_kinematics::CameraKinematics;
use crate::levenberg_marquardt::{
    Minimization, MinimizationLimits, Proposal, damped_solve, minimize, predicted_gain, scaled_norm,
};
use crate::prior::Priors;
use crate::{CalibrationError, Loss, Model, Parameter};
use nalgebra::{DMatrix, DVector};
use skclam_geometry::Point3;
use skclam_rig::Rig;

/// A gain below this, in squared sigmas, means nothing.
const MEANINGLESS_GAIN: f64 = 1e-3;
/// A step of parameters, board and posture errors together that is shorter than this means nothing, however far single
/// points still have to go.
const MEANINGLESS_SIGMAS: f64 = 0.02;

/// All that a minimisation needs besides the state.
pub(crate) struct Adjustment<'a> {
    pub nominal: &'a Rig,
    pub motion: &'a CameraKinematics,
    pub observations: &'a Observations,
    pub parameters: &'a [Parameter],
    pub priors: &'a Priors,
    pub loss: Loss,
    pub noise: NoiseScales,
    /// What the errors of single postures consist of.
    pub errors: &'a PostureErrorModel,
    /// How the loss is weighted against the prior of the posture errors.
    pub balance: LossCorrection,
    /// A parameter that does not move.
    pub held: Option<usize>,
}

impl Adjustment<'_> {
    fn unknowns(&self, state: &State) -> Unknowns<'_> {
        let postures = self.motion.len();
        let components = state.posture_errors.len().checked_div(postures).unwrap_or(0);
        Unknowns { parameters: self.parameters, board: state.base_from_board.is_some(), components, postures }
    }

    fn chunks(&self) -> Vec<Chunk> {
        track_chunks(self.observations)
    }

    fn cost(&self, state: &State, chunks: &[Chunk]) -> f64 {
        let view = state.view(&self.noise, self.loss);
        track_cost(self.observations, chunks, &view, &state.points) + self.cost_beside_tracks(state)
    }

    /// Board corners, posture errors, priors.
    fn cost_beside_tracks(&self, state: &State) -> f64 {
        let view = state.view(&self.noise, self.loss);
        let corners = corner_cost(self.observations, &view, state.placed_board().as_ref());
        let sigma = self.errors.sigma_of(&self.noise.posture);
        let errors: f64 = state.posture_errors.iter().enumerate().map(|(k, error)| (error / sigma(k)).powi(2)).sum();
        corners
            + 0.5 * self.balance.prior_weight * errors
            + self.priors.cost(self.nominal, &state.model, self.parameters)
    }

    /// Adds the prior of the posture errors to `H delta = g` (g: the negative gradient).
    fn add_posture_error_prior(
        &self,
        unknowns: &Unknowns<'_>,
        state: &State,
        normal: &mut DMatrix<f64>,
        gradient: &mut DVector<f64>,
    ) {
        let sigma = self.errors.sigma_of(&self.noise.posture);
        for (k, error) in state.posture_errors.iter().enumerate() {
            let at = unknowns.first_posture_error() + k;
            let weight = self.balance.prior_weight / sigma(k).powi(2);
            normal[(at, at)] += weight;
            gradient[at] -= weight * error;
        }
    }

    /// Minimises until a step gains nothing that means anything.
    pub(crate) fn minimize(
        &self,
        state: State,
        max_iterations: usize,
    ) -> Result<Minimization<State>, CalibrationError> {
        let chunks = self.chunks();
        let cost = self.cost(&state, &chunks);
        let unknowns = self.unknowns(&state);
        let cost_tolerance = (MEANINGLESS_GAIN / cost.max(f64::MIN_POSITIVE)).clamp(1e-13, 1e-6);
        let limits = MinimizationLimits {
            max_iterations,
            cost_tolerance,
            step_tolerance: 1e-11,
            sigma_tolerance: MEANINGLESS_SIGMAS,
        };
        minimize(state, cost, limits, |state, damping| {
            let view = state.view(&self.noise, self.loss);
            let board = state.placed_board();
            let shared = unknowns.shared_free();
            let columns = unknowns.columns(self.motion, state)?;
            let (system, eliminated) =
                reduce(self.observations, &chunks, &view, &state.points, board.as_ref(), shared, damping);
            let (mut normal, mut rhs) = unknowns.assemble(&system, &columns);
            self.priors.add_to(self.nominal, &state.model, self.parameters, &mut normal, &mut rhs);
            self.add_posture_error_prior(&unknowns, state, &mut normal, &mut rhs);
            if let Some(held) = self.held {
                normal.row_mut(held).fill(0.0);
                normal.column_mut(held).fill(0.0);
                rhs[held] = 0.0;
            }
            let step = damped_solve(&normal, &rhs, self.parameters, damping)?;
            let camera_step = unknowns.camera_step(&columns, &step);
            let mut moved = unknowns.stepped(self.motion, state, &step)?;
            let moved_view = moved.view(&self.noise, self.loss);
            let (points, tracks) =
                follow(self.observations, &chunks, &eliminated, &state.points, &camera_step, &moved_view);
            moved.points = points;
            let norm = scaled_norm(self.parameters, &step);
            let own_gain = predicted_gain(&normal, &rhs, &step);
            Ok(Proposal {
                cost: tracks + self.cost_beside_tracks(&moved),
                state: moved,
                // Without parameters only board and points move: the cost decides.
                step: if self.parameters.is_empty() { f64::INFINITY } else { norm },
                sigmas: if self.parameters.is_empty() { f64::INFINITY } else { (2.0 * own_gain.max(0.0)).sqrt() },
                predicted: own_gain + system.point_gain,
            })
        })
    }

    /// Sizes of all residuals at a state.
    pub(crate) fn residual_sizes(&self, state: &State) -> Vec<ResidualSize> {
        let view = state.view(&self.noise, self.loss);
        residual_sizes(self.observations, &self.chunks(), &view, &state.points, state.placed_board().as_ref())
    }

    /// [`Adjustment::normal_equations`] without the gradient.
    pub(crate) fn normal_matrix(
        &self,
        state: &State,
        sigmas: &PostureErrorSigmas,
    ) -> Result<DMatrix<f64>, CalibrationError> {
        Ok(self.normal_equations(state, sigmas)?.0)
    }

    /// Normal matrix and negative gradient of the data by all unknowns, points eliminated, less what the loss wastes of
    /// them; with the prior of the posture errors for some sigmas, without those of the parameters.
    pub(crate) fn normal_equations(
        &self,
        state: &State,
        sigmas: &PostureErrorSigmas,
    ) -> Result<(DMatrix<f64>, DVector<f64>), CalibrationError> {
        let unknowns = self.unknowns(state);
        let view = state.view(&self.noise, self.loss);
        let board = state.placed_board();
        let columns = unknowns.columns(self.motion, state)?;
        let shared = unknowns.shared_free();
        let chunks = self.chunks();
        let (system, _) = reduce(self.observations, &chunks, &view, &state.points, board.as_ref(), shared, 0.0);
        let (normal, gradient) = unknowns.assemble(&system, &columns);
        let mut normal = normal / self.balance.efficiency_factor;
        let mut gradient = gradient / self.balance.efficiency_factor;
        let sigma = self.errors.sigma_of(sigmas);
        for (k, error) in state.posture_errors.iter().enumerate() {
            let at = unknowns.first_posture_error() + k;
            normal[(at, at)] += sigma(k).powi(-2);
            gradient[at] -= sigma(k).powi(-2) * error;
        }
        Ok((normal, gradient))
    }

    #[cfg(test)]
    pub(crate) fn cost_of(&self, state: &State) -> f64 {
        self.cost(state, &self.chunks())
    }

    /// Negative gradient of the reduced cost.
    #[cfg(test)]
    pub(crate) fn rhs_of(&self, state: &State) -> Result<DVector<f64>, CalibrationError> {
        let unknowns = self.unknowns(state);
        let view = state.view(&self.noise, self.loss);
        let columns = unknowns.columns(self.motion, state)?;
        let board = state.placed_board();
        let (system, _) = reduce(
            self.observations,
            &self.chunks(),
            &view,
            &state.points,
            board.as_ref(),
            unknowns.shared_free(),
            0.0,
        );
        Ok(unknowns.assemble(&system, &columns).1)
    }

    /// Points of all tracks under the cameras of `state`; tracks that cannot be triangulated are reported.
    pub(crate) fn triangulate(&self, state: &State) -> Vec<Option<Point3>> {
        triangulate_all(self.observations, &state.view(&self.noise, self.loss), None)
    }
}

/// A state for a model: cameras posed, board placed, no points yet.
pub(crate) fn posed_state(
    model: &Model,
    posture_errors: Vec<f64>,
    motion: &CameraKinematics,
    observations: &Observations,
    noise: &NoiseScales,
    loss: Loss,
) -> Result<State, CalibrationError> {
    let mut state =
        State { model: model.clone(), posture_errors, points: Vec::new(), base_from_board: None, frames: Vec::new() };
    state.refresh_frames(motion)?;
    if !observations.corners.is_empty() {
        state.base_from_board = place_board(observations, &state.view(noise, loss));
    }
    Ok(state)
}

/// Eliminates all unknowns but the first `count`: their normal matrix when the others are free.
pub(crate) fn marginal(normal: &DMatrix<f64>, count: usize) -> DMatrix<f64> {
    let total = normal.nrows();
    let own = normal.view((0, 0), (count, count)).into_owned();
    if total == count {
        return own;
    }
    let cross = normal.view((0, count), (count, total - count)).into_owned();
    let rest = normal.view((count, count), (total - count, total - count)).into_owned();
    match rest.cholesky() {
        Some(factor) => {
            let marginal = own - &cross * factor.solve(&cross.transpose());
            (&marginal + marginal.transpose()) * 0.5
        }
        None => own,
    }
}

/// The same with the negative gradient.
pub(crate) fn marginal_equations(
    normal: &DMatrix<f64>,
    gradient: &DVector<f64>,
    count: usize,
) -> (DMatrix<f64>, DVector<f64>) {
    let total = normal.nrows();
    let own = gradient.rows(0, count).into_owned();
    if total == count {
        return (normal.clone(), own);
    }
    let cross = normal.view((0, count), (count, total - count)).into_owned();
    let rest = normal.view((count, count), (total - count, total - count)).into_owned();
    let Some(factor) = rest.cholesky() else { return (marginal(normal, count), own) };
    let reduced = normal.view((0, 0), (count, count)) - &cross * factor.solve(&cross.transpose());
    let gradient = own - &cross * factor.solve(&gradient.rows(count, total - count).into_owned());
    ((&reduced + reduced.transpose()) * 0.5, gradient)
}

/// The inverse; `None` where it is not positive definite.
pub(crate) fn inverse(normal: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let scale = DVector::from_fn(normal.nrows(), |k, _| 1.0 / normal[(k, k)].max(1e-300).sqrt());
    let scaled = DMatrix::from_fn(normal.nrows(), normal.ncols(), |i, j| {
        normal[(i, j)] * scale[i] * scale[j] + if i == j { 1e-13 } else { 0.0 }
    });
    let mut inverse = scaled.cholesky()?.inverse();
    for (j, mut column) in inverse.column_iter_mut().enumerate() {
        column.iter_mut().zip(scale.iter()).for_each(|(value, s)| *value *= s * scale[j]);
    }
    Some(inverse)
}
