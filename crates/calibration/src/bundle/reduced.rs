//! Normal equations by camera poses, board pose and shared numbers, after the scene points are eliminated.
//!
//! For a track with point block `V` (3 x 3), pose blocks `U_i` and couplings `W_i` the Schur complement adds `U_i - W_i V^-1 W_i^T` on the diagonal and
//! `-W_i V^-1 W_j^T` off it (Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6.1). Everything a sight adds comes
//! from the 3 x 3 information of its point *in the camera*: a camera twist moves the point by `(-v, x cross omega)`, the point itself by `R^T`.

use crate::bundle::observations::{CornerSighting, Observations, Sighting};
use crate::bundle::triangulate::View;
use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector6};
use rayon::prelude::*;
use skclam_geometry::{INTRINSICS, Isometry3, Point3};

/// Intrinsics, depth offset, depth scale.
pub(crate) const SHARED: usize = INTRINSICS + 2;
pub(crate) const DEPTH_OFFSET: usize = INTRINSICS;
pub(crate) const DEPTH_SCALE: usize = INTRINSICS + 1;

type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
type SharedVector = SVector<f64, SHARED>;
type SharedByTwist = SMatrix<f64, SHARED, 6>;
type SharedByPoint = SMatrix<f64, SHARED, 3>;
type TwistByPoint = SMatrix<f64, 6, 3>;

/// Memory that the partial sums of one pass may take together, bytes.
const PARTIAL_SUMS: usize = 256 << 20;

/// Normal equations whose unknowns are the twists of `postures` cameras, the board's twist and the shared numbers.
#[derive(Debug, Clone)]
pub(crate) struct PoseSystem {
    pub postures: usize,
    /// Blocks (i, j) with i <= j, row by row.
    blocks: Vec<Matrix6<f64>>,
    pub descent: Vec<Vector6<f64>>,
    pub shared_by_pose: Vec<SharedByTwist>,
    pub shared: SharedMatrix,
    pub shared_descent: SharedVector,
    pub board_by_pose: Vec<Matrix6<f64>>,
    pub board: Matrix6<f64>,
    pub board_descent: Vector6<f64>,
    pub shared_by_board: SharedByTwist,
    /// Decrease of the cost that the eliminated points promise by themselves.
    pub point_gain: f64,
}

impl PoseSystem {
    fn new(postures: usize) -> Self {
        PoseSystem {
            postures,
            blocks: vec![Matrix6::zeros(); postures * (postures + 1) / 2],
            descent: vec![Vector6::zeros(); postures],
            shared_by_pose: vec![SharedByTwist::zeros(); postures],
            shared: SharedMatrix::zeros(),
            shared_descent: SharedVector::zeros(),
            board_by_pose: vec![Matrix6::zeros(); postures],
            board: Matrix6::zeros(),
            board_descent: Vector6::zeros(),
            shared_by_board: SharedByTwist::zeros(),
            point_gain: 0.0,
        }
    }

    fn index(&self, i: usize, j: usize) -> usize {
        i * (2 * self.postures - i + 1) / 2 + (j - i)
    }

    /// Block (i, j) of the symmetric matrix.
    pub(crate) fn block(&self, i: usize, j: usize) -> Matrix6<f64> {
        if i <= j { self.blocks[self.index(i, j)] } else { self.blocks[self.index(j, i)].transpose() }
    }

    fn add(&mut self, other: &PoseSystem) {
        fn sum<T: Copy + std::ops::AddAssign>(into: &mut [T], from: &[T]) {
            into.iter_mut().zip(from).for_each(|(a, b)| *a += *b);
        }
        sum(&mut self.blocks, &other.blocks);
        sum(&mut self.descent, &other.descent);
        sum(&mut self.shared_by_pose, &other.shared_by_pose);
        sum(&mut self.board_by_pose, &other.board_by_pose);
        self.shared += other.shared;
        self.shared_descent += other.shared_descent;
        self.board += other.board;
        self.board_descent += other.board_descent;
        self.shared_by_board += other.shared_by_board;
        self.point_gain += other.point_gain;
    }
}

