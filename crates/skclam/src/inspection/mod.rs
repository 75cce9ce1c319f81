//! A dataset judged before any calibration: how the joints are covered, how sharp and how well exposed the images are,
//! which postures should see the same, how well each parameter can be determined from them, and what is likely to go
//! wrong.

mod expected;
mod failure;
mod warnings;

pub use expected::{ExpectedParameter, ExpectedSigmaOptions, ExpectedSigmas, JointToMove};
pub use failure::likely_cause;

use crate::dataset::{Dataset, DatasetError};
use crate::pipeline::{
    BoardSummary, Config, ImagePair, PairingOptions, PredictedView, RunError, choose_pairs, find_boards,
};
use crate::progress::{Progress, Stage};
use expected::{Predicted, expected_sigmas};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_features::board::BoardOptions;
use skclam_kinematics::JointKind;
use skclam_recordings::{Exposure, exposure, sharpness};
use skclam_rig::{PostureState, RigError};
use warnings::warnings;

/// From where on something is worth a warning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InspectionOptions {
    /// Prediction of the overlap of images.
    pub pairing: PairingOptions,
    /// Fewer postures than this calibrate badly: the paper needed 30 for a tenth of a degree.
    pub min_postures: usize,
    /// A revolute joint that turns by less than this says little about its parameters, degrees.
    pub min_joint_range_deg: f64,
    /// A prismatic joint that slides by less than this, millimetres.
    pub min_joint_range_mm: f64,
    /// An image with less than this fraction of the median sharpness is blurred.
    pub min_relative_sharpness: f64,
    /// A fraction of black or of white pixels beyond this is badly exposed.
    pub max_clipped: f64,
    /// A depth image with a smaller fraction of measured pixels is a poor one.
    pub min_depth_fraction: f64,
    /// The median depth of a camera on a wrist lies between these; beyond, the unit of the depth images is in doubt,
    /// metres.
    pub plausible_depth_m: [f64; 2],
    /// Detector of the rig's board.
    pub board: BoardOptions,
    /// Prediction of how well the parameters can be determined.
    pub expected: ExpectedSigmaOptions,
}

impl Default for InspectionOptions {
    fn default() -> Self {
        InspectionOptions {
            pairing: PairingOptions::default(),
            min_postures: 30,
            min_joint_range_deg: 15.0,
            min_joint_range_mm: 50.0,
            min_relative_sharpness: 0.4,
            max_clipped: 0.25,
            min_depth_fraction: 0.3,
            plausible_depth_m: [0.1, 10.0],
            board: BoardOptions::default(),
            expected: ExpectedSigmaOptions::default(),
        }
    }
}

/// How a joint is covered by the postures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JointCoverage {
    /// The joint's name.
    pub joint: String,
    /// "deg" or "mm".
    pub unit: &'static str,
    /// Least value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Limits of the rig.
    pub limits: Option<[f64; 2]>,
    /// Values that differ by more than a tenth of the range.
    pub distinct: usize,
}

/// An image as it is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImageJudgement {
    /// The posture's index.
    pub index: u64,
    /// Its file.
    pub color: String,
    /// Fine detail as a fraction of the contrast; to be compared within a dataset.
    pub sharpness: f64,
    /// Grey values.
    pub exposure: Exposure,
    /// Fraction of measured depth pixels.
    pub depth_fraction: Option<f64>,
    /// Median depth, metres.
    pub median_depth_m: Option<f64>,
}

/// What a dataset promises.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Inspection {
    /// Number of postures.
    pub postures: usize,
    /// One entry a joint; empty where only flange poses are known.
    pub joints: Vec<JointCoverage>,
    /// One entry a posture.
    pub images: Vec<ImageJudgement>,
    /// Pairs of postures (positions in the dataset) that should see the same, by the nominal rig.
    pub pairs: Vec<ImagePair>,
    /// Groups of postures that no pair connects, the largest first: each is its own island.
    pub groups: Vec<Vec<usize>>,
    /// The rig's board in the images; `null` where the rig has none.
    pub board: Option<BoardSummary>,
    /// How well each parameter can be determined from these postures; `null` where they cannot be calibrated with at
    /// all.
    pub expected: Option<ExpectedSigmas>,
    /// What a user should know, each with advice.
    pub warnings: Vec<String>,
}

