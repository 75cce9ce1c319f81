//! How a calibration fares on postures that it was not fitted to.
//!
//! Only scene points and the board's pose are estimated anew; joint deviations are zero. Residuals are those of the sights in held-out
//! postures, of the tracks that touch them. Three rigs stand side by side: the nominal one, the nominal arm with its mount fitted, and the calibrated
//! one. A mount that was only a guess makes every calibration look good; whether the *arm* was worth calibrating shows beside the second.

use crate::bundle::{OUTLIER_SIGMAS, Observations, compare};
use crate::motion::Motion;
use crate::robust::median;
use crate::{
    Calibration, CalibrationError, Correspondences, EpipolarStatistics, Model, ReprojectionStatistics,
    epipolar_statistics,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_rig::Rig;

/// The same figure of the rigs that are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Rigs<T> {
    /// The nominal rig.
    pub nominal: T,
    /// The nominal arm with the mount fitted to the other postures; `None` where that was not asked for.
    pub mount_only: Option<T>,
    /// The calibrated rig.
    pub calibrated: T,
}

impl<T> Rigs<T> {
    /// The same for another figure.
    pub fn map<U>(self, figure: impl Fn(T) -> U) -> Rigs<U> {
        Rigs {
            nominal: figure(self.nominal),
            mount_only: self.mount_only.map(&figure),
            calibrated: figure(self.calibrated),
        }
    }

    fn as_ref(&self) -> Rigs<&T> {
        Rigs { nominal: &self.nominal, mount_only: self.mount_only.as_ref(), calibrated: &self.calibrated }
    }
}

/// Residuals of the models on the same sights.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Comparison {
    /// Reprojection over the sights that fit one of the models; no observations where there are neither tracks nor board corners.
    pub reprojection: Rigs<ReprojectionStatistics>,
    /// Epipolar distances of the pair matches with an end in the postures.
    pub epipolar: Rigs<EpipolarStatistics>,
}

/// One fold: who was held out, and how the rigs fare there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Fold {
    /// Positions of the held-out postures.
    pub held_out: Vec<usize>,
    /// The nominal rig against those fitted to all other postures.
    pub comparison: Comparison,
}

impl Fold {
    /// The figure by which rigs are judged, px: RMS of the reprojection, or the median epipolar distance where there are pairs alone.
    pub fn figure_px(&self) -> Rigs<f64> {
        if self.comparison.reprojection.calibrated.observations > 0 {
            self.comparison.reprojection.map(|statistics| statistics.rms_px)
        } else {
            self.comparison.epipolar.map(|statistics| statistics.median_px)
        }
    }
}

/// All folds.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CrossValidation {
    /// In the order of the groups.
    pub folds: Vec<Fold>,
    /// [`Fold::figure_px`] over all folds: RMS over their sights, or the mean of their medians.
    pub figure_px: Rigs<f64>,
    /// Folds in which the calibrated rig is better than the nominal one.
    pub better_folds: usize,
}

/// Fits a rig to correspondences.
pub type Estimate<'a> = dyn Fn(&Correspondences) -> Result<Calibration, CalibrationError> + Sync + 'a;

/// `folds` runs of neighbouring postures of nearly equal length, which share more sights than scattered ones.
pub fn neighbouring_folds(postures: usize, folds: usize) -> Vec<Vec<usize>> {
    let folds = folds.clamp(1, postures.max(1));
    (0..folds).map(|fold| (fold * postures / folds..(fold + 1) * postures / folds).collect()).collect()
}