/// One sight, linearised: the point's information in the camera, and what the shared numbers share of it.
struct LinearSight {
    posture: usize,
    /// `J_camera_point^T J`, weights included.
    information: Matrix3<f64>,
    descent: Vector3<f64>,
    in_camera: Point3,
    rotation: Matrix3<f64>,
    /// Coupling of the shared numbers with the point in the camera.
    shared_by_point: SharedByPoint,
}

/// What the shared numbers have of a track by themselves; `None` where none of them is free.
struct SharedSums {
    information: SharedMatrix,
    descent: SharedVector,
}

/// d(point in camera) / d(camera twist) = `[-I, [x]x]`, applied to a 3 x 3 from the left: `C^T M`.
fn twist_transposed(in_camera: &Point3, m: &Matrix3<f64>) -> TwistByPoint {
    let hat = in_camera.coords.cross_matrix();
    let mut out = TwistByPoint::zeros();
    out.fixed_view_mut::<3, 3>(0, 0).copy_from(&-m);
    // [x]x^T = -[x]x.
    out.fixed_view_mut::<3, 3>(3, 0).copy_from(&-(hat * m));
    out
}

/// The same from the right: `M C`.
fn twist_right<const R: usize>(in_camera: &Point3, m: &SMatrix<f64, R, 3>) -> SMatrix<f64, R, 6> {
    let hat = in_camera.coords.cross_matrix();
    let mut out = SMatrix::<f64, R, 6>::zeros();
    out.fixed_view_mut::<R, 3>(0, 0).copy_from(&-m);
    out.fixed_view_mut::<R, 3>(0, 3).copy_from(&(m * hat));
    out
}

fn linearize(
    view: &View<'_>,
    sighting: &Sighting,
    point: &Point3,
    shared: &mut Option<SharedSums>,
) -> Option<LinearSight> {
    let pose = &view.poses[sighting.posture as usize];
    let in_camera = pose.inverse_transform_point(point);
    let projection = view.camera.project_with_jacobian(&in_camera)?;
    let inverse_sigma = 1.0 / view.scales.pixel;
    let residual = sighting.whiten(sighting.pixel - projection.pixel) * inverse_sigma;
    let weight = view.scales.loss.weight(residual.norm());
    let whitener = sighting.whitener() * inverse_sigma;
    let jacobian = whitener * projection.by_point;
    let weighted = jacobian.transpose() * weight;
    let mut information = weighted * jacobian;
    let mut descent = weighted * residual;
    let mut shared_by_point = SharedByPoint::zeros();
    if let Some(shared) = shared {
        let by_intrinsics = whitener * projection.by_intrinsics;
        let weighted = by_intrinsics.transpose() * weight;
        shared_by_point.fixed_rows_mut::<INTRINSICS>(0).copy_from(&(weighted * jacobian));
        let mut own = shared.information.fixed_view_mut::<INTRINSICS, INTRINSICS>(0, 0);
        own += weighted * by_intrinsics;
        let mut pull = shared.descent.fixed_rows_mut::<INTRINSICS>(0);
        pull += weighted * residual;
    }
    if sighting.depth_m > 0.0 {
        let (residual, slope) = view.depth_residual(sighting, in_camera.z);
        let weight = view.scales.loss.weight(residual);
        information[(2, 2)] += weight * slope * slope;
        descent.z += weight * residual * slope;
        if let Some(shared) = shared {
            // The residual grows with the shared numbers where it falls with z.
            let by_offset = -slope;
            let by_scale = -slope * (in_camera.z - view.depth.offset_m) / view.depth.scale;
            for (i, x) in [(DEPTH_OFFSET, by_offset), (DEPTH_SCALE, by_scale)] {
                shared_by_point[(i, 2)] += weight * slope * x;
                shared.descent[i] += weight * residual * x;
                for (j, y) in [(DEPTH_OFFSET, by_offset), (DEPTH_SCALE, by_scale)] {
                    shared.information[(i, j)] += weight * x * y;
                }
            }
        }
    }
    let rotation = *pose.rotation.to_rotation_matrix().matrix();
    Some(LinearSight { posture: sighting.posture as usize, information, descent, in_camera, rotation, shared_by_point })
}

