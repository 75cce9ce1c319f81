//! Piles posed depth images up into one coloured cloud: the map of the paper (Section 3.4).
//!
//! With a voxel size, all points within one voxel become their mean, weighted by the inverse variance of the depth
//! noise, so memory grows with the surface and not with the number of images. Points are dealt out to shards by their
//! voxel; each shard takes its points in image order, and the result is ordered by voxel: the same bytes on any number
//! of threads.

use crate::normals::{NormalWindow, surface_patches};
use crate::view::Rays;
use crate::voxel::{VoxelKey, VoxelMap};
use crate::{DepthFilter, Error, PointCloud, View};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::mem::size_of;

const SHARD_BITS: u32 = 6;
/// Colour of points that no colour image shows.
const NEUTRAL_GREY: f32 = 128.0;

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

/// How a cloud is made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CloudOptions {
    /// Which depth pixels are believed.
    pub filter: DepthFilter,
    /// Edge of the voxels that are merged into one point, metres; none keeps every pixel of every image.
    pub voxel_m: Option<f64>,
    /// Voxels with fewer pixels than this are left out (needs `voxel_m`).
    pub min_pixels_per_voxel: u32,
    /// What becomes of points that the colour image does not show.
    pub uncolored: UncoloredPoints,
    /// Whether points get normals, fitted to their surroundings in the depth image.
    pub normals: PointNormals,
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
            memory_limit_mib: 1024,
        }
    }
}

/// One believed pixel: where it is and what it weighs.
#[derive(Clone, Copy)]
struct Sample {
    point_in_base: [f64; 3],
    weight: f32,
    normal_in_base: [f32; 3],
    color: Option<[f32; 3]>,
}

/// Weighted sums over one voxel; positions relative to its corner keep single precision harmless.
#[derive(Clone, Copy, Default)]
struct Cell {
    offset: [f32; 3],
    weight: f32,
    normal: [f32; 3],
    color: [f32; 3],
    color_weight: f32,
    pixels: u32,
}

/// Takes views one by one and ends as a [`PointCloud`].
#[derive(Debug)]
pub struct CloudBuilder {
    options: CloudOptions,
    rays: Option<Rays>,
    shards: Vec<VoxelMap<Cell>>,
    raw: PointCloud,
    views: usize,
}

