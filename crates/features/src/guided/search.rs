//! The masked distance matrix, sixteen entries at once.
//!
//! Keypoints of image A are sorted as those of image B are, and neighbours share their candidates: four rows and a run of
//! blocks go to the kernel of the exhaustive search, with a mask of the pairs that the prediction refuses. The mask is
//! computed in single precision; where that cannot tell (a pair within rounding of a threshold), in double precision.

use super::chart::{Chart, ChartedLine, Extent, Interval};
use super::strips::{Reach, Site, Stored, Strips};
use super::{NO_KEY, PredictedPoints};
use crate::FeaturesError;
use crate::filter::{DescribedPoints, Gate};
use crate::matching::kernel::{Kernel, Refused};
use crate::matching::nearest::{self, Best, INDEX_BITS, LANES, Lanes, NO_BEST, ROWS, RowGroup, two_smallest, words};

use multiversion::multiversion;
use nalgebra::{Point2, Vector3};
use rayon::prelude::*;

/// Rows in the smallest band, and bands at most: each keeps the best of all columns.
const BAND_ROWS: usize = 512;
const MAX_BANDS: usize = 32;
/// Blocks that are masked together.
const MASKED: usize = 16;

/// Two best keys of each keypoint of A (`distance << 32 | b`), and the best of each of B (`distance << 32 | a`).
pub(super) type NearestAdmitted = (Vec<[u64; 2]>, Vec<u64>);

/// Nearest, second nearest and nearest of the other side among the admitted pairs.
pub(super) fn nearest_admitted(
    a: DescribedPoints<'_>,
    b: DescribedPoints<'_>,
    gate: Option<&Gate>,
    points: Option<PredictedPoints<'_>>,
    kernel: Kernel,
) -> Result<NearestAdmitted, FeaturesError> {
    let mut of_a = vec![[NO_KEY; 2]; a.positions.len()];
    let mut of_b = vec![NO_KEY; b.positions.len()];
    let most = a.positions.len().max(b.positions.len());
    if most >= 1 << INDEX_BITS {
        return Err(FeaturesError::TooManyKeypoints { got: most, max: (1 << INDEX_BITS) - 1 });
    }
    if a.positions.is_empty() || b.positions.is_empty() {
        return Ok((of_a, of_b));
    }
    let extents = [Extent::of(a.positions)?, Extent::of(b.positions)?];
    let lines: Vec<Vector3<f64>> = match gate {
        Some(gate) => a.positions.par_iter().with_min_len(1024).map(|in_a| gate.line_in_b(in_a)).collect(),
        None => vec![Vector3::zeros(); a.positions.len()],
    };
    let chart = if gate.is_some() { Chart::of_lines(&lines, &extents[1]) } else { Chart::of_points(&extents[1]) };
    let known = points.map_or(0, |points| points.in_b.iter().flatten().count());
    let reach = Reach {
        half_width_px: gate.map_or(f64::INFINITY, Gate::half_width_px),
        radius_px: points.filter(|_| 2 * known > a.positions.len()).map(|points| points.radius_px),
    };
    let middles = extents.map(|extent| extent.middle);
    let line_in_a = |in_b: &Point2<f64>| gate.map_or(Vector3::zeros(), |gate| gate.line_in_a(in_b));
    let strips = Strips::new(chart, b.positions, b.descriptors, reach, middles, line_in_a);

    let radius_px = points.map_or(f64::INFINITY, |points| points.radius_px);
    let row = |index: usize| {
        let expected = points.and_then(|points| points.in_b[index]);
        if gate.is_none() && expected.is_none() {
            return None;
        }
        let line = chart.charted(&lines[index], reach.half_width_px);
        let everywhere = [f64::NEG_INFINITY, f64::INFINITY];
        let (across, disc) = expected.map_or((everywhere, Interval::ALL), |point| chart.of_disc(&point, radius_px));
        // Neighbours in the order of the strips; those without a predicted point, by their lines, after them.
        let sorted_by = match (expected, line) {
            (Some(point), _) => {
                let [u, v] = chart.place(&point);
                (strips.strip(u), v)
            }
            (None, ChartedLine::Polar { direction, .. }) => (usize::MAX, direction),
            (None, ChartedLine::Straight { start, .. }) => (usize::MAX, start),
            (None, ChartedLine::Everywhere) => (usize::MAX, f64::NEG_INFINITY),
        };
        Some(Row { index, expected, line, across, disc, sorted_by })
    };
    let mut rows: Vec<Row> = (0..a.positions.len()).into_par_iter().with_min_len(1024).filter_map(row).collect();
    let key = |row: &Row| (row.sorted_by.0, row.sorted_by.1, row.index);
    rows.sort_unstable_by(|x, y| {
        let (x, y) = (key(x), key(y));
        x.0.cmp(&y.0).then(x.1.total_cmp(&y.1)).then(x.2.cmp(&y.2))
    });

    let radius = extents.iter().map(|extent| extent.radius).fold(0.0, f64::max);
    let search = Search {
        a,
        lines: &lines,
        strips: &strips,
        kernel,
        thresholds: Thresholds { half_width_px: reach.half_width_px, radius_px },
        middles,
        // Offsets up to twice the radius: three products and sums of them, each right to 2^-24 of itself.
        rounding_px: radius * 2f64.powi(-19) + 1e-6,
    };
    let band_rows = BAND_ROWS.max(rows.len().div_ceil(MAX_BANDS)).next_multiple_of(ROWS);
    let bands: Vec<(Vec<[u64; 2]>, Vec<Lanes>)> =
        rows.par_chunks(band_rows).map(|rows| search_band(&search, rows)).collect();
    for ((best, _), rows) in bands.iter().zip(rows.chunks(band_rows)) {
        for (best, row) in best.iter().zip(rows) {
            of_a[row.index] = *best;
        }
    }
    for (block, tags) in strips.blocks.iter().map(|block| &block.tags).enumerate() {
        for (lane, &tag) in tags.0.iter().enumerate().filter(|(_, tag)| **tag != nearest::NO_KEY) {
            let least = bands.iter().map(|(_, columns)| columns[block].0[lane]).min();
            of_b[tag as usize] = long_key(least.unwrap_or(nearest::NO_KEY));
        }
    }
    Ok((of_a, of_b))
}

