//! The binary descriptor: M-LDB, 486 bits.
//!
//! A square of 20 x 20 steps around the keypoint, turned by its main direction, is sampled once a step and divided into
//! 2 x 2, 3 x 3 and 4 x 4 cells. Each cell has three values: the mean of the level's image and of its two first
//! derivatives along the square's axes. Within each grid every pair of cells gives three bits, one a value: whether the
//! first cell's is larger. That is 3 (6 + 36 + 120) = 486 bits.
//!
//! The samples are symmetric about the keypoint (at -9.5, -8.5 .. 9.5 steps), so that a turn by 180 degrees samples the
//! same points; the 20 samples of a side are shared as 7, 6 and 7 in the grid of 3. All three grids use the same
//! samples, summed once over the 6 x 6 blocks that the cells' borders cut out.

use crate::Descriptor;
use multiversion::multiversion;

/// Samples along a side of the square.
const SIDE: usize = 20;
/// Borders of the blocks along a side: those of the cells of all three grids.
const BLOCKS: [usize; 7] = [0, 5, 7, 10, 13, 15, 20];
/// First and last block of each cell along a side, for each grid.
const CELLS: [&[(usize, usize)]; 3] = [&[(0, 3), (3, 6)], &[(0, 2), (2, 4), (4, 6)], &[(0, 1), (1, 3), (3, 5), (5, 6)]];

/// Where and how a descriptor is sampled.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Square {
    /// Centre in the level's pixels.
    pub centre: [f32; 2],
    /// Distance between samples in the level's pixels.
    pub step: f32,
    /// Cosine and sine of the main direction.
    pub direction: [f32; 2],
}

/// Describes one keypoint. The square has to lie inside of the level.
pub(crate) fn describe(image: &[f32], gradient: &[[f32; 2]], width: usize, square: Square) -> Descriptor {
    let mut index = [0u32; SIDE * SIDE];
    sample_positions(width as u32, square, &mut index);

    // Sums over the 6 x 6 blocks: image, derivative in x and in y.
    let mut blocks = [[[0.0f32; 3]; 6]; 6];
    for (u, row) in index.chunks_exact(SIDE).enumerate() {
        let sums = &mut blocks[BLOCKS.iter().rposition(|&b| b <= u).expect("the first border is 0")];
        for (sum, borders) in sums.iter_mut().zip(BLOCKS.windows(2)) {
            for &i in &row[borders[0]..borders[1]] {
                let [gx, gy] = gradient[i as usize];
                sum[0] += image[i as usize];
                sum[1] += gx;
                sum[2] += gy;
            }
        }
    }

    let [co, si] = square.direction;
    let mut bits = BitWriter::default();
    for cells in CELLS {
        let count = cells.len() * cells.len();
        let mut values = [[0.0f32; 16]; 3];
        for (i, &rows) in cells.iter().enumerate() {
            for (j, &columns) in cells.iter().enumerate() {
                let mut sum = [0.0f32; 3];
                for row in &blocks[rows.0..rows.1] {
                    for block in &row[columns.0..columns.1] {
                        (0..3).for_each(|c| sum[c] += block[c]);
                    }
                }
                let side = |r: (usize, usize)| BLOCKS[r.1] - BLOCKS[r.0];
                let inverse = 1.0 / (side(rows) * side(columns)) as f32;
                let [grey, gx, gy] = sum.map(|s| s * inverse);
                let cell = i * cells.len() + j;
                values[0][cell] = grey;
                values[1][cell] = gy * co - gx * si;
                values[2][cell] = gx * co + gy * si;
            }
        }
        compare_pairs(&values, count, &mut bits);
    }
    Descriptor(bits.words)
}

