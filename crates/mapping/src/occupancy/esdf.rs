//! The distance of every cell to the nearest occupied one, as a dense array: the exact Euclidean distance transform of
//! Felzenszwalb and Huttenlocher (2012), one axis after the other.

use super::npz::Npz;
use super::{OccupancyGrid, state};
use crate::Error;
use rayon::prelude::*;
use std::io::Write;

/// A dense box of cells; the cell `(x, y, z)` is at `(x * ny + y) * nz + z`.
#[derive(Debug, Clone, PartialEq)]
pub struct Esdf {
    /// Cells along x, y, z.
    pub shape: [usize; 3],
    /// Centre of the cell (0, 0, 0) in the base frame, metres.
    pub origin_m: [f64; 3],
    /// Edge of a cell, metres.
    pub resolution_m: f64,
    /// Distance between a cell's centre and that of the nearest occupied cell, metres; 0 in occupied cells.
    pub distance_m: Vec<f32>,
    /// 0 unknown, 1 free, 2 occupied.
    pub state: Vec<u8>,
}

/// Bytes a cell takes while distances are computed.
const BYTES_PER_CELL: u64 = 4 + 1 + 4;

impl OccupancyGrid {
    /// Distances over the box around all known cells, if it takes no more than `memory_limit_mib`.
    pub fn esdf(&self, memory_limit_mib: u64) -> Result<Esdf, Error> {
        let cells = self.cells();
        let occupied = cells.iter().any(|(_, value)| state(*value) == super::Occupancy::Occupied);
        let Some(first) = cells.first().map(|(index, _)| *index).filter(|_| occupied) else {
            return Err(Error::Empty {
                what: "the set of occupied cells",
                advice: "a distance field needs something to be distant from: add views that show a surface",
            });
        };
        let (low, high) = cells.iter().fold((first, first), |(low, high), (index, _)| {
            let pick = |of: fn(i32, i32) -> i32, a: [i32; 3]| std::array::from_fn(|axis| of(a[axis], index[axis]));
            (pick(i32::min, low), pick(i32::max, high))
        });
        let shape: [usize; 3] = std::array::from_fn(|axis| (high[axis] - low[axis]) as usize + 1);
        let count = shape.iter().map(|&length| length as u64).product::<u64>();
        if count.saturating_mul(BYTES_PER_CELL) > memory_limit_mib << 20 {
            return Err(Error::MemoryLimit {
                limit_mib: memory_limit_mib,
                views: self.views,
                advice: "use a larger resolution_m or a smaller max_range_m, or raise the limit",
            });
        }
        let mut states = vec![0u8; count as usize];
        let mut squared = vec![f32::INFINITY; count as usize];
        for (index, value) in cells {
            let [x, y, z]: [usize; 3] = std::array::from_fn(|axis| (index[axis] - low[axis]) as usize);
            let place = (x * shape[1] + y) * shape[2] + z;
            let is_occupied = state(value) == super::Occupancy::Occupied;
            states[place] = if is_occupied { 2 } else { 1 };
            if is_occupied {
                squared[place] = 0.0;
            }
        }
        transform(&mut squared, shape);
        let resolution_m = self.resolution_m();
        squared.par_iter_mut().for_each(|value| *value = value.sqrt() * resolution_m as f32);
        let origin_m = low.map(|index| (f64::from(index) + 0.5) * resolution_m);
        Ok(Esdf { shape, origin_m, resolution_m, distance_m: squared, state: states })
    }
}

impl Esdf {
    /// Writes a NumPy archive: `distance_m` (float32) and `state` (uint8), both indexed `[x, y, z]`, `origin_m`
    /// (float64, 3) and `resolution_m` (float64, a scalar). The writer should be buffered.
    pub fn write_npz(&self, out: impl Write) -> Result<(), Error> {
        let mut archive = Npz::new(out);
        let floats = |list: &[f32]| list.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let doubles = |list: &[f64]| list.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        archive.add("distance_m", "<f4", &self.shape, &floats(&self.distance_m))?;
        archive.add("state", "|u1", &self.shape, &self.state)?;
        archive.add("origin_m", "<f8", &[3], &doubles(&self.origin_m))?;
        archive.add("resolution_m", "<f8", &[], &doubles(&[self.resolution_m]))?;
        archive.finish()
    }
}

