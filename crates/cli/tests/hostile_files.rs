//! Files that strangers made, and systems that end in the middle: nothing lost, nothing outside, nothing that hangs.

#![cfg(unix)]

mod support;

use std::fs;
use std::os::unix::fs::symlink;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};
use support::{edit, fail, skclam, small_copy, succeed, text, utf8};

/// Waits for the end of a program; kills one that does not come to it.
fn ended(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let deadline = Instant::now() + limit;
    while Instant::now() < deadline {
        if let Some(status) = child.try_wait().expect("a status") {
            return Some(status);
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().expect("it is killed");
    child.wait().expect("it ended");
    None
}

/// Runs the program and asks that it ends by itself in a few seconds, with 1; what it said.
fn fails_soon(arguments: &[&str]) -> String {
    let mut child = Command::new(env!("CARGO_BIN_EXE_skclam"))
        .args(arguments)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let status = ended(&mut child, Duration::from_secs(20)).unwrap_or_else(|| panic!("{arguments:?} does not end"));
    let message = std::io::read_to_string(child.stderr.take().expect("a pipe")).expect("text");
    assert_eq!(status.code(), Some(1), "{arguments:?}: {message}");
    message
}

fn pipe(path: &Path) {
    let made = Command::new("mkfifo").arg(path).status().expect("mkfifo runs");
    assert!(made.success());
}

/// A small result with everything that a run leaves but the map.
fn result(place: &Path) -> PathBuf {
    let out = place.join("result");
    succeed(&["calibrate", utf8(small_copy(12).path()), "--free", "angles", "--quiet", "--out", utf8(&out)]);
    out
}

#[test]
fn names_in_files_do_not_lead_out_of_their_folder() {
    let copy = small_copy(3);
    fs::write(copy.path().parent().unwrap().join("skclam-victim"), "x").unwrap();
    // Images, by their letters and by a link.
    edit(copy.path(), "postures.csv", "color/001.jpg", "../skclam-victim");
    let out = copy.path().join("out");
    let message = fails_soon(&["run", utf8(copy.path()), "--quiet", "--out", utf8(&out)]);
    assert!(message.contains("line 3") && message.contains("leaves the folder"), "{message}");
    fs::remove_file(copy.path().parent().unwrap().join("skclam-victim")).unwrap();

    let copy = small_copy(3);
    let outside = tempfile::tempdir().unwrap();
    fs::rename(copy.path().join("color/001.jpg"), outside.path().join("001.jpg")).unwrap();
    symlink(outside.path().join("001.jpg"), copy.path().join("color/001.jpg")).unwrap();
    let message = fails_soon(&["run", utf8(copy.path()), "--quiet", "--out", utf8(&out)]);
    assert!(message.contains("link that leads out of the folder"), "{message}");

    // Masks and robot descriptions of a rig.
    for (from, to) in
        [("[color]", "[color]\nmask = \"../victim.png\""), ("[color]", "[color]\nmask = \"/etc/hostname\"")]
    {
        let copy = small_copy(3);
        edit(copy.path(), "rig.toml", from, to);
        let message = fails_soon(&["inspect", utf8(copy.path())]);
        assert!(message.contains("color.mask") && message.contains("leaves the folder"), "{message}");
    }
}

#[test]
fn pipes_and_endless_devices_are_refused_at_once() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let copy = small_copy(3);
    pipe(&path("pipe.bag"));
    assert!(fails_soon(&["inspect", utf8(&path("pipe.bag"))]).contains("is a pipe"));
    fs::remove_file(copy.path().join("color/001.jpg")).unwrap();
    pipe(&copy.path().join("color/001.jpg"));
    assert!(fails_soon(&["inspect", utf8(copy.path())]).contains("is a pipe"));

    let copy = small_copy(3);
    let (data, out) = (utf8(copy.path()).to_owned(), utf8(&path("out")).to_owned());
    let rig = copy.path().join("rig.toml");
    for arguments in [
        vec!["run", &data, "--config", "/dev/zero"],
        vec!["run", &data, "--rig", "/dev/zero"],
        vec!["map", &data, "--self-filter", "/dev/zero"],
        vec!["export", utf8(&rig), "--nominal", utf8(&rig), "--urdf", "/dev/zero"],
        vec!["compensate", "/dev/zero", "--nominal", utf8(&rig), "--calibrated", utf8(&rig)],
        vec!["render", "/dev/zero"],
    ] {
        let out = if arguments[0] == "render" { format!("{out}.png") } else { out.clone() };
        let message = fails_soon(&[arguments.as_slice(), &["--out", &out]].concat());
        assert!(message.contains("/dev/zero") && message.contains("is a device"), "{arguments:?}: {message}");
    }
    fs::remove_file(copy.path().join("postures.csv")).unwrap();
    symlink("/dev/zero", copy.path().join("postures.csv")).unwrap();
    assert!(fails_soon(&["calibrate", &data, "--out", &out]).contains("is a device"));
    // A terabyte without a byte in it.
    fs::remove_file(copy.path().join("postures.csv")).unwrap();
    fs::File::create(copy.path().join("postures.csv")).unwrap().set_len(1 << 40).unwrap();
    assert!(fails_soon(&["calibrate", &data, "--out", &out]).contains("1099511627776 bytes"));
}

#[test]
fn what_names_hold_is_never_obeyed_by_a_terminal() {
    let copy = small_copy(12);
    let evil = "\\u001b]0;pwned\\u0007\\u009b31m\\u202e=HYPERLINK(1)";
    edit(copy.path(), "rig.toml", "name = \"S\"", &format!("name = \"{evil}\""));
    let harmful = |text: &str| text.chars().any(|c| skclam_files::is_harmful(c) && !"\n\t".contains(c));
    let output = skclam(&["inspect", utf8(copy.path())]);
    let said = text(&output.stdout) + &text(&output.stderr);
    assert!(said.contains("\\u{1b}]0;pwned") && !harmful(&said), "{said}");
    let json = succeed(&["inspect", utf8(copy.path()), "--json", "--quiet"]);
    assert!(!harmful(&json), "{json}");
    serde_json::from_str::<serde_json::Value>(&json).expect("JSON");
    edit(copy.path(), "rig.toml", "a_mm = ", "a_mm = nan # ");
    let message = fail(&["inspect", utf8(copy.path())]);
    assert!(message.contains("\\u{1b}") && !harmful(&message), "{message}");

    // Pages, descriptions and tables.
    let copy = small_copy(12);
    edit(copy.path(), "rig.toml", "name = \"S\"", &format!("name = \"{evil}\""));
    let out = copy.path().join("result");
    succeed(&["calibrate", utf8(copy.path()), "--free", "angles", "--quiet", "--out", utf8(&out)]);
    // The page carries a script that has controls of its own; none of the name's is among them.
    let page = fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("pwned") && !page.contains(['\u{1b}', '\u{7}', '\u{9b}', '\u{202e}']));
    let export = copy.path().join("export");
    succeed(&[
        "export",
        utf8(&out),
        "--nominal",
        utf8(&copy.path().join("rig.toml")),
        "--quiet",
        "--out",
        utf8(&export),
    ]);
    for file in ["robot.urdf", "corrections.csv"] {
        let written = fs::read_to_string(export.join(file)).unwrap();
        assert!(!harmful(&written) && !written.contains(",=HYPERLINK"), "{file}: {written}");
    }
}

