//! A real arm and a real checkerboard: what the corners say before and after, and on postures that were held out.
//!
//! `cargo test --release -p skclam --test real_board -- --nocapture` prints the metrics.

use skclam::calibration::{
    Calibration, Correspondences, Model, PriorGroup, Rigs, aligned_positions, board_residuals, default_sigma,
    fit_mount_to_board,
};
use skclam::dataset::Dataset;
use skclam::marker_points::{MarkerPoints, validate_points};
use skclam::pipeline::{Config, calibrate, find_boards, hold_out};
use skclam::progress::Silent;
use std::path::PathBuf;

fn shared(name: &str) -> Option<PathBuf> {
    let shared = std::env::var_os("SKCLAM_DATA")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")), PathBuf::from);
    let folder = shared.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: {} is not there (set SKCLAM_DATA)", folder.display());
    None
}

/// A recording of the board, as `skclam run` reads it.
struct BoardRecording {
    dataset: Dataset,
    data: Correspondences,
}

impl BoardRecording {
    fn open(name: &str) -> Option<Self> {
        let dataset = Dataset::open(&shared(name)?).unwrap();
        let (boards, summary) = find_boards(&dataset, &[], &Config::default(), &Silent).unwrap().expect("a [board]");
        assert_eq!((summary.postures, summary.corners), (24, 24 * 88), "{summary:?}");
        let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
        let data = Correspondences { postures, boards, ..Correspondences::default() };
        Some(BoardRecording { dataset, data })
    }

    fn calibrated(&self) -> Calibration {
        calibrate(&self.dataset, &self.data, &Config::default(), &Silent).unwrap()
    }
}

#[test]
fn a_board_alone_calibrates_a_real_arm() {
    let Some(recording) = BoardRecording::open("nachi-mz25") else { return };
    let BoardRecording { dataset, data } = &recording;
    let all: Vec<usize> = (0..dataset.len()).collect();
    let rms = |model: &Model| board_residuals(model, data, &all, &all).unwrap().unwrap().rms_px;
    let nominal = rms(&fit_mount_to_board(&dataset.rig, data).unwrap());
    let calibration = recording.calibrated();
    let calibrated = rms(&calibration.model);
    println!("RMS of the corners: {nominal:.3} px with the mount fitted, {calibrated:.3} px calibrated");
    println!("{:?} {:?} {:?}", calibration.noise, calibration.prior_scales, calibration.warnings);
    assert!((1.1..1.2).contains(&nominal), "{nominal}");
    // Joints are off in every posture anew, and the calibrated arm alone does not know by how much: what is left is
    // more than the corners' noise.
    assert!(calibrated < 0.75 * nominal, "{calibrated}");
    // Corners scatter about as their own sigmas say.
    assert!((0.5..2.0).contains(&calibration.noise.pixel), "{:?}", calibration.noise);
    let joint_error = calibration.noise.posture_angular.unwrap().to_degrees();
    assert!((0.005..0.05).contains(&joint_error), "{joint_error} deg");

    // No change beyond three times what the evidence has an arm made to, and cameras and boards are known to.
    let of_arm = |group: Option<PriorGroup>| calibration.prior_scales.iter().find(|scale| Some(scale.group) == group);
    for estimate in &calibration.parameters {
        let scale = of_arm(PriorGroup::of(estimate.parameter));
        let tolerance = scale.map_or_else(|| default_sigma(&dataset.rig, estimate.parameter), |scale| scale.sigma);
        let change = estimate.value - estimate.nominal;
        let (factor, unit) = estimate.parameter.unit().of_files();
        let [change, tolerance] = [change, tolerance].map(|value| value * factor);
        println!("{}: {change:+.4} {unit}, tolerance {tolerance:.4} {unit}", estimate.parameter);
        assert!(change.abs() < 3.0 * tolerance, "{}: {change} beyond {tolerance}", estimate.parameter);
    }
}

/// Of the first day and of another, 18 days later, beside positions of a marker that an optical tracker measured:
/// better than nominal by what no image knows.
#[test]
fn a_tracker_confirms_the_calibration_of_two_days() {
    let Some(folder) = shared("nachi-mz25") else { return };
    let points = MarkerPoints::read(folder.join("tracker.csv")).unwrap();
    for name in ["nachi-mz25", "nachi-mz25-second-day"] {
        let Some(recording) = BoardRecording::open(name) else { return };
        let calibration = recording.calibrated();
        let nominal = &recording.dataset.rig;
        let found = validate_points(&points, &calibration.model.corrected_rig(), Some(nominal)).unwrap();
        let before = found.nominal.unwrap().rms_mm;
        println!(
            "{name}: {before:.3} mm RMS nominal, {:.3} mm calibrated; {:?}",
            found.tested.rms_mm, found.comparison
        );
        let claimed = aligned_positions(nominal, &calibration, &recording.data.postures).unwrap();
        println!("   claimed over the recorded postures: {claimed:?}");
        assert!((before - 0.729).abs() < 0.001, "{before}");
        assert!(found.tested.rms_mm < 0.60, "{name}: {}", found.tested.rms_mm);
    }
}

/// Groups of four were taken with the first three joints at rest: a fold holds out one of six positions of the arm, and
/// the board lies where the others saw it.
#[test]
fn held_out_positions_of_a_real_arm() {
    let Some(recording) = BoardRecording::open("nachi-mz25") else { return };
    let BoardRecording { dataset, data } = &recording;
    let calibration = recording.calibrated();
    let judged = hold_out(dataset, data, &calibration, &Config::default(), &Silent).unwrap().expect("enough postures");
    assert_eq!(judged.folds.len(), 6);
    for (at, fold) in judged.folds.iter().enumerate() {
        let of_one: Vec<u64> = (4 * at as u64..4 * at as u64 + 4).collect();
        assert_eq!(fold.postures, of_one);
        let Rigs { nominal, mount_only, calibrated } = fold.metric_px;
        let mount_only = mount_only.unwrap();
        println!(
            "held out {:?}: {nominal:.3} px nominal, {mount_only:.3} px mount fitted, {calibrated:.3} px calibrated",
            fold.postures
        );
    }
    println!("all: {:?}, better in {} of 6; {:?}", judged.metric_px, judged.better_folds, judged.jackknife);
    assert!(judged.beats_nominal() && judged.beats_mount_only().unwrap(), "{:?}", judged.metric_px);
    assert!(judged.better_folds >= 4, "{:?}", judged.folds);
    assert!(judged.jackknife.unwrap().variance_factor >= 1.0);
}
