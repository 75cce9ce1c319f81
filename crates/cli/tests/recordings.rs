//! import, inspect, compensate and export as their users run them: what they write, and what they say to bad input.
//!
//! The round trip of `export --mcap` is read by independent libraries (PyPI: mcap, mcap-protobuf-support,
//! foxglove-schemas-protobuf) in a Python environment below the target folder; without Python or a package index that
//! part says so and is skipped.

mod support;

use serde_json::Value;
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::inspection::{InspectionOptions, inspect};
use skclam::mapping::read_ply;
use skclam::progress::Silent;
use skclam::rig::{PostureState, Rig};
use skclam::trajectory::read_trajectory;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;
use support::{cell, fail, skclam, small_copy, succeed, text, utf8};

fn json(text: &str) -> Value {
    serde_json::from_str(text).expect("JSON")
}

/// Asks that a command fails with the expected words and leaves nothing at `out`.
fn refused(arguments: &[&str], out: &Path, expected: &[&str]) {
    let message = fail(arguments);
    for word in expected {
        assert!(message.contains(word), "{arguments:?}: \"{message}\" lacks \"{word}\"");
    }
    assert!(!out.exists(), "{arguments:?}: something was left behind");
}

// ----- import and inspect

/// A folder in TUM's layout: the arm rests at each posture for 3 s, three images and depth images each time, and moves
/// for 1 s. Joints lie beside it as CSV, 50 a second.
fn tum_folder(dataset: &Dataset, folder: &Path) {
    let (mut rgb, mut depth) = ("# time file\n".to_owned(), "# time file\n".to_owned());
    for sub in ["rgb", "depth"] {
        fs::create_dir_all(folder.join(sub)).unwrap();
    }
    let joints: Vec<&Vec<f64>> = dataset
        .records
        .iter()
        .map(|record| match &record.posture.state {
            PostureState::Joints(values) => values,
            PostureState::FlangePose(_) => panic!("joints expected"),
        })
        .collect();
    for (index, record) in dataset.records.iter().enumerate() {
        dataset.color(index).unwrap().save(folder.join(format!("rgb/{index}.png"))).unwrap();
        let depth_file = dataset.path_of(record.depth.as_ref().unwrap());
        fs::copy(depth_file, folder.join(format!("depth/{index}.png"))).unwrap();
        for at in [1.0, 1.5, 2.0] {
            let seconds = 4.0 * index as f64 + at;
            rgb += &format!("{seconds:.6} rgb/{index}.png\n");
            depth += &format!("{:.6} depth/{index}.png\n", seconds + 0.01);
        }
    }
    let mut table = "timestamp_s,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n".to_owned();
    for step in 0..200 * joints.len() {
        let (posture, seconds) = (step / 200, 0.02 * (step % 200) as f64);
        let fraction = (seconds - 3.0).clamp(0.0, 1.0);
        let next = joints[(posture + 1).min(joints.len() - 1)];
        let values = joints[posture].iter().zip(next).map(|(a, b)| (a + fraction * (b - a)).to_degrees().to_string());
        table += &format!("{:.3},{}\n", 0.02 * step as f64, values.collect::<Vec<_>>().join(","));
    }
    fs::write(folder.join("rgb.txt"), rgb).unwrap();
    fs::write(folder.join("depth.txt"), depth).unwrap();
    fs::write(folder.join("joints.csv"), table).unwrap();
}

