//! Piles posed depth images up into one coloured cloud: the map of the paper (Section 3.4).
//!
//! With a voxel size, all points within one voxel become their mean, weighted by the inverse variance of the depth
//! noise, so memory grows with the surface and not with the number of images. Points are dealt out to shards by their
//! voxel; each shard takes its points in image order, and the result is ordered by voxel: the same bytes on any number
//! of threads.
//!
//! What does not depend on the pose (which pixels are valid, their normals and colours) is found once an image, so
//! that a second map at other poses costs only its voxels: [`CloudBuilder::points`] and [`CloudBuilder::add_points`].

use crate::cloud_cell::{Cell, FinishedPoint, NEUTRAL_GREY, Shard, to_byte};
use crate::rays::Rays;
use crate::view::check_isometry;
use crate::view_points::{ViewPoint, ViewPoints};
use crate::voxel::VoxelKey;
use crate::{DepthFilter, Error, PointCloud, View};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Point3};
use std::mem::size_of;

const SHARD_BITS: u32 = 6;
/// Points that are finished side by side before they join the cloud.
const FINISHED_TOGETHER: usize = 1 << 16;

/// What becomes of points that the colour image does not show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UncoloredPoints {
    /// They are kept in a neutral grey.
    #[default]
    Grey,
    /// They are left out.
    Drop,
}

/// Whether points get normals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PointNormals {
    /// From the slope of inverse depth around each pixel; where there is none to be had, towards the camera.
    #[default]
    Fitted,
    /// No normals.
    None,
}

/// Which depth a point gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PointDepths {
    /// That of the plane through the pixel's surroundings, wherever they are flat within the noise: a thinner surface.
    #[default]
    Fitted,
    /// That of the depth image.
    Measured,
}

/// How a cloud is made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CloudOptions {
    /// Which depth pixels are valid.
    pub filter: DepthFilter,
    /// Edge of the voxels that are merged into one point, metres; none keeps every pixel of every image.
    pub voxel_m: Option<f64>,
    /// Voxels with fewer pixels than this are left out (needs `voxel_m`).
    pub min_pixels_per_voxel: u32,
    /// What becomes of points that the colour image does not show.
    pub uncolored: UncoloredPoints,
    /// Whether points get normals, fitted to their surroundings in the depth image.
    pub normals: PointNormals,
    /// Which depth a point gets.
    pub depths: PointDepths,
    /// Memory that the cloud may take while it is built, MiB.
    pub memory_limit_mib: u64,
}

impl Default for CloudOptions {
    fn default() -> Self {
        CloudOptions {
            filter: DepthFilter::default(),
            voxel_m: Some(0.003),
            min_pixels_per_voxel: 1,
            uncolored: UncoloredPoints::Grey,
            normals: PointNormals::Fitted,
            depths: PointDepths::Fitted,
            memory_limit_mib: 1024,
        }
    }
}

/// Takes views one by one and ends as a [`PointCloud`].
#[derive(Debug)]
pub struct CloudBuilder {
    options: CloudOptions,
    rays: Option<Rays>,
    shards: Vec<Shard>,
    raw: PointCloud,
    views: usize,
}

impl CloudBuilder {
    /// An empty cloud; options that make no sense are errors.
    pub fn new(options: CloudOptions) -> Result<Self, Error> {
        options.filter.check()?;
        if let Some(voxel_m) = options.voxel_m
            && !(voxel_m.is_finite() && voxel_m >= 1e-5)
        {
            let need = "at least 0.00001 m is needed, or none to keep every point";
            return Err(Error::Option { option: "voxel_m", value: voxel_m.to_string(), need });
        }
        let shards = (0..1 << SHARD_BITS).map(|_| Shard::default()).collect();
        Ok(CloudBuilder { options, rays: None, shards, raw: PointCloud::default(), views: 0 })
    }

    /// Adds the valid pixels of a view and returns how many they were. A view without any is no error.
    ///
    /// On an error the cloud is as it was, except when the memory limit is hit.
    pub fn add(&mut self, view: &View<'_>) -> Result<usize, Error> {
        let points = self.points(view)?;
        self.add_points(&points, &view.base_from_color)
    }

