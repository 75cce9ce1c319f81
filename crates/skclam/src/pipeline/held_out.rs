//! Validation as the normal case: how the calibration fares on postures that it was not fitted to, in every run.

use super::{Config, RunError, calibrate::estimate};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    BundleOptions, Calibration, CalibrationError, Correspondences, CrossValidation, Fold, Free, Jackknife,
    MountComponent, Parameter, PostureErrorPolicy, Rigs, cross_validate, held_out_groups, jackknife,
};
use skclam_rig::Posture;

/// How much is held out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HeldOutOptions {
    /// Groups of arm positions that are held out in turn; fewer where there are fewer than two postures a group.
    pub folds: usize,
    /// Observations (and pair matches) that a fit takes at most, from tracks evenly over the recording; `None`: all.
    pub max_observations: Option<usize>,
}

impl Default for HeldOutOptions {
    fn default() -> Self {
        HeldOutOptions { folds: 6, max_observations: Some(10_000) }
    }
}

/// One group of postures that the fit did not see.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FoldSummary {
    /// The recording's indices of the held-out postures.
    pub postures: Vec<u64>,
    /// Their residuals, px; [`HeldOutSummary::metric`] says of which kind.
    pub metric_px: Rigs<f64>,
}

/// How the rigs fare on held-out postures.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeldOutSummary {
    /// "reprojection, RMS" or "epipolar distance, median".
    pub metric: String,
    /// The metric over all folds, px: the nominal rig, the nominal arm with its mount fitted, and the calibrated rig.
    pub metric_px: Rigs<f64>,
    /// Each fold.
    pub folds: Vec<FoldSummary>,
    /// Folds in which the calibrated rig is better than the nominal one.
    pub better_folds: usize,
    /// What the scatter of the folds' fits says of the covariance, which was widened by it; `null` where there is no
    /// covariance.
    pub jackknife: Option<Jackknife>,
}

impl HeldOutSummary {
    /// Whether the calibrated rig is better than the nominal one on postures that it was not fitted to.
    pub fn beats_nominal(&self) -> bool {
        self.metric_px.calibrated < self.metric_px.nominal
    }

    /// Whether the arm was worth calibrating: better than with the mount alone. `None` where that was not measured.
    pub fn beats_mount_only(&self) -> Option<bool> {
        self.metric_px.mount_only.map(|mount_only| self.metric_px.calibrated < mount_only)
    }

    fn of(validation: &CrossValidation, dataset: &Dataset, jackknife: Option<Jackknife>) -> Self {
        let reprojection = |fold: &Fold| fold.comparison.reprojection.calibrated.observations > 0;
        let metric =
            if validation.folds.iter().any(reprojection) { "reprojection, RMS" } else { "epipolar distance, median" };
        let folds = validation.folds.iter().map(|fold| FoldSummary {
            postures: fold.held_out.iter().map(|&position| dataset.records[position].posture.index).collect(),
            metric_px: fold.metric_px(),
        });
        HeldOutSummary {
            metric: metric.to_owned(),
            metric_px: validation.metric_px,
            folds: folds.collect(),
            better_folds: validation.better_folds,
            jackknife,
        }
    }
}

/// Postures that a group has at least.
pub(super) const POSTURES_A_FOLD: usize = 2;

