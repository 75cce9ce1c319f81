//! The voxels of a cloud that is being built: sums, and the table that finds them.

use crate::voxel::{VoxelKey, VoxelMap};
use crate::{CloudOptions, UncoloredPoints};
use std::mem::size_of;

/// Colour of points that no colour image shows.
pub(crate) const NEUTRAL_GREY: f32 = 128.0;

/// Weighted sums over one voxel; positions relative to its corner keep single precision harmless.
#[derive(Clone, Copy, Default)]
pub(crate) struct Cell {
    offset: [f32; 3],
    weight: f32,
    normal: [f32; 3],
    color: [f32; 3],
    color_weight: f32,
    pixels: u32,
}

/// The mean of a cell.
pub(crate) struct FinishedPoint {
    pub(crate) point: [f32; 3],
    pub(crate) color: [u8; 3],
    pub(crate) normal: [f32; 3],
}

impl Cell {
    pub(crate) fn finish(&self, key: VoxelKey, voxel_m: f64, options: &CloudOptions) -> Option<FinishedPoint> {
        if self.pixels < options.min_pixels_per_voxel {
            return None;
        }
        let color = if self.color_weight > 0.0 {
            self.color.map(|sum| sum / self.color_weight)
        } else if options.uncolored == UncoloredPoints::Grey {
            [NEUTRAL_GREY; 3]
        } else {
            return None;
        };
        let corner = key.index();
        let point = std::array::from_fn(|axis| {
            (f64::from(corner[axis]) * voxel_m + f64::from(self.offset[axis] / self.weight)) as f32
        });
        Some(FinishedPoint { point, color: color.map(to_byte), normal: unit_or_up(self.normal) })
    }

    #[inline]
    pub(crate) fn add(&mut self, offset: [f32; 3], normal: [f32; 3], weight: f32, color: Option<[f32; 3]>) {
        for axis in 0..3 {
            self.offset[axis] += weight * offset[axis];
            self.normal[axis] += weight * normal[axis];
        }
        self.weight += weight;
        self.pixels += 1;
        if let Some(color) = color {
            for (sum, value) in self.color.iter_mut().zip(color) {
                *sum += weight * value;
            }
            self.color_weight += weight;
        }
    }

    #[inline]
    pub(crate) fn merge(&mut self, other: &Cell) {
        for axis in 0..3 {
            self.offset[axis] += other.offset[axis];
            self.normal[axis] += other.normal[axis];
            self.color[axis] += other.color[axis];
        }
        self.weight += other.weight;
        self.color_weight += other.color_weight;
        self.pixels += other.pixels;
    }
}

impl std::fmt::Debug for Cell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Cell({} px)", self.pixels)
    }
}

/// A shard of all cells. The table holds places, not cells: its empty slots, up to half of all, stay small.
#[derive(Debug, Default)]
pub(crate) struct Shard {
    place: VoxelMap<u32>,
    cells: Vec<Cell>,
}

impl Shard {
    /// Number of cells.
    pub(crate) fn len(&self) -> usize {
        self.cells.len()
    }

    /// The cell of a voxel, made if there is none.
    #[inline]
    pub(crate) fn at(&mut self, key: VoxelKey) -> &mut Cell {
        let next = self.cells.len() as u32;
        let place = *self.place.entry(key).or_insert(next);
        if place == next {
            self.cells.push(Cell::default());
        }
        &mut self.cells[place as usize]
    }

    /// Appends the voxels with the places of their cells, in no order, and returns the cells.
    pub(crate) fn split_into(self, places: &mut Vec<(VoxelKey, u32)>) -> Vec<Cell> {
        places.extend(self.place);
        self.cells
    }

    /// Memory that it takes.
    pub(crate) fn memory_bytes(&self) -> usize {
        // A table has a byte more for each of its slots.
        self.place.capacity() * (size_of::<(VoxelKey, u32)>() + 1) + self.cells.capacity() * size_of::<Cell>()
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
