//! A calibration board that stood still while the images were taken.

use serde::{Deserialize, Serialize};

/// What is printed on the board.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub enum BoardPattern {
    /// Alternating squares; its inner corners are the features.
    Checkerboard,
    /// A checkerboard with ArUco markers in its white squares.
    Charuco {
        /// Name of the markers' dictionary, as in OpenCV: "DICT_4X4_50".
        dictionary: String,
        /// Side of a marker in micrometres (an integer keeps `Eq` honest).
        marker_um: u64,
    },
}

/// A flat board: columns x rows inner corners, `square_m` metres apart.
#[derive(Debug, Clone, PartialEq)]
pub struct Board {
    /// What is printed on it.
    pub pattern: BoardPattern,
    /// Inner corners along x.
    pub columns: u32,
    /// Inner corners along y.
    pub rows: u32,
    /// Side of a square, metres.
    pub square_m: f64,
}
