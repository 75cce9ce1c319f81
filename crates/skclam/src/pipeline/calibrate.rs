//! The estimators behind one door: which one runs is a setting.

use super::held_out::{POSTURES_A_FOLD, thinned};
use super::{Config, Estimator, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use skclam_calibration::{
    BundleOptions, Calibration, CalibrationError, Correspondences, DeviationPolicy, Free, NelderMeadOptions,
    PairwiseOptions, Warning, calibrate_bundle, calibrate_nelder_mead, calibrate_pairwise, cross_validate,
    neighbouring_folds,
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
        Estimator::Bundle => bundle(nominal, data, &BundleOptions { free, ..config.bundle.clone() }, config),
        Estimator::Sampson => calibrate_pairwise(nominal, data, &PairwiseOptions { free, ..config.pairwise.clone() }),
    }
}

/// Encoders and backlash of an industrial arm stay below this, degrees.
const PLAUSIBLE_DEVIATION_DEG: f64 = 0.01;

/// The bundle adjustment. Deviations whose sigma is estimated are a claim: they can swallow errors of the arm that they have nothing to do with,
/// above all with few positions of the arm. Where they come out larger than encoders deviate, postures that are held out decide between them and none: a
/// rig must predict with joints at their word.
fn bundle(
    nominal: &Rig,
    data: &Correspondences,
    options: &BundleOptions,
    config: &Config,
) -> Result<Calibration, CalibrationError> {
    let with = calibrate_bundle(nominal, data, options)?;
    let estimated = options.deviations == DeviationPolicy::Estimated && nominal.prior.joint_deviation_deg.is_none();
    let sigma_deg = with.noise.joint_deviation.unwrap_or(0.0).to_degrees();
    if !estimated || sigma_deg <= PLAUSIBLE_DEVIATION_DEG {
        return Ok(with);
    }
    let held_out = config.held_out.clone().unwrap_or_default();
    let thin = thinned(data, held_out.max_sightings);
    let seen = seen_postures(&thin);
    let groups: Vec<Vec<usize>> = neighbouring_folds(seen.len(), held_out.folds.min(seen.len() / POSTURES_A_FOLD))
        .into_iter()
        .map(|group| group.into_iter().map(|at| seen[at]).collect())
        .collect();
    let off = BundleOptions { deviations: DeviationPolicy::Off, ..options.clone() };
    let as_estimated = |data: &Correspondences| calibrate_bundle(nominal, data, options);
    let as_exact = |data: &Correspondences| calibrate_bundle(nominal, data, &off);
    // The rig without deviations takes the place of the one whose mount alone is fitted.
    let (with_px, without_px) = match cross_validate(nominal, &thin, &groups, &as_estimated, Some(&as_exact), &|| {}) {
        Ok(judged) if groups.len() >= 2 => (Some(judged.figure_px.calibrated), judged.figure_px.mount_only),
        Ok(_) => (None, None),
        Err(CalibrationError::Interrupted) => return Err(CalibrationError::Interrupted),
        // The whole recording was enough, a part of it was not.
        Err(_) => (None, None),
    };
    if let (Some(with_px), Some(without_px)) = (with_px, without_px)
        && with_px < without_px
    {
        return Ok(with);
    }
    let mut without = calibrate_bundle(nominal, data, &off)?;
    without.warnings.push(Warning::DeviationsRefused { sigma_deg, with_px, without_px });
    Ok(without)
}

/// Postures that tracks or corners see.
fn seen_postures(data: &Correspondences) -> Vec<usize> {
    let mut seen: Vec<usize> = data.boards.iter().map(|board| board.posture).collect();
    seen.extend(data.tracks.iter().flat_map(|track| track.observations.iter().map(|sight| sight.posture)));
    seen.sort_unstable();
    seen.dedup();
    seen
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_calibration::{BoardObservation, Track, TrackObservation, isotropic_covariance};
    use skclam_geometry::Pixel;

    #[test]
    fn postures_count_that_anything_sees() {
        let sight = |posture| TrackObservation {
            posture,
            pixel: Pixel::origin(),
            covariance: isotropic_covariance(1.0),
            depth_m: None,
        };
        let data = Correspondences {
            boards: vec![BoardObservation { posture: 4, corners: Vec::new(), sigma_px: 1.0 }],
            tracks: vec![Track { observations: vec![sight(7), sight(1)] }, Track { observations: vec![sight(1)] }],
            ..Default::default()
        };
        assert_eq!(seen_postures(&data), [1, 4, 7]);
        assert!(seen_postures(&Correspondences::default()).is_empty());
    }
}
