//! Surface normals, and depths with less noise, from a depth image.
//!
//! A plane `n . X = c` seen at the normalised image point `(x, y)` has `1/z = (n_x x + n_y y + n_z) / c`: inverse depth
//! is linear over the image, and under noise `sigma = k z^2` its standard deviation is the same everywhere. So the
//! normal is the least-squares gradient of inverse depth over a window, without any bias from a steep view.
//! The same fit gives a depth with a fraction of the noise, wherever its residuals look like noise.
//!
//! Where the window is complete, the fit is that of `complete`. Elsewhere eight pixels of a row are fitted at a time, with
//! their sums in registers.

mod complete;

use crate::DepthFilter;
use crate::rays::Rays;
use complete::{RUN, fit_run};
use multiversion::multiversion;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::borrow::Cow;
use wide::f32x8;

/// Surroundings whose variance about the plane exceeds that of the noise by this factor are not flat.
const MOST_BENT: f32 = 2.0;
/// Pixels that are fitted together.
const LANES: usize = 8;

/// The window over which inverse depth is fitted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormalWindow {
    /// Half its edge, pixels.
    pub(crate) radius: usize,
    /// Distance of the pixels that are used, pixels; divides `radius`.
    pub(crate) stride: usize,
    /// Pixels of the camera between two pixels of the image at hand, which may be a thinned one.
    pub(crate) thinning: usize,
}

impl NormalWindow {
    /// The window of maps: nine pixels of the camera wide.
    pub(crate) fn of_maps(thinning: usize) -> Self {
        NormalWindow { radius: 4 / thinning, stride: (2 / thinning).max(1), thinning }
    }
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

/// The patches of a row of pixels, quantity by quantity; longer than the row by what fills the last eight.
#[derive(Debug, Clone, Default)]
pub(crate) struct PatchRow {
    /// x, y, z of the normals.
    pub(crate) normal: [Vec<f32>; 3],
    /// Depths of the planes.
    pub(crate) depth: Vec<f32>,
}

impl PatchRow {
    /// The patch of a pixel.
    pub(crate) fn at(&self, x: usize) -> SurfacePatch {
        let [nx, ny, nz] = &self.normal;
        SurfacePatch { normal: Vector3::new(nx[x], ny[x], nz[x]), depth: self.depth[x] }
    }
}

/// One pixel of the window.
struct Neighbour {
    /// How far it stands behind the centre in the padded image.
    step: isize,
    u: f32,
    v: f32,
    /// Tolerances that its depth may differ by: one a pixel of the camera.
    reach: f32,
}

/// Fits planes to a depth image, row by row.
pub(crate) struct PatchFitter<'a> {
    depth: &'a [f32],
    rays: &'a Rays,
    filter: &'a DepthFilter,
    neighbours: Vec<Neighbour>,
    inverse: Cow<'a, InverseDepths>,
    /// Distance of the pixels that are used, and what they are thinned by.
    unit: usize,
    thinning: usize,
    /// Whether the window is the one that `complete` knows.
    is_five_by_five: bool,
}

/// Inverse depths with a border as wide as the window on all sides; infinite where there is none.
#[derive(Debug, Clone, Default)]
pub(crate) struct InverseDepths {
    values: Vec<f32>,
    stride: usize,
    margin: usize,
}

impl InverseDepths {
    fn of(depth: &[f32], width: usize, window: NormalWindow) -> Self {
        let mut inverse = InverseDepths::default();
        let bands = inverse.bands_mut(width, depth.len() / width.max(1), 1, window);
        bands.zip(depth.par_chunks(width.max(1))).for_each(|(padded, row)| window.invert(row, padded));
        inverse
    }

    /// Length of a row with its borders.
    pub(crate) fn stride_of(width: usize, window: NormalWindow) -> usize {
        width.next_multiple_of(RUN) + 2 * window.radius
    }

    /// Makes room for an image and gives its rows with their borders, several at a time, to [`NormalWindow::invert`].
    pub(crate) fn bands_mut(
        &mut self,
        width: usize,
        height: usize,
        rows: usize,
        window: NormalWindow,
    ) -> rayon::slice::ChunksMut<'_, f32> {
        let margin = window.radius;
        let stride = Self::stride_of(width, window);
        let length = stride * (height + 2 * margin);
        if (self.stride, self.margin, self.values.len()) != (stride, margin, length) {
            *self = InverseDepths { values: vec![f32::INFINITY; length], stride, margin };
        }
        self.values[stride * margin..stride * (height + margin)].par_chunks_mut(stride * rows)
    }
}

