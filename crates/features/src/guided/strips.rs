//! Keypoints sorted into strips, so that those near a line are a few stretches of memory.
//!
//! The image is cut into strips across one axis ("across"), and within a strip the keypoints are sorted into bins along
//! the other ("along"). A line that runs more across than along passes each strip once; the band around it is there one
//! run of bins, and the keypoints of a run lie side by side, descriptors included.

use crate::{Descriptor, FeaturesError};
use nalgebra::{Point2, Vector3};

/// Width of a strip, px: wide enough that few strips are visited, narrow enough that a slanting line sweeps little.
const STRIP_PX: f64 = 48.0;
/// Height of a bin, px.
const BIN_PX: f64 = 4.0;
/// Strips and bins at most, which bounds the memory if a position is far outside of the image.
const MAX_STRIPS: usize = 256;
const MAX_BINS: usize = 2048;
/// Slack of ranges, px; far more than the rounding of positions and far less than a threshold.
const SLACK_PX: f64 = 1e-6;

/// The axis that strips cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Across {
    /// Strips side by side in x; for lines nearer to level.
    X,
    /// Strips one below the other in y; for lines nearer to upright.
    Y,
}

impl Across {
    /// The axis for which the line passes each strip at a slope of at most one.
    pub(super) fn for_line(line: &Vector3<f64>) -> Self {
        if line.y.abs() >= line.x.abs() { Across::X } else { Across::Y }
    }

    fn split(self, point: &Point2<f64>) -> (f64, f64) {
        match self {
            Across::X => (point.x, point.y),
            Across::Y => (point.y, point.x),
        }
    }
}

/// An interval, ends included.
#[derive(Debug, Clone, Copy)]
pub(super) struct Range {
    pub(super) from: f64,
    pub(super) to: f64,
}

impl Range {
    pub(super) const ALL: Range = Range { from: f64::NEG_INFINITY, to: f64::INFINITY };

    pub(super) fn around(centre: f64, half: f64) -> Self {
        Range { from: centre - half - SLACK_PX, to: centre + half + SLACK_PX }
    }

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
    bin_px: f64,
    strips: usize,
    bins: usize,
    /// Where each bin of each strip starts in the lists below; one more entry at the end.
    starts: Vec<u32>,
    /// Keypoints in the order of strips and bins, in a bin by index.
    pub(super) stored: Vec<Stored>,
    /// Their descriptors.
    pub(super) descriptors: Vec<Descriptor>,
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
            let (x, y) = across.split(position);
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
            bin_px,
            strips: (wide / strip_px) as usize + 1,
            bins: (long / bin_px) as usize + 1,
            starts: Vec::new(),
            stored: Vec::with_capacity(positions.len()),
            descriptors: Vec::with_capacity(positions.len()),
        };
        let mut order: Vec<(u32, u32)> = positions
            .iter()
            .zip(0..)
            .map(|(position, index)| {
                let (x, y) = across.split(position);
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
        }
        for cell in 1..sorted.starts.len() {
            sorted.starts[cell] += sorted.starts[cell - 1];
        }
        Ok(sorted)
    }

    fn strip(&self, x: f64) -> usize {
        // Casts of floats saturate: what is left of the first strip is in it.
        (((x - self.first_across) / self.strip_px) as usize).min(self.strips - 1)
    }

    fn bin(&self, y: f64) -> usize {
        (((y - self.first_along) / self.bin_px) as usize).min(self.bins - 1)
    }

    /// The keypoints in reach as runs of the stored list: within `half` of the line and within the window (x, y), and
    /// some more.
    ///
    /// Without a line (or for a zero one) the window alone counts.
    pub(super) fn runs(
        &self,
        line: Option<(&Vector3<f64>, f64)>,
        window: (Range, Range),
    ) -> impl Iterator<Item = std::ops::Range<usize>> + '_ {
        let (window_across, window_along) = match self.across {
            Across::X => window,
            Across::Y => (window.1, window.0),
        };
        // The line as along = offset + slope * across.
        let line = line.and_then(|(line, half)| {
            let (across, along) = self.across.split(&Point2::new(line.x, line.y));
            (along != 0.0).then(|| (-line.z / along, -across / along, half / along.abs()))
        });
        let last_across = self.first_across + self.strips as f64 * self.strip_px;
        let last_along = self.first_along + self.bins as f64 * self.bin_px;
        let mut crossed = Range { from: self.first_across, to: last_across }.and(window_across);
        // A line leaves the image early if it is steep, at most one strip for each on the way.
        if let Some((offset, slope, half)) = line
            && slope != 0.0
        {
            let ends = [self.first_along - half - SLACK_PX, last_along + half + SLACK_PX].map(|y| (y - offset) / slope);
            crossed = crossed.and(Range { from: ends[0].min(ends[1]), to: ends[0].max(ends[1]) });
        }
        let strips = if crossed.from <= crossed.to {
            self.strip(crossed.from)..self.strip(crossed.to) + 1
        } else {
            0..0
        };
        strips.filter_map(move |strip| {
            let mut range = window_along;
            if let Some((offset, slope, half)) = line {
                let from = self.first_across + strip as f64 * self.strip_px;
                let (start, end) = (offset + slope * from, offset + slope * (from + self.strip_px));
                range = range
                    .and(Range { from: start.min(end) - half - SLACK_PX, to: start.max(end) + half + SLACK_PX });
            }
            if range.from > range.to || range.to < self.first_along || range.from > last_along {
                return None;
            }
            let base = strip * self.bins;
            let run = self.starts[base + self.bin(range.from)] as usize
                ..self.starts[base + self.bin(range.to) + 1] as usize;
            (!run.is_empty()).then_some(run)
        })
    }
}
