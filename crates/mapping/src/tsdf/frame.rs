//! One image prepared for fusion: for every pixel the plane of its surroundings, its weight and its colour.

use super::TsdfOptions;
use crate::View;
use crate::color_lookup::{ColorLookup, ColorPlaces};
use crate::normals::{NormalWindow, PatchFitter, PatchRow};
use crate::projector::Projector;
use crate::rays::Rays;
use multiversion::multiversion;
use nalgebra::Isometry3;
use rayon::prelude::*;
use skclam_geometry::PinholeCamera;

/// Pixels along the edge of a tile of [`Frame::farthest_in_tile`].
pub(super) const TILE: usize = 16;
/// A surface seen flatter than this (cosine) weighs no less.
const LEAST_COSINE: f32 = 0.1;

/// What a voxel needs to know of the pixel it is seen at, in half a line of the cache.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(32))]
pub(super) struct Pixel {
    /// z-depth of the plane, metres; 0 = nothing is known.
    pub(super) depth: f32,
    /// Unit normal of the surface, towards the camera, in the depth camera's frame.
    pub(super) normal: [f32; 3],
    /// `normal . point` of the surface.
    pub(super) offset: f32,
    /// Inverse variance relative to that at 1 m, times the cosine of the viewing angle.
    pub(super) weight: f32,
    /// Red, green, blue, and 1 if there is a colour.
    pub(super) color: [u8; 4],
}

const NOTHING: Pixel = Pixel { depth: 0.0, normal: [0.0; 3], offset: 0.0, weight: 0.0, color: [0; 4] };

/// An image ready to be fused.
pub(super) struct Frame {
    pub(super) camera: PinholeCamera,
    pub(super) projector: Projector,
    pub(super) base_from_depth: Isometry3<f64>,
    /// Row-major, and one more at the end at which nothing is known, for voxels outside the image.
    pub(super) surface: Vec<Pixel>,
    /// z-depths of the planes, metres; 0 = nothing is known.
    pub(super) depth: Vec<f32>,
    /// Largest depth in each tile of 16 x 16 pixels, 0 where there is none.
    pub(super) farthest_in_tile: Vec<f32>,
    pub(super) tiles_x: usize,
    /// Largest depth of all.
    pub(super) farthest: f32,
    /// Believed pixels.
    pub(super) pixels: usize,
    /// Pixels of the camera between two of the frame.
    pub(super) thinning: usize,
}

impl Frame {
    /// `cameras` are kept from image to image.
    pub(super) fn new(view: &View<'_>, cameras: &mut FrameCameras, options: &TsdfOptions) -> Self {
        let full = cameras.full(&view.depth_camera.camera);
        let believed = view.believed_depth_along(&options.filter, full);
        let thinning = thinning(&believed, &view.depth_camera.camera, options.voxel_m);
        let pixels = believed.iter().filter(|z| **z > 0.0).count();
        let depth = thinned(believed, full.width(), thinning);
        let rays = cameras.thinned(&view.depth_camera.camera, thinning);
        let camera = *rays.camera();
        let width = camera.width.max(1) as usize;
        let fitter = PatchFitter::new(&depth, rays, &options.filter, NormalWindow::of_maps(thinning));
        let lookup = view.color.map(|image| (image, ColorLookup::new(view)));
        let noise = &options.filter.noise;
        let noise = (noise.floor_m as f32, noise.quadratic_per_m as f32);
        let mut surface = vec![NOTHING; depth.len() + 1];
        let mut fitted_depth = vec![0f32; depth.len()];
        surface[..depth.len()].par_chunks_mut(width).zip(fitted_depth.par_chunks_mut(width)).enumerate().for_each_init(
            <(PatchRow, ColorPlaces)>::default,
            |(patches, places), (y, (row, depths))| {
                fitter.row(y, patches);
                depths.copy_from_slice(&patches.depth[..width]);
                fill_row(patches, rays.row(y), noise, row);
                if let Some((image, lookup)) = &lookup {
                    lookup.find(rays, y, depths, places);
                    for (x, pixel) in row.iter_mut().enumerate() {
                        pixel.color = places.nearest_color(x, image);
                    }
                }
            },
        );
        let tiles_x = width.div_ceil(TILE);
        let mut farthest_in_tile = vec![0f32; tiles_x * (depth.len() / width).div_ceil(TILE)];
        for (y, row) in depth.chunks(width).enumerate() {
            for (tile, span) in row.chunks(TILE).enumerate() {
                let farthest = &mut farthest_in_tile[y / TILE * tiles_x + tile];
                *farthest = span.iter().fold(*farthest, |most, &z| most.max(z));
            }
        }
        Frame {
            camera,
            projector: Projector::new(&camera),
            base_from_depth: view.base_from_depth(),
            depth: fitted_depth,
            surface,
            farthest: farthest_in_tile.iter().fold(0.0, |most, &z| most.max(z)),
            farthest_in_tile,
            tiles_x,
            thinning,
            pixels,
        }
    }
}

