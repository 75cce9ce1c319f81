//! The signed Sampson distance of a match, and its derivative by the relative pose.
//!
//! With `camera_a_from_camera_b = (R, t)`, `E = [t]x R`, directions `a` and `b`, `l = E b`, `l' = E^T a` and `c = a .
//! l`, the distance is `c / s` with `s^2 = |J_a^T l|^2 + |J_b^T l'|^2`, where `J` takes a change of a *measured* pixel,
//! distortion included, in units of its sigma to the direction: the first-order distance of the pair to the epipolar
//! variety (Hartley and Zisserman, section 11.4.3). A left twist `(v, omega)` of the relative pose changes `l` by `v x
//! (R b) + omega x l` and `l'` by `R^T (a x v) + E^T (a x omega)`.

use nalgebra::{Matrix2, Matrix3, SMatrix, Vector2, Vector3, Vector6};
use skclam_geometry::{INTRINSICS, Isometry3, PinholeCamera, Pixel, Point3, essential_matrix};

/// One endpoint of a match: where it looks, and how its pixel turns that.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bearing {
    /// `(x/z, y/z, 1)`.
    direction: Vector3<f64>,
    /// d(x/z, y/z) / d(pixel) times the pixel's sigma.
    by_pixel: Matrix2<f64>,
}

impl Bearing {
    pub(crate) fn new(camera: &PinholeCamera, pixel: &Pixel, sigma_px: f64) -> Option<Self> {
        let direction = camera.unproject(pixel);
        let projection = camera.project_with_jacobian(&Point3::from(direction))?;
        let by_pixel = projection.by_point.fixed_view::<2, 2>(0, 0).into_owned().try_inverse()? * sigma_px;
        Some(Bearing { direction, by_pixel })
    }

    /// No geometry: every distance to it is 0.
    pub(crate) fn blind() -> Self {
        Bearing { direction: Vector3::zeros(), by_pixel: Matrix2::zeros() }
    }

    /// d(x/z, y/z) / d(intrinsics) for a fixed pixel.
    fn by_intrinsics(&self, camera: &PinholeCamera) -> SMatrix<f64, 2, INTRINSICS> {
        camera.project_with_jacobian(&Point3::from(self.direction)).map_or_else(SMatrix::zeros, |projection| {
            let by_normalized = projection.by_point.fixed_view::<2, 2>(0, 0).into_owned();
            by_normalized.try_inverse().map_or_else(SMatrix::zeros, |inverse| -inverse * projection.by_intrinsics)
        })
    }
}

/// The relative pose of a pair, ready for its matches.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RelativePose {
    rotation: Matrix3<f64>,
    essential: Matrix3<f64>,
}

/// A distance in sigmas and its derivative by the left twist `(v, omega)` of `camera_a_from_camera_b`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Distance {
    pub value: f64,
    pub by_twist: Vector6<f64>,
}

impl RelativePose {
    pub(crate) fn new(camera_a_from_camera_b: &Isometry3) -> Self {
        RelativePose {
            rotation: *camera_a_from_camera_b.rotation.to_rotation_matrix().matrix(),
            essential: essential_matrix(camera_a_from_camera_b),
        }
    }

    /// Signed, in sigmas; 0 where both lines vanish.
    pub(crate) fn distance(&self, a: &Bearing, b: &Bearing) -> f64 {
        let line_a = self.essential * b.direction;
        let line_b = self.essential.tr_mul(&a.direction);
        let gradient = a.by_pixel.tr_mul(&line_a.xy()).norm_squared() + b.by_pixel.tr_mul(&line_b.xy()).norm_squared();
        if gradient > 0.0 { a.direction.dot(&line_a) / gradient.sqrt() } else { 0.0 }
    }

    /// As [`distance`](Self::distance), with its derivative.
    pub(crate) fn differentiate(&self, a: &Bearing, b: &Bearing) -> Distance {
        let rotated = self.rotation * b.direction;
        let line_a = self.essential * b.direction;
        let line_b = self.essential.tr_mul(&a.direction);
        let (in_a, in_b) = (a.by_pixel.tr_mul(&line_a.xy()), b.by_pixel.tr_mul(&line_b.xy()));
        let gradient = (in_a.norm_squared() + in_b.norm_squared()).sqrt();
        if gradient == 0.0 {
            return Distance { value: 0.0, by_twist: Vector6::zeros() };
        }
        let value = a.direction.dot(&line_a) / gradient;
        // d(s) = (k_a . d(l) + k_b . d(l')) / s.
        let lift = |jacobian: &Matrix2<f64>, v: &Vector2<f64>| (jacobian * v).push(0.0);
        let (k_a, k_b) = (lift(&a.by_pixel, &in_a), lift(&b.by_pixel, &in_b));
        let (turned, lined) = (self.rotation * k_b, self.essential * k_b);
        let algebraic_v = rotated.cross(&a.direction);
        let algebraic_omega = line_a.cross(&a.direction);
        let scale_v = rotated.cross(&k_a) + turned.cross(&a.direction);
        let scale_omega = line_a.cross(&k_a) + lined.cross(&a.direction);
        let inverse = 1.0 / gradient;
        let by_v = (algebraic_v - scale_v * (value * inverse)) * inverse;
        let by_omega = (algebraic_omega - scale_omega * (value * inverse)) * inverse;
        Distance { value, by_twist: Vector6::new(by_v.x, by_v.y, by_v.z, by_omega.x, by_omega.y, by_omega.z) }
    }

