//! A rig on a recording that it was not fitted to: another day, other postures, the camera taken off and put back.

use super::front_end::{FrontEnd, front_end};
use super::verdict::UNEXPLAINED_PX;
use super::{Config, DepthConsistencySummary, RunError, Status, localize, measure_depth_consistency};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    BundleOptions, Comparison, Correspondences, EpipolarStatistics, Free, Model, MountComponent, Parameter,
    PostureErrorPolicy, PriorPolicy, RecordingComparison, ReprojectionStatistics, Rigs, calibrate_bundle,
    compare_on_recording, held_out_groups,
};
use skclam_geometry::Isometry3;
use skclam_rig::Rig;

/// How a rig fares beside the nominal one of the data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// The judgement in one sentence.
    pub verdict: String,
    /// What the case calls for.
    pub status: Status,
    /// The case.
    pub case: ValidationCase,
    /// Name of the rig under test.
    pub rig: String,
    /// What was fitted anew on this recording, for both rigs alike; "" for nothing.
    pub refit: String,
    /// Postures of the recording.
    pub postures: usize,
    /// Pair matches.
    pub matches: usize,
    /// Observations of points followed over several images.
    pub observations: usize,
    /// By which metric rigs are judged: "reprojection, RMS" (scene and board where other arm positions saw them under
    /// the same rig) or "epipolar distance, median".
    pub metric: String,
    /// That metric, px: the nominal rig of the data set and (as `calibrated`) the rig under test.
    pub metric_px: Rigs<f64>,
    /// Reprojection over the observations that fit one of the rigs.
    pub reprojection: Rigs<ReprojectionStatistics>,
    /// Epipolar distances of the pair matches.
    pub epipolar: Rigs<EpipolarStatistics>,
    /// How far apart the depth images are; `null` without depth.
    pub depth_consistency: Option<Rigs<DepthConsistencySummary>>,
    /// Reprojection posture by posture, where the rig under test fits worst first.
    pub by_posture: Vec<PostureMetric>,
    /// What a user should know.
    pub warnings: Vec<String>,
}

/// How the rigs fare in one posture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PostureMetric {
    /// The recording's index.
    pub posture: u64,
    /// RMS of the reprojection, px.
    pub metric_px: Rigs<f64>,
}

/// What a validation found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ValidationCase {
    /// Better than the data set's own rig, and it explains the recording.
    Holds,
    /// Neither better nor worse.
    Same,
    /// Better, but it does not explain the recording.
    BetterButUnexplained,
    /// It fits the images, and the depth images are less consistent.
    DepthInconsistent,
    /// No better.
    NotBetter,
}

impl ValidationCase {
    /// What it calls for.
    pub fn status(self) -> Status {
        match self {
            ValidationCase::Holds => Status::Good,
            ValidationCase::Same | ValidationCase::BetterButUnexplained | ValidationCase::DepthInconsistent => {
                Status::Caution
            }
            ValidationCase::NotBetter => Status::Bad,
        }
    }
}

