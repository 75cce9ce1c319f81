//! Which gross mistake explains a recording that its rig does not explain at all: each is undone in turn, and what the
//! images then say decides.
//!
//! Matches are computed anew without any prediction of the rig, as a wrong one loses the right ones. Every hypothesis
//! is compared with the camera rotations that the matches of single pairs give ([`screening`]: microseconds each);
//! the most promising ones, and the unchanged data, get the mount that fits them best, found from nothing
//! ([`find_mount`]), and are compared by the median Sampson distance of the same matches. A mistake is named only where
//! undoing it is better by a clear factor, and better than anything else.

mod candidates;
mod depth_shift;
mod describe;
mod pairs;
mod relative_pose;
mod screening;
#[cfg(test)]
mod tests;

pub use depth_shift::{DepthShift, find_depth_shift};
pub use describe::{describe, describe_depth_shift};

use super::{Config, ImageFeatures, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use candidates::{Candidate, candidates};
use pairs::{FreePair, free_pairs};
use relative_pose::median;
use screening::rotation_misfit_rad;
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    Calibration, CalibrationError, Correspondences, Free, Model, MountComponent, PairMatches, PairwiseOptions,
    Parameter, calibrate_pairwise_from, epipolar_statistics, find_mount,
};
use skclam_geometry::{Isometry3, PinholeCamera};
use skclam_rig::{Posture, PostureState, Prior, Rig};

/// A gross mistake in a data set. Joints are counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "kind")]
#[non_exhaustive]
pub enum GrossCause {
    /// A joint turns the other way round than the rig has it.
    JointSign {
        /// Which.
        joint: usize,
    },
    /// The values of two joints are in each other's column.
    JointsSwapped {
        /// The first.
        a: usize,
        /// The second.
        b: usize,
    },
    /// The columns say radians and the values are degrees.
    DegreesForRadians,
    /// The columns say degrees and the values are radians.
    RadiansForDegrees,
    /// The image of a row belongs to the posture that is so many rows further down (above, where negative).
    PosturesShifted {
        /// Rows.
        by: i64,
    },
    /// The arm's table is of modified DH parameters and is given as a standard one, or the other way round.
    LinkConvention,
    /// The mount is another one than the rig's.
    MountFarOff {
        /// Between the rig's mount and the one that was found, degrees.
        rotation_deg: f64,
        /// Between their origins, millimetres.
        translation_mm: f64,
        /// The one that was found.
        flange_from_color: Isometry3,
    },
    /// The quaternions of the flange poses have their scalar part first.
    QuaternionOrder,
    /// The flange poses take points from the base to the flange.
    PoseInverted,
    /// The images agree with each other, and no mistake that was tried makes the postures agree with them.
    OtherArm,
    /// Not even two images agree with each other under the colour camera's intrinsics.
    SceneOrCamera,
}

/// The mistake that was found, and how much better the images are explained without it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GrossFinding {
    /// Which.
    pub cause: GrossCause,
    /// Median Sampson distance of the matches with the unchanged data, the mount fitted (but for
    /// [`GrossCause::MountFarOff`]: with the rig's), px; `None` where no mount fits at all.
    pub before_px: Option<f64>,
    /// The same with the mistake undone and the mount fitted; where no mistake was found, of the best hypothesis; for
    /// [`GrossCause::SceneOrCamera`] of epipolar geometries that need no intrinsics. px; `None` where no hypothesis
    /// fits at all.
    pub after_px: Option<f64>,
    /// The next best hypothesis and its median distance, px; `None` where nothing else was tried.
    pub second: Option<(GrossCause, f64)>,
    /// Mistakes that were tried.
    pub tried: usize,
    /// Pairs of images that took part.
    pub pairs: usize,
    /// Their matches.
    pub matches: usize,
}

/// With fewer pairs nothing is decided.
const MIN_PAIRS: usize = 6;
/// Hypotheses that get a mount of their own.
const FINALISTS: usize = 6;
/// Matches on which hypotheses are compared.
const MATCHES: usize = 1500;
/// A mistake is undone when the distance falls by this factor ...
const MIN_GAIN: f64 = 3.0;
/// ... and is smaller than every other hypothesis' by this one.
const MIN_LEAD: f64 = 1.5;
/// What a nominal arm leaves with the mount fitted, at most: so many pixels, or that angle where it is more (its angles
/// off by half a degree each, seen at arm's length).
const MOUNT_LEAVES: (f64, f64) = (3.0, 0.02);
/// What it leaves with its own angles fitted too, at most.
const ANGLES_LEAVE: (f64, f64) = (3.0, 6e-3);
/// A mount further off than this was not measured with a ruler: rotation in degrees, translation in millimetres.
const FAR_OFF: (f64, f64) = (5.0, 50.0);
/// No camera is mounted farther from a flange.
const FARTHEST_M: f64 = 1.0;
/// Pairs that miss by so much more with the intrinsics than without, and by so many pixels, do not belong to them.
const INCONSISTENT: (f64, f64) = (3.0, 1.0);
/// The angles of an arm that is no other one are within a few of these, degrees.
const OWN_ARM_DEG: f64 = 1.0;