/// Why a dataset could not be judged.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InspectionError {
    /// An image.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A posture.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The rig's board cannot be looked for.
    #[error(transparent)]
    Board(Box<RunError>),
    /// It was asked to stop.
    #[error("stopped")]
    Stopped,
}

/// Judges a dataset. Reads every image once.
pub fn inspect(
    dataset: &Dataset,
    options: &InspectionOptions,
    progress: &dyn Progress,
) -> Result<Inspection, InspectionError> {
    progress.begin(Stage::Inspect, dataset.len() as u64);
    let looked: Vec<(ImageJudgement, PredictedView, Predicted)> = (0..dataset.len())
        .into_par_iter()
        .map(|position| {
            if progress.stop_requested() {
                return Err(InspectionError::Stopped);
            }
            let looked = look(dataset, position, options)?;
            progress.step();
            Ok(looked)
        })
        .collect::<Result<_, InspectionError>>()?;
    let mut images = Vec::with_capacity(looked.len());
    let (mut views, mut predicted) = (Vec::with_capacity(looked.len()), Vec::with_capacity(looked.len()));
    for (image, view, observations) in looked {
        images.push(image);
        views.push(view);
        predicted.push(observations);
    }
    let pairs = choose_pairs(&views, &dataset.rig.color, &options.pairing);
    let groups = groups(dataset.len(), &pairs, options.pairing.min_overlap);
    let joints = coverage(dataset);
    let config = Config { board: options.board.clone(), ..Config::default() };
    let boards = find_boards(dataset, &[], &config, progress).map_err(|error| match error {
        RunError::Interrupted => InspectionError::Stopped,
        error => InspectionError::Board(Box::new(error)),
    })?;
    let (boards, board) = boards.map_or((vec![], None), |(boards, summary)| (boards, Some(summary)));
    let seen = expected::Observations { views: &predicted, pairs: &pairs, boards };
    let expected = expected_sigmas(dataset, seen, &joints, &options.pairing, &options.expected);
    let (expected, impossible) = match expected {
        Ok(expected) => (Some(expected), None),
        Err(error) => (None, Some(format!("with these postures nothing can be calibrated: {error}"))),
    };
    let mut inspection =
        Inspection { postures: dataset.len(), joints, images, pairs, groups, board, expected, warnings: vec![] };
    inspection.warnings = warnings(dataset, &inspection, options);
    inspection.warnings.extend(impossible);
    Ok(inspection)
}

fn look(
    dataset: &Dataset,
    position: usize,
    options: &InspectionOptions,
) -> Result<(ImageJudgement, PredictedView, Predicted), InspectionError> {
    let record = &dataset.records[position];
    let gray = dataset.gray(position)?;
    let base_from_color = dataset.rig.base_from_color(&record.posture)?;
    let (mut depth_fraction, mut median_depth_m) = (None, None);
    let depth = dataset.depth(position)?;
    let assumed_depth_m = options.pairing.assumed_depth_m;
    let observations =
        Predicted::new(base_from_color, depth.as_ref(), &dataset.rig, &options.expected, assumed_depth_m);
    let view = match (depth, &dataset.rig.depth) {
        (Some(depth), Some(camera)) => {
            let mut measured: Vec<f32> = depth.as_slice().iter().copied().filter(|&z| z > 0.0).collect();
            depth_fraction = Some(measured.len() as f64 / depth.as_slice().len().max(1) as f64);
            let middle = measured.len() / 2;
            if !measured.is_empty() {
                median_depth_m = Some(f64::from(*measured.select_nth_unstable_by(middle, f32::total_cmp).1));
            }
            PredictedView::from_depth(base_from_color, &depth, camera)
        }
        _ => PredictedView::from_assumed_depth(base_from_color, &dataset.rig.color, assumed_depth_m),
    };
    let judgement = ImageJudgement {
        index: record.posture.index,
        color: record.color.display().to_string(),
        sharpness: sharpness(&gray),
        exposure: exposure(&gray),
        depth_fraction,
        median_depth_m,
    };
    Ok((judgement, view, observations))
}

