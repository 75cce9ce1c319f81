//! AKAZE keypoints and descriptors, matching and its filters.
//!
//! This crate knows images and matrices, and nothing of robots or poses: a predicted epipolar
//! geometry comes in as a fundamental matrix.
//!
#![doc = include_str!("../README.md")]

pub mod akaze;
pub mod board;
mod error;
pub mod filter;
pub mod guided;
mod keypoint;
pub mod mask;
pub mod matching;
pub mod refine;
pub mod tracks;

pub use akaze::{Akaze, AkazeOptions};
pub use board::{BoardLayout, BoardOptions, Dictionary, FoundBoard, MarkerLayout, detect_board};
pub use error::FeaturesError;
pub use filter::{DescribedPoints, FilterOptions, FilteredMatches, RansacOptions, match_and_filter};
pub use guided::{PredictedPoints, Prediction, match_guided};
pub use keypoint::{Descriptor, Features, KeyPoint, Match};
pub use mask::{EgoMask, MaskOptions, MaskOutcome, MatchedPair, find_ego_mask, keep_unmasked};
pub use matching::{MatchCounts, MatchOptions, Matching, match_descriptors};
pub use refine::{
    Bend, BendPrediction, Pyramid, RefineOptions, Refined, Refiner, Rejection, Seed, WarpModel, refine_matches,
};
pub use tracks::{
    ImagePair, Observation, TrackOptions, TrackPoint, Tracks, WarpPrediction, build_tracks, refine_tracks,
    refine_tracks_in_windows,
};
