//! Everything that can go wrong while a map is built, written or read.

use std::io;

/// Why a map could not be built, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// An image does not have the size that its camera says.
    #[error("the {what} is {got_width} x {got_height}, its camera says {need_width} x {need_height}")]
    ImageSize {
        /// Which image.
        what: &'static str,
        /// Columns of the image.
        got_width: u32,
        /// Rows of the image.
        got_height: u32,
        /// Columns the camera has.
        need_width: u32,
        /// Rows the camera has.
        need_height: u32,
    },
    /// A pose or a camera holds a number that is not finite, or a focal length that is not positive.
    #[error("{what} holds {value}; {need} is needed")]
    BadNumber {
        /// Where the number is.
        what: &'static str,
        /// The number as text, since NaN equals nothing.
        value: String,
        /// What would be right.
        need: &'static str,
    },
    /// A pose lies so far from the base that the map cannot address it.
    #[error(
        "the camera is {distance_m:.3e} m from the base, the map reaches {limit_m:.3e} m; check the pose and its unit"
    )]
    PoseFarAway {
        /// Distance of the camera.
        distance_m: f64,
        /// What the map can address.
        limit_m: f64,
    },
    /// A point lies outside what voxel indices can address.
    #[error(
        "a point {distance_m:.3} m from the base is beyond the {limit_m:.3} m that voxels of {voxel_m} m can address; use a larger voxel or limit the depth range"
    )]
    OutOfRange {
        /// Largest coordinate of the point, metres.
        distance_m: f64,
        /// Largest coordinate that can be addressed, metres.
        limit_m: f64,
        /// Edge of a voxel, metres.
        voxel_m: f64,
    },
    /// The map outgrew the memory it may take.
    #[error("the map needs more than the limit of {limit_mib} MiB after {views} views; {advice}")]
    MemoryLimit {
        /// The limit in MiB.
        limit_mib: u64,
        /// How many views had been taken in.
        views: usize,
        /// What to do about it.
        advice: &'static str,
    },
    /// An option has a value that makes no sense.
    #[error("option {option} is {value}; {need}")]
    Option {
        /// Its name.
        option: &'static str,
        /// Its value as text.
        value: String,
        /// What would be right.
        need: &'static str,
    },
    /// Lists of a cloud or mesh do not fit each other.
    #[error("{what}: {got} entries where {need} are needed")]
    Inconsistent {
        /// Which list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// The length of the list of points.
        need: usize,
    },
    /// A file is not what it should be.
    #[error("{format} file: {reason}")]
    Format {
        /// The format that was expected.
        format: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// There is nothing to work on.
    #[error("{what} is empty; {advice}")]
    Empty {
        /// What is empty.
        what: &'static str,
        /// What to do about it.
        advice: &'static str,
    },
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] io::Error),
}