#[test]
fn a_full_standard_output_is_an_error_and_no_panic() {
    if !Path::new("/dev/full").exists() {
        eprintln!("skipped: there is no /dev/full");
        return;
    }
    let copy = small_copy(3);
    for arguments in
        [vec!["completions", "bash"], vec!["inspect", utf8(copy.path())], vec!["inspect", utf8(copy.path()), "--json"]]
    {
        let full = fs::File::options().write(true).open("/dev/full").unwrap();
        let output = Command::new(env!("CARGO_BIN_EXE_skclam")).args(&arguments).stdout(full).output().unwrap();
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{arguments:?}: {message}");
        assert!(message.contains("error: standard output") && !message.contains("panicked"), "{message}");
        // With both closed nobody reads it.
        let full = || fs::File::options().write(true).open("/dev/full").unwrap();
        let status =
            Command::new(env!("CARGO_BIN_EXE_skclam")).args(&arguments).stdout(full()).stderr(full()).status().unwrap();
        assert_eq!(status.code(), Some(1), "{arguments:?}");
    }
}

#[test]
fn a_signal_ends_every_command_within_a_second_and_leaves_nothing() {
    let place = tempfile::tempdir().unwrap();
    let cell = small_copy(40);
    let data = utf8(cell.path()).to_owned();
    let out = place.path().join("deep/out");
    let out_text = utf8(&out).to_owned();
    let commands: [&[&str]; 4] = [
        &["run", &data],
        &["map", &data, "--voxel-mm", "5", "--also", "mesh,obj,glb,stl,pcd,octomap,esdf"],
        &["calibrate", &data, "--preset", "paper"],
        &["simulate", "--scale", "0.5"],
    ];
    for (at, command) in commands.iter().enumerate() {
        for (signal, code, wait_ms) in [("INT", 130, 150), ("TERM", 143, 700), ("TERM", 143, 1500)] {
            let mut child = Command::new(env!("CARGO_BIN_EXE_skclam"))
                .args(*command)
                .args(["--quiet", "--out", &out_text])
                .stdout(Stdio::null())
                .stderr(Stdio::piped())
                .spawn()
                .unwrap();
            std::thread::sleep(Duration::from_millis(wait_ms));
            let sent = Command::new("kill").arg(format!("-{signal}")).arg(child.id().to_string()).status().unwrap();
            if !sent.success() {
                // It had come to its end.
                child.wait().unwrap();
                let _ = fs::remove_dir_all(place.path().join("deep"));
                continue;
            }
            let begin = Instant::now();
            let status =
                ended(&mut child, Duration::from_secs(10)).unwrap_or_else(|| panic!("{command:?} does not end"));
            assert!(begin.elapsed() < Duration::from_millis(1500), "{command:?}: {:?}", begin.elapsed());
            assert_eq!((status.code(), status.signal()), (Some(code), None), "{command:?} {at}");
            assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0, "{command:?} left something");
        }
    }
}