#[test]
fn a_tum_folder_becomes_a_data_set_that_calibrates() {
    let place = tempfile::tempdir().unwrap();
    let copy = small_copy(12);
    let original = Dataset::open(copy.path()).unwrap();
    let (recording, out) = (place.path().join("tum"), place.path().join("cell"));
    tum_folder(&original, &recording);

    let survey = json(&succeed(&["inspect", utf8(&recording), "--json", "--quiet"]));
    let topics = survey["topics"].as_array().unwrap();
    assert_eq!(topics.iter().map(|topic| topic["messages"].as_u64().unwrap()).collect::<Vec<_>>(), [36, 36]);
    let shown = succeed(&["inspect", utf8(&recording), "--quiet"]);
    assert!(shown.contains("72 messages"), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() <= 80), "{shown}");

    let (rig, log) = (copy.path().join("rig.toml"), recording.join("joints.csv"));
    let arguments = ["import", utf8(&recording), "--rig", utf8(&rig), "--joints", utf8(&log), "--out", utf8(&out)];
    let printed = succeed(&arguments);
    assert!(printed.contains("12 postures") && printed.contains("skclam inspect"), "{printed}");
    let imported = Dataset::open(&out).unwrap();
    assert_eq!(imported.len(), 12);
    for index in 0..12 {
        let (PostureState::Joints(wanted), PostureState::Joints(got)) =
            (&original.records[index].posture.state, &imported.records[index].posture.state)
        else {
            panic!("joints expected")
        };
        assert!(wanted.iter().zip(got).all(|(a, b)| (a - b).abs() < 1e-9), "posture {index}");
        assert!(original.color(index).unwrap() == imported.color(index).unwrap(), "posture {index}");
        assert_eq!(original.depth(index).unwrap(), imported.depth(index).unwrap(), "posture {index}");
    }

    let judged = json(&succeed(&["inspect", utf8(&out), "--json", "--quiet"]));
    assert_eq!(judged["postures"], 12);
    let shown = skclam(&["inspect", utf8(&out), "--free", "angles"]);
    assert!(text(&shown.stderr).contains("12 postures; 30 or more"));
    let shown = text(&shown.stdout);
    assert!(shown.contains("expected sigma") && shown.contains("theta_offset_5"), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() <= 80 || !line.contains('│')), "{shown}");
    let result = place.path().join("result");
    let summary =
        json(&succeed(&["calibrate", utf8(&out), "--free", "angles", "--json", "--quiet", "--out", utf8(&result)]));
    assert!(summary["calibration"]["epipolar_after"]["median_px"].as_f64().unwrap() < 0.3, "{summary}");
    // What is expected from the postures alone, with the noise that was found, is what the calibration reports.
    let found = &summary["calibration"];
    let mut options = InspectionOptions::default();
    let expectation = &mut options.expected.expectation;
    expectation.free = Free::Angles;
    expectation.pixel_sigma = found["reprojection_after"]["rms_px"].as_f64().unwrap();
    expectation.depth_sigma_per_m2 = found["depth_sigma_per_m2"].as_f64().unwrap();
    expectation.joint_error_deg = found["joint_error_sigma_deg"].as_f64().unwrap();
    let expected = inspect(&imported, &options, &Silent).unwrap().expected.unwrap().parameters;
    let reported = found["parameters"].as_array().unwrap();
    assert_eq!(expected.len(), reported.len());
    for (expected, reported) in expected.iter().zip(reported) {
        assert_eq!(reported["name"], expected.name);
        let ratio = expected.sigma.unwrap() / reported["sigma"].as_f64().unwrap();
        println!("{}: expected {:.5} deg, {ratio:.2} of the reported", expected.name, expected.sigma.unwrap());
        assert!((1.0 / 3.0..3.0).contains(&ratio), "{expected:?} {reported}");
    }
    assert_eq!(judged["expected"]["pixel_sigma"], 0.2, "without options a cautious noise is assumed");
}

