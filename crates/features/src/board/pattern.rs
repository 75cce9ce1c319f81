//! What is printed about a corner of a board, whether an image shows it, and exactly where.

use super::markers::marked_cells;
use super::plane::project;
use super::saddle::Plane;
use super::{BoardLayout, BoardOptions};
use nalgebra::{Matrix3, Matrix4, Vector4};
use std::collections::BTreeMap;

/// Half the width of what is compared about a corner, px, at least.
pub(super) const MIN_REACH_PX: f64 = 4.0;
/// Points compared, each way.
const POINTS: (usize, usize) = (9, 25);
/// Steps of the alignment at most, and when it has converged, px.
const ROUNDS: usize = 12;
const CONVERGED_PX: f64 = 1e-3;
/// A print is not aligned farther than this from where it starts, px or squares, whichever is more.
const MAX_MOVED_PX: f64 = 1.5;
const MAX_MOVED_SQUARES: f64 = 0.08;
/// The print is blurred by a box of this half width before it is compared, px.
const BLUR_PX: f64 = 1.0;
/// Samples of the print in that box, each way.
const FINE: usize = 6;
/// Correlation of print and image from which a corner is there.
const MIN_CORRELATION: f64 = 0.6;
/// Part of what is compared that must be in the image.
const MIN_IN_IMAGE: f64 = 0.7;
/// Standard deviation of what the image shows below which nothing is compared, grey levels.
const MIN_DEVIATION: f64 = 3.0;

/// The print of a board, in squares; corner (0, 0) is the first inner one.
pub(super) struct Pattern<'a> {
    layout: &'a BoardLayout,
    /// Markers by the least column and row of their squares; none on a checkerboard.
    ids: BTreeMap<(i32, i32), usize>,
    first_is_black: bool,
    /// Half the width of what is compared about a corner, in squares, and in pixels at most.
    reach: (f64, f64),
}

impl<'a> Pattern<'a> {
    pub(super) fn of(layout: &'a BoardLayout, first_is_black: bool, options: &BoardOptions) -> Self {
        let cells = if layout.markers.is_some() { marked_cells(layout, first_is_black) } else { Vec::new() };
        let ids = cells.into_iter().enumerate().map(|(id, cell)| (cell, id)).collect();
        Pattern { layout, ids, first_is_black, reach: (options.window, options.max_window_px) }
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
        if ((column + row).rem_euclid(2) == 0) == self.first_is_black {
            return 0.0;
        }
        let Some((markers, &id)) = self.layout.markers.as_ref().zip(self.ids.get(&(column, row))) else { return 1.0 };
        let side = markers.dictionary.side() as f64 + 2.0;
        let into = |v: f64| ((v - v.floor() - 0.5) / markers.marker_in_square + 0.5) * side;
        let (bx, by) = (into(x), into(y));
        if bx < 0.0 || by < 0.0 || bx >= side || by >= side {
            return 1.0;
        }
        let bit = |v: f64| (v.floor() as usize).checked_sub(1);
        let white = bit(bx).zip(bit(by)).and_then(|(c, r)| markers.dictionary.bit(id, r, c));
        f64::from(u8::from(white == Some(true)))
    }

    /// The corner (column, row) near `place`, where the print fits the image best; `None` where the image does not show
    /// the print. The homography gives the print its shape about the corner; it may be a little aside.
    ///
    /// Least squares of `image(p + d) = a print + b` over `d, a, b` (Lucas and Kanade, "An iterative image registration
    /// technique", 1981), from the best of the places within `search_px` whole pixels of the first one.
    pub(super) fn align(
        &self,
        image: &Plane,
        (column, row): (i32, i32),
        place: (f64, f64),
        image_from_board: &Matrix3<f64>,
        search_px: i32,
    ) -> Option<Aligned> {
        let corner = (f64::from(column), f64::from(row));
        // At the image's edge a smaller window is whole.
        let (right, bottom) = (image.width as f64 - 1.0, image.height as f64 - 1.0);
        let inside_px = place.0.min(place.1).min(right - place.0).min(bottom - place.1) - 2.0;
        let print = self.patch(corner, image_from_board, inside_px);
        let shortest_px =
            axes(image_from_board, corner).map(|axis| axis.0.hypot(axis.1)).into_iter().fold(f64::MAX, f64::min);
        let max_moved_px = MAX_MOVED_PX.max(MAX_MOVED_SQUARES * shortest_px);
        let mut best = (f64::MIN, place);
        let range = -search_px..=search_px;
        for (dx, dy) in range.clone().flat_map(|dy| range.clone().map(move |dx| (dx, dy))) {
            let at = (place.0 + f64::from(dx), place.1 + f64::from(dy));
            if let Some(found) = print.correlation(image, at)
                && found > best.0
            {
                best = (found, at);
            }
        }
        let mut aligned = Aligned { x: best.1.0, y: best.1.1, noise_gain: 0.0 };
        for _ in 0..ROUNDS {
            let (step, gain) = print.step(image, (aligned.x, aligned.y))?;
            aligned = Aligned { x: aligned.x + step.0, y: aligned.y + step.1, noise_gain: gain };
            let moved = (aligned.x - best.1.0).hypot(aligned.y - best.1.1);
            if moved.is_nan() || moved > max_moved_px {
                return None;
            }
            if step.0.hypot(step.1) < CONVERGED_PX {
                break;
            }
        }
        let seen = print.correlation(image, (aligned.x, aligned.y))? >= MIN_CORRELATION;
        seen.then_some(aligned)
    }

