//! Which column and row of the board a grid's corner is.

use super::BoardLayout;
use super::grid::Grid;

/// A corner of a grid; columns and rows are counted from anywhere.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GridCorner {
    /// Grows along the grid's x.
    pub column: i32,
    /// Grows along the grid's y, a quarter turn clockwise from x in the image.
    pub row: i32,
    /// Position, px; (0, 0) is the centre of the top-left pixel.
    pub x: f64,
    /// Position, px.
    pub y: f64,
    /// Standard deviation of the position along an axis, px: from the image's noise and the gradients about the corner,
    /// and from how far the board's corners scatter about a smoothly bent plane beyond that.
    pub sigma_px: f64,
}

/// An inner corner of the board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardCorner {
    /// Counted from 0, below [`BoardLayout::columns`].
    pub column: u32,
    /// Counted from 0, below [`BoardLayout::rows`].
    pub row: u32,
    /// Position, px.
    pub x: f64,
    /// Position, px.
    pub y: f64,
    /// As [`GridCorner::sigma_px`].
    pub sigma_px: f64,
}

/// One labelling: the grid is turned, then shifted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Labelling {
    /// Quarter turns, 0 to 3: after each, the board's column is the grid's row.
    pub turns: u8,
    /// Added to the turned column.
    pub column: i32,
    /// Added to the turned row.
    pub row: i32,
}

/// Column and row after `turns` quarter turns: (column, row) becomes (row, -column).
fn turned(turns: u8, (column, row): (i32, i32)) -> (i32, i32) {
    (0..turns).fold((column, row), |(column, row), _| (row, -column))
}

impl Labelling {
    pub(super) fn of(&self, column: i32, row: i32) -> (i32, i32) {
        let (column, row) = turned(self.turns, (column, row));
        (column + self.column, row + self.row)
    }
}

/// What an image shows of a board.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundBoard {
    /// Every corner, in any count.
    pub corners: Vec<GridCorner>,
    /// The labellings that the pattern allows, at least one. More than one: the board looks the same when
    /// turned, or a part of it is out of view.
    pub labellings: Vec<Labelling>,
    /// Markers that were read.
    pub markers: usize,
    /// RMS of the corners' sigmas, px.
    pub sigma_px: f64,
}

impl FoundBoard {
    /// The corners as one of the labellings counts them, by row and column; those beyond the board are left out.
    pub fn labelled(&self, labelling: &Labelling, layout: &BoardLayout) -> Vec<BoardCorner> {
        let mut corners: Vec<BoardCorner> = self
            .corners
            .iter()
            .filter_map(|corner| {
                let (column, row) = labelling.of(corner.column, corner.row);
                let (column, row) = (u32::try_from(column).ok()?, u32::try_from(row).ok()?);
                let inside = column < layout.columns && row < layout.rows;
                inside.then_some(BoardCorner { column, row, x: corner.x, y: corner.y, sigma_px: corner.sigma_px })
            })
            .collect();
        corners.sort_by_key(|corner| (corner.row, corner.column));
        corners
    }
}

/// Labellings that put every corner of the grid on the board, by its size and its colours alone.
///
/// The square beyond corner (0, 0), at larger column and row, is dark as the board's first square is. On a board whose
/// columns and rows are both even or both odd half a turn leaves the colours as they are, and the other half of all
/// boards of that size has them swapped: there colours say nothing.
pub(super) fn possible(grid: &Grid, layout: &BoardLayout) -> Vec<Labelling> {
    let ((top, bottom), (left, right)) = grid.bounds();
    let (columns, rows) = (layout.columns as i32, layout.rows as i32);
    let colours_decide = layout.markers.is_some() || (columns + rows) % 2 == 1;
    let mut all = Vec::new();
    for turns in 0..4 {
        let (a, b) = (turned(turns, (left, top)), turned(turns, (right, bottom)));
        let (low, high) = ((a.0.min(b.0), a.1.min(b.1)), (a.0.max(b.0), a.1.max(b.1)));
        for row in -low.1..=rows - 1 - high.1 {
            for column in -low.0..=columns - 1 - high.0 {
                let labelling = Labelling { turns, column, row };
                if !colours_decide || keeps_colours(grid, &labelling) {
                    all.push(labelling);
                }
            }
        }
    }
    all
}

/// Whether dark squares of the grid are dark on the board.
pub(super) fn keeps_colours(grid: &Grid, labelling: &Labelling) -> bool {
    // The square beyond a grid's corner, at larger column and row, has this corner at its least column and row:
    // (column, row). After a quarter turn the corner with the least column and row of the same square is another one.
    let Some((&(row, column), _)) = grid.corners.iter().next() else { return false };
    let (a, b) = (labelling.of(column, row), labelling.of(column + 1, row + 1));
    let (min_column, min_row) = (a.0.min(b.0), a.1.min(b.1));
    grid.is_dark(row, column) == ((min_column + min_row).rem_euclid(2) == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(columns: i32, rows: i32, even_is_dark: bool) -> Grid {
        let places = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        Grid { corners: places.map(|place| (place, (place.1 as f32, place.0 as f32))).collect(), even_is_dark }
    }

    fn layout(columns: u32, rows: u32) -> BoardLayout {
        BoardLayout { columns, rows, markers: None }
    }

    #[test]
    fn colours_decide_the_orientation_of_a_board_of_odd_and_even_counts() {
        let straight = possible(&grid(11, 8, true), &layout(11, 8));
        assert_eq!(straight, [Labelling { turns: 0, column: 0, row: 0 }]);
        let upside_down = possible(&grid(11, 8, false), &layout(11, 8));
        assert_eq!(upside_down, [Labelling { turns: 2, column: 10, row: 7 }]);
        let lying = possible(&grid(8, 11, true), &layout(11, 8));
        assert_eq!(lying.len(), 1);
        assert_eq!(lying[0].turns % 2, 1);
        // Every labelling counts each corner once.
        let found = FoundBoard {
            corners: (0..8).map(|c| GridCorner { column: c, row: 10, x: 0.0, y: 0.0, sigma_px: 0.1 }).collect(),
            labellings: lying.clone(),
            markers: 0,
            sigma_px: 0.1,
        };
        assert_eq!(found.labelled(&lying[0], &layout(11, 8)).len(), 8);
    }

    #[test]
    fn even_boards_and_parts_leave_several_ways() {
        assert_eq!(possible(&grid(7, 5, true), &layout(7, 5)).len(), 2);
        assert_eq!(possible(&grid(6, 6, true), &layout(6, 6)).len(), 4);
        // A column is missing: two shifts and two turns, of which colours leave two.
        assert_eq!(possible(&grid(10, 8, true), &layout(11, 8)).len(), 2);
        assert!(possible(&grid(12, 8, true), &layout(11, 8)).is_empty());
    }
}
