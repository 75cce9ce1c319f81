//! Surface normals, and depths with less noise, from a depth image.
//!
//! A plane `n . X = c` seen at the normalised image point `(x, y)` has `1/z = (n_x x + n_y y + n_z) / c`: inverse depth
//! is linear over the image, and under noise `sigma = k z^2` its standard deviation is the same everywhere. So the
//! normal is the least-squares gradient of inverse depth over a window, without any bias from a steep view.
//! The same fit gives a depth with a fraction of the noise, wherever its residuals look like noise.

use crate::DepthFilter;
use crate::view::Rays;
use multiversion::multiversion;
use nalgebra::Vector3;
use rayon::prelude::*;

/// Surroundings whose variance about the plane exceeds that of the noise by this factor are not flat.
const MOST_BENT: f32 = 2.0;

/// The window over which inverse depth is fitted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormalWindow {
    /// Half its edge, pixels.
    pub(crate) radius: usize,
    /// Distance of the pixels that are used, pixels; divides `radius`.
    pub(crate) stride: usize,
}

/// The plane of a pixel's surroundings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SurfacePatch {
    /// Unit normal in the depth camera's frame, towards the camera; zero where there is no depth or too few neighbours
    /// lie on the same surface.
    pub(crate) normal: Vector3<f32>,
    /// Depth of the plane at the pixel, metres: less noisy than the pixel's own, which it is where the surroundings
    /// bend by more than the noise explains.
    pub(crate) depth: f32,
}

/// Sums over a window for one row of pixels, one entry a pixel; `u`, `v` are pixels from the centre, `d` the difference
/// in inverse depth.
struct Sums {
    count: Vec<f32>,
    u: Vec<f32>,
    v: Vec<f32>,
    d: Vec<f32>,
    uu: Vec<f32>,
    uv: Vec<f32>,
    vv: Vec<f32>,
    ud: Vec<f32>,
    vd: Vec<f32>,
    dd: Vec<f32>,
}

impl Sums {
    fn new(width: usize) -> Self {
        let zeros = || vec![0.0; width];
        Sums {
            count: zeros(),
            u: zeros(),
            v: zeros(),
            d: zeros(),
            uu: zeros(),
            uv: zeros(),
            vv: zeros(),
            ud: zeros(),
            vd: zeros(),
            dd: zeros(),
        }
    }

    /// Slopes of inverse depth along u and v, its difference at the centre, and the variance of what remains; `None`
    /// where the neighbours do not span a plane.
    fn fit(&self, x: usize) -> Option<(f32, f32, f32, f32)> {
        let n = self.count[x];
        if n < 5.0 {
            return None;
        }
        let (su, sv, sd) = (self.u[x], self.v[x], self.d[x]);
        let (cuu, cuv, cvv) = (self.uu[x] - su * su / n, self.uv[x] - su * sv / n, self.vv[x] - sv * sv / n);
        let (cud, cvd) = (self.ud[x] - su * sd / n, self.vd[x] - sv * sd / n);
        let determinant = cuu * cvv - cuv * cuv;
        if determinant <= 1e-3 * cuu * cvv || cuu <= 0.0 || cvv <= 0.0 {
            return None;
        }
        let by_u = (cud * cvv - cvd * cuv) / determinant;
        let by_v = (cvd * cuu - cud * cuv) / determinant;
        let at_centre = (sd - by_u * su - by_v * sv) / n;
        let rest = (self.dd[x] - sd * sd / n - by_u * cud - by_v * cvd).max(0.0) / (n - 3.0);
        Some((by_u, by_v, at_centre, rest))
    }
}

/// Adds the neighbour `(u, v)` of the pixels `from..`: `here` and `there` are inverse depths of the pixels and of their
/// neighbours, and a neighbour counts that differs by no more than `max(|u|, |v|)` tolerances.
#[multiversion(targets("x86_64+avx2"))]
fn add_neighbours(sums: &mut Sums, from: usize, (u, v): (f32, f32), here: &[f32], there: &[f32], tolerance: &[f32]) {
    let end = from + here.len();
    let reach = u.abs().max(v.abs());
    let (uu, uv, vv) = (u * u, u * v, v * v);
    // Equal lengths, known to the compiler, let it work on several pixels at a time.
    let length = here.len();
    let (there, tolerance) = (&there[..length], &tolerance[..length]);
    let (count, sum_u, sum_v) = (&mut sums.count[from..end], &mut sums.u[from..end], &mut sums.v[from..end]);
    let (sum_uu, sum_uv, sum_vv) = (&mut sums.uu[from..end], &mut sums.uv[from..end], &mut sums.vv[from..end]);
    let (sum_d, sum_dd) = (&mut sums.d[from..end], &mut sums.dd[from..end]);
    let (sum_ud, sum_vd) = (&mut sums.ud[from..end], &mut sums.vd[from..end]);
    for x in 0..length {
        // Where there is no depth the inverse is infinite or the difference not a number: it does not count.
        let difference = there[x] - here[x];
        let counts = difference.abs() <= tolerance[x] * reach;
        let one = if counts { 1.0 } else { 0.0 };
        let d = if counts { difference } else { 0.0 };
        count[x] += one;
        sum_u[x] += u * one;
        sum_v[x] += v * one;
        sum_uu[x] += uu * one;
        sum_uv[x] += uv * one;
        sum_vv[x] += vv * one;
        sum_d[x] += d;
        sum_ud[x] += u * d;
        sum_vd[x] += v * d;
        sum_dd[x] += d * d;
    }
}