/// `distance << 22 | index` as `distance << 32 | index`.
fn long_key(key: u32) -> u64 {
    if key == nearest::NO_KEY {
        return NO_KEY;
    }
    u64::from(key >> INDEX_BITS) << 32 | u64::from(key & ((1 << INDEX_BITS) - 1))
}

/// A keypoint of image A and where its match may be.
#[derive(Debug, Clone, Copy)]
struct Row {
    index: usize,
    expected: Option<Point2<f64>>,
    line: ChartedLine,
    across: [f64; 2],
    disc: Interval,
    sorted_by: (usize, f64),
}

#[derive(Debug, Clone, Copy)]
struct Thresholds {
    half_width_px: f64,
    radius_px: f64,
}

/// What all bands share.
struct Search<'a> {
    a: DescribedPoints<'a>,
    lines: &'a [Vector3<f64>],
    strips: &'a Strips,
    kernel: Kernel,
    thresholds: Thresholds,
    middles: [Point2<f64>; 2],
    /// What single precision can be wrong by in a distance, px.
    rounding_px: f64,
}

/// The mask's test of one row in single precision, positions from the middles of the images.
#[derive(Debug, Clone, Copy)]
struct CoarseRow {
    line: [f32; 3],
    in_a: [f32; 2],
    near: [f32; 2],
    /// Surely within up to the first, surely not beyond the second; squares.
    radius: [f32; 2],
}

impl CoarseRow {
    /// Of a row that is missing: refuses everything.
    const NONE: CoarseRow = CoarseRow { line: [0.0; 3], in_a: [0.0; 2], near: [0.0; 2], radius: [-1.0; 2] };
}

impl Search<'_> {
    fn coarse(&self, row: &Row) -> CoarseRow {
        let line = self.lines[row.index];
        let [middle_a, middle_b] = self.middles;
        let in_a = self.a.positions[row.index] - middle_a;
        let near = row.expected.map_or([0.0; 2], |point| (point - middle_b).map(|value| value as f32).into());
        let radius = self.thresholds.radius_px;
        let radius = match row.expected {
            Some(_) => [(radius - self.rounding_px).max(0.0), radius + self.rounding_px],
            None => [f64::INFINITY; 2],
        };
        CoarseRow {
            line: [line.x as f32, line.y as f32, (line.x * middle_b.x + line.y * middle_b.y + line.z) as f32],
            in_a: [in_a.x as f32, in_a.y as f32],
            near,
            radius: [(radius[0] * radius[0] * (1.0 - 1e-5)) as f32, (radius[1] * radius[1] * (1.0 + 1e-5)) as f32],
        }
    }

    /// Whether the pair is admitted.
    fn admits(&self, row: &Row, other: &Stored) -> bool {
        let off = |line: &Vector3<f64>, point: &Point2<f64>| (line.x * point.x + line.y * point.y + line.z).abs();
        let Thresholds { half_width_px, radius_px } = self.thresholds;
        off(&self.lines[row.index], &other.at) <= half_width_px
            && off(&other.line, &self.a.positions[row.index]) <= half_width_px
            && row.expected.is_none_or(|point| (other.at - point).norm_squared() <= radius_px * radius_px)
    }
}

