//! What can be wrong with a dataset.

use skclam_geometry::DepthImageError;
use skclam_rig::{RigError, RigFileError};
use std::path::PathBuf;

/// Why a dataset could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// There is no such folder.
    #[error("{}: no such folder; a dataset is a folder with rig.toml, postures.csv, color/ and depth/", path.display())]
    NoFolder {
        /// What was asked for.
        path: PathBuf,
    },
    /// The folder lacks what a dataset is made of.
    #[error("{}: there is no {file} in it; a dataset is a folder with rig.toml, postures.csv, color/ and depth/ (`skclam import` makes one of a recording)", path.display())]
    Missing {
        /// The folder.
        path: PathBuf,
        /// The file.
        file: &'static str,
    },
    /// A command that was to replace the folder was interrupted, and that cannot be finished.
    #[error(transparent)]
    Folder(#[from] skclam_files::OutputError),
    /// The rig's file.
    #[error(transparent)]
    Rig(#[from] RigFileError),
    /// A file could not be opened, read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The robot's body cannot be taken out of the depth images.
    #[error("{}: {problem}", path.display())]
    SelfFilter {
        /// The URDF.
        path: PathBuf,
        /// What is wrong with it, or with the posture.
        problem: String,
    },
    /// The table of postures is not well formed.
    #[error("{}, line {line}: {problem}", path.display())]
    Table {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: usize,
        /// What is wrong, what was expected.
        problem: String,
    },
    /// A posture does not fit the rig.
    #[error("{}, line {line}: {source}", path.display())]
    Posture {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: usize,
        /// Why.
        source: RigError,
    },
    /// Fewer than two postures.
    #[error("{}: {got} posture(s); at least 2 are needed, and 30 or more diverse ones for a good calibration", path.display())]
    TooFewPostures {
        /// The file.
        path: PathBuf,
        /// Postures found.
        got: usize,
    },
    /// Fewer measured positions of a marker than its offset and the instrument's frame have numbers.
    #[error("{}: {got} measured points of {markers} marker(s); at least {need} are needed, and 30 or more diverse ones for a good judgement", path.display())]
    TooFewPoints {
        /// The file.
        path: PathBuf,
        /// Points found.
        got: usize,
        /// Points needed.
        need: usize,
        /// Markers on the flange.
        markers: usize,
    },
    /// A depth image is named, but the rig describes no depth camera.
    #[error("{}, line {line}: a depth image is named, but the rig has no [depth] table; describe the depth camera or drop the column", path.display())]
    DepthWithoutCamera {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: usize,
    },
    /// Postures or images that are no files do not fit each other or the rig.
    #[error("images in memory: {problem}")]
    Frames {
        /// What is wrong, what was expected.
        problem: String,
    },
    /// An image is missing, truncated, or of a kind that is not read.
    #[error("{}: {problem}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// An image has another size than the rig says.
    #[error("{}: {got_width} x {got_height} pixels, but [{table}] in the rig says {width} x {height}; the intrinsics belong to one size", path.display())]
    ImageSize {
        /// The file.
        path: PathBuf,
        /// The rig's table: color or depth.
        table: &'static str,
        /// Width in the rig.
        width: u32,
        /// Height in the rig.
        height: u32,
        /// Width of the image.
        got_width: u32,
        /// Height of the image.
        got_height: u32,
    },
    /// A depth image's values make no sense.
    #[error("{}: {source}", path.display())]
    Depth {
        /// The file.
        path: PathBuf,
        /// Why.
        source: DepthImageError,
    },
}