/// A track linearised: its point's block and the couplings of its sights.
struct LinearTrack {
    sights: Vec<(LinearSight, TwistByPoint)>,
    inverse: Matrix3<f64>,
    descent: Vector3<f64>,
    shared_by_point: SharedByPoint,
    shared: Option<SharedSums>,
}

/// `None` where the point's block is singular: the track then says nothing.
fn linearize_track(
    view: &View<'_>,
    track: &[Sighting],
    point: &Point3,
    shared_free: bool,
    damping: f64,
) -> Option<LinearTrack> {
    let mut information = Matrix3::zeros();
    let mut descent = Vector3::zeros();
    let mut shared_by_point = SharedByPoint::zeros();
    let mut shared =
        shared_free.then(|| SharedSums { information: SharedMatrix::zeros(), descent: SharedVector::zeros() });
    let mut sights = Vec::with_capacity(track.len());
    for sighting in track {
        let Some(sight) = linearize(view, sighting, point, &mut shared) else { continue };
        let turned = sight.information * sight.rotation.transpose();
        information += sight.rotation * turned;
        descent += sight.rotation * sight.descent;
        if shared_free {
            shared_by_point += sight.shared_by_point * sight.rotation.transpose();
        }
        let coupling = twist_transposed(&sight.in_camera, &turned);
        sights.push((sight, coupling));
    }
    let damped = information + Matrix3::from_diagonal(&information.diagonal()) * damping;
    let inverse = well_conditioned_inverse(&damped)?;
    Some(LinearTrack { sights, inverse, descent, shared_by_point, shared })
}

/// Inverse of a positive definite 3 x 3; `None` where its smallest eigenvalue is lost beside the greatest.
fn well_conditioned_inverse(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let trace = matrix.trace();
    if matrix.determinant() > 1e-13 * trace * trace * trace { matrix.try_inverse() } else { None }
}

fn add_track(system: &mut PoseSystem, track: &LinearTrack) {
    let inverse = &track.inverse;
    let moved = inverse * track.descent;
    system.point_gain += 0.5 * track.descent.dot(&moved);
    for (k, (sight, coupling)) in track.sights.iter().enumerate() {
        let i = sight.posture;
        let y = coupling * inverse;
        let by_twist = twist_right(&sight.in_camera, &sight.information);
        // C^T (M C) - W V^-1 W^T.
        let mut own = -(y * coupling.transpose());
        let hat = sight.in_camera.coords.cross_matrix();
        let mut top = own.fixed_rows_mut::<3>(0);
        top -= by_twist;
        let mut bottom = own.fixed_rows_mut::<3>(3);
        bottom -= hat * by_twist;
        let at = system.index(i, i);
        system.blocks[at] += own;
        let mut pull = -(coupling * moved);
        let mut top = pull.fixed_rows_mut::<3>(0);
        top -= sight.descent;
        let mut bottom = pull.fixed_rows_mut::<3>(3);
        bottom -= sight.in_camera.coords.cross(&sight.descent);
        system.descent[i] += pull;
        for (other, other_coupling) in &track.sights[k + 1..] {
            let j = other.posture;
            if i < j {
                let at = system.index(i, j);
                system.blocks[at] -= y * other_coupling.transpose();
            } else {
                let at = system.index(j, i);
                system.blocks[at] -= other_coupling * y.transpose();
            }
        }
        if track.shared.is_some() {
            system.shared_by_pose[i] +=
                twist_right(&sight.in_camera, &sight.shared_by_point) - track.shared_by_point * y.transpose();
        }
    }
    if let Some(shared) = &track.shared {
        let y = track.shared_by_point * inverse;
        system.shared += shared.information - y * track.shared_by_point.transpose();
        system.shared_descent += shared.descent - track.shared_by_point * moved;
    }
}

