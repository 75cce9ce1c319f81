//! Elimination of the scene points: normal equations by cameras, board and shared numbers, and the points that follow a
//! step of those.
//!
//! For a track with point block `V` (3 x 3), pose blocks `U_i` and couplings `W_i` the Schur complement adds `U_i - W_i
//! V^-1 W_i^T` on the diagonal and `-W_i V^-1 W_j^T` off it (Triggs et al., "Bundle adjustment: a modern synthesis",
//! 2000, section 6.1). With `V = L L^T` and the observations' informations `B_i`, `W_i = -T^T B_i` and the products are
//! `Z_i^T Z_j`, `Z_i = L^-1 B_i T`.

use crate::bundle::observations::{CornerObservation, Observation, Observations};
use crate::bundle::pose_system::{PoseSystem, SharedByPoint, SharedVector, TwistRows, by_twist, moved_by};
use crate::bundle::projection_model::{LinearizedObservation, LinearizedShared, ProjectionModel};
use crate::bundle::state::PlacedBoard;
use nalgebra::{Matrix3, Vector3, Vector6};
use rayon::prelude::*;
use skclam_geometry::Point3;

/// Memory that the partial sums of one pass may take together, bytes.
const PARTIAL_SUMS: usize = 256 << 20;

/// A range of tracks.
pub(crate) type Chunk = (usize, usize);

/// A symmetric 3 x 3: xx, xy, xz, yy, yz, zz.
type Symmetric = [f64; 6];

fn packed(m: &Matrix3<f64>) -> Symmetric {
    [m[(0, 0)], m[(0, 1)], m[(0, 2)], m[(1, 1)], m[(1, 2)], m[(2, 2)]]
}

#[inline]
fn times([xx, xy, xz, yy, yz, zz]: &Symmetric, v: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z)
}

/// What is kept of a chunk's tracks until their points follow.
#[derive(Debug, Clone, Default)]
pub(crate) struct Eliminated {
    /// Information of every observation; zero behind the camera.
    observations: Vec<Symmetric>,
    /// `V^-1` of every track; zero where it is singular.
    inverses: Vec<Symmetric>,
    rhs_blocks: Vec<Vector3<f64>>,
    /// Coupling of the shared numbers; empty where none is free.
    shared: Vec<SharedByPoint>,
}

/// How tracks are eliminated, and buffers for one of them, used again for the next.
#[derive(Default)]
struct Workspace {
    shared_free: bool,
    damping: f64,
    observations: Vec<LinearizedObservation>,
    shared: Vec<LinearizedShared>,
    rows: Vec<TwistRows>,
}

/// Point block of a track, damped: inverse of its Cholesky factor and of itself.
struct PointBlock {
    factor_inverse: Matrix3<f64>,
    inverse: Matrix3<f64>,
}

/// `None` where the smallest eigenvalue is lost beside the greatest: the track then carries no information.
fn point_block(normal: &Matrix3<f64>, damping: f64) -> Option<PointBlock> {
    let damped = normal + Matrix3::from_diagonal(&normal.diagonal()) * damping;
    let trace = damped.trace();
    if damped.determinant() <= 1e-13 * trace * trace * trace {
        return None;
    }
    let l = damped.cholesky()?.unpack();
    let (a, b, c) = (1.0 / l[(0, 0)], 1.0 / l[(1, 1)], 1.0 / l[(2, 2)]);
    let d = -l[(1, 0)] * a * b;
    let e = -l[(2, 1)] * b * c;
    let f = -(l[(2, 0)] * a + l[(2, 1)] * d) * c;
    let factor_inverse = Matrix3::new(a, 0.0, 0.0, d, b, 0.0, f, e, c);
    Some(PointBlock { factor_inverse, inverse: factor_inverse.transpose() * factor_inverse })
}

/// Inverse of a track's point block without damping: the covariance of the point when the cameras are fixed.
pub(crate) fn point_covariance(
    view: &ProjectionModel<'_>,
    track: &[Observation],
    point: &Point3,
) -> Option<Matrix3<f64>> {
    let observations = track.iter().filter_map(|observation| view.linearize(observation, point));
    let normal = observations.fold(Matrix3::zeros(), |sum, observation| sum + observation.normal);
    point_block(&normal, 0.0).map(|block| block.inverse)
}