/// Squared distances, in cells, from 0 where something is and infinity elsewhere.
fn transform(squared: &mut [f32], [nx, ny, nz]: [usize; 3]) {
    squared.par_chunks_mut(nz).for_each(along_line);
    let columns = |slab: &mut [f32], count: usize, stride: usize| {
        let mut line = vec![0.0; count];
        for first in 0..stride {
            for (step, value) in line.iter_mut().enumerate() {
                *value = slab[first + step * stride];
            }
            along_line(&mut line);
            for (step, value) in line.iter().enumerate() {
                slab[first + step * stride] = *value;
            }
        }
    };
    squared.par_chunks_mut(ny * nz).for_each(|slab| columns(slab, ny, nz));
    columns(squared, nx, ny * nz);
}

/// The lower envelope of parabolas over one line.
fn along_line(line: &mut [f32]) {
    // Apexes of the parabolas of the envelope, and where each begins to be the lowest.
    let mut apexes: Vec<(usize, f64)> = Vec::with_capacity(line.len());
    let mut begins: Vec<f64> = Vec::with_capacity(line.len());
    for (place, &height) in line.iter().enumerate() {
        if !height.is_finite() {
            continue;
        }
        let (x, height) = (place as f64, f64::from(height));
        let mut begin = f64::NEG_INFINITY;
        while let Some(&(last, last_height)) = apexes.last() {
            let last_x = last as f64;
            begin = ((height + x * x) - (last_height + last_x * last_x)) / (2.0 * (x - last_x));
            if begins.last().is_some_and(|last_begin| begin <= *last_begin) {
                apexes.pop();
                begins.pop();
                begin = f64::NEG_INFINITY;
            } else {
                break;
            }
        }
        apexes.push((place, height));
        begins.push(begin);
    }
    let mut current = 0;
    for (place, value) in line.iter_mut().enumerate() {
        if apexes.is_empty() {
            return;
        }
        while begins.get(current + 1).is_some_and(|begin| *begin < place as f64) {
            current += 1;
        }
        let (apex, height) = apexes[current];
        *value = ((place as f64 - apex as f64).powi(2) + height) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::seen_wall;
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn distances_are_those_of_a_search_of_all(occupied in prop::collection::vec((0usize..7, 0usize..5, 0usize..6), 1..6)) {
            let shape = [7, 5, 6];
            let mut field = vec![f32::INFINITY; 210];
            for &(x, y, z) in &occupied {
                field[(x * 5 + y) * 6 + z] = 0.0;
            }
            transform(&mut field, shape);
            for (place, value) in field.iter().enumerate() {
                let (x, y, z) = (place / 30, place / 6 % 5, place % 6);
                let nearest = occupied.iter().map(|o| {
                    let d = |a: usize, b: usize| (a as f32 - b as f32).powi(2);
                    d(x, o.0) + d(y, o.1) + d(z, o.2)
                }).fold(f32::INFINITY, f32::min);
                prop_assert!((value - nearest).abs() < 1e-4, "{value} {nearest}");
            }
        }
    }

    #[test]
    fn distances_grow_before_the_wall() {
        let esdf = seen_wall().esdf(64).unwrap();
        assert_eq!(esdf.distance_m.len(), esdf.shape.iter().product::<usize>());
        let cell = |point: [f64; 3]| {
            let [x, y, z]: [usize; 3] =
                std::array::from_fn(|axis| ((point[axis] - esdf.origin_m[axis]) / esdf.resolution_m).round() as usize);
            (x * esdf.shape[1] + y) * esdf.shape[2] + z
        };
        assert!((esdf.distance_m[cell([0.01, 0.01, 0.71])] - 0.3).abs() < 1e-3);
        assert_eq!((esdf.distance_m[cell([0.01, 0.01, 1.01])], esdf.state[cell([0.01, 0.01, 1.01])]), (0.0, 2));
        assert_eq!(esdf.state[cell([0.01, 0.01, 0.71])], 1);
        assert!(matches!(seen_wall().esdf(0), Err(Error::MemoryLimit { .. })));
        let empty = OccupancyGrid::new(crate::OccupancyOptions::default()).unwrap();
        assert!(matches!(empty.esdf(64), Err(Error::Empty { .. })));
    }
}