fn add_corner(
    system: &mut PoseSystem,
    view: &View<'_>,
    base_from_board: &Isometry3,
    corner: &CornerSighting,
    shared_free: bool,
) {
    let point = base_from_board * corner.point_in_board;
    let mut shared =
        shared_free.then(|| SharedSums { information: SharedMatrix::zeros(), descent: SharedVector::zeros() });
    let Some(sight) = linearize(view, &corner.sighting, &point, &mut shared) else { return };
    let i = sight.posture;
    // d(point in camera) / d(camera twist) and / d(board twist).
    let by_camera = twist_right(&sight.in_camera, &Matrix3::identity());
    let turned = sight.rotation.transpose() * base_from_board.rotation.to_rotation_matrix().matrix();
    let mut by_board = SMatrix::<f64, 3, 6>::zeros();
    by_board.fixed_view_mut::<3, 3>(0, 0).copy_from(&turned);
    by_board.fixed_view_mut::<3, 3>(0, 3).copy_from(&-(turned * corner.point_in_board.coords.cross_matrix()));
    let (m_camera, m_board) = (sight.information * by_camera, sight.information * by_board);
    let at = system.index(i, i);
    system.blocks[at] += by_camera.transpose() * m_camera;
    system.descent[i] += by_camera.transpose() * sight.descent;
    system.board += by_board.transpose() * m_board;
    system.board_descent += by_board.transpose() * sight.descent;
    system.board_by_pose[i] += by_board.transpose() * m_camera;
    if let Some(shared) = &shared {
        system.shared_by_pose[i] += sight.shared_by_point * by_camera;
        system.shared_by_board += sight.shared_by_point * by_board;
        system.shared += shared.information;
        system.shared_descent += shared.descent;
    }
}

