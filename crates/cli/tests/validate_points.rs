//! `validate --points`: a rig by measured points, without images, and what a script does with its status.

mod support;

use skclam::geometry::Point3;
use skclam::rig::{Posture, PostureState, Rig, builtin_rig};
use std::fs;
use support::{fail, skclam, succeed, text, utf8};

/// A folder with `truth.toml`, `off.toml` and `points.csv`: 60 points at 12 arm positions, exact to the micrometre.
fn measured() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let truth = builtin_rig("hp3j").unwrap().unwrap();
    let mut off = truth.clone();
    let arm = off.robot.as_mut().unwrap();
    for (at, id) in arm.parameter_ids().into_iter().enumerate() {
        let value = arm.parameter(id).unwrap();
        arm.set_parameter(id, value + 1e-3 * (at as f64 * 1.7).sin()).unwrap();
    }
    fs::write(folder.path().join("truth.toml"), truth.to_toml().unwrap()).unwrap();
    fs::write(folder.path().join("off.toml"), off.to_toml().unwrap()).unwrap();
    fs::write(folder.path().join("points.csv"), table(&truth)).unwrap();
    folder
}

fn table(rig: &Rig) -> String {
    let mut table = "index,group,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_mm,y_mm,z_mm\n".to_owned();
    for at in 0..60 {
        let spread = |joint: usize, step: usize| 0.9 * ((step * 7 + joint * 5) as f64 * 1.3).sin();
        let joints: Vec<f64> = (0..6).map(|joint| spread(joint, if joint < 3 { at / 5 } else { at })).collect();
        let flange = rig.base_from_flange(&Posture::new(0, PostureState::Joints(joints.clone()))).unwrap();
        let marker = flange * Point3::new(0.03, -0.08, 0.11);
        let joints: Vec<String> = joints.iter().map(|value| format!("{value:.12}")).collect();
        // Axes of the tracker: its x, y, z are y, z, x of the base.
        let [x, y, z] = [marker.y, marker.z, marker.x].map(|metres| 1e3 * metres);
        table += &format!("{at},{},{},{x:.3},{y:.3},{z:.3}\n", at / 5, joints.join(","));
    }
    table
}

#[test]
fn a_rig_is_judged_without_images() {
    let folder = measured();
    let [truth, off, points] = ["truth.toml", "off.toml", "points.csv"].map(|name| folder.path().join(name));
    let [truth, off, points] = [utf8(&truth), utf8(&off), utf8(&points)];
    let judged = |rig: &str, nominal: &str, more: &[&str]| {
        skclam(&[&["validate", "--points", points, "--rig", rig, "--nominal", nominal], more].concat())
    };

    let printed = succeed(&["validate", "--points", points, "--rig", truth, "--nominal", off, "--json"]);
    let json: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let found = &json["points"];
    assert_eq!((found["comparison"]["status"].as_str(), found["clusters"].as_u64()), (Some("good"), Some(12)));
    assert!(found["tested"]["rms_mm"].as_f64().unwrap() < 2e-3, "{found}");
    for (axis, expected) in [30.0, -80.0, 110.0].into_iter().enumerate() {
        assert!((found["tested"]["offsets"][0]["offset_mm"][axis].as_f64().unwrap() - expected).abs() < 0.01);
    }

    // Exit codes follow the status.
    for (rig, nominal, fail_on, code, said) in [
        (truth, off, "caution", 0, "The rig is better"),
        (off, off, "bad", 0, "do NOT distinguish"),
        (off, off, "caution", 1, "do NOT distinguish"),
        (off, truth, "bad", 1, "is WORSE"),
        (off, truth, "caution", 1, "is WORSE"),
    ] {
        let output = judged(rig, nominal, &["--fail-on", fail_on]);
        assert_eq!(output.status.code(), Some(code), "{fail_on}: {}", text(&output.stderr));
        assert!(text(&output.stdout).contains(said), "{}", text(&output.stdout));
        assert_eq!(text(&output.stderr).contains("--fail-on"), code == 1);
    }
    let output = judged(off, truth, &[]);
    assert_eq!(output.status.code(), Some(0), "without --fail-on a bad rig is a result");

    // A rig alone has errors and no status.
    let alone = succeed(&["validate", "--points", points, "--rig", off]);
    assert!(alone.contains("no nominal rig beside it"), "{alone}");
    assert!(fail(&["validate", "--points", points, "--rig", off, "--fail-on", "bad"]).contains("--nominal"));
    assert_eq!(skclam(&["validate", "--rig", off]).status.code(), Some(2));
}

#[test]
fn damaged_tables_are_refused_and_gross_errors_named() {
    let folder = measured();
    let (rig, points) = (folder.path().join("truth.toml"), folder.path().join("points.csv"));
    let whole = fs::read_to_string(&points).unwrap();
    let refused = |table: &str, expected: &str| {
        fs::write(&points, table).unwrap();
        let message = fail(&["validate", "--points", utf8(&points), "--rig", utf8(&rig)]);
        assert!(message.contains("points.csv") && message.contains(expected), "\"{message}\" lacks \"{expected}\"");
    };
    let lines: Vec<&str> = whole.lines().collect();
    refused("", "no joint columns");
    refused(&lines[..5].join("\n"), "4 measured points");
    refused(&whole[..whole.len() - 30], "line 61");
    refused(&whole.replacen("z_mm", "height", 1), "unknown column \"height\"");
    refused(&whole.replacen(",q6_rad", ",q7_rad", 1), "q1 to q6");
    refused(&whole.replacen("\n7,", "\n7.5,", 1), "line 9: index is \"7.5\"");

    // The tracker lost the marker at two points.
    let lost: Vec<String> = lines
        .iter()
        .enumerate()
        .map(|(at, line)| {
            let cells: Vec<&str> = line.split(',').collect();
            if at == 10 || at == 40 { format!("{},0,0,0", cells[..8].join(",")) } else { (*line).to_owned() }
        })
        .collect();
    fs::write(&points, lost.join("\n")).unwrap();
    let output = skclam(&["validate", "--points", utf8(&points), "--rig", utf8(&rig)]);
    assert!(output.status.success());
    let warnings = text(&output.stderr);
    assert!(warnings.contains("line 11, index 9") && warnings.contains("line 41, index 39"), "{warnings}");
    assert!(text(&output.stdout).contains("2 outliers"), "{}", text(&output.stdout));
}
