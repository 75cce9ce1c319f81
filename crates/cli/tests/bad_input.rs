//! What a stranger's folder can be wrong in: each case a clear error or a named warning, and never a half-written
//! result.

mod support;

use std::fs;
use std::path::Path;
use support::{edit, fail, skclam, small_copy, text, utf8};

/// Asks that a run fails, names every expected word, and leaves nothing behind.
fn refused(folder: &Path, expected: &[&str]) {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("result");
    let message = fail(&["run", utf8(folder), "--out", utf8(&out), "--quiet"]);
    for word in expected {
        assert!(message.contains(word), "\"{message}\" lacks \"{word}\"");
    }
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0, "something was left behind");
}

#[test]
fn missing_and_truncated_files() {
    let copy = small_copy(4);
    fs::remove_file(copy.path().join("color/002.jpg")).unwrap();
    refused(copy.path(), &["postures.csv, line 4", "posture 2", "color/002.jpg is not there"]);

    let copy = small_copy(4);
    let image = copy.path().join("color/001.jpg");
    let bytes = fs::read(&image).unwrap();
    fs::write(&image, &bytes[..200]).unwrap();
    refused(copy.path(), &["color/001.jpg"]);
    fs::write(&image, &bytes[..bytes.len() - 500]).unwrap();
    refused(copy.path(), &["color/001.jpg", "breaks off"]);

    let copy = small_copy(4);
    let depth = copy.path().join("depth/003.png");
    let bytes = fs::read(&depth).unwrap();
    fs::write(&depth, &bytes[..bytes.len() / 2]).unwrap();
    refused(copy.path(), &["depth/003.png"]);

    for file in ["rig.toml", "postures.csv"] {
        let copy = small_copy(4);
        fs::remove_file(copy.path().join(file)).unwrap();
        refused(copy.path(), &[file]);
        fs::write(copy.path().join(file), "").unwrap();
        refused(copy.path(), &[file]);
    }
}

#[test]
fn images_that_do_not_fit_the_rig() {
    let copy = small_copy(3);
    edit(copy.path(), "rig.toml", "width = 576", "width = 640");
    refused(copy.path(), &["color/000.jpg", "576 x 324", "640 x 324", "[color]"]);

    let copy = small_copy(3);
    image::RgbImage::new(144, 108).save(copy.path().join("depth/001.png")).unwrap();
    refused(copy.path(), &["depth/001.png", "16-bit"]);
}

#[test]
fn numbers_that_are_none() {
    let copy = small_copy(3);
    edit(copy.path(), "rig.toml", "fy = ", "fy = nan # ");
    refused(copy.path(), &["rig.toml", "color.fy"]);

    let copy = small_copy(3);
    edit(copy.path(), "postures.csv", "\n1,1.000000,", "\n1,1.000000,nan");
    refused(copy.path(), &["postures.csv", "line 3", "q1_deg"]);
}

#[test]
fn a_joint_without_a_column_is_named_once() {
    let copy = small_copy(3);
    let table = fs::read_to_string(copy.path().join("postures.csv")).unwrap();
    let header: Vec<&str> = table.lines().next().unwrap().split(',').collect();
    let dropped = header.iter().position(|name| *name == "q6_deg").unwrap();
    let without = |line: &str| {
        let cells: Vec<&str> =
            line.split(',').enumerate().filter(|(at, _)| *at != dropped).map(|(_, cell)| cell).collect();
        cells.join(",") + "\n"
    };
    fs::write(copy.path().join("postures.csv"), table.lines().map(without).collect::<String>()).unwrap();
    refused(copy.path(), &["line 1", "no column q6_deg"]);

    let empty = tempfile::tempdir().unwrap();
    let message = fail(&["run", utf8(empty.path()), "--out", utf8(&empty.path().join("out")), "--quiet"]);
    assert!(message.contains("no rig.toml in it") && message.contains("skclam import"), "{message}");
}

