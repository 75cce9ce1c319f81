//! What is printed about a corner of a ChArUco board, and whether an image shows it.

use super::markers::marked_cells;
use super::saddle::Plane;
use super::{BoardLayout, MarkerLayout};
use std::collections::BTreeMap;

/// Half the width of what is compared about a corner, in squares, and in pixels at least.
const REACH: f64 = 0.3;
const MIN_REACH_PX: f64 = 4.0;
/// Points compared, each way.
const POINTS: usize = 13;
/// The print is blurred by a box of this half width before it is compared, px.
const BLUR_PX: f64 = 1.0;
/// Correlation of print and image from which a corner is there.
const MIN_CORRELATION: f64 = 0.6;
/// Standard deviation of what the image shows below which nothing is compared, grey levels.
const MIN_DEVIATION: f64 = 3.0;

/// The print of a ChArUco board, in squares; corner (0, 0) is the first inner one.
pub(super) struct Pattern<'a> {
    layout: &'a BoardLayout,
    markers: &'a MarkerLayout,
    ids: BTreeMap<(i32, i32), usize>,
    first_is_black: bool,
}

impl<'a> Pattern<'a> {
    pub(super) fn of(layout: &'a BoardLayout, markers: &'a MarkerLayout, first_is_black: bool) -> Self {
        let cells = marked_cells(layout, first_is_black);
        let ids = cells.into_iter().enumerate().map(|(id, cell)| (cell, id)).collect();
        Pattern { layout, markers, ids, first_is_black }
    }

    pub(super) fn first_is_black(&self) -> bool {
        self.first_is_black
    }

    /// The square of a marker by its least column and row.
    pub(super) fn cell_of(&self, id: usize) -> Option<(i32, i32)> {
        self.ids.iter().find(|(_, other)| **other == id).map(|(cell, _)| *cell)
    }

    /// 1 where it is white, 0 where it is black.
    fn at(&self, x: f64, y: f64) -> f64 {
        let (column, row) = (x.floor() as i32, y.floor() as i32);
        let outside = |v: i32, corners: u32| v < -1 || v > corners as i32 - 1;
        if outside(column, self.layout.columns) || outside(row, self.layout.rows) {
            return 1.0;
        }
        let Some(&id) = self.ids.get(&(column, row)) else { return 0.0 };
        let side = self.markers.dictionary.side() as f64 + 2.0;
        let into = |v: f64| ((v - v.floor() - 0.5) / self.markers.marker_in_square + 0.5) * side;
        let (bx, by) = (into(x), into(y));
        if bx < 0.0 || by < 0.0 || bx >= side || by >= side {
            return 1.0;
        }
        let bit = |v: f64| (v.floor() as usize).checked_sub(1);
        let white = bit(bx).zip(bit(by)).and_then(|(c, r)| self.markers.dictionary.bit(id, r, c));
        f64::from(u8::from(white == Some(true)))
    }

    /// Whether an image shows the print about a corner: (column, row) at `place`, and how a column and a row change that, px.
    pub(super) fn is_seen(
        &self,
        image: &Plane,
        (column, row): (i32, i32),
        place: (f64, f64),
        axes: [(f64, f64); 2],
    ) -> bool {
        let length = |axis: (f64, f64)| axis.0.hypot(axis.1).max(1e-6);
        let lengths = [length(axes[0]), length(axes[1])];
        let reach = lengths.map(|length| REACH.max(MIN_REACH_PX / length));
        let blur = lengths.map(|length| BLUR_PX / length);
        let offset = |k: usize| 2.0 * k as f64 / (POINTS - 1) as f64 - 1.0;
        let (mut print, mut seen) = (Vec::with_capacity(POINTS * POINTS), Vec::with_capacity(POINTS * POINTS));
        for at in 0..POINTS * POINTS {
            let (u, v) = (reach[0] * offset(at % POINTS), reach[1] * offset(at / POINTS));
            let x = place.0 + u * axes[0].0 + v * axes[1].0;
            let y = place.1 + u * axes[0].1 + v * axes[1].1;
            let Some(value) = image.sample(x as f32, y as f32) else { return false };
            seen.push(f64::from(value));
            let mut sum = 0.0;
            for k in 0..25 {
                let spread = |k: usize| 0.5 * k as f64 - 1.0;
                let (du, dv) = (blur[0] * spread(k % 5), blur[1] * spread(k / 5));
                sum += self.at(f64::from(column) + u + du, f64::from(row) + v + dv);
            }
            print.push(sum / 25.0);
        }
        correlation(&print, &seen).is_some_and(|found| found >= MIN_CORRELATION)
    }
}

/// Pearson's correlation; `None` where the second list hardly varies.
fn correlation(a: &[f64], b: &[f64]) -> Option<f64> {
    let count = a.len() as f64;
    let (mean_a, mean_b) = (a.iter().sum::<f64>() / count, b.iter().sum::<f64>() / count);
    let (mut aa, mut ab, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        aa += (a - mean_a).powi(2);
        ab += (a - mean_a) * (b - mean_b);
        bb += (b - mean_b).powi(2);
    }
    ((bb / count).sqrt() >= MIN_DEVIATION && aa > 0.0).then(|| ab / (aa * bb).sqrt())
}
