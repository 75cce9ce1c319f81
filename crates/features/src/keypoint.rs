//! The vocabulary of the crate: keypoints, descriptors, and the matches between them.

use serde::{Deserialize, Serialize};

/// A point of interest in an image.
///
/// Coordinates are pixels; (0, 0) is the *centre* of the top-left pixel, x points right and y down,
/// whatever the octave in which the point was found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct KeyPoint {
    /// Column in pixels of the full-resolution image.
    pub x: f32,
    /// Row in pixels of the full-resolution image.
    pub y: f32,
    /// Diameter of the meaningful neighbourhood in pixels of the full-resolution image.
    pub size: f32,
    /// Main orientation in radians in [0, 2 pi), from the x axis towards the y axis.
    pub angle: f32,
    /// Response of the detector (scale-normalised determinant of the Hessian).
    pub response: f32,
    /// Octave in which the point was found; 0 is the full resolution.
    pub octave: u16,
    /// Index of the evolution level, over all octaves.
    pub level: u16,
}

/// A binary descriptor of 486 bits (M-LDB), bit `i` in word `i / 64`; unused bits are zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[repr(align(64))]
pub struct Descriptor(pub [u64; 8]);

impl Descriptor {
    /// Number of differing bits.
    #[inline]
    pub fn hamming(&self, other: &Descriptor) -> u32 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a ^ b).count_ones()).sum()
    }
}

/// What one image yields: keypoints and, index by index, their descriptors.
#[derive(Debug, Clone, Default)]
pub struct Features {
    /// Keypoints in a fixed order that does not depend on the number of threads.
    pub keypoints: Vec<KeyPoint>,
    /// One descriptor a keypoint.
    pub descriptors: Vec<Descriptor>,
}

/// A correspondence between keypoint `a` of one image and keypoint `b` of another.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Match {
    /// Index into the first image's keypoints.
    pub a: u32,
    /// Index into the second image's keypoints.
    pub b: u32,
    /// Hamming distance to the nearest neighbour.
    pub distance: u32,
    /// Hamming distance to the second nearest neighbour; `u32::MAX` where there is none.
    pub second_distance: u32,
}
