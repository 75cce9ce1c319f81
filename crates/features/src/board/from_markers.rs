//! From markers to corners: the way to a ChArUco board whose markers leave its corners little space.
//!
//! With markers nearly as large as their squares the saddle points of the corners drown in the markers' borders. The
//! markers themselves are seen well: each one read is four points of known places on the board. Neighbours that predict
//! each other's places make up the board; they predict the corners about them, which are aligned with the print, and
//! known corners predict the next ones.

use super::grid::Grid;
use super::markers::read_marker;
use super::pattern::{Pattern, axes};
use super::plane::{Counted, homography, project};
use super::quads::{Quad, dark_quads};
use super::saddle::Plane;
use super::{BoardLayout, BoardOptions, MarkerLayout};
use nalgebra::Matrix3;
use std::collections::{BTreeMap, BTreeSet};

/// Markers farther apart than this say little of each other, in squares.
const FAR: f64 = 4.5;
/// A marker predicts another's middle within this part of their distance, in squares.
const TOLERANCE: f64 = 0.15;
/// Corners by which a missing one is predicted.
const NEAREST: usize = 12;
/// A corner is aligned to within this part of a square of its prediction, and so many px at least.
const MOVED: f64 = 0.12;
const MIN_MOVED_PX: f64 = 1.5;
/// Predictions are off by at most so many whole pixels.
const SEARCH_PX: i32 = 2;

/// A marker that was read; corners in its own order, clockwise from its first.
struct Marker {
    id: usize,
    corners: Quad,
}

/// A marker on the board.
struct Placed {
    cell: (i32, i32),
    image_from_board: Matrix3<f64>,
    middle: (f64, f64),
    step_px: f64,
}

/// Grids over the markers of an image, counted as the board is, one for each way in which the board may begin; and
/// whether its markers leave several.
pub(super) fn grids(
    image: &Plane,
    layout: &BoardLayout,
    markers: &MarkerLayout,
    options: &BoardOptions,
) -> (Vec<Grid>, bool) {
    let read = read_all(image, layout, markers);
    // OpenCV before 4.6 began boards with an even number of rows of squares with a white one.
    let beginnings: &[bool] = if layout.rows % 2 == 1 { &[true, false] } else { &[true] };
    let agree = |first_is_black: &bool| {
        let pattern = Pattern::of(layout, *first_is_black, options);
        let placed = agreeing(read.iter().filter_map(|marker| place(marker, &pattern, markers)).collect());
        let cells: BTreeSet<(i32, i32)> = placed.iter().map(|placed| placed.cell).collect();
        (cells.len(), pattern, placed)
    };
    let mut labellings: Vec<_> = beginnings.iter().map(agree).collect();
    // Markers at the board's edge contradict the wrong beginning.
    let most = labellings.iter().map(|(cells, ..)| *cells).max().unwrap_or(0);
    labellings.retain(|(cells, ..)| *cells == most && most > 0);
    let grown = labellings.iter().map(|(_, pattern, placed)| ExtendedGrid { image, layout, pattern }.grown(placed));
    (grown.filter(|grid| !grid.corners.is_empty()).collect(), labellings.len() > 1)
}

fn read_all(image: &Plane, layout: &BoardLayout, markers: &MarkerLayout) -> Vec<Marker> {
    let count = ((layout.columns as usize + 1) * (layout.rows as usize + 1)).div_ceil(2);
    let read = |quad: Quad| {
        let image_from_marker = homography(&unit_square(&quad), &[1.0; 4])?;
        let (id, turns) = read_marker(image, &image_from_marker, &markers.dictionary, count)?;
        // Turned clockwise, the marker's first corner comes to the next one.
        Some(Marker { id, corners: std::array::from_fn(|k| quad[(k + turns) % 4]) })
    };
    dark_quads(image).into_iter().filter_map(read).collect()
}

fn unit_square(quad: &Quad) -> [Counted; 4] {
    let places = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
    std::array::from_fn(|k| Counted { column: places[k].0, row: places[k].1, x: quad[k].0, y: quad[k].1 })
}

fn place(marker: &Marker, pattern: &Pattern<'_>, markers: &MarkerLayout) -> Option<Placed> {
    let cell = pattern.cell_of(marker.id)?;
    let margin = 0.5 * (1.0 - markers.marker_in_square);
    let corners = unit_square(&marker.corners).map(|corner| Counted {
        column: f64::from(cell.0) + margin + markers.marker_in_square * corner.column,
        row: f64::from(cell.1) + margin + markers.marker_in_square * corner.row,
        ..corner
    });
    let image_from_board = homography(&corners, &[1.0; 4])?;
    let middle = project(&image_from_board, f64::from(cell.0) + 0.5, f64::from(cell.1) + 0.5);
    let step_px = (0..4).map(|k| (corners[k].x - corners[(k + 1) % 4].x).hypot(corners[k].y - corners[(k + 1) % 4].y));
    Some(Placed { cell, image_from_board, middle, step_px: step_px.sum::<f64>() / (4.0 * markers.marker_in_square) })
}