/// Compares models on some postures. Sights count where one of the models fits them within 4.5 sigma (`sigma_px`, but at least 1 px).
pub fn compare_models(
    models: Rigs<&Model>,
    data: &Correspondences,
    postures: &[usize],
    sigma_px: f64,
) -> Result<Comparison, CalibrationError> {
    data.check()?;
    let motion = Motion::new(&models.nominal.rig, &data.postures)?;
    let chosen = |posture: usize| postures.contains(&posture);
    let touching = Correspondences {
        postures: data.postures.clone(),
        tracks: data.tracks.iter().filter(|t| t.observations.iter().any(|o| chosen(o.posture))).cloned().collect(),
        pairs: data.pairs.iter().filter(|pair| chosen(pair.a) || chosen(pair.b)).cloned().collect(),
        boards: data.boards.iter().filter(|board| chosen(board.posture)).cloned().collect(),
    };
    let epipolar = |model: &Model| epipolar_statistics(model, &touching);
    let mut comparison = Comparison {
        reprojection: Rigs {
            mount_only: models.mount_only.map(|_| ReprojectionStatistics::default()),
            ..Rigs::default()
        },
        epipolar: Rigs {
            nominal: epipolar(models.nominal)?,
            mount_only: models.mount_only.map(epipolar).transpose()?,
            calibrated: epipolar(models.calibrated)?,
        },
    };
    let observations = Observations::new(&models.nominal.rig, &touching, &|_| true, &mut Vec::new())?;
    if observations.sightings.is_empty() && observations.corners.is_empty() {
        return Ok(comparison);
    }
    let gate = OUTLIER_SIGMAS * sigma_px.max(1.0);
    let sights = |other: &Model| {
        let (others, calibrated) = compare(other, models.calibrated, &motion, &observations, sigma_px)?;
        let pairs = others.sizes.iter().zip(&calibrated.sizes).filter(|(size, _)| chosen(size.posture as usize));
        Ok::<_, CalibrationError>(pairs.map(|(o, c)| [o.distance_px(), c.distance_px()]).collect::<Vec<_>>())
    };
    let nominal = sights(models.nominal)?;
    let mount_only = models.mount_only.map(sights).transpose()?;
    let mut kept =
        Rigs { nominal: Vec::new(), mount_only: mount_only.as_ref().map(|_| Vec::new()), calibrated: Vec::new() };
    for (at, &[before, after]) in nominal.iter().enumerate() {
        let between = mount_only.as_ref().map(|sights| sights[at][0]);
        let finite = before.is_finite() && after.is_finite() && between.is_none_or(f64::is_finite);
        if finite && before.min(after).min(between.unwrap_or(after)) < gate {
            kept.nominal.push(before);
            kept.calibrated.push(after);
            if let (Some(list), Some(between)) = (&mut kept.mount_only, between) {
                list.push(between);
            }
        }
    }
    comparison.reprojection = kept.map(|mut distances| statistics(&mut distances, nominal.len()));
    Ok(comparison)
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

/// What is left of the correspondences without some postures.
pub fn without_postures(data: &Correspondences, held_out: &[usize]) -> Correspondences {
    let kept = |posture: usize| !held_out.contains(&posture);
    let mut rest = data.clone();
    rest.tracks.iter_mut().for_each(|track| track.observations.retain(|o| kept(o.posture)));
    rest.tracks.retain(|track| track.observations.len() >= 2);
    rest.pairs.retain(|pair| kept(pair.a) && kept(pair.b));
    rest.boards.retain(|board| kept(board.posture));
    rest
}

/// Fits to all postures but those of a group, group by group, and compares with the nominal rig on the group. `mount_only` fits the mount
/// alone; `done` is called after each group.
pub fn cross_validate(
    nominal: &Rig,
    data: &Correspondences,
    groups: &[Vec<usize>],
    estimate: &Estimate<'_>,
    mount_only: Option<&Estimate<'_>>,
    done: &(dyn Fn() + Sync),
) -> Result<CrossValidation, CalibrationError> {
    data.check()?;
    let start = Model::new(nominal.clone());
    let one = |held_out: &Vec<usize>| {
        if let Some(&got) = held_out.iter().find(|posture| **posture >= data.postures.len()) {
            let (what, count) = ("a group of held-out postures".to_owned(), data.postures.len());
            return Err(CalibrationError::NoSuchPosture { what, got, count });
        }
        let rest = without_postures(data, held_out);
        let (fitted, between) =
            rayon::join(|| estimate(&rest), || mount_only.map(|estimate| estimate(&rest)).transpose());
        let (fitted, between) = (fitted?, between?);
        let models = Rigs {
            nominal: &start,
            mount_only: between.as_ref().map(|calibration| &calibration.model),
            calibrated: &fitted.model,
        };
        let comparison = compare_models(models, data, held_out, fitted.noise.pixel)?;
        done();
        Ok(Fold { held_out: held_out.clone(), comparison })
    };
    let folds = groups.par_iter().map(one).collect::<Result<Vec<_>, CalibrationError>>()?;
    Ok(CrossValidation {
        figure_px: Rigs {
            nominal: joined(&folds, |rigs| Some(rigs.nominal)).unwrap_or_default(),
            mount_only: joined(&folds, |rigs| rigs.mount_only),
            calibrated: joined(&folds, |rigs| Some(rigs.calibrated)).unwrap_or_default(),
        },
        better_folds: folds.iter().map(Fold::figure_px).filter(|px| px.calibrated < px.nominal).count(),
        folds,
    })
}

/// A figure over all folds: root of the mean square over their sights, or the mean of their medians where there are pairs alone.
fn joined(folds: &[Fold], rig: impl Fn(Rigs<f64>) -> Option<f64>) -> Option<f64> {
    let weighted = folds.iter().map(|fold| {
        let inliers = fold.comparison.reprojection.as_ref().calibrated.inliers as f64;
        Some((rig(fold.figure_px())?, inliers))
    });
    let values = weighted.collect::<Option<Vec<(f64, f64)>>>()?;
    let sights: f64 = values.iter().map(|(_, inliers)| inliers).sum();
    Some(if sights > 0.0 {
        (values.iter().map(|(px, inliers)| px * px * inliers).sum::<f64>() / sights).sqrt()
    } else {
        values.iter().map(|(px, _)| px).sum::<f64>() / values.len().max(1) as f64
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        diverse_postures, fresh_pairs, half_pixel, hp3j, manufacture, perturbed, record, room, seeded,
    };
    use crate::{BundleOptions, DeviationPolicy, Free, MountComponent, Parameter, calibrate_bundle};

    fn estimate(nominal: &Rig, free: Free, data: &Correspondences) -> Result<Calibration, CalibrationError> {
        calibrate_bundle(nominal, data, &BundleOptions { free, deviations: DeviationPolicy::Off, ..Default::default() })
    }

    #[test]
    fn held_out_postures_prefer_the_calibrated_rig_when_the_nominal_one_is_wrong() {
        let mut rng = seeded(21);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 24, &mut rng);
        let points = room(3000, &mut rng);
        let data = record(&truth, &postures, &points, half_pixel(), &mut rng);
        let groups = neighbouring_folds(24, 3);
        assert_eq!(groups.concat(), (0..24).collect::<Vec<_>>());
        let mount = || Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec());
        let validate = |nominal: &Rig, groups: &[Vec<usize>]| {
            let mount_only = |data: &Correspondences| estimate(nominal, mount(), data);
            let all = |data: &Correspondences| estimate(nominal, Free::Auto, data);
            cross_validate(nominal, &data, groups, &all, Some(&mount_only), &|| {})
        };
        let result = validate(&hp3j(), &groups).unwrap();
        assert_eq!(result.better_folds, 3);
        let Rigs { nominal, mount_only, calibrated } = result.figure_px;
        let mount_only = mount_only.unwrap();
        assert!(
            calibrated < 1.0 && nominal > 2.0 && mount_only > 2.0 * calibrated && mount_only < nominal,
            "{result:?}"
        );
        // A nominal rig that is true is not beaten.
        let honest = validate(&truth, &groups).unwrap().figure_px;
        assert!(honest.calibrated > 0.98 * honest.nominal, "{honest:?}");
        assert!(validate(&truth, &[vec![99]]).is_err());

        // Pairs alone are judged by their epipolar distances.
        let neighbours: Vec<(usize, usize)> = (1..24).map(|b| (b - 1, b)).collect();
        let pairs = Correspondences {
            pairs: fresh_pairs(&truth, &data.postures, &neighbours, 30, half_pixel(), &mut rng),
            tracks: Vec::new(),
            ..data.clone()
        };
        let truth_model = Model::new(truth.clone());
        let nominal_model = Model::new(hp3j());
        let models = Rigs { nominal: &nominal_model, mount_only: None, calibrated: &truth_model };
        let comparison = compare_models(models, &pairs, &groups[1], 0.5).unwrap();
        assert_eq!(comparison.reprojection.calibrated.observations, 0);
        let fold = Fold { held_out: groups[1].clone(), comparison };
        assert!(fold.figure_px().calibrated < 0.5 * fold.figure_px().nominal, "{fold:?}");
    }
}
