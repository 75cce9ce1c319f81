//! The masked distance matrix, sixteen entries at once.
//!
//! Keypoints of image A are sorted as those of image B are, and neighbours share their candidates: four rows and a run
//! of blocks go to the kernel of the exhaustive search, with a mask of the pairs that the prediction refuses. The mask
//! is computed in single precision; where that cannot decide (a pair within rounding of a threshold), in double
//! precision.

use super::chart::{Chart, ChartedLine, Extent, Interval};
use super::strips::{Located, Reach, Site, SortKeys, Strips};
use super::{NO_KEY, PredictedPoints};
use crate::FeaturesError;
use crate::filter::{DescribedPoints, Gate};
use crate::matching::kernel::{Kernel, Refused};
use crate::matching::nearest::{self, Best, INDEX_BITS, LANES, Lanes, NO_BEST, ROWS, RowGroup, two_smallest, words};

use multiversion::multiversion;
use nalgebra::{Point2, Vector3};
use rayon::prelude::*;
use std::f64::consts::FRAC_PI_2;

/// Rows in the smallest band, and bands at most: each keeps the best of all columns.
const BAND_ROWS: usize = 512;
const MAX_BANDS: usize = 32;
/// Rows of which the descriptors are fetched together; a multiple of [`ROWS`].
const FETCHED: usize = 32;

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
        let line = chart.charted(&lines[index], reach.half_width_px);
        let everywhere = [f64::NEG_INFINITY, f64::INFINITY];
        let (across, disc) = expected.map_or((everywhere, Interval::ALL), |point| chart.of_disc(&point, radius_px));
        Row { index, expected, line, across, disc }
    };
    let rows: Vec<Row> = (0..a.positions.len()).into_par_iter().with_min_len(1024).map(row).collect();
    let order = sorted(&rows, gate.is_some(), &strips, &extents[1]);

    let extent_px = extents.iter().map(|extent| extent.radius).fold(0.0, f64::max);
    let search = Search {
        a,
        b,
        gate,
        lines: &lines,
        rows: &rows,
        strips: &strips,
        kernel,
        thresholds: Thresholds { half_width_px: reach.half_width_px, radius_px },
        middles,
        extent_px,
    };
    let band_rows = BAND_ROWS.max(order.len().div_ceil(MAX_BANDS)).next_multiple_of(ROWS);
    let bands: Vec<(Vec<[u64; 2]>, Vec<Lanes>)> =
        order.par_chunks(band_rows).map(|order| search_band(&search, order)).collect();
    for ((best, _), order) in bands.iter().zip(order.chunks(band_rows)) {
        for (best, &key) in best.iter().zip(order) {
            of_a[SortKeys::index(key)] = *best;
        }
    }
    for (block, tags) in strips.blocks.iter().map(|located| &located.block.tags).enumerate() {
        for (lane, &tag) in tags.0.iter().enumerate().filter(|(_, tag)| **tag != nearest::NO_KEY) {
            let least = bands.iter().map(|(_, columns)| columns[block].0[lane]).min();
            of_b[tag as usize] = long_key(least.unwrap_or(nearest::NO_KEY));
        }
    }
    Ok((of_a, of_b))
}

/// The rows that admit anything, neighbours one after the other: by their predicted points as those of B are sorted, or
/// by their lines. The result does not depend on the order.
fn sorted(rows: &[Row], by_lines: bool, strips: &Strips, extent: &Extent) -> Vec<u64> {
    let (low, high) = match strips.chart {
        Chart::Polar { .. } => (-FRAC_PI_2, FRAC_PI_2),
        Chart::Straight { .. } => (-extent.radius, extent.radius),
    };
    let sort = SortKeys::between(low, high);
    // After all strips.
    let unpredicted = (1 << 9) - 1;
    let key = |row: &Row| match (row.expected, row.line) {
        (Some(point), _) => {
            let [u, v] = strips.chart.place(&point);
            Some(sort.key(strips.strip(u), v, row.index))
        }
        (None, _) if !by_lines => None,
        (None, ChartedLine::Polar { direction: v } | ChartedLine::Straight { start: v, .. }) => {
            Some(sort.key(unpredicted, v, row.index))
        }
        (None, ChartedLine::Everywhere) => Some(sort.key(unpredicted, low, row.index)),
    };
    let mut order: Vec<u64> = rows.iter().filter_map(key).collect();
    order.sort_unstable();
    order
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
}

