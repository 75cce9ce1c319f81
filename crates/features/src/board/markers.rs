//! The markers of a ChArUco board: read through the grid, they name its corners.

use super::grid::Grid;
use super::labelling::Labelling;
use super::saddle::Plane;
use super::{BoardLayout, Dictionary, MarkerLayout};
use nalgebra::{Matrix3, SMatrix, SVector};
use std::collections::BTreeMap;

/// Difference of black and white below which nothing is read, grey levels.
const MIN_CONTRAST: f32 = 10.0;
/// Part of a marker's black border that may look white.
const BORDER_ERRORS: f64 = 0.1;
/// Samples along a side of a bit.
const SAMPLES: usize = 3;

/// The labellings of a grid that most of its markers name (one, but for old boards in part), and how many do; `None`
/// where fewer than two agree.
///
/// A grid that was clipped to the board under one beginning says nothing of the other: then all labellings are
/// returned.
pub(super) fn read(
    image: &Plane,
    grid: &Grid,
    layout: &BoardLayout,
    markers: &MarkerLayout,
    is_clipped: bool,
) -> Option<(Vec<Labelling>, usize)> {
    // OpenCV before 4.6 began boards with an even number of rows of squares with a white one.
    let cells = [true, false].map(|first_is_black| marked_cells(layout, first_is_black));
    let beginnings = if layout.rows % 2 == 1 { 2 } else { 1 };
    let count = cells.iter().map(Vec::len).max().unwrap_or(0);
    let mut votes: BTreeMap<Labelling, usize> = BTreeMap::new();
    let mut all = 0;
    for &(row, column) in grid.corners.keys().filter(|(row, column)| !grid.is_dark(*row, *column)) {
        let Some((id, turns)) = read_cell(image, grid, row, column, markers, count) else { continue };
        all += 1;
        for cell in cells[..beginnings].iter().filter_map(|cells| cells.get(id)) {
            *votes.entry(labelling_of(turns, (column, row), *cell)).or_insert(0) += 1;
        }
    }
    let most = votes.values().copied().max()?;
    if most < 2 || 2 * most <= all {
        return None;
    }
    // On a board with an odd number of columns of squares, inner markers alone fit both beginnings, a column apart. The
    // whole of a board lies on itself under one of them only; of a part both are returned.
    let on_board = |labelling: &Labelling| {
        let inside = |&&(row, column): &&(i32, i32)| {
            let (column, row) = labelling.of(column, row);
            (0..layout.columns as i32).contains(&column) && (0..layout.rows as i32).contains(&row)
        };
        grid.corners.keys().filter(inside).count()
    };
    let tied: Vec<Labelling> = votes.into_iter().filter(|(_, count)| *count == most).map(|(way, _)| way).collect();
    if is_clipped {
        return Some((tied, most));
    }
    let held = tied.iter().map(on_board).max()?;
    Some((tied.into_iter().filter(|way| on_board(way) == held).collect(), most))
}

/// Column and row of the white squares' first corners, in the order of the markers' numbers. Squares at the board's
/// edge have their first corner outside: (-1, ...).
pub(super) fn marked_cells(layout: &BoardLayout, first_is_black: bool) -> Vec<(i32, i32)> {
    let white = if first_is_black { 1 } else { 0 };
    (0..=layout.rows as i32)
        .flat_map(|row| (0..=layout.columns as i32).map(move |column| (column, row)))
        .filter(|(column, row)| (column + row) % 2 == white)
        .map(|(column, row)| (column - 1, row - 1))
        .collect()
}

/// The labelling under which the grid's square at `first` (its corner of least column and row) with its marker turned
/// by `turns` quarters clockwise is the board's square at `cell`.
fn labelling_of(turns: usize, first: (i32, i32), cell: (i32, i32)) -> Labelling {
    // A marker turned clockwise by t quarters has its own x along the grid's direction t of (+column, +row, -column,
    // -row).
    let turns = (turns % 4) as u8;
    let unshifted = Labelling { turns, column: 0, row: 0 };
    let (a, b) = (unshifted.of(first.0, first.1), unshifted.of(first.0 + 1, first.1 + 1));
    Labelling { turns, column: cell.0 - a.0.min(b.0), row: cell.1 - a.1.min(b.1) }
}

/// The marker in the grid's square whose corner of least column and row is given: its number, and its quarter turns
/// clockwise against the grid.
fn read_cell(
    image: &Plane,
    grid: &Grid,
    row: i32,
    column: i32,
    markers: &MarkerLayout,
    count: usize,
) -> Option<(usize, usize)> {
    let corner = |dr: i32, dc: i32| grid.at(row + dr, column + dc);
    let corners = [corner(0, 0)?, corner(0, 1)?, corner(1, 1)?, corner(1, 0)?];
    let image_from_square = homography(&corners)?;
    let margin = 0.5 * (1.0 - markers.marker_in_square);
    let side = markers.marker_in_square;
    let square_from_marker = Matrix3::new(side, 0.0, margin, 0.0, side, margin, 0.0, 0.0, 1.0);
    read_marker(image, &(image_from_square * square_from_marker), &markers.dictionary, count)
}

