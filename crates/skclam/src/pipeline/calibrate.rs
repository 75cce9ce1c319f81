//! The estimators behind one door: which one runs is a setting.

use super::{Config, Estimator, ImageFeatures, MatchedPair, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use skclam_calibration::{
    Calibration, Correspondences, NelderMeadOptions, PairMatch, PairMatches, PairwiseOptions, calibrate_nelder_mead,
    calibrate_pairwise,
};
use skclam_geometry::Pixel;

/// The matches as the estimators take them: pixels as measured.
pub fn correspondences(dataset: &Dataset, images: &[ImageFeatures], pairs: &[MatchedPair]) -> Correspondences {
    let pixel = |image: usize, keypoint: u32| {
        let keypoint = &images[image].features.keypoints[keypoint as usize];
        Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))
    };
    let of_pair = |matched: &MatchedPair| {
        let (a, b) = (matched.pair.a, matched.pair.b);
        let matches = matched
            .matches
            .iter()
            .map(|m| PairMatch { in_a: pixel(a, m.a), in_b: pixel(b, m.b), sigma_px: 1.0, distance: m.distance })
            .collect();
        PairMatches { a, b, matches }
    };
    Correspondences {
        postures: dataset.records.iter().map(|record| record.posture.clone()).collect(),
        pairs: pairs.iter().map(of_pair).collect(),
        tracks: Vec::new(),
        boards: Vec::new(),
    }
}

/// Estimates the rig.
pub fn calibrate(
    dataset: &Dataset,
    data: &Correspondences,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Calibration, RunError> {
    progress.begin(Stage::Calibrate, 1);
    let free = config.free.clone();
    let calibration = match config.estimator {
        Estimator::NelderMead => {
            calibrate_nelder_mead(&dataset.rig, data, &NelderMeadOptions { free, ..config.nelder_mead.clone() })?
        }
        Estimator::Sampson => {
            calibrate_pairwise(&dataset.rig, data, &PairwiseOptions { free, ..config.pairwise.clone() })?
        }
    };
    progress.step();
    Ok(calibration)
}
