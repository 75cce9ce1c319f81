//! Keypoints sorted into strips, so that those near a line are a few stretches of memory.
//!
//! The image is cut into strips across one direction ("across"), and within a strip the keypoints are sorted into bins
//! along the perpendicular one ("along"). A line that runs more across than along passes each strip once; the band
//! around it is there one run of bins, and the keypoints of a run lie side by side, descriptors included. The less a
//! line slants, the fewer keypoints besides those of the band are met: the direction is that of most lines.

use crate::{Descriptor, FeaturesError};
use nalgebra::{Point2, Vector2, Vector3};

/// Width of a strip, px: wide enough that few strips are visited, narrow enough that a slanting line sweeps little.
const STRIP_PX: f64 = 80.0;
/// Height of a bin, px.
const BIN_PX: f64 = 4.0;
/// Strips and bins at most, which bounds the memory if a position is far outside of the image.
const MAX_STRIPS: usize = 256;
const MAX_BINS: usize = 2048;
/// Slack of ranges, px; far more than the rounding of positions and far less than a threshold.
const SLACK_PX: f64 = 1e-6;

/// The direction, of length one, that strips cut; `along` is it turned by a right angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Across(Vector2<f64>);

impl Across {
    /// The direction in which most of the lines (with unit normals, or zero) run.
    pub(super) fn most(lines: &[Vector3<f64>]) -> Self {
        // Doubled angles: a normal and its opposite are one line.
        let (cosine, sine) = lines
            .iter()
            .fold((0.0, 0.0), |(c, s), line| (c + line.x * line.x - line.y * line.y, s + 2.0 * line.x * line.y));
        let angle = 0.5 * f64::atan2(sine, cosine);
        Across(Vector2::new(-angle.sin(), angle.cos()))
    }

    /// The direction at a right angle, for lines that run so.
    pub(super) fn turned(self) -> Self {
        Across(Vector2::new(-self.0.y, self.0.x))
    }

    /// Whether the line passes each strip at a slope of at most one.
    pub(super) fn suits(self, line: &Vector3<f64>) -> bool {
        let (across, along) = self.split(line.x, line.y);
        along.abs() >= across.abs()
    }

    #[inline(always)]
    fn split(self, x: f64, y: f64) -> (f64, f64) {
        (self.0.x * x + self.0.y * y, self.0.x * y - self.0.y * x)
    }
}

/// An interval, ends included.
#[derive(Debug, Clone, Copy)]
struct Range {
    from: f64,
    to: f64,
}

impl Range {
    #[inline(always)]
    fn and(self, other: Range) -> Self {
        Range { from: self.from.max(other.from), to: self.to.min(other.to) }
    }
}

/// A keypoint as the search meets it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stored {
    /// Where it is, px.
    pub(super) at: Point2<f64>,
    /// Its epipolar line in the other image, with unit normal.
    pub(super) line: Vector3<f64>,
    /// Its index.
    pub(super) index: u32,
}

/// The keypoints of one image in strips.
#[derive(Debug, Clone)]
pub(super) struct Strips {
    across: Across,
    first_across: f64,
    first_along: f64,
    strip_px: f64,
    strips_per_px: f64,
    bins_per_px: f64,
    strips: usize,
    bins: usize,
    /// Where each bin of each strip starts in the lists below; one more entry at the end.
    starts: Vec<u32>,
    /// Keypoints in the order of strips and bins, in a bin by index.
    pub(super) stored: Vec<Stored>,
    /// Their descriptors.
    pub(super) descriptors: Vec<Descriptor>,
    /// Their positions from `middle` in single precision, padded so that [`TOGETHER`] can always be read.
    x: Vec<f32>,
    y: Vec<f32>,
    middle: Point2<f64>,
    /// What single precision can be wrong by in a distance to a line that passes near the keypoints, px.
    rounding_px: f64,
}

/// Keypoints that are tested against a line at once.
pub(super) const TOGETHER: usize = 16;

