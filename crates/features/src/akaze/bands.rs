//! Bands of rows: how one image is shared among threads, and the small ring buffers of rows that each band streams
//! through, so that intermediate images never leave the cache.

use super::options::Threading;
use rayon::prelude::*;
use std::ops::Range;

/// The last few rows of an image that is made row by row.
#[derive(Debug, Default)]
pub(crate) struct Ring {
    data: Vec<f32>,
    width: usize,
    capacity: usize,
}

impl Ring {
    /// Empties the ring and sets the length and number of its rows.
    pub(crate) fn reset(&mut self, width: usize, capacity: usize) {
        self.width = width;
        self.capacity = capacity;
        if self.data.len() < width * capacity {
            self.data.resize(width * capacity, 0.0);
        }
    }

    /// Row `y` of the image; it must be one of the last `capacity` rows that were written.
    pub(crate) fn row(&self, y: usize) -> &[f32] {
        &self.data[y % self.capacity * self.width..][..self.width]
    }

    /// Place of row `y`, overwriting row `y - capacity`.
    pub(crate) fn row_mut(&mut self, y: usize) -> &mut [f32] {
        &mut self.data[y % self.capacity * self.width..][..self.width]
    }
}

/// How many bands to cut `rows` rows into.
pub(crate) fn band_count(rows: usize, threading: Threading) -> usize {
    /// Thinner bands would recompute more rows at their edges than they contain.
    const MIN_ROWS: usize = 32;
    match threading {
        Threading::Caller => 1,
        Threading::RowBands => rayon::current_num_threads().min(rows / MIN_ROWS).max(1),
    }
}

/// Band `index` of `count` equal ones.
pub(crate) fn band(rows: usize, index: usize, count: usize) -> Range<usize> {
    rows * index / count..rows * (index + 1) / count
}

/// Cuts a plane into its bands of rows.
pub(crate) fn split_rows<T>(mut plane: &mut [T], width: usize, rows: usize, count: usize) -> Vec<&mut [T]> {
    (0..count)
        .map(|i| {
            let (head, tail) = std::mem::take(&mut plane).split_at_mut(band(rows, i, count).len() * width);
            plane = tail;
            head
        })
        .collect()
}

/// Does every job, on the threads of the pool or on this one.
pub(crate) fn for_each<T: Send>(jobs: Vec<T>, threading: Threading, work: impl Fn(T) + Sync + Send) {
    match threading {
        Threading::RowBands if jobs.len() > 1 => jobs.into_par_iter().with_max_len(1).for_each(work),
        _ => jobs.into_iter().for_each(work),
    }
}

/// Row `y` of an image of `rows` rows, mirrored at the first and last row's centre; the farthest row there is where
/// the image is smaller than that.
pub(crate) fn mirrored(y: isize, rows: usize) -> usize {
    let last = rows as isize - 1;
    let inside = if y < 0 {
        -y
    } else if y > last {
        2 * last - y
    } else {
        y
    };
    inside.clamp(0, last) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_cover_every_row_once() {
        for rows in [1, 31, 64, 1080] {
            for count in 1..9 {
                let all: Vec<usize> = (0..count).flat_map(|i| band(rows, i, count)).collect();
                assert_eq!(all, (0..rows).collect::<Vec<_>>());
                let mut plane = vec![0u8; rows * 3];
                let parts = split_rows(&mut plane, 3, rows, count);
                assert!(parts.iter().enumerate().all(|(i, p)| p.len() == 3 * band(rows, i, count).len()));
            }
        }
    }

    #[test]
    fn mirroring_repeats_no_pixel() {
        let seen: Vec<usize> = (-3..8).map(|y| mirrored(y, 5)).collect();
        assert_eq!(seen, [3, 2, 1, 0, 1, 2, 3, 4, 3, 2, 1]);
        assert_eq!(mirrored(-4, 1), 0);
        assert_eq!(mirrored(9, 2), 0);
    }

    #[test]
    fn a_ring_keeps_its_last_rows() {
        let mut ring = Ring::default();
        ring.reset(2, 3);
        for y in 0..10 {
            ring.row_mut(y).fill(y as f32);
        }
        assert_eq!([ring.row(7)[0], ring.row(8)[1], ring.row(9)[0]], [7.0, 8.0, 9.0]);
    }
}
