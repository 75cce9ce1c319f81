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

    // Judged on postures that the fit did not see, beside the nominal rig and the mount alone.
    let held_out = |rig: &str| number(&summary, &format!("/held_out/metric_px/{rig}"));
    assert!(held_out("calibrated") < 0.2 * held_out("mount_only"), "{}", summary["held_out"]);
    assert_eq!(summary["held_out"]["folds"].as_array().unwrap().len(), 6);
    assert_eq!(summary["status"], "good");
    // The reported error of the camera's position is what the calibration moved it by.
    assert!(number(&summary, "/recorded_poses/camera_change_mm/mean") > 5.0);
    assert!(number(&summary, "/workspace_poses/camera_sigma_mm/max") < 0.2);
    let lines = |name: &str| fs::read_to_string(out.join(name)).unwrap().lines().count();
    assert_eq!((lines("pose_sigmas.csv"), lines("covariance.csv")), (1 + 73 + 256, 1 + 10));

    let validation = |rig: &std::path::Path, refit: &[&str]| {
        json(&succeed(&[&["validate", utf8(cell()), "--rig", utf8(rig), "--json", "--quiet"], refit].concat()))
    };
    let holds = validation(&out, &[]);
    assert!(number(&holds, "/metric_px/calibrated") < 0.1 * number(&holds, "/metric_px/nominal"), "{holds}");
    assert!(holds["verdict"].as_str().unwrap().contains("holds"), "{holds}");
    // The data set's own rig is as good as itself, however its mount is fitted.
    let same = validation(&cell().join("rig.toml"), &["--refit", "mount"]);
    assert!(same["verdict"].as_str().unwrap().contains("exactly as"), "{same}");
    assert_eq!(same["refit"], "the mount");

    let truth = cell().join("truth/rig.toml");
    let evaluation =
        json(&succeed(&["evaluate", utf8(&out), "--truth", utf8(&truth), "--dataset", utf8(cell()), "--json"]));
    // 0.02 mm is the target at full resolution; these images have a tenth of its pixels.
    assert!(number(&evaluation, "/flange/position_mm/mean") < 0.1, "{evaluation}");

    // The result is a rig again, and maps can be built from it; the map of the run and that of the stage are the same.
    let again = folder.path().join("map");
    succeed(&["map", utf8(cell()), "--rig", utf8(&out.join("rig.toml")), "--quiet", "--out", utf8(&again)]);
    assert_eq!(fs::metadata(again.join("map.ply")).unwrap().len(), fs::metadata(out.join("map.ply")).unwrap().len());
    let image = folder.path().join("map.png");
    succeed(&[
        "render",
        utf8(&out.join("map_nominal.ply")),
        "--beside",
        utf8(&out.join("map.ply")),
        "--out",
        utf8(&image),
        "--width",
        "320",
        "--height",
        "200",
    ]);
    assert_eq!(image::image_dimensions(&image).unwrap(), (652, 200));
}

#[test]
fn without_depth_one_length_holds_the_scale() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("result");
    let free = "angles,a_2,d_4";
    succeed(&["calibrate", utf8(cell()), "--no-depth", "--free", free, "--quiet", "--out", utf8(&out)]);
    let summary = json(&fs::read_to_string(out.join("summary.json")).unwrap());
    assert_eq!(number(&summary, "/counts/depth_images"), 0.0);
    assert!(summary["calibration"]["depth_sigma_per_m2"].is_null());
    assert!(number(&summary, "/calibration/epipolar_after/median_px") < 0.3);
}

#[test]
fn a_reader_that_has_seen_enough_is_no_panic() {
    use std::process::{Command, Stdio};
    let mut child = Command::new(env!("CARGO_BIN_EXE_skclam"))
        .args(["inspect", utf8(cell())])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_ne!(output.status.code(), Some(101), "{}", text(&output.stderr));
    assert!(!text(&output.stderr).contains("panicked"), "{}", text(&output.stderr));
}

#[test]
fn a_mount_that_nobody_knows_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    let nominal = fs::read_to_string(cell().join("rig.toml")).unwrap();
    // The camera looks backwards, by this rig, and from the wrong side of the flange.
    let (before, mount) = nominal.split_once("[mount]").unwrap();
    let after = &mount[mount.find("\n[").unwrap()..];
    let unknown = "[mount]\ntranslation_mm = [80.0, 90.0, -50.0]\nquaternion_xyzw = [0.8, 0.0, 0.6, 0.0]\n";
    fs::write(&rig, format!("{before}{unknown}{after}")).unwrap();
    let out = folder.path().join("result");
    succeed(&["calibrate", utf8(cell()), "--rig", utf8(&rig), "--find-mount", "--quiet", "--out", utf8(&out)]);
    let truth = cell().join("truth/rig.toml");
    let evaluation =
        json(&succeed(&["evaluate", utf8(&out), "--truth", utf8(&truth), "--dataset", utf8(cell()), "--json"]));
    assert!(number(&evaluation, "/camera_after_base_gauge/position_mm/mean") < 1.0, "{evaluation}");
}

#[test]
fn the_papers_method_beats_the_papers_results() {
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
        results.push(
            ["rig.toml", "trajectory.txt", "map.ply", "pose_sigmas.csv", "covariance.csv"]
                .map(|name| fs::read(out.join(name)).unwrap()),
        );
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
