//! The keypoints of image B in blocks, so that those near a line or a point are few runs of blocks.
//!
//! Image B is cut into strips by the first coordinate of a [`Chart`]; in a strip the keypoints are sorted by the
//! second, sixteen to a block. Strips are chosen such that a run holds little besides what is looked for and is still
//! longer than its two ragged ends.

use super::chart::{Chart, Interval};
use crate::Descriptor;
use crate::matching::nearest::{Block, INDEX_BITS, LANES, Lanes, NO_KEY, words};
use nalgebra::{Point2, Vector3};
use rayon::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};
use std::ops::Range;

/// Strips at most.
const MAX_STRIPS: usize = 64;

/// One single-precision number a lane.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
pub(super) struct Floats(pub(super) [f32; LANES]);

/// Where the keypoints of a block are, from the middle of image B, and their lines in image A, whose offsets count from
/// the middle of image A.
#[derive(Debug, Clone, Copy)]
pub(super) struct Site {
    pub(super) x: Floats,
    pub(super) y: Floats,
    pub(super) line_x: Floats,
    pub(super) line_y: Floats,
    pub(super) line_offset: Floats,
}

/// A block and where its keypoints are.
#[derive(Debug, Clone)]
pub(super) struct Located {
    pub(super) block: Block,
    pub(super) site: Site,
}

/// A strip: its blocks and what it spans.
#[derive(Debug, Clone)]
struct Strip {
    blocks: Range<usize>,
    /// Least and greatest u of its keypoints.
    from: f64,
    to: f64,
    /// [`Chart::half_at`] of `from`.
    half: f64,
}

/// What is typically looked for, by which the strips are chosen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach {
    /// Half width of the band, px; infinite for none.
    pub(super) half_width_px: f64,
    /// Radius about predicted points, if most keypoints have one.
    pub(super) radius_px: Option<f64>,
}

/// The keypoints of image B, sorted.
#[derive(Debug, Clone)]
pub(super) struct Strips {
    pub(super) chart: Chart,
    strips: Vec<Strip>,
    /// Least and greatest v of each block.
    ends: Vec<[f64; 2]>,
    pub(super) blocks: Vec<Located>,
}

/// Sorts by strip and, as finely as it matters, by v; equals by index. Packed into one number, which sorts fast.
#[derive(Debug, Clone, Copy)]
pub(super) struct SortKeys {
    low: f64,
    steps_per_unit: f64,
}

impl SortKeys {
    const V_BITS: u32 = 32;

    /// For values of v between two bounds; what is beyond counts as the bound.
    pub(super) fn between(low: f64, high: f64) -> Self {
        let steps = (1u64 << Self::V_BITS) as f64 * (1.0 - 1e-9);
        SortKeys { low, steps_per_unit: if high > low { steps / (high - low) } else { 0.0 } }
    }

    pub(super) fn key(&self, strip: usize, v: f64, index: usize) -> u64 {
        // The cast saturates.
        let step = ((v - self.low) * self.steps_per_unit) as u32;
        (strip as u64) << (Self::V_BITS + INDEX_BITS) | u64::from(step) << INDEX_BITS | index as u64
    }

    pub(super) fn strip(key: u64) -> u64 {
        key >> (Self::V_BITS + INDEX_BITS)
    }

    pub(super) fn index(key: u64) -> usize {
        (key & ((1 << INDEX_BITS) - 1)) as usize
    }

    /// A bound of v for everything at or below (`up` 0) or at and above (`up` 1) the key's place in the order.
    fn v(&self, key: u64, up: f64) -> f64 {
        if self.steps_per_unit == 0.0 {
            return self.low;
        }
        // A step more in either direction covers the rounding.
        let step = (key >> INDEX_BITS) as u32;
        self.low + (f64::from(step) + 3.0 * up - 1.0) / self.steps_per_unit
    }
}

