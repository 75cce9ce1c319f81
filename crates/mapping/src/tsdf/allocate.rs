//! Which blocks an image concerns: those around the surfaces it shows, which are allocated, and those that exist and
//! that it sees to be free.

use super::frame::{Frame, TILE};
use super::{BLOCK_EDGE, Block, Tsdf, TsdfOptions};
use crate::Error;
use crate::view::Rays;
use crate::voxel::{VoxelKey, VoxelMap};
use nalgebra::Vector3;
use rayon::prelude::*;
use std::mem::size_of;

/// The voxels, the box, the key and what the two indices keep.
pub(super) const BYTES_PER_BLOCK: usize = size_of::<Block>() + size_of::<Box<Block>>() + 5 * size_of::<VoxelKey>();
/// Blocks along the edge of a region.
const REGION_EDGE: i32 = 16;
/// Rays are cast through every second pixel: a block is many pixels wide at any depth at which its voxels make sense.
const PIXEL_STRIDE: usize = 2;
/// Rows that are searched together.
const ROWS: usize = 16;

impl Frame {
    /// Addresses of the blocks within the truncation of the surface, sorted.
    pub(super) fn touched_blocks(&self, rays: &Rays, options: &TsdfOptions) -> Result<Vec<VoxelKey>, Error> {
        let width = self.camera.width.max(1) as usize;
        let height = self.camera.height as usize;
        let block_m = options.voxel_m * BLOCK_EDGE as f64;
        let inverse = 1.0 / block_m;
        let rotation = self.base_from_depth.rotation.to_rotation_matrix();
        let origin = self.base_from_depth.translation.vector;
        // A depth image has few blocks across, so most rays meet those of their neighbours: a short memory of what
        // was found last saves most of the sorting.
        let bands: Vec<Result<Vec<VoxelKey>, Error>> = (0..height.div_ceil(ROWS))
            .into_par_iter()
            .map(|band| {
                let mut found = Vec::new();
                let mut recent = [None; 64];
                for y in (band * ROWS..((band + 1) * ROWS).min(height)).step_by(PIXEL_STRIDE) {
                    for x in (0..width).step_by(PIXEL_STRIDE) {
                        let index = y * width + x;
                        let z = f64::from(self.surface[index].depth);
                        if z <= 0.0 {
                            continue;
                        }
                        let direction: Vector3<f64> = rotation * rays.direction(index).cast();
                        let truncation = options.truncation(z);
                        let steps = (4.0 * truncation * inverse).ceil().max(1.0);
                        for step in 0..=steps as usize {
                            let depth = z + truncation * (2.0 * step as f64 / steps - 1.0);
                            let key = VoxelKey::of_point((origin + direction * depth).into(), inverse)?;
                            let slot = &mut recent[key.shard(6)];
                            if *slot != Some(key) {
                                *slot = Some(key);
                                found.push(key);
                            }
                        }
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
        // Distortion moves the block by no more than a few tiles in any sane camera; the centre is projected with it.
        let Some(centre) = camera.project(&centre_in_depth.cast::<f64>().into()) else {
            return false;
        };
        let reach = radius * camera.fx.max(camera.fy) as f32 / (z - radius);
        let (x, y) = (centre.x as f32, centre.y as f32);
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
    /// Makes the blocks that do not exist yet and returns how many those were; none if they would exceed the limit.
    pub(super) fn allocate(&mut self, touched: &[VoxelKey]) -> Result<usize, Error> {
        let new: Vec<VoxelKey> = touched.iter().copied().filter(|key| !self.index.contains_key(key)).collect();
        let limit_mib = self.options.memory_limit_mib;
        if ((self.blocks.len() + new.len()) * BYTES_PER_BLOCK) as u64 > limit_mib << 20 {
            return Err(Error::MemoryLimit {
                limit_mib,
                views: self.views,
                advice: "use a larger voxel_m, a smaller max_depth_m or truncation, or raise memory_limit_mib",
            });
        }
        for &key in &new {
            let place = self.blocks.len() as u32;
            self.index.insert(key, place);
            self.keys.push(key);
            self.blocks.push(Block::new());
            let region = key.index().map(|index| index.div_euclid(REGION_EDGE));
            let region = VoxelKey::new(region).expect("a region's index is smaller than its block's");
            self.regions.entry(region).or_default().push(place);
        }
        Ok(new.len())
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
