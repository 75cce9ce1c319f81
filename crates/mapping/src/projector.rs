//! A pinhole camera in single precision for loops over many points, several at a time.
//!
//! The same equations as [`PinholeCamera::project`]; single precision is good to 1e-4 px, and what is looked up here
//! are whole pixels.

use skclam_geometry::PinholeCamera;

/// Points nearer than this are not projected, metres.
const NEAREST: f32 = 1e-3;

/// Projects points of the camera's frame to pixels counted from the image's outer corner, so that truncation gives the
/// pixel's column and row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Projector {
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    distortion: [f32; 5],
    distorted: bool,
    /// Largest squared radius in the normalised image at which the image lies: beyond it the distortion may fold back.
    farthest: f32,
    width: f32,
    height: f32,
    /// The last positions inside.
    last_u: f32,
    last_v: f32,
}

impl Projector {
    pub(crate) fn new(camera: &PinholeCamera) -> Self {
        let (right, bottom) = (f64::from(camera.width) - 0.5, f64::from(camera.height) - 0.5);
        let corners = [(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)];
        let farthest = corners
            .map(|(x, y)| camera.unproject(&skclam_geometry::Pixel::new(x, y)).xy().norm_squared())
            .into_iter()
            .fold(0.0, f64::max);
        Projector {
            fx: camera.fx as f32,
            fy: camera.fy as f32,
            cx: camera.cx as f32 + 0.5,
            cy: camera.cy as f32 + 0.5,
            distortion: camera.distortion.map(|value| value as f32),
            distorted: camera.is_distorted(),
            farthest: 1.05 * farthest as f32,
            width: camera.width as f32,
            height: camera.height as f32,
            last_u: (camera.width as f32).next_down(),
            last_v: (camera.height as f32).next_down(),
        }
    }

    /// Column and row of a point; meaningless unless [`Projector::sees`] them.
    #[inline(always)]
    pub(crate) fn project(&self, x: f32, y: f32, z: f32) -> (f32, f32) {
        if self.distorted { self.project_distorted(x, y, z) } else { self.project_straight(x, y, z) }
    }

    /// Whether the camera has any distortion.
    pub(crate) fn is_distorted(&self) -> bool {
        self.distorted
    }

    /// As [`Projector::project`] for a camera without distortion.
    #[inline(always)]
    pub(crate) fn project_straight(&self, x: f32, y: f32, z: f32) -> (f32, f32) {
        let inverse_z = 1.0 / z;
        (x * inverse_z * self.fx + self.cx, y * inverse_z * self.fy + self.cy)
    }

    /// As [`Projector::project`] for any camera.
    #[inline(always)]
    pub(crate) fn project_distorted(&self, x: f32, y: f32, z: f32) -> (f32, f32) {
        let inverse_z = 1.0 / z;
        let (x, y) = (x * inverse_z, y * inverse_z);
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        let folded = r2 > self.farthest;
        let xd = if folded { f32::NEG_INFINITY } else { xd };
        (xd * self.fx + self.cx, yd * self.fy + self.cy)
    }

    /// Whether a point at this depth and position lies in the image; false for anything that is not a number.
    #[inline(always)]
    pub(crate) fn sees(&self, z: f32, u: f32, v: f32) -> bool {
        (z > NEAREST) & (u >= 0.0) & (v >= 0.0) & (u < self.width) & (v < self.height)
    }

    /// All bits set where [`Projector::sees`] is false, else none, for a finite `z` and what it was projected to:
    /// signs, so that compilers see nothing to branch on in loops over several points.
    #[inline(always)]
    pub(crate) fn outside(&self, z: f32, u: f32, v: f32) -> i32 {
        let signs = (z - NEAREST).to_bits() | u.to_bits() | v.to_bits();
        let signs = signs | (self.last_u - u).to_bits() | (self.last_v - v).to_bits();
        (signs as i32) >> 31
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use skclam_geometry::Point3;

    proptest! {
        #[test]
        fn single_precision_agrees_with_the_camera(x in -0.5..0.5f64, y in -0.4..0.4f64, z in 0.2..4.0f64, distorted: bool) {
            let mut camera = PinholeCamera::from_hfov(640, 480, 1.0);
            if distorted {
                camera.distortion = [-0.1, 0.05, 1e-3, -5e-4, 0.01];
            }
            let projector = Projector::new(&camera);
            let (u, v) = projector.project((x * z) as f32, (y * z) as f32, z as f32);
            let pixel = camera.project(&Point3::new(x * z, y * z, z)).unwrap();
            // Positions at the border may round to either side of it.
            let inside = |margin: f64| pixel.x > margin - 0.5 && pixel.y > margin - 0.5
                && pixel.x < 639.5 - margin && pixel.y < 479.5 - margin;
            if inside(0.01) {
                prop_assert!(projector.sees(z as f32, u, v) && projector.outside(z as f32, u, v) == 0);
                prop_assert!((f64::from(u) - 0.5 - pixel.x).abs() < 1e-3 && (f64::from(v) - 0.5 - pixel.y).abs() < 1e-3);
            } else if !inside(-0.01) {
                prop_assert!(!projector.sees(z as f32, u, v) && projector.outside(z as f32, u, v) == -1);
            }
        }
    }

    #[test]
    fn nothing_behind_the_camera_is_seen() {
        let projector = Projector::new(&PinholeCamera::from_hfov(640, 480, 1.0));
        for z in [-1.0, 0.0, f32::NAN] {
            let (u, v) = projector.project(0.0, 0.0, z);
            assert!(!projector.sees(z, u, v));
            assert!(z.is_nan() || projector.outside(z, u, v) == -1);
        }
        let width = 640f32;
        assert_eq!((projector.outside(1.0, width, 3.0), projector.outside(1.0, width.next_down(), 3.0)), (-1, 0));
    }
}
