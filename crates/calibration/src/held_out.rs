//! How a calibration fares on postures that it was not fitted to.
//!
//! Only scene points and the board's pose are estimated anew; joint deviations are zero. Residuals are those of the sights in held-out
//! postures, of the tracks that touch them.

use crate::bundle::{NoiseScales, OUTLIER_SIGMAS, Observations, compare};
use crate::motion::Motion;
use crate::robust::median;
use crate::{
    BundleOptions, CalibrationError, Correspondences, EpipolarStatistics, Model, ReprojectionStatistics,
    calibrate_bundle, epipolar_statistics,
};
use serde::{Deserialize, Serialize};
use skclam_rig::Rig;

/// Residuals of two models on the same sights.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Comparison {
    /// Reprojection under the first model, over the sights that fit one of the two.
    pub nominal: ReprojectionStatistics,
    /// The same under the second.
    pub calibrated: ReprojectionStatistics,
    /// Epipolar distances of the pair matches with an end in the postures, first model.
    pub epipolar_nominal: EpipolarStatistics,
    /// The same, second model.
    pub epipolar_calibrated: EpipolarStatistics,
}

/// One fold: who was held out, and how the two rigs fare there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fold {
    /// Positions of the held-out postures.
    pub held_out: Vec<usize>,
    /// Nominal rig against the one fitted to all other postures.
    pub comparison: Comparison,
}

/// All folds.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CrossValidation {
    /// In the order of the groups.
    pub folds: Vec<Fold>,
    /// RMS over the sights of all folds under the nominal rig, px.
    pub nominal_rms_px: f64,
    /// The same under the rigs fitted without them.
    pub calibrated_rms_px: f64,
    /// Folds in which the calibrated rig is better.
    pub better_folds: usize,
}

/// `folds` runs of neighbouring postures of nearly equal length, which share more sights than scattered ones.
pub fn neighbouring_folds(postures: usize, folds: usize) -> Vec<Vec<usize>> {
    let folds = folds.clamp(1, postures.max(1));
    (0..folds).map(|fold| (fold * postures / folds..(fold + 1) * postures / folds).collect()).collect()
}

/// Compares two models on some postures. Sights count where one of the models fits them within 4.5 sigma (`sigma_px`, but at least 1 px).
pub fn compare_models(
    nominal: &Model,
    calibrated: &Model,
    data: &Correspondences,
    postures: &[usize],
    sigma_px: f64,
) -> Result<Comparison, CalibrationError> {
    data.check()?;
    let motion = Motion::new(&nominal.rig, &data.postures)?;
    let chosen = |posture: usize| postures.contains(&posture);
    let touching = Correspondences {
        postures: data.postures.clone(),
        tracks: data.tracks.iter().filter(|t| t.observations.iter().any(|o| chosen(o.posture))).cloned().collect(),
        pairs: data.pairs.iter().filter(|pair| chosen(pair.a) || chosen(pair.b)).cloned().collect(),
        boards: data.boards.iter().filter(|board| chosen(board.posture)).cloned().collect(),
    };
    let observations = Observations::new(&nominal.rig, &touching, &|_| true, &mut Vec::new())?;
    let noise = NoiseScales { pixel: sigma_px.max(1e-6), depth: 0.01, deviation: 1.0 };
    let (before, after) = compare(nominal, calibrated, &motion, &observations, noise)?;
    let gate = OUTLIER_SIGMAS * sigma_px.max(1.0);
    let pairs = before.sizes.iter().zip(&after.sizes).filter(|(b, _)| chosen(b.posture as usize));
    let (mut first, mut second, mut all) = (Vec::new(), Vec::new(), 0);
    for (b, a) in pairs {
        all += 1;
        if b.distance_px.min(a.distance_px) < gate && b.distance_px.is_finite() && a.distance_px.is_finite() {
            first.push(b.distance_px);
            second.push(a.distance_px);
        }
    }
    Ok(Comparison {
        nominal: statistics(&mut first, all),
        calibrated: statistics(&mut second, all),
        epipolar_nominal: epipolar_statistics(nominal, &touching)?,
        epipolar_calibrated: epipolar_statistics(calibrated, &touching)?,
    })
}

fn statistics(distances: &mut [f64], observations: usize) -> ReprojectionStatistics {
    let squares: f64 = distances.iter().map(|d| d * d).sum();
    ReprojectionStatistics {
        rms_px: (squares / distances.len().max(1) as f64).sqrt(),
        median_px: median(distances),
        observations,
        inliers: distances.len(),
    }
}

/// Fits to all postures but those of a group, group by group, and compares with the nominal rig on the group.
pub fn cross_validate(
    nominal: &Rig,
    data: &Correspondences,
    options: &BundleOptions,
    groups: &[Vec<usize>],
) -> Result<CrossValidation, CalibrationError> {
    data.check()?;
    let start = Model::new(nominal.clone());
    let mut result = CrossValidation::default();
    let (mut before, mut after, mut sights) = (0.0, 0.0, 0);
    for held_out in groups {
        if let Some(&got) = held_out.iter().find(|posture| **posture >= data.postures.len()) {
            let (what, count) = ("a group of held-out postures".to_owned(), data.postures.len());
            return Err(CalibrationError::NoSuchPosture { what, got, count });
        }
        let kept = |posture: usize| !held_out.contains(&posture);
        let mut rest = data.clone();
        rest.tracks.iter_mut().for_each(|track| track.observations.retain(|o| kept(o.posture)));
        rest.tracks.retain(|track| track.observations.len() >= 2);
        rest.pairs.retain(|pair| kept(pair.a) && kept(pair.b));
        rest.boards.retain(|board| kept(board.posture));
        let fitted = calibrate_bundle(nominal, &rest, options)?;
        let comparison = compare_models(&start, &fitted.model, data, held_out, fitted.noise.pixel)?;
        let count = comparison.nominal.inliers;
        before += comparison.nominal.rms_px.powi(2) * count as f64;
        after += comparison.calibrated.rms_px.powi(2) * count as f64;
        sights += count;
        result.better_folds += usize::from(comparison.calibrated.rms_px < comparison.nominal.rms_px);
        result.folds.push(Fold { held_out: held_out.clone(), comparison });
    }
    let count = sights.max(1) as f64;
    (result.nominal_rms_px, result.calibrated_rms_px) = ((before / count).sqrt(), (after / count).sqrt());
    Ok(result)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Free;
    use crate::synthetic::{diverse_postures, half_pixel, hp3j, manufacture, perturbed, record, room, seeded};

    #[test]
    fn held_out_postures_prefer_the_calibrated_rig_when_the_nominal_one_is_wrong() {
        let mut rng = seeded(21);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 24, &mut rng);
        let points = room(3000, &mut rng);
        let data = record(&truth, &postures, &points, half_pixel(), &mut rng);
        let groups = neighbouring_folds(24, 3);
        assert_eq!(groups.concat(), (0..24).collect::<Vec<_>>());
        let options = BundleOptions { deviations: crate::DeviationPolicy::Off, ..Default::default() };
        let result = cross_validate(&hp3j(), &data, &options, &groups).unwrap();
        assert_eq!(result.better_folds, 3);
        assert!(result.calibrated_rms_px < 1.0 && result.nominal_rms_px > 2.0, "{result:?}");
        // A nominal rig that is true is not beaten.
        let honest = cross_validate(&truth, &data, &options, &groups).unwrap();
        assert!(honest.calibrated_rms_px > 0.98 * honest.nominal_rms_px, "{honest:?}");
        assert!(cross_validate(&truth, &data, &options, &[vec![99]]).is_err());
    }
}
