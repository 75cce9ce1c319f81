//! How a calibration fares on postures that it was not fitted to.
//!
//! A group of postures is held out, the rig is fitted to the others, and the observations of the group are compared
//! with where the fitted rig expects them: the scene and the board lie where the *other* postures saw them, joint
//! values are taken as exact, nothing is fitted to the group. Groups are arm positions ([`held_out_groups`]): images
//! that were taken from one position share its errors, and a scene that is laid anew takes up what they have in common,
//! so that the error of the arm would vanish from the metric. Three rigs are compared: the nominal one, the nominal arm
//! with its mount fitted, and the calibrated one.
//!
//! The fits are a delete-a-group jackknife too ([`jackknife`]; Efron and Stein, "The jackknife estimate of variance",
//! 1981): their scatter gives the covariance without any model of the noise.

use crate::bundle::{OUTLIER_SIGMAS, Predicted, predicted_distances};
use crate::pose_covariance::AlignedVariance;
use crate::robust::median;
use crate::{
    Calibration, CalibrationError, Correspondences, EpipolarStatistics, Model, Parameter, ReprojectionStatistics,
    epipolar_statistics,
};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_rig::{Posture, PostureState, Rig};

/// The same metric of the rigs that are compared.
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
    /// The same for another metric.
    pub fn map<U>(self, metric: impl Fn(T) -> U) -> Rigs<U> {
        Rigs {
            nominal: metric(self.nominal),
            mount_only: self.mount_only.map(&metric),
            calibrated: metric(self.calibrated),
        }
    }

    fn as_ref(&self) -> Rigs<&T> {
        Rigs { nominal: &self.nominal, mount_only: self.mount_only.as_ref(), calibrated: &self.calibrated }
    }
}

/// Residuals of the models on the same observations.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Comparison {
    /// Reprojection over the observations that fit one of the models; no observations where there are neither tracks
    /// nor board corners.
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
    /// The free parameters of the fit less their nominal values, in their order and units.
    pub offsets: Vec<f64>,
    /// Normal matrix of the data that the fit had by the free parameters, everything else eliminated; `None` but for
    /// the bundle adjustment.
    #[serde(skip)]
    pub normal: Option<DMatrix<f64>>,
}

impl Fold {
    /// The metric by which rigs are judged, px.
    pub fn metric_px(&self) -> Rigs<f64> {
        self.comparison.metric_px()
    }
}

impl Comparison {
    /// The metric by which rigs are judged, px: RMS of the reprojection, or the median epipolar distance where there
    /// are pairs alone.
    pub fn metric_px(&self) -> Rigs<f64> {
        if self.reprojection.calibrated.observations > 0 {
            self.reprojection.map(|statistics| statistics.rms_px)
        } else {
            self.epipolar.map(|statistics| statistics.median_px)
        }
    }
}

/// All folds.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CrossValidation {
    /// In the order of the groups.
    pub folds: Vec<Fold>,
    /// [`Fold::metric_px`] over all folds: RMS over their observations, or the mean of their medians.
    pub metric_px: Rigs<f64>,
    /// Folds in which the calibrated rig is better than the nominal one.
    pub better_folds: usize,
}

/// Fits a rig to correspondences.
pub type Estimate<'a> = dyn Fn(&Correspondences) -> Result<Calibration, CalibrationError> + Sync + 'a;

/// `folds` runs of neighbouring postures of nearly equal length.
pub fn neighbouring_folds(postures: usize, folds: usize) -> Vec<Vec<usize>> {
    let folds = folds.clamp(1, postures.max(1));
    (0..folds).map(|fold| (fold * postures / folds..(fold + 1) * postures / folds).collect()).collect()
}

/// Joints nearer than this to each other (rad, or m) count as one place.
const ONE_PLACE: f64 = 9e-3;

/// Which arm position each posture belongs to, counted in the order of the recording: postures whose joints of the base
/// half (the first three of six) are at one place share what is off there. Flange poses are positions of their own.
pub fn arm_positions(postures: &[Posture]) -> Vec<usize> {
    let mut known: Vec<(usize, &[f64])> = Vec::new();
    let mut next = 0;
    let mut positions = Vec::with_capacity(postures.len());
    for posture in postures {
        let own = match &posture.state {
            PostureState::Joints(values) => &values[..values.len().div_ceil(2)],
            PostureState::FlangePose(_) => &[],
        };
        let near = |other: &[f64]| {
            !own.is_empty() && other.len() == own.len() && other.iter().zip(own).all(|(a, b)| (a - b).abs() < ONE_PLACE)
        };
        let position = known.iter().find(|(_, other)| near(other)).map(|(position, _)| *position);
        positions.push(position.unwrap_or(next));
        if position.is_none() {
            known.push((next, own));
            next += 1;
        }
    }
    positions
}

