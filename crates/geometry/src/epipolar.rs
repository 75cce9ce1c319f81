//! Two views of one scene: the essential and the fundamental matrix, epipolar lines and distances.
//!
//! With `T = camera_a_from_camera_b` (Eq. (2)) and `E = [t]x R` (Eq. (4)), directions satisfy `a^T E b = 0` and
//! undistorted pixels `a^T F b = 0`; `F b` is a line in image A. Hartley and Zisserman, "Multiple View Geometry
//! in Computer Vision", 2nd ed., chapters 9 and 11.

use crate::{Isometry3, PinholeCamera, Pixel};
use nalgebra::{Matrix3, Vector3};

/// `[t]x R` of `camera_a_from_camera_b`, Eq. (4) and (5): `direction_in_a^T E direction_in_b = 0`.
pub fn essential_matrix(camera_a_from_camera_b: &Isometry3) -> Matrix3<f64> {
    camera_a_from_camera_b.translation.vector.cross_matrix()
        * camera_a_from_camera_b.rotation.to_rotation_matrix().matrix()
}

/// `F` with `in_a^T F in_b = 0` for undistorted pixels, Eq. (3).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FundamentalMatrix(pub Matrix3<f64>);

/// The line `a x + b y + c = 0` in an image, in pixels; not normalised.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpipolarLine(pub Vector3<f64>);

impl EpipolarLine {
    /// Unsigned distance of a pixel to the line, px. Infinite for the line at infinity.
    pub fn distance(&self, pixel: &Pixel) -> f64 {
        let normal = self.0.xy().norm();
        if normal == 0.0 {
            return f64::INFINITY;
        }
        (self.0.x * pixel.x + self.0.y * pixel.y + self.0.z).abs() / normal
    }
}

impl FundamentalMatrix {
    /// Eq. (3), `F = K_a^-T E K_b^-1`, for two cameras that may differ.
    pub fn from_pose(camera_a: &PinholeCamera, camera_b: &PinholeCamera, camera_a_from_camera_b: &Isometry3) -> Self {
        let inverse = |camera: &PinholeCamera| {
            let (fx, fy) = (1.0 / camera.fx, 1.0 / camera.fy);
            Matrix3::new(fx, 0.0, -camera.cx * fx, 0.0, fy, -camera.cy * fy, 0.0, 0.0, 1.0)
        };
        FundamentalMatrix(inverse(camera_a).transpose() * essential_matrix(camera_a_from_camera_b) * inverse(camera_b))
    }

    /// The line in image A on which the point seen at `in_b` must lie.
    pub fn line_in_a(&self, in_b: &Pixel) -> EpipolarLine {
        EpipolarLine(self.0 * in_b.to_homogeneous())
    }

    /// The line in image B on which the point seen at `in_a` must lie.
    pub fn line_in_b(&self, in_a: &Pixel) -> EpipolarLine {
        EpipolarLine(self.0.tr_mul(&in_a.to_homogeneous()))
    }

    /// The two distances of Eq. (8): of `in_a` to its line in A, and of `in_b` to its line in B. px.
    pub fn point_line_distances(&self, in_a: &Pixel, in_b: &Pixel) -> (f64, f64) {
        (self.line_in_a(in_b).distance(in_a), self.line_in_b(in_a).distance(in_b))
    }

    /// The signed Sampson distance, the first-order distance of the pair to the epipolar variety. px.
    ///
    /// `NaN` where both lines vanish (no baseline).
    pub fn sampson_distance(&self, in_a: &Pixel, in_b: &Pixel) -> f64 {
        let line_in_a = self.0 * in_b.to_homogeneous();
        let line_in_b = self.0.tr_mul(&in_a.to_homogeneous());
        let algebraic = line_in_a.dot(&in_a.to_homogeneous());
        algebraic / (line_in_a.xy().norm_squared() + line_in_b.xy().norm_squared()).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Point3;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn exact_points_lie_on_their_lines(x in -0.5..0.5f64, y in -0.4..0.4f64, z in 0.8..3.0f64, angle in -0.3..0.3f64) {
            let camera = PinholeCamera::from_hfov(1920, 1080, 1.2);
            let a_from_b = Isometry3::new(Vector3::new(0.2, -0.05, 0.1), Vector3::new(0.1, angle, -0.2));
            let in_b_point = Point3::new(x, y, z);
            let in_b = camera.project(&in_b_point).unwrap();
            let in_a = camera.project(&(a_from_b * in_b_point)).unwrap();
            let fundamental = FundamentalMatrix::from_pose(&camera, &camera, &a_from_b);
            let (distance_in_a, distance_in_b) = fundamental.point_line_distances(&in_a, &in_b);
            prop_assert!(distance_in_a < 1e-8 && distance_in_b < 1e-8);
            prop_assert!(fundamental.sampson_distance(&in_a, &in_b).abs() < 1e-8);
            // A pixel moved off its line by one is one pixel away from it.
            let line = fundamental.line_in_a(&in_b).0;
            let moved = in_a + line.xy().normalize();
            prop_assert!((fundamental.line_in_a(&in_b).distance(&moved) - 1.0).abs() < 1e-8);
        }
    }

    #[test]
    fn no_baseline_has_no_epipolar_geometry() {
        let camera = PinholeCamera::from_hfov(640, 480, 1.0);
        let fundamental = FundamentalMatrix::from_pose(&camera, &camera, &Isometry3::identity());
        assert!(fundamental.sampson_distance(&Pixel::new(1.0, 2.0), &Pixel::new(1.0, 2.0)).is_nan());
        assert_eq!(fundamental.point_line_distances(&Pixel::new(1.0, 2.0), &Pixel::new(1.0, 2.0)).0, f64::INFINITY);
    }
}