    /// What this builder would add of a view, for several builders with the same options but different poses.
    pub fn points(&mut self, view: &View<'_>) -> Result<ViewPoints, Error> {
        view.check()?;
        let camera = &view.depth_camera.camera;
        let rays = match self.rays.take() {
            Some(rays) if rays.are_of(camera) => rays,
            _ => Rays::new(camera),
        };
        let points = ViewPoints::new(view, &rays, &self.options);
        self.rays = Some(rays);
        Ok(points)
    }

    /// Adds the points of a view taken from a pose of the colour camera and returns how many they were.
    pub fn add_points(&mut self, points: &ViewPoints, base_from_color: &Isometry3) -> Result<usize, Error> {
        check_isometry("base_from_color", base_from_color)?;
        match self.options.voxel_m {
            Some(voxel_m) => self.add_to_voxels(points, base_from_color, voxel_m)?,
            None => self.add_raw(points, base_from_color),
        }
        self.views += 1;
        self.check_memory()?;
        Ok(points.len())
    }

    /// Number of points so far.
    pub fn len(&self) -> usize {
        self.raw.len() + self.shards.iter().map(Shard::len).sum::<usize>()
    }

    /// Whether there is no point yet.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The cloud, ordered by voxel (or by image and pixel when nothing was merged).
    pub fn finish(self) -> PointCloud {
        let CloudBuilder { options, shards, raw, .. } = self;
        let Some(voxel_m) = options.voxel_m else {
            return raw;
        };
        // Each table goes as soon as it is read: only the sums and the points are ever both there as a whole.
        let mut order: Vec<(VoxelKey, u32)> = Vec::with_capacity(shards.iter().map(Shard::len).sum());
        let cells: Vec<Vec<Cell>> = shards.into_iter().map(|shard| shard.split_into(&mut order)).collect();
        order.par_sort_unstable_by_key(|(key, _)| *key);
        let finished =
            |(key, place): (VoxelKey, u32)| cells[key.shard(SHARD_BITS)][place as usize].finish(key, voxel_m, &options);
        let mut cloud = PointCloud::default();
        cloud.points.reserve_exact(order.len());
        cloud.colors.reserve_exact(order.len());
        if options.normals == PointNormals::Fitted {
            cloud.normals.reserve_exact(order.len());
        }
        for part in order.chunks(FINISHED_TOGETHER) {
            let points: Vec<Option<FinishedPoint>> = part.par_iter().copied().map(finished).collect();
            for point in points.into_iter().flatten() {
                cloud.points.push(point.point);
                cloud.colors.push(point.color);
                if options.normals == PointNormals::Fitted {
                    cloud.normals.push(point.normal);
                }
            }
        }
        cloud
    }

    fn add_raw(&mut self, points: &ViewPoints, base_from_color: &Isometry3) {
        let rotation = base_from_color.rotation.cast::<f32>();
        for point in points.bands.iter().flatten() {
            let point_in_base = base_from_color * Point3::from(point.point_in_color.map(f64::from));
            self.raw.points.push(point_in_base.coords.cast::<f32>().into());
            self.raw.colors.push(point.color.unwrap_or([NEUTRAL_GREY; 3]).map(to_byte));
            if self.options.normals == PointNormals::Fitted {
                self.raw.normals.push((rotation * Vector3::from(point.normal_in_color)).into());
            }
        }
    }

    fn add_to_voxels(&mut self, points: &ViewPoints, base_from_color: &Isometry3, voxel_m: f64) -> Result<(), Error> {
        let dealt: Vec<Vec<Vec<(VoxelKey, Cell)>>> =
            points.bands.par_iter().map(|band| deal(band, base_from_color, voxel_m)).collect::<Result<_, Error>>()?;
        self.shards.par_iter_mut().enumerate().for_each(|(shard, cells)| {
            for (key, part) in dealt.iter().flat_map(|band| &band[shard]) {
                cells.at(*key).merge(part);
            }
        });
        Ok(())
    }

