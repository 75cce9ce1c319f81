//! Which cells a depth image shows to be free and which it hits.

use super::{CELLS, EDGE, INDEX_LIMIT, Occupancy, OccupancyOptions, place};
use crate::projector::Projector;
use crate::rays::Rays;
use crate::voxel::{VoxelKey, VoxelMap};
use crate::{DepthFilter, Error, View};
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

/// A block's address and what a view says of its cells.
pub(super) type ObservedBlock = (VoxelKey, Box<[Occupancy; CELLS]>);

/// A depth image and, level by level, the smallest depth of ever larger squares of pixels.
pub(super) struct DepthPyramid {
    levels: Vec<Level>,
    projector: Projector,
    focal: f32,
    farthest: f32,
}

struct Level {
    width: usize,
    height: usize,
    /// Smallest depth; infinite where nothing was measured.
    nearest: Vec<f32>,
}

impl DepthPyramid {
    pub(super) fn new(view: &View<'_>, rays: &Rays, options: &OccupancyOptions) -> Self {
        let camera = &view.depth_camera.camera;
        // Blended pixels at edges lie between two surfaces: they hide less than the nearer one does, so edges are not
        // removed here but only from the hits.
        let filter = DepthFilter { edge_margin_px: 0, ..options.filter };
        let depth = view.valid_depth_along(&filter, rays);
        let base = Level {
            width: camera.width as usize,
            height: camera.height as usize,
            nearest: depth.iter().map(|&z| if z > 0.0 { z } else { f32::INFINITY }).collect(),
        };
        let mut levels = vec![base];
        while let Some(last) = levels.last().filter(|level| level.width.max(level.height) > 1) {
            let (width, height) = (last.width.div_ceil(2), last.height.div_ceil(2));
            let nearest = (0..width * height).map(|index| {
                let (x, y) = (2 * (index % width), 2 * (index / width));
                let corner = |dx: usize, dy: usize| {
                    let (x, y) = ((x + dx).min(last.width - 1), (y + dy).min(last.height - 1));
                    last.nearest[y * last.width + x]
                };
                corner(0, 0).min(corner(1, 0)).min(corner(0, 1)).min(corner(1, 1))
            });
            let level = Level { width, height, nearest: nearest.collect() };
            levels.push(level);
        }
        DepthPyramid {
            levels,
            projector: Projector::new(camera),
            focal: camera.fx.max(camera.fy) as f32,
            farthest: depth.iter().fold(0.0, |most, &z| most.max(z)),
        }
    }

    /// Blocks of which the view says anything, in the order of their addresses.
    pub(super) fn observed_blocks(
        &self,
        view: &View<'_>,
        rays: &Rays,
        options: &OccupancyOptions,
    ) -> Result<Vec<ObservedBlock>, Error> {
        let base_from_depth = view.base_from_depth();
        let hits = hits(view, rays, options, &base_from_depth)?;
        let mut blocks = self.blocks_in_view(view, options, &base_from_depth)?;
        blocks.extend(hits.keys());
        blocks.sort_unstable();
        blocks.dedup();
        let depth_from_base = base_from_depth.inverse().cast::<f32>();
        let observed: Vec<_> = blocks
            .into_par_iter()
            .filter_map(|key| {
                let mut cells = self.free_cells(key, options, &depth_from_base);
                for &hit in hits.get(&key).into_iter().flatten() {
                    cells[usize::from(hit)] = Occupancy::Occupied;
                }
                cells.iter().any(|cell| *cell != Occupancy::Unknown).then_some((key, cells))
            })
            .collect();
        Ok(observed)
    }

    /// Blocks that may be seen: those of the box around the view's cone whose ball meets the image.
    fn blocks_in_view(
        &self,
        view: &View<'_>,
        options: &OccupancyOptions,
        base_from_depth: &Isometry3<f64>,
    ) -> Result<Vec<VoxelKey>, Error> {
        let camera = &view.depth_camera.camera;
        let range = options.max_range_m.min(f64::from(self.farthest));
        if range <= 0.0 {
            return Ok(Vec::new());
        }
        let block_m = options.resolution_m * f64::from(EDGE);
        let (right, bottom) = (f64::from(camera.width) - 0.5, f64::from(camera.height) - 0.5);
        let corners = [(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)].map(|(x, y)| {
            (base_from_depth * Point3::from(camera.unproject(&skclam_geometry::Pixel::new(x, y)) * range)).coords
        });
        let apex = base_from_depth.translation.vector;
        let low = corners.iter().fold(apex, |low, corner| low.inf(corner));
        let high = corners.iter().fold(apex, |high, corner| high.sup(corner));
        let limit_m = options.resolution_m * f64::from(INDEX_LIMIT);
        let farthest = low.amax().max(high.amax());
        if farthest + block_m >= limit_m {
            return Err(Error::OutOfRange { distance_m: farthest, limit_m, voxel_m: options.resolution_m });
        }
        let index = |point: Vector3<f64>| point.map(|value| (value / block_m).floor() as i32);
        let (low, high) = (index(low), index(high));
        let ball = (0.5 * 3f64.sqrt() * block_m) as f32;
        let depth_from_base = base_from_depth.inverse();
        let keys: Vec<Vec<VoxelKey>> = (low.z..=high.z)
            .into_par_iter()
            .map(|z| {
                let mut keys = Vec::new();
                for y in low.y..=high.y {
                    for x in low.x..=high.x {
                        let centre = [x, y, z].map(|index| (f64::from(index) + 0.5) * block_m);
                        let seen = (depth_from_base * Point3::from(centre)).cast::<f32>();
                        if seen.z < -ball || seen.z - ball > range as f32 {
                            continue;
                        }
                        if seen.z > 2.0 * ball {
                            let reach = ball * self.focal / (seen.z - ball);
                            let (u, v) = self.projector.project(seen.x, seen.y, seen.z);
                            let base = &self.levels[0];
                            let misses = |at: f32, size: usize| at + reach < 0.0 || at - reach > size as f32;
                            if u.is_nan() || misses(u, base.width) || misses(v, base.height) {
                                continue;
                            }
                        }
                        keys.extend(VoxelKey::new([x, y, z]));
                    }
                }
                keys
            })
            .collect();
        Ok(keys.concat())
    }

