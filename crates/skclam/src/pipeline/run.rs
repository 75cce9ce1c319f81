//! The run itself, and its results as files.

use super::front_end::{FrontEnd, front_end};
use super::pose_sigmas::{covariance_csv, pose_sigmas_csv};
use super::sentences::verdict_sentence;
use super::verdict::{Evidence, VerdictCase};
use super::{
    Config, ImageFeatures, MatchedPair, PoseSigma, PoseSigmas, RunError, Scale, build_maps, calibrate, causes,
    hold_out, judge, localize, map_coverage, measure_depth_consistency, pose_sigmas, worst,
};
use crate::dataset::{Dataset, DatasetError};
use crate::output::StagedFolder;
use crate::progress::{Progress, Stage};
use crate::report_data::{ReportData, sample_map};
use crate::summary::{CalibrationSummary, Counts, MapSummary, PairSummary, SCHEMA_VERSION, Summary, total_counts};
use crate::trajectory::{StampedPose, trajectory_text};
use image::GrayImage;
use skclam_calibration::{Calibration, Warning};
use skclam_features::MaskOutcome;
use skclam_geometry::Isometry3;
use skclam_mapping::{PointCloud, write_cloud_ply};
use skclam_rig::Rig;
use std::fs::File;
use std::io::{BufWriter, Write};

/// The maps of a run.
#[derive(Debug, Clone)]
pub struct Maps {
    /// Every depth image at its calibrated pose.
    pub calibrated: PointCloud,
    /// Every depth image at its nominal pose, for comparison (the paper's Figs. 4 and 7).
    pub nominal: PointCloud,
}

/// What a run gives back.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The calibration.
    pub calibration: Calibration,
    /// The calibrated rig.
    pub rig: Rig,
    /// Where the camera was, by the calibrated rig.
    pub trajectory: Vec<StampedPose>,
    /// 0 where the colour camera sees what moves with it; `None` where nothing was found, or the rig brings a mask of
    /// its own.
    pub mask: Option<GrayImage>,
    /// What is known of flange and camera, at the recorded postures and over the workspace.
    pub pose_sigmas: Vec<PoseSigma>,
    /// `None` without depth, or where no map was asked for.
    pub maps: Option<Maps>,
    /// Every metric.
    pub summary: Summary,
    /// What the report shows beside them.
    pub report: ReportData,
}