#[test]
fn what_cannot_be_replaced_is_said_before_the_work() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let copy = small_copy(12);
    symlink("nowhere", path("dangling")).unwrap();
    fs::create_dir_all(path("half/summary.json")).unwrap();
    for name in ["rig.toml", "map.ply", "report.html"] {
        fs::write(path("half").join(name), "OLD").unwrap();
    }
    pipe(&path("pipe"));
    for (name, why) in [
        ("dangling", "is a link to what does not exist"),
        ("half", "is not known to be of an earlier command"),
        ("pipe", "is a pipe"),
    ] {
        let begin = Instant::now();
        let message = fail(&["run", utf8(copy.path()), "--quiet", "--out", utf8(&path(name))]);
        assert!(message.contains(why) && message.contains(name), "{message}");
        assert!(begin.elapsed() < Duration::from_secs(2), "{name} was reported after the work");
    }
    for name in ["rig.toml", "map.ply", "report.html"] {
        assert_eq!(fs::read_to_string(path("half").join(name)).unwrap(), "OLD");
    }
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 3, "something was left");
}

#[test]
fn a_mixed_result_is_noticed_by_every_reader_and_pages_replace_no_part_of_one() {
    let place = tempfile::tempdir().unwrap();
    let out = result(place.path());
    let copy = small_copy(4);
    let rig = copy.path().join("rig.toml");
    let message = fail(&["report", utf8(&out), "--out", utf8(&out.join("summary.json"))]);
    assert!(message.contains("belongs to the result"), "{message}");
    symlink("target", place.path().join("link")).unwrap();
    fs::write(place.path().join("target"), "old").unwrap();
    succeed(&["report", utf8(&out), "--quiet", "--out", utf8(&place.path().join("link"))]);
    assert!(place.path().join("link").symlink_metadata().unwrap().is_symlink());
    assert!(fs::read_to_string(place.path().join("target")).unwrap().contains("<html"));
    succeed(&["report", utf8(&out), "--quiet"]);

    let mixed = fs::read_to_string(out.join("rig.toml")).unwrap() + "# of another run\n";
    fs::write(out.join("rig.toml"), mixed).unwrap();
    for arguments in [
        vec!["report", utf8(&out)],
        vec!["compare", utf8(&out), utf8(&out)],
        vec!["validate", utf8(copy.path()), "--rig", utf8(&out)],
        vec!["export", utf8(&out), "--nominal", utf8(&rig), "--out", "never"],
        vec!["evaluate", utf8(&out), "--truth", utf8(&rig), "--dataset", utf8(copy.path())],
    ] {
        let message = fail(&arguments);
        assert!(message.contains("not of one piece: rig.toml"), "{arguments:?}: {message}");
    }
    // Who names the file means it.
    let file = out.join("rig.toml");
    succeed(&["evaluate", utf8(&file), "--truth", utf8(&rig), "--dataset", utf8(copy.path())]);
}