/// A line for [`Strips::near`].
#[derive(Debug, Clone, Copy)]
pub(super) struct CoarseLine {
    x: f32,
    y: f32,
    offset: f32,
    half: f32,
}

impl Strips {
    /// Sorts keypoints, of which there is at least one; `line` makes the line of a position.
    pub(super) fn new(
        across: Across,
        positions: &[Point2<f64>],
        descriptors: &[Descriptor],
        line: impl Fn(&Point2<f64>) -> Vector3<f64>,
    ) -> Result<Self, FeaturesError> {
        let (mut low, mut high) = ((f64::INFINITY, f64::INFINITY), (f64::NEG_INFINITY, f64::NEG_INFINITY));
        for position in positions {
            let (x, y) = across.split(position.x, position.y);
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x), high.1.max(y));
        }
        let (wide, long) = (high.0 - low.0, high.1 - low.1);
        if !(wide.is_finite() && long.is_finite()) {
            let what = "the extent of the positions of keypoints";
            return Err(FeaturesError::NotFinite { what, value: format!("{wide} x {long}") });
        }
        let strip_px = STRIP_PX.max(wide / (MAX_STRIPS - 1) as f64);
        let bin_px = BIN_PX.max(long / (MAX_BINS - 1) as f64);
        let mut sorted = Strips {
            across,
            first_across: low.0,
            first_along: low.1,
            strip_px,
            strips_per_px: 1.0 / strip_px,
            bins_per_px: 1.0 / bin_px,
            strips: (wide / strip_px) as usize + 1,
            bins: (long / bin_px) as usize + 1,
            starts: Vec::new(),
            stored: Vec::with_capacity(positions.len()),
            descriptors: Vec::with_capacity(positions.len()),
            x: Vec::with_capacity(positions.len() + TOGETHER),
            y: Vec::with_capacity(positions.len() + TOGETHER),
            middle: positions[positions.len() / 2],
            // Two products and a sum of numbers up to twice the extent, each right to 2^-24 of itself.
            rounding_px: (wide + long) * 2f64.powi(-19),
        };
        let mut order: Vec<(u32, u32)> = positions
            .iter()
            .zip(0..)
            .map(|(position, index)| {
                let (x, y) = across.split(position.x, position.y);
                ((sorted.strip(x) * sorted.bins + sorted.bin(y)) as u32, index)
            })
            .collect();
        order.sort_unstable();
        sorted.starts = vec![0; sorted.strips * sorted.bins + 1];
        for &(cell, index) in &order {
            sorted.starts[cell as usize + 1] += 1;
            let at = positions[index as usize];
            sorted.stored.push(Stored { at, line: line(&at), index });
            sorted.descriptors.push(descriptors[index as usize]);
            sorted.x.push((at.x - sorted.middle.x) as f32);
            sorted.y.push((at.y - sorted.middle.y) as f32);
        }
        sorted.x.resize(positions.len() + TOGETHER, 0.0);
        sorted.y.resize(positions.len() + TOGETHER, 0.0);
        for cell in 1..sorted.starts.len() {
            sorted.starts[cell] += sorted.starts[cell - 1];
        }
        Ok(sorted)
    }

    #[inline(always)]
    fn strip(&self, x: f64) -> usize {
        // Casts of floats saturate: what is left of the first strip is in it.
        (((x - self.first_across) * self.strips_per_px) as usize).min(self.strips - 1)
    }

    #[inline(always)]
    fn bin(&self, y: f64) -> usize {
        (((y - self.first_along) * self.bins_per_px) as usize).min(self.bins - 1)
    }

    /// The line with unit normal (or zero) and the half width of its band, for [`Strips::near`].
    #[inline(always)]
    pub(super) fn coarse(&self, line: &Vector3<f64>, half: f64) -> CoarseLine {
        let offset = line.x * self.middle.x + line.y * self.middle.y + line.z;
        CoarseLine {
            x: line.x as f32,
            y: line.y as f32,
            offset: offset as f32,
            // The last bits of a line far away are no matter: it is far away.
            half: ((half + self.rounding_px + 1e-6) * (1.0 + 1e-6)) as f32,
        }
    }

    /// One bit for each of the [`TOGETHER`] keypoints stored from `start` on: whether it may be within the band; a
    /// superset of those that are. Bits past the end of a run mean nothing.
    #[inline(always)]
    pub(super) fn near(&self, start: usize, line: &CoarseLine) -> u32 {
        let lanes = start..start + TOGETHER;
        let x: &[f32; TOGETHER] = self.x[lanes.clone()].try_into().expect("as many as asked for");
        let y: &[f32; TOGETHER] = self.y[lanes].try_into().expect("as many as asked for");
        let mut bits = [0u32; TOGETHER];
        for lane in 0..TOGETHER {
            let off = (line.x * x[lane] + line.y * y[lane] + line.offset).abs();
            bits[lane] = if off <= line.half { 1 << lane } else { 0 };
        }
        bits.into_iter().fold(0, |near, bit| near | bit)
    }

    /// Visits the keypoints in reach as runs of the stored list: within `half` of the line and within the radius of the
    /// point, and some more. For a zero line the point alone counts.
    #[inline(always)]
    pub(super) fn for_each_run(
        &self,
        line: &Vector3<f64>,
        half: f64,
        near: Option<(Point2<f64>, f64)>,
        mut visit: impl FnMut(std::ops::Range<usize>),
    ) {
        let mut crossed = Range { from: f64::NEG_INFINITY, to: f64::INFINITY };
        let mut window = crossed;
        if let Some((point, radius)) = near {
            let (across, along) = self.across.split(point.x, point.y);
            crossed = Range { from: across - radius - SLACK_PX, to: across + radius + SLACK_PX };
            window = Range { from: along - radius - SLACK_PX, to: along + radius + SLACK_PX };
        }
        let length = self.bins as f64;
        let last_across = self.first_across + self.strips as f64 * self.strip_px;
        crossed = crossed.and(Range { from: self.first_across, to: last_across });

        // From here on heights are in bins. The line: along = start + slope * across.
        let in_bins = |y: f64| (y - self.first_along) * self.bins_per_px;
        let window = Range { from: in_bins(window.from), to: in_bins(window.to) }.and(Range { from: 0.0, to: length });
        let (across, along) = self.across.split(line.x, line.y);
        let (start, slope, half) = if along == 0.0 {
            (0.0, 0.0, f64::INFINITY)
        } else {
            let slope = -across / along * self.bins_per_px;
            let half = (half / along.abs() + SLACK_PX) * self.bins_per_px;
            (in_bins(-line.z / along), slope, half)
        };
        // A slanting line leaves the image early.
        if slope != 0.0 && half.is_finite() {
            let ends = [(-half - start) / slope, (length + half - start) / slope];
            crossed = crossed.and(Range { from: ends[0].min(ends[1]), to: ends[0].max(ends[1]) });
        }
        if crossed.from > crossed.to || window.from > window.to {
            return;
        }
        let rise = slope * self.strip_px;
        let (lower, upper) = (rise.min(0.0) - half, rise.max(0.0) + half);
        for strip in self.strip(crossed.from)..self.strip(crossed.to) + 1 {
            let at = start + slope * (self.first_across + strip as f64 * self.strip_px);
            let range = Range { from: at + lower, to: at + upper }.and(window);
            if range.from > range.to {
                continue;
            }
            let bins = &self.starts[strip * self.bins..(strip + 1) * self.bins + 1];
            let last = (range.to as u32 as usize).min(self.bins - 1);
            let first = (range.from as u32 as usize).min(last);
            let run = bins[first] as usize..bins[last + 1] as usize;
            if !run.is_empty() {
                visit(run);
            }
        }
    }
}