/// Groups of postures to be held out in turn: whole arm positions, neighbours in the recording, in at most `folds`
/// groups of about equal size.
pub fn held_out_groups(postures: &[Posture], folds: usize) -> Vec<Vec<usize>> {
    let position = arm_positions(postures);
    let count = position.iter().max().map_or(0, |last| last + 1);
    if count < 2 {
        return neighbouring_folds(postures.len(), folds);
    }
    let folds = folds.clamp(1, count);
    let mut groups = vec![Vec::new(); folds];
    let sizes: Vec<usize> = (0..count).map(|at| position.iter().filter(|p| **p == at).count()).collect();
    let mut before = 0;
    for (at, size) in sizes.iter().enumerate() {
        // The middle of the position among all postures decides its group.
        let group = ((2 * before + size) * folds / (2 * postures.len())).min(folds - 1);
        groups[group].extend((0..postures.len()).filter(|&posture| position[posture] == at));
        before += size;
    }
    groups.retain(|group: &Vec<usize>| !group.is_empty());
    groups
}

/// How two rigs fare on a recording that neither was fitted to.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordingComparison {
    /// `nominal`: the rig to compare with; `calibrated`: the one under test.
    pub comparison: Comparison,
    /// The same posture by posture, for those with observations: position, and RMS of the reprojection of each rig, px.
    pub postures: Vec<(usize, Rigs<f64>)>,
}

/// Compares two rigs on a recording that neither was fitted to. Each group of arm positions is compared with the scene
/// and the board where the *others* saw them under the same rig, so that errors of the arm cannot vanish into the
/// scene.
pub fn compare_on_recording(
    nominal: &Model,
    tested: &Model,
    data: &Correspondences,
    groups: &[Vec<usize>],
    sigma_px: f64,
) -> Result<RecordingComparison, CalibrationError> {
    data.check()?;
    let of = |model: &Model| -> Result<Vec<Predicted>, CalibrationError> {
        Ok(groups
            .iter()
            .map(|group| predicted_distances(model, &[], data, group))
            .collect::<Result<Vec<_>, _>>()?
            .concat())
    };
    let (before, after) = (of(nominal)?, of(tested)?);
    let distances = |list: &[Predicted]| list.iter().map(|one| one.distance_px).collect::<Vec<f64>>();
    let (before_px, after_px) = (distances(&before), distances(&after));
    let rigs = Rigs { nominal: &before_px[..], mount_only: None, calibrated: &after_px[..] };
    let kept = fitting_one(rigs, sigma_px);
    let mut postures = Vec::new();
    for posture in 0..data.postures.len() {
        let own: Vec<usize> = kept.iter().copied().filter(|&at| after[at].posture == posture).collect();
        let rms = |list: &[f64]| (own.iter().map(|&at| list[at].powi(2)).sum::<f64>() / own.len() as f64).sqrt();
        if !own.is_empty() {
            postures.push((posture, Rigs { nominal: rms(&before_px), mount_only: None, calibrated: rms(&after_px) }));
        }
    }
    let epipolar = Rigs {
        nominal: epipolar_statistics(nominal, data)?,
        mount_only: None,
        calibrated: epipolar_statistics(tested, data)?,
    };
    Ok(RecordingComparison { comparison: Comparison { reprojection: over(rigs, &kept), epipolar }, postures })
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

/// A rig as it was fitted, with what it says of the postures that it was fitted to.
#[derive(Debug, Clone, Copy)]
pub struct Trained<'a> {
    /// The rig.
    pub model: &'a Model,
    /// Errors of the single postures, one after another ([`Calibration::posture_errors`]); empty for none.
    pub posture_errors: &'a [f64],
}