/// Names the gross mistake that explains why the rig does not explain the images; `None` where the unchanged data
/// are explained with another calibration of the same rig, or where too few images have anything in common.
///
/// Called when an estimate explains nothing; asked of a good data set it says `None`, too. Deterministic; seconds.
///
/// # Errors
/// [`RunError::Interrupted`], and what matching and fitting refuse.
pub fn find_gross_cause(
    dataset: &Dataset,
    images: &[ImageFeatures],
    config: &Config,
    progress: &dyn Progress,
) -> Result<Option<GrossFinding>, RunError> {
    let camera = &dataset.rig.color;
    let pairs = free_pairs(images, camera, config, progress)?;
    if pairs.len() < MIN_PAIRS {
        return Ok(None);
    }
    let trial = Trial { pairs: thinned(&pairs), camera };
    let nominal = Candidate::nominal(dataset);
    let unchanged = trial.fit(&nominal)?;
    let mut finding = GrossFinding {
        cause: GrossCause::OtherArm,
        before_px: unchanged.map(|fit| fit.px),
        after_px: None,
        second: None,
        tried: 0,
        pairs: pairs.len(),
        matches: pairs.iter().map(|pair| pair.matches.len()).sum(),
    };
    let per_pair = |of: fn(&FreePair) -> f64| median(pairs.iter().map(of).collect());
    let (with, without) = (per_pair(|p| p.rotation.calibrated_px), per_pair(|p| p.rotation.uncalibrated_px));
    if with > INCONSISTENT.0 * without && with > INCONSISTENT.1 {
        return Ok(Some(GrossFinding {
            cause: GrossCause::SceneOrCamera,
            before_px: Some(with),
            after_px: Some(without),
            ..finding
        }));
    }
    let hypotheses = candidates(dataset);
    finding.tried = hypotheses.len();
    let tried = trial.finalists(&pairs, hypotheses, progress)?;
    finding.second = tried.get(1).map(|second| (second.cause, second.fit.px));
    if let Some(best) = tried.first() {
        let px = best.fit.px;
        finding.after_px = Some(px);
        let lead = finding.second.is_none_or(|(_, second)| MIN_LEAD * px <= second);
        if lead
            && finding.before_px.is_none_or(|before| MIN_GAIN * px <= before)
            && trial.explained(&best.candidate, &best.fit)?
        {
            return Ok(Some(GrossFinding { cause: best.cause, ..finding }));
        }
    }
    if let Some(fit) = unchanged
        && trial.explained(&nominal, &fit)?
    {
        finding.second = tried.first().map(|best| (best.cause, best.fit.px));
        return Ok(mount_far_off(&trial, dataset, &fit, finding)?);
    }
    Ok(Some(finding))
}

/// A limit in pixels or as an angle, whichever is more, px.
fn limit_px((px, angle): (f64, f64), camera: &PinholeCamera) -> f64 {
    px.max(angle * camera.fx)
}

/// The data are explained with this mount: whether it is the rig's.
fn mount_far_off(
    trial: &Trial<'_>,
    dataset: &Dataset,
    fit: &Fit,
    finding: GrossFinding,
) -> Result<Option<GrossFinding>, CalibrationError> {
    let data = trial.data(&Candidate::nominal(dataset)).0;
    let before_px = epipolar_statistics(&Model::new(dataset.rig.clone()), &data)?.median_sampson_px;
    let change = dataset.rig.flange_from_color.inverse() * fit.flange_from_color;
    let (rotation_deg, translation_mm) = (change.rotation.angle().to_degrees(), change.translation.vector.norm() * 1e3);
    let far = rotation_deg > FAR_OFF.0 || translation_mm > FAR_OFF.1;
    if !far || before_px < MIN_GAIN * fit.px {
        return Ok(None);
    }
    let cause = GrossCause::MountFarOff { rotation_deg, translation_mm, flange_from_color: fit.flange_from_color };
    Ok(Some(GrossFinding { cause, before_px: Some(before_px), after_px: Some(fit.px), ..finding }))
}

/// A mount that was found, and what it leaves.
#[derive(Debug, Clone, Copy)]
struct Fit {
    flange_from_color: Isometry3,
    px: f64,
}

/// A hypothesis with the mount that fits it best.
struct Finalist {
    cause: GrossCause,
    candidate: Candidate,
    fit: Fit,
}