#[test]
fn an_import_over_another_leaves_nothing_of_it_beside_the_new_one() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    let [recording, cell, out] = ["capture.mcap", "cell", "out"].map(path);
    succeed(&["simulate", "--scale", "0.2", "--quiet", "--recording", utf8(&recording), "--out", utf8(&cell)]);
    let import = |every: &str| {
        let options = ["--moving", "--every", every, "--quiet", "--out", utf8(&out)];
        succeed(&[&["import", utf8(&recording), "--robot", "hp3j"][..], &options].concat());
        fs::read_dir(out.join("color")).unwrap().count()
    };
    let (many, few) = (import("2"), import("9"));
    assert!(few < many, "{few} of {many}");
    assert_eq!(fs::read_dir(path("out.previous/color")).unwrap().count(), many);
    succeed(&["inspect", utf8(&out), "--quiet"]);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 4);
}

#[test]
fn a_slip_in_the_data_is_reported_as_one() {
    let refused = |from: &str, to: &str, expected: &[&str]| {
        let copy = small_copy(12);
        edit(copy.path(), "rig.toml", from, to);
        let out = copy.path().join("out");
        let message = fail(&["calibrate", utf8(copy.path()), "--quiet", "--out", utf8(&out)]);
        assert_eq!(message.lines().count(), 1, "{message}");
        for word in expected {
            assert!(message.contains(word), "{message}");
        }
        assert!(!message.contains("-inf") && message.len() < 1200, "{message}");
    };
    refused("unit_mm = 1.0", "unit_mm = 1000.0", &["depth.unit_mm", "0.1 to 5"]);
    refused("fx = ", "fx = 1e-300 # ", &["color.fx", "field of view"]);
    refused("a_mm = ", "a_mm = 1e300 # ", &["a_mm", "no arm is that long"]);
    refused("name = \"L\"", "name = \"S\"", &["\"S\" is the name of two joints"]);
}

#[test]
fn a_jpeg_that_was_cut_and_closed_is_refused() {
    let copy = small_copy(4);
    let image = copy.path().join("color/002.jpg");
    let bytes = fs::read(&image).unwrap();
    fs::write(&image, [&bytes[..bytes.len() / 2], &[0xFF, 0xD9]].concat()).unwrap();
    let message = fail(&["run", utf8(copy.path()), "--quiet", "--out", utf8(&copy.path().join("out"))]);
    assert!(message.contains("002.jpg") && message.contains("breaks off"), "{message}");
}

#[test]
fn a_colour_profile_is_not_unpacked() {
    // 64 MiB of zeros in 64 KiB, as the profile of each image: without care each of them is unpacked, and more than
    // once.
    let copy = small_copy(3);
    for index in 0..3 {
        let path = copy.path().join(format!("color/{index:03}.jpg"));
        let image = image::open(&path).unwrap().into_rgb8();
        let mut png = std::io::Cursor::new(Vec::new());
        image.write_to(&mut png, image::ImageFormat::Png).unwrap();
        fs::write(&path, with_profile(&png.into_inner())).unwrap();
    }
    let begin = Instant::now();
    let output = skclam(&["inspect", utf8(copy.path()), "--quiet"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(begin.elapsed() < Duration::from_secs(20));
}

/// A PNG with a colour profile whose bytes are no stream that can be unpacked: who tries is refused by an error.
fn with_profile(png: &[u8]) -> Vec<u8> {
    let (before, after) = png.split_at(33);
    let data = [b"bomb\0\0".as_slice(), &[0xFF; 64]].concat();
    let kind = b"iCCP";
    let mut crc = u32::MAX;
    for byte in kind.iter().chain(&data) {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = if crc & 1 == 1 { 0xEDB8_8320 ^ (crc >> 1) } else { crc >> 1 };
        }
    }
    [before, &(data.len() as u32).to_be_bytes(), kind, &data, &(!crc).to_be_bytes(), after].concat()
}
