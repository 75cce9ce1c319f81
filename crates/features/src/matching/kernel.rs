//! The inner loop of the exhaustive search and of that along epipolar lines, for the vector units that a processor may
//! have.
//!
//! All kernels do the same integer arithmetic, so their results are equal bit for bit. Which of them runs is decided
//! at run time; nothing has to be set when compiling.

use super::nearest::{Best, Block, INDEX_BITS, LANES, Lanes, ROWS, RowGroup};

/// A vector unit to search with.
///
/// Architecture Invariant: [`fastest`] and [`available`] are the only makers of variants other than `Portable`, and
/// make them only after asking the processor; the calls in [`Kernel::run`] rest on that.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kernel {
    /// Whatever the compiler makes of plain Rust for the target.
    Portable,
    /// 256-bit vectors; bits are counted by table look-ups.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 512-bit vectors with a population count of their own.
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

/// The kernels that this processor can run, the slowest first.
pub(crate) fn available() -> Vec<Kernel> {
    #[allow(unused_mut)]
    let mut kernels = vec![Kernel::Portable];
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx2") {
            kernels.push(Kernel::Avx2);
        }
        if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vpopcntdq") {
            kernels.push(Kernel::Avx512);
        }
    }
    kernels
}

/// The fastest kernel that this processor can run.
pub(crate) fn fastest() -> Kernel {
    *available().last().unwrap_or(&Kernel::Portable)
}

impl Kernel {
    /// Compares a group of rows with a stretch of blocks; lowers `rows` (a set of lanes for each row) and `columns`
    /// (one for each block) to the two smallest keys seen.
    #[inline]
    pub(super) fn run(self, group: &RowGroup, blocks: &[Block], rows: &mut [Best; ROWS], columns: &mut [Best]) {
        debug_assert_eq!(blocks.len(), columns.len());
        match self {
            Kernel::Portable => portable(group, blocks, rows, columns),
            // SAFETY: by the invariant of `Kernel`, the variant exists only if the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code)]
            Kernel::Avx2 => unsafe { x86::avx2(group, blocks, rows, columns) },
            // SAFETY: likewise for AVX-512F and VPOPCNTDQ.
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code)]
            Kernel::Avx512 => unsafe { x86::avx512(group, blocks, rows, columns) },
        }
    }
}

/// Which pairs of a block and a group of rows are out of the question: for each row, all bits of such a lane are set.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Refused(pub(crate) [Lanes; ROWS]);

impl Kernel {
    /// [`Kernel::run`] for the pairs of one block that are not refused; of the columns only the smallest key.
    #[inline]
    pub(crate) fn run_where(
        self,
        group: &RowGroup,
        block: &Block,
        refused: &Refused,
        rows: &mut [Best; ROWS],
        column: &mut Lanes,
    ) {
        match self {
            Kernel::Portable => portable_where(group, block, refused, rows, column),
            // SAFETY: by the invariant of `Kernel`, the variant exists only if the processor has AVX2.
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code)]
            Kernel::Avx2 => unsafe { x86::avx2_where(group, block, refused, rows, column) },
            // SAFETY: likewise for AVX-512F and VPOPCNTDQ.
            #[cfg(target_arch = "x86_64")]
            #[allow(unsafe_code)]
            Kernel::Avx512 => unsafe { x86::avx512_where(group, block, refused, rows, column) },
        }
    }
}

/// Keeps the two smallest keys of a lane.
#[inline(always)]
fn keep(best: &mut Best, lane: usize, key: u32) {
    let smallest = best[0].0[lane];
    best[1].0[lane] = best[1].0[lane].min(smallest.max(key));
    best[0].0[lane] = smallest.min(key);
}

fn portable(group: &RowGroup, blocks: &[Block], rows: &mut [Best; ROWS], columns: &mut [Best]) {
    for (block, column) in blocks.iter().zip(columns) {
        for (row, best) in rows.iter_mut().enumerate() {
            for (lane, distance) in portable_distances(&group.words[row], block).into_iter().enumerate() {
                let key = distance << INDEX_BITS;
                // A missing row or lane has a tag of ones, which makes its key the worst one.
                keep(best, lane, key | block.tags.0[lane]);
                keep(column, lane, key | group.tags[row]);
            }
        }
    }
}

#[inline(always)]
fn portable_distances(row: &[u32; 16], block: &Block) -> [u32; LANES] {
    let mut distances = [0; LANES];
    for (word, lanes) in row.iter().zip(&block.words) {
        for (distance, lane) in distances.iter_mut().zip(&lanes.0) {
            *distance += (word ^ lane).count_ones();
        }
    }
    distances
}