fn add_track(
    system: &mut PoseSystem,
    kept: &mut Eliminated,
    work: &mut Workspace,
    view: &ProjectionModel<'_>,
    track: &[Observation],
    point: &Point3,
) {
    let shared_free = work.shared_free;
    work.observations.clear();
    work.shared.clear();
    work.rows.clear();
    let mut normal = Matrix3::zeros();
    let mut rhs = Vector3::zeros();
    let mut shared_by_point = SharedByPoint::zeros();
    for observation in track {
        let Some(linearized) = view.linearize(observation, point) else {
            kept.observations.push(Symmetric::default());
            continue;
        };
        normal += linearized.normal;
        rhs += linearized.rhs;
        kept.observations.push(packed(&linearized.normal));
        work.observations.push(linearized);
        if shared_free && let Some(shared) = view.linearize_shared(observation, point) {
            shared_by_point += shared.by_point;
            work.shared.push(shared);
        }
    }
    kept.rhs_blocks.push(rhs);
    if shared_free {
        kept.shared.push(shared_by_point);
    }
    let Some(block) = point_block(&normal, work.damping) else {
        kept.inverses.push(Symmetric::default());
        return;
    };
    kept.inverses.push(packed(&block.inverse));
    let moved = block.inverse * rhs;
    system.point_gain += 0.5 * rhs.dot(&moved);
    for (k, observation) in work.observations.iter().enumerate() {
        let rhs_part = observation.rhs - observation.normal * moved;
        system.add_observation(observation.posture, point, &observation.normal, &rhs_part);
        let rows = by_twist(&(block.factor_inverse * observation.normal), point);
        for (other, other_rows) in work.observations[..k].iter().zip(&work.rows) {
            system.subtract(other.posture, other_rows, observation.posture, &rows);
        }
        system.subtract(observation.posture, &rows, observation.posture, &rows);
        work.rows.push(rows);
    }
    if shared_free {
        let by_moved = shared_by_point * block.inverse;
        for (observation, shared) in work.observations.iter().zip(&work.shared) {
            system.subtract_shared(observation.posture, &(shared.by_point - by_moved * observation.normal), point);
            system.shared += shared.normal;
            system.shared_rhs += shared.rhs;
        }
        system.shared -= by_moved * shared_by_point.transpose();
        system.shared_rhs -= shared_by_point * moved;
    }
}

/// Ranges of tracks of about equal work, the same for any number of threads.
pub(crate) fn track_chunks(observations: &Observations) -> Vec<Chunk> {
    let count = (PARTIAL_SUMS / PoseSystem::size(observations.postures).max(1)).clamp(2, 32);
    let work = |track: usize| {
        let observations = observations.track(track).len();
        observations * (observations + 10)
    };
    let total: usize = (0..observations.track_count()).map(work).sum();
    let fraction = total.div_ceil(count).max(1);
    let mut chunks = Vec::new();
    let (mut from, mut sum) = (0, 0);
    for track in 0..observations.track_count() {
        sum += work(track);
        if sum >= fraction {
            chunks.push((from, track + 1));
            (from, sum) = (track + 1, 0);
        }
    }
    if from < observations.track_count() {
        chunks.push((from, observations.track_count()));
    }
    chunks
}

/// Linearises everything and eliminates the points.
pub(crate) fn reduce(
    observations: &Observations,
    chunks: &[Chunk],
    view: &ProjectionModel<'_>,
    points: &[Point3],
    board: Option<&PlacedBoard>,
    shared_free: bool,
    damping: f64,
) -> (PoseSystem, Vec<Eliminated>) {
    let of_chunk = |&(from, to): &Chunk| {
        let mut system = PoseSystem::new(observations.postures);
        let mut kept = Eliminated::default();
        kept.observations.reserve_exact(observations.offsets[to] - observations.offsets[from]);
        kept.inverses.reserve_exact(to - from);
        kept.rhs_blocks.reserve_exact(to - from);
        let mut work = Workspace { shared_free, damping, ..Workspace::default() };
        for (track, point) in (from..to).zip(&points[from..to]) {
            let track = observations.track(track);
            add_track(&mut system, &mut kept, &mut work, view, track, point);
        }
        (system, kept)
    };
    let partial: Vec<(PoseSystem, Eliminated)> = chunks.par_iter().map(of_chunk).collect();
    let mut system = PoseSystem::new(observations.postures);
    let mut eliminated = Vec::with_capacity(partial.len());
    for (part, kept) in partial {
        system.add(&part);
        eliminated.push(kept);
    }
    if let Some(board) = board {
        for corner in &observations.corners {
            system.add_corner(view, board, corner, shared_free);
        }
    }
    (system, eliminated)
}

