//! How a patch changes from one image to another beyond its linear part, if it shows a piece of a plane.
//!
//! Two cameras see a plane `1/z = w + g . (x - x0)` (x: ray with z = 1) through a homography: the ray `x` of camera A
//! goes to `R x + t (w + g . (x - x0))` in camera B. Its linear part at `x0` is linear in the slant `g`, so that `g`
//! follows from the linear part that the alignment of the patches found, and the part of second order from `g`. The
//! poses are those of the nominal rig: what they are off changes the part of second order by some per cent.

use super::ImageFeatures;
use nalgebra::{Matrix2, Vector2, Vector3};
use skclam_features::{Bend, Observation, WarpPrediction};
use skclam_geometry::{Isometry3, PinholeCamera, Pixel, Point3};

/// Step of the differences, px: about the sigma of the window in which patches are aligned.
const STEP_PX: f64 = 6.0;
/// What the found linear part is trusted to, mostly since the nominal rig's rotations are off: the noise beside the
/// slant's own spread.
const LINEAR_SIGMA: f64 = 0.02;
/// Spread of slants, `g / w`: a surface at 45 degrees has 1.
const SLANT_SIGMA: f64 = 0.7;
/// Rays that meet at less than this angle give no depth, rad.
const MIN_PARALLAX: f64 = 0.02;

/// Predicts from the nominal poses, the camera, and depths where they were measured.
#[derive(Debug)]
pub struct PlaneWarp<'a> {
    /// What the images showed, in the order of the tracks' image numbers.
    pub images: &'a [ImageFeatures],
    /// The colour camera.
    pub camera: &'a PinholeCamera,
}

impl WarpPrediction for PlaneWarp<'_> {
    fn bend(
        &self,
        reference: Observation,
        observation: Observation,
        b_from_a: &Matrix2<f64>,
        in_b: &Pixel,
    ) -> Option<Bend> {
        let [a, b] = [reference, observation].map(|o| (&self.images[o.image as usize], o.keypoint as usize));
        let keypoint = &a.0.features.keypoints[a.1];
        let in_a = Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y));
        let pose = b.0.view.base_from_color.inverse() * a.0.view.base_from_color;
        let view = TwoViews { camera: self.camera, b_from_a: pose, in_a, ray: self.camera.unproject(&in_a) };
        let inverse_depth = match a.0.depth_m[a.1] {
            Some(depth_m) => 1.0 / depth_m,
            None => view.inverse_depth(in_b)?,
        };
        let slant = view.slant(inverse_depth, b_from_a)?;
        view.bend(inverse_depth, &slant)
    }
}

/// One match and the cameras that saw it.
struct TwoViews<'a> {
    camera: &'a PinholeCamera,
    b_from_a: Isometry3,
    in_a: Pixel,
    /// Of the point in A, z = 1.
    ray: Vector3<f64>,
}