/// Holds out groups of neighbouring postures in turn. The reason in words where it cannot be done.
pub fn hold_out(
    dataset: &Dataset,
    data: &Correspondences,
    whole: &Calibration,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Result<HeldOutSummary, String>, RunError> {
    let Some(options) = &config.held_out else { return Ok(Err("it was switched off".to_owned())) };
    let folds = options.folds.min(dataset.len() / POSTURES_A_FOLD);
    if folds < 2 {
        return Ok(Err(format!("{} postures are too few to leave some out", dataset.len())));
    }
    progress.begin(Stage::HoldOut, folds as u64);
    let postures: Vec<Posture> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let groups = held_out_groups(&postures, folds);
    let thin = thinned(data, options.max_observations);
    let stop = || if progress.stop_requested() { Err(CalibrationError::Interrupted) } else { Ok(()) };
    let all = |data: &Correspondences| stop().and_then(|()| estimate(&dataset.rig, &config.free, data, config));
    let mount = Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec());
    // Errors of single postures would take up what is wrong with the arm, and they are zero on held-out postures
    // anyway.
    let bundle = BundleOptions { posture_errors: PostureErrorPolicy::Off, ..config.bundle.clone() };
    let rigid = Config { bundle, ..config.clone() };
    let mount_only = |data: &Correspondences| stop().and_then(|()| estimate(&dataset.rig, &mount, data, &rigid));
    // With flange poses the mount and the camera are all that is free: there is no arm to judge.
    let arm_is_free = dataset.has_joints() && config.free != mount;
    let between: Option<&skclam_calibration::Estimate<'_>> = if arm_is_free { Some(&mount_only) } else { None };
    match cross_validate(&dataset.rig, &thin, &groups, &all, between, &|| progress.step()) {
        Ok(validation) => {
            // The folds were fitted to a part of the observations: their scatter belongs beside what the same part
            // claims.
            let same = if thin == *data { Ok(whole.clone()) } else { all(&thin) };
            let scatter = match same {
                Ok(same) => jackknife(&dataset.rig, &same, &validation.folds, &postures)?,
                Err(CalibrationError::Interrupted) => return Err(RunError::Interrupted),
                Err(_) => None,
            };
            Ok(Ok(HeldOutSummary::of(&validation, dataset, scatter)))
        }
        Err(CalibrationError::Interrupted) => Err(RunError::Interrupted),
        // The whole recording was enough, a part of it was not: no reason to lose the calibration.
        Err(error) => Ok(Err(format!("without some of the postures there is too little to fit: {error}"))),
    }
}

/// Whole tracks evenly over the recording, and as large a part of the pair matches.
pub(super) fn thinned(data: &Correspondences, max_observations: Option<usize>) -> Correspondences {
    let mut thin = data.clone();
    let Some(limit) = max_observations else { return thin };
    let keep = |fraction: f64| {
        let mut at = 0.0f64;
        move || {
            let before = at.floor();
            at += fraction;
            at.floor() > before
        }
    };
    if data.observation_count() > limit {
        let mut kept = keep(limit as f64 / data.observation_count() as f64);
        thin.tracks.retain(|_| kept());
    }
    if data.match_count() > limit {
        let mut kept = keep(limit as f64 / data.match_count() as f64);
        thin.pairs.iter_mut().for_each(|pair| pair.matches.retain(|_| kept()));
    }
    thin
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix2;
    use skclam_calibration::{PairMatch, PairMatches, Track, TrackObservation};
    use skclam_geometry::Pixel;

    #[test]
    fn thinning_keeps_whole_tracks_and_the_fraction_of_the_matches() {
        let observation = |posture| TrackObservation {
            posture,
            pixel: Pixel::origin(),
            covariance: Matrix2::identity(),
            depth_m: None,
            depth_slope: [0.0; 2],
        };
        let pair_match = PairMatch { in_a: Pixel::origin(), in_b: Pixel::origin(), sigma_px: 1.0, distance: 0 };
        let data = Correspondences {
            tracks: vec![Track { observations: (0..4).map(observation).collect() }; 100],
            pairs: vec![PairMatches { a: 0, b: 1, matches: vec![pair_match; 50] }; 4],
            ..Default::default()
        };
        let thin = thinned(&data, Some(100));
        assert_eq!((thin.observation_count(), thin.match_count()), (100, 100));
        assert!(thin.pairs.iter().all(|pair| pair.matches.len() == 25));
        assert_eq!(thinned(&data, None), data);
        assert_eq!(thinned(&data, Some(1000)), data);
    }
}
