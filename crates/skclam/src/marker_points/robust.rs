//! The global and robust fit: many starting rotations, a loss that bounds what a wrong point can do, and the points
//! beyond it.
//!
//! With its rotation given the problem is linear, so only the rotation needs starts: the one that maps flange positions
//! to measured positions best (Kabsch 1976), turned by each of the 24 rotations of a cube; no rotation is farther than
//! 63 degrees from one of them. Of the minima, the one with the least trimmed squares counts (Rousseeuw 1984), which
//! half the points may contradict.

use super::observability::unobservable;
use super::solve::{FRAME_UNKNOWNS, Observation, Problem, State};
use nalgebra::{DVector, Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Points farther off than this many robust standard deviations are taken for gross errors.
const OUTLIER_SIGMAS: f64 = 6.0;
/// Width of the Cauchy loss in robust standard deviations.
const LOSS_SIGMAS: f64 = 3.0;
/// Median length of a vector of three standard normal numbers.
const MEDIAN_LENGTH: f64 = 1.538_172;
/// No instrument measures better, metres: below it, rounding would decide what is an outlier.
const MIN_SCALE_M: f64 = 1e-6;
/// Starts are tried on at most so many points.
const START_POINTS: usize = 300;

/// A state, and which points contradict it.
#[derive(Debug, Clone)]
pub(super) struct RobustFit {
    pub state: State,
    /// Positions of the observations beyond the limit.
    pub outliers: Vec<usize>,
    /// Combinations of offsets that were held at zero.
    pub held: Vec<DVector<f64>>,
}

/// Fits frame and offsets from scratch.
pub(super) fn fit(observations: &[Observation], markers: usize) -> RobustFit {
    let all: Vec<usize> = (0..observations.len()).collect();
    let few = spread(observations.len());
    let guess = State { tracker_from_base: Isometry3::identity(), offsets_m: vec![Vector3::zeros(); markers] };
    let mut held = directions(observations, &all, &guess);
    // What is observable depends on the offsets where the arm turned about one axis; it settles at once elsewhere.
    const MAX_ROUNDS: usize = 3;
    let mut result = None;
    for _ in 0..MAX_ROUNDS {
        let start = best_start(observations, &few, markers, &held);
        let state = robust(observations, &all, start, &held);
        let fit = trimmed(observations, &all, state, &held);
        let found = directions(observations, &all, &fit.state);
        let settled = found.len() == held.len();
        result = Some(fit);
        if settled {
            break;
        }
        held = found;
    }
    result.unwrap_or(RobustFit { state: guess, outliers: Vec::new(), held })
}

/// Least squares over the used points, from a state nearby.
pub(super) fn least_squares(observations: &[Observation], used: &[usize], fit: &RobustFit) -> State {
    let weights = weights(observations, scale(observations, used, &fit.state)).0;
    let problem = Problem { observations, used, weights: &weights, width_m: None, held: &fit.held };
    problem.minimise(fit.state.clone())
}

fn directions(observations: &[Observation], used: &[usize], state: &State) -> Vec<DVector<f64>> {
    unobservable(observations, used, state).into_iter().map(|found| found.direction).collect()
}

/// Positions over the whole list, at most [`START_POINTS`] of them.
fn spread(count: usize) -> Vec<usize> {
    let taken = count.min(START_POINTS);
    (0..taken).map(|k| k * count / taken).collect()
}

fn best_start(observations: &[Observation], used: &[usize], markers: usize, held: &[DVector<f64>]) -> State {
    let nearest = kabsch(observations, used);
    let candidates = cube_rotations().map(|turn| {
        let rotation = nearest * turn;
        let parts: Vec<Vector3<f64>> = used
            .iter()
            .map(|&at| {
                let observation = &observations[at];
                observation.position_m - rotation * observation.base_from_flange.translation.vector
            })
            .collect();
        let middle = Vector3::from_fn(|axis, _| median(parts.iter().map(|part| part[axis]).collect()));
        let state = State {
            tracker_from_base: Isometry3::from_parts(Translation3::from(middle), rotation),
            offsets_m: vec![Vector3::zeros(); markers],
        };
        let state = robust(observations, used, state, held);
        (trimmed_squares(observations, used, &state), state)
    });
    // Of equals the first, so that the result does not depend on rounding at the end of a search.
    let keep_better = |best: (f64, State), next: (f64, State)| if next.0 < best.0 * (1.0 - 1e-9) { next } else { best };
    let fallback = State { tracker_from_base: Isometry3::identity(), offsets_m: vec![Vector3::zeros(); markers] };
    candidates.reduce(keep_better).map_or(fallback, |(_, state)| state)
}

/// Robust fit with the loss's width drawn in as the fit improves.
fn robust(observations: &[Observation], used: &[usize], mut state: State, held: &[DVector<f64>]) -> State {
    const MAX_ROUNDS: usize = 12;
    let mut before = f64::INFINITY;
    for _ in 0..MAX_ROUNDS {
        let scale_m = scale(observations, used, &state);
        let (weights, unit_m) = weights(observations, scale_m);
        let problem = Problem { observations, used, weights: &weights, width_m: Some(LOSS_SIGMAS * unit_m), held };
        state = problem.minimise(state);
        if (before - scale_m).abs() < 1e-3 * scale_m {
            break;
        }
        before = scale_m;
    }
    state
}

/// Least squares without the points beyond the limit, until these stay the same.
fn trimmed(observations: &[Observation], all: &[usize], mut state: State, held: &[DVector<f64>]) -> RobustFit {
    const MAX_ROUNDS: usize = 20;
    let mut inliers: Vec<usize> = Vec::new();
    for _ in 0..MAX_ROUNDS {
        let (weights, unit_m) = weights(observations, scale(observations, all, &state));
        let limit = (OUTLIER_SIGMAS * unit_m).powi(2);
        let within = |at: &usize| weighted_square(&observations[*at], &state, &weights[*at]) <= limit;
        let found: Vec<usize> = all.iter().copied().filter(within).collect();
        if found == inliers {
            break;
        }
        inliers = found;
        let problem = Problem { observations, used: &inliers, weights: &weights, width_m: None, held };
        state = problem.minimise(state);
    }
    let outliers = all.iter().copied().filter(|at| inliers.binary_search(at).is_err()).collect();
    RobustFit { state, outliers, held: held.to_vec() }
}

fn weighted_square(observation: &Observation, state: &State, weights: &Vector3<f64>) -> f64 {
    let residual = state.residual(observation);
    residual.component_mul(&residual).dot(weights)
}

/// Robust standard deviation of a coordinate, metres.
fn scale(observations: &[Observation], used: &[usize], state: &State) -> f64 {
    let lengths = used.iter().map(|&at| state.residual(&observations[at]).norm()).collect();
    (median(lengths) / MEDIAN_LENGTH).max(MIN_SCALE_M)
}

/// Weights by the instrument's standard deviations where there are any, and the residual that has the weight 1, metres.
///
/// A residual's variance is the instrument's at this point and that of the rig's own errors at all of them; the latter
/// is what `scale_m` leaves after the instrument's median. Without it a rig with errors would be fitted to the best
/// measured points alone.
fn weights(observations: &[Observation], scale_m: f64) -> (Vec<Vector3<f64>>, f64) {
    let known: Vec<f64> =
        observations.iter().filter_map(|observation| Some(observation.sigma_m?.norm_squared() / 3.0)).collect();
    if known.is_empty() {
        return (vec![Vector3::repeat(1.0); observations.len()], scale_m);
    }
    let instrument = median(known);
    let rig = (scale_m * scale_m - instrument).max(0.0);
    let unit = rig + instrument;
    let weight = |observation: &Observation| {
        observation.sigma_m.map_or(Vector3::repeat(1.0), |sigma| sigma.map(|sigma| unit / (rig + sigma * sigma)))
    };
    (observations.iter().map(weight).collect(), unit.sqrt().max(MIN_SCALE_M))
}

/// Mean of the smaller half of the squared residuals.
fn trimmed_squares(observations: &[Observation], used: &[usize], state: &State) -> f64 {
    let unknowns = FRAME_UNKNOWNS + 3 * state.offsets_m.len();
    let mut squares: Vec<f64> = used.iter().map(|&at| state.residual(&observations[at]).norm_squared()).collect();
    squares.sort_by(f64::total_cmp);
    squares.truncate((used.len() + unknowns.div_ceil(3)).div_ceil(2));
    squares.iter().sum::<f64>() / squares.len().max(1) as f64
}

/// The rotation that maps the flange's positions best to the measured ones, as if the marker were at the flange's
/// origin.
fn kabsch(observations: &[Observation], used: &[usize]) -> UnitQuaternion<f64> {
    let count = used.len().max(1) as f64;
    let chosen = || used.iter().map(|&at| &observations[at]);
    let flange: Vector3<f64> =
        chosen().map(|one| one.base_from_flange.translation.vector).sum::<Vector3<f64>>() / count;
    let measured: Vector3<f64> = chosen().map(|one| one.position_m).sum::<Vector3<f64>>() / count;
    let correlation: Matrix3<f64> = chosen()
        .map(|one| (one.position_m - measured) * (one.base_from_flange.translation.vector - flange).transpose())
        .sum();
    let svd = correlation.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return UnitQuaternion::identity() };
    let proper = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * proper * v_t))
}

