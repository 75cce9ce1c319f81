//! The blocks that an image concerns: those around the surfaces it shows, which are allocated, and those that exist and
//! that it sees to be free.

use super::frame::{Frame, TILE};
use super::{BLOCK_EDGE, Block, Tsdf};
use crate::Error;
use crate::voxel::{VoxelKey, VoxelMap};
use nalgebra::Vector3;
use std::mem::size_of;

/// The voxels, the key and what the two indices keep.
pub(super) const BYTES_PER_BLOCK: usize = size_of::<Block>() + 5 * size_of::<VoxelKey>();
/// Blocks along the edge of a region.
const REGION_EDGE: i32 = 16;
impl Frame<'_> {
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
    pub(super) fn add_blocks_in_free_space(&self, frame: &Frame<'_>, blocks: &mut Vec<u32>) {
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
    fn region_in_view(&self, frame: &Frame<'_>, centre: &Vector3<f32>, radius: f32) -> bool {
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