/// The marker in a quadrilateral of the image, given by the homography from the unit square: its number among the first
/// `count`, and its quarter turns clockwise against the square.
pub(super) fn read_marker(
    image: &Plane,
    image_from_marker: &Matrix3<f64>,
    dictionary: &Dictionary,
    count: usize,
) -> Option<(usize, usize)> {
    let side = dictionary.side() + 2;
    let bit = 1.0 / side as f64;
    let mut means = vec![0.0f32; side * side];
    for (at, mean) in means.iter_mut().enumerate() {
        let (bit_row, bit_column) = (at / side, at % side);
        for k in 0..SAMPLES * SAMPLES {
            // The inner half of a bit.
            let offset = |k: usize| 0.25 + 0.5 * (k as f64 + 0.5) / SAMPLES as f64;
            let x = bit * (bit_column as f64 + offset(k % SAMPLES));
            let y = bit * (bit_row as f64 + offset(k / SAMPLES));
            let p = image_from_marker * nalgebra::Vector3::new(x, y, 1.0);
            *mean += image.sample((p.x / p.z) as f32, (p.y / p.z) as f32)?;
        }
        *mean /= (SAMPLES * SAMPLES) as f32;
    }
    let threshold = threshold(&means)?;
    let on_border = |at: usize| {
        let (r, c) = (at / side, at % side);
        r == 0 || c == 0 || r == side - 1 || c == side - 1
    };
    let white_border = (0..means.len()).filter(|&at| on_border(at) && means[at] > threshold).count();
    if white_border as f64 > BORDER_ERRORS * (4 * side - 4) as f64 {
        return None;
    }
    let bits = (0..means.len())
        .filter(|&at| !on_border(at))
        .fold(0u64, |bits, at| bits << 1 | u64::from(means[at] > threshold));
    dictionary.find(bits, count)
}

/// Between the dark and the bright values, where the two classes are farthest apart (Otsu 1979); `None` where all are
/// alike.
fn threshold(values: &[f32]) -> Option<f32> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let total: f32 = sorted.iter().sum();
    let (mut best, mut below) = ((-1.0, 0.0), 0.0);
    for k in 1..sorted.len() {
        below += sorted[k - 1];
        let (low, high) = (below / k as f32, (total - below) / (sorted.len() - k) as f32);
        let between = (k * (sorted.len() - k)) as f32 * (high - low) * (high - low);
        if between > best.0 && high - low > MIN_CONTRAST {
            best = (between, 0.5 * (low + high));
        }
    }
    (best.0 > 0.0).then_some(best.1)
}

/// The homography that takes the unit square's corners (0, 0), (1, 0), (1, 1), (0, 1) to four points of the image.
fn homography(corners: &[(f32, f32); 4]) -> Option<Matrix3<f64>> {
    let mut left = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (k, ((x, y), (u, v))) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].into_iter().zip(corners).enumerate() {
        let (u, v) = (f64::from(*u), f64::from(*v));
        left.set_row(2 * k, &SMatrix::<f64, 1, 8>::from([[x], [y], [1.0], [0.0], [0.0], [0.0], [-u * x], [-u * y]]));
        left.set_row(
            2 * k + 1,
            &SMatrix::<f64, 1, 8>::from([[0.0], [0.0], [0.0], [x], [y], [1.0], [-v * x], [-v * y]]),
        );
        (right[2 * k], right[2 * k + 1]) = (u, v);
    }
    let h = left.lu().solve(&right)?;
    Some(Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_homography_hits_its_corners() {
        let corners = [(10.0, 20.0), (60.0, 25.0), (55.0, 80.0), (5.0, 70.0)];
        let h = homography(&corners).unwrap();
        for ((x, y), (u, v)) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].into_iter().zip(corners) {
            let p = h * nalgebra::Vector3::new(x, y, 1.0);
            assert!((p.x / p.z - f64::from(u)).abs() < 1e-9 && (p.y / p.z - f64::from(v)).abs() < 1e-9);
        }
    }

    #[test]
    fn squares_are_numbered_row_by_row() {
        let layout = BoardLayout { columns: 4, rows: 3, markers: None };
        let cells = marked_cells(&layout, true);
        assert_eq!(cells.len(), 10);
        assert_eq!(cells[..3], [(0, -1), (2, -1), (-1, 0)]);
        assert_eq!(marked_cells(&layout, false)[0], (-1, -1));
    }
}
