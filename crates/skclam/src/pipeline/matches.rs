//! The second stage, section 3.2: which images are matched, and the paper's chain of filters on each pair.

use super::{Config, ImageFeatures, ImagePair, PredictedView, RunError, choose_pairs};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_features::{
    DescribedPoints, FilteredMatches, Match, MatchCounts, PredictedPoints, Prediction, match_and_filter, match_guided,
};
use skclam_geometry::{FundamentalMatrix, Isometry3, PinholeCamera, Pixel, Point3};

/// How candidates for a match are searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Search {
    /// All with all, the gate afterwards: the paper's order.
    Exhaustive,
    /// Only near the predicted epipolar line and, where the depth is known, near the predicted point.
    Guided,
}

/// The matches of one pair.
#[derive(Debug, Clone)]
pub struct MatchedPair {
    /// Which images.
    pub pair: ImagePair,
    /// What the filters left; indices of keypoints.
    pub matches: Vec<Match>,
    /// What each step left.
    pub counts: MatchCounts,
}

/// Chooses the pairs by what the nominal rig predicts.
pub fn pairs_to_match(images: &[ImageFeatures], camera: &PinholeCamera, config: &Config) -> Vec<ImagePair> {
    let views: Vec<PredictedView> = images.iter().map(|image| image.view.clone()).collect();
    choose_pairs(&views, camera, &config.pairing)
}

/// Matches pairs of images.
pub fn match_pairs(
    dataset: &Dataset,
    images: &[ImageFeatures],
    pairs: Vec<ImagePair>,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Vec<MatchedPair>, RunError> {
    let camera = &dataset.rig.color;
    progress.begin(Stage::MatchPairs, pairs.len() as u64);
    pairs
        .into_par_iter()
        .map(|pair| {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            let found = match_pair(&images[pair.a], &images[pair.b], camera, config)?;
            progress.step();
            Ok(MatchedPair { pair, matches: found.matches, counts: found.counts })
        })
        .collect()
}

fn match_pair(
    a: &ImageFeatures,
    b: &ImageFeatures,
    camera: &PinholeCamera,
    config: &Config,
) -> Result<FilteredMatches, RunError> {
    let a_from_b = a.view.base_from_color.inverse() * b.view.base_from_color;
    let fundamental = predicted_fundamental(camera, &a_from_b);
    let filter = config.filter(camera);
    let found = match config.search {
        Search::Exhaustive => match_and_filter(described(a), described(b), Some(&fundamental), &filter)?,
        Search::Guided => {
            let in_b = predicted_points(a, camera, &a_from_b.inverse());
            let points = filter.gate_px.map(|radius_px| PredictedPoints { in_b: &in_b, radius_px });
            let prediction = Prediction { fundamental: Some(&fundamental), points };
            match_guided(described(a), described(b), &prediction, &filter)?
        }
    };
    Ok(found)
}

fn described(image: &ImageFeatures) -> DescribedPoints<'_> {
    DescribedPoints { descriptors: &image.features.descriptors, positions: &image.undistorted }
}

/// The nominal F of Eq. (3); zero where the cameras are at one place, as then there is no epipolar geometry.
fn predicted_fundamental(camera: &PinholeCamera, a_from_b: &Isometry3) -> nalgebra::Matrix3<f64> {
    /// A tenth of a millimetre: below it the direction of the baseline is rounding and noise.
    const MIN_BASELINE_M: f64 = 1e-4;
    if a_from_b.translation.vector.norm() < MIN_BASELINE_M {
        return nalgebra::Matrix3::zeros();
    }
    FundamentalMatrix::from_pose(camera, camera, a_from_b).0
}

/// Where image B should show the keypoints of A whose depth is known. Undistorted pixels.
fn predicted_points(a: &ImageFeatures, camera: &PinholeCamera, b_from_a: &Isometry3) -> Vec<Option<Pixel>> {
    let ideal = PinholeCamera { distortion: Default::default(), ..*camera };
    a.undistorted
        .iter()
        .zip(&a.depth_m)
        .map(|(pixel, depth_m)| {
            let in_a = Point3::from(ideal.unproject(pixel) * (*depth_m)?);
            ideal.project(&(b_from_a * in_a))
        })
        .collect()
}