    /// The print about a corner as a camera would see it.
    fn patch(&self, (column, row): (f64, f64), image_from_board: &Matrix3<f64>, max_px: f64) -> Patch {
        let middle = project(image_from_board, column, row);
        let axes = axes(image_from_board, (column, row));
        let lengths = axes.map(|axis| axis.0.hypot(axis.1).max(1e-6));
        let max_px = self.reach.1.min(max_px);
        let reach = lengths.map(|length| self.reach.0.min(max_px / length).max(MIN_REACH_PX / length));
        let blur = lengths.map(|length| BLUR_PX / length);
        // About a point a pixel.
        let count = |k: usize| ((2.0 * reach[k] * lengths[k]).ceil() as usize).clamp(POINTS.0, POINTS.1);
        let (across, down) = (count(0), count(1));
        let mut patch = Patch { offsets: Vec::with_capacity(across * down), print: Vec::with_capacity(across * down) };
        for at in 0..across * down {
            let offset = |k: usize, count: usize| 2.0 * k as f64 / (count - 1) as f64 - 1.0;
            let (u, v) = (reach[0] * offset(at % across, across), reach[1] * offset(at / across, down));
            let mut sum = 0.0;
            for k in 0..FINE * FINE {
                // An even number: none is at the corner's own edges, which would count it to one side.
                let spread = |k: usize| (2.0 * k as f64 + 1.0) / FINE as f64 - 1.0;
                sum += self.at(column + u + blur[0] * spread(k % FINE), row + v + blur[1] * spread(k / FINE));
            }
            let place = project(image_from_board, column + u, row + v);
            patch.offsets.push((place.0 - middle.0, place.1 - middle.1));
            patch.print.push(sum / (FINE * FINE) as f64);
        }
        patch
    }
}

/// How a column and a row change the place in the image about a corner, px.
pub(super) fn axes(image_from_board: &Matrix3<f64>, (column, row): (f64, f64)) -> [(f64, f64); 2] {
    // Differences over half a square each way.
    [(0.5, 0.0), (0.0, 0.5)].map(|(dc, dr)| {
        let a = project(image_from_board, column - dc, row - dr);
        let b = project(image_from_board, column + dc, row + dr);
        (b.0 - a.0, b.1 - a.1)
    })
}

/// A corner where its print fits the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Aligned {
    pub x: f64,
    pub y: f64,
    /// Scatter along an axis, px for each grey level of white noise.
    pub noise_gain: f64,
}

/// What is printed at places about a corner.
struct Patch {
    /// From the corner, px.
    offsets: Vec<(f64, f64)>,
    print: Vec<f64>,
}

impl Patch {
    /// Pearson's correlation of print and image; `None` where the image hardly varies, or too little of it is there.
    fn correlation(&self, image: &Plane, (x, y): (f64, f64)) -> Option<f64> {
        let mut sums = [0.0; 5];
        let mut count = 0u32;
        for (offset, print) in self.offsets.iter().zip(&self.print) {
            let Some(seen) = image.sample((x + offset.0) as f32, (y + offset.1) as f32) else { continue };
            let seen = f64::from(seen);
            count += 1;
            let terms = [*print, seen, print * print, print * seen, seen * seen];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        }
        if f64::from(count) < MIN_IN_IMAGE * self.print.len() as f64 {
            return None;
        }
        let [a, b, aa, ab, bb] = sums.map(|sum| sum / f64::from(count));
        let (aa, ab, bb) = (aa - a * a, ab - a * b, bb - b * b);
        (bb > MIN_DEVIATION * MIN_DEVIATION && aa > 0.0).then(|| ab / (aa * bb).sqrt())
    }

    /// By how much the place should move, and how grey levels of noise move it.
    fn step(&self, image: &Plane, (x, y): (f64, f64)) -> Option<((f64, f64), f64)> {
        let mut normal = Matrix4::<f64>::zeros();
        let mut right = Vector4::<f64>::zeros();
        for (offset, print) in self.offsets.iter().zip(&self.print) {
            let (u, v) = ((x + offset.0) as f32, (y + offset.1) as f32);
            let Some((seen, gx, gy)) = with_gradient(image, u, v) else { continue };
            let row = Vector4::new(gx, gy, -*print, -1.0);
            normal += row * row.transpose();
            right -= row * seen;
        }
        let inverse = normal.try_inverse()?;
        let solved = inverse * right;
        let gain = (0.5 * (inverse[(0, 0)] + inverse[(1, 1)])).sqrt();
        gain.is_finite().then_some(((solved[0], solved[1]), gain))
    }
}

/// Grey level and its derivatives along x and y, a pixel; `None` at the image's edge.
fn with_gradient(image: &Plane, x: f32, y: f32) -> Option<(f64, f64, f64)> {
    let gx = 0.5 * (image.sample(x + 1.0, y)? - image.sample(x - 1.0, y)?);
    let gy = 0.5 * (image.sample(x, y + 1.0)? - image.sample(x, y - 1.0)?);
    Some((f64::from(image.sample(x, y)?), f64::from(gx), f64::from(gy)))
}