impl NormalWindow {
    /// Writes the inverse depths of a row of pixels into a row of [`InverseDepths`].
    pub(crate) fn invert(&self, row: &[f32], padded: &mut [f32]) {
        for (inverse, z) in padded[self.radius..].iter_mut().zip(row) {
            *inverse = 1.0 / z;
        }
    }
}

impl<'a> PatchFitter<'a> {
    /// Of an image whose size is that of the rays.
    pub(crate) fn new(depth: &'a [f32], rays: &'a Rays, filter: &'a DepthFilter, window: NormalWindow) -> Self {
        let inverse = InverseDepths::of(depth, rays.width(), window);
        Self::with_inverse(depth, Cow::Owned(inverse), rays, filter, window)
    }

    /// As [`PatchFitter::new`], with the inverse depths at hand.
    pub(crate) fn with_inverse(
        depth: &'a [f32],
        inverse: Cow<'a, InverseDepths>,
        rays: &'a Rays,
        filter: &'a DepthFilter,
        window: NormalWindow,
    ) -> Self {
        let stride = inverse.stride;
        let offsets = || (-(window.radius as isize)..=window.radius as isize).step_by(window.stride.max(1));
        let neighbours = offsets()
            .flat_map(|v| offsets().map(move |u| (u, v)))
            // Every second one, like the black fields of a chess board: half the work, the same reach. The centre
            // differs from itself by nothing.
            .filter(|&(u, v)| (u + v) / window.stride.max(1) as isize % 2 == 0 && (u, v) != (0, 0))
            .map(|(u, v)| {
                let reach = (u.abs().max(v.abs()) as usize * window.thinning) as f32;
                Neighbour { step: v * stride as isize + u, u: u as f32, v: v as f32, reach }
            })
            .collect();
        let is_five_by_five = window.radius == 2 * window.stride;
        let (unit, thinning) = (window.stride, window.thinning);
        PatchFitter { depth, rays, filter, neighbours, inverse, unit, thinning, is_five_by_five }
    }

    /// Fits the planes of a row of pixels.
    pub(crate) fn row(&self, y: usize, out: &mut PatchRow) {
        let width = self.rays.width();
        let padded = width.next_multiple_of(RUN);
        for plane in out.normal.iter_mut().chain([&mut out.depth]) {
            plane.resize(padded, 0.0);
        }
        let own = &self.depth[y * width..(y + 1) * width];
        out.depth[..width].copy_from_slice(own);
        out.depth[width..].fill(0.0);
        for at in (0..padded).step_by(RUN) {
            let mut incomplete: [bool; RUN] = std::array::from_fn(|x| out.depth[at + x] > 0.0);
            if !incomplete.contains(&true) {
                out.normal.iter_mut().for_each(|plane| plane[at..at + RUN].fill(0.0));
            } else if self.is_five_by_five {
                incomplete = fit_run(self, y, at, out);
            }
            for (group, incomplete) in incomplete.chunks(LANES).enumerate() {
                if incomplete.contains(&true) {
                    let at = at + group * LANES;
                    // A complete pixel beside an incomplete one is fitted again, from its own depth.
                    let end = width.min(at + LANES);
                    out.depth[at..end].copy_from_slice(&own[at..end]);
                    fit_eight(self, y, at, out);
                }
            }
        }
    }
}

/// Eight values from a place on; zeros beyond the end.
#[inline(always)]
fn load(row: &[f32], at: usize) -> f32x8 {
    let mut lanes = [0.0; LANES];
    match row.get(at..at + LANES) {
        Some(full) => lanes.copy_from_slice(full),
        None => lanes[..row.len() - at].copy_from_slice(&row[at..]),
    }
    f32x8::from(lanes)
}