/// Compares rigs on held-out postures, with scene and board where each rig's other postures saw them. Observations
/// count where one of the rigs fits them, beside a gate that follows their median.
pub fn compare_trained(
    rigs: Rigs<Trained<'_>>,
    data: &Correspondences,
    held_out: &[usize],
    sigma_px: f64,
) -> Result<Comparison, CalibrationError> {
    data.check()?;
    let touching = Correspondences {
        postures: data.postures.clone(),
        pairs: data.pairs.iter().filter(|p| held_out.contains(&p.a) || held_out.contains(&p.b)).cloned().collect(),
        ..Default::default()
    };
    let epipolar = |trained: Trained<'_>| epipolar_statistics(trained.model, &touching);
    let distances = |trained: Trained<'_>| -> Result<Vec<f64>, CalibrationError> {
        let predicted = predicted_distances(trained.model, trained.posture_errors, data, held_out)?;
        Ok(predicted.into_iter().map(|one| one.distance_px).collect())
    };
    let nominal = distances(rigs.nominal)?;
    let mount_only = rigs.mount_only.map(distances).transpose()?;
    let calibrated = distances(rigs.calibrated)?;
    let all = Rigs { nominal: &nominal[..], mount_only: mount_only.as_deref(), calibrated: &calibrated[..] };
    Ok(Comparison {
        reprojection: over(all, &fitting_one(all, sigma_px)),
        epipolar: Rigs {
            nominal: epipolar(rigs.nominal)?,
            mount_only: rigs.mount_only.map(epipolar).transpose()?,
            calibrated: epipolar(rigs.calibrated)?,
        },
    })
}

/// Which of the same observations (distances infinite where nothing is expected) fit one of the rigs.
fn fitting_one(distances: Rigs<&[f64]>, sigma_px: f64) -> Vec<usize> {
    let of = |at: usize| {
        let between = distances.mount_only.map(|list| list[at]);
        (distances.nominal[at], between, distances.calibrated[at])
    };
    let known = |at: &usize| {
        let (nominal, between, calibrated) = of(*at);
        nominal.is_finite() && calibrated.is_finite() && between.is_none_or(f64::is_finite)
    };
    let known: Vec<usize> = (0..distances.calibrated.len()).filter(known).collect();
    let best = |at: usize| {
        let (nominal, between, calibrated) = of(at);
        nominal.min(calibrated).min(between.unwrap_or(calibrated))
    };
    let middle = median(&mut known.iter().map(|&at| best(at)).collect::<Vec<_>>());
    // The median of the norm of a two-dimensional normal is 1.18 sigma.
    let gate = OUTLIER_SIGMAS * sigma_px.max(1.0).max(middle / 1.18);
    known.into_iter().filter(|&at| best(at) < gate).collect()
}

fn over(distances: Rigs<&[f64]>, kept: &[usize]) -> Rigs<ReprojectionStatistics> {
    let total = distances.calibrated.len();
    let of = |list: &[f64]| statistics(&mut kept.iter().map(|&at| list[at]).collect::<Vec<_>>(), total);
    Rigs {
        nominal: of(distances.nominal),
        mount_only: distances.mount_only.map(of),
        calibrated: of(distances.calibrated),
    }
}

/// Fits to all postures but those of a group, group by group, and compares with the nominal rig on the group.
/// `mount_only` fits the mount alone; `done` is called after each group.
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
        let errors = |calibration: &Calibration| calibration.posture_errors.concat();
        let (own, of_mount) = (errors(&fitted), between.as_ref().map(errors).unwrap_or_default());
        let rigs = Rigs {
            nominal: Trained { model: &start, posture_errors: &[] },
            mount_only: between.as_ref().map(|fit| Trained { model: &fit.model, posture_errors: &of_mount }),
            calibrated: Trained { model: &fitted.model, posture_errors: &own },
        };
        let comparison = compare_trained(rigs, data, held_out, fitted.noise.pixel)?;
        let offsets = fitted.parameters.iter().map(|estimate| estimate.value - estimate.nominal).collect();
        let normal = fitted.posterior.as_ref().map(|inputs| inputs.likelihood.normal.clone());
        done();
        Ok(Fold { held_out: held_out.clone(), comparison, offsets, normal })
    };
    let folds = groups.par_iter().map(one).collect::<Result<Vec<_>, CalibrationError>>()?;
    Ok(CrossValidation {
        metric_px: Rigs {
            nominal: joined(&folds, |rigs| Some(rigs.nominal)).unwrap_or_default(),
            mount_only: joined(&folds, |rigs| rigs.mount_only),
            calibrated: joined(&folds, |rigs| Some(rigs.calibrated)).unwrap_or_default(),
        },
        better_folds: folds.iter().map(Fold::metric_px).filter(|px| px.calibrated < px.nominal).count(),
        folds,
    })
}

