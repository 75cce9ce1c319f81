//! The least-squares problem: a marker at `o` on the flange, measured at `p_i = R (R_i o + t_i) + t`, where `(R_i,
//! t_i)` is `base_from_flange` of the rig and `(R, t)` the unknown `tracker_from_base`.
//!
//! Levenberg-Marquardt with the analytic Jacobian `[-[R y_i]x | I | R R_i]` by a rotation vector in the tracker's
//! frame, `t` and `o`, where `y_i = R_i o + t_i`; every marker has an offset of its own.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix3, SMatrix, UnitQuaternion, Vector3};

/// Unknowns of `tracker_from_base`.
pub(super) const FRAME_UNKNOWNS: usize = 6;

/// One measured point with the flange's pose that a rig gives it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    pub base_from_flange: Isometry3<f64>,
    pub marker: usize,
    /// In the tracker's frame, metres.
    pub position_m: Vector3<f64>,
    /// The instrument's standard deviation a coordinate, metres.
    pub sigma_m: Option<Vector3<f64>>,
}

/// What is fitted.
#[derive(Debug, Clone)]
pub(super) struct State {
    pub tracker_from_base: Isometry3<f64>,
    /// In the flange's frame, metres; one a marker.
    pub offsets_m: Vec<Vector3<f64>>,
}

impl State {
    pub fn residual(&self, observation: &Observation) -> Vector3<f64> {
        let in_base = observation.base_from_flange * nalgebra::Point3::from(self.offsets_m[observation.marker]);
        (self.tracker_from_base * in_base).coords - observation.position_m
    }

    /// Moved by a step in the order of the Jacobian.
    fn moved(&self, step: &DVector<f64>) -> State {
        let mut state = self.clone();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(step[0], step[1], step[2]));
        state.tracker_from_base.rotation = turn * state.tracker_from_base.rotation;
        state.tracker_from_base.rotation.renormalize();
        state.tracker_from_base.translation.vector += Vector3::new(step[3], step[4], step[5]);
        for (marker, offset) in state.offsets_m.iter_mut().enumerate() {
            *offset += step.fixed_rows::<3>(FRAME_UNKNOWNS + 3 * marker);
        }
        state
    }

    /// By rotation, translation and the observation's own offset.
    pub fn jacobian(&self, observation: &Observation) -> SMatrix<f64, 3, 9> {
        let rotation = self.tracker_from_base.rotation;
        let in_base = observation.base_from_flange * nalgebra::Point3::from(self.offsets_m[observation.marker]);
        let by_offset = (rotation * observation.base_from_flange.rotation).to_rotation_matrix();
        let mut jacobian = SMatrix::<f64, 3, 9>::zeros();
        jacobian.fixed_columns_mut::<3>(0).copy_from(&-(rotation * in_base.coords).cross_matrix());
        jacobian.fixed_columns_mut::<3>(3).copy_from(&Matrix3::identity());
        jacobian.fixed_columns_mut::<3>(6).copy_from(by_offset.matrix());
        jacobian
    }
}

/// What is minimised over which points.
pub(super) struct Problem<'a> {
    pub observations: &'a [Observation],
    /// Positions of the used observations.
    pub used: &'a [usize],
    /// Weight of each coordinate of every observation; 1 where all are alike.
    pub weights: &'a [Vector3<f64>],
    /// Cauchy loss with this width, metres; `None`: least squares.
    pub width_m: Option<f64>,
    /// Unit combinations of offsets that the points do not determine; they are held at zero.
    pub held: &'a [DVector<f64>],
}

impl Problem<'_> {
    fn rho(&self, squared: f64) -> (f64, f64) {
        match self.width_m {
            None => (squared, 1.0),
            Some(width) => {
                let scaled = squared / (width * width);
                (width * width * scaled.ln_1p(), 1.0 / (1.0 + scaled))
            }
        }
    }

    fn weighted_square(&self, state: &State, at: usize) -> f64 {
        let residual = state.residual(&self.observations[at]);
        residual.component_mul(&residual).dot(&self.weights[at])
    }

    fn cost(&self, state: &State) -> f64 {
        let points: f64 = self.used.iter().map(|&at| self.rho(self.weighted_square(state, at)).0).sum();
        let offsets = offset_vector(state);
        let held: f64 = self.held.iter().map(|direction| direction.dot(&offsets).powi(2)).sum();
        points + self.used.len() as f64 * held
    }

    /// Normal matrix and gradient.
    pub fn normal(&self, state: &State) -> (DMatrix<f64>, DVector<f64>) {
        let unknowns = FRAME_UNKNOWNS + 3 * state.offsets_m.len();
        let (mut normal, mut gradient) = (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
        for &at in self.used {
            let observation = &self.observations[at];
            let slope = self.rho(self.weighted_square(state, at)).1;
            let jacobian = state.jacobian(observation);
            let weighted = SMatrix::<f64, 3, 3>::from_diagonal(&(self.weights[at] * slope)) * jacobian;
            let block = jacobian.transpose() * weighted;
            let part = weighted.transpose() * state.residual(observation);
            let place = |k: usize| if k < FRAME_UNKNOWNS { k } else { k + 3 * observation.marker };
            for column in 0..9 {
                gradient[place(column)] += part[column];
                for row in 0..9 {
                    normal[(place(row), place(column))] += block[(row, column)];
                }
            }
        }
        let offsets = offset_vector(state);
        let strength = self.used.len() as f64;
        for direction in self.held {
            let mut block = normal.view_mut((FRAME_UNKNOWNS, FRAME_UNKNOWNS), (direction.len(), direction.len()));
            block += strength * direction * direction.transpose();
            let mut rows = gradient.rows_mut(FRAME_UNKNOWNS, direction.len());
            rows += direction * (strength * direction.dot(&offsets));
        }
        (normal, gradient)
    }

    /// The nearest minimum.
    pub fn minimise(&self, start: State) -> State {
        const MAX_ITERATIONS: usize = 100;
        const MAX_DAMPING: f64 = 1e12;
        // Radians and metres: far below what any instrument measures.
        const SHORT_STEP: f64 = 1e-12;
        let (mut state, mut damping) = (start, 1e-4);
        let mut cost = self.cost(&state);
        for _ in 0..MAX_ITERATIONS {
            let (normal, gradient) = self.normal(&state);
            loop {
                let Some(step) = damped_step(&normal, &gradient, damping) else { return state };
                let moved = state.moved(&step);
                let reached = self.cost(&moved);
                if reached <= cost {
                    let done = step.amax() < SHORT_STEP || cost - reached <= 1e-15 * cost;
                    (state, cost, damping) = (moved, reached, (damping * 0.1).max(1e-10));
                    if done {
                        return state;
                    }
                    break;
                }
                damping *= 10.0;
                if damping > MAX_DAMPING {
                    return state;
                }
            }
        }
        state
    }
}

/// All offsets, one after the other.
fn offset_vector(state: &State) -> DVector<f64> {
    DVector::from_iterator(3 * state.offsets_m.len(), state.offsets_m.iter().flat_map(|offset| offset.iter().copied()))
}

/// `None` where no damping makes the matrix definite: then nothing determines a step.
fn damped_step(normal: &DMatrix<f64>, gradient: &DVector<f64>, damping: f64) -> Option<DVector<f64>> {
    let largest = normal.diagonal().amax();
    let mut damped = normal.clone();
    for k in 0..damped.nrows() {
        // A coordinate that moves no point still needs a pivot.
        damped[(k, k)] += damping * normal[(k, k)].max(1e-9 * largest);
    }
    Some(-damped.cholesky()?.solve(gradient))
}
