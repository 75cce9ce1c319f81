//! One image prepared for fusion: for every pixel the plane of its surroundings, its weight and its colour.

use super::TsdfOptions;
use crate::View;
use crate::normals::{NormalWindow, SurfacePatch, surface_patches};
use crate::projector::Projector;
use crate::view::Rays;
use nalgebra::{Isometry3, Matrix3, Vector3};
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
    pub(super) projector: Projector,
    pub(super) base_from_depth: Isometry3<f64>,
    /// Row-major, and one more at the end at which nothing is known, for voxels outside the image.
    pub(super) surface: Vec<Pixel>,
    /// The depths of `surface` by themselves.
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
        let depth = view.believed_depth(&options.filter);
        let width = camera.width.max(1) as usize;
        let patches = surface_patches(&depth, rays, &options.filter, NormalWindow { radius: 4, stride: 2 });
        let colors = Colors::new(view);
        let noise = &options.filter.noise;
        let (floor, quadratic) = (noise.floor_m as f32, noise.quadratic_per_m as f32);
        let sigma_at_1m = floor + quadratic;
        let mut surface = vec![NOTHING; depth.len() + 1];
        surface[..depth.len()].par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let index = y * width + x;
                let SurfacePatch { normal: fitted, depth: z } = patches[index];
                if z <= 0.0 {
                    continue;
                }
                let ray = rays.direction(index);
                let inverse_range = 1.0 / ray.norm();
                // Without a normal the surface is taken to face the camera.
                let normal = if fitted == Vector3::zeros() { -ray * inverse_range } else { fitted };
                let along_ray = normal.dot(&ray);
                let cosine = (-along_ray * inverse_range).max(LEAST_COSINE);
                let relative_sigma = sigma_at_1m / (floor + quadratic * z * z);
                *pixel = Pixel {
                    normal: normal.into(),
                    offset: along_ray * z,
                    depth: z,
                    weight: relative_sigma * relative_sigma * cosine,
                    color: colors.as_ref().map_or([0; 4], |colors| colors.at(ray * z)),
                };
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
            depth: surface.iter().map(|pixel| pixel.depth).collect(),
            surface,
            farthest: farthest_in_tile.iter().fold(0.0, |most, &z| most.max(z)),
            farthest_in_tile,
            tiles_x,
            pixels: depth.iter().filter(|z| **z > 0.0).count(),
        }
    }
}

/// Looks up the colour of points in the depth camera's frame: the nearest pixel, since a voxel takes the mean over many.
struct Colors<'a> {
    image: &'a image::RgbImage,
    projector: Projector,
    rotation: Matrix3<f32>,
    translation: Vector3<f32>,
}

impl<'a> Colors<'a> {
    fn new(view: &View<'a>) -> Option<Self> {
        let color_from_depth = view.depth_camera.color_from_depth.cast::<f32>();
        Some(Colors {
            image: view.color?,
            projector: Projector::new(view.color_camera),
            rotation: *color_from_depth.rotation.to_rotation_matrix().matrix(),
            translation: color_from_depth.translation.vector,
        })
    }

    #[inline]
    fn at(&self, point_in_depth: Vector3<f32>) -> [u8; 4] {
        let point = self.rotation * point_in_depth + self.translation;
        let (u, v) = self.projector.project(point.x, point.y, point.z);
        if !self.projector.sees(point.z, u, v) {
            return [0; 4];
        }
        let [r, g, b] = self.image.get_pixel(u as u32, v as u32).0;
        [r, g, b, 1]
    }
}
