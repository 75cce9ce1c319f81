//! A real arm and a real checkerboard: what the corners say before and after, and on postures that were held out.
//!
//! `cargo test --release -p skclam --test real_board -- --nocapture` prints the figures.

use skclam::calibration::{
    BoardPlace, BundleOptions, Correspondences, DeviationPolicy, Model, Rigs, Unit, board_residuals,
    cross_validate_board, default_sigma, fit_mount_to_board, neighbouring_folds,
};
use skclam::dataset::Dataset;
use skclam::pipeline::{Config, calibrate, find_boards, hold_out};
use skclam::progress::Silent;
use std::path::PathBuf;

fn data_set(name: &str) -> Option<Dataset> {
    let shared = std::env::var_os("SKCLAM_DATA")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")), PathBuf::from);
    let folder = shared.join(name);
    if folder.is_dir() {
        return Some(Dataset::open(&folder).unwrap());
    }
    println!("skipped: {} is not there (set SKCLAM_DATA)", folder.display());
    None
}

#[test]
fn a_board_alone_calibrates_a_real_arm() {
    let Some(dataset) = data_set("nachi-mz25") else { return };
    let config = Config::default();
    let (boards, summary) = find_boards(&dataset, &[], &config, &Silent).unwrap().expect("a [board]");
    assert_eq!((summary.postures, summary.corners), (24, 24 * 88), "{summary:?}");
    let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let data = Correspondences { postures, boards, ..Correspondences::default() };

    let all: Vec<usize> = (0..dataset.len()).collect();
    let rms = |model: &Model| board_residuals(model, &data, &all, &all).unwrap().unwrap().rms_px;
    let nominal = rms(&fit_mount_to_board(&dataset.rig, &data).unwrap());
    let calibration = calibrate(&dataset, &data, &config, &Silent).unwrap();
    let calibrated = rms(&calibration.model);
    println!(
        "RMS of {} corners: {nominal:.3} px with the mount fitted, {calibrated:.3} px calibrated",
        summary.corners
    );
    assert!((1.1..1.2).contains(&nominal), "{nominal}");
    assert!(calibrated < 0.40, "{calibrated}");

    // What an arm is made to: no change beyond three times its tolerance.
    for estimate in &calibration.parameters {
        let tolerance = default_sigma(&dataset.rig, estimate.parameter);
        let change = estimate.value - estimate.nominal;
        let (factor, unit) = match estimate.parameter.unit() {
            Unit::Metre => (1e3, "mm"),
            _ => (1f64.to_degrees(), "deg"),
        };
        let [change, tolerance] = [change, tolerance].map(|value| value * factor);
        println!("{}: {change:+.3} {unit}, tolerance {tolerance:.3} {unit}", estimate.parameter);
        assert!(change.abs() < 3.0 * tolerance, "{}: {change} beyond {tolerance}", estimate.parameter);
    }
}

/// Groups of four were taken with the first three joints at rest, so a fold holds out one of six positions of the arm.
#[test]
fn held_out_positions_of_a_real_arm() {
    let Some(dataset) = data_set("nachi-mz25") else { return };
    let config = Config::default();
    let (boards, _) = find_boards(&dataset, &[], &config, &Silent).unwrap().expect("a [board]");
    let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let data = Correspondences { postures, boards, ..Correspondences::default() };
    // As `skclam run` judges: the board is laid anew into the held-out postures, the rig stays as the others made it.
    let judged = hold_out(&dataset, &data, &config, &Silent).unwrap().expect("enough postures");
    for fold in &judged.folds {
        let Rigs { nominal, mount_only, calibrated } = fold.figure_px;
        let mount_only = mount_only.unwrap();
        println!(
            "held out {:?}, laid anew: {nominal:.3} px nominal, {mount_only:.3} px mount fitted, {calibrated:.3} px calibrated",
            fold.postures
        );
        assert!(calibrated < nominal, "{fold:?}");
    }
    println!("all: {:?}", judged.figure_px);
    assert!(judged.beats_mount_only().unwrap() && judged.figure_px.calibrated < 0.6 * judged.figure_px.nominal);

    // Stricter: the board where the others saw it. Postures 4 to 7 stand alone: without them joints 2 and 3 move on a line, and what lies beyond
    // is extrapolated.
    let groups = neighbouring_folds(24, 6);
    let options = BundleOptions { deviations: DeviationPolicy::Off, ..BundleOptions::default() };
    let folds = cross_validate_board(&dataset.rig, &data, &options, &groups, BoardPlace::AsTrained).unwrap();
    for fold in &folds {
        let (nominal, calibrated) = (fold.nominal.rms_px, fold.calibrated.rms_px);
        println!(
            "held out {:?}, as trained: {nominal:.3} px mount fitted, {calibrated:.3} px calibrated",
            fold.held_out
        );
    }
    let better = folds.iter().filter(|fold| fold.calibrated.rms_px < fold.nominal.rms_px).count();
    println!("as trained, better in {better} of 6 folds");
    assert!(better >= 4, "{better}");
}