/// How the cameras (twists in the base frame) and the shared numbers move in a step.
pub(crate) struct CameraStep {
    pub twists: Vec<Vector6<f64>>,
    pub shared: Option<SharedVector>,
}

/// Points after a step of cameras and shared numbers, `V^-1 (g - sum W_i^T xi_i - W_s^T s)`, and the cost of their
/// tracks in the view that the step leads to.
pub(crate) fn follow(
    observations: &Observations,
    chunks: &[Chunk],
    eliminated: &[Eliminated],
    points: &[Point3],
    step: &CameraStep,
    moved_view: &ProjectionModel<'_>,
) -> (Vec<Point3>, f64) {
    let of_chunk = |(&(from, to), kept): (&Chunk, &Eliminated)| {
        let mut moved = Vec::with_capacity(to - from);
        let mut cost = 0.0;
        let mut normals = kept.observations.iter();
        for (at, point) in points[from..to].iter().enumerate() {
            let track = observations.track(from + at);
            let mut right = kept.rhs_blocks[at];
            for (observation, normal) in track.iter().zip(&mut normals) {
                right += times(normal, &moved_by(&step.twists[observation.posture as usize], point));
            }
            if let (Some(shared), Some(coupling)) = (&step.shared, kept.shared.get(at)) {
                right -= coupling.tr_mul(shared);
            }
            let next = point + times(&kept.inverses[at], &right);
            cost += moved_view.cost(track, &next);
            moved.push(next);
        }
        (moved, cost)
    };
    let parts: Vec<(Vec<Point3>, f64)> = chunks.par_iter().zip(eliminated).map(of_chunk).collect();
    let cost = parts.iter().map(|(_, cost)| cost).sum();
    let mut moved = Vec::with_capacity(points.len());
    parts.iter().for_each(|(points, _)| moved.extend_from_slice(points));
    (moved, cost)
}

/// Robust cost of all tracks.
pub(crate) fn track_cost(
    observations: &Observations,
    chunks: &[Chunk],
    view: &ProjectionModel<'_>,
    points: &[Point3],
) -> f64 {
    let of_chunk = |&(from, to): &Chunk| -> f64 {
        (from..to).map(|track| view.cost(observations.track(track), &points[track])).sum()
    };
    chunks.par_iter().map(of_chunk).collect::<Vec<f64>>().iter().sum()
}

/// Robust cost of all board corners.
pub(crate) fn corner_cost(observations: &Observations, view: &ProjectionModel<'_>, board: Option<&PlacedBoard>) -> f64 {
    board.map_or(0.0, |board| {
        let cost = |corner: &CornerObservation| view.cost_of(&corner.observation, &board.point_in_base(corner));
        observations.corners.iter().map(cost).sum()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn point_blocks_are_inverted_and_lines_refused() {
        let v = Matrix3::new(4.0, 0.5, -0.3, 0.5, 3.0, 0.2, -0.3, 0.2, 0.7);
        let block = point_block(&v, 0.0).unwrap();
        assert!((block.inverse * v - Matrix3::identity()).norm() < 1e-14);
        assert!((block.factor_inverse * v * block.factor_inverse.transpose() - Matrix3::identity()).norm() < 1e-14);
        let along = Vector3::new(0.3, 0.5, 1.0);
        assert!(point_block(&(along * along.transpose()), 0.0).is_none());
        let w = Vector3::new(0.4, -0.2, 1.3);
        assert!((times(&packed(&v), &w) - v * w).norm() < 1e-15);
    }
}
