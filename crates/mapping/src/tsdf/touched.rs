//! Which blocks lie within the truncation of the surfaces that an image shows.

use super::frame::{Frame, TILE};
use super::{BLOCK_EDGE, TsdfOptions};
use crate::Error;
use crate::rays::Rays;
use crate::voxel::{INDEX_LIMIT, VoxelKey};
use multiversion::multiversion;
use nalgebra::{Matrix3, Vector3};

/// Rays that meet a block across its width, at least, at the farthest depth of their tile of the image.
const RAYS_PER_BLOCK: f32 = 4.0;
/// Rays are never cast farther apart than this, pixels, so that small things get their blocks.
const WIDEST_STRIDE: f32 = 6.0;

/// What the rays of an image share on their way through the blocks.
pub(super) struct Search<'a> {
    rays: &'a Rays,
    /// Rays that are cast in each tile: every how many pixels.
    strides: Vec<u8>,
    tiles_x: usize,
    rotation: Matrix3<f32>,
    origin: Vector3<f32>,
    truncation_m: f32,
    sigmas_floor: f32,
    sigmas_quadratic: f32,
    voxel_m: f64,
    inverse_block: f32,
}

impl<'a> Search<'a> {
    pub(super) fn new(frame: &Frame<'_>, rays: &'a Rays, farthest_in_tile: &[f32], options: &TsdfOptions) -> Self {
        let block_m = options.voxel_m * BLOCK_EDGE as f64;
        let block_px_at_1m = (block_m * frame.camera.fx.min(frame.camera.fy)) as f32;
        let stride =
            |farthest: &f32| (block_px_at_1m / (RAYS_PER_BLOCK * farthest.max(1e-3))).clamp(1.0, WIDEST_STRIDE) as u8;
        let rotation = frame.base_from_depth.rotation.cast::<f32>().to_rotation_matrix();
        Search {
            rays,
            strides: farthest_in_tile.iter().map(stride).collect(),
            tiles_x: frame.tiles_x,
            rotation: *rotation.matrix(),
            origin: frame.base_from_depth.translation.vector.cast(),
            truncation_m: (options.truncation_voxels * options.voxel_m) as f32,
            sigmas_floor: (options.truncation_sigmas * options.filter.noise.floor_m) as f32,
            sigmas_quadratic: (options.truncation_sigmas * options.filter.noise.depth_sigma_per_m2) as f32,
            voxel_m: options.voxel_m,
            inverse_block: (1.0 / block_m) as f32,
        }
    }

    /// Appends the blocks around the surfaces of a row of pixels, some of them several times; an error if no block can
    /// hold one of them. A block's border may be missed by a rounding error, which does no harm to a block that is
    /// wanted for its inside.
    pub(super) fn along_row(&self, y: usize, depth: &[f32], found: &mut Vec<VoxelKey>) -> Result<(), Error> {
        match blocks_along_row(self, y, depth, found) {
            None => Ok(()),
            Some(point) => Err(Error::OutOfRange {
                distance_m: point.iter().fold(0.0, |most, value| f64::from(value.abs()).max(most)),
                limit_m: f64::from(INDEX_LIMIT) * self.voxel_m * BLOCK_EDGE as f64,
                voxel_m: self.voxel_m,
            }),
        }
    }
}

/// As [`Search::along_row`], with a point that no block can hold.
#[multiversion(targets("x86_64+avx2"))]
fn blocks_along_row(search: &Search<'_>, y: usize, depth: &[f32], found: &mut Vec<VoxelKey>) -> Option<[f32; 3]> {
    // Most rays meet the blocks of their neighbour, step by step: a short memory saves most of the sorting.
    const MEMORY: usize = 32;
    let mut last = [[i32::MIN; 3]; MEMORY];
    let limit = INDEX_LIMIT as f32;
    let (ray_x, ray_y) = search.rays.row(y);
    for (tile, depth) in depth.chunks(TILE).enumerate() {
        let pixels_apart = usize::from(search.strides[y / TILE * search.tiles_x + tile]);
        if !(y % TILE).is_multiple_of(pixels_apart) {
            continue;
        }
        for (x, &z) in depth.iter().enumerate().step_by(pixels_apart) {
            if z <= 0.0 {
                continue;
            }
            let x = tile * TILE + x;
            let direction = search.rotation * Vector3::new(ray_x[x], ray_y[x], 1.0);
            let truncation = search.truncation_m.max(search.sigmas_floor + search.sigmas_quadratic * z * z);
            let steps = (4.0 * truncation * search.inverse_block).ceil().max(1.0);
            let first = search.origin + direction * (z - truncation);
            let stride = direction * (2.0 * truncation / steps);
            for step in 0..=steps as usize {
                let point = first + stride * step as f32;
                let cell = (point * search.inverse_block).map(f32::floor);
                if !cell.iter().all(|index| index.abs() < limit) {
                    return Some(point.into());
                }
                let block = [cell.x as i32, cell.y as i32, cell.z as i32];
                let slot = &mut last[step % MEMORY];
                if *slot != block {
                    *slot = block;
                    found.extend(VoxelKey::new(block));
                }
            }
        }
    }
    None
}
