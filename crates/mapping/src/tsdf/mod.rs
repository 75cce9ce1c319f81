//! Truncated signed distance fusion (Curless and Levoy 1996) on a sparse hash of voxel blocks (Niessner et al. 2013).
//!
//! Each voxel keeps the weighted mean of its signed distances to the surfaces that the depth images show, in metres,
//! positive on the side of the camera. What differs from the textbook:
//!
//! - The distance is that to the *plane* of the pixel's surroundings, not along the ray: no bias from steep views, and
//!   none from a voxel falling between pixels.
//! - The weight of an observation is the inverse variance of the depth noise `sigma(z)`, relative to that at 1 m, times
//!   the cosine of the viewing angle; behind the surface it falls to zero, so that thin things survive.
//! - The truncation grows with `sigma(z)`: far surfaces are not torn into layers by their noise, near ones stay sharp.
//! - Only blocks within the truncation of a surface are allocated; blocks that exist and are now seen to be free are
//!   carved.
//!
//! One image at a time; memory goes with the surface. Blocks are allocated in the order of their addresses and each
//! is updated by one thread: the same bytes on any number of threads.

mod allocate;
mod block;
mod cameras;
mod frame;
mod integrate;
mod touched;

pub(crate) use block::{BLOCK_EDGE, Block};

use block::BlockStore;

use crate::voxel::{VoxelKey, VoxelMap};
use crate::{DepthFilter, Error, View};
use frame::{Frame, FrameBuffers};
use serde::{Deserialize, Serialize};
use skclam_geometry::PinholeCamera;

/// Whether existing voxels that are observed to be free are moved towards free.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SpaceCarving {
    /// What was there by mistake, or has gone, disappears again.
    #[default]
    On,
    /// Only the surroundings of the surfaces seen are updated: faster.
    Off,
}

/// How depth images are fused.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TsdfOptions {
    /// Which depth pixels are valid.
    pub filter: DepthFilter,
    /// Edge of a voxel, metres; [`TsdfOptions::voxel_for`] chooses one.
    pub voxel_m: f64,
    /// Distances are kept up to this many voxels around a surface ...
    pub truncation_voxels: f64,
    /// ... or this many standard deviations of the depth noise, whichever is more.
    pub truncation_sigmas: f64,
    /// What happens to voxels that are seen to be free.
    pub carving: SpaceCarving,
    /// The weight of a voxel grows no further than this (one pixel seen straight on at 1 m weighs 1), so that a very
    /// long run can still forget.
    pub max_weight: f64,
    /// Memory that the voxels may take, MiB.
    pub memory_limit_mib: u64,
}

impl Default for TsdfOptions {
    fn default() -> Self {
        TsdfOptions {
            filter: DepthFilter::default(),
            voxel_m: 0.005,
            truncation_voxels: 3.0,
            truncation_sigmas: 3.0,
            carving: SpaceCarving::On,
            max_weight: 10_000.0,
            memory_limit_mib: 3072,
        }
    }
}

impl TsdfOptions {
    /// A voxel that fits a camera at a range: the width of a pixel there, or a third of the depth noise if that is
    /// more, rounded to half millimetres.
    pub fn voxel_for(camera: &PinholeCamera, range_m: f64, filter: &DepthFilter) -> f64 {
        let pixel_m = range_m / camera.fx.min(camera.fy);
        let wanted = pixel_m.max(filter.noise.sigma(range_m) / 3.0);
        ((wanted / 0.0005).round() * 0.0005).max(0.0005)
    }

    fn check(&self) -> Result<(), Error> {
        self.filter.check()?;
        let bad = |option, value: f64, need| Err(Error::Option { option, value: value.to_string(), need });
        if !(self.voxel_m.is_finite() && (1e-4..=10.0).contains(&self.voxel_m)) {
            return bad("voxel_m", self.voxel_m, "0.0001 to 10 m is needed");
        }
        if !(1.5..=32.0).contains(&self.truncation_voxels) {
            return bad("truncation_voxels", self.truncation_voxels, "1.5 to 32 voxels are needed");
        }
        if !(0.0..=10.0).contains(&self.truncation_sigmas) {
            return bad("truncation_sigmas", self.truncation_sigmas, "0 to 10 are needed");
        }
        if !(self.max_weight.is_finite() && self.max_weight >= 1.0) {
            return bad("max_weight", self.max_weight, "at least 1 is needed");
        }
        Ok(())
    }
}