/// Measures `rig` on a data set, beside the data set's own. With `refit`, those parameters of either rig are fitted to
/// the data set first, and nothing else: `mount` after the camera was taken off.
pub fn validate(
    dataset: &Dataset,
    rig: &Rig,
    refit: Option<&Free>,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Validation, RunError> {
    let FrontEnd { data, .. } = front_end(dataset, config, progress)?;
    progress.begin(Stage::Validate, 2);
    let fitted = |rig: &Rig| -> Result<Model, RunError> {
        let model = match refit {
            None => Model::new(rig.clone()),
            Some(free) => refitted(rig, free, &data, config)?,
        };
        progress.step();
        Ok(model)
    };
    let (nominal, tested) = (fitted(&dataset.rig)?, fitted(rig)?);
    let groups = held_out_groups(&data.postures, dataset.len());
    let RecordingComparison { comparison, postures } =
        compare_on_recording(&nominal, &tested, &data, &groups, SIGMA_PX)?;
    let metric_px = comparison.metric_px();
    let metric = if comparison.reprojection.calibrated.observations > 0 {
        "reprojection, RMS"
    } else {
        "epipolar distance, median"
    };
    let index = |position: usize| dataset.records[position].posture.index;
    let mut by_posture: Vec<PostureMetric> = postures
        .into_iter()
        .map(|(position, metric_px)| PostureMetric { posture: index(position), metric_px })
        .collect();
    by_posture.sort_by(|a, b| b.metric_px.calibrated.total_cmp(&a.metric_px.calibrated));
    let poses = |rig: &Rig| -> Result<Vec<Isometry3>, RunError> {
        Ok(localize(dataset, rig)?.into_iter().map(|stamped| stamped.base_from_camera).collect())
    };
    let (nominal_poses, tested_poses) = (poses(&nominal.rig)?, poses(&tested.rig)?);
    let [before, after] = measure_depth_consistency(dataset, [&nominal_poses, &tested_poses], &dataset.rig)?;
    let depth_consistency =
        before.surfaces.zip(after.surfaces).map(|(nominal, calibrated)| Rigs { nominal, mount_only: None, calibrated });
    let refit = refit.map(label).unwrap_or_default();
    let case = case(metric_px, &comparison, depth_consistency.as_ref());
    Ok(Validation {
        verdict: sentence(case, metric, metric_px, &refit, &comparison, depth_consistency.as_ref()),
        status: case.status(),
        case,
        by_posture,
        rig: rig.name.clone(),
        refit,
        postures: dataset.len(),
        matches: data.match_count(),
        observations: data.observation_count(),
        metric: metric.to_owned(),
        metric_px,
        reprojection: comparison.reprojection,
        epipolar: comparison.epipolar,
        depth_consistency,
        warnings: Vec::new(),
    })
}

/// Expected sigma of an observation, px: only for the gate beyond which one that fits neither rig counts as a wrong
/// match.
const SIGMA_PX: f64 = 1.0;

fn refitted(rig: &Rig, free: &Free, data: &Correspondences, config: &Config) -> Result<Model, RunError> {
    let options = BundleOptions {
        free: free.clone(),
        // What is refitted has moved: its old value says nothing of the new one.
        priors: PriorPolicy::Never,
        posture_errors: PostureErrorPolicy::Off,
        ..config.bundle.clone()
    };
    Ok(calibrate_bundle(rig, data, &options)?.model)
}

/// The mount by its name, anything else by its parameters.
fn label(free: &Free) -> String {
    let mount = Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec());
    if *free == mount { "the mount".to_owned() } else { free.to_string() }
}

/// A rig under which the depth images lie farther apart than this times the other's does not hold.
const WORSE_CONSISTENCY: f64 = 1.05;
/// A metric over fewer of the observations says little of the rig.
const MANY_LEFT_OUT: f64 = 0.2;
/// Reprojection beyond this is not explained, px: errors of single postures make a pixel or two.
const UNEXPLAINED_RMS_PX: f64 = 5.0;

/// Metrics nearer to each other than this are the same.
const SAME_PX: f64 = 1e-6;

fn case(px: Rigs<f64>, comparison: &Comparison, depth: Option<&Rigs<DepthConsistencySummary>>) -> ValidationCase {
    let lines = comparison.epipolar.calibrated;
    let observations = comparison.reprojection.calibrated;
    let left_out = 1.0 - observations.inliers as f64 / observations.observations.max(1) as f64;
    if (px.calibrated - px.nominal).abs() < SAME_PX {
        ValidationCase::Same
    } else if px.calibrated > px.nominal {
        ValidationCase::NotBetter
    } else if lines.matches > 0 && lines.median_px > UNEXPLAINED_PX
        || observations.observations > 0 && (left_out > MANY_LEFT_OUT || observations.rms_px > UNEXPLAINED_RMS_PX)
    {
        ValidationCase::BetterButUnexplained
    } else if depth.is_some_and(|d| d.calibrated.median_mm > d.nominal.median_mm * WORSE_CONSISTENCY) {
        ValidationCase::DepthInconsistent
    } else {
        ValidationCase::Holds
    }
}