    /// Derivative by the intrinsics, the change of `s` left out: it is proportional to the distance itself.
    pub(crate) fn by_intrinsics(
        &self,
        camera: &PinholeCamera,
        a: &Bearing,
        b: &Bearing,
    ) -> SMatrix<f64, INTRINSICS, 1> {
        let line_a = self.essential * b.direction;
        let line_b = self.essential.tr_mul(&a.direction);
        let (in_a, in_b) = (a.by_pixel.tr_mul(&line_a.xy()), b.by_pixel.tr_mul(&line_b.xy()));
        let gradient = (in_a.norm_squared() + in_b.norm_squared()).sqrt();
        if gradient == 0.0 {
            return SMatrix::zeros();
        }
        let change = a.by_intrinsics(camera).tr_mul(&line_a.xy()) + b.by_intrinsics(camera).tr_mul(&line_b.xy());
        change / gradient
    }
}

/// `Ad(T) (v, omega)`: a twist of the right frame as the left one sees it.
pub(crate) fn adjoint(pose: &Isometry3, twist: &Vector6<f64>) -> Vector6<f64> {
    let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
    let turned = pose.rotation * omega;
    crate::camera_kinematics::stack(&(pose.rotation * v + pose.translation.vector.cross(&turned)), &turned)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion};
    use proptest::prelude::*;
    use skclam_geometry::FundamentalMatrix;

    fn camera() -> PinholeCamera {
        let plain = PinholeCamera::from_hfov(1920, 1080, 1.2);
        PinholeCamera { distortion: [-0.1, 0.05, 1e-3, -5e-4, 0.01], ..plain }
    }

    proptest! {
        #[test]
        fn derivatives_agree_with_differences(
            pixels in prop::collection::vec(200.0..900.0f64, 4),
            t in prop::collection::vec(-0.3..0.3f64, 3),
            w in prop::collection::vec(-0.4..0.4f64, 3),
        ) {
            let translation = Vector3::new(t[0], t[1], t[2]);
            prop_assume!(translation.norm() > 0.05);
            let camera = camera();
            let pose = Isometry3::new(translation, Vector3::new(w[0], w[1], w[2]));
            let a = Bearing::new(&camera, &Pixel::new(pixels[0], pixels[1]), 0.7).unwrap();
            let b = Bearing::new(&camera, &Pixel::new(pixels[2], pixels[3]), 0.7).unwrap();
            let analytic = RelativePose::new(&pose).differentiate(&a, &b);
            prop_assert!((analytic.value - RelativePose::new(&pose).distance(&a, &b)).abs() < 1e-9 * (1.0 + analytic.value.abs()));
            let step = 1e-6;
            for axis in 0..6 {
                let at = |s: f64| {
                    let mut twist = Vector6::zeros();
                    twist[axis] = s;
                    let moved = Isometry3::from_parts(
                        Translation3::new(twist[0], twist[1], twist[2]),
                        UnitQuaternion::from_scaled_axis(Vector3::new(twist[3], twist[4], twist[5])),
                    ) * pose;
                    RelativePose::new(&moved).distance(&a, &b)
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - analytic.by_twist[axis]).abs() < 2e-5 * (1.0 + analytic.by_twist.norm()), "{axis}: {difference} {}", analytic.by_twist[axis]);
            }
        }

        #[test]
        fn derivatives_by_intrinsics_agree_where_the_distance_vanishes(x in -0.4..0.4f64, y in -0.2..0.2f64, z in 0.5..2.0f64) {
            let camera = camera();
            let pose = Isometry3::new(Vector3::new(0.2, 0.05, -0.1), Vector3::new(0.1, -0.2, 0.3));
            let point = Point3::new(x * z, y * z, z);
            let in_b = camera.project(&point).unwrap();
            let in_a = camera.project(&(pose * point)).unwrap();
            let relative = RelativePose::new(&pose);
            let of = |camera: &PinholeCamera| (Bearing::new(camera, &in_a, 1.0).unwrap(), Bearing::new(camera, &in_b, 1.0).unwrap());
            let (a, b) = of(&camera);
            prop_assert!(relative.distance(&a, &b).abs() < 1e-7);
            let analytic = relative.by_intrinsics(&camera, &a, &b);
            for k in 0..INTRINSICS {
                let step = 1e-5;
                let at = |s: f64| {
                    let mut intrinsics = camera.intrinsics();
                    intrinsics[k] += s;
                    let (a, b) = of(&camera.with_intrinsics(intrinsics));
                    relative.distance(&a, &b)
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - analytic[k]).abs() < 1e-3 * (1.0 + difference.abs()), "{k}: {difference} {}", analytic[k]);
            }
        }
    }

    #[test]
    fn it_is_the_pixel_distance_of_an_ideal_camera() {
        let camera = PinholeCamera::from_hfov(1920, 1080, 1.2);
        let pose = Isometry3::new(Vector3::new(0.2, 0.05, -0.1), Vector3::new(0.1, -0.2, 0.3));
        let (in_a, in_b) = (Pixel::new(300.0, 400.0), Pixel::new(350.0, 380.0));
        let of = |pixel: &Pixel| Bearing::new(&camera, pixel, 1.0).unwrap();
        let expected = FundamentalMatrix::from_pose(&camera, &camera, &pose).sampson_distance(&in_a, &in_b);
        assert!((RelativePose::new(&pose).distance(&of(&in_a), &of(&in_b)) - expected).abs() < 1e-9);
    }
}