    fn free_cells(
        &self,
        key: VoxelKey,
        options: &OccupancyOptions,
        depth_from_base: &Isometry3<f32>,
    ) -> Box<[Occupancy; CELLS]> {
        let mut cells = Box::new([Occupancy::Unknown; CELLS]);
        let corner = key.index().map(|index| index * EDGE);
        let ball = 0.5 * 3f32.sqrt() * options.resolution_m as f32;
        for (at, cell) in cells.iter_mut().enumerate() {
            let at = at as i32;
            let index = [corner[0] + at % EDGE, corner[1] + at / EDGE % EDGE, corner[2] + at / EDGE / EDGE];
            let centre = index.map(|index| ((f64::from(index) + 0.5) * options.resolution_m) as f32);
            let seen = depth_from_base * Point3::from(centre);
            let back = seen.z + ball;
            if seen.z - ball < options.filter.min_depth_m as f32 || f64::from(back) > options.max_range_m {
                continue;
            }
            let (u, v) = self.projector.project(seen.x, seen.y, seen.z);
            if !self.projector.sees(seen.z, u, v) {
                continue;
            }
            let Some(nearest) = self.nearest_around(u, v, ball * self.focal / (seen.z - ball)) else { continue };
            let margin = 3.0 * options.filter.noise.sigma(f64::from(nearest)) as f32;
            if back + margin < nearest {
                *cell = Occupancy::Free;
            }
        }
        cells
    }

    /// Smallest depth within `reach` pixels; `None` where the middle pixel has no depth.
    fn nearest_around(&self, u: f32, v: f32, reach: f32) -> Option<f32> {
        let base = &self.levels[0];
        if !base.nearest[v as usize * base.width + u as usize].is_finite() {
            return None;
        }
        // On the level whose squares are as wide as the outline, it touches at most three by three of them.
        let number = ((2.0 * reach).max(1.0).log2().ceil() as usize).min(self.levels.len() - 1);
        let level = &self.levels[number];
        let square = (1u32 << number) as f32;
        let span = |at: f32, size: usize| {
            let first = ((at - reach).max(0.0) / square) as usize;
            let last = ((at + reach) / square) as usize;
            first.min(size - 1)..=last.min(size - 1)
        };
        let columns = span(u, level.width);
        let mut nearest = f32::INFINITY;
        for row in span(v, level.height) {
            for column in columns.clone() {
                nearest = nearest.min(level.nearest[row * level.width + column]);
            }
        }
        Some(nearest)
    }
}

/// Cells that hold the point of a valid pixel, by block; sorted, no two alike.
fn hits(
    view: &View<'_>,
    rays: &Rays,
    options: &OccupancyOptions,
    base_from_depth: &Isometry3<f64>,
) -> Result<VoxelMap<Vec<u16>>, Error> {
    let depth = view.valid_depth_along(&options.filter, rays);
    let mut hits: VoxelMap<Vec<u16>> = VoxelMap::default();
    let limit_m = options.resolution_m * f64::from(INDEX_LIMIT);
    // Neighbouring pixels mostly lie in one cell.
    let mut last = [i32::MIN; 3];
    for (index, &z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0) {
        let point = base_from_depth * rays.point(index, z);
        let distance_m = point.coords.amax();
        if distance_m >= limit_m {
            return Err(Error::OutOfRange { distance_m, limit_m, voxel_m: options.resolution_m });
        }
        let cell = VoxelKey::of_point(point.coords.into(), 1.0 / options.resolution_m)?.index();
        if cell == last {
            continue;
        }
        last = cell;
        let block = VoxelKey::new(cell.map(|index| index.div_euclid(EDGE))).expect("smaller than the cell's index");
        let list = hits.entry(block).or_default();
        let at = place(cell.map(|index| index.rem_euclid(EDGE))) as u16;
        if list.last() != Some(&at) {
            list.push(at);
        }
    }
    for list in hits.values_mut() {
        list.sort_unstable();
        list.dedup();
    }
    Ok(hits)
}
