//! The pinhole camera with the Brown-Conrady distortion of OpenCV, both ways and with derivatives.

use crate::{Pixel, Point3};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// Number of distortion coefficients: `k1 k2 p1 p2 k3`.
pub const DISTORTION_COEFFICIENTS: usize = 5;
/// Number of intrinsic parameters, in the order `fx fy cx cy k1 k2 p1 p2 k3`.
pub const INTRINSICS: usize = 4 + DISTORTION_COEFFICIENTS;

/// A pinhole camera. Axes: x right, y down, z forward; pixel (0, 0) is the centre of the top-left pixel.
///
/// A point `(x, y, z)` is seen at `(fx xd + cx, fy yd + cy)` where `(xd, yd)` is `(x/z, y/z)` after distortion:
/// with `r2 = x^2 + y^2`, `xd = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)` and
/// `yd = y (1 + ...) + p1 (r2 + 2 y^2) + 2 p2 x y` (OpenCV's five-coefficient model).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PinholeCamera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point, column in pixels.
    pub cx: f64,
    /// Principal point, row in pixels.
    pub cy: f64,
    /// `k1 k2 p1 p2 k3`, as in OpenCV.
    pub distortion: [f64; DISTORTION_COEFFICIENTS],
}

/// A projection and its derivatives.
#[derive(Debug, Clone, Copy)]
pub struct ProjectionJacobian {
    /// Where the point is seen.
    pub pixel: Pixel,
    /// d(pixel) / d(point in camera), px per metre.
    pub by_point: Matrix2x3<f64>,
    /// d(pixel) / d(`fx fy cx cy k1 k2 p1 p2 k3`).
    pub by_intrinsics: SMatrix<f64, 2, INTRINSICS>,
}

impl PinholeCamera {
    /// A camera without distortion whose horizontal field of view is `hfov` radians, square pixels, centred.
    pub fn from_hfov(width: u32, height: u32, hfov: f64) -> Self {
        let focal = 0.5 * f64::from(width) / (0.5 * hfov).tan();
        PinholeCamera {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: 0.5 * (f64::from(width) - 1.0),
            cy: 0.5 * (f64::from(height) - 1.0),
            distortion: [0.0; DISTORTION_COEFFICIENTS],
        }
    }

    /// Horizontal field of view in radians, `theta_h` of Eq. (6), without regard to distortion.
    pub fn hfov(&self) -> f64 {
        2.0 * (0.5 * f64::from(self.width) / self.fx).atan()
    }

    /// The matrix K of Eq. (3).
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// Whether any distortion coefficient differs from zero.
    pub fn is_distorted(&self) -> bool {
        self.distortion.iter().any(|&k| k != 0.0)
    }

    /// Whether the pixel lies within the image (to the outer borders of its border pixels).
    #[inline]
    pub fn contains(&self, pixel: &Pixel) -> bool {
        pixel.x >= -0.5
            && pixel.y >= -0.5
            && pixel.x <= f64::from(self.width) - 0.5
            && pixel.y <= f64::from(self.height) - 0.5
    }

    /// Where a point in the camera is seen; `None` at or behind the camera's plane. The pixel may lie outside the
    /// image.
    #[inline]
    pub fn project(&self, point_in_camera: &Point3) -> Option<Pixel> {
        if point_in_camera.z <= 1e-9 {
            return None;
        }
        let normalized = Vector2::new(point_in_camera.x / point_in_camera.z, point_in_camera.y / point_in_camera.z);
        Some(self.pixel_from_distorted(&self.distort(&normalized)))
    }

    /// As [`project`](Self::project), with d(pixel) / d(point in camera), px per metre.
    #[inline]
    pub fn project_with_point_jacobian(&self, point_in_camera: &Point3) -> Option<(Pixel, Matrix2x3<f64>)> {
        if point_in_camera.z <= 1e-9 {
            return None;
        }
        let inverse_z = 1.0 / point_in_camera.z;
        let (x, y) = (point_in_camera.x * inverse_z, point_in_camera.y * inverse_z);
        let bend = self.distortion_jacobian(x, y);
        let (ux, uy) = (self.fx * inverse_z * bend[(0, 0)], self.fx * inverse_z * bend[(0, 1)]);
        let (vx, vy) = (self.fy * inverse_z * bend[(1, 0)], self.fy * inverse_z * bend[(1, 1)]);
        let by_point = Matrix2x3::new(ux, uy, -(ux * x + uy * y), vx, vy, -(vx * x + vy * y));
        Some((self.pixel_from_distorted(&self.distort(&Vector2::new(x, y))), by_point))
    }

