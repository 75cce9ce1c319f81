//! Exhaustive search for the two nearest descriptors, in both directions, in one pass over the distance matrix.
//!
//! The Hamming distance of every pair is computed once and updates the two best of its row and the two best of its
//! column. A candidate is one `u32`, `distance << 22 | index`, so that the two best are kept with a minimum and a
//! maximum, and equal distances are decided by the lower index whatever the order of the work. The second set is
//! stored transposed, [`LANES`] descriptors side by side, so that one vector instruction advances that many distances
//! and no horizontal sum is needed; [`ROWS`] descriptors of the first set share each load. A stretch of the second
//! set that fits the second-level cache is walked for one row group after another.
//!
//! Rows are cut into bands by their number alone, bands run in parallel, and the best of each column are merged over
//! the bands; a minimum over distinct keys does not depend on the order, so neither does the result on the threads.

use super::kernel::{self, Kernel};
use crate::Descriptor;
use rayon::prelude::*;

/// Descriptors of the second set that are compared at once.
pub(crate) const LANES: usize = 16;
/// Descriptors of the first set that share one walk over the second.
pub(crate) const ROWS: usize = 4;
/// Bits of a key that hold an index; the distance of at most 512 needs the ten above.
pub(crate) const INDEX_BITS: u32 = 22;
/// The key that is worse than every candidate.
pub(crate) const NO_KEY: u32 = u32::MAX;
/// Blocks of [`LANES`] descriptors that are walked together: 128 KiB of descriptors and 16 KiB of column state.
const BLOCKS_PER_STRETCH: usize = 128;
/// Rows in the smallest band: fewer, and merging the columns would show.
const BAND_ROWS: usize = 512;
/// Bands at most, which bounds the memory for the columns' state.
const MAX_BANDS: usize = 64;

/// One `u32` a lane, aligned for the widest vector.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(crate) struct Lanes(pub(crate) [u32; LANES]);

/// The two smallest keys of each lane, the smallest first.
pub(crate) type Best = [Lanes; 2];

/// [`LANES`] descriptors, transposed: word `w` of all of them side by side.
#[derive(Debug, Clone)]
pub(crate) struct Block {
    pub(crate) words: [Lanes; 16],
    /// Index within the stretch, [`NO_KEY`] for lanes without a descriptor.
    pub(crate) tags: Lanes,
}

/// Descriptors of the first set with what their keys in the columns carry ([`NO_KEY`] for a missing row).
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(crate) struct RowGroup {
    pub(crate) words: [[u32; 16]; ROWS],
    pub(crate) tags: [u32; ROWS],
}

/// No candidate yet.
pub(crate) const NO_BEST: Best = [Lanes([NO_KEY; LANES]); 2];

/// The nearest descriptor of another set, and how far the second nearest is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Nearest {
    /// Index of the nearest; the lowest one of those at equal distance.
    pub index: u32,
    /// Hamming distance to it.
    pub distance: u32,
    /// Hamming distance to the second nearest (another index, perhaps at the same distance);
    /// `u32::MAX` where the other set has but one descriptor.
    pub second_distance: u32,
}

/// The two nearest of every descriptor, in both directions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TwoNearest {
    /// For each descriptor of the first set, its nearest in the second; empty if the second set is.
    pub of_a: Vec<Nearest>,
    /// For each descriptor of the second set, its nearest in the first; empty if the first set is.
    pub of_b: Vec<Nearest>,
}

/// Two nearest neighbours of every descriptor in the other set, by comparing all with all.
///
/// Uses the widest vectors that the processor offers (AVX-512 with a population count, AVX2, or portable code, with
/// equal results) and rayon's current pool. Memory grows with the sum of the sizes, not with their product.
///
/// # Panics
/// If a set has 2^32 - 1 descriptors or more; an index is a `u32`.
pub fn two_nearest(a: &[Descriptor], b: &[Descriptor]) -> TwoNearest {
    two_nearest_with(a, b, kernel::fastest())
}