#[test]
fn recordings_that_are_none_and_wishes_that_cannot_be_met() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let import = |recording: &Path, more: &[&str], expected: &[&str]| {
        let arguments = [&["import", utf8(recording), "--out", utf8(&out), "--quiet"], more].concat();
        refused(&arguments, &out, expected);
    };
    let missing = place.path().join("missing.bag");
    import(&missing, &["--robot", "ur5e"], &["missing.bag"]);
    let junk = place.path().join("junk.mcap");
    fs::write(&junk, "no recording at all").unwrap();
    import(&junk, &["--robot", "ur5e"], &["junk.mcap", "no recording"]);
    assert!(fail(&["inspect", utf8(&junk)]).contains("no recording"));
    fs::write(&junk, b"\x89MCAP0\r\n\x01\xff\xff\xff\xff\xff\xff\xff\x7f").unwrap();
    import(&junk, &["--robot", "ur5e"], &["junk.mcap", "was not closed"]);
    import(&junk, &["--robot", "no-such-arm"], &["no-such-arm"]);

    let copy = small_copy(3);
    let recording = place.path().join("tum");
    tum_folder(&Dataset::open(copy.path()).unwrap(), &recording);
    let rig = copy.path().join("rig.toml");
    let log = recording.join("joints.csv");
    // Without joints there are no postures of an arm.
    import(&recording, &["--rig", utf8(&rig)], &["joint"]);
    import(&recording, &["--rig", utf8(&rig), "--joints", utf8(&rig)], &["rig.toml", "timestamp_s"]);
    let far = ["--rig", utf8(&rig), "--joints", utf8(&log), "--joint-offset-s", "1e6"];
    import(&recording, &far, &[]);
    let topic = ["--rig", utf8(&rig), "--joints", utf8(&log), "--color-topic", "/none"];
    import(&recording, &topic, &["/none"]);
    // One bad image is passed over, two of three are too many.
    fs::write(recording.join("rgb/1.png"), "no image").unwrap();
    let passed =
        skclam(&["import", utf8(&recording), "--out", utf8(&out), "--rig", utf8(&rig), "--joints", utf8(&log)]);
    let said = text(&passed.stderr);
    assert!(passed.status.success() && said.contains("rgb/1.png") && said.contains("neither JPEG nor PNG"), "{said}");
    fs::remove_dir_all(&out).unwrap();
    fs::write(recording.join("rgb/2.png"), "no image").unwrap();
    import(&recording, &["--rig", utf8(&rig), "--joints", utf8(&log)], &["rgb/1.png", "neither JPEG nor PNG"]);
    fs::write(recording.join("rgb.txt"), "0.0 ../../outside.png\n").unwrap();
    import(&recording, &["--rig", utf8(&rig), "--joints", utf8(&log)], &["rgb.txt"]);
    // Wrong use.
    assert_eq!(skclam(&["import", utf8(&recording), "--out", utf8(&out)]).status.code(), Some(2));
}

/// Topics, types and times of librealsense's recorder, in a bag that the library rosbags wrote.
#[test]
fn a_recording_of_the_realsense_viewer_becomes_a_data_set() {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => {
            println!("skipped: no Python with rosbags ({})", reason.lines().last().unwrap_or_default());
            return;
        }
    };
    let place = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benchmarks/recordings/write_recordings.py");
    let output = Command::new(python).arg(script).arg("viewer").arg(place.path()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let log = place.path().join("joints.csv");
    for name in ["viewer", "viewer_older"] {
        let (bag, out) = (place.path().join(format!("{name}.bag")), place.path().join(name));
        let survey = json(&succeed(&["inspect", utf8(&bag), "--json", "--quiet"]));
        let messages = |topic: &str| {
            let topics = survey["topics"].as_array().unwrap();
            topics.iter().find(|found| found["topic"] == topic).unwrap()["messages"].as_u64().unwrap()
        };
        assert_eq!(messages("/device_0/sensor_0/Depth_0/image/data"), 135);
        assert_eq!(messages("/device_0/sensor_1/Color_0/image/metadata"), 270);
        let importing = ["import", utf8(&bag), "--robot", "hp3j", "--out", utf8(&out), "--quiet"];
        let log = ["--joints", utf8(&log), "--joint-offset-s", "100"];
        succeed(&[&importing[..], &log].concat());
        let dataset = Dataset::open(&out).unwrap();
        assert_eq!(dataset.len(), 3, "{name}: three stationary intervals");
        for (interval, record) in dataset.records.iter().enumerate() {
            let PostureState::Joints(values) = &record.posture.state else { panic!("joints expected") };
            for (joint, value) in values.iter().enumerate() {
                let wanted = 10.0 * (joint as f64 + 1.0) + 5.0 * interval as f64;
                assert!((value.to_degrees() - wanted).abs() < 1e-6, "{name}, interval {interval}: {value}");
            }
            assert_eq!(dataset.color(interval).unwrap().width(), 64);
            let depth = dataset.depth(interval).unwrap().unwrap();
            // Tenths of a millimetre, by the image itself or by the sensor's option.
            let (low, high) = depth.as_slice().iter().fold((9f32, 0f32), |(low, high), z| (low.min(*z), high.max(*z)));
            assert!((0.199..0.3).contains(&low) && (3.8..4.0).contains(&high), "{name}: {low} to {high} m");
        }
        let (color, depth) = (dataset.rig.color, dataset.rig.depth.unwrap());
        assert_eq!((color.fx, color.cy, color.distortion), (80.0, 23.5, [-0.05, 0.06, 0.001, -0.002, 0.01]));
        assert_eq!((depth.camera.fx, depth.camera.width), (40.0, 32));
        assert!((depth.unit_m - 1e-4).abs() < 1e-11, "{}", depth.unit_m);
        let at = depth.color_from_depth.translation.vector;
        assert!((at.x - 0.015).abs() + (at.y + 0.0002).abs() + (at.z - 0.0004).abs() < 1e-9, "{at}");
        assert!((depth.color_from_depth.rotation.angle() - 0.01).abs() < 1e-9);
    }
}

