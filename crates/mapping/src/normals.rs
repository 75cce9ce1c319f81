//! Surface normals, and depths with less noise, from a depth image.
//!
//! A plane `n . X = c` seen at the normalised image point `(x, y)` has `1/z = (n_x x + n_y y + n_z) / c`: inverse depth
//! is linear over the image, and under noise `sigma = k z^2` its standard deviation is the same everywhere. So the
//! normal is the least-squares gradient of inverse depth over a window, without any bias from a steep view.
//! The same fit gives a depth with a fraction of the noise, wherever its residuals look like noise.
//!
mod fit;
mod inverse;

pub(crate) use inverse::InverseDepths;

use crate::DepthFilter;
use crate::rays::Rays;
use fit::{PARTIAL_RUN, RUN, fit_complete, fit_partial};
use nalgebra::Vector3;
use rayon::prelude::*;
use std::borrow::Cow;

/// Surroundings whose variance about the plane exceeds that of the noise by this factor are not flat.
const MAX_BENT: f32 = 2.0;

/// The window over which inverse depth is fitted: two units to each side.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormalWindow {
    /// Distance of the pixels that are used, pixels.
    unit: usize,
    /// Pixels of the camera between two pixels of the image at hand, which may be a thinned one.
    thinning: usize,
}

impl NormalWindow {
    /// The window of maps: nine pixels of the camera wide, of an image thinned by 1 or 2.
    pub(crate) fn of_maps(thinning: usize) -> Self {
        NormalWindow { unit: (2 / thinning).max(1), thinning }
    }

    /// Half its edge, pixels of the image at hand.
    fn radius(self) -> usize {
        2 * self.unit
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

/// The patches of a row of pixels, quantity by quantity; longer than the row by what fills the last run.
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

/// Fits planes to a depth image, row by row.
pub(crate) struct PatchFitter<'a> {
    depth: &'a [f32],
    rays: &'a Rays,
    filter: &'a DepthFilter,
    inverse: Cow<'a, InverseDepths>,
    window: NormalWindow,
}

impl<'a> PatchFitter<'a> {
    /// Of an image whose size is that of the rays.
    pub(crate) fn new(depth: &'a [f32], rays: &'a Rays, filter: &'a DepthFilter, window: NormalWindow) -> Self {
        let inverse = Cow::Owned(InverseDepths::of(depth, rays.width(), window));
        PatchFitter { depth, rays, filter, inverse, window }
    }

    /// As [`PatchFitter::new`], with the inverse depths at hand.
    pub(crate) fn with_inverse(
        depth: &'a [f32],
        inverse: &'a InverseDepths,
        rays: &'a Rays,
        filter: &'a DepthFilter,
        window: NormalWindow,
    ) -> Self {
        PatchFitter { depth, rays, filter, inverse: Cow::Borrowed(inverse), window }
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
            if out.depth[at..at + RUN].iter().all(|z| *z <= 0.0) {
                out.normal.iter_mut().for_each(|plane| plane[at..at + RUN].fill(0.0));
                continue;
            }
            let incomplete = fit_complete(self, y, at, out);
            for (part, incomplete) in incomplete.chunks(PARTIAL_RUN).enumerate() {
                if incomplete.contains(&true) {
                    // The complete pixels among them are fitted again, from their own depth.
                    let from = at + part * PARTIAL_RUN;
                    let end = width.min(from + PARTIAL_RUN);
                    out.depth[from..end].copy_from_slice(&own[from..end]);
                    fit_partial(self, y, from, out);
                }
            }
        }
    }
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
            let window = NormalWindow::of_maps(1);
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
        let window = NormalWindow::of_maps(1);
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