#[derive(Debug, Clone, Copy)]
struct Thresholds {
    half_width_px: f64,
    radius_px: f64,
}

/// What all bands share.
struct Search<'a> {
    a: DescribedPoints<'a>,
    b: DescribedPoints<'a>,
    gate: Option<&'a Gate>,
    rows: &'a [Row],
    lines: &'a [Vector3<f64>],
    strips: &'a Strips,
    kernel: Kernel,
    thresholds: Thresholds,
    middles: [Point2<f64>; 2],
    /// Half of the larger diagonal of what the keypoints span, px.
    extent_px: f64,
}

/// The mask's test of one row in single precision, positions from the middles of the images.
#[derive(Debug, Clone, Copy)]
struct CoarseRow {
    line: [f32; 3],
    in_a: [f32; 2],
    half_width: f32,
    near: [f32; 2],
    /// With the distance `d` from the predicted point, `d^2 * per_px - radius` is how far beyond the radius it is, near
    /// it; negative throughout if there is no such point.
    per_px: f32,
    radius: f32,
    /// What single precision can be wrong by, px.
    rounding: f32,
}

impl CoarseRow {
    /// Of a row that is missing: refuses everything.
    const NONE: CoarseRow = CoarseRow {
        line: [0.0; 3],
        in_a: [0.0; 2],
        half_width: -1e30,
        near: [0.0; 2],
        per_px: 0.0,
        radius: 1e30,
        rounding: 0.0,
    };
}

impl Search<'_> {
    fn coarse(&self, row: &Row) -> CoarseRow {
        let line = self.lines[row.index];
        let [middle_a, middle_b] = self.middles;
        let in_a = self.a.positions[row.index] - middle_a;
        let near = row.expected.map_or([0.0; 2], |point| (point - middle_b).map(|value| value as f32).into());
        // Half of the square over the radius grows as fast as the distance does at the radius, or faster beyond.
        let (per_px, radius) = match row.expected {
            Some(_) => (0.5 / self.thresholds.radius_px, 0.5 * self.thresholds.radius_px),
            None => (0.0, 1e30),
        };
        // Sums of a few products of such numbers, each right to 2^-24 of itself; past numbers of which the squares
        // might overflow, nothing is sure.
        let reach = self.extent_px
            + self.gate.map_or(0.0, Gate::half_width_px)
            + row.expected.map_or(0.0, |point| self.thresholds.radius_px + (point - middle_b).norm());
        let rounding = if reach < 1e15 { reach * 2f64.powi(-20) + 1e-6 } else { f64::INFINITY };
        CoarseRow {
            rounding: rounding as f32,
            line: [line.x as f32, line.y as f32, (line.x * middle_b.x + line.y * middle_b.y + line.z) as f32],
            in_a: [in_a.x as f32, in_a.y as f32],
            half_width: self.thresholds.half_width_px.min(1e30) as f32,
            near,
            per_px: per_px as f32,
            radius: radius as f32,
        }
    }

    /// Whether the pair is admitted.
    fn admits(&self, row: &Row, in_b: &Point2<f64>) -> bool {
        let Thresholds { radius_px, .. } = self.thresholds;
        let in_a = &self.a.positions[row.index];
        self.gate
            .is_none_or(|gate| gate.admits(&self.lines[row.index], in_b) && gate.admits(&gate.line_in_a(in_b), in_a))
            && row.expected.is_none_or(|point| (in_b - point).norm_squared() <= radius_px * radius_px)
    }
}

