//! What moves with the camera, found by the program: its keypoints are left out of everything that follows.

use super::{Config, ImageFeatures, ImagePair, RunError};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_features::mask::is_kept;
use skclam_features::{EgoMask, MaskOutcome, MatchedPair, find_ego_mask, match_descriptors};
use skclam_geometry::{PinholeCamera, Pixel};

/// What was found, for the summary.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EgoMaskSummary {
    /// How the search ended.
    pub outcome: MaskOutcome,
    /// Pairs of images that were looked at.
    pub pairs: usize,
    /// Fraction of the image that moves with the camera.
    pub masked_fraction: f64,
    /// Keypoints that were left out.
    pub dropped_keypoints: usize,
}

/// Pairs that are looked at: enough for several votes everywhere, and few enough to cost next to nothing.
const PAIRS: usize = 24;

/// Finds what moves with the camera and takes its keypoints out of `images`. `None` where it was not asked for, or
/// where the rig brings a mask of its own.
pub fn drop_ego_masked(
    images: &mut [ImageFeatures],
    pairs: &[ImagePair],
    camera: &PinholeCamera,
    config: &Config,
) -> Result<Option<(EgoMask, EgoMaskSummary)>, RunError> {
    let Some(options) = &config.mask else { return Ok(None) };
    let chosen: Vec<&ImagePair> = pairs.iter().step_by(pairs.len().div_ceil(PAIRS).max(1)).collect();
    let positions: Vec<Vec<Pixel>> = images
        .iter()
        .map(|image| image.features.keypoints.iter().map(|k| Pixel::new(f64::from(k.x), f64::from(k.y))).collect())
        .collect();
    // Without the gate: it would drop just what is looked for.
    let matchings = chosen
        .par_iter()
        .map(|pair| {
            let descriptors = |index: usize| &images[index].features.descriptors;
            match_descriptors(descriptors(pair.a), descriptors(pair.b), &config.filter.matching)
        })
        .collect::<Result<Vec<_>, _>>()?;
    let votes: Vec<MatchedPair<'_>> = chosen
        .iter()
        .zip(&matchings)
        .map(|(pair, matching)| MatchedPair {
            positions_a: &positions[pair.a],
            positions_b: &positions[pair.b],
            matches: &matching.matches,
        })
        .collect();
    let found = find_ego_mask(camera.width, camera.height, &votes, options)?;
    let mut dropped_keypoints = 0;
    if found.outcome == MaskOutcome::Found {
        for image in images {
            dropped_keypoints += image.retain(|pixel| is_kept(&found.mask, pixel.x as f32, pixel.y as f32));
        }
    }
    let summary = EgoMaskSummary {
        outcome: found.outcome,
        pairs: found.pairs,
        masked_fraction: if found.outcome == MaskOutcome::Found { found.masked_fraction } else { 0.0 },
        dropped_keypoints,
    };
    Ok(Some((found, summary)))
}