/// Fits the planes of eight pixels; `u`, `v` are pixels from the centre, `d` the difference in inverse depth.
#[multiversion(targets("x86_64+avx2"))]
fn fit_eight(fitter: &PatchFitter<'_>, y: usize, at: usize, out: &mut PatchRow) {
    let zero = f32x8::splat(0.0);
    let one = f32x8::splat(1.0);
    let (share, floor, quadratic) = fitter.filter.step_coefficients();
    let z = load(&out.depth, at);
    let inverse = &fitter.inverse.values;
    let centre = (y + fitter.inverse.margin) * fitter.inverse.stride + fitter.inverse.margin + at;
    let here = load(inverse, centre);
    let tolerance = (z * share + floor + z * z * quadratic) * here * here;
    let (mut count, mut su, mut sv, mut sd) = (one, zero, zero, zero);
    let (mut suu, mut suv, mut svv) = (zero, zero, zero);
    let (mut sud, mut svd, mut sdd) = (zero, zero, zero);
    for &Neighbour { step, u, v, reach } in &fitter.neighbours {
        // Where there is no depth the inverse is infinite or the difference not a number: it does not count.
        let difference = load(inverse, centre.wrapping_add_signed(step)) - here;
        let counts = difference.abs().simd_le(tolerance * reach);
        let one = counts & one;
        let d = counts & difference;
        let (wu, wv) = (one * u, one * v);
        count += one;
        su += wu;
        sv += wv;
        sd += d;
        suu += wu * u;
        suv += wu * v;
        svv += wv * v;
        sud += d * u;
        svd += d * v;
        sdd += d * d;
    }
    let inverse_count = one / count;
    let cuu = suu - su * su * inverse_count;
    let cuv = suv - su * sv * inverse_count;
    let cvv = svv - sv * sv * inverse_count;
    let (cud, cvd) = (sud - su * sd * inverse_count, svd - sv * sd * inverse_count);
    let determinant = cuu * cvv - cuv * cuv;
    let spans = count.simd_ge(f32x8::splat(5.0))
        & cuu.simd_gt(zero)
        & cvv.simd_gt(zero)
        & determinant.simd_gt(cuu * cvv * 1e-3)
        & z.simd_gt(zero);
    let inverse_determinant = one / determinant;
    let by_u = (cud * cvv - cvd * cuv) * inverse_determinant;
    let by_v = (cvd * cuu - cud * cuv) * inverse_determinant;
    let at_centre = (sd - by_u * su - by_v * sv) * inverse_count;
    let rest = (sdd - sd * sd * inverse_count - by_u * cud - by_v * cvd).max(zero) / (count - 3.0);
    // Per pixel to per unit of the normalised image; the distortion's local scale, within a few percent of 1 in usual
    // cameras, is left out.
    let (pitch_x, pitch_y) = fitter.rays.pixel_pitch();
    let (ray_x, ray_y) = fitter.rays.row(y);
    let (a, b) = (by_u * (1.0 / pitch_x), by_v * (1.0 / pitch_y));
    let fitted = here + at_centre;
    let c = fitted - a * load(ray_x, at) - b * load(ray_y, at);
    let squared = a * a + b * b + c * c;
    let good = spans & squared.simd_gt(zero) & squared.simd_lt(f32x8::splat(f32::MAX));
    // n . X = c with c > 0 points away from the camera.
    let scale = -one / squared.sqrt();
    for (plane, value) in out.normal.iter_mut().zip([a, b, c]) {
        plane[at..at + LANES].copy_from_slice(&(good & (value * scale)).to_array());
    }
    let noise = &fitter.filter.noise;
    let sigma = (z * z * noise.quadratic_per_m as f32 + noise.floor_m as f32) * here * here;
    let flat = good & rest.simd_le(sigma * sigma * MOST_BENT) & fitted.simd_gt(zero);
    out.depth[at..at + LANES].copy_from_slice(&flat.select(one / fitted, z).to_array());
}

/// Fits a plane to the surroundings of every pixel with a depth; row-major.
pub(crate) fn surface_patches(
    depth: &[f32],
    rays: &Rays,
    filter: &DepthFilter,
    window: NormalWindow,
) -> Vec<SurfacePatch> {
    let fitter = PatchFitter::new(depth, rays, filter, window);
    let width = rays.width().max(1);
    let mut patches = vec![SurfacePatch { normal: Vector3::zeros(), depth: 0.0 }; depth.len()];
    patches.par_chunks_mut(width).enumerate().for_each_init(PatchRow::default, |fitted, (y, row)| {
        fitter.row(y, fitted);
        for (x, patch) in row.iter_mut().enumerate() {
            *patch = fitted.at(x);
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
            let window = NormalWindow { radius: 3, stride: 1, thinning: 1 };
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
        let window = NormalWindow { radius: 2, stride: 2, thinning: 1 };
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
        let window = NormalWindow::of_maps(1);
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