#[test]
fn tables_that_contradict_themselves() {
    let copy = small_copy(3);
    edit(copy.path(), "postures.csv", "\n2,", "\n1,");
    refused(copy.path(), &["line 4", "index 1 follows 1"]);

    let copy = small_copy(3);
    edit(copy.path(), "postures.csv", "q6_deg", "speed");
    refused(copy.path(), &["line 1", "unknown column \"speed\""]);

    let copy = small_copy(3);
    edit(copy.path(), "rig.toml", "[mount]", "colour = 3\n[mount]");
    refused(copy.path(), &["rig.toml", "colour"]);

    // A rig with one joint fewer than the table.
    let copy = small_copy(3);
    let path = copy.path().join("rig.toml");
    let rig = fs::read_to_string(&path).unwrap();
    let (first, last) = (rig.find("[[robot.joint]]").unwrap(), rig.rfind("[[robot.joint]]").unwrap());
    let mount = rig.find("[mount]").unwrap();
    assert!(first < last && last < mount);
    fs::write(&path, format!("{}{}", &rig[..last], &rig[mount..])).unwrap();
    refused(copy.path(), &["postures.csv, line 1", "5 joints", "q6_deg belongs to none"]);
}

#[test]
fn a_recording_of_one_posture() {
    refused(small_copy(1).path(), &["1 posture", "at least 2"]);
}

#[test]
fn a_scene_without_texture() {
    let copy = small_copy(4);
    for index in 0..4 {
        let plain = image::RgbImage::from_pixel(576, 324, image::Rgb([120, 120, 120]));
        plain.save(copy.path().join(format!("color/{index:03}.jpg"))).unwrap();
    }
    refused(copy.path(), &["no pair of images has enough matches", "0 keypoints", "texture"]);
}

#[test]
fn images_of_another_place_than_the_joints_say() {
    // Every image shows what another posture saw: all matches are wrong.
    let copy = small_copy(30);
    let bytes: Vec<Vec<u8>> =
        (0..30).map(|i| fs::read(copy.path().join(format!("color/{i:03}.jpg"))).unwrap()).collect();
    for index in 0..30 {
        fs::write(copy.path().join(format!("color/{index:03}.jpg")), &bytes[(index * 11 + 5) % 30]).unwrap();
    }
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("result");
    let output = skclam(&["run", utf8(copy.path()), "--free", "angles", "--out", utf8(&out)]);
    let said = text(&output.stderr) + &text(&output.stdout);
    // Refused for lack of matches, or done with a verdict that warns; never praised.
    let refused =
        said.contains("enough matches") || said.contains("matches are needed") || said.contains("DO NOT TRUST");
    assert!(refused, "{said}");
}

#[test]
fn a_pair_of_identical_postures_is_named_and_skipped() {
    let copy = small_copy(12);
    fs::copy(copy.path().join("color/000.jpg"), copy.path().join("color/012.jpg")).unwrap();
    fs::copy(copy.path().join("depth/000.png"), copy.path().join("depth/012.png")).unwrap();
    let table = fs::read_to_string(copy.path().join("postures.csv")).unwrap();
    let first = table.lines().nth(1).unwrap();
    let again =
        first.replacen("0,0.000000,", "12,12.000000,", 1).replace("000.jpg", "012.jpg").replace("000.png", "012.png");
    fs::write(copy.path().join("postures.csv"), table.clone() + &again + "\n").unwrap();
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("result");
    let output = skclam(&["run", utf8(copy.path()), "--free", "angles", "--out", utf8(&out)]);
    let said = text(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("no epipolar geometry"), "{said}");
}

#[test]
fn a_posture_that_no_other_overlaps_is_named() {
    let copy = small_copy(10);
    // Posture 9 looks at the other side of the cell: its images are those of posture 40.
    for (name, ending) in [("color", "jpg"), ("depth", "png")] {
        fs::copy(
            support::cell().join(format!("{name}/040.{ending}")),
            copy.path().join(format!("{name}/009.{ending}")),
        )
        .unwrap();
    }
    let table = fs::read_to_string(support::cell().join("postures.csv")).unwrap();
    let far = table.lines().nth(41).unwrap().replacen("40,40.000000,", "9,9.000000,", 1).replace("040.", "009.");
    let copied = fs::read_to_string(copy.path().join("postures.csv")).unwrap();
    let mut lines: Vec<&str> = copied.lines().collect();
    lines.pop();
    fs::write(copy.path().join("postures.csv"), lines.join("\n") + "\n" + &far + "\n").unwrap();
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("result");
    let output = skclam(&["run", utf8(copy.path()), "--free", "angles", "--out", utf8(&out)]);
    let said = text(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("(index 9) has no usable correspondence"), "{said}");
}

#[test]
fn a_result_folder_that_cannot_be() {
    let copy = small_copy(3);
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("file");
    fs::write(&file, "mine").unwrap();
    let message = fail(&["run", utf8(copy.path()), "--out", utf8(&file), "--quiet"]);
    assert!(message.contains("is a file"), "{message}");
    assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
}
