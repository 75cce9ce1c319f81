//! Surface normals from a depth image.
//!
//! A plane `n . X = c` seen at the normalised image point `(x, y)` has `1/z = (n_x x + n_y y + n_z) / c`: inverse depth
//! is linear over the image, and under noise `sigma = k z^2` its standard deviation is the same everywhere. So the
//! normal is the least-squares gradient of inverse depth over a window, without any bias from a steep view.

use crate::DepthFilter;
use crate::view::Rays;
use nalgebra::Vector3;
use rayon::prelude::*;

/// The window over which inverse depth is fitted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormalWindow {
    /// Half its edge, pixels.
    pub(crate) radius: usize,
    /// Distance of the pixels that are used, pixels; divides `radius`.
    pub(crate) stride: usize,
}

/// Unit normals in the depth camera's frame, towards the camera; zero where there is no depth or too few neighbours lie
/// on the same surface.
pub(crate) fn normals_in_depth(
    depth: &[f32],
    rays: &Rays,
    filter: &DepthFilter,
    window: NormalWindow,
) -> Vec<Vector3<f32>> {
    let width = rays.width();
    let height = depth.len() / width.max(1);
    let mut normals = vec![Vector3::zeros(); depth.len()];
    normals.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, normal) in row.iter_mut().enumerate() {
            let index = y * width + x;
            let here = depth[index];
            if here <= 0.0 {
                continue;
            }
            // A neighbour n pixels away may differ by n steps; compared in inverse depth.
            let tolerance = filter.step_tolerance(here) / (here * here);
            let inverse = 1.0 / here;
            let (top, bottom) = (y.saturating_sub(window.radius), (y + window.radius).min(height - 1));
            let (left, right) = (x.saturating_sub(window.radius), (x + window.radius).min(width - 1));
            // Keep the grid centred on the pixel when the image's border cuts it.
            let top = y - (y - top) / window.stride * window.stride;
            let left = x - (x - left) / window.stride * window.stride;
            let (mut count, mut su, mut sv, mut sd) = (0f32, 0f32, 0f32, 0f32);
            let (mut suu, mut suv, mut svv, mut sud, mut svd) = (0f32, 0f32, 0f32, 0f32, 0f32);
            for row_y in (top..=bottom).step_by(window.stride) {
                let v = row_y as f32 - y as f32;
                for column in (left..=right).step_by(window.stride) {
                    let z = depth[row_y * width + column];
                    let u = column as f32 - x as f32;
                    let d = 1.0 / z - inverse;
                    // Without depth z is 0 and the difference infinite.
                    if d.abs() > tolerance * u.abs().max(v.abs()) {
                        continue;
                    }
                    count += 1.0;
                    su += u;
                    sv += v;
                    sd += d;
                    suu += u * u;
                    suv += u * v;
                    svv += v * v;
                    sud += u * d;
                    svd += v * d;
                }
            }
            if count < 4.0 {
                continue;
            }
            let (cuu, cuv, cvv) = (suu - su * su / count, suv - su * sv / count, svv - sv * sv / count);
            let (cud, cvd) = (sud - su * sd / count, svd - sv * sd / count);
            let determinant = cuu * cvv - cuv * cuv;
            if determinant <= 1e-3 * cuu * cvv || cuu <= 0.0 || cvv <= 0.0 {
                continue;
            }
            let by_u = (cud * cvv - cvd * cuv) / determinant;
            let by_v = (cvd * cuu - cud * cuv) / determinant;
            let here_fitted = inverse + (sd - by_u * su - by_v * sv) / count;
            // Per pixel to per unit of the normalised image; the distortion's local scale, within a few percent of
            // 1 in usual cameras, is left out.
            let (scale_x, scale_y) = rays.pixel_pitch();
            let (a, b) = (by_u / scale_x, by_v / scale_y);
            let ray = rays.direction(index);
            let direction = Vector3::new(a, b, here_fitted - a * ray.x - b * ray.y);
            let unit = direction / direction.norm();
            if unit.iter().all(|value| value.is_finite()) {
                // n . X = c with c > 0 points away from the camera.
                *normal = -unit;
            }
        }
    });
    normals
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use skclam_geometry::PinholeCamera;

    proptest! {
        #[test]
        fn the_normal_of_a_plane_is_exact_even_when_steep(tilt_x in -1.2..1.2f64, tilt_y in -1.0..1.0f64) {
            let camera = PinholeCamera::from_hfov(48, 36, 0.5);
            let rays = Rays::new(&camera);
            let expected = nalgebra::Rotation3::from_euler_angles(tilt_y, tilt_x, 0.0) * Vector3::new(0.0, 0.0, -1.0);
            // n . X = n . (0, 0, 1) with X = z ray.
            let depth: Vec<f32> = (0..48 * 36).map(|index| {
                let ray = rays.direction(index).cast::<f64>();
                let z = expected.z / expected.dot(&ray);
                if z > 0.0 && z < 50.0 { z as f32 } else { 0.0 }
            }).collect();
            let filter = DepthFilter::default();
            let window = NormalWindow { radius: 3, stride: 1 };
            let normals = normals_in_depth(&depth, &rays, &filter, window);
            let centre = normals[18 * 48 + 24].cast::<f64>();
            prop_assert!((centre - expected).norm() < 2e-2, "{centre} {expected}");
        }
    }

    #[test]
    fn holes_and_lone_pixels_have_no_normal() {
        let camera = PinholeCamera::from_hfov(9, 9, 1.0);
        let mut depth = vec![0.0; 81];
        depth[40] = 1.0;
        let window = NormalWindow { radius: 2, stride: 2 };
        let normals = normals_in_depth(&depth, &Rays::new(&camera), &DepthFilter::default(), window);
        assert!(normals.iter().all(|normal| *normal == Vector3::zeros()));
    }
}
