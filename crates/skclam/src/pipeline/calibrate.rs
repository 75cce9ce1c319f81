//! The estimators behind one door: which one runs is a setting.

use super::{Config, Estimator, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use skclam_calibration::{
    BundleOptions, Calibration, Correspondences, NelderMeadOptions, PairwiseOptions, calibrate_bundle,
    calibrate_nelder_mead, calibrate_pairwise,
};

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
        Estimator::Bundle => calibrate_bundle(&dataset.rig, data, &BundleOptions { free, ..config.bundle.clone() })?,
        Estimator::Sampson => {
            calibrate_pairwise(&dataset.rig, data, &PairwiseOptions { free, ..config.pairwise.clone() })?
        }
    };
    progress.step();
    Ok(calibration)
}