/// What one image did to the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Integration {
    /// Depth pixels that were valid and fused: every second of every second row where voxels are wide in the image.
    pub pixels: usize,
    /// Blocks of 8 x 8 x 8 voxels that were updated.
    pub blocks_updated: usize,
    /// Blocks among them that are new.
    pub blocks_new: usize,
}

/// The map as a field of truncated signed distances.
#[derive(Debug)]
pub struct Tsdf {
    options: TsdfOptions,
    buffers: FrameBuffers,
    /// Where a block is in `blocks`.
    index: VoxelMap<u32>,
    keys: Vec<VoxelKey>,
    blocks: BlockStore,
    /// Blocks by cubes of 16 x 16 x 16 blocks, so that an image looks only at what is near its frustum.
    regions: VoxelMap<Vec<u32>>,
    views: usize,
}

impl Tsdf {
    /// An empty map; options that make no sense are errors.
    pub fn new(options: TsdfOptions) -> Result<Self, Error> {
        options.check()?;
        Ok(Tsdf {
            options,
            buffers: FrameBuffers::default(),
            index: VoxelMap::default(),
            keys: Vec::new(),
            blocks: BlockStore::default(),
            regions: VoxelMap::default(),
            views: 0,
        })
    }

    /// Fuses one view. On an error the map is as it was. A view without any valid pixel changes nothing.
    pub fn integrate(&mut self, view: &View<'_>) -> Result<Integration, Error> {
        view.check()?;
        let mut buffers = std::mem::take(&mut self.buffers);
        let integration = Frame::new(view, &mut buffers, &self.options).and_then(|frame| self.integrate_frame(&frame));
        self.buffers = buffers;
        integration
    }

    fn integrate_frame(&mut self, frame: &Frame<'_>) -> Result<Integration, Error> {
        let (mut updated, blocks_new) = self.allocate(&frame.touched)?;
        if self.options.carving == SpaceCarving::On && frame.pixels > 0 {
            self.add_blocks_in_free_space(frame, &mut updated);
        }
        updated.sort_unstable();
        updated.dedup();
        self.update(frame, &updated);
        self.views += 1;
        Ok(Integration { pixels: frame.pixels, blocks_updated: updated.len(), blocks_new })
    }

    /// The options it was made with.
    pub fn options(&self) -> &TsdfOptions {
        &self.options
    }

    /// Number of views fused.
    pub fn views(&self) -> usize {
        self.views
    }

    /// Number of blocks of 8 x 8 x 8 voxels.
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Memory taken by the voxels and their index, bytes.
    pub fn memory_bytes(&self) -> usize {
        self.blocks.len() * allocate::BYTES_PER_BLOCK
    }

    /// Signed distance (metres, positive = free) and weight at the voxel that holds a point; `None` where nothing was
    /// observed.
    pub fn at(&self, point_in_base: [f64; 3]) -> Option<(f64, f64)> {
        let voxel = VoxelKey::of_point(point_in_base, 1.0 / self.options.voxel_m).ok()?.index();
        let block = self.block(voxel.map(|index| index.div_euclid(BLOCK_EDGE as i32)))?;
        let [x, y, z] = voxel.map(|index| index.rem_euclid(BLOCK_EDGE as i32) as usize);
        let row = &block.rows[z * BLOCK_EDGE + y];
        (row.weight[x] > 0.0).then(|| (f64::from(row.distance[x]), f64::from(row.weight[x])))
    }

    /// The block at a block index.
    pub(crate) fn block(&self, index: [i32; 3]) -> Option<&Block> {
        let place = *self.index.get(&VoxelKey::new(index)?)?;
        Some(self.blocks.get(place))
    }

