//! Calibration boards in an image: checkerboards and ChArUco boards, whole or in part, as labelled inner corners.
//!
//! 1. Saddle points of the smoothed image are candidates: there the determinant of the Hessian is strongly negative. A
//!    circle about each must show two dark and two bright sectors (the idea of ChESS: Bennett and Lasenby, "ChESS -
//!    quick and robust detection of chess-board features", 2014).
//! 2. A grid grows over them (`grid`): neighbours lie along each other's edges, dark and bright swap sides from one to
//!    the next. This is a local rule, so lens distortion, perspective and hidden parts of the board are no matter.
//! 3. Where the markers of a ChArUco board leave its corners little space, they come first (`quads`, `from_markers`)
//!    and predict the corners.
//! 4. Corners are refined to about a hundredth of a pixel (`pattern`): the print about each, seen in the perspective of
//!    its neighbours, is aligned with the image.
//! 5. Columns and rows are counted (`labelling`). The markers of a ChArUco board name them; on a checkerboard the size
//!    and the colours may leave several labellings, and all are returned.
//! 6. Corners that lie on no plane, bent as a lens would bend it, are no board's (`plane`); what they scatter about it
//!    is in their sigma.

mod detect;
pub mod dictionary;
mod from_markers;
mod grid;
mod labelling;
mod markers;
mod pattern;
mod plane;
mod quads;
mod saddle;
#[cfg(test)]
mod tests;

pub use detect::{BoardOptions, detect_board};
pub use dictionary::Dictionary;
pub use labelling::{BoardCorner, FoundBoard, GridCorner, Labelling};

/// What is printed on a board.
///
/// Corner (0, 0) is the inner corner between the board's first square, which is black, and its neighbours; columns run
/// along x, rows along y, and y is a quarter turn clockwise from x for who looks at the print.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardLayout {
    /// Inner corners along x.
    pub columns: u32,
    /// Inner corners along y.
    pub rows: u32,
    /// ArUco markers in the white squares; `None` on a plain checkerboard.
    pub markers: Option<MarkerLayout>,
}

/// The markers of a ChArUco board: 0, 1, 2, ... over its white squares, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkerLayout {
    /// Which markers.
    pub dictionary: Dictionary,
    /// Side of a marker over the side of a square, between 0 and 1.
    pub marker_in_square: f64,
}