    fn check_memory(&self) -> Result<(), Error> {
        let table: usize = self.shards.iter().map(Shard::memory_bytes).sum();
        let raw = self.raw.points.capacity() * size_of::<[f32; 3]>() + self.raw.colors.capacity() * 3;
        let raw = raw + self.raw.normals.capacity() * size_of::<[f32; 3]>();
        if (table + raw) as u64 > self.options.memory_limit_mib << 20 {
            return Err(Error::MemoryLimit {
                limit_mib: self.options.memory_limit_mib,
                views: self.views,
                advice: "use a larger voxel_m, a smaller max_depth_m, or raise memory_limit_mib",
            });
        }
        Ok(())
    }
}

/// Puts the points of some rows into cells, by shard; neighbours in one voxel share a cell at once.
fn deal(band: &[ViewPoint], base_from_color: &Isometry3, voxel_m: f64) -> Result<Vec<Vec<(VoxelKey, Cell)>>, Error> {
    let rotation = *base_from_color.rotation.to_rotation_matrix().matrix();
    let (rotation_f32, translation) = (rotation.cast::<f32>(), base_from_color.translation.vector);
    let inverse_voxel = 1.0 / voxel_m;
    let mut dealt: Vec<Vec<(VoxelKey, Cell)>> =
        (0..1 << SHARD_BITS).map(|_| Vec::with_capacity(band.len() >> SHARD_BITS)).collect();
    let mut open: Option<(VoxelKey, Cell)> = None;
    for point in band {
        let in_base = rotation * Vector3::from(point.point_in_color).cast::<f64>() + translation;
        let key = VoxelKey::of_point(in_base.into(), inverse_voxel)?;
        let (open_key, cell) = match &mut open {
            Some(open) if open.0 == key => open,
            other => {
                if let Some((key, cell)) = other.take() {
                    dealt[key.shard(SHARD_BITS)].push((key, cell));
                }
                other.insert((key, Cell::default()))
            }
        };
        let corner = open_key.index();
        let offset = std::array::from_fn(|axis| (in_base[axis] - f64::from(corner[axis]) * voxel_m) as f32);
        let normal = (rotation_f32 * Vector3::from(point.normal_in_color)).into();
        cell.add(offset, normal, point.weight, point.color);
    }
    if let Some((key, cell)) = open {
        dealt[key.shard(SHARD_BITS)].push((key, cell));
    }
    Ok(dealt)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::tests::{plain_camera, view};
    use image::{Rgb, RgbImage};
    use skclam_geometry::{DepthImage, Isometry3};

    #[test]
    fn a_wall_seen_from_two_sides_falls_onto_itself() {
        let mut camera = plain_camera(64, 48);
        camera.color_from_depth = Isometry3::translation(0.015, 0.0, 0.001);
        camera.camera.distortion = [0.05, -0.02, 1e-3, -1e-3, 0.0];
        let depth = DepthImage::new(64, 48, vec![1.0; 64 * 48]).unwrap();
        let color = RgbImage::from_pixel(64, 48, Rgb([10, 20, 30]));
        let mut builder = CloudBuilder::new(CloudOptions { voxel_m: None, ..Default::default() }).unwrap();
        let front = View { color: Some(&color), ..view(&depth, &camera) };
        assert_eq!(builder.add(&front).unwrap(), 64 * 48);
        // The second camera looks back at the wall at z = 1.001 from 2.002.
        let half_turn = nalgebra::UnitQuaternion::from_axis_angle(&nalgebra::Vector3::y_axis(), std::f64::consts::PI);
        let back = Isometry3::from_parts(nalgebra::Translation3::new(0.0, 0.0, 2.002), half_turn);
        builder.add(&View { base_from_color: back, ..front }).unwrap();
        let cloud = builder.finish();
        cloud.check().unwrap();
        assert!(cloud.points.iter().all(|point| (point[2] - 1.001).abs() < 1e-6));
        assert!(
            cloud.normals[..64 * 48].iter().all(|normal| (normal[2] + 1.0).abs() < 1e-3),
            "towards the first camera"
        );
        assert!(cloud.normals[64 * 48..].iter().all(|normal| (normal[2] - 1.0).abs() < 1e-3), "towards the second one");
        assert!(cloud.colors.contains(&[10, 20, 30]));
        assert!(cloud.colors.contains(&[128; 3]), "the baseline leaves a strip without colour");
    }

    #[test]
    fn voxels_merge_by_weight_and_bound_the_memory() {
        let camera = plain_camera(64, 48);
        let depth = DepthImage::new(64, 48, vec![1.0; 64 * 48]).unwrap();
        let one_pass = |passes: usize| {
            let mut builder = CloudBuilder::new(CloudOptions { voxel_m: Some(0.05), ..Default::default() }).unwrap();
            for _ in 0..passes {
                builder.add(&view(&depth, &camera)).unwrap();
            }
            builder.finish()
        };
        let (once, many) = (one_pass(1), one_pass(20));
        assert!(once.len() < 64 * 48 / 4 && !once.is_empty());
        assert_eq!(once.len(), many.len(), "repeated images add no points");
        for (a, b) in once.points.iter().flatten().zip(many.points.iter().flatten()) {
            assert!((a - b).abs() < 1e-5);
        }
    }

    #[test]
    fn the_same_bytes_on_any_number_of_threads() {
        let camera = plain_camera(80, 60);
        let wavy = (0..4800).map(|i| 1.0 + 0.2 * ((i % 80) as f32 * 0.1).sin() + 0.001 * ((i * 37) % 11) as f32);
        let depth = DepthImage::new(80, 60, wavy.collect()).unwrap();
        let build = |threads: usize| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let mut builder =
                    CloudBuilder::new(CloudOptions { voxel_m: Some(0.02), ..Default::default() }).unwrap();
                for step in 0..5 {
                    let pose = Isometry3::translation(0.01 * f64::from(step), 0.0, 0.0);
                    builder.add(&View { base_from_color: pose, ..view(&depth, &camera) }).unwrap();
                }
                builder.finish()
            })
        };
        assert_eq!(build(1), build(4));
    }

    #[test]
    fn points_without_colour_can_be_dropped() {
        let camera = plain_camera(16, 12);
        let depth = DepthImage::new(16, 12, vec![1.0; 192]).unwrap();
        let options = CloudOptions { uncolored: UncoloredPoints::Drop, ..Default::default() };
        let mut builder = CloudBuilder::new(options).unwrap();
        assert_eq!(builder.add(&view(&depth, &camera)).unwrap(), 0);
        assert!(builder.finish().is_empty());
    }

    #[test]
    fn empty_depth_is_no_error_and_limits_are() {
        let camera = plain_camera(64, 48);
        let holes = DepthImage::new(64, 48, vec![0.0; 64 * 48]).unwrap();
        let mut builder = CloudBuilder::new(CloudOptions::default()).unwrap();
        assert_eq!(builder.add(&view(&holes, &camera)).unwrap(), 0);
        assert!(builder.is_empty());

        let wall = DepthImage::new(64, 48, vec![1.0; 64 * 48]).unwrap();
        let mut tight = CloudBuilder::new(CloudOptions { memory_limit_mib: 0, ..Default::default() }).unwrap();
        assert!(matches!(tight.add(&view(&wall, &camera)), Err(Error::MemoryLimit { .. })));

        let tiny = CloudOptions { voxel_m: Some(1e-5), ..Default::default() };
        let mut far = view(&wall, &camera);
        far.base_from_color.translation.x = 500.0;
        assert!(matches!(CloudBuilder::new(tiny).unwrap().add(&far), Err(Error::OutOfRange { .. })));
        assert!(CloudBuilder::new(CloudOptions { voxel_m: Some(f64::NAN), ..Default::default() }).is_err());
    }
}