    /// As [`project`](Self::project), with the derivatives by the point and by the intrinsics.
    pub fn project_with_jacobian(&self, point_in_camera: &Point3) -> Option<ProjectionJacobian> {
        if point_in_camera.z <= 1e-9 {
            return None;
        }
        let inverse_z = 1.0 / point_in_camera.z;
        let (x, y) = (point_in_camera.x * inverse_z, point_in_camera.y * inverse_z);
        let distorted = self.distort(&Vector2::new(x, y));
        let by_normalized = self.distortion_jacobian(x, y);
        let normalized_by_point = Matrix2x3::new(inverse_z, 0.0, -x * inverse_z, 0.0, inverse_z, -y * inverse_z);
        let focal = Matrix2::new(self.fx, 0.0, 0.0, self.fy);
        let r2 = x * x + y * y;
        let mut by_intrinsics = SMatrix::<f64, 2, INTRINSICS>::zeros();
        by_intrinsics[(0, 0)] = distorted.x;
        by_intrinsics[(1, 1)] = distorted.y;
        by_intrinsics[(0, 2)] = 1.0;
        by_intrinsics[(1, 3)] = 1.0;
        let by_coefficients = [
            (x * r2, y * r2),
            (x * r2 * r2, y * r2 * r2),
            (2.0 * x * y, r2 + 2.0 * y * y),
            (r2 + 2.0 * x * x, 2.0 * x * y),
            (x * r2 * r2 * r2, y * r2 * r2 * r2),
        ];
        for (column, (dx, dy)) in by_coefficients.into_iter().enumerate() {
            by_intrinsics[(0, 4 + column)] = self.fx * dx;
            by_intrinsics[(1, 4 + column)] = self.fy * dy;
        }
        Some(ProjectionJacobian {
            pixel: self.pixel_from_distorted(&distorted),
            by_point: focal * by_normalized * normalized_by_point,
            by_intrinsics,
        })
    }

    /// The direction `(x/z, y/z, 1)` in which a pixel looks, distortion removed (Newton's method on the distortion).
    ///
    /// Beyond the radius at which the polynomial folds back there is no inverse; the closest approach is returned.
    pub fn unproject(&self, pixel: &Pixel) -> Vector3<f64> {
        let target = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        if !self.is_distorted() {
            return target.push(1.0);
        }
        let mut normalized = target;
        for _ in 0..20 {
            let error = self.distort(&normalized) - target;
            if error.norm_squared() < 1e-26 {
                break;
            }
            let Some(inverse) = self.distortion_jacobian(normalized.x, normalized.y).try_inverse() else {
                break;
            };
            normalized -= inverse * error;
        }
        normalized.push(1.0)
    }

    /// The pixel at which a camera with the same K and no distortion would have seen what `pixel` shows.
    pub fn undistort(&self, pixel: &Pixel) -> Pixel {
        if !self.is_distorted() {
            return *pixel;
        }
        let direction = self.unproject(pixel);
        self.pixel_from_distorted(&direction.xy())
    }

    /// The nine intrinsic parameters in the order of [`INTRINSICS`].
    pub fn intrinsics(&self) -> [f64; INTRINSICS] {
        let [k1, k2, p1, p2, k3] = self.distortion;
        [self.fx, self.fy, self.cx, self.cy, k1, k2, p1, p2, k3]
    }

    /// The same camera with other intrinsic parameters, in the order of [`INTRINSICS`].
    pub fn with_intrinsics(&self, [fx, fy, cx, cy, k1, k2, p1, p2, k3]: [f64; INTRINSICS]) -> Self {
        PinholeCamera { width: self.width, height: self.height, fx, fy, cx, cy, distortion: [k1, k2, p1, p2, k3] }
    }

