//! Which blocks an image concerns: those around the surfaces it shows, which are allocated, and those that exist and
//! that it sees to be free.

use super::frame::{Frame, TILE};
use super::{BLOCK_EDGE, Block, Tsdf, TsdfOptions};
use crate::Error;
use crate::rays::Rays;
use crate::voxel::{INDEX_LIMIT, VoxelKey, VoxelMap};
use multiversion::multiversion;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use std::mem::size_of;

/// The voxels, the key and what the two indices keep.
pub(super) const BYTES_PER_BLOCK: usize = size_of::<Block>() + 5 * size_of::<VoxelKey>();
/// Blocks along the edge of a region.
const REGION_EDGE: i32 = 16;
/// Rays that meet a block across its width, at least, at the farthest depth of the image.
const RAYS_PER_BLOCK: f64 = 3.0;
/// Rays are never cast farther apart than this, pixels, so that small things get their blocks.
const WIDEST_STRIDE: f64 = 6.0;
/// Rows that are searched together.
const ROWS: usize = 16;

/// What the rays of an image share on their way through the blocks.
struct Search<'a> {
    depth: &'a [f32],
    stride: usize,
    rays: &'a Rays,
    rotation: Matrix3<f32>,
    origin: Vector3<f32>,
    truncation_m: f32,
    sigmas_floor: f32,
    sigmas_quadratic: f32,
    inverse_block: f32,
}

