//! Which space is free, occupied or unknown, for planners: log-odds on a sparse grid (Hornung et al. 2013, OctoMap).
//!
//! Instead of casting a ray through every pixel, every cell in the camera's view is looked up in the depth image: it is
//! free if *all* of it lies in front of *everything* that is seen within its outline (a pyramid of minima answers
//! that), by three standard deviations of the noise. It is hit if a valid pixel's point lies in it. What is
//! neither stays as it was: behind surfaces, at the edges of things, and where the camera saw nothing.

mod coverage;
mod esdf;
mod npz;
mod octree;
mod visible;

pub use coverage::FreeBoundary;
pub use esdf::Esdf;

use crate::rays::Rays;
use crate::voxel::{VoxelKey, VoxelMap};
use crate::{DepthFilter, Error, View};
use serde::{Deserialize, Serialize};
use visible::DepthPyramid;

/// Cells along the edge of a block.
pub(crate) const EDGE: i32 = 8;
/// Cells in a block.
pub(crate) const CELLS: usize = 512;
/// OctoMap's trees have sixteen levels: indices from -2^15 to 2^15 - 1.
pub(crate) const INDEX_LIMIT: i32 = 1 << 15;

/// How occupancy is mapped.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OccupancyOptions {
    /// Which depth pixels are valid.
    pub filter: DepthFilter,
    /// Edge of a cell, metres.
    pub resolution_m: f64,
    /// Free space is mapped up to this depth, metres.
    pub max_range_m: f64,
    /// Added to the log-odds of a cell that is hit (OctoMap's default: probability 0.7).
    pub hit: f32,
    /// Added to the log-odds of a cell that is seen to be free (OctoMap's default: probability 0.4).
    pub miss: f32,
    /// Smallest log-odds.
    pub least: f32,
    /// Largest log-odds.
    pub most: f32,
    /// Memory that the grid may take, MiB.
    pub memory_limit_mib: u64,
}

impl Default for OccupancyOptions {
    fn default() -> Self {
        OccupancyOptions {
            filter: DepthFilter::default(),
            resolution_m: 0.02,
            max_range_m: 3.0,
            hit: 0.85,
            miss: -0.4,
            least: -2.0,
            most: 3.5,
            memory_limit_mib: 1024,
        }
    }
}

impl OccupancyOptions {
    fn check(&self) -> Result<(), Error> {
        self.filter.check()?;
        let bad = |option, value: f64, need| Err(Error::Option { option, value: value.to_string(), need });
        if !(1e-3..=10.0).contains(&self.resolution_m) {
            return bad("resolution_m", self.resolution_m, "0.001 to 10 m is needed");
        }
        if !(self.max_range_m > 0.0 && self.max_range_m <= 100.0) {
            return bad("max_range_m", self.max_range_m, "up to 100 m is needed");
        }
        if !(self.hit > 0.0 && self.hit.is_finite()) {
            return bad("hit", self.hit.into(), "a positive number is needed");
        }
        if !(self.miss < 0.0 && self.miss.is_finite()) {
            return bad("miss", self.miss.into(), "a negative number is needed");
        }
        if !(self.least < 0.0 && self.most > 0.0 && self.least.is_finite() && self.most.is_finite()) {
            return bad("least", self.least.into(), "least < 0 < most is needed");
        }
        Ok(())
    }
}

/// What is known of a point in space.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Occupancy {
    /// Never seen.
    Unknown,
    /// Seen to be empty.
    Free,
    /// Something is there.
    Occupied,
}

/// Log-odds of a block's cells, `(z * 8 + y) * 8 + x`; NaN = unknown.
type Cells = [f32; CELLS];

/// The map of free and occupied space.
#[derive(Debug)]
pub struct OccupancyGrid {
    options: OccupancyOptions,
    rays: Option<Rays>,
    blocks: VoxelMap<Box<Cells>>,
    views: usize,
}

/// Bytes a block takes: its cells and its place in the table.
const BYTES_PER_BLOCK: usize = size_of::<Cells>() + 4 * size_of::<VoxelKey>();