    /// All blocks with their indices, in the order of their addresses.
    pub(crate) fn sorted_blocks(&self) -> Vec<([i32; 3], &Block)> {
        let mut order: Vec<(VoxelKey, u32)> = self.keys.iter().copied().zip(0..).collect();
        order.sort_unstable();
        order.into_iter().map(|(key, place)| (key.index(), self.blocks.get(place))).collect()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::view::tests::{plain_camera, view};
    use skclam_geometry::{DepthImage, Isometry3};

    pub(crate) fn wall(width: u32, height: u32, depth_m: f32) -> DepthImage {
        DepthImage::new(width, height, vec![depth_m; (width * height) as usize]).unwrap()
    }

    #[test]
    fn distances_to_a_wall_are_metric_and_truncated() {
        let camera = plain_camera(160, 120);
        let depth = wall(160, 120, 1.0);
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
        let report = tsdf.integrate(&view(&depth, &camera)).unwrap();
        assert_eq!(report.pixels, 160 * 120);
        assert_eq!(report.blocks_new, tsdf.blocks());
        for offset in [-0.015, -0.005, 0.005, 0.015] {
            let z = 1.0 - offset;
            let (distance, weight) = tsdf.at([0.035, 0.025, z]).unwrap();
            // The voxel's centre is at half a voxel.
            assert!((distance - offset).abs() < 1e-4, "{offset}: {distance}");
            assert!(weight > 0.1);
        }
        let (free, _) = tsdf.at([0.035, 0.025, 0.965]).unwrap();
        assert!((free - 0.03).abs() < 0.001, "truncated at three voxels: {free}");
        assert_eq!(tsdf.at([0.0, 0.0, 1.2]), None, "nothing is known behind the wall");
    }

    #[test]
    fn a_steep_wall_gets_its_perpendicular_distance() {
        let camera = plain_camera(200, 150);
        // The plane n . X = c with n at 60 degrees to the axis.
        let normal = nalgebra::Vector3::new(60f64.to_radians().sin(), 0.0, 60f64.to_radians().cos());
        let depth = (0..200 * 150).map(|i| {
            let ray = camera.camera.unproject(&skclam_geometry::Pixel::new(f64::from(i % 200), f64::from(i / 200)));
            (0.5 / normal.dot(&ray)).clamp(0.0, 3.0) as f32
        });
        let depth = DepthImage::new(200, 150, depth.collect()).unwrap();
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
        tsdf.integrate(&view(&depth, &camera)).unwrap();
        for step in -1..=1 {
            let point = normal * (0.5 - 0.008 * f64::from(step))
                + nalgebra::Vector3::new(0.0, 0.02, 0.0)
                + nalgebra::Vector3::new(-normal.z, 0.0, normal.x) * 0.35;
            let centre = point.map(|value| ((value / 0.01).floor() + 0.5) * 0.01);
            let (distance, _) = tsdf.at(point.into()).unwrap();
            assert!((distance - (0.5 - normal.dot(&centre))).abs() < 5e-4, "{distance}");
        }
    }

    #[test]
    fn what_has_gone_is_carved_away() {
        let camera = plain_camera(160, 120);
        let (near, far) = (wall(160, 120, 0.6), wall(160, 120, 1.0));
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
        tsdf.integrate(&view(&near, &camera)).unwrap();
        let inside = [0.005, 0.005, 0.615];
        assert!(tsdf.at(inside).unwrap().0 < 0.0);
        for _ in 0..20 {
            tsdf.integrate(&view(&far, &camera)).unwrap();
        }
        assert!(tsdf.at(inside).unwrap().0 > 0.0);
    }

    #[test]
    fn repeated_images_take_no_more_memory() {
        let camera = plain_camera(80, 60);
        let depth = wall(80, 60, 1.0);
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.02, ..Default::default() }).unwrap();
        tsdf.integrate(&view(&depth, &camera)).unwrap();
        let once = (tsdf.blocks(), tsdf.memory_bytes());
        for _ in 0..200 {
            tsdf.integrate(&view(&depth, &camera)).unwrap();
        }
        assert_eq!((tsdf.blocks(), tsdf.memory_bytes()), once);
    }

    #[test]
    fn bad_views_and_limits_leave_the_map_as_it_was() {
        let camera = plain_camera(80, 60);
        let depth = wall(80, 60, 1.0);
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.005, memory_limit_mib: 1, ..Default::default() }).unwrap();
        let mut bad = view(&depth, &camera);
        bad.base_from_color.translation.y = f64::NAN;
        assert!(matches!(tsdf.integrate(&bad), Err(Error::BadNumber { .. })));
        bad.base_from_color.translation.y = 1e6;
        assert!(matches!(tsdf.integrate(&bad), Err(Error::PoseFarAway { .. })));
        assert!(matches!(tsdf.integrate(&view(&depth, &camera)), Err(Error::MemoryLimit { limit_mib: 1, .. })));
        assert_eq!(tsdf.blocks(), 0);
        let fine = TsdfOptions { voxel_m: 1e-4, ..Default::default() };
        let mut far = view(&depth, &camera);
        far.base_from_color.translation.x = 9000.0;
        assert!(matches!(Tsdf::new(fine).unwrap().integrate(&far), Err(Error::OutOfRange { .. })));
        let holes = wall(80, 60, 0.0);
        let report = Tsdf::new(TsdfOptions::default()).unwrap().integrate(&view(&holes, &camera)).unwrap();
        assert_eq!(report, Integration { pixels: 0, blocks_updated: 0, blocks_new: 0 });
        assert!(Tsdf::new(TsdfOptions { voxel_m: f64::NAN, ..Default::default() }).is_err());
    }

    #[test]
    fn an_image_without_pixels_changes_nothing() {
        let mut camera = plain_camera(0, 0);
        (camera.camera.fx, camera.camera.fy) = (1.0, 1.0);
        let depth = DepthImage::new(0, 0, Vec::new()).unwrap();
        let mut tsdf = Tsdf::new(TsdfOptions::default()).unwrap();
        let report = tsdf.integrate(&view(&depth, &camera)).unwrap();
        assert_eq!(report, Integration { pixels: 0, blocks_updated: 0, blocks_new: 0 });
        let mut cloud = crate::CloudBuilder::new(crate::CloudOptions::default()).unwrap();
        assert_eq!(cloud.add(&view(&depth, &camera)).unwrap(), 0);
        let mut grid = crate::OccupancyGrid::new(crate::OccupancyOptions::default()).unwrap();
        grid.add(&view(&depth, &camera)).unwrap();
        assert_eq!(grid.counts(), (0, 0));
    }

    #[test]
    fn wide_voxels_take_every_second_pixel_and_see_the_same_wall() {
        let camera = plain_camera(161, 121);
        // A slanted wall: n . X = 0.5.
        let normal = nalgebra::Vector3::new(0.3, -0.2, 1.0).normalize();
        let depth = (0..161 * 121).map(|i| {
            let ray = camera.camera.unproject(&skclam_geometry::Pixel::new(f64::from(i % 161), f64::from(i / 161)));
            (0.5 / normal.dot(&ray)) as f32
        });
        let depth = DepthImage::new(161, 121, depth.collect()).unwrap();
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.02, ..Default::default() }).unwrap();
        tsdf.integrate(&view(&depth, &camera)).unwrap();
        assert_eq!(
            Frame::new(&view(&depth, &camera), &mut FrameBuffers::default(), tsdf.options()).unwrap().thinning,
            2
        );
        let mut seen = 0;
        for (x, y) in (-8..=8).flat_map(|x| (-6..=6).map(move |y| (x, y))) {
            let (x, y) = (f64::from(x) * 0.02 + 0.01, f64::from(y) * 0.02 + 0.01);
            let z = (((0.5 - normal.x * x - normal.y * y) / normal.z / 0.02).floor() + 0.5) * 0.02;
            let (distance, _) = tsdf.at([x, y, z]).unwrap();
            let expected = 0.5 - normal.dot(&nalgebra::Vector3::new(x, y, z));
            assert!((distance - expected).abs() < 2e-4, "{distance} {expected}");
            seen += 1;
        }
        assert_eq!(seen, 17 * 13);
    }

    #[test]
    fn the_same_field_on_any_number_of_threads() {
        let camera = plain_camera(120, 90);
        let wavy = (0..120 * 90).map(|i| 1.0 + 0.1 * ((i % 120) as f32 * 0.1).sin() + 0.002 * ((i * 37) % 11) as f32);
        let depth = DepthImage::new(120, 90, wavy.collect()).unwrap();
        let build = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
                for step in 0..4 {
                    let base_from_color = Isometry3::translation(0.01 * f64::from(step), 0.0, 0.02);
                    tsdf.integrate(&View { base_from_color, ..view(&depth, &camera) }).unwrap();
                }
                let blocks = tsdf.sorted_blocks();
                let rows = |block: &Block| block.rows.map(|row| (row.distance, row.weight, row.color));
                blocks.iter().map(|(key, block)| (*key, rows(block))).collect::<Vec<_>>()
            })
        };
        assert!(build(1) == build(4));
    }

    #[test]
    fn a_voxel_is_chosen_from_the_camera_and_the_range() {
        let camera = PinholeCamera::from_hfov(480, 360, 1.0);
        let near = TsdfOptions::voxel_for(&camera, 0.5, &DepthFilter::default());
        let far = TsdfOptions::voxel_for(&camera, 3.0, &DepthFilter::default());
        assert!((0.0005..0.002).contains(&near), "{near}");
        assert!((0.006..0.012).contains(&far), "{far}");
    }
}