/// Index of the pixel nearest to each sample, `u` (along the direction) outer, `v` (across it) inner.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
fn sample_positions(width: u32, square: Square, index: &mut [u32; SIDE * SIDE]) {
    let Square { centre: [cx, cy], step, direction: [co, si] } = square;
    let (along, across) = ([co * step, si * step], [-si * step, co * step]);
    for (u, row) in index.chunks_exact_mut(SIDE).enumerate() {
        let du = u as f32 - 9.5;
        let (x0, y0) = (cx + du * along[0], cy + du * along[1]);
        for (v, i) in row.iter_mut().enumerate() {
            let dv = v as f32 - 9.5;
            // Adding 2^23 rounds to the nearest integer and leaves it in the low bits.
            let x = (x0 + dv * across[0] + 8_388_608.0).to_bits() & 0x7f_ffff;
            let y = (y0 + dv * across[1] + 8_388_608.0).to_bits() & 0x7f_ffff;
            *i = y * width + x;
        }
    }
}

/// For each channel the bits of all pairs `i < j < count`: whether value `i` is larger than value `j`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2"))]
fn compare_pairs(values: &[[f32; 16]; 3], count: usize, bits: &mut BitWriter) {
    for values in values {
        for (i, &first) in values[..count - 1].iter().enumerate() {
            // All sixteen comparisons at once, then those with a later value.
            let mut larger = 0u32;
            for (j, &second) in values.iter().enumerate() {
                larger |= u32::from(first > second) << j;
            }
            let later = count - 1 - i;
            bits.push(u64::from(larger >> (i + 1)) & ((1 << later) - 1), later);
        }
    }
}

/// Appends bits to the words of a descriptor.
#[derive(Default)]
struct BitWriter {
    words: [u64; 8],
    count: usize,
}

impl BitWriter {
    /// Appends the `n < 64` lowest bits; the others have to be 0.
    #[inline(always)]
    fn push(&mut self, bits: u64, n: usize) {
        let (word, shift) = (self.count >> 6, self.count & 63);
        self.words[word] |= bits << shift;
        if shift + n > 64 {
            self.words[word + 1] |= bits >> (64 - shift);
        }
        self.count += n;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(x: f32, y: f32) -> f32 {
        (0.31 * x + 0.2 * y).sin() + (0.17 * x - 0.4 * y).cos() + 0.5 * (0.05 * x * y).sin()
    }

    fn planes(size: usize) -> (Vec<f32>, Vec<[f32; 2]>) {
        let at = |i: usize| ((i % size) as f32, (i / size) as f32);
        let image = (0..size * size).map(|i| texture(at(i).0, at(i).1)).collect();
        let slope = |i: usize| {
            let (x, y) = at(i);
            [texture(x + 0.5, y) - texture(x - 0.5, y), texture(x, y + 0.5) - texture(x, y - 0.5)]
        };
        (image, (0..size * size).map(slope).collect())
    }

    #[test]
    fn exactly_486_bits_are_used() {
        let used: usize = CELLS.iter().map(|c| c.len() * c.len()).map(|n| 3 * n * (n - 1) / 2).sum();
        assert_eq!(used, 486);
        let (image, gradient) = planes(64);
        let square = Square { centre: [32.0, 32.0], step: 2.0, direction: [1.0, 0.0] };
        let descriptor = describe(&image, &gradient, 64, square);
        assert_eq!(descriptor.0[7] >> (486 - 448), 0);
    }

    #[test]
    fn blocks_are_the_common_refinement_of_the_three_grids() {
        for (cells, sizes) in CELLS.iter().zip([&[10, 10][..], &[7, 6, 7], &[5, 5, 5, 5]]) {
            let got: Vec<usize> = cells.iter().map(|c| BLOCKS[c.1] - BLOCKS[c.0]).collect();
            assert_eq!(got, sizes);
        }
    }

    #[test]
    fn a_half_turn_of_image_and_direction_changes_nothing() {
        let size = 80;
        let (image, gradient) = planes(size);
        let turned: Vec<f32> = image.iter().rev().copied().collect();
        let turned_gradient: Vec<[f32; 2]> = gradient.iter().rev().map(|g| [-g[0], -g[1]]).collect();
        let direction = [0.8f32, 0.6];
        let a = Square { centre: [40.2, 38.76], step: 2.0, direction };
        let b = Square { centre: [79.0 - 40.2, 79.0 - 38.76], step: 2.0, direction: direction.map(|d| -d) };
        let distance = describe(&image, &gradient, size, a).hamming(&describe(&turned, &turned_gradient, size, b));
        assert!(distance <= 4, "{distance}");
    }
}