// ----- compensate

#[test]
fn targets_come_back_as_commands() {
    let place = tempfile::tempdir().unwrap();
    let (nominal, truth) = (cell().join("rig.toml"), cell().join("truth/rig.toml"));
    let (targets, out) = (place.path().join("targets.csv"), place.path().join("commands.csv"));
    let joints = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg";
    fs::write(&targets, format!("name,{joints}\nfirst,10,20,-30,5,40,0\nsecond,-20,10,-10,0,60,15\n")).unwrap();
    let arguments = |calibrated: &Path| -> Vec<String> {
        let paths = [&targets, &nominal, &calibrated.to_owned(), &out].map(|path| utf8(path).to_owned());
        let [targets, nominal, calibrated, out] = paths;
        ["compensate".to_owned(), targets, "--nominal".to_owned(), nominal]
            .into_iter()
            .chain(["--calibrated".to_owned(), calibrated, "--out".to_owned(), out, "--json".to_owned()])
            .collect()
    };
    let of_truth = arguments(&truth);
    let of_truth: Vec<&str> = of_truth.iter().map(String::as_str).collect();
    let summary = json(&succeed(&of_truth));
    assert_eq!(summary["targets"], 2);
    assert!(summary["uncorrected_mean_mm"].as_f64().unwrap() > 1.0, "{summary}");
    let commands = fs::read_to_string(&out).unwrap();
    let lines: Vec<&str> = commands.lines().collect();
    assert_eq!(lines.len(), 3);
    assert!(lines[0].starts_with("name,q1_deg") && lines[1].starts_with("first,") && lines[2].starts_with("second,"));
    // The true arm, given the commands, is where the nominal arm would have been.
    let arm = |path: &Path| Rig::read(path).unwrap().robot.unwrap();
    let wanted = [[10.0, 20.0, -30.0, 5.0, 40.0, 0.0], [-20.0, 10.0, -10.0, 0.0, 60.0, 15.0]];
    for (line, wanted) in lines[1..].iter().zip(wanted) {
        let commanded: Vec<f64> =
            line.split(',').skip(1).take(6).map(|value| value.parse::<f64>().unwrap().to_radians()).collect();
        let reached = arm(&truth).base_from_flange(&commanded).unwrap();
        let target = arm(&nominal).base_from_flange(&wanted.map(f64::to_radians)).unwrap();
        assert!((reached.to_homogeneous() - target.to_homogeneous()).norm() < 1e-7, "{line}");
    }

    // One target that cannot be reached does not hold up the others.
    fs::write(&targets, "x_mm,y_mm,z_mm,qx,qy,qz,qw\n300,0,300,0,0,0,1\n9000,0,0,0,0,0,1\n").unwrap();
    let summary = json(&succeed(&of_truth));
    assert_eq!((&summary["compensated"], &summary["without_command"][0]["line"]), (&1.into(), &3.into()));
    let commands = fs::read_to_string(&out).unwrap();
    let lines: Vec<&str> = commands.lines().collect();
    assert!(lines[1].ends_with(",ok") && lines[2].contains(",,,the nominal arm does not reach"), "{commands}");

    fs::remove_file(&out).unwrap();
    for (table, expected) in [
        ("q1_deg,q2_deg\n1,2\n", "q3_deg"),
        ("name,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\na,1,2,3,x,5,6\n", "line 2"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n9000,0,0,0,0,0,1\n", "line 2"),
        ("x_mm,y_mm,z_mm,qx,qy,qz,qw\n300,0,300,0,0,0,9\n", "line 2"),
        ("", "line 1"),
    ] {
        fs::write(&targets, table).unwrap();
        let message = fail(&of_truth);
        assert!(message.contains(expected) && !out.exists(), "{table}: {message}");
    }
    let other = place.path().join("other.toml");
    fs::write(&other, skclam::rig::builtin_rig("franka-fr3").unwrap().unwrap().to_toml().unwrap()).unwrap();
    fs::write(&targets, format!("{joints}\n1,2,3,4,5,6\n")).unwrap();
    let message = fail(&arguments(&other).iter().map(String::as_str).collect::<Vec<_>>());
    assert!(message.contains('7') && message.contains('6'), "{message}");
}

// ----- export

const URDF: &str = r#"<robot name="r"><link name="base"/><link name="tip"/><!-- kept -->
  <joint name="j" type="revolute"><parent link="base"/><child link="tip"/><origin xyz="0 0 0.3"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>
"#;

#[test]
fn exports_that_cannot_be_say_why() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let (nominal, truth) = (cell().join("rig.toml"), cell().join("truth/rig.toml"));
    let urdf = place.path().join("robot.urdf");
    let export = |more: &[&str], expected: &[&str]| {
        refused(&[&["export", utf8(&truth), "--out", utf8(&out), "--quiet"], more].concat(), &out, expected);
    };
    fs::write(&urdf, r#"<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>"#)
        .unwrap();
    export(&["--urdf", utf8(&urdf)], &["robot.urdf", "xacro robot.urdf.xacro > robot.urdf"]);
    fs::write(&urdf, "<robot><link").unwrap();
    export(&["--urdf", utf8(&urdf)], &["robot.urdf", "not XML"]);
    // One joint in the URDF, six in the rig.
    fs::write(&urdf, URDF).unwrap();
    export(&["--urdf", utf8(&urdf)], &["differ in their joints"]);
    export(&["--nominal", utf8(&nominal), "--flange-frame", "a b; rm"], &["frame name"]);
    export(&["--dataset", utf8(place.path()), "--mcap"], &["rig.toml"]);
    // Wrong use: the recording needs the data set's images.
    assert_eq!(skclam(&["export", utf8(&truth), "--out", utf8(&out)]).status.code(), Some(2));
    let arguments = ["export", utf8(&truth), "--nominal", utf8(&nominal), "--mcap", "--out", utf8(&out)];
    assert_eq!(skclam(&arguments).status.code(), Some(2));
}

/// A Python with the libraries; why there is none.
fn python() -> Result<PathBuf, String> {
    static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();
    PYTHON.get_or_init(make_python).clone()
}

fn make_python() -> Result<PathBuf, String> {
    let run = |command: &mut Command| -> Result<(), String> {
        let output = command.output().map_err(|error| error.to_string())?;
        if output.status.success() { Ok(()) } else { Err(text(&output.stderr)) }
    };
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("result-python");
    let python = folder.join("bin/python");
    let modules = "import mcap_protobuf, foxglove_schemas_protobuf, rosbags, numpy, PIL";
    let works = || run(Command::new(&python).args(["-c", modules]));
    if works().is_ok() {
        return Ok(python);
    }
    run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    let packages = ["mcap", "mcap-protobuf-support", "foxglove-schemas-protobuf", "rosbags", "numpy", "pillow"];
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).args(packages))?;
    works().map(|()| python)
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
}

