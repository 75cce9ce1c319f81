//! One image prepared for fusion: for every pixel the plane of its surroundings, its weight and its colour.

use super::TsdfOptions;
use crate::View;
use crate::normals::{NormalWindow, surface_patches};
use crate::view::Rays;
use nalgebra::{Isometry3, Vector3};
use rayon::prelude::*;
use skclam_geometry::PinholeCamera;

/// Pixels along the edge of a tile of [`Frame::farthest_in_tile`].
pub(super) const TILE: usize = 16;
/// A surface seen flatter than this (cosine) weighs no less.
const LEAST_COSINE: f32 = 0.1;

/// What a voxel needs to know of the pixel it is seen at; 32 bytes, one fetch.
#[derive(Clone, Copy)]
#[repr(align(32))]
pub(super) struct Pixel {
    /// Unit normal of the surface, towards the camera, in the depth camera's frame.
    pub(super) normal: [f32; 3],
    /// `normal . point` of the surface.
    pub(super) offset: f32,
    /// z-depth, metres; 0 = nothing is known.
    pub(super) depth: f32,
    /// Inverse variance relative to that at 1 m, times the cosine of the viewing angle.
    pub(super) weight: f32,
    /// Red, green, blue, and 1 if there is a colour.
    pub(super) color: [u8; 4],
}

const NOTHING: Pixel = Pixel { normal: [0.0; 3], offset: 0.0, depth: 0.0, weight: 0.0, color: [0; 4] };

/// An image ready to be fused.
pub(super) struct Frame {
    pub(super) camera: PinholeCamera,
    pub(super) base_from_depth: Isometry3<f64>,
    /// Row-major, and one more at the end at which nothing is known, for voxels outside the image.
    pub(super) surface: Vec<Pixel>,
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
        let depth = view.believed_depth(&options.filter);
        let width = camera.width.max(1) as usize;
        let patches = surface_patches(&depth, rays, &options.filter, NormalWindow { radius: 4, stride: 2 });
        let sigma_at_1m = options.filter.noise.sigma(1.0);
        let mut surface = vec![NOTHING; depth.len() + 1];
        surface[..depth.len()].par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let index = y * width + x;
                let z = patches[index].depth;
                if z <= 0.0 {
                    continue;
                }
                let ray = rays.direction(index);
                let range = ray.norm();
                // Without a normal the surface is taken to face the camera.
                let fitted = patches[index].normal;
                let normal: Vector3<f32> = if fitted == Vector3::zeros() { -ray / range } else { fitted };
                let cosine = (-normal.dot(&ray) / range).max(LEAST_COSINE);
                let weight = (sigma_at_1m / options.filter.noise.sigma(f64::from(z))).powi(2) as f32 * cosine;
                let color = view.color_of(&(view.depth_camera.color_from_depth * rays.point(index, z)));
                let color = color.map_or([0; 4], |[r, g, b]| [r as u8, g as u8, b as u8, 1]);
                *pixel = Pixel { normal: normal.into(), offset: normal.dot(&ray) * z, depth: z, weight, color };
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
            base_from_depth: view.base_from_depth(),
            surface,
            farthest: farthest_in_tile.iter().fold(0.0, |most, &z| most.max(z)),
            farthest_in_tile,
            tiles_x,
            pixels: depth.iter().filter(|z| **z > 0.0).count(),
        }
    }
}