/// The 24 rotations that map a cube's axes to axes; the identity first.
fn cube_rotations() -> impl Iterator<Item = UnitQuaternion<f64>> {
    const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]];
    ORDERS.into_iter().flat_map(|order| {
        (0..8).filter_map(move |signs| {
            let mut matrix = Matrix3::zeros();
            for (row, &column) in order.iter().enumerate() {
                matrix[(row, column)] = if signs >> row & 1 == 0 { 1.0 } else { -1.0 };
            }
            (matrix.determinant() > 0.0)
                .then(|| UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix)))
        })
    })
}

/// Median; the mean of the middle two of an even number; 0 of none.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    match (values.len(), values.len() / 2) {
        (0, _) => 0.0,
        (count, half) if count % 2 == 1 => values[half],
        (_, half) => 0.5 * (values[half - 1] + values[half]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_rotation_is_far_from_one_of_the_cube() {
        let rotations: Vec<UnitQuaternion<f64>> = cube_rotations().collect();
        assert_eq!(rotations.len(), 24);
        assert!(rotations[0].angle() < 1e-12);
        for (at, turn) in rotations.iter().enumerate() {
            assert!(rotations[..at].iter().all(|other| other.angle_to(turn) > 1.0), "{at} is a duplicate");
        }
    }
}