/// [`two_nearest`] with a chosen kernel.
pub(super) fn two_nearest_with(a: &[Descriptor], b: &[Descriptor], kernel: Kernel) -> TwoNearest {
    assert!(a.len() < u32::MAX as usize && b.len() < u32::MAX as usize, "{} x {} descriptors", a.len(), b.len());
    if a.is_empty() || b.is_empty() {
        return TwoNearest::default();
    }
    let blocks = transposed(b);
    let band_rows = BAND_ROWS.max(a.len().div_ceil(MAX_BANDS)).next_multiple_of(ROWS).min(1 << INDEX_BITS);
    let bands: Vec<(Vec<Pair>, Vec<Best>)> =
        a.par_chunks(band_rows).map(|band| search_band(band, &blocks, kernel)).collect();

    let of_b = (0..b.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|column| {
            let mut best = Pair::default();
            for (band, (_, columns)) in bands.iter().enumerate() {
                let [first, second] = &columns[column / LANES];
                best.insert_key(first.0[column % LANES], band * band_rows);
                best.insert_key(second.0[column % LANES], band * band_rows);
            }
            best.into_nearest()
        })
        .collect();
    let of_a = bands.into_iter().flat_map(|(rows, _)| rows).map(Pair::into_nearest).collect();
    TwoNearest { of_a, of_b }
}

/// The two best candidates over stretches or bands: `distance << 32 | index`.
#[derive(Debug, Clone, Copy)]
struct Pair([u64; 2]);

impl Default for Pair {
    fn default() -> Self {
        Pair([u64::MAX; 2])
    }
}

impl Pair {
    /// Takes in a candidate whose index counts from `first`.
    fn insert_key(&mut self, key: u32, first: usize) {
        if key == NO_KEY {
            return;
        }
        let index = first as u64 + u64::from(key & ((1 << INDEX_BITS) - 1));
        let key = u64::from(key >> INDEX_BITS) << 32 | index;
        self.0[1] = self.0[1].min(self.0[0].max(key));
        self.0[0] = self.0[0].min(key);
    }

    fn into_nearest(self) -> Nearest {
        Nearest {
            index: self.0[0] as u32,
            distance: (self.0[0] >> 32) as u32,
            // The upper half of the "none" key is `u32::MAX`, as promised.
            second_distance: (self.0[1] >> 32) as u32,
        }
    }
}

/// The second set in blocks of [`LANES`], indices counted from the start of each stretch.
fn transposed(descriptors: &[Descriptor]) -> Vec<Block> {
    let blocks = descriptors.par_chunks(LANES).enumerate().map(|(number, chunk)| {
        let first = (number % BLOCKS_PER_STRETCH * LANES) as u32;
        let mut block = Block { words: [Lanes([0; LANES]); 16], tags: Lanes([NO_KEY; LANES]) };
        for (lane, descriptor) in chunk.iter().enumerate() {
            block.tags.0[lane] = first + lane as u32;
            for (word, value) in words(descriptor).into_iter().enumerate() {
                block.words[word].0[lane] = value;
            }
        }
        block
    });
    blocks.collect()
}

/// A descriptor as 16 words of 32 bits.
pub(crate) fn words(descriptor: &Descriptor) -> [u32; 16] {
    std::array::from_fn(|word| (descriptor.0[word / 2] >> (word % 2 * 32)) as u32)
}