fn coverage(dataset: &Dataset) -> Vec<JointCoverage> {
    let Some(robot) = &dataset.rig.robot else { return vec![] };
    let values = |joint: usize| {
        dataset.records.iter().filter_map(move |record| match &record.posture.state {
            PostureState::Joints(values) => values.get(joint).copied(),
            PostureState::FlangePose(_) => None,
        })
    };
    if values(0).next().is_none() {
        return vec![];
    }
    let one = |(index, joint): (usize, &skclam_kinematics::Joint)| {
        let (unit, scale) = if joint.kind == JointKind::Revolute { ("deg", 1f64.to_degrees()) } else { ("mm", 1e3) };
        let mut sorted: Vec<f64> = values(index).map(|value| scale * value).collect();
        sorted.sort_by(f64::total_cmp);
        let (min, max) = (sorted[0], sorted[sorted.len() - 1]);
        let apart = 0.1 * (max - min);
        let mut last = f64::NEG_INFINITY;
        let mut distinct = 0;
        for value in sorted {
            if value > last + apart {
                (last, distinct) = (value, distinct + 1);
            }
        }
        let limits = joint.limits.map(|limits| limits.map(|limit| scale * limit));
        JointCoverage { joint: joint.name.clone(), unit, min, max, limits, distinct }
    };
    robot.joints().iter().enumerate().map(one).collect()
}

