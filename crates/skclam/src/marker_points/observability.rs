//! Which parts of the offsets the points determine. With all postures in one orientation an offset and the frame's
//! translation cannot be separated; with rotations about one axis alone, that axis of the offset.

use super::solve::{FRAME_UNKNOWNS, Observation, Problem, State};
use nalgebra::{DMatrix, DVector, Vector3};

/// A combination of offsets is not observable where moving it by a length moves the points, after the frame has
/// followed, by less than this part of the length (RMS). One hundredth is what a spread of half a degree of the
/// flange's orientation gives.
pub(super) const MIN_SENSITIVITY: f64 = 1e-2;

/// A unit combination of offsets with its sensitivity: metres at the points a metre of the offset.
#[derive(Debug, Clone)]
pub(super) struct OffsetDirection {
    pub direction: DVector<f64>,
    pub sensitivity: f64,
}

/// All combinations of offsets, least observable first.
pub(super) fn offset_directions(observations: &[Observation], used: &[usize], state: &State) -> Vec<OffsetDirection> {
    let ones = vec![Vector3::repeat(1.0); observations.len()];
    let problem = Problem { observations, used, weights: &ones, width_m: None, held: &[] };
    let (normal, _) = problem.normal(state);
    let offsets = 3 * state.offsets_m.len();
    let frame = normal.view((0, 0), (FRAME_UNKNOWNS, FRAME_UNKNOWNS)).into_owned();
    let mixed = normal.view((0, FRAME_UNKNOWNS), (FRAME_UNKNOWNS, offsets)).into_owned();
    let mut reduced = normal.view((FRAME_UNKNOWNS, FRAME_UNKNOWNS), (offsets, offsets)).into_owned();
    reduced -= mixed.transpose() * pseudo_inverse(frame) * &mixed;
    // A marker with n points has n on its diagonal.
    let counts: Vec<f64> = (0..offsets).map(|k| normal[(FRAME_UNKNOWNS + k, FRAME_UNKNOWNS + k)].max(1.0)).collect();
    for row in 0..offsets {
        for column in 0..offsets {
            reduced[(row, column)] /= (counts[row] * counts[column]).sqrt();
        }
    }
    let eigen = reduced.symmetric_eigen();
    let mut directions: Vec<OffsetDirection> = (0..offsets)
        .map(|k| {
            let scaled: Vec<f64> = (0..offsets).map(|row| eigen.eigenvectors[(row, k)] / counts[row].sqrt()).collect();
            let direction = DVector::from_vec(scaled).normalize();
            OffsetDirection { direction, sensitivity: eigen.eigenvalues[k].max(0.0).sqrt() }
        })
        .collect();
    directions.sort_by(|a, b| a.sensitivity.total_cmp(&b.sensitivity));
    directions
}

/// The combinations that the points do not determine.
pub(super) fn unobservable(observations: &[Observation], used: &[usize], state: &State) -> Vec<OffsetDirection> {
    let mut directions = offset_directions(observations, used, state);
    directions.retain(|direction| direction.sensitivity < MIN_SENSITIVITY);
    directions
}

/// Of the frame's block: the rotation is not determined where all points lie on a line.
fn pseudo_inverse(matrix: DMatrix<f64>) -> DMatrix<f64> {
    const CUTOFF: f64 = 1e-10;
    let eigen = matrix.symmetric_eigen();
    let limit = CUTOFF * eigen.eigenvalues.amax();
    let inverted = eigen.eigenvalues.map(|value| if value > limit { 1.0 / value } else { 0.0 });
    &eigen.eigenvectors * DMatrix::from_diagonal(&inverted) * eigen.eigenvectors.transpose()
}