fn portable_where(group: &RowGroup, block: &Block, refused: &Refused, rows: &mut [Best; ROWS], column: &mut Lanes) {
    for (row, best) in rows.iter_mut().enumerate() {
        for (lane, distance) in portable_distances(&group.words[row], block).into_iter().enumerate() {
            let key = (distance << INDEX_BITS) | refused.0[row].0[lane];
            keep(best, lane, key | block.tags.0[lane]);
            column.0[lane] = column.0[lane].min(key | group.tags[row]);
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code)]
mod x86 {
    //! Loads and stores go through references to `Lanes` (64 bytes, aligned to 64) and are therefore in bounds and
    //! aligned; everything else is arithmetic on registers.

    use super::super::nearest::{Best, Block, INDEX_BITS, Lanes, ROWS, RowGroup};
    use super::Refused;
    use core::arch::x86_64::*;

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn load512(lanes: &Lanes) -> __m512i {
        // SAFETY: `Lanes` is 64 bytes aligned to 64.
        unsafe { _mm512_load_si512((&raw const lanes.0).cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx512f")]
    fn store512(lanes: &mut Lanes, value: __m512i) {
        // SAFETY: `Lanes` is 64 bytes aligned to 64.
        unsafe { _mm512_store_si512((&raw mut lanes.0).cast(), value) }
    }

    /// The distances of a block's lanes to each row.
    #[inline]
    #[target_feature(enable = "avx512f,avx512vpopcntdq")]
    #[allow(clippy::needless_range_loop)] // As below.
    fn distances512(group: &RowGroup, block: &Block) -> [__m512i; ROWS] {
        let mut distances = [_mm512_setzero_si512(); ROWS];
        for word in 0..16 {
            let lanes = load512(&block.words[word]);
            for row in 0..ROWS {
                let bits = _mm512_xor_si512(lanes, _mm512_set1_epi32(group.words[row][word] as i32));
                distances[row] = _mm512_add_epi32(distances[row], _mm512_popcnt_epi32(bits));
            }
        }
        distances
    }

    #[target_feature(enable = "avx512f,avx512vpopcntdq")]
    #[allow(clippy::needless_range_loop)] // As below.
    pub(super) fn avx512_where(
        group: &RowGroup,
        block: &Block,
        refused: &Refused,
        rows: &mut [Best; ROWS],
        column: &mut Lanes,
    ) {
        let distances = distances512(group, block);
        let tags = load512(&block.tags);
        let mut column_first = load512(column);
        for row in 0..ROWS {
            let key = _mm512_or_si512(_mm512_slli_epi32::<INDEX_BITS>(distances[row]), load512(&refused.0[row]));
            let row_key = _mm512_or_si512(key, tags);
            let (first, second) = (load512(&rows[row][0]), load512(&rows[row][1]));
            store512(&mut rows[row][1], _mm512_min_epu32(second, _mm512_max_epu32(first, row_key)));
            store512(&mut rows[row][0], _mm512_min_epu32(first, row_key));
            let column_key = _mm512_or_si512(key, _mm512_set1_epi32(group.tags[row] as i32));
            column_first = _mm512_min_epu32(column_first, column_key);
        }
        store512(column, column_first);
    }

    #[target_feature(enable = "avx512f,avx512vpopcntdq")]
    #[allow(clippy::needless_range_loop)] // Several arrays run in step, unrolled into registers.
    pub(super) fn avx512(group: &RowGroup, blocks: &[Block], rows: &mut [Best; ROWS], columns: &mut [Best]) {
        let mut first: [__m512i; ROWS] = [load512(&rows[0][0]); ROWS];
        let mut second = first;
        for row in 0..ROWS {
            first[row] = load512(&rows[row][0]);
            second[row] = load512(&rows[row][1]);
        }
        for (block, column) in blocks.iter().zip(columns) {
            let distances = distances512(group, block);
            let tags = load512(&block.tags);
            let mut column_first = load512(&column[0]);
            let mut column_second = load512(&column[1]);
            for row in 0..ROWS {
                let key = _mm512_slli_epi32::<INDEX_BITS>(distances[row]);
                let row_key = _mm512_or_si512(key, tags);
                second[row] = _mm512_min_epu32(second[row], _mm512_max_epu32(first[row], row_key));
                first[row] = _mm512_min_epu32(first[row], row_key);
                let column_key = _mm512_or_si512(key, _mm512_set1_epi32(group.tags[row] as i32));
                column_second = _mm512_min_epu32(column_second, _mm512_max_epu32(column_first, column_key));
                column_first = _mm512_min_epu32(column_first, column_key);
            }
            store512(&mut column[0], column_first);
            store512(&mut column[1], column_second);
        }
        for row in 0..ROWS {
            store512(&mut rows[row][0], first[row]);
            store512(&mut rows[row][1], second[row]);
        }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn load256(lanes: &Lanes, half: usize) -> __m256i {
        // SAFETY: the indexing checks that eight `u32` follow; `Lanes` is aligned to 64, so its halves are to 32.
        unsafe { _mm256_load_si256(lanes.0[half * 8..half * 8 + 8].as_ptr().cast()) }
    }

    #[inline]
    #[target_feature(enable = "avx2")]
    fn store256(lanes: &mut Lanes, half: usize, value: __m256i) {
        // SAFETY: as in `load256`.
        unsafe { _mm256_store_si256(lanes.0[half * 8..half * 8 + 8].as_mut_ptr().cast(), value) }
    }

    /// Bits set in each byte.
    #[inline]
    #[target_feature(enable = "avx2")]
    fn bits_of_bytes(value: __m256i) -> __m256i {
        let counts = _mm256_setr_epi8(
            0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4, 0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4,
        );
        let nibble = _mm256_set1_epi8(15);
        let low = _mm256_and_si256(value, nibble);
        let high = _mm256_and_si256(_mm256_srli_epi16::<4>(value), nibble);
        _mm256_add_epi8(_mm256_shuffle_epi8(counts, low), _mm256_shuffle_epi8(counts, high))
    }

    /// The distances of half of a block's lanes to each row.
    #[inline]
    #[target_feature(enable = "avx2")]
    #[allow(clippy::needless_range_loop)] // As above.
    fn distances256(group: &RowGroup, block: &Block, half: usize) -> [__m256i; ROWS] {
        let mut counts = [_mm256_setzero_si256(); ROWS];
        for word in 0..16 {
            let lanes = load256(&block.words[word], half);
            for row in 0..ROWS {
                let bits = _mm256_xor_si256(lanes, _mm256_set1_epi32(group.words[row][word] as i32));
                // A byte counts at most 16 x 8 = 128 bits: no overflow of the unsigned byte.
                counts[row] = _mm256_add_epi8(counts[row], bits_of_bytes(bits));
            }
        }
        let (one_byte, one_word) = (_mm256_set1_epi8(1), _mm256_set1_epi16(1));
        counts.map(|counts| _mm256_madd_epi16(_mm256_maddubs_epi16(counts, one_byte), one_word))
    }

    #[target_feature(enable = "avx2")]
    #[allow(clippy::needless_range_loop)] // As above.
    pub(super) fn avx2_where(
        group: &RowGroup,
        block: &Block,
        refused: &Refused,
        rows: &mut [Best; ROWS],
        column: &mut Lanes,
    ) {
        for half in 0..2 {
            let distances = distances256(group, block, half);
            let tags = load256(&block.tags, half);
            let mut column_first = load256(column, half);
            for row in 0..ROWS {
                let distance = _mm256_slli_epi32::<{ INDEX_BITS as i32 }>(distances[row]);
                let key = _mm256_or_si256(distance, load256(&refused.0[row], half));
                let row_key = _mm256_or_si256(key, tags);
                let first = load256(&rows[row][0], half);
                let second = load256(&rows[row][1], half);
                store256(&mut rows[row][1], half, _mm256_min_epu32(second, _mm256_max_epu32(first, row_key)));
                store256(&mut rows[row][0], half, _mm256_min_epu32(first, row_key));
                let column_key = _mm256_or_si256(key, _mm256_set1_epi32(group.tags[row] as i32));
                column_first = _mm256_min_epu32(column_first, column_key);
            }
            store256(column, half, column_first);
        }
    }

    #[target_feature(enable = "avx2")]
    #[allow(clippy::needless_range_loop)] // As above.
    pub(super) fn avx2(group: &RowGroup, blocks: &[Block], rows: &mut [Best; ROWS], columns: &mut [Best]) {
        for (block, column) in blocks.iter().zip(columns) {
            for half in 0..2 {
                let tags = load256(&block.tags, half);
                let mut column_first = load256(&column[0], half);
                let mut column_second = load256(&column[1], half);
                let distances = distances256(group, block, half);
                for row in 0..ROWS {
                    let key = _mm256_slli_epi32::<{ INDEX_BITS as i32 }>(distances[row]);
                    let row_key = _mm256_or_si256(key, tags);
                    let first = load256(&rows[row][0], half);
                    let second = load256(&rows[row][1], half);
                    store256(&mut rows[row][1], half, _mm256_min_epu32(second, _mm256_max_epu32(first, row_key)));
                    store256(&mut rows[row][0], half, _mm256_min_epu32(first, row_key));
                    let column_key = _mm256_or_si256(key, _mm256_set1_epi32(group.tags[row] as i32));
                    column_second = _mm256_min_epu32(column_second, _mm256_max_epu32(column_first, column_key));
                    column_first = _mm256_min_epu32(column_first, column_key);
                }
                store256(&mut column[0], half, column_first);
                store256(&mut column[1], half, column_second);
            }
        }
    }
}
