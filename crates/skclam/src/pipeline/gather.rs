//! From images to correspondences: all that happens before an estimator runs.

use super::{
    CameraFixedSummary, Config, ImageFeatures, MatchedPair, RunError, TrackSummary, correspondences, drop_camera_fixed,
    extract_features, match_pairs, pairs_to_match,
};
use crate::dataset::Dataset;
use crate::progress::Progress;
use crate::summary::total_counts;
use skclam_calibration::Correspondences;
use skclam_features::CameraFixed;

/// What the images said.
pub(super) struct Gathered {
    pub images: Vec<ImageFeatures>,
    pub pairs: Vec<MatchedPair>,
    pub data: Correspondences,
    pub tracks: Option<TrackSummary>,
    pub camera_fixed: Option<(CameraFixed, CameraFixedSummary)>,
}

/// Features, matches and tracks: section 3.2. Fails where nothing is left.
pub(super) fn gather(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<Gathered, RunError> {
    let mut images = extract_features(dataset, config, progress)?;
    let chosen = pairs_to_match(&images, &dataset.rig.color, config);
    let camera_fixed = match dataset.rig.color_mask {
        // The user's word comes before what can be found.
        Some(_) => None,
        None => drop_camera_fixed(&mut images, &chosen, &dataset.rig.color, config)?,
    };
    let pairs = match_pairs(dataset, &images, chosen, config, progress)?;
    let (data, tracks) = correspondences(dataset, &images, &pairs, config, progress)?;
    if data.match_count() == 0 {
        let total = total_counts(&pairs);
        return Err(RunError::NoMatches {
            images: images.len(),
            keypoints: images.iter().map(|image| image.features.keypoints.len()).sum(),
            candidates: total.candidates,
            after_ratio: total.after_ratio.unwrap_or(total.candidates),
            matches: 0,
        });
    }
    Ok(Gathered { images, pairs, data, tracks, camera_fixed })
}