/// Connected components of the graph of pairs with enough overlap.
fn groups(count: usize, pairs: &[ImagePair], min_overlap: f64) -> Vec<Vec<usize>> {
    let mut root: Vec<usize> = (0..count).collect();
    fn find(root: &mut [usize], mut at: usize) -> usize {
        while root[at] != at {
            root[at] = root[root[at]];
            at = root[at];
        }
        at
    }
    for pair in pairs.iter().filter(|pair| pair.overlap >= min_overlap) {
        let (a, b) = (find(&mut root, pair.a), find(&mut root, pair.b));
        root[a.max(b)] = a.min(b);
    }
    let mut groups: Vec<Vec<usize>> = vec![vec![]; count];
    for posture in 0..count {
        let group = find(&mut root, posture);
        groups[group].push(posture);
    }
    groups.retain(|group| !group.is_empty());
    groups.sort_by_key(|group| (std::cmp::Reverse(group.len()), group[0]));
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(a: usize, b: usize, overlap: f64) -> ImagePair {
        ImagePair { a, b, overlap }
    }

    #[test]
    fn islands_are_found_whatever_the_order_of_the_pairs() {
        let pairs = [pair(3, 4, 0.5), pair(0, 2, 0.5), pair(2, 4, 0.1), pair(2, 3, 0.9)];
        assert_eq!(groups(6, &pairs, 0.25), vec![vec![0, 2, 3, 4], vec![1], vec![5]]);
        assert_eq!(groups(2, &[], 0.25), vec![vec![0], vec![1]]);
    }

    fn shared(name: &str) -> Option<Dataset> {
        let beside = std::path::PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data"));
        let folder = std::env::var_os("SKCLAM_DATA").map_or(beside, std::path::PathBuf::from).join(name);
        if !folder.is_dir() {
            println!("skipped: {} is not there", folder.display());
            return None;
        }
        Some(Dataset::open(folder).unwrap())
    }

    #[test]
    fn a_good_dataset_has_one_island_and_a_bad_one_is_warned_of() {
        let Some(mut dataset) = shared("virtual-cell") else { return };
        let options = InspectionOptions::default();
        let good = inspect(&dataset, &options, &crate::progress::Silent).unwrap();
        assert_eq!((good.postures, good.joints.len(), good.images.len()), (48, 6, 48));
        assert!(good.pairs.len() > 96 && good.groups[0].len() > 40, "{:?}", good.groups);
        assert!(good.images.iter().all(|image| image.median_depth_m.is_some_and(|z| (0.1..3.0).contains(&z))));
        let expected = good.expected.as_ref().unwrap();
        assert!(expected.rank == expected.free && expected.joints_to_move.is_empty(), "{expected:?}");
        // Most of it is the tolerance of the depth's scale.
        assert!((0.05..3.0).contains(&expected.camera_sigma_mm.mean), "{expected:?}");
        assert!(expected.identifiable > expected.free / 2, "{expected:?}");
        dataset.records.truncate(3);
        let bad = inspect(&dataset, &options, &crate::progress::Silent).unwrap();
        assert!(bad.warnings.iter().any(|warning| warning.starts_with("3 postures; 30 or more")), "{:?}", bad.warnings);
        assert!(bad.warnings.len() > good.warnings.len());
    }

    #[test]
    fn a_joint_that_does_not_move_is_named_before_any_calibration() {
        let Some(mut dataset) = shared("virtual-cell") else { return };
        for record in &mut dataset.records {
            if let PostureState::Joints(values) = &mut record.posture.state {
                values[4] = 0.6;
            }
        }
        let still = inspect(&dataset, &InspectionOptions::default(), &crate::progress::Silent).unwrap();
        let expected = still.expected.unwrap();
        assert!(expected.identifiable <= expected.rank && expected.rank < expected.free, "{expected:?}");
        let named: Vec<&str> = expected.joints_to_move.iter().map(|joint| joint.joint.as_str()).collect();
        assert_eq!(named, [still.joints[4].joint.as_str()], "{expected:?}");
        assert!(expected.not_identifiable.iter().any(|reason| reason.contains("joint 5")), "{expected:?}");
        assert!(still.warnings.iter().any(|warning| warning.contains("should move more")), "{:?}", still.warnings);
    }
    #[test]
    fn what_only_the_tolerances_fix_is_not_counted_as_identifiable() {
        let Some(mut dataset) = shared("virtual-cell") else { return };
        for (at, record) in dataset.records.iter_mut().enumerate() {
            if let PostureState::Joints(values) = &mut record.posture.state {
                // All but the last joint are at rest, up to what makes the residuals depend on them a little.
                *values = [0.1, 0.2, -0.3, 0.1, 0.6, 0.1 * at as f64].map(|q| q + 1e-5 * (at as f64).sin()).to_vec();
            }
        }
        let expected = inspect(&dataset, &InspectionOptions::default(), &crate::progress::Silent).unwrap().expected;
        let expected = expected.unwrap();
        let none = expected.parameters.iter().filter(|parameter| parameter.sigma.is_none()).count();
        assert!(none > 10 && expected.identifiable < expected.free / 2, "{expected:?}");
    }

    #[test]
    fn a_wrong_unit_of_depth_is_named() {
        let Some(mut dataset) = shared("virtual-cell") else { return };
        dataset.records.truncate(2);
        let warned = |dataset: &Dataset| {
            let judged = inspect(dataset, &InspectionOptions::default(), &crate::progress::Silent).unwrap();
            judged.warnings.iter().any(|warning| warning.contains("depth.unit_mm"))
        };
        assert!(!warned(&dataset));
        dataset.rig.depth.as_mut().unwrap().unit_m *= 1e-3;
        assert!(warned(&dataset));
    }

    #[test]
    fn a_board_gives_the_scale_and_leads_where_all_postures_show_it() {
        let Some(mut dataset) = shared("nachi-mz25") else { return };
        let by_board = inspect(&dataset, &InspectionOptions::default(), &crate::progress::Silent).unwrap();
        let board = by_board.board.as_ref().unwrap();
        assert_eq!((board.postures, board.corners), (24, 24 * 88), "{board:?}");
        let expected = by_board.expected.as_ref().unwrap();
        assert_eq!((expected.points, expected.corners), (0, 24 * 88));
        assert!(!by_board.warnings.iter().any(|warning| warning.contains("scale")), "{:?}", by_board.warnings);
        dataset.rig.board = None;
        let without = inspect(&dataset, &InspectionOptions::default(), &crate::progress::Silent).unwrap();
        assert!(without.warnings.iter().any(|warning| warning.contains("scale")), "{:?}", without.warnings);
    }
}