fn sentence(
    case: ValidationCase,
    metric: &str,
    px: Rigs<f64>,
    refit: &str,
    comparison: &Comparison,
    depth: Option<&Rigs<DepthConsistencySummary>>,
) -> String {
    let with = if refit.is_empty() { String::new() } else { format!(", after fitting {refit} of both anew") };
    let observations = comparison.reprojection.calibrated;
    let left_out = 1.0 - observations.inliers as f64 / observations.observations.max(1) as f64;
    let fraction = match observations.observations {
        0 => String::new(),
        _ => format!(", without the {:.0} % of the observations that fit neither", 100.0 * left_out),
    };
    let metrics =
        format!("{metric}: {:.2} px, the data set's own rig {:.2} px{fraction}{with}", px.calibrated, px.nominal);
    match case {
        ValidationCase::Holds => format!("The rig holds on this recording ({metrics})."),
        ValidationCase::Same => format!("The rig fits this recording exactly as the data set's own does ({metrics})."),
        ValidationCase::NotBetter => format!("The rig does NOT beat the data set's own on this recording ({metrics})."),
        ValidationCase::BetterButUnexplained => {
            format!("The rig is better than the data set's own, but it does NOT explain this recording ({metrics}).")
        }
        ValidationCase::DepthInconsistent => {
            let mm = depth.map_or([0.0; 2], |depth| [depth.calibrated.median_mm, depth.nominal.median_mm]);
            format!(
                "The rig fits the images, but NOT the depth: its depth consistency (point to plane) is {:.1} mm, that of the data set's own rig {:.1} mm ({metrics}).",
                mm[0], mm[1]
            )
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_holds_only_where_it_explains_the_recording() {
        fn rigs<T>(nominal: T, calibrated: T) -> Rigs<T> {
            Rigs { nominal, mount_only: None, calibrated }
        }
        let found = |px: [f64; 2], median_px: f64, inliers: usize, rms_px: f64, distance_mm: f64| {
            let lines = EpipolarStatistics { matches: 100, median_px, ..Default::default() };
            let observations = ReprojectionStatistics { observations: 100, inliers, rms_px, ..Default::default() };
            let comparison =
                Comparison { reprojection: rigs(observations, observations), epipolar: rigs(lines, lines) };
            let surfaces = |median_mm| DepthConsistencySummary { median_mm, ..Default::default() };
            let depth = rigs(surfaces(5.0), surfaces(distance_mm));
            let px = rigs(px[0], px[1]);
            let case = case(px, &comparison, Some(&depth));
            (case, sentence(case, "reprojection, RMS", px, "", &comparison, Some(&depth)))
        };
        use ValidationCase::{BetterButUnexplained, DepthInconsistent, Holds, NotBetter, Same};
        let rows = [
            (found([9.0, 1.0], 0.2, 95, 1.0, 5.0), Holds, Status::Good, "without the 5 % of the observations"),
            (found([9.0, 1.0], 3.0, 95, 1.0, 5.0), BetterButUnexplained, Status::Caution, "does NOT explain"),
            (found([9.0, 1.0], 0.2, 30, 1.0, 5.0), BetterButUnexplained, Status::Caution, "does NOT explain"),
            (found([9.0, 6.0], 0.2, 95, 6.0, 5.0), BetterButUnexplained, Status::Caution, "does NOT explain"),
            (found([9.0, 1.0], 0.2, 95, 1.0, 9.0), DepthInconsistent, Status::Caution, "NOT the depth"),
            (found([1.0, 2.0], 0.2, 95, 1.0, 5.0), NotBetter, Status::Bad, "does NOT beat"),
            (found([1.0, 1.0], 0.2, 95, 1.0, 5.0), Same, Status::Caution, "exactly as"),
        ];
        for ((case, said), expected, status, says) in rows {
            assert_eq!((case, case.status()), (expected, status), "{said}");
            assert!(said.contains(says), "{said}");
        }
    }
}
