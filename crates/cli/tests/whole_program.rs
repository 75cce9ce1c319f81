//! The program on a small virtual cell: from images to a rig that is right, its files read back.

mod support;

use std::fs;
use support::{cell, fail, skclam, succeed, text, utf8};

fn number(value: &serde_json::Value, path: &str) -> f64 {
    value.pointer(path).and_then(serde_json::Value::as_f64).unwrap_or_else(|| panic!("{path} is no number in {value}"))
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).expect("JSON")
}

#[test]
fn a_run_leaves_its_four_files_and_they_can_be_used_again() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("result");
    let printed = succeed(&["run", utf8(cell()), "--free", "angles", "--json", "--quiet", "--out", utf8(&out)]);
    let summary = json(&fs::read_to_string(out.join("summary.json")).unwrap());
    assert_eq!(json(&printed), summary, "--json prints the summary");
    assert!(number(&summary, "/calibration/epipolar_after/median_px") < 0.3);
    assert_eq!(number(&summary, "/calibration/rank"), 10.0);
    assert!(summary["stages"].as_array().unwrap().len() >= 4);
    assert_eq!(
        fs::read_to_string(out.join("trajectory.txt")).unwrap().lines().filter(|line| !line.starts_with('#')).count(),
        73
    );

    let truth = cell().join("truth/rig.toml");
    let evaluation =
        json(&succeed(&["evaluate", utf8(&out), "--truth", utf8(&truth), "--dataset", utf8(cell()), "--json"]));
    // 0.02 mm is the target at full resolution; these images have a tenth of its pixels.
    assert!(number(&evaluation, "/flange/position_mm/mean") < 0.1, "{evaluation}");

    // The result is a rig again, and maps can be built from it; the map of the run and that of the stage are the same.
    let again = folder.path().join("map");
    succeed(&["map", utf8(cell()), "--rig", utf8(&out.join("rig.toml")), "--quiet", "--out", utf8(&again)]);
    assert_eq!(fs::metadata(again.join("map.ply")).unwrap().len(), fs::metadata(out.join("map.ply")).unwrap().len());
    let picture = folder.path().join("map.png");
    succeed(&[
        "render",
        utf8(&out.join("map_nominal.ply")),
        "--beside",
        utf8(&out.join("map.ply")),
        "--out",
        utf8(&picture),
        "--width",
        "320",
        "--height",
        "200",
    ]);
    assert_eq!(image::image_dimensions(&picture).unwrap(), (652, 200));
}

#[test]
fn the_papers_method_beats_the_papers_figures() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("result");
    succeed(&["calibrate", utf8(cell()), "--preset", "paper", "--quiet", "--out", utf8(&out)]);
    assert!(!out.join("map.ply").exists(), "calibrate builds no map");
    let truth = cell().join("truth/rig.toml");
    let evaluation =
        json(&succeed(&["evaluate", utf8(&out), "--truth", utf8(&truth), "--dataset", utf8(cell()), "--json"]));
    // The paper: 0.25 mm from images with eleven times as many pixels.
    assert!(number(&evaluation, "/flange/position_mm/mean") < 0.25, "{evaluation}");
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let mut results = Vec::new();
    for threads in ["1", "2", "3"] {
        let out = folder.path().join(threads);
        succeed(&["run", utf8(cell()), "--threads", threads, "--quiet", "--out", utf8(&out)]);
        results.push(["rig.toml", "trajectory.txt", "map.ply"].map(|name| fs::read(out.join(name)).unwrap()));
    }
    assert!(results[0] == results[1] && results[0] == results[2]);
}

#[test]
fn the_configuration_of_a_summary_repeats_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    succeed(&["calibrate", utf8(cell()), "--preset", "paper", "--seed", "7", "--quiet", "--out", utf8(&first)]);
    let summary = first.join("summary.json");
    succeed(&["calibrate", utf8(cell()), "--config", utf8(&summary), "--quiet", "--out", utf8(&second)]);
    assert_eq!(fs::read(first.join("rig.toml")).unwrap(), fs::read(second.join("rig.toml")).unwrap());
}

#[test]
fn wrong_use_ends_with_2_and_help_teaches() {
    for arguments in [
        &["run"][..],
        &["run", "cell"],
        &["simulate", "--out", "x", "--count", "1"],
        &["fly"],
        &["--threads", "0", "run"],
    ] {
        assert_eq!(skclam(arguments).status.code(), Some(2), "{arguments:?}");
    }
    let help = text(&skclam(&["run", "--help"]).stdout);
    assert!(help.contains("--preset") && help.contains("Examples:"), "{help}");
    assert!(text(&skclam(&["completions", "bash"]).stdout).contains("complete"));
    let message = fail(&["run", "no/such/folder", "--out", "never"]);
    assert!(message.contains("no/such/folder"), "{message}");
}