impl OccupancyGrid {
    /// An empty grid; options that make no sense are errors.
    pub fn new(options: OccupancyOptions) -> Result<Self, Error> {
        options.check()?;
        Ok(OccupancyGrid { options, rays: None, blocks: VoxelMap::default(), views: 0 })
    }

    /// Adds a view. On an error the grid is as it was.
    pub fn add(&mut self, view: &View<'_>) -> Result<(), Error> {
        view.check()?;
        let camera = &view.depth_camera.camera;
        let rays = match self.rays.take() {
            Some(rays) if rays.are_of(camera) => rays,
            _ => Rays::new(camera),
        };
        let pyramid = DepthPyramid::new(view, &rays, &self.options);
        let observed = pyramid.observed_blocks(view, &rays, &self.options);
        self.rays = Some(rays);
        let observed = observed?;
        let new = observed.iter().filter(|(key, _)| !self.blocks.contains_key(key)).count();
        if ((self.blocks.len() + new) * BYTES_PER_BLOCK) as u64 > self.options.memory_limit_mib << 20 {
            return Err(Error::MemoryLimit {
                limit_mib: self.options.memory_limit_mib,
                views: self.views,
                advice: "use a larger resolution_m, a smaller max_range_m, or raise memory_limit_mib",
            });
        }
        for (key, seen) in observed {
            let cells = self.blocks.entry(key).or_insert_with(|| Box::new([f32::NAN; CELLS]));
            for (cell, seen) in cells.iter_mut().zip(seen.iter()) {
                let change = match seen {
                    Occupancy::Unknown => continue,
                    Occupancy::Free => self.options.miss,
                    Occupancy::Occupied => self.options.hit,
                };
                let before = if cell.is_nan() { 0.0 } else { *cell };
                *cell = (before + change).clamp(self.options.least, self.options.most);
            }
        }
        self.views += 1;
        Ok(())
    }

    /// What is known of a point in the base frame.
    pub fn at(&self, point_in_base: [f64; 3]) -> Occupancy {
        let Ok(key) = VoxelKey::of_point(point_in_base, 1.0 / self.options.resolution_m) else {
            return Occupancy::Unknown;
        };
        self.at_cell(key.index())
    }

    /// What is known of a cell.
    pub(crate) fn at_cell(&self, index: [i32; 3]) -> Occupancy {
        let block = VoxelKey::new(index.map(|i| i.div_euclid(EDGE))).and_then(|key| self.blocks.get(&key));
        block.map_or(Occupancy::Unknown, |cells| state(cells[place(index.map(|i| i.rem_euclid(EDGE)))]))
    }

    /// Numbers of free and of occupied cells.
    pub fn counts(&self) -> (usize, usize) {
        self.blocks.values().flat_map(|cells| cells.iter()).fold((0, 0), |(free, occupied), cell| match state(*cell) {
            Occupancy::Unknown => (free, occupied),
            Occupancy::Free => (free + 1, occupied),
            Occupancy::Occupied => (free, occupied + 1),
        })
    }

    /// Edge of a cell, metres.
    pub fn resolution_m(&self) -> f64 {
        self.options.resolution_m
    }

    /// All known cells with their log-odds, by z, y and x of their blocks and then of themselves.
    pub(crate) fn cells(&self) -> Vec<([i32; 3], f32)> {
        let mut blocks: Vec<(&VoxelKey, &Box<Cells>)> = self.blocks.iter().collect();
        blocks.sort_unstable_by_key(|(key, _)| **key);
        let mut cells = Vec::new();
        for (key, values) in blocks {
            let corner = key.index().map(|index| index * EDGE);
            for (at, value) in values.iter().enumerate().filter(|(_, value)| !value.is_nan()) {
                let at = at as i32;
                cells.push((
                    [corner[0] + at % EDGE, corner[1] + at / EDGE % EDGE, corner[2] + at / EDGE / EDGE],
                    *value,
                ));
            }
        }
        cells
    }
}