/// Ranges of tracks of about equal work, the same for any number of threads.
pub(crate) fn track_chunks(observations: &Observations) -> Vec<(usize, usize)> {
    let blocks = observations.postures * (observations.postures + 1) / 2 * size_of::<Matrix6<f64>>();
    let count = (PARTIAL_SUMS / blocks.max(1)).clamp(2, 32);
    let work = |track: usize| {
        let sights = observations.track(track).len();
        sights * (sights + 10)
    };
    let total: usize = (0..observations.track_count()).map(work).sum();
    let share = total.div_ceil(count).max(1);
    let mut chunks = Vec::new();
    let (mut from, mut sum) = (0, 0);
    for track in 0..observations.track_count() {
        sum += work(track);
        if sum >= share {
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
    chunks: &[(usize, usize)],
    view: &View<'_>,
    points: &[Point3],
    base_from_board: Option<&Isometry3>,
    shared_free: bool,
    damping: f64,
) -> PoseSystem {
    let partial = |&(from, to): &(usize, usize)| {
        let mut system = PoseSystem::new(observations.postures);
        for (track, point) in (from..to).zip(&points[from..to]) {
            if let Some(linear) = linearize_track(view, observations.track(track), point, shared_free, damping) {
                add_track(&mut system, &linear);
            }
        }
        system
    };
    let partial: Vec<PoseSystem> = chunks.par_iter().map(partial).collect();
    let mut system = PoseSystem::new(observations.postures);
    partial.iter().for_each(|part| system.add(part));
    if let Some(base_from_board) = base_from_board {
        for corner in &observations.corners {
            add_corner(&mut system, view, base_from_board, corner, shared_free);
        }
    }
    system
}

/// How the cameras and the shared numbers move in a step.
pub(crate) struct CameraStep {
    pub twists: Vec<Vector6<f64>>,
    pub shared: Option<SharedVector>,
}

/// Points after a step of cameras and shared numbers: `V^-1 (g - sum W_i^T xi_i - W_s^T s)`.
pub(crate) fn substitute_back(
    observations: &Observations,
    chunks: &[(usize, usize)],
    view: &View<'_>,
    points: &[Point3],
    step: &CameraStep,
    damping: f64,
) -> Vec<Point3> {
    let of_track = |track: usize| {
        let point = points[track];
        let linear = linearize_track(view, observations.track(track), &point, step.shared.is_some(), damping);
        linear.map_or(point, |linear| {
            let mut right = linear.descent;
            for (sight, coupling) in &linear.sights {
                right -= coupling.transpose() * step.twists[sight.posture];
            }
            if let Some(shared) = &step.shared {
                right -= linear.shared_by_point.transpose() * shared;
            }
            point + linear.inverse * right
        })
    };
    let moved: Vec<Vec<Point3>> = chunks.par_iter().map(|&(from, to)| (from..to).map(of_track).collect()).collect();
    moved.concat()
}

/// Robust cost of all sights.
pub(crate) fn total_cost(
    observations: &Observations,
    chunks: &[(usize, usize)],
    view: &View<'_>,
    points: &[Point3],
    base_from_board: Option<&Isometry3>,
) -> f64 {
    let of_chunk = |&(from, to): &(usize, usize)| -> f64 {
        (from..to).map(|track| view.cost(observations.track(track), &points[track])).sum()
    };
    let tracks: f64 = chunks.par_iter().map(of_chunk).collect::<Vec<f64>>().iter().sum();
    let corners: f64 = base_from_board.map_or(0.0, |base_from_board| {
        let cost = |corner: &CornerSighting| view.cost_of(&corner.sighting, &(base_from_board * corner.point_in_board));
        observations.corners.iter().map(cost).sum()
    });
    tracks + corners
}

/// Size and leverage of one sight's residuals.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ResidualSize {
    pub posture: u32,
    /// Distance in px as seen, not whitened.
    pub distance_px: f64,
    /// Norm of the whitened pixel residual in sigmas; infinite behind the camera.
    pub pixel: f64,
    /// Its two degrees of freedom less what its own point takes.
    pub pixel_freedom: f64,
    /// Depth residual in sigmas and what is left of its degree of freedom.
    pub depth: Option<(f64, f64)>,
}

/// All residuals, tracks first, then board corners.
pub(crate) fn residual_sizes(
    observations: &Observations,
    chunks: &[(usize, usize)],
    view: &View<'_>,
    points: &[Point3],
    base_from_board: Option<&Isometry3>,
) -> Vec<ResidualSize> {
    let size = |sighting: &Sighting, point: &Point3, spread: &Matrix3<f64>| {
        let pose = &view.poses[sighting.posture as usize];
        let in_camera = pose.inverse_transform_point(point);
        let Some(projection) = view.camera.project_with_jacobian(&in_camera) else {
            return ResidualSize {
                posture: sighting.posture,
                distance_px: f64::INFINITY,
                pixel: f64::INFINITY,
                pixel_freedom: 2.0,
                depth: None,
            };
        };
        let difference = sighting.pixel - projection.pixel;
        let residual = sighting.whiten(difference) / view.scales.pixel;
        let rotation = pose.rotation.to_rotation_matrix();
        let in_frame = rotation.matrix().transpose() * spread * rotation.matrix();
        let jacobian = sighting.whitener() * projection.by_point / view.scales.pixel;
        let weight = view.scales.loss.weight(residual.norm());
        let leverage = (jacobian * in_frame * jacobian.transpose()).trace() * weight;
        let depth = (sighting.depth_m > 0.0).then(|| {
            let (u, slope) = view.depth_residual(sighting, in_camera.z);
            let leverage = view.scales.loss.weight(u) * in_frame[(2, 2)] * slope * slope;
            (u, (1.0 - leverage).clamp(0.0, 1.0))
        });
        ResidualSize {
            posture: sighting.posture,
            distance_px: difference.norm(),
            pixel: residual.norm(),
            pixel_freedom: (2.0 - leverage).clamp(0.0, 2.0),
            depth,
        }
    };
    let of_chunk = |&(from, to): &(usize, usize)| -> Vec<ResidualSize> {
        let mut sizes = Vec::new();
        for (track, point) in (from..to).zip(&points[from..to]) {
            let sightings = observations.track(track);
            let spread = linearize_track(view, sightings, point, false, 0.0)
                .map_or_else(Matrix3::zeros, |linear| linear.inverse);
            sizes.extend(sightings.iter().map(|sighting| size(sighting, point, &spread)));
        }
        sizes
    };
    let mut sizes = chunks.par_iter().map(of_chunk).collect::<Vec<_>>().concat();
    if let Some(base_from_board) = base_from_board {
        sizes.extend(
            observations
                .corners
                .iter()
                .map(|corner| size(&corner.sighting, &(base_from_board * corner.point_in_board), &Matrix3::zeros())),
        );
    }
    sizes
}