/// What the scatter of the folds' fits says of the covariance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Jackknife {
    /// Sigma of the camera's position over the recorded postures, the base frame fitted to them, as the scatter of the
    /// folds' fits has it, m.
    pub scattered_m: f64,
    /// The same as the covariance claims it, without the standard of length, which all folds share.
    pub claimed_m: f64,
    /// By how much the variance of the observations has to be larger, so that the covariance claims no less than the
    /// scatter; 1 where the scatter is not larger than the claim by more than chance makes it once in a hundred times.
    pub variance_factor: f64,
}

/// No group is taken for a larger part of the information.
const MAX_OF_THE_INFORMATION: f64 = 0.7;

/// The delete-a-group jackknife over the folds' fits (groups that weigh more than their number: Busing, Meijer and van
/// der Leeden, "Delete-m jackknife for unequal m", 1999), beside what the covariance of `whole` (the same estimate on
/// all of the same data) claims. `None` without a covariance of the bundle adjustment, or with fewer than three folds.
pub fn jackknife(
    nominal: &Rig,
    whole: &Calibration,
    folds: &[Fold],
    postures: &[Posture],
) -> Result<Option<Jackknife>, CalibrationError> {
    let (Some(claimed), Some(inputs)) = (whole.covariance_without_ruler(), &whole.posterior) else { return Ok(None) };
    let parameters: Vec<Parameter> = whole.parameters.iter().map(|estimate| estimate.parameter).collect();
    if folds.len() < 3 || folds.iter().any(|fold| fold.offsets.len() != parameters.len()) {
        return Ok(None);
    }
    let count = folds.len() as f64;
    let offsets = |fold: &Fold| DVector::from_column_slice(&fold.offsets);
    let mean = folds.iter().map(offsets).sum::<DVector<f64>>() / count;
    // A group takes tracks with it that it shared with others: what it has of the information is more than its part of
    // the postures. Sigmas that are estimated anew in each fold make single parts uncertain, so that their mean counts,
    // which cannot be less than that of equal groups.
    let information = |normal: &DMatrix<f64>| claimed.component_mul(normal).sum();
    let all = information(&inputs.likelihood.normal);
    let parts = folds.iter().filter_map(|fold| fold.normal.as_ref()).map(|normal| 1.0 - information(normal) / all);
    let part = (parts.sum::<f64>() / count).clamp(1.0 / count, MAX_OF_THE_INFORMATION);
    let mut scatter = DMatrix::zeros(parameters.len(), parameters.len());
    for fold in folds {
        let away = offsets(fold) - &mean;
        scatter += &away * away.transpose() * ((1.0 / part - 1.0) / count);
    }
    let aligned = AlignedVariance::new(nominal, &whole.model, &parameters, postures)?;
    let dof = aligned.degrees_of_freedom(&claimed) * (count - 1.0);
    let (scattered, claimed) = (aligned.of(&scatter), aligned.of(&claimed));
    if !(scattered.is_finite() && claimed > 0.0) {
        return Ok(None);
    }
    let at = |factor: f64| -> f64 {
        let Some(known) = inputs.tempered(factor).posterior() else { return f64::INFINITY };
        let of_ruler = known
            .ruler
            .map(|ruler| ruler.covariance * (ruler.sigma.powi(2) / (ruler.sigma.powi(2) + ruler.away_squared)));
        aligned.of(&match of_ruler {
            Some(part) => known.own - part,
            None => known.own,
        })
    };
    let mut factor = 1.0;
    if scattered > claimed * chance_ratio(dof) {
        // A variance that few groups determine makes of a normal distribution one of Student's, which is wider: by this factor of the variance (Cameron and Miller, "A
        // practitioner's guide to cluster-robust inference", 2015, section VI).
        let scattered = scattered * (count - 1.0) / (count - 3.0).max(0.5);
        // The claim grows with the factor until the priors alone hold it.
        let (mut low, mut high) = (0.0, MAX_FACTOR.ln());
        for _ in 0..30 {
            let middle: f64 = 0.5 * (low + high);
            if at(middle.exp()) < scattered { low = middle } else { high = middle }
        }
        factor = high.exp();
    }
    Ok(Some(Jackknife { scattered_m: scattered.sqrt(), claimed_m: claimed.sqrt(), variance_factor: factor }))
}

/// Ratio of an estimated variance of so many degrees of freedom to the true one that chance alone exceeds once in a
/// hundred times (Wilson and Hilferty 1931).
fn chance_ratio(dof: f64) -> f64 {
    const QUANTILE: f64 = 2.326;
    let spread = 2.0 / (9.0 * dof.max(1.0));
    (1.0 - spread + QUANTILE * spread.sqrt()).powi(3)
}

