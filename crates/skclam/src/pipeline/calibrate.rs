//! The estimators behind one door: which one runs is a setting.

use super::{Config, Estimator, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use skclam_calibration::{
    BundleOptions, Calibration, CalibrationError, Correspondences, Free, NelderMeadOptions, PairwiseOptions,
    calibrate_bundle, calibrate_nelder_mead, calibrate_pairwise,
};
use skclam_rig::Rig;

/// Estimates the rig.
pub fn calibrate(
    dataset: &Dataset,
    data: &Correspondences,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Calibration, RunError> {
    progress.begin(Stage::Calibrate, 1);
    let calibration = estimate(&dataset.rig, &config.free, data, config)?;
    progress.step();
    Ok(calibration)
}

/// The estimator that the configuration names, with some parameters free.
pub(super) fn estimate(
    nominal: &Rig,
    free: &Free,
    data: &Correspondences,
    config: &Config,
) -> Result<Calibration, CalibrationError> {
    let free = free.clone();
    match config.estimator {
        Estimator::NelderMead => {
            calibrate_nelder_mead(nominal, data, &NelderMeadOptions { free, ..config.nelder_mead.clone() })
        }
        Estimator::Bundle => calibrate_bundle(nominal, data, &BundleOptions { free, ..config.bundle.clone() }),
        Estimator::Sampson => calibrate_pairwise(nominal, data, &PairwiseOptions { free, ..config.pairwise.clone() }),
    }
}
