//! What can go wrong in this crate.

use thiserror::Error;

/// Errors of detection, description, matching and refinement.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum FeaturesError {
    /// An option lies outside of what the method can work with.
    #[error("option `{option}` is {got}, expected {need}")]
    BadOption {
        /// Name of the field.
        option: &'static str,
        /// Its value.
        got: String,
        /// What was expected.
        need: &'static str,
    },
    /// A mask must have the size of its image.
    #[error("the mask is {mask_width}x{mask_height} but the image is {width}x{height}")]
    MaskSize {
        /// Width of the image in pixels.
        width: u32,
        /// Height of the image in pixels.
        height: u32,
        /// Width of the mask in pixels.
        mask_width: u32,
        /// Height of the mask in pixels.
        mask_height: u32,
    },
    /// The scale space of the image would not fit into a sensible amount of memory.
    #[error("the image is {width}x{height}, at most {max_pixels} pixels are supported")]
    ImageTooLarge {
        /// Width of the image in pixels.
        width: u32,
        /// Height of the image in pixels.
        height: u32,
        /// The limit in pixels.
        max_pixels: u64,
    },
    /// A number that must be finite is not.
    #[error("{what} holds {value}, which is not finite")]
    NotFinite {
        /// Where the number is.
        what: &'static str,
        /// The number as text.
        value: String,
    },
    /// Lists that run in parallel differ in length.
    #[error("{what}: {got} were given, {need} are needed")]
    CountMismatch {
        /// Which list.
        what: &'static str,
        /// Its length.
        got: usize,
        /// The length that it must have.
        need: usize,
    },
    /// More keypoints than an index of the search can distinguish.
    #[error("an image has {got} keypoints, at most {max} can be matched along epipolar lines")]
    TooManyKeypoints {
        /// How many there are.
        got: usize,
        /// The limit.
        max: usize,
    },
    /// An index points past the end of what it indexes.
    #[error("{what} {index} does not exist, there are {count}")]
    NoSuchIndex {
        /// What is indexed.
        what: &'static str,
        /// The index.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// No dictionary of markers has this name.
    #[error("there is no dictionary \"{got}\"; known are {known}")]
    UnknownDictionary {
        /// What was asked for.
        got: String,
        /// All names, with commas between.
        known: String,
    },
}