/// The matches on which hypotheses are compared.
struct Trial<'a> {
    pairs: Vec<PairMatches>,
    camera: &'a PinholeCamera,
}

impl Trial<'_> {
    /// The matches with a hypothesis' postures, and the part of them whose images have one.
    fn data(&self, candidate: &Candidate) -> (Correspondences, f64) {
        let has = |row: usize| candidate.postures[row].is_some();
        let pairs: Vec<PairMatches> = self.pairs.iter().filter(|pair| has(pair.a) && has(pair.b)).cloned().collect();
        let nowhere = || Posture::new(0, PostureState::FlangePose(Isometry3::identity()));
        let any = candidate.postures.iter().flatten().next().cloned().unwrap_or_else(nowhere);
        // Images without a posture have no pair.
        let postures = candidate.postures.iter().map(|posture| posture.clone().unwrap_or_else(|| any.clone()));
        let data = Correspondences { postures: postures.collect(), pairs, ..Default::default() };
        let all: usize = self.pairs.iter().map(|pair| pair.matches.len()).sum();
        let part = data.match_count() as f64 / all.max(1) as f64;
        (data, part)
    }

    /// The mount that fits a hypothesis best; `None` where nothing fits at all.
    fn fit(&self, candidate: &Candidate) -> Result<Option<Fit>, CalibrationError> {
        let (data, part) = self.data(candidate);
        if part < 0.5
            || candidate.flange_poses().iter().zip(&candidate.postures).any(|(p, q)| p.is_none() && q.is_some())
        {
            return Ok(None);
        }
        let found = match find_mount(&candidate.rig, &data) {
            Ok(found) => found,
            // Without a baseline between the postures no match says anything of them.
            Err(CalibrationError::TooFew { .. }) => return Ok(None),
            Err(error) => return Err(error),
        };
        let flange_from_color = found.model.rig.flange_from_color;
        let near = flange_from_color.translation.vector.norm() <= FARTHEST_M;
        let px = found.epipolar_after.median_sampson_px;
        Ok((near && px.is_finite()).then_some(Fit { flange_from_color, px }))
    }

    /// The most promising hypotheses with what each leaves, best first.
    fn finalists(
        &self,
        pairs: &[FreePair],
        candidates: Vec<Candidate>,
        progress: &dyn Progress,
    ) -> Result<Vec<Finalist>, RunError> {
        progress.begin(Stage::FindCause, FINALISTS as u64);
        let mut screened: Vec<(f64, Candidate)> =
            candidates.into_iter().map(|c| (rotation_misfit_rad(pairs, &c.flange_poses()), c)).collect();
        // Stable: among equals, the order in which they were made.
        screened.sort_by(|x, y| x.0.total_cmp(&y.0));
        let mut tried = Vec::new();
        for (_, candidate) in screened.into_iter().take(FINALISTS) {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            if let (Some(cause), Some(fit)) = (candidate.cause, self.fit(&candidate)?) {
                tried.push(Finalist { cause, candidate, fit });
            }
            progress.step();
        }
        tried.sort_by(|x, y| x.fit.px.total_cmp(&y.fit.px));
        Ok(tried)
    }

    /// Whether nothing gross is left: the mount explains the matches, or the arm's own angles explain what it does not.
    fn explained(&self, candidate: &Candidate, fit: &Fit) -> Result<bool, CalibrationError> {
        if fit.px <= limit_px(MOUNT_LEAVES, self.camera) {
            return Ok(true);
        }
        let (data, _) = self.data(candidate);
        if data.postures.iter().any(|posture| matches!(posture.state, PostureState::FlangePose(_))) {
            return Ok(false);
        }
        let prior = Prior { angle_deg: Some(OWN_ARM_DEG), ..Prior::default() };
        let rig = Rig { flange_from_color: fit.flange_from_color, prior, ..candidate.rig.clone() };
        let mut free = Free::Angles.candidates(&rig, true, false)?;
        free.extend(MountComponent::ALL.map(Parameter::Mount));
        let options = PairwiseOptions { free: Free::List(free), ..PairwiseOptions::default() };
        let refined: Calibration = calibrate_pairwise_from(&Model::new(rig.clone()), &rig, &data, &options)?;
        Ok(refined.epipolar_after.median_sampson_px <= limit_px(ANGLES_LEAVE, self.camera))
    }
}

/// About [`MATCHES`] of the matches, every k-th.
fn thinned(pairs: &[FreePair]) -> Vec<PairMatches> {
    let all: usize = pairs.iter().map(|pair| pair.matches.len()).sum();
    let stride = all.div_ceil(MATCHES).max(1);
    let thin = |pair: &FreePair| PairMatches {
        a: pair.a,
        b: pair.b,
        matches: pair.matches.iter().copied().step_by(stride).collect(),
    };
    pairs.iter().map(thin).collect()
}