#[test]
fn a_result_as_a_recording_is_read_by_independent_libraries() {
    let place = tempfile::tempdir().unwrap();
    let copy = small_copy(12);
    let (result, out) = (place.path().join("result"), place.path().join("export"));
    succeed(&["run", utf8(copy.path()), "--free", "angles", "--quiet", "--out", utf8(&result)]);
    let dataset = ["--dataset", utf8(copy.path()), "--out", utf8(&out)];
    let export = [&["export", utf8(&result), "--mcap", "--json", "--quiet"], &dataset[..]].concat();
    let printed = json(&succeed(&export));
    let summary = json(&fs::read_to_string(result.join("summary.json")).unwrap());
    assert_eq!(printed["mcap"]["map_points"], summary["map"]["points"]);
    assert!(printed["mcap"]["left_out"].as_array().unwrap().is_empty(), "{printed}");
    assert!(out.join("corrections.csv").is_file());
    let again = place.path().join("again");
    let arguments: Vec<&str> =
        export.iter().map(|word| if *word == utf8(&out) { utf8(&again) } else { word }).collect();
    succeed(&[&arguments[..], &["--threads", "1"]].concat());
    let written = fs::read(out.join("result.mcap")).unwrap();
    assert!(written == fs::read(again.join("result.mcap")).unwrap(), "the same result gives the same bytes");

    let python = match python() {
        Ok(python) => python,
        Err(reason) => {
            println!("skipped: no Python with mcap ({})", reason.lines().last().unwrap_or_default());
            return;
        }
    };
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benchmarks/recordings/read_result.py");
    let output = Command::new(python).arg(script).arg(out.join("result.mcap")).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let read = json(&text(&output.stdout));
    // Every message that was counted, under its topic.
    for (topic, count) in printed["mcap"]["messages"].as_object().unwrap() {
        assert_eq!(read["topics"][topic]["messages"], *count, "{topic}");
    }
    assert_eq!(read["topics"].as_object().unwrap().len(), 15);
    // Trajectories: the calibrated one is that of the result, the nominal one that of the data set's rig.
    let opened = Dataset::open(copy.path()).unwrap();
    let calibrated = read_trajectory(&result.join("trajectory.txt")).unwrap();
    let nominal = skclam::pipeline::localize(&opened, &opened.rig).unwrap();
    for (name, wanted) in [("calibrated", calibrated), ("nominal", nominal)] {
        let poses = read["trajectory"][name].as_array().unwrap();
        assert_eq!(poses.len(), wanted.len());
        for (index, (pose, wanted)) in poses.iter().zip(&wanted).enumerate() {
            let (pose, t) = (numbers(pose), wanted.base_from_camera.translation.vector);
            let q = wanted.base_from_camera.rotation.coords;
            let off = (0..3).map(|k| (pose[k] - t[k]).abs()).fold(0.0, f64::max);
            let dot = (0..4).map(|k| pose[3 + k] * q[k]).sum::<f64>();
            assert!(off < 2e-9 && dot.abs() > 1.0 - 1e-11, "{name}, posture {index}: {pose:?}");
            assert!((read["stamps"][index].as_f64().unwrap() - wanted.timestamp_s).abs() < 1e-6);
        }
    }
    // The maps, point for point as far as sums and endpoints show; the colours byte for byte.
    for (name, file) in [("calibrated", "map.ply"), ("nominal", "map_nominal.ply")] {
        let bytes = fs::read(result.join(file)).unwrap();
        let cloud = read_ply(&bytes[..]).unwrap().points().clone();
        let map = &read["map"][name];
        assert_eq!(map["points"].as_u64().unwrap() as usize, cloud.len(), "{file}");
        for (key, point) in [("first", cloud.points[0]), ("last", cloud.points[cloud.len() - 1])] {
            // The JSON reader rounds the last digit.
            let equal =
                numbers(&map[key]).iter().zip(point).all(|(got, wanted)| (got - f64::from(wanted)).abs() < 1e-12);
            assert!(equal, "{file}, {key}: {} is not {point:?}", map[key]);
        }
        for (axis, sum) in numbers(&map["sum"]).into_iter().enumerate() {
            let wanted: f64 = cloud.points.iter().map(|point| f64::from(point[axis])).sum();
            assert!((sum - wanted).abs() < 1e-6, "{file}: {sum} is not {wanted}");
        }
    }
    assert_eq!(read["images"].as_array().unwrap().len(), 12);
    assert!(read["images"].as_array().unwrap().iter().all(|image| image["format"] == "jpeg"));
    assert_eq!(read["depth"].as_array().unwrap().len(), 12);
    // Lines before are long, lines after are short.
    let medians = |name: &str| -> Vec<f64> {
        read["residuals"][name].as_array().unwrap().iter().map(|posture| posture["median"].as_f64().unwrap()).collect()
    };
    let (before, after) = (medians("nominal"), medians("calibrated"));
    assert_eq!((before.len(), after.len()), (12, 12));
    assert!(
        before.iter().zip(&after).all(|(before, after)| *after < 0.3 && *before > 3.0 * after),
        "{before:?} {after:?}"
    );
    for frame in ["link_6", "tool0", "camera_depth_optical_frame", "nominal/camera_color_optical_frame"] {
        assert!(read["frames"].as_array().unwrap().iter().any(|found| found == frame), "{frame}");
    }
    assert!(read["attachments"].as_object().unwrap().contains_key("summary.json"));
}
