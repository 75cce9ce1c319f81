//! Why a run ends without a result.

use crate::dataset::DatasetError;
use crate::output::OutputError;
use skclam_calibration::CalibrationError;
use skclam_features::FeaturesError;
use skclam_rig::{RigError, RigFileError};

/// Why a run ends without a result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The data set.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A rig file.
    #[error(transparent)]
    RigFile(#[from] RigFileError),
    /// The rig does not fit the postures.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// Features and matching.
    #[error("features: {0}")]
    Features(#[from] FeaturesError),
    /// The estimator.
    #[error("calibration: {0}")]
    Calibration(#[from] CalibrationError),
    /// The map.
    #[error("map: {0}")]
    Mapping(#[from] skclam_mapping::Error),
    /// The virtual cell.
    #[error("simulation: {0}")]
    Simulation(#[from] skclam_simulation::SimulationError),
    /// The results could not be written.
    #[error("results: {0}")]
    Output(#[from] OutputError),
    /// The summary could not be written as JSON.
    #[error("summary: {0}")]
    Json(#[from] serde_json::Error),
    /// A setting of one module that a setting of the run overrides.
    #[error("configuration: {key} has no effect, since {by} decides; leave {key} at its default and set {by}")]
    Overridden {
        /// The setting without effect.
        key: &'static str,
        /// What is in force in its place.
        by: &'static str,
    },
    /// No image pair is left with enough matches.
    #[error(
        "no pair of images has enough matches: {keypoints} keypoints in {images} images, {candidates} candidates, {after_ratio} after the ratio test, {matches} after all filters. \
         Is there texture in view, do neighbouring images overlap, does the nominal rig belong to this recording? Where the mount is only a guess, --find-mount finds it"
    )]
    NoMatches {
        /// Images.
        images: usize,
        /// Keypoints over all images.
        keypoints: usize,
        /// Candidates over all pairs.
        candidates: usize,
        /// Left by the ratio test.
        after_ratio: usize,
        /// Left by everything.
        matches: usize,
    },
    /// A mount that no camera has.
    #[error(
        "the mount that fits the matches best lies {distance_m:.1} m from the flange, farther than a camera is mounted: the recording does not determine it \
         ({matches} matches in {pairs} pairs, {median_px:.1} px from their lines in the median). Turn the wrist more while recording, or give a rough mount in the rig \
         and leave --find-mount out"
    )]
    AbsurdMount {
        /// From the flange to the camera, metres.
        distance_m: f64,
        /// Matches that were used.
        matches: usize,
        /// Their pairs of images.
        pairs: usize,
        /// Median Sampson distance of the matches, px.
        median_px: f64,
    },
    /// The user asked to stop.
    #[error("interrupted; nothing was written")]
    Interrupted,
}