/// The two best of each row of a band, and the best in it of every column.
// With wider vectors the mask takes a fraction of the time; what single precision cannot decide is left to double
// precision.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn search_band(search: &Search<'_>, order: &[u64]) -> (Vec<[u64; 2]>, Vec<Lanes>) {
    let strips = search.strips;
    let mut columns = vec![Lanes([nearest::NO_KEY; LANES]); strips.blocks.len()];
    let mut best = Vec::with_capacity(order.len());
    let mut refused = Refused([Lanes([0; LANES]); ROWS]);
    // Fetched some groups ahead, all at once: the keypoints lie scattered, and so their memory is waited for together.
    let mut fetched = [[0u32; 16]; FETCHED];
    for (number, keys) in order.chunks(ROWS).enumerate() {
        let first = number * ROWS % FETCHED;
        if first == 0 {
            for (words_of_row, &key) in fetched.iter_mut().zip(&order[number * ROWS..]) {
                *words_of_row = words(&search.a.descriptors[SortKeys::index(key)]);
            }
        }
        let mut rows: [Option<&Row>; ROWS] = [None; ROWS];
        let mut group = RowGroup { words: [[0; 16]; ROWS], tags: [nearest::NO_KEY; ROWS] };
        let mut coarse = [CoarseRow::NONE; ROWS];
        let mut across = [f64::INFINITY, f64::NEG_INFINITY];
        for (at, &key) in keys.iter().enumerate() {
            let row = &search.rows[SortKeys::index(key)];
            rows[at] = Some(row);
            group.words[at] = fetched[first + at];
            group.tags[at] = row.index as u32;
            coarse[at] = search.coarse(row);
            across = [across[0].min(row.across[0]), across[1].max(row.across[1])];
        }
        let any_disc = rows.iter().flatten().any(|row| row.expected.is_some());
        let mut lanes: [Best; ROWS] = [NO_BEST; ROWS];
        let wanted = |us: [f64; 2], half_at: f64| {
            let of_row = |row: &&Row| [strips.chart.of_band(&row.line, us, half_at), row.disc];
            strips.chart.union(rows.iter().flatten().map(of_row))
        };
        strips.for_each_run(across, wanted, |run| {
            for (located, column) in strips.blocks[run.clone()].iter().zip(&mut columns[run]) {
                let [any_left, any_unsure] = if any_disc {
                    mask::<true>(&coarse, &located.site, &mut refused)
                } else {
                    mask::<false>(&coarse, &located.site, &mut refused)
                };
                if any_unsure {
                    decide(search, &rows, located, &coarse, &mut refused);
                }
                if any_left {
                    search.kernel.run_where(&group, &located.block, &refused, &mut lanes, column);
                }
            }
        });
        best.extend(lanes[..keys.len()].iter().map(|keys| two_smallest(keys).map(long_key)));
    }
    (best, columns)
}

/// Marks the pairs of a block and a group that are not admitted, but for those which single precision cannot decide;
/// whether any is left, and whether there are of the latter.
#[inline(always)]
fn mask<const DISC: bool>(coarse: &[CoarseRow; ROWS], site: &Site, refused: &mut Refused) -> [bool; 2] {
    let (mut left, mut unsure) = ([0u32; LANES], [0u32; LANES]);
    for (row, refused) in coarse.iter().zip(&mut refused.0) {
        for lane in 0..LANES {
            let beyond = beyond::<DISC>(row, site, lane);
            let out = if beyond > row.rounding { u32::MAX } else { 0 };
            refused.0[lane] = out;
            left[lane] |= !out;
            // True also for what is not a number.
            unsure[lane] |= if beyond.abs() > row.rounding { 0 } else { 1 };
        }
    }
    [left, unsure].map(|bits| bits.into_iter().fold(0, |any, lane| any | lane) != 0)
}

/// How far, in px, a pair is beyond the nearest threshold; negative within.
#[inline(always)]
fn beyond<const DISC: bool>(row: &CoarseRow, site: &Site, lane: usize) -> f32 {
    let (x, y) = (site.x.0[lane], site.y.0[lane]);
    let in_b = row.line[0] * x + row.line[1] * y + row.line[2];
    let in_a = site.line_x.0[lane] * row.in_a[0] + site.line_y.0[lane] * row.in_a[1] + site.line_offset.0[lane];
    let larger = |a: f32, b: f32| if a > b { a } else { b };
    let off = larger(in_b.abs(), in_a.abs()) - row.half_width;
    if !DISC {
        return off;
    }
    let (dx, dy) = (x - row.near[0], y - row.near[1]);
    larger((dx * dx + dy * dy) * row.per_px - row.radius, off)
}

/// Decides in double precision what single precision leaves unsure.
#[cold]
fn decide(
    search: &Search<'_>,
    rows: &[Option<&Row>; ROWS],
    located: &Located,
    coarse: &[CoarseRow; ROWS],
    refused: &mut Refused,
) {
    for (number, row) in rows.iter().enumerate() {
        let Some(row) = row else { continue };
        for (lane, &tag) in located.block.tags.0.iter().enumerate().filter(|(_, tag)| **tag != nearest::NO_KEY) {
            let surely = beyond::<true>(&coarse[number], &located.site, lane).abs() > coarse[number].rounding;
            if !surely && !search.admits(row, &search.b.positions[tag as usize]) {
                refused.0[number].0[lane] = u32::MAX;
            }
        }
    }
}