impl TwoViews<'_> {
    /// Inverse depth in A of the point where the rays come nearest to each other, 1/m; `None` where they are nearly
    /// parallel or meet behind.
    fn inverse_depth(&self, in_b: &Pixel) -> Option<f64> {
        let (along, t) = (self.b_from_a.rotation * self.ray, self.b_from_a.translation.vector);
        let toward = self.camera.unproject(in_b);
        // z along + t is parallel to `toward`.
        let (across, along_baseline) = (along.cross(&toward), t.cross(&toward));
        let parallax = across.norm() / (along.norm() * toward.norm());
        let inverse_depth = -across.norm_squared() / across.dot(&along_baseline);
        (parallax > MIN_PARALLAX && inverse_depth.is_finite() && inverse_depth > 0.0).then_some(inverse_depth)
    }

    /// Where B shows what A shows at an offset from the point, on a plane.
    fn mapped(&self, inverse_depth: f64, slant: &Vector2<f64>, offset: Vector2<f64>) -> Option<Vector2<f64>> {
        let ray = self.camera.unproject(&(self.in_a + offset));
        let inverse = inverse_depth * (1.0 + slant.dot(&(ray - self.ray).xy()));
        let in_b = self.b_from_a.rotation * ray + self.b_from_a.translation.vector * inverse;
        Some(self.camera.project(&Point3::from(in_b))?.coords)
    }

    fn linear(&self, inverse_depth: f64, slant: &Vector2<f64>) -> Option<Matrix2<f64>> {
        let column = |axis: Vector2<f64>| {
            let [ahead, back] = [STEP_PX, -STEP_PX].map(|step| self.mapped(inverse_depth, slant, axis * step));
            Some((ahead? - back?) / (2.0 * STEP_PX))
        };
        Some(Matrix2::from_columns(&[column(Vector2::x())?, column(Vector2::y())?]))
    }

    /// The slant `g / w` that explains the linear part best.
    fn slant(&self, inverse_depth: f64, b_from_a: &Matrix2<f64>) -> Option<Vector2<f64>> {
        let level = self.linear(inverse_depth, &Vector2::zeros())?;
        let off = b_from_a - level;
        let ridge = (LINEAR_SIGMA / SLANT_SIGMA).powi(2);
        let mut normal = Matrix2::identity() * ridge;
        let mut right = Vector2::zeros();
        let by = [Vector2::x(), Vector2::y()].map(|axis| Some(self.linear(inverse_depth, &axis)? - level));
        let by = [by[0]?, by[1]?];
        for i in 0..2 {
            right[i] = by[i].dot(&off);
            for j in 0..2 {
                normal[(i, j)] += by[i].dot(&by[j]);
            }
        }
        Some(normal.try_inverse()? * right)
    }

    /// Second differences of the map.
    fn bend(&self, inverse_depth: f64, slant: &Vector2<f64>) -> Option<Bend> {
        let at = |x: f64, y: f64| self.mapped(inverse_depth, slant, Vector2::new(x, y) * STEP_PX);
        let square = STEP_PX * STEP_PX;
        let twice = at(0.0, 0.0)? * 2.0;
        let uu = (at(1.0, 0.0)? + at(-1.0, 0.0)? - twice) / (2.0 * square);
        let vv = (at(0.0, 1.0)? + at(0.0, -1.0)? - twice) / (2.0 * square);
        let uv = (at(1.0, 1.0)? + at(-1.0, -1.0)? - at(1.0, -1.0)? - at(-1.0, 1.0)?) / (4.0 * square);
        Some(Bend([0, 1].map(|axis| [uu[axis], uv[axis], vv[axis]])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slanted plane between two distorted views: the second-order part that follows from the true linear part is
    /// that of the true map.
    #[test]
    fn the_bend_of_a_plane_follows_from_its_linear_part() {
        let mut camera = PinholeCamera::from_hfov(1280, 720, 1.2);
        camera.distortion[0] = -0.12;
        let b_from_a = Isometry3::new(Vector3::new(-0.25, 0.1, 0.15), Vector3::new(0.05, 0.2, -0.4));
        let in_a = Pixel::new(700.0, 300.0);
        let view = TwoViews { camera: &camera, b_from_a, in_a, ray: camera.unproject(&in_a) };
        let (inverse_depth, slant) = (1.0 / 0.9, Vector2::new(0.6, -0.3));
        let linear = view.linear(inverse_depth, &slant).unwrap();
        let found = view.slant(inverse_depth, &linear).unwrap();
        assert!((found - slant).norm() < 0.02, "{found:?}");
        let Bend(factors) = view.bend(inverse_depth, &found).unwrap();
        // Away from the differences' own steps the map is what linear and second-order part make of it.
        let here = view.mapped(inverse_depth, &slant, Vector2::zeros()).unwrap();
        for offset in [Vector2::new(5.0, -3.0), Vector2::new(-4.0, 6.0), Vector2::new(7.0, 7.0)] {
            let (u, v) = (offset.x, offset.y);
            let bent = Vector2::from(factors.map(|[uu, uv, vv]| uu * u * u + uv * u * v + vv * v * v));
            let expected = view.mapped(inverse_depth, &slant, offset).unwrap();
            let straight = here + linear * offset;
            assert!((expected - straight).norm() > 1e-4, "nothing to predict");
            assert!((expected - straight - bent).norm() < 0.15 * (expected - straight).norm());
        }
        let in_b = Pixel::from(here);
        assert!((view.inverse_depth(&in_b).unwrap() - inverse_depth).abs() < 1e-9);
        let turned = TwoViews { b_from_a: Isometry3::rotation(Vector3::new(0.1, 0.2, 0.0)), ..view };
        let in_b = Pixel::from(turned.mapped(1.0, &slant, Vector2::zeros()).unwrap());
        assert_eq!(turned.inverse_depth(&in_b), None, "no baseline, no depth");
    }
}