impl std::fmt::Debug for Cell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Cell({} px)", self.pixels)
    }
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
        let shards = (0..1 << SHARD_BITS).map(|_| VoxelMap::default()).collect();
        Ok(CloudBuilder { options, rays: None, shards, raw: PointCloud::default(), views: 0 })
    }

    /// Adds the believed pixels of a view and returns how many they were. A view without any is no error.
    ///
    /// On an error the cloud is as it was, except when the memory limit is hit.
    pub fn add(&mut self, view: &View<'_>) -> Result<usize, Error> {
        view.check()?;
        let camera = &view.depth_camera.camera;
        let rays = match self.rays.take() {
            Some(rays) if rays.are_of(camera) => rays,
            _ => Rays::new(camera),
        };
        let rows = self.samples(view, &rays);
        self.rays = Some(rays);
        let added = rows.iter().map(Vec::len).sum();
        match self.options.voxel_m {
            Some(voxel_m) => self.add_to_voxels(&rows, voxel_m)?,
            None => self.add_raw(&rows),
        }
        self.views += 1;
        self.check_memory()?;
        Ok(added)
    }

    /// Number of points so far.
    pub fn len(&self) -> usize {
        self.raw.len() + self.shards.iter().map(VoxelMap::len).sum::<usize>()
    }

    /// Whether there is no point yet.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The cloud, ordered by voxel (or by image and pixel when nothing was merged).
    pub fn finish(self) -> PointCloud {
        let Some(voxel_m) = self.options.voxel_m else {
            return self.raw;
        };
        let mut cells: Vec<(VoxelKey, Cell)> = self.shards.into_iter().flatten().collect();
        cells.par_sort_unstable_by_key(|(key, _)| *key);
        let mut cloud = PointCloud::default();
        for (key, cell) in cells {
            if cell.pixels < self.options.min_pixels_per_voxel {
                continue;
            }
            let color = if cell.color_weight > 0.0 {
                cell.color.map(|sum| sum / cell.color_weight)
            } else if self.options.uncolored == UncoloredPoints::Grey {
                [NEUTRAL_GREY; 3]
            } else {
                continue;
            };
            let corner = key.index();
            cloud.points.push(std::array::from_fn(|axis| {
                (f64::from(corner[axis]) * voxel_m + f64::from(cell.offset[axis] / cell.weight)) as f32
            }));
            cloud.colors.push(color.map(to_byte));
            if self.options.normals == PointNormals::Fitted {
                cloud.normals.push(unit_or_up(cell.normal));
            }
        }
        cloud
    }

    fn samples(&self, view: &View<'_>, rays: &Rays) -> Vec<Vec<Sample>> {
        let filter = &self.options.filter;
        let depth = view.believed_depth(filter);
        let width = view.depth.width().max(1) as usize;
        let patches = match self.options.normals {
            PointNormals::Fitted => surface_patches(&depth, rays, filter, NormalWindow { radius: 4, stride: 2 }),
            PointNormals::None => Vec::new(),
        };
        let base_from_depth = view.base_from_depth().rotation.cast::<f32>();
        // Weights are relative to that at 1 m: inverse variance of the depth noise.
        let sigma_at_1m = filter.noise.sigma(1.0);
        depth
            .par_chunks(width)
            .enumerate()
            .map(|(y, row)| {
                let mut samples = Vec::new();
                for (x, &z) in row.iter().enumerate().filter(|(_, z)| **z > 0.0) {
                    let point_in_color = view.depth_camera.color_from_depth * rays.point(y * width + x, z);
                    let color = view.color_of(&point_in_color);
                    if color.is_none() && self.options.uncolored == UncoloredPoints::Drop {
                        continue;
                    }
                    let weight = (sigma_at_1m / filter.noise.sigma(f64::from(z))).powi(2) as f32;
                    let point_in_base = (view.base_from_color * point_in_color).coords.into();
                    let normal_in_base = patches.get(y * width + x).map_or([0.0; 3], |patch| {
                        let towards_camera = -rays.direction(y * width + x).normalize();
                        let fitted = patch.normal.norm_squared() > 0.0;
                        let normal = if fitted { patch.normal } else { towards_camera };
                        (base_from_depth * normal).into()
                    });
                    samples.push(Sample { point_in_base, weight, normal_in_base, color });
                }
                samples
            })
            .collect()
    }

    fn add_raw(&mut self, rows: &[Vec<Sample>]) {
        for sample in rows.iter().flatten() {
            self.raw.points.push(sample.point_in_base.map(|value| value as f32));
            self.raw.colors.push(sample.color.unwrap_or([NEUTRAL_GREY; 3]).map(to_byte));
            if self.options.normals == PointNormals::Fitted {
                self.raw.normals.push(sample.normal_in_base);
            }
        }
    }

    fn add_to_voxels(&mut self, rows: &[Vec<Sample>], voxel_m: f64) -> Result<(), Error> {
        let mut dealt: Vec<Vec<(VoxelKey, &Sample)>> = vec![Vec::new(); 1 << SHARD_BITS];
        for sample in rows.iter().flatten() {
            let key = VoxelKey::of_point(sample.point_in_base, 1.0 / voxel_m)?;
            dealt[key.shard(SHARD_BITS)].push((key, sample));
        }
        self.shards.par_iter_mut().zip(dealt).for_each(|(shard, samples)| {
            for (key, sample) in samples {
                let cell = shard.entry(key).or_default();
                for (axis, corner) in key.index().into_iter().enumerate() {
                    let offset = sample.point_in_base[axis] - f64::from(corner) * voxel_m;
                    cell.offset[axis] += sample.weight * offset as f32;
                    cell.normal[axis] += sample.weight * sample.normal_in_base[axis];
                }
                cell.weight += sample.weight;
                cell.pixels += 1;
                if let Some(color) = sample.color {
                    for (sum, value) in cell.color.iter_mut().zip(color) {
                        *sum += sample.weight * value;
                    }
                    cell.color_weight += sample.weight;
                }
            }
        });
        Ok(())
    }

    fn check_memory(&self) -> Result<(), Error> {
        // A hash table keeps up to twice as many places as it has entries, and one byte more for each.
        let table: usize = self.shards.iter().map(|shard| shard.capacity() * (size_of::<(VoxelKey, Cell)>() + 1)).sum();
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

/// Normals of opposite sides of a thin thing may cancel out; any unit vector is better than none then.
fn unit_or_up(sum: [f32; 3]) -> [f32; 3] {
    let norm = sum.iter().map(|value| value * value).sum::<f32>().sqrt();
    if norm > 1e-6 { sum.map(|value| value / norm) } else { [0.0, 0.0, 1.0] }
}

pub(crate) fn to_byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
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
