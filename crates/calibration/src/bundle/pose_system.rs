//! Normal equations whose unknowns are camera twists, the board's twist and the parameters common to all observations.
//!
//! Twists are those of the base frame. With `T(X) = [I, -[X]x]` a camera's twist moves what it sees of a point `X` by
//! `-T xi`, so that an observation of normal matrix `B` adds `T^T B T`, and every block of the Schur complement is a 3
//! x 3 between two `T`.

use crate::bundle::observations::CornerObservation;
use crate::bundle::projection_model::{BOARD_SCALE, ProjectionModel, SHARED};
use crate::bundle::state::PlacedBoard;
use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector6};
use skclam_geometry::Point3;

pub(crate) type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
pub(crate) type SharedVector = SVector<f64, SHARED>;
pub(crate) type SharedByTwist = SMatrix<f64, SHARED, 6>;
pub(crate) type SharedByPoint = SMatrix<f64, SHARED, 3>;

/// Three rows of six: a 3 x 6 laid out for loops over its columns.
pub(crate) type TwistRows = [[f64; 6]; 3];

/// `M T(X)` for a 3 x 3.
#[inline]
pub(crate) fn by_twist(m: &Matrix3<f64>, point: &Point3) -> TwistRows {
    std::array::from_fn(|row| {
        let (a, b, c) = (m[(row, 0)], m[(row, 1)], m[(row, 2)]);
        let (x, y, z) = (point.x, point.y, point.z);
        [a, b, c, y * c - z * b, z * a - x * c, x * b - y * a]
    })
}

/// `M T(X)` for a matrix of three columns.
fn shared_by_twist(m: &SharedByPoint, point: &Point3) -> SharedByTwist {
    let mut out = SharedByTwist::zeros();
    let (x, y, z) = (point.x, point.y, point.z);
    for row in 0..SHARED {
        let (a, b, c) = (m[(row, 0)], m[(row, 1)], m[(row, 2)]);
        let values = [a, b, c, y * c - z * b, z * a - x * c, x * b - y * a];
        values.into_iter().enumerate().for_each(|(column, value)| out[(row, column)] = value);
    }
    out
}

/// `T(X)^T v`.
#[inline]
pub(crate) fn twist_of(v: &Vector3<f64>, point: &Point3) -> Vector6<f64> {
    let turn = point.coords.cross(v);
    Vector6::new(v.x, v.y, v.z, turn.x, turn.y, turn.z)
}

/// How a twist moves a point: `T(X) xi`.
#[inline]
pub(crate) fn moved_by(twist: &Vector6<f64>, point: &Point3) -> Vector3<f64> {
    let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
    v + omega.cross(&point.coords)
}

/// `block -= A^T B`.
#[inline]
fn subtract_product(block: &mut Matrix6<f64>, a: &TwistRows, b: &TwistRows) {
    let columns: &mut [[f64; 6]; 6] = &mut block.data.0;
    for (column, values) in columns.iter_mut().enumerate() {
        let (b0, b1, b2) = (b[0][column], b[1][column], b[2][column]);
        for row in 0..6 {
            values[row] -= a[0][row] * b0 + a[1][row] * b1 + a[2][row] * b2;
        }
    }
}

/// Normal equations of `postures` cameras, a board and the shared numbers.
#[derive(Debug, Clone)]
pub(crate) struct PoseSystem {
    pub postures: usize,
    /// Blocks (i, j) with i <= j, row by row.
    blocks: Vec<Matrix6<f64>>,
    pub rhs: Vec<Vector6<f64>>,
    pub shared_by_pose: Vec<SharedByTwist>,
    pub shared: SharedMatrix,
    pub shared_rhs: SharedVector,
    pub board_by_pose: Vec<Matrix6<f64>>,
    pub board: Matrix6<f64>,
    pub board_rhs: Vector6<f64>,
    pub shared_by_board: SharedByTwist,
    /// Decrease of the cost that the eliminated points promise by themselves.
    pub point_gain: f64,
}

impl PoseSystem {
    pub(crate) fn new(postures: usize) -> Self {
        PoseSystem {
            postures,
            blocks: vec![Matrix6::zeros(); postures * (postures + 1) / 2],
            rhs: vec![Vector6::zeros(); postures],
            shared_by_pose: vec![SharedByTwist::zeros(); postures],
            shared: SharedMatrix::zeros(),
            shared_rhs: SharedVector::zeros(),
            board_by_pose: vec![Matrix6::zeros(); postures],
            board: Matrix6::zeros(),
            board_rhs: Vector6::zeros(),
            shared_by_board: SharedByTwist::zeros(),
            point_gain: 0.0,
        }
    }

    /// Bytes of the blocks of so many postures.
    pub(crate) fn size(postures: usize) -> usize {
        postures * (postures + 1) / 2 * size_of::<Matrix6<f64>>()
    }

    fn index(&self, i: usize, j: usize) -> usize {
        i * (2 * self.postures - i + 1) / 2 + (j - i)
    }

    /// Block (i, j) of the symmetric matrix.
    pub(crate) fn block(&self, i: usize, j: usize) -> Matrix6<f64> {
        if i <= j { self.blocks[self.index(i, j)] } else { self.blocks[self.index(j, i)].transpose() }
    }