/// Observations that are worth less than by this factor of their variance carry no information.
const MAX_FACTOR: f64 = 1e4;

/// A metric over all folds: root of the mean square over their observations, or the mean of their medians where there
/// are pairs alone.
fn joined(folds: &[Fold], rig: impl Fn(Rigs<f64>) -> Option<f64>) -> Option<f64> {
    let weighted = folds.iter().map(|fold| {
        let inliers = fold.comparison.reprojection.as_ref().calibrated.inliers as f64;
        Some((rig(fold.metric_px())?, inliers))
    });
    let values = weighted.collect::<Option<Vec<(f64, f64)>>>()?;
    let observations: f64 = values.iter().map(|(_, inliers)| inliers).sum();
    Some(if observations > 0.0 {
        (values.iter().map(|(px, inliers)| px * px * inliers).sum::<f64>() / observations).sqrt()
    } else {
        values.iter().map(|(px, _)| px).sum::<f64>() / values.len().max(1) as f64
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        Sensing, box_points, diverse_postures, fresh_pairs, half_pixel, hp3j, joints, manufacture, normal, perturbed,
        record, seeded,
    };
    use crate::{BundleOptions, Free, MountComponent, Parameter, PostureErrorPolicy, calibrate_bundle};
    use rand::RngExt;

    fn estimate(nominal: &Rig, free: Free, data: &Correspondences) -> Result<Calibration, CalibrationError> {
        calibrate_bundle(
            nominal,
            data,
            &BundleOptions { free, posture_errors: PostureErrorPolicy::Off, ..Default::default() },
        )
    }

    #[test]
    fn held_out_postures_prefer_the_calibrated_rig_when_the_nominal_one_is_wrong() {
        let mut rng = seeded(21);
        let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&hp3j(), 24, &mut rng);
        let points = box_points(3000, &mut rng);
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
        let Rigs { nominal, mount_only, calibrated } = result.metric_px;
        let mount_only = mount_only.unwrap();
        // Half a pixel of each coordinate, and the points where a few other images saw them.
        assert!(
            calibrated < 1.3 && nominal > 2.0 && mount_only > 2.0 * calibrated && mount_only < nominal,
            "{result:?}"
        );
        // A nominal rig that is true is not beaten.
        let honest = validate(&truth, &groups).unwrap().metric_px;
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
        let RecordingComparison { comparison, .. } =
            compare_on_recording(&nominal_model, &truth_model, &pairs, &groups, 0.5).unwrap();
        assert_eq!(comparison.reprojection.calibrated.observations, 0);
        let fold = Fold { held_out: groups[1].clone(), comparison, offsets: Vec::new(), normal: None };
        assert!(fold.metric_px().calibrated < 0.5 * fold.metric_px().nominal, "{fold:?}");
    }

    fn postures_of(values: &[[f64; 6]]) -> Vec<Posture> {
        values.iter().enumerate().map(|(at, values)| joints(at, values)).collect()
    }

    #[test]
    fn positions_are_given_by_the_joints_before_the_wrist() {
        let at = |arm: f64, wrist: f64| [arm, 0.2, -0.3, wrist, -wrist, 1.0];
        // The second position is visited twice; a tenth of a degree is the same place, a degree is not.
        let postures =
            postures_of(&[at(0.0, 0.1), at(0.5, 0.2), at(0.002, 0.9), at(0.51, 0.1), at(0.5175, 0.3), at(0.5, 2.0)]);
        assert_eq!(arm_positions(&postures), [0, 1, 0, 2, 2, 1]);
        let flange = PostureState::FlangePose(skclam_geometry::Isometry3::identity());
        let poses = [0, 1, 2].map(|at| Posture::new(at, flange.clone()));
        assert_eq!(arm_positions(&poses), [0, 1, 2]);
    }

    #[test]
    fn groups_hold_out_whole_positions() {
        let of = |position: usize, wrist: usize| [0.3 * position as f64, 0.0, 0.0, 0.1 * wrist as f64, 0.0, 0.0];
        let postures = postures_of(&(0..24).map(|at| of(at / 4, at % 4)).collect::<Vec<_>>());
        assert_eq!(held_out_groups(&postures, 6), neighbouring_folds(24, 6));
        assert_eq!(held_out_groups(&postures, 3), neighbouring_folds(24, 3));
        assert_eq!(held_out_groups(&postures, 99).len(), 6, "no more groups than positions");
        // Positions taken in turn are held out together all the same, each posture once.
        let mixed = postures_of(&(0..24).map(|at| of(at % 6, at / 6)).collect::<Vec<_>>());
        let groups = held_out_groups(&mixed, 3);
        let positions = arm_positions(&mixed);
        let mut all = groups.concat();
        all.sort_unstable();
        assert_eq!(all, (0..24).collect::<Vec<_>>());
        for position in 0..6 {
            let holding = groups.iter().filter(|group| group.iter().any(|&posture| positions[posture] == position));
            assert_eq!(holding.count(), 1, "{groups:?}");
        }
        // One position alone: neighbours.
        let one = postures_of(&(0..8).map(|at| of(0, at)).collect::<Vec<_>>());
        assert_eq!(held_out_groups(&one, 4), neighbouring_folds(8, 4));
    }

    /// Mean over some recordings of the squared ratio of what the folds' fits scatter to what is claimed, and the mean
    /// factor of the variance. Six positions of four postures; `shared`: sigma of what the three joints before the
    /// wrist are off at a whole position, `own`: of every joint in every posture, rad.
    fn jackknifed(shared: f64, own: f64, seeds: std::ops::Range<u64>) -> [f64; 2] {
        let runs = seeds.end - seeds.start;
        let one = |seed: u64| {
            let mut rng = seeded(seed);
            let truth = perturbed(&hp3j(), &Free::Auto, manufacture(), &mut rng);
            let arms = diverse_postures(&hp3j(), 6, &mut rng);
            let values = |posture: &Posture| match &posture.state {
                PostureState::Joints(values) => values.clone(),
                PostureState::FlangePose(_) => unreachable!("diverse postures are joints"),
            };
            let reported: Vec<Vec<f64>> = (0..24)
                .map(|at| {
                    let mut own = values(&arms[at / 4]);
                    own[3..].iter_mut().for_each(|value| *value += rng.random_range(-1.2..1.2));
                    own
                })
                .collect();
            let off: Vec<[f64; 3]> = (0..6).map(|_| std::array::from_fn(|_| shared * normal(&mut rng))).collect();
            let actual_at = |at: usize, rng: &mut rand_chacha::ChaCha8Rng| {
                let shift = |k: usize| off[at / 4].get(k).copied().unwrap_or_default();
                let moved: Vec<f64> =
                    reported[at].iter().enumerate().map(|(k, q)| q + shift(k) + own * normal(rng)).collect();
                joints(at, &moved)
            };
            let actual: Vec<Posture> = (0..24).map(|at| actual_at(at, &mut rng)).collect();
            let sensing = Sensing { depth_relative: Some(0.003), keypoints: 80, ..half_pixel() };
            let mut data = record(&truth, &actual, &box_points(900, &mut rng), sensing, &mut rng);
            data.postures = reported.iter().enumerate().map(|(at, values)| joints(at, values)).collect();
            let fit = |data: &Correspondences| calibrate_bundle(&hp3j(), data, &BundleOptions::default());
            let groups = held_out_groups(&data.postures, 6);
            assert_eq!(groups, neighbouring_folds(24, 6));
            let folds = cross_validate(&hp3j(), &data, &groups, &fit, None, &|| {}).unwrap().folds;
            let found = jackknife(&hp3j(), &fit(&data).unwrap(), &folds, &data.postures).unwrap().unwrap();
            assert!(found.variance_factor == 1.0 || found.scattered_m > found.claimed_m, "{found:?}");
            println!("shared {shared}, seed {seed}: {found:?}");
            [(found.scattered_m / found.claimed_m).powi(2), found.variance_factor]
        };
        let sum = seeds.map(one).fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]]);
        sum.map(|sum| sum / runs as f64)
    }

    #[test]
    fn folds_scatter_as_claimed_where_errors_are_independent() {
        let [ratio, factor] = jackknifed(0.0, 5e-5, 0..4);
        // Six groups scatter by up to twice that by chance, and by their leverage.
        assert!((0.5..2.0).contains(&ratio) && factor < 1.5, "{ratio} {factor}");
    }

    #[test]
    fn folds_scatter_more_than_claimed_where_positions_have_errors_in_common() {
        let [ratio, factor] = jackknifed(6e-4, 5e-5, 0..3);
        assert!(ratio > 2.0 && factor > 2.0, "{ratio} {factor}");
    }
}
