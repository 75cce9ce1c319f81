//! One image prepared for fusion: for every pixel the plane of its surroundings, its weight and its colour.

use super::TsdfOptions;
use super::cameras::{FrameCameras, thinning};
use super::touched::Search;
use crate::color_lookup::{ColorLookup, ColorPlaces};
use crate::normals::{InverseDepths, NormalWindow, PatchFitter, PatchRow};
use crate::projector::Projector;
use crate::valid_depth::{RowScratch, ValidRows};
use crate::voxel::VoxelKey;
use crate::{Error, View};
use multiversion::multiversion;
use nalgebra::Isometry3;
use rayon::prelude::*;
use skclam_geometry::PinholeCamera;

/// Pixels along the edge of a tile of [`Frame::farthest_in_tile`].
pub(super) const TILE: usize = 16;
/// A surface seen flatter than this (cosine) weighs no less.
const MIN_COSINE: f32 = 0.1;

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

/// Buffers for what is made of an image, kept from image to image: asking the system for memory takes as long as the
/// work.
#[derive(Debug, Default)]
pub(super) struct FrameBuffers {
    cameras: FrameCameras,
    depth: Vec<f32>,
    inverse: InverseDepths,
    surface: Vec<Pixel>,
    farthest_in_tile: Vec<f32>,
}

/// An image ready to be fused.
pub(super) struct Frame<'a> {
    pub(super) camera: PinholeCamera,
    pub(super) projector: Projector,
    pub(super) base_from_depth: Isometry3<f64>,
    /// Row-major, and one more at the end at which nothing is known, for voxels outside the image.
    pub(super) surface: &'a [Pixel],
    /// Largest depth in each tile of 16 x 16 pixels, 0 where there is none.
    pub(super) farthest_in_tile: &'a [f32],
    pub(super) tiles_x: usize,
    /// Largest depth of all.
    pub(super) farthest: f32,
    /// Pixels in use.
    pub(super) pixels: usize,
    /// Pixels of the camera between two of the frame.
    #[cfg(test)]
    pub(super) thinning: usize,
    /// Addresses of the blocks within the truncation of the surface, sorted.
    pub(super) touched: Vec<VoxelKey>,
}

/// What a thread needs for a row, and the blocks that it found.
#[derive(Default)]
struct BandScratch {
    patches: PatchRow,
    places: ColorPlaces,
    touched: Vec<VoxelKey>,
}

impl<'a> Frame<'a> {
    /// Of a view that was checked.
    pub(super) fn new(view: &View<'_>, buffers: &'a mut FrameBuffers, options: &TsdfOptions) -> Result<Self, Error> {
        let full = &view.depth_camera.camera;
        let thinning = thinning(view.depth, full, options);
        let FrameBuffers { cameras, depth, inverse, surface, farthest_in_tile } = buffers;
        let rays = cameras.thinned(full, thinning);
        let camera = *rays.camera();
        let (width, height) = (camera.width as usize, camera.height as usize);
        let (length, tiles_x) = (width * height, width.div_ceil(TILE));
        depth.resize(length, 0.0);
        surface.resize(length + 1, NOTHING);
        surface[length] = NOTHING;
        farthest_in_tile.resize(tiles_x * height.div_ceil(TILE), 0.0);
        let mut frame = Frame {
            camera,
            projector: Projector::new(&camera),
            base_from_depth: view.base_from_depth(),
            surface: &[],
            farthest_in_tile: &[],
            tiles_x,
            farthest: 0.0,
            pixels: 0,
            #[cfg(test)]
            thinning,
            touched: Vec::new(),
        };
        if length == 0 {
            return Ok(frame);
        }

        let window = NormalWindow::of_maps(thinning);
        let valid = ValidRows::new(view, &options.filter, Some(rays), thinning);
        inverse.make_room(width, height, window);
        let bands = depth
            .par_chunks_mut(width * TILE)
            .zip(inverse.bands_mut(TILE))
            .zip(farthest_in_tile.par_chunks_mut(tiles_x))
            .enumerate();
        let pixels = bands.map_init(RowScratch::default, |scratch, (band, ((rows, mut inverse), tiles))| {
            let mut pixels = 0;
            tiles.fill(0.0);
            for (y, row) in rows.chunks_mut(width).enumerate() {
                valid.row(band * TILE + y, row, scratch);
                inverse.fill(y, row);
                for (farthest, span) in tiles.iter_mut().zip(row.chunks(TILE)) {
                    *farthest = span.iter().fold(*farthest, |most, &z| if z > most { z } else { most });
                    pixels += span.iter().map(|z| u32::from(*z > 0.0)).sum::<u32>();
                }
            }
            pixels
        });
        frame.pixels = pixels.sum::<u32>() as usize;
        frame.farthest = farthest_in_tile.iter().fold(0.0, |most, &z| most.max(z));

        let search = Search::new(&frame, rays, farthest_in_tile, options);
        let fitter = PatchFitter::with_inverse(depth, inverse, rays, &options.filter, window);
        let lookup = view.color.map(|image| (image, ColorLookup::new(view)));
        let noise = &options.filter.noise;
        let noise = (noise.floor_m as f32, noise.depth_sigma_per_m2 as f32);
        let bands = surface[..length].par_chunks_mut(width * TILE).enumerate();
        let touched: Vec<Result<Vec<VoxelKey>, Error>> = bands
            .map_init(BandScratch::default, |BandScratch { patches, places, touched }, (band, rows)| {
                for (y, row) in rows.chunks_mut(width).enumerate() {
                    let y = band * TILE + y;
                    fitter.row(y, patches);
                    fill_row(patches, rays.row(y), noise, row);
                    let depths = &patches.depth[..width];
                    if let Some((image, lookup)) = &lookup {
                        lookup.find(rays, y, depths, places);
                        for (x, pixel) in row.iter_mut().enumerate() {
                            pixel.color = places.nearest_color(x, image);
                        }
                    }
                    search.along_row(y, depths, touched)?;
                }
                touched.sort_unstable();
                touched.dedup();
                Ok(std::mem::take(touched))
            })
            .collect();
        for band in touched {
            frame.touched.extend(band?);
        }
        frame.touched.sort_unstable();
        frame.touched.dedup();
        (frame.surface, frame.farthest_in_tile) = (surface, farthest_in_tile);
        Ok(frame)
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
        let cosine = (-along_ray * inverse_range).max(MIN_COSINE);
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
