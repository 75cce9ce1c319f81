//! What the cameras measure of a scene point: residuals, costs, and both linearised by the point.
//!
//! Everything is differentiated by the point *in the base frame*. A twist `(v, omega)` of the base frame that moves a
//! camera moves what it sees by `-(v + omega x X)`, whichever camera it is, so that the 3 x 3 normal matrix of a point
//! is all that an observation contributes.

use crate::bundle::observations::Observation;
use crate::{DepthCorrection, Loss};
use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};
use skclam_geometry::{INTRINSICS, Isometry3, PinholeCamera, Point3};

/// Intrinsics, depth offset, depth scale, the depth camera's place (translation, rotation), the board's scale.
pub(crate) const SHARED: usize = INTRINSICS + 9;
pub(crate) const DEPTH_OFFSET: usize = INTRINSICS;
pub(crate) const DEPTH_SCALE: usize = INTRINSICS + 1;
pub(crate) const EXTRINSICS: usize = INTRINSICS + 2;
pub(crate) const BOARD_SCALE: usize = INTRINSICS + 8;

/// No sensor reads less, m.
const NEAREST_M: f64 = 1e-3;

/// Residual, in sigmas, of what lies behind the camera.
pub(crate) const BEHIND: f64 = 1e3;

/// A camera's pose, as the inner loops want it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame {
    pub camera_from_base: Matrix3<f64>,
    pub center_in_base: Point3,
}

impl Frame {
    pub(crate) fn new(base_from_camera: &Isometry3) -> Self {
        Frame {
            camera_from_base: base_from_camera.rotation.to_rotation_matrix().matrix().transpose(),
            center_in_base: base_from_camera.translation.vector.into(),
        }
    }

    #[inline]
    pub(crate) fn in_camera(&self, point_in_base: &Point3) -> Point3 {
        Point3::from(self.camera_from_base * (point_in_base - self.center_in_base))
    }

    pub(crate) fn in_base(&self, point_in_camera: &Point3) -> Point3 {
        self.center_in_base + self.camera_from_base.tr_mul(&point_in_camera.coords)
    }
}

/// What residuals are measured with.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scales {
    pub loss: Loss,
    /// Sigma of a pixel coordinate whose covariance is given as 1.
    pub pixel: f64,
    /// `s` of `sigma = s z^2`: the sigma of an inverse depth.
    pub depth: f64,
}

/// The cameras that look at the points.
#[derive(Clone, Copy)]
pub(crate) struct ProjectionModel<'a> {
    pub camera: &'a PinholeCamera,
    pub frames: &'a [Frame],
    pub depth: DepthCorrection,
    pub scales: Scales,
}

/// An observation's weighted normal equations by its point in the base frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinearizedObservation {
    pub posture: usize,
    pub normal: Matrix3<f64>,
    pub rhs: Vector3<f64>,
}

/// The same for the parameters common to all observations.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinearizedShared {
    /// With the point in the base frame.
    pub by_point: SMatrix<f64, SHARED, 3>,
    pub normal: SMatrix<f64, SHARED, SHARED>,
    pub rhs: SVector<f64, SHARED>,
}

/// How the depth that a pixel shows grows with the depth camera's translation and rotation in the colour camera's axes:
/// the surface moves, and the pixel's ray meets it elsewhere where it is slanted.
fn depth_by_extrinsics(observation: &Observation, in_camera: &Point3) -> [f64; 6] {
    let z = observation.depth_m;
    let (x, y) = (in_camera.x / in_camera.z, in_camera.y / in_camera.z);
    let [slope_x, slope_y] = observation.depth_slope.map(|slope| slope / z);
    let by_x = -slope_x;
    let by_y = -slope_y;
    let by_z = 1.0 + slope_x * x + slope_y * y;
    // omega x p with p = z (x, y, 1).
    [by_x, by_y, by_z, z * (by_z * y - by_y), z * (by_x - by_z * x), z * (by_y * x - by_x * y)]
}