/// The largest set of markers in which neighbours predict each other.
fn agreeing(placed: Vec<Placed>) -> Vec<Placed> {
    let predicts = |a: &Placed, b: &Placed| {
        let (column, row) = (f64::from(b.cell.0) + 0.5, f64::from(b.cell.1) + 0.5);
        let far = f64::from(b.cell.0 - a.cell.0).hypot(f64::from(b.cell.1 - a.cell.1));
        let (x, y) = project(&a.image_from_board, column, row);
        let off = (x - b.middle.0).hypot(y - b.middle.1);
        far <= FAR && off <= TOLERANCE * far.max(1.0) * a.step_px.min(b.step_px)
    };
    let mut group: Vec<usize> = (0..placed.len()).collect();
    for at in 0..placed.len() {
        for other in 0..at {
            let (a, b) = (&placed[at], &placed[other]);
            if group[at] != group[other] && predicts(a, b) && predicts(b, a) {
                let (from, to) = (group[at].max(group[other]), group[at].min(group[other]));
                group.iter_mut().filter(|group| **group == from).for_each(|group| *group = to);
            }
        }
    }
    let mut cells: BTreeMap<usize, Vec<(i32, i32)>> = BTreeMap::new();
    for (at, group) in group.iter().enumerate() {
        let of = cells.entry(*group).or_default();
        if !of.contains(&placed[at].cell) {
            of.push(placed[at].cell);
        }
    }
    // Of equal ones the first.
    let Some((&largest, _)) = cells.iter().max_by_key(|(group, cells)| (cells.len(), std::cmp::Reverse(**group)))
    else {
        return Vec::new();
    };
    placed.into_iter().zip(group).filter(|(_, group)| *group == largest).map(|(placed, _)| placed).collect()
}

/// What corners are looked for in.
struct ExtendedGrid<'a> {
    image: &'a Plane,
    layout: &'a BoardLayout,
    pattern: &'a Pattern<'a>,
}

impl ExtendedGrid<'_> {
    fn grown(&self, placed: &[Placed]) -> Grid {
        let mut predicted: BTreeMap<(i32, i32), Vec<&Matrix3<f64>>> = BTreeMap::new();
        for marker in placed {
            for (dc, dr) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
                let (column, row) = (marker.cell.0 + dc, marker.cell.1 + dr);
                predicted.entry((row, column)).or_default().push(&marker.image_from_board);
            }
        }
        let mut corners: BTreeMap<(i32, i32), (f64, f64)> = BTreeMap::new();
        for (&(row, column), by) in &predicted {
            let places = by.iter().map(|h| project(h, f64::from(column), f64::from(row)));
            let sum = places.fold((0.0, 0.0), |sum, place| (sum.0 + place.0, sum.1 + place.1));
            let place = (sum.0 / by.len() as f64, sum.1 / by.len() as f64);
            if let Some(found) = self.corner((row, column), place, by[0]) {
                corners.insert((row, column), found);
            }
        }
        self.spread(&mut corners);
        let corners = corners.into_iter().map(|(place, (x, y))| (place, (x as f32, y as f32))).collect();
        // The square beyond corner (0, 0) is as dark as the first.
        Grid { corners, even_is_dark: self.pattern.first_is_black() }
    }

    /// Adds corners beside known ones, until there are no more.
    fn spread(&self, corners: &mut BTreeMap<(i32, i32), (f64, f64)>) {
        let mut tried: BTreeMap<(i32, i32), usize> = BTreeMap::new();
        loop {
            let before = corners.len();
            for row in 0..self.layout.rows as i32 {
                for column in 0..self.layout.columns as i32 {
                    let beside = [(0, 1), (1, 0), (0, -1), (-1, 0)]
                        .iter()
                        .filter(|(dr, dc)| corners.contains_key(&(row + dr, column + dc)))
                        .count();
                    // A corner that failed is worth another look once more neighbours are known.
                    let known = corners.contains_key(&(row, column));
                    if known || beside <= tried.get(&(row, column)).copied().unwrap_or(0) {
                        continue;
                    }
                    tried.insert((row, column), beside);
                    let Some(h) = nearby(corners, (row, column)) else { continue };
                    let place = project(&h, f64::from(column), f64::from(row));
                    if let Some(found) = self.corner((row, column), place, &h) {
                        corners.insert((row, column), found);
                    }
                }
            }
            if corners.len() == before {
                return;
            }
        }
    }

    /// The corner near its prediction, if the image shows the print there.
    fn corner(&self, (row, column): (i32, i32), place: (f64, f64), h: &Matrix3<f64>) -> Option<(f64, f64)> {
        let inside = |v: i32, count: u32| (0..count as i32).contains(&v);
        if !inside(row, self.layout.rows) || !inside(column, self.layout.columns) {
            return None;
        }
        let axes = axes(h, (f64::from(column), f64::from(row)));
        let step_px = axes[0].0.hypot(axes[0].1).min(axes[1].0.hypot(axes[1].1));
        let found = self.pattern.align(self.image, (column, row), place, h, SEARCH_PX)?;
        let moved = (found.x - place.0).hypot(found.y - place.1);
        (moved <= (MOVED * step_px).max(MIN_MOVED_PX)).then_some((found.x, found.y))
    }
}

/// The homography through the known corners nearest to a place.
pub(super) fn nearby(corners: &BTreeMap<(i32, i32), (f64, f64)>, (row, column): (i32, i32)) -> Option<Matrix3<f64>> {
    let mut nearest: Vec<(i32, Counted)> = corners
        .iter()
        .map(|(&(r, c), &(x, y))| {
            let far = (r - row).pow(2) + (c - column).pow(2);
            (far, Counted { column: f64::from(c), row: f64::from(r), x, y })
        })
        .collect();
    nearest.sort_by_key(|(far, _)| *far);
    nearest.truncate(NEAREST);
    let nearest: Vec<Counted> = nearest.into_iter().map(|(_, corner)| corner).collect();
    if nearest.len() < 4 { None } else { homography(&nearest, &vec![1.0; nearest.len()]) }
}