/// A cell's place in its block.
pub(crate) fn place([x, y, z]: [i32; 3]) -> usize {
    ((z * EDGE + y) * EDGE + x) as usize
}

/// OctoMap's rule: a cell is occupied from a probability of one half on.
pub(crate) fn state(log_odds: f32) -> Occupancy {
    if log_odds.is_nan() {
        Occupancy::Unknown
    } else if log_odds >= 0.0 {
        Occupancy::Occupied
    } else {
        Occupancy::Free
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::tsdf::tests::wall;
    use crate::view::tests::{plain_camera, view};

    /// A wall at 1.01 m seen three times, cells of 2 cm.
    pub(crate) fn seen_wall() -> OccupancyGrid {
        let camera = plain_camera(200, 150);
        let depth = wall(200, 150, 1.01);
        let mut grid = OccupancyGrid::new(OccupancyOptions::default()).unwrap();
        for _ in 0..3 {
            grid.add(&view(&depth, &camera)).unwrap();
        }
        grid
    }

    #[test]
    fn before_the_wall_it_is_free_at_it_occupied_and_behind_it_unknown() {
        let grid = seen_wall();
        for z in [0.3, 0.5, 0.9] {
            assert_eq!(grid.at([0.0, 0.0, z]), Occupancy::Free, "{z}");
        }
        assert_eq!(grid.at([0.0, 0.0, 1.01]), Occupancy::Occupied);
        assert_eq!(grid.at([0.2, -0.1, 1.01]), Occupancy::Occupied);
        assert_eq!(grid.at([0.0, 0.0, 1.05]), Occupancy::Unknown);
        assert_eq!(grid.at([0.0, 0.0, -0.2]), Occupancy::Unknown, "behind the camera");
        assert_eq!(grid.at([0.8, 0.0, 0.5]), Occupancy::Unknown, "outside the image");
    }

    #[test]
    fn cells_beside_a_near_edge_are_not_free() {
        let camera = plain_camera(200, 150);
        let depths = (0..200 * 150).map(|i| if i % 200 < 100 { 0.5 } else { 1.0 }).collect();
        let depth = skclam_geometry::DepthImage::new(200, 150, depths).unwrap();
        let mut grid = OccupancyGrid::new(OccupancyOptions::default()).unwrap();
        grid.add(&view(&depth, &camera)).unwrap();
        // The shadow of the near half: x < 0 at z > 0.5.
        assert_eq!(grid.at([-0.01, 0.0, 0.75]), Occupancy::Unknown);
        assert_eq!(grid.at([0.07, 0.0, 0.75]), Occupancy::Free);
        assert_eq!(grid.at([-0.07, 0.0, 0.4]), Occupancy::Free);
    }

    #[test]
    fn bad_input_leaves_the_grid_as_it_was() {
        let camera = plain_camera(40, 30);
        let depth = wall(40, 30, 1.0);
        let tight = OccupancyOptions { memory_limit_mib: 0, ..Default::default() };
        let mut grid = OccupancyGrid::new(tight).unwrap();
        assert!(matches!(grid.add(&view(&depth, &camera)), Err(Error::MemoryLimit { .. })));
        let mut far = view(&depth, &camera);
        far.base_from_color.translation.x = 5000.0;
        assert!(matches!(grid.add(&far), Err(Error::OutOfRange { .. })));
        far.base_from_color.translation.x = f64::NAN;
        assert!(matches!(grid.add(&far), Err(Error::BadNumber { .. })));
        assert_eq!(grid.counts(), (0, 0));
        let holes = wall(40, 30, 0.0);
        let mut grid = OccupancyGrid::new(OccupancyOptions::default()).unwrap();
        grid.add(&view(&holes, &camera)).unwrap();
        assert_eq!(grid.counts(), (0, 0));
        assert!(OccupancyGrid::new(OccupancyOptions { miss: 0.1, ..Default::default() }).is_err());
    }
}