/// All of one band of rows against everything: the best of its rows, and the best in it of every column.
fn search_band(band: &[Descriptor], blocks: &[Block], kernel: Kernel) -> (Vec<Pair>, Vec<Best>) {
    let mut best_of_rows = vec![Pair::default(); band.len()];
    let mut best_of_columns = vec![NO_BEST; blocks.len()];
    let groups: Vec<RowGroup> = band
        .chunks(ROWS)
        .enumerate()
        .map(|(number, rows)| {
            let mut group = RowGroup { words: [[0; 16]; ROWS], tags: [NO_KEY; ROWS] };
            for (row, descriptor) in rows.iter().enumerate() {
                group.words[row] = words(descriptor);
                group.tags[row] = (number * ROWS + row) as u32;
            }
            group
        })
        .collect();

    let stretches = blocks.chunks(BLOCKS_PER_STRETCH).zip(best_of_columns.chunks_mut(BLOCKS_PER_STRETCH));
    for (number, (stretch, columns)) in stretches.enumerate() {
        let first = number * BLOCKS_PER_STRETCH * LANES;
        for (group, best) in groups.iter().zip(best_of_rows.chunks_mut(ROWS)) {
            let mut lanes = [NO_BEST; ROWS];
            kernel.run(group, stretch, &mut lanes, columns);
            for (row, keys) in best.iter_mut().zip(&lanes) {
                let [smallest, second] = two_smallest(keys);
                row.insert_key(smallest, first);
                row.insert_key(second, first);
            }
        }
    }
    (best_of_rows, best_of_columns)
}

/// The two smallest keys over all lanes.
#[inline]
pub(crate) fn two_smallest(best: &Best) -> [u32; 2] {
    let [mut first, mut second] = [best[0].0, best[1].0];
    // Halves are merged until one lane is left.
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            let larger = first[lane].max(first[lane + half]);
            first[lane] = first[lane].min(first[lane + half]);
            second[lane] = second[lane].min(second[lane + half]).min(larger);
        }
        half /= 2;
    }
    [first[0], second[0]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::kernel::available;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// What the module computes, written for reading.
    fn plain(a: &[Descriptor], b: &[Descriptor]) -> Vec<Nearest> {
        let nearest = |row: &Descriptor| {
            let mut all: Vec<(u32, u32)> =
                b.iter().zip(0..).map(|(other, index)| (row.hamming(other), index)).collect();
            all.sort_unstable();
            Nearest { index: all[0].1, distance: all[0].0, second_distance: all.get(1).map_or(u32::MAX, |next| next.0) }
        };
        a.iter().map(nearest).collect()
    }

    /// Descriptors with few different bits, so that ties abound.
    fn descriptors(count: usize, mask: u64, seed: u64) -> Vec<Descriptor> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        (0..count).map(|_| Descriptor(std::array::from_fn(|_| random.random::<u64>() & mask))).collect()
    }

    #[test]
    fn every_kernel_agrees_with_sorting_all_distances() {
        // Sizes around every boundary: lanes, row groups, stretches and bands.
        for (count_a, count_b) in [(1, 1), (1, 2), (3, 15), (4, 16), (5, 17), (33, 2048), (515, 40), (30, 2065)] {
            for mask in [u64::MAX, 0x8000_0000_0000_0001] {
                let (a, b) = (descriptors(count_a, mask, 1), descriptors(count_b, mask, 2));
                let expected = TwoNearest { of_a: plain(&a, &b), of_b: plain(&b, &a) };
                for kernel in available() {
                    assert_eq!(two_nearest_with(&a, &b, kernel), expected, "{kernel:?} on {count_a} x {count_b}");
                }
            }
        }
    }

    #[test]
    fn the_farthest_distance_is_held() {
        let (zeros, ones) = (vec![Descriptor([0; 8]); 3], vec![Descriptor([u64::MAX; 8]); 3]);
        for kernel in available() {
            let nearest = two_nearest_with(&zeros, &ones, kernel);
            assert!(nearest.of_a.iter().all(|n| *n == Nearest { index: 0, distance: 512, second_distance: 512 }));
        }
    }

    #[test]
    fn an_empty_set_has_no_neighbours() {
        let some = descriptors(3, u64::MAX, 3);
        assert_eq!(two_nearest(&some, &[]), TwoNearest::default());
        assert_eq!(two_nearest(&[], &some), TwoNearest::default());
    }

    #[test]
    fn threads_do_not_matter() {
        let (a, b) = (descriptors(1500, u64::MAX, 4), descriptors(700, u64::MAX, 5));
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| two_nearest(&a, &b))
        };
        let one = on(1);
        assert!((2..5).all(|threads| on(threads) == one));
    }
}