    /// The same camera at another resolution: the field of view stays, pixels shrink or grow by `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        let scale = |length: u32| (f64::from(length) * factor).round().max(1.0) as u32;
        PinholeCamera {
            width: scale(self.width),
            height: scale(self.height),
            fx: self.fx * factor,
            fy: self.fy * factor,
            // Pixel borders, not centres, keep their place under scaling.
            cx: (self.cx + 0.5) * factor - 0.5,
            cy: (self.cy + 0.5) * factor - 0.5,
            distortion: self.distortion,
        }
    }

    #[inline]
    fn pixel_from_distorted(&self, distorted: &Vector2<f64>) -> Pixel {
        Pixel::new(self.fx * distorted.x + self.cx, self.fy * distorted.y + self.cy)
    }

    #[inline]
    fn distort(&self, normalized: &Vector2<f64>) -> Vector2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = (normalized.x, normalized.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    #[inline]
    fn distortion_jacobian(&self, x: f64, y: f64) -> Matrix2<f64> {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        // d(radial)/d(r2); d(r2)/dx = 2x.
        let slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3);
        let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        Matrix2::new(
            radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn distorted_camera() -> PinholeCamera {
        PinholeCamera {
            width: 2064,
            height: 1544,
            fx: 2254.4,
            fy: 2250.6,
            cx: 1019.7,
            cy: 781.2,
            distortion: [-0.149, 0.247, 1.4e-4, 3.1e-5, -0.218],
        }
    }

    proptest! {
        #[test]
        fn unproject_inverts_project(x in -0.45..0.45f64, y in -0.34..0.34f64, z in 0.1..5.0f64) {
            let camera = distorted_camera();
            let pixel = camera.project(&Point3::new(x * z, y * z, z)).unwrap();
            let direction = camera.unproject(&pixel);
            prop_assert!((direction - Vector3::new(x, y, 1.0)).norm() < 1e-9);
        }

        #[test]
        fn projection_jacobian_agrees_with_differences(x in -0.4..0.4f64, y in -0.3..0.3f64, z in 0.3..3.0f64) {
            let camera = distorted_camera();
            let point = Point3::new(x * z, y * z, z);
            let analytic = camera.project_with_jacobian(&point).unwrap();
            let (pixel, by_point) = camera.project_with_point_jacobian(&point).unwrap();
            prop_assert!((pixel - analytic.pixel).norm() < 1e-9);
            prop_assert!((by_point - analytic.by_point).norm() < 1e-9 * analytic.by_point.norm());
            let step = 1e-6;
            for axis in 0..3 {
                let mut offset = Vector3::zeros();
                offset[axis] = step;
                let difference = (camera.project(&(point + offset)).unwrap() - camera.project(&(point - offset)).unwrap()) / (2.0 * step);
                prop_assert!((difference - analytic.by_point.column(axis)).norm() < 1e-4 * (1.0 + difference.norm()));
            }
            for index in 0..INTRINSICS {
                let mut upper = camera.intrinsics();
                let mut lower = upper;
                upper[index] += step;
                lower[index] -= step;
                let difference = (camera.with_intrinsics(upper).project(&point).unwrap()
                    - camera.with_intrinsics(lower).project(&point).unwrap()) / (2.0 * step);
                prop_assert!((difference - analytic.by_intrinsics.column(index)).norm() < 1e-4 * (1.0 + difference.norm()));
            }
        }
    }

    #[test]
    fn hfov_of_the_paper_gives_its_focal_length() {
        let camera = PinholeCamera::from_hfov(1920, 1080, 70f64.to_radians());
        assert!((camera.fx - 1371.02).abs() < 0.01);
        assert!((camera.hfov() - 70f64.to_radians()).abs() < 1e-12);
    }

    #[test]
    fn nothing_is_seen_behind_the_camera() {
        assert!(distorted_camera().project(&Point3::new(0.0, 0.0, -1.0)).is_none());
        assert!(distorted_camera().project(&Point3::new(0.0, 0.0, 0.0)).is_none());
    }
}
