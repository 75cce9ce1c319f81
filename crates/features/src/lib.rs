//! AKAZE keypoints and descriptors, matching and its filters.
//!
//! This crate knows images and matrices, and nothing of robots or poses: a predicted epipolar
//! geometry comes in as a fundamental matrix.

mod error;
mod keypoint;
pub mod matching;

pub use error::FeaturesError;
pub use keypoint::{Descriptor, Features, KeyPoint, Match};
pub use matching::{MatchCounts, MatchOptions, Matching, match_descriptors};