/// Appends the blocks around the surfaces of a row of pixels, some of them several times; returns a point that no block
/// can hold, if there is one. A block's border may be missed by a rounding error, which does no harm to a block that is
/// wanted for its inside.
#[multiversion(targets("x86_64+avx2"))]
fn blocks_along_row(search: &Search<'_>, row: std::ops::Range<usize>, found: &mut Vec<VoxelKey>) -> Option<[f32; 3]> {
    // Most rays meet the blocks of their neighbour, step by step: a short memory saves most of the sorting.
    const MEMORY: usize = 32;
    let mut last = [[i32::MIN; 3]; MEMORY];
    let limit = INDEX_LIMIT as f32;
    for index in row.step_by(search.stride) {
        let z = search.depth[index];
        if z <= 0.0 {
            continue;
        }
        let direction = search.rotation * search.rays.direction(index);
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
    None
}

impl Frame {
    /// Addresses of the blocks within the truncation of the surface, sorted.
    pub(super) fn touched_blocks(&self, rays: &Rays, options: &TsdfOptions) -> Result<Vec<VoxelKey>, Error> {
        let width = self.camera.width.max(1) as usize;
        let height = self.camera.height as usize;
        let block_m = options.voxel_m * BLOCK_EDGE as f64;
        let inverse = 1.0 / block_m;
        let block_px = block_m * self.camera.fx.min(self.camera.fy) / f64::from(self.farthest.max(1e-3));
        let stride = (block_px / RAYS_PER_BLOCK).clamp(1.0, WIDEST_STRIDE) as usize;
        let rotation = self.base_from_depth.rotation.cast::<f32>().to_rotation_matrix();
        let search = Search {
            depth: &self.depth,
            stride,
            rays,
            rotation: *rotation.matrix(),
            origin: self.base_from_depth.translation.vector.cast(),
            truncation_m: (options.truncation_voxels * options.voxel_m) as f32,
            sigmas_floor: (options.truncation_sigmas * options.filter.noise.floor_m) as f32,
            sigmas_quadratic: (options.truncation_sigmas * options.filter.noise.quadratic_per_m) as f32,
            inverse_block: inverse as f32,
        };
        let bands: Vec<Result<Vec<VoxelKey>, Error>> = (0..height.div_ceil(ROWS))
            .into_par_iter()
            .map(|band| {
                let mut found = Vec::new();
                for y in (band * ROWS..((band + 1) * ROWS).min(height)).step_by(stride) {
                    if let Some(point) = blocks_along_row(&search, y * width..(y + 1) * width, &mut found) {
                        return Err(Error::OutOfRange {
                            distance_m: point.iter().fold(0.0, |most, value| f64::from(value.abs()).max(most)),
                            limit_m: f64::from(INDEX_LIMIT) * block_m,
                            voxel_m: options.voxel_m,
                        });
                    }
                }
                found.sort_unstable();
                found.dedup();
                Ok(found)
            })
            .collect();
        let mut all = Vec::new();
        for band in bands {
            all.extend(band?);
        }
        all.sort_unstable();
        all.dedup();
        Ok(all)
    }

    /// Whether a ball around a block may hold voxels in front of what is seen there.
    fn may_be_free(&self, centre_in_depth: &Vector3<f32>, radius: f32) -> bool {
        let z = centre_in_depth.z;
        if z <= radius || z - radius > self.farthest {
            return false;
        }
        let camera = &self.camera;
        let (x, y) = self.projector.project(centre_in_depth.x, centre_in_depth.y, z);
        let reach = radius * camera.fx.max(camera.fy) as f32 / (z - radius);
        let span = |low: f32, high: f32, count: usize| {
            let first = (low / TILE as f32).floor().max(0.0) as usize;
            let end = ((high / TILE as f32).floor() + 1.0).clamp(0.0, count as f32) as usize;
            first.min(end)..end
        };
        let tiles_y = self.farthest_in_tile.len() / self.tiles_x.max(1);
        let columns = span(x - reach, x + reach, self.tiles_x);
        span(y - reach, y + reach, tiles_y)
            .any(|row| columns.clone().any(|column| self.farthest_in_tile[row * self.tiles_x + column] > z - radius))
    }
}

impl Tsdf {
    /// Places of the blocks at the addresses given (no two alike) and how many of them are new; none is made if they
    /// would exceed the limit.
    pub(super) fn allocate(&mut self, touched: &[VoxelKey]) -> Result<(Vec<u32>, usize), Error> {
        const MISSING: u32 = u32::MAX;
        let mut places: Vec<u32> = touched.iter().map(|key| self.index.get(key).copied().unwrap_or(MISSING)).collect();
        let new = places.iter().filter(|place| **place == MISSING).count();
        let limit_mib = self.options.memory_limit_mib;
        if ((self.blocks.len() + new) * BYTES_PER_BLOCK) as u64 > limit_mib << 20 {
            return Err(Error::MemoryLimit {
                limit_mib,
                views: self.views,
                advice: "use a larger voxel_m, a smaller max_depth_m or truncation, or raise memory_limit_mib",
            });
        }
        self.blocks.grow(new);
        for (place, &key) in places.iter_mut().zip(touched).filter(|(place, _)| **place == MISSING) {
            *place = self.keys.len() as u32;
            self.index.insert(key, *place);
            self.keys.push(key);
            let region = key.index().map(|index| index.div_euclid(REGION_EDGE));
            let region = VoxelKey::new(region).expect("a region's index is smaller than its block's");
            self.regions.entry(region).or_default().push(*place);
        }
        Ok((places, new))
    }

    /// Adds existing blocks that the image may see to be free. The order does not matter: the list is sorted later.
    pub(super) fn add_blocks_in_free_space(&self, frame: &Frame, blocks: &mut Vec<u32>) {
        let depth_from_base = frame.base_from_depth.inverse();
        let block_m = self.options.voxel_m * BLOCK_EDGE as f64;
        // Half the diagonal of a cube.
        let ball = |edge: f64| (0.5 * 3f64.sqrt() * edge) as f32;
        let centre = |index: [i32; 3], edge: f64| {
            let point = nalgebra::Point3::from(index.map(|index| (f64::from(index) + 0.5) * edge));
            (depth_from_base * point).coords.cast::<f32>()
        };
        let region_m = block_m * f64::from(REGION_EDGE);
        let regions: &VoxelMap<Vec<u32>> = &self.regions;
        for (region, members) in regions {
            let seen = centre(region.index(), region_m);
            // A region around the camera has no projection; it always counts.
            if seen.norm() > ball(region_m) && !self.region_in_view(frame, &seen, ball(region_m)) {
                continue;
            }
            blocks.extend(members.iter().copied().filter(|&place| {
                frame.may_be_free(&centre(self.keys[place as usize].index(), block_m), ball(block_m))
            }));
        }
    }

    /// Whether a ball meets the cone around the image; generous, since it only saves work.
    fn region_in_view(&self, frame: &Frame, centre: &Vector3<f32>, radius: f32) -> bool {
        let camera = &frame.camera;
        if centre.z < -radius || centre.z - radius > frame.farthest {
            return false;
        }
        let widest = |size: u32, principal: f64, focal: f64| {
            (principal.abs().max((f64::from(size) - principal).abs()) / focal * 1.2) as f32
        };
        let slope_x = widest(camera.width, camera.cx, camera.fx);
        let slope_y = widest(camera.height, camera.cy, camera.fy);
        let fits = |offset: f32, slope: f32| offset.abs() <= slope * (centre.z + radius) + radius * (1.0 + slope);
        fits(centre.x, slope_x) && fits(centre.y, slope_y)
    }
}