/// Fits a plane to the surroundings of every pixel; row-major.
pub(crate) fn surface_patches(
    depth: &[f32],
    rays: &Rays,
    filter: &DepthFilter,
    window: NormalWindow,
) -> Vec<SurfacePatch> {
    let width = rays.width();
    if width == 0 {
        return Vec::new();
    }
    let height = depth.len() / width;
    let inverse: Vec<f32> = depth.iter().map(|z| 1.0 / z).collect();
    let mut patches = vec![SurfacePatch { normal: Vector3::zeros(), depth: 0.0 }; depth.len()];
    let offsets: Vec<isize> = (-(window.radius as isize)..=window.radius as isize).step_by(window.stride).collect();
    let (floor, quadratic) = (filter.noise.floor_m as f32, filter.noise.quadratic_per_m as f32);
    patches.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let own = &depth[y * width..(y + 1) * width];
        if own.iter().all(|z| *z <= 0.0) {
            return;
        }
        let here = &inverse[y * width..(y + 1) * width];
        let tolerance: Vec<f32> = own.iter().map(|&z| filter.step_tolerance(z) / (z * z)).collect();
        // Nothing to do beyond the first and the last pixel with a depth.
        let begin = own.iter().position(|z| *z > 0.0).unwrap_or(0);
        let finish = own.iter().rposition(|z| *z > 0.0).map_or(0, |last| last + 1);
        let mut sums = Sums::new(width);
        for &v in &offsets {
            let Some(other) = y.checked_add_signed(v).filter(|other| *other < height) else { continue };
            let there = &inverse[other * width..(other + 1) * width];
            for &u in &offsets {
                // Every second neighbour, like the black fields of a chess board: half the work, the same reach.
                if (u + v) / window.stride as isize % 2 != 0 {
                    continue;
                }
                let first = begin.max((-u).max(0) as usize);
                let end = finish.min((width as isize - u).clamp(0, width as isize) as usize);
                if first < end {
                    let shifted = &there[(first as isize + u) as usize..];
                    let (here, tolerance) = (&here[first..end], &tolerance[first..end]);
                    add_neighbours(&mut sums, first, (u as f32, v as f32), here, shifted, tolerance);
                }
            }
        }
        for (x, patch) in row.iter_mut().enumerate() {
            let z = own[x];
            if z <= 0.0 {
                continue;
            }
            patch.depth = z;
            let Some((by_u, by_v, at_centre, rest)) = sums.fit(x) else { continue };
            // Per pixel to per unit of the normalised image; the distortion's local scale, within a few percent of
            // 1 in usual cameras, is left out.
            let (scale_x, scale_y) = rays.pixel_pitch();
            let (a, b) = (by_u / scale_x, by_v / scale_y);
            let ray = rays.direction(y * width + x);
            let fitted = here[x] + at_centre;
            let direction = Vector3::new(a, b, fitted - a * ray.x - b * ray.y);
            let unit = direction / direction.norm();
            if !unit.iter().all(|value| value.is_finite()) {
                continue;
            }
            // n . X = c with c > 0 points away from the camera.
            patch.normal = -unit;
            let noise = (floor + quadratic * z * z) / (z * z);
            if rest <= MOST_BENT * noise * noise {
                patch.depth = 1.0 / fitted;
            }
        }
    });
    patches
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
            let patches = surface_patches(&depth, &rays, &filter, window);
            let centre = patches[18 * 48 + 24].normal.cast::<f64>();
            prop_assert!((centre - expected).norm() < 2e-2, "{centre} {expected}");
        }
    }

    #[test]
    fn holes_and_lone_pixels_have_no_normal() {
        let camera = PinholeCamera::from_hfov(9, 9, 1.0);
        let mut depth = vec![0.0; 81];
        depth[40] = 1.0;
        let window = NormalWindow { radius: 2, stride: 2 };
        let patches = surface_patches(&depth, &Rays::new(&camera), &DepthFilter::default(), window);
        assert!(patches.iter().all(|patch| patch.normal == Vector3::zeros()));
        assert_eq!(patches[40].depth, 1.0);
    }

    #[test]
    fn a_noisy_wall_is_smoothed_and_a_ridge_is_not() {
        let camera = PinholeCamera::from_hfov(60, 60, 1.0);
        let rays = Rays::new(&camera);
        let filter = DepthFilter::default();
        let sigma = filter.noise.sigma(1.0) as f32;
        let noise = |i: usize| sigma * ((i as f32 * 12.9898).sin() * 43758.547).fract() * 1.7;
        let wall: Vec<f32> = (0..3600).map(|i| 1.0 + noise(i)).collect();
        let window = NormalWindow { radius: 4, stride: 2 };
        let rms = |depths: &mut dyn Iterator<Item = f32>| {
            let squares: Vec<f32> = depths.map(|z| (z - 1.0).powi(2)).collect();
            (squares.iter().sum::<f32>() / squares.len() as f32).sqrt()
        };
        let patches = surface_patches(&wall, &rays, &filter, window);
        let (before, after) = (rms(&mut wall.iter().copied()), rms(&mut patches.iter().map(|patch| patch.depth)));
        assert!(after < 0.4 * before, "{before} {after}");
        // A roof whose ridge is ten sigma above the ends of the window.
        let roof: Vec<f32> = (0..3600).map(|i| 1.0 + 2.5 * sigma * ((i % 60) as f32 - 30.0).abs()).collect();
        let ridge = surface_patches(&roof, &rays, &filter, window)[30 * 60 + 30];
        assert_eq!(ridge.depth, 1.0);
    }
}