/// The camera's rays, and those of every second pixel.
#[derive(Debug, Default)]
pub(super) struct FrameCameras {
    full: Option<Rays>,
    thinned: Option<Rays>,
}

impl FrameCameras {
    fn full(&mut self, camera: &PinholeCamera) -> &Rays {
        keep(&mut self.full, *camera)
    }

    /// The rays of a frame that was made with these cameras.
    pub(super) fn thinned(&mut self, camera: &PinholeCamera, thinning: usize) -> &Rays {
        if thinning == 1 {
            return self.full(camera);
        }
        let by = thinning as f64;
        let mut thin = *camera;
        (thin.width, thin.height) = (camera.width.div_ceil(thinning as u32), camera.height.div_ceil(thinning as u32));
        (thin.fx, thin.fy, thin.cx, thin.cy) = (camera.fx / by, camera.fy / by, camera.cx / by, camera.cy / by);
        keep(&mut self.thinned, thin)
    }
}

fn keep(kept: &mut Option<Rays>, camera: PinholeCamera) -> &Rays {
    if !kept.as_ref().is_some_and(|rays| rays.are_of(&camera)) {
        *kept = None;
    }
    kept.get_or_insert_with(|| Rays::new(&camera))
}

/// Voxels as wide as this many pixels take their planes from every second pixel: a quarter of the work, and no voxel's
/// pixel is farther away than a quarter of the voxel.
const WIDE_VOXEL_PX: f32 = 4.0;

/// Pixels between those that are fused, 1 or 2, by the width of a voxel at the mean depth.
fn thinning(depth: &[f32], camera: &PinholeCamera, voxel_m: f64) -> usize {
    // A sample of the pixels tells the mean well enough.
    let seen = || depth.iter().step_by(13).filter(|z| **z > 0.0);
    let mean = seen().sum::<f32>() / seen().count().max(1) as f32;
    let width_px = voxel_m as f32 * camera.fx.min(camera.fy) as f32;
    if width_px >= WIDE_VOXEL_PX * mean { 2 } else { 1 }
}

/// Every `thinning`-th pixel of every `thinning`-th row.
fn thinned(depth: Vec<f32>, width: usize, thinning: usize) -> Vec<f32> {
    if thinning == 1 {
        return depth;
    }
    let rows = depth.chunks(width.max(1)).step_by(thinning);
    rows.flat_map(|row| row.iter().copied().step_by(thinning)).collect()
}

/// Planes and weights of a row of pixels.
#[multiversion(targets("x86_64+avx2"))]
fn fill_row(patches: &PatchRow, (ray_x, ray_y): (&[f32], &[f32]), (floor, quadratic): (f32, f32), row: &mut [Pixel]) {
    let length = row.len();
    let (ray_x, ray_y, depth) = (&ray_x[..length], &ray_y[..length], &patches.depth[..length]);
    let [nx, ny, nz] = patches.normal.each_ref().map(|plane| &plane[..length]);
    let sigma_at_1m = floor + quadratic;
    for x in 0..length {
        let z = depth[x];
        let (ray_x, ray_y) = (ray_x[x], ray_y[x]);
        let inverse_range = 1.0 / (ray_x * ray_x + ray_y * ray_y + 1.0).sqrt();
        // Without a normal the surface is taken to face the camera.
        let fitted = (nx[x] != 0.0) | (ny[x] != 0.0) | (nz[x] != 0.0);
        let nx = if fitted { nx[x] } else { -ray_x * inverse_range };
        let ny = if fitted { ny[x] } else { -ray_y * inverse_range };
        let nz = if fitted { nz[x] } else { -inverse_range };
        let along_ray = nx * ray_x + ny * ray_y + nz;
        let cosine = (-along_ray * inverse_range).max(LEAST_COSINE);
        let relative_sigma = sigma_at_1m / (floor + quadratic * z * z);
        row[x] = Pixel {
            depth: z,
            normal: [nx, ny, nz],
            offset: along_ray * z,
            weight: if z > 0.0 { relative_sigma * relative_sigma * cosine } else { 0.0 },
            color: [0; 4],
        };
    }
}