impl ProjectionModel<'_> {
    pub(crate) fn frame(&self, observation: &Observation) -> &Frame {
        &self.frames[observation.posture as usize]
    }

    /// Robust cost of a point; what lies behind a camera costs as an outlier.
    pub(crate) fn cost(&self, track: &[Observation], point: &Point3) -> f64 {
        track.iter().map(|observation| self.cost_of(observation, point)).sum()
    }

    pub(crate) fn cost_of(&self, observation: &Observation, point: &Point3) -> f64 {
        let in_camera = self.frame(observation).in_camera(point);
        let loss = self.scales.loss;
        let Some(pixel) = self.camera.project(&in_camera) else {
            return 2.0 * observation.pixel_weight * loss.rho(BEHIND);
        };
        let u = observation.size(&(observation.pixel - pixel)) / self.scales.pixel;
        let depth =
            if observation.depth_m > 0.0 { loss.rho(self.depth_residual(observation, &in_camera).0) } else { 0.0 };
        observation.pixel_weight * loss.rho(u) + observation.depth_weight * depth
    }

    /// How much farther the sensor saw a point than it should have at `z`, in sigmas, and by how much that falls a
    /// metre of z.
    ///
    /// It is taken in *inverse* depth of the sensor's own reading, where the noise `s z^2` of a depth is the constant
    /// `s`: weights made of noisy depths would count near readings more than far ones and shrink the world, and a
    /// residual in corrected metres would shrink with the depth's scale. The mean of the reciprocal of a reading with
    /// normal noise, `1/z + s^2 z`, is allowed for.
    pub(crate) fn depth_residual(&self, observation: &Observation, in_camera: &Point3) -> (f64, f64) {
        let s = self.scales.depth;
        let z = self.depth_before_scale(observation, in_camera);
        let expected = (z / self.depth.scale).max(NEAREST_M);
        let measured = 1.0 / observation.depth_m - s * s * observation.depth_m;
        ((1.0 / expected - measured) / s, 1.0 / (expected * expected * self.depth.scale * s))
    }

    /// The depth that the sensor should have read, but for its scale: what its offset and its place beside the colour
    /// camera make of a point's depth.
    fn depth_before_scale(&self, observation: &Observation, in_camera: &Point3) -> f64 {
        let z = in_camera.z - self.depth.offset_m;
        if self.depth.extrinsics == [0.0; 6] {
            return z;
        }
        let by = depth_by_extrinsics(observation, in_camera);
        z - by.iter().zip(&self.depth.extrinsics).map(|(by, value)| by * value).sum::<f64>()
    }

    /// `None` behind the camera.
    #[inline]
    pub(crate) fn linearize(&self, observation: &Observation, point: &Point3) -> Option<LinearizedObservation> {
        let frame = self.frame(observation);
        let in_camera = frame.in_camera(point);
        let (pixel, by_point) = self.camera.project_with_point_jacobian(&in_camera)?;
        let residual = observation.pixel - pixel;
        let omega = self.pixel_information(observation, &residual);
        let [a, b, c] = omega;
        let (u, v) = (by_point.row(0) * frame.camera_from_base, by_point.row(1) * frame.camera_from_base);
        let (rhs_u, rhs_v) = (a * residual.x + b * residual.y, b * residual.x + c * residual.y);
        let (wu, wv) = (u * a + v * b, u * b + v * c);
        let (mut depth_weight, mut rhs_depth) = (0.0, 0.0);
        if observation.depth_m > 0.0 {
            let (residual, slope) = self.depth_residual(observation, &in_camera);
            let weight = self.scales.loss.weight(residual) * observation.depth_weight;
            (depth_weight, rhs_depth) = (weight * slope * slope, weight * residual * slope);
        }
        let z = frame.camera_from_base.row(2);
        let entry = |i: usize, j: usize| u[i] * wu[j] + v[i] * wv[j] + depth_weight * z[i] * z[j];
        let (xx, xy, xz) = (entry(0, 0), entry(0, 1), entry(0, 2));
        let (yy, yz, zz) = (entry(1, 1), entry(1, 2), entry(2, 2));
        Some(LinearizedObservation {
            posture: observation.posture as usize,
            normal: Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz),
            rhs: Vector3::from_fn(|i, _| u[i] * rhs_u + v[i] * rhs_v + z[i] * rhs_depth),
        })
    }

    /// Inverse covariance of the pixel's two coordinates with the loss's weight at a residual: xx, xy, yy.
    fn pixel_information(&self, observation: &Observation, residual: &Vector2<f64>) -> [f64; 3] {
        let inverse_variance = 1.0 / (self.scales.pixel * self.scales.pixel);
        let size = observation.size(residual) / self.scales.pixel;
        let weight = self.scales.loss.weight(size) * observation.pixel_weight * inverse_variance;
        observation.information.map(|x| x * weight)
    }

    /// What the shared numbers have of an observation; `None` behind the camera.
    pub(crate) fn linearize_shared(&self, observation: &Observation, point: &Point3) -> Option<LinearizedShared> {
        let frame = self.frame(observation);
        let in_camera = frame.in_camera(point);
        let projection = self.camera.project_with_jacobian(&in_camera)?;
        let residual = observation.pixel - projection.pixel;
        let [a, b, c] = self.pixel_information(observation, &residual);
        let by_base = projection.by_point * frame.camera_from_base;
        let mut shared =
            LinearizedShared { by_point: SMatrix::zeros(), normal: SMatrix::zeros(), rhs: SVector::zeros() };
        let by = &projection.by_intrinsics;
        for j in 0..INTRINSICS {
            let (u, v) = (by[(0, j)], by[(1, j)]);
            // Most entries are zero: a focal length and a coordinate of the centre each move one coordinate.
            let (wu, wv) = (a * u + b * v, b * u + c * v);
            for i in 0..3 {
                shared.by_point[(j, i)] = wu * by_base[(0, i)] + wv * by_base[(1, i)];
            }
            shared.rhs[j] = wu * residual.x + wv * residual.y;
            for i in 0..INTRINSICS {
                shared.normal[(i, j)] = by[(0, i)] * wu + by[(1, i)] * wv;
            }
        }
        if observation.depth_m > 0.0 {
            let (residual, slope) = self.depth_residual(observation, &in_camera);
            let weight = self.scales.loss.weight(residual) * observation.depth_weight;
            // The residual grows with the shared numbers where it falls with z.
            let by_offset = -slope;
            let by_scale = -slope * self.depth_before_scale(observation, &in_camera) / self.depth.scale;
            let mut rows = [(0, 0.0); 8];
            rows[..2].copy_from_slice(&[(DEPTH_OFFSET, by_offset), (DEPTH_SCALE, by_scale)]);
            let by_extrinsics = depth_by_extrinsics(observation, &in_camera);
            for (k, by) in by_extrinsics.iter().enumerate() {
                rows[2 + k] = (EXTRINSICS + k, -slope * by);
            }
            for (i, x) in rows {
                for axis in 0..3 {
                    shared.by_point[(i, axis)] = weight * slope * x * frame.camera_from_base[(2, axis)];
                }
                shared.rhs[i] = weight * residual * x;
                for (j, y) in rows {
                    shared.normal[(i, j)] = weight * x * y;
                }
            }
        }
        Some(shared)
    }
}