impl Strips {
    /// Sorts keypoints, of which there is at least one. `line` makes the line of a position in image A.
    pub(super) fn new(
        chart: Chart,
        positions: &[Point2<f64>],
        descriptors: &[Descriptor],
        reach: Reach,
        middles: [Point2<f64>; 2],
        line: impl Fn(&Point2<f64>) -> Vector3<f64> + Sync,
    ) -> Self {
        let places: Vec<[f64; 2]> =
            positions.par_iter().with_min_len(1024).map(|position| chart.place(position)).collect();
        let bounds = bounds(&chart, &places, reach);
        let vs = places.iter().map(|place| place[1]);
        let (low, high) = vs.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let sort = SortKeys::between(low, high);
        let key =
            |(index, &[u, v]): (usize, &[f64; 2])| sort.key(bounds.partition_point(|bound| *bound <= u), v, index);
        let mut order: Vec<u64> = places.iter().enumerate().map(key).collect();
        order.sort_unstable();

        let mut strips = Vec::new();
        let mut members: Vec<&[u64]> = Vec::new();
        for strip in order.chunk_by(|a, b| SortKeys::strip(*a) == SortKeys::strip(*b)) {
            let us = strip.iter().map(|&key| places[SortKeys::index(key)][0]);
            let (from, to) = us.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), u| (from.min(u), to.max(u)));
            let first = members.len();
            members.extend(strip.chunks(LANES));
            let half = chart.half_at(from, reach.half_width_px);
            strips.push(Strip { blocks: first..members.len(), from, to, half });
        }
        let ends = members.iter().map(|block| [sort.v(block[0], 0.0), sort.v(block[block.len() - 1], 1.0)]).collect();
        let blocks = members
            .par_iter()
            .with_min_len(64)
            .map(|members| located(members, positions, descriptors, middles, &line))
            .collect();
        Strips { chart, strips, ends, blocks }
    }

    /// The strip of a coordinate u, or the nearest one.
    pub(super) fn strip(&self, u: f64) -> usize {
        self.strips.partition_point(|strip| strip.to < u).min(self.strips.len() - 1)
    }

    /// Visits the runs of blocks that may hold what lies within `across` (of u) and, for each strip, within the
    /// interval of v that `wanted` gives for the u of the strip and its [`Chart::half_at`]. No block is visited twice.
    #[inline(always)]
    pub(super) fn for_each_run(
        &self,
        across: [f64; 2],
        wanted: impl Fn([f64; 2], f64) -> Interval,
        mut visit: impl FnMut(Range<usize>),
    ) {
        let first = self.strips.partition_point(|strip| strip.to < across[0]);
        for strip in self.strips[first..].iter().take_while(|strip| strip.from <= across[1]) {
            let Interval { centre, half } = wanted([strip.from.max(across[0]), strip.to.min(across[1])], strip.half);
            if half.is_infinite() || (self.chart.is_circular() && half >= FRAC_PI_2) {
                visit(strip.blocks.clone());
                continue;
            }
            let run = self.run(strip, centre - half, centre + half);
            if !self.chart.is_circular() {
                visit(run);
                continue;
            }
            // The rest of the interval beyond an end of the circle.
            let low = self.run(strip, centre - half - PI, centre + half - PI);
            let high = self.run(strip, centre - half + PI, centre + half + PI);
            let others = if low.is_empty() { high } else { low };
            if !others.is_empty() && others.start < run.end && run.start < others.end {
                visit(others.start.min(run.start)..others.end.max(run.end));
            } else {
                visit(run);
                visit(others);
            }
        }
    }

    #[inline(always)]
    fn run(&self, strip: &Strip, from: f64, to: f64) -> Range<usize> {
        let ends = &self.ends[strip.blocks.clone()];
        let first = ends.partition_point(|end| end[1] < from);
        let count = ends[first..].partition_point(|end| end[0] <= to);
        strip.blocks.start + first..strip.blocks.start + first + count
    }
}

/// Where one strip ends and the next begins, ascending.
fn bounds(chart: &Chart, places: &[[f64; 2]], reach: Reach) -> Vec<f64> {
    let (low, high) =
        places.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &[u, _]| (low.min(u), high.max(u)));
    // Keypoints a square pixel, as if they filled a square.
    let density = places.len() as f64 / (high - low).max(1.0).powi(2);
    let lanes = LANES as f64;
    if let Some(radius) = reach.radius_px {
        // A run of `2 half` times the length of a strip is looked at beyond either end of the disc, and each strip has
        // ragged ends of about a block: the least sum of both.
        let half = reach.half_width_px.min(radius);
        let length = (2.0 * radius * lanes / (density * 2.0 * half)).sqrt().max((high - low) / MAX_STRIPS as f64);
        let count = ((high - low) / length).ceil().clamp(1.0, MAX_STRIPS as f64);
        return (1..count as usize).map(|strip| low + (high - low) * strip as f64 / count).collect();
    }
    // Parallel bands need no strips. About the epipole they need them in proportion to the distance: within a strip the
    // interval is as wide as it must be for the near end. `n` strips look at `1 + ln(ratio) / 2n` times what they
    // must and have `n` ragged ends.
    let near = low.max(reach.half_width_px);
    if matches!(chart, Chart::Straight { .. }) || near >= high {
        return Vec::new();
    }
    let candidates = 2.0 * reach.half_width_px * density * (high - low);
    let spread = (high / near).ln();
    let count = (candidates * spread / (2.0 * lanes)).sqrt().ceil().clamp(1.0, MAX_STRIPS as f64);
    let first = if near > low { 0 } else { 1 };
    (first..count as usize).map(|strip| near * (spread * strip as f64 / count).exp()).collect()
}

fn located(
    members: &[u64],
    positions: &[Point2<f64>],
    descriptors: &[Descriptor],
    [middle_a, middle_b]: [Point2<f64>; 2],
    line: &impl Fn(&Point2<f64>) -> Vector3<f64>,
) -> Located {
    let zero = Floats([0.0; LANES]);
    let mut block = Block { words: [Lanes([0; LANES]); 16], tags: Lanes([NO_KEY; LANES]) };
    let mut site = Site { x: zero, y: zero, line_x: zero, line_y: zero, line_offset: zero };
    // All fetched at once: the keypoints lie scattered, and so their memory is waited for together.
    let mut fetched = [[0; 16]; LANES];
    for (fetched, &key) in fetched.iter_mut().zip(members) {
        *fetched = words(&descriptors[SortKeys::index(key)]);
    }
    for (word, lanes) in block.words.iter_mut().enumerate() {
        for (value, fetched) in lanes.0.iter_mut().zip(&fetched) {
            *value = fetched[word];
        }
    }
    for (lane, &key) in members.iter().enumerate() {
        let index = SortKeys::index(key);
        let at = positions[index];
        let line = line(&at);
        block.tags.0[lane] = index as u32;
        site.x.0[lane] = (at.x - middle_b.x) as f32;
        site.y.0[lane] = (at.y - middle_b.y) as f32;
        site.line_x.0[lane] = line.x as f32;
        site.line_y.0[lane] = line.y as f32;
        site.line_offset.0[lane] = (line.x * middle_a.x + line.y * middle_a.y + line.z) as f32;
    }
    Located { block, site }
}