/// Calibrates, localizes and maps: the method of section 3 in its order.
pub fn run(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<Outcome, RunError> {
    let (mut outcome, judging) = estimate(dataset, config, progress)?;
    let nominal = localize(dataset, &dataset.rig)?;
    // Depths are measured with the calibrated scale and offset from here on; at the nominal poses too, so that the
    // poses alone differ.
    let corrected = Dataset { rig: Rig { depth: outcome.rig.depth, ..dataset.rig.clone() }, ..dataset.clone() };
    let dataset = &corrected;
    let poses = |trajectory: &[StampedPose]| {
        trajectory.iter().map(|stamped| stamped.base_from_camera).collect::<Vec<Isometry3>>()
    };
    let (calibrated_poses, nominal_poses) = (poses(&outcome.trajectory), poses(&nominal));
    let maps = build_maps(
        dataset,
        [&calibrated_poses, &nominal_poses],
        &outcome.rig,
        outcome.mask.as_ref(),
        config,
        progress,
    )?;
    outcome.maps = maps.map(|[calibrated, nominal]| Maps { calibrated, nominal });
    if let Some(maps) = &outcome.maps {
        let [calibrated, nominal] =
            measure_depth_consistency(dataset, [&calibrated_poses, &nominal_poses], &outcome.rig)?;
        progress.begin(Stage::Report, 1);
        let samples = [&calibrated.samples[..], &nominal.samples[..]];
        outcome.report.map = sample_map(dataset, &outcome.rig, outcome.mask.as_ref(), samples)?;
        progress.step();
        let [depth_consistency_calibrated, depth_consistency_nominal] = [calibrated.surfaces, nominal.surfaces];
        let mask = outcome.mask.as_ref();
        let coverage = map_coverage(dataset, &calibrated_poses, &outcome.rig, mask, config.cloud.filter)?;
        outcome.summary.map = Some(MapSummary {
            points: maps.calibrated.len(),
            depth_consistency_nominal,
            depth_consistency_calibrated,
            coverage,
        });
    }
    judging.conclude(&mut outcome);
    Ok(outcome)
}

/// Calibrates and localizes.
pub fn run_without_map(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<Outcome, RunError> {
    let (mut outcome, judging) = estimate(dataset, config, progress)?;
    judging.conclude(&mut outcome);
    Ok(outcome)
}

/// What the checks of a run follow from, besides its summary.
struct Judging {
    evidence: Evidence,
    case: VerdictCase,
}

impl Judging {
    fn conclude(self, outcome: &mut Outcome) {
        outcome.summary.checks = judge(&outcome.summary, &self.evidence, &self.case, &outcome.calibration.warnings);
        outcome.summary.status = worst(&outcome.summary.checks);
    }
}

/// The estimate, judged on held-out postures.
fn estimate(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<(Outcome, Judging), RunError> {
    let FrontEnd { images, pairs, data, tracks, mut board, warnings: mut texts, ego_mask } =
        front_end(dataset, config, progress)?;
    let mut calibration = calibrate(dataset, &data, config, progress)?;
    if let Some(summary) = &mut board {
        summary.compare(dataset, &data, &calibration)?;
    }
    let held_out = match Evidence::of(&calibration, None, None, dataset.has_joints()).is_unexplained() {
        // Long fits that cannot succeed would not change the verdict.
        true => Err("it does not explain the postures that it was fitted to".to_owned()),
        false => hold_out(dataset, &data, &calibration, config, progress)?,
    };
    if let Err(reason) = &held_out {
        texts.push(format!("the calibration was not judged on held-out postures: {reason}"));
    }
    let held_out = held_out.ok();
    if let Some(jackknife) = held_out.as_ref().and_then(|held_out| held_out.jackknife) {
        calibration.widen(jackknife.variance_factor);
    }
    let PoseSigmas { table: pose_sigmas, recorded: recorded_poses, workspace: workspace_poses } =
        pose_sigmas(dataset, &calibration)?;
    let scale = Scale::of(dataset, &data, &calibration, &pose_sigmas);
    let causes = causes(dataset, &images, &data, &calibration, config, progress)?;
    let registered = recorded_poses.as_ref().and_then(|poses| poses.registered);
    let evidence = Evidence::of(&calibration, held_out.as_ref(), registered, dataset.has_joints());
    let case = evidence.case(causes.first());
    let rig = calibration.model.corrected_rig();
    let trajectory = localize(dataset, &rig)?;
    let (mask, ego_mask) = match ego_mask {
        Some((found, summary)) => ((summary.outcome == MaskOutcome::Found).then_some(found.mask), Some(summary)),
        None => (None, None),
    };
    progress.begin(Stage::Report, 1);
    let report = ReportData::new(dataset, &data, &calibration, &rig, &pose_sigmas)?;
    progress.step();
    let posture_index = |position: usize| dataset.records[position].posture.index;
    let summary = Summary {
        program: "skclam".to_owned(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        schema_version: SCHEMA_VERSION,
        verdict: verdict_sentence(&case),
        status: case.status(),
        case: case.clone(),
        evidence: evidence.clone(),
        causes,
        checks: Vec::new(),
        scale,
        rig: dataset.rig.name.clone(),
        counts: Counts {
            postures: dataset.len(),
            depth_images: dataset.records.iter().filter(|record| record.depth.is_some()).count(),
            pairs: pairs.len(),
            matches: data.match_count(),
            tracks: data.tracks.len(),
            observations: data.observation_count(),
        },
        matching: total_counts(&pairs),
        pairs: pairs
            .iter()
            .map(|matched| PairSummary {
                a: posture_index(matched.pair.a),
                b: posture_index(matched.pair.b),
                predicted_overlap: matched.pair.overlap,
                counts: matched.counts,
            })
            .collect(),
        keypoints: images.iter().map(|image| image.features.keypoints.len()).collect(),
        ego_mask,
        tracks,
        board,
        calibration: CalibrationSummary::of(&calibration, dataset.has_joints()),
        held_out,
        recorded_poses,
        workspace_poses,
        map: None,
        warnings: {
            texts.extend(warnings(&calibration, pairs.len()));
            if !calibration.warnings.iter().any(|warning| matches!(warning, Warning::NoBaseline { .. })) {
                texts.extend(identical_postures(dataset, &images, &pairs));
            }
            texts
        },
        configuration: config.clone(),
        stages: Vec::new(),
        peak_memory_mib: None,
    };
    Ok((
        Outcome { calibration, rig, trajectory, mask, pose_sigmas, maps: None, summary, report },
        Judging { evidence, case },
    ))
}

/// Warnings in words. Where many pairs share little, one sentence says it for all of them: pairs are chosen generously,
/// and the counts of each are in the summary.
fn warnings(calibration: &Calibration, pairs: usize) -> Vec<String> {
    const LISTED_ONE_BY_ONE: usize = 3;
    let few = calibration.warnings.iter().filter(|warning| matches!(warning, Warning::FewMatches { .. })).count();
    let one_by_one = few <= LISTED_ONE_BY_ONE;
    let warnings =
        calibration.warnings.iter().filter(|warning| one_by_one || !matches!(warning, Warning::FewMatches { .. }));
    let mut texts: Vec<String> = warnings.map(Warning::to_string).collect();
    if !one_by_one {
        texts.push(format!("{few} of {pairs} pairs share hardly any matches; see \"pairs\" in summary.json"));
    }
    texts
}

/// Pairs of images taken from one place, by the nominal rig: they have no epipolar geometry and say nothing of the arm
/// (the paper's 73rd posture equals its first).
fn identical_postures(dataset: &Dataset, images: &[ImageFeatures], pairs: &[MatchedPair]) -> Vec<String> {
    const ONE_PLACE_M: f64 = 1e-4;
    let center = |position: usize| images[position].view.base_from_color.translation.vector;
    let index = |position: usize| dataset.records[position].posture.index;
    let same =
        pairs.iter().map(|matched| &matched.pair).filter(|pair| (center(pair.a) - center(pair.b)).norm() < ONE_PLACE_M);
    same.map(|pair| {
        let (a, b) = (index(pair.a), index(pair.b));
        format!("postures {a} and {b} were taken from one place: without a baseline there is no epipolar geometry between them")
    })
    .collect()
}

impl Outcome {
    /// Writes what `docs` promise of a run into a folder that is not yet published.
    pub fn write(&self, staged: &StagedFolder) -> Result<(), RunError> {
        staged.write("rig.toml", self.rig.to_toml()?)?;
        staged.write("trajectory.txt", trajectory_text(&self.trajectory))?;
        staged.write("pose_sigmas.csv", pose_sigmas_csv(&self.pose_sigmas))?;
        if let Some(table) = covariance_csv(&self.calibration) {
            staged.write("covariance.csv", table)?;
        }
        if let Some(mask) = &self.mask {
            let path = staged.path("mask.png")?;
            mask.save(&path).map_err(|error| DatasetError::Image { path, problem: error.to_string() })?;
        }
        if let Some(maps) = &self.maps {
            write_cloud(staged, "map.ply", &maps.calibrated)?;
            write_cloud(staged, "map_nominal.ply", &maps.nominal)?;
        }
        let mut json = serde_json::to_string_pretty(&self.summary)?;
        json.push('\n');
        staged.write("summary.json", json)?;
        staged.write("report_data.json", serde_json::to_string(&self.report)?)?;
        Ok(())
    }
}

/// Writes a cloud as binary PLY into a folder that is not yet published.
pub fn write_cloud(staged: &StagedFolder, name: &str, cloud: &PointCloud) -> Result<(), RunError> {
    let path = staged.path(name)?;
    let io = |source| DatasetError::Io { path: path.clone(), source };
    let mut writer = BufWriter::new(File::create(&path).map_err(io)?);
    write_cloud_ply(cloud, &mut writer)?;
    writer.flush().map_err(io)?;
    Ok(())
}