    /// What an observation with normal matrix `B` and right-hand side `g` contributes by itself: `T^T B T` and `-T^T
    /// g`.
    #[inline]
    pub(crate) fn add_observation(&mut self, i: usize, point: &Point3, normal: &Matrix3<f64>, rhs: &Vector3<f64>) {
        let [a, b, c] = by_twist(normal, point);
        let (x, y, z) = (point.x, point.y, point.z);
        let at = self.index(i, i);
        for (column, values) in self.blocks[at].data.0.iter_mut().enumerate() {
            let (a, b, c) = (a[column], b[column], c[column]);
            values[0] += a;
            values[1] += b;
            values[2] += c;
            values[3] += y * c - z * b;
            values[4] += z * a - x * c;
            values[5] += x * b - y * a;
        }
        self.rhs[i] -= twist_of(rhs, point);
    }

    /// Takes `A^T B` from block (i, j), whichever of the two comes first.
    #[inline]
    pub(crate) fn subtract(&mut self, i: usize, a: &TwistRows, j: usize, b: &TwistRows) {
        if i <= j {
            let at = self.index(i, j);
            subtract_product(&mut self.blocks[at], a, b);
        } else {
            let at = self.index(j, i);
            subtract_product(&mut self.blocks[at], b, a);
        }
    }

    /// The shared numbers' coupling with a camera through a point: `-C T`.
    pub(crate) fn subtract_shared(&mut self, i: usize, coupling: &SharedByPoint, point: &Point3) {
        self.shared_by_pose[i] -= shared_by_twist(coupling, point);
    }

    /// A board corner, whose point is no unknown of its own.
    pub(crate) fn add_corner(
        &mut self,
        view: &ProjectionModel<'_>,
        board: &PlacedBoard,
        corner: &CornerObservation,
        shared_free: bool,
    ) {
        let base_from_board = &board.base_from_board;
        let in_board = corner.point_in_board * board.scale;
        let point = base_from_board * in_board;
        let Some(observation) = view.linearize(&corner.observation, &point) else { return };
        let i = observation.posture;
        self.add_observation(i, &point, &observation.normal, &observation.rhs);
        // The board's twist in its own frame moves the corner by `R T(corner)`.
        let turned = *base_from_board.rotation.to_rotation_matrix().matrix();
        let by_board = SMatrix::<f64, 3, 6>::from_fn({
            let rows = by_twist(&turned, &in_board);
            move |row, column| rows[row][column]
        });
        let by_camera = SMatrix::<f64, 3, 6>::from_fn({
            let rows = by_twist(&observation.normal, &point);
            move |row, column| rows[row][column]
        });
        self.board += by_board.transpose() * observation.normal * by_board;
        self.board_rhs += by_board.transpose() * observation.rhs;
        self.board_by_pose[i] -= by_board.transpose() * by_camera;
        if !shared_free {
            return;
        }
        if let Some(mut shared) = view.linearize_shared(&corner.observation, &point) {
            // The squares' size moves the corner by `R corner`.
            let grown = turned * corner.point_in_board.coords;
            let by_scale = shared.by_point * grown;
            shared.normal.set_column(BOARD_SCALE, &by_scale);
            shared.normal.set_row(BOARD_SCALE, &by_scale.transpose());
            let own = observation.normal * grown;
            shared.normal[(BOARD_SCALE, BOARD_SCALE)] = grown.dot(&own);
            shared.by_point.set_row(BOARD_SCALE, &own.transpose());
            shared.rhs[BOARD_SCALE] = grown.dot(&observation.rhs);
            self.subtract_shared(i, &shared.by_point, &point);
            self.shared_by_board += shared.by_point * by_board;
            self.shared += shared.normal;
            self.shared_rhs += shared.rhs;
        }
    }

    pub(crate) fn add(&mut self, other: &PoseSystem) {
        fn sum<T: Copy + std::ops::AddAssign>(into: &mut [T], from: &[T]) {
            into.iter_mut().zip(from).for_each(|(a, b)| *a += *b);
        }
        sum(&mut self.blocks, &other.blocks);
        sum(&mut self.rhs, &other.rhs);
        sum(&mut self.shared_by_pose, &other.shared_by_pose);
        sum(&mut self.board_by_pose, &other.board_by_pose);
        self.shared += other.shared;
        self.shared_rhs += other.shared_rhs;
        self.board += other.board;
        self.board_rhs += other.board_rhs;
        self.shared_by_board += other.shared_by_board;
        self.point_gain += other.point_gain;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn twists_of_points_agree_with_cross_products() {
        let point = Point3::new(0.3, -1.2, 0.7);
        let m = Matrix3::new(1.0, 2.0, -0.5, 0.3, -0.7, 1.1, 0.9, 0.2, 0.4);
        let mut t = SMatrix::<f64, 3, 6>::zeros();
        t.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
        t.fixed_view_mut::<3, 3>(0, 3).copy_from(&-point.coords.cross_matrix());
        let product = m * t;
        let rows = by_twist(&m, &point);
        for (row, column) in (0..3).flat_map(|row| (0..6).map(move |column| (row, column))) {
            assert!((rows[row][column] - product[(row, column)]).abs() < 1e-15);
        }
        let v = Vector3::new(0.1, 0.8, -0.4);
        assert!((twist_of(&v, &point) - t.transpose() * v).norm() < 1e-15);
        let twist = Vector6::new(0.1, 0.2, -0.3, 0.4, 0.5, -0.6);
        assert!((moved_by(&twist, &point) - t * twist).norm() < 1e-15);
        // The block of an observation, and what is taken from it.
        let normal = m.transpose() * m;
        let mut system = PoseSystem::new(2);
        system.add_observation(1, &point, &normal, &v);
        assert!((system.block(1, 1) - t.transpose() * normal * t).norm() < 1e-13);
        system.subtract(1, &rows, 0, &by_twist(&normal, &point));
        assert!((system.block(1, 0) + product.transpose() * (normal * t)).norm() < 1e-13);
    }
}
