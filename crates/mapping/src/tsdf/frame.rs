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

/// What a voxel needs to know of the pixel it is seen at, apart from its depth.
#[derive(Clone, Copy)]
pub(super) struct Pixel {
    /// Unit normal of the surface, towards the camera, in the depth camera's frame.
    pub(super) normal: [f32; 3],
    /// `normal . point` of the surface.
    pub(super) offset: f32,
    /// Inverse variance relative to that at 1 m, times the cosine of the viewing angle.
    pub(super) weight: f32,
    /// Red, green, blue, and 1 if there is a colour.
    pub(super) color: [u8; 4],
}

const NOTHING: Pixel = Pixel { normal: [0.0; 3], offset: 0.0, weight: 0.0, color: [0; 4] };

/// An image ready to be fused.
pub(super) struct Frame {
    pub(super) camera: PinholeCamera,
    pub(super) projector: Projector,
    pub(super) base_from_depth: Isometry3<f64>,
    /// Row-major, and one more at the end at which nothing is known, for voxels outside the image.
    pub(super) surface: Vec<Pixel>,
    /// z-depths of the planes, metres; 0 = nothing is known. By themselves: most voxels ask for no more.
    pub(super) depth: Vec<f32>,
    /// Largest depth in each tile of 16 x 16 pixels, 0 where there is none.
    pub(super) farthest_in_tile: Vec<f32>,
    pub(super) tiles_x: usize,
    /// Largest depth of all.
    pub(super) farthest: f32,
    /// Believed pixels.
    pub(super) pixels: usize,
}

impl Frame {
    pub(super) fn new(view: &View<'_>, rays: &Rays, options: &TsdfOptions) -> Self {
        let camera = view.depth_camera.camera;
        let depth = view.believed_depth_along(&options.filter, rays);
        let width = camera.width.max(1) as usize;
        let fitter = PatchFitter::new(&depth, rays, &options.filter, NormalWindow { radius: 4, stride: 2 });
        let lookup = view.color.map(|image| (image, ColorLookup::new(view)));
        let noise = &options.filter.noise;
        let noise = (noise.floor_m as f32, noise.quadratic_per_m as f32);
        let mut surface = vec![NOTHING; depth.len() + 1];
        let mut fitted_depth = vec![0f32; depth.len() + 1];
        surface[..depth.len()]
            .par_chunks_mut(width)
            .zip(fitted_depth[..depth.len()].par_chunks_mut(width))
            .enumerate()
            .for_each_init(<(PatchRow, ColorPlaces)>::default, |(patches, places), (y, (row, depths))| {
                fitter.row(y, patches);
                depths.copy_from_slice(&patches.depth[..width]);
                fill_row(patches, rays.row(y), noise, row);
                if let Some((image, lookup)) = &lookup {
                    lookup.find(rays, y, depths, places);
                    for (x, pixel) in row.iter_mut().enumerate() {
                        pixel.color = places.nearest_color(x, image);
                    }
                }
            });
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
            pixels: depth.iter().filter(|z| **z > 0.0).count(),
        }
    }
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
            normal: [nx, ny, nz],
            offset: along_ray * z,
            weight: if z > 0.0 { relative_sigma * relative_sigma * cosine } else { 0.0 },
            color: [0; 4],
        };
    }
}