/// The two best of each row of a band, and the best in it of every column.
// With wider vectors the mask takes a fraction of the time; what single precision cannot tell is never decided by it.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn search_band(search: &Search<'_>, rows: &[Row]) -> (Vec<[u64; 2]>, Vec<Lanes>) {
    let strips = search.strips;
    let mut columns = vec![Lanes([nearest::NO_KEY; LANES]); strips.blocks.len()];
    let mut best = Vec::with_capacity(rows.len());
    let mut refused = [Refused([Lanes([0; LANES]); ROWS]); MASKED];
    let mut any_left = [false; MASKED];
    for rows in rows.chunks(ROWS) {
        let mut group = RowGroup { words: [[0; 16]; ROWS], tags: [nearest::NO_KEY; ROWS] };
        let mut coarse = [CoarseRow::NONE; ROWS];
        let mut across = [f64::INFINITY, f64::NEG_INFINITY];
        for (at, row) in rows.iter().enumerate() {
            group.words[at] = words(&search.a.descriptors[row.index]);
            group.tags[at] = row.index as u32;
            coarse[at] = search.coarse(row);
            across = [across[0].min(row.across[0]), across[1].max(row.across[1])];
        }
        let mut lanes: [Best; ROWS] = [NO_BEST; ROWS];
        let wanted = |from: f64, to: f64| {
            let of_row = |row: &Row| [strips.chart.of_band(&row.line, from, to), row.disc];
            strips.chart.union(rows.iter().map(of_row))
        };
        strips.for_each_run(across, wanted, |run| {
            for first in run.clone().step_by(MASKED) {
                let part = first..run.end.min(first + MASKED);
                for (at, block) in part.clone().enumerate() {
                    any_left[at] = mask(search, rows, &coarse, block, &mut refused[at]);
                }
                search.kernel.run_where(
                    &group,
                    &strips.blocks[part.clone()],
                    &refused[..part.len()],
                    &any_left[..part.len()],
                    &mut lanes,
                    &mut columns[part],
                );
            }
        });
        best.extend(lanes[..rows.len()].iter().map(|keys| two_smallest(keys).map(long_key)));
    }
    (best, columns)
}

/// Marks the pairs of a block and a group that are not admitted; whether any is left.
#[inline(always)]
fn mask(search: &Search<'_>, rows: &[Row], coarse: &[CoarseRow; ROWS], block: usize, refused: &mut Refused) -> bool {
    let site: &Site = &search.strips.sites[block];
    let half = [
        (search.thresholds.half_width_px - search.rounding_px) as f32,
        (search.thresholds.half_width_px + search.rounding_px) as f32,
    ];
    let mut any_left = 0u32;
    for (number, (row, refused)) in coarse.iter().zip(&mut refused.0).enumerate() {
        let mut unsure = [0u32; LANES];
        for lane in 0..LANES {
            let (x, y) = (site.x.0[lane], site.y.0[lane]);
            let in_b = (row.line[0] * x + row.line[1] * y + row.line[2]).abs();
            let in_a = site.line_x.0[lane] * row.in_a[0] + site.line_y.0[lane] * row.in_a[1];
            let off = in_b.max((in_a + site.line_offset.0[lane]).abs());
            let (dx, dy) = (x - row.near[0], y - row.near[1]);
            let apart = dx * dx + dy * dy;
            // Comparisons with what is not a number are false, which leaves the pair unsure.
            let out = (off > half[1]) | (apart > row.radius[1]);
            let within = (off <= half[0]) & (apart <= row.radius[0]);
            refused.0[lane] = if out { u32::MAX } else { 0 };
            unsure[lane] = if out | within { 0 } else { 1 };
        }
        any_left |= refused.0.iter().fold(0, |left, lane| left | !lane);
        if unsure.iter().fold(0, |any, lane| any | lane) != 0 {
            decide(search, rows.get(number), block, &unsure, refused);
        }
    }
    any_left != 0
}

/// Decides in double precision what single precision leaves unsure.
#[cold]
fn decide(search: &Search<'_>, row: Option<&Row>, block: usize, unsure: &[u32; LANES], refused: &mut Lanes) {
    let Some(row) = row else { return };
    let tags = &search.strips.blocks[block].tags.0;
    for lane in (0..LANES).filter(|&lane| unsure[lane] != 0 && tags[lane] != nearest::NO_KEY) {
        if !search.admits(row, &search.strips.stored[block][lane]) {
            refused.0[lane] = u32::MAX;
        }
    }
}
