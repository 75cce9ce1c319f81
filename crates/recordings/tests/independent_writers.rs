//! Recordings written by independent libraries (PyPI: rosbags, mcap), in every container, compression and encoding.
//!
//! The test makes a Python environment of its own below the target folder; without Python or a package index it says so
//! and is skipped. `SKCLAM_MESSAGES=1000` writes as many images into each recording (default 12).

use skclam_recordings::{
    CameraInfo, ColorPixels, CompressedImage, DepthPixels, Image, JointNames, JointState, MessageKind, Recording,
    Wanted, pinhole_from_info,
};
use std::path::{Path, PathBuf};
use std::process::Command;

fn run(command: &mut Command) -> Result<(), String> {
    let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    if output.status.success() { Ok(()) } else { Err(format!("{command:?}: {text}")) }
}

/// A Python with the libraries; why there is none.
fn python() -> Result<PathBuf, String> {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("recordings-python");
    let python = folder.join("bin/python");
    let works = || run(Command::new(&python).args(["-c", "import rosbags, mcap, numpy, PIL"]));
    if works().is_ok() {
        return Ok(python);
    }
    run(Command::new("python3").args(["-m", "venv"]).arg(&folder))?;
    let packages = ["rosbags", "mcap", "numpy", "pillow", "lz4", "zstandard"];
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet"]).args(packages))?;
    works().map(|()| python)
}

#[test]
fn everything_reads_back_equal() {
    let python = match python() {
        Ok(python) => python,
        Err(reason) => {
            println!("skipped: no Python with rosbags and mcap ({})", reason.lines().last().unwrap_or_default());
            return;
        }
    };
    let count = std::env::var("SKCLAM_MESSAGES").ok().and_then(|count| count.parse().ok()).unwrap_or(12usize);
    let folder = tempfile::tempdir().unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../benchmarks/recordings/write_recordings.py");
    run(Command::new(python).arg(script).arg("matrix").arg(folder.path()).arg(count.to_string())).unwrap();
    let listing = std::fs::read(folder.path().join("expected.json")).unwrap();
    let listing: serde_json::Value = serde_json::from_slice(&listing).unwrap();
    let recordings = listing.as_array().unwrap();
    assert_eq!(recordings.len(), 9 * 7);
    let mut messages = 0;
    for recording in recordings {
        let name = recording["file"].as_str().unwrap();
        messages += compare(&folder.path().join(name), recording, count);
    }
    println!("{} recordings, {messages} messages read back equal", recordings.len());
}

/// Reads a recording and compares every message with what was written.
fn compare(path: &Path, expected: &serde_json::Value, count: usize) -> usize {
    let arm: Vec<String> = (1..=6).map(|k| format!("joint_{k}")).collect();
    let images = expected["images"].as_array().unwrap();
    let (encoding, depth_encoding) = (expected["encoding"].as_str().unwrap(), expected["depth"].as_str().unwrap());
    let (mut joints, mut colors, mut depths, mut infos) = (0, 0, 0, 0);
    let mut recording = Recording::open(path).unwrap();
    let shown = path.display();
    recording
        .scan(true, &mut |_, _| Wanted::Whole, &mut |topic, message| {
            let (name, wire) = (&topic.name, topic.wire.unwrap());
            match (topic.kind, name.as_str()) {
                (MessageKind::JointState, _) => {
                    let state = JointState::parse(name, wire, message.data)?;
                    let names = JointNames::resolve(&arm, &state.names)?;
                    let values = names.values(&state.names, &state.positions).unwrap();
                    for (value, wanted) in values.iter().zip(images[joints]["joints"].as_array().unwrap()) {
                        assert!((value - wanted.as_f64().unwrap()).abs() <= 1e-12, "{shown}");
                    }
                    joints += 1;
                }
                (MessageKind::CameraInfo, _) => {
                    let (camera, remark) =
                        pinhole_from_info(name, &CameraInfo::parse(name, wire, message.data)?, false, None)?;
                    assert_eq!((camera.width, camera.height, camera.fx, camera.fy, remark), (32, 24, 40.0, 41.0, None));
                    assert_eq!(
                        (camera.cx, camera.cy, camera.distortion),
                        (15.5, 11.5, [0.1, -0.2, 0.001, 0.002, 0.05])
                    );
                    infos += 1;
                }
                (kind, "/camera/image_raw") => {
                    let wanted = &images[colors];
                    assert_eq!(message.stamp(topic)?, wanted["stamp"].as_i64().unwrap(), "{shown}");
                    let (pixels, file) = match kind {
                        MessageKind::Image => {
                            (ColorPixels::from_image(name, &Image::parse(name, wire, message.data)?)?, None)
                        }
                        _ => {
                            let image = CompressedImage::parse(name, wire, message.data)?;
                            (ColorPixels::from_compressed(name, &image)?, Some(image.data))
                        }
                    };
                    let crc = match encoding {
                        "jpeg" => crc32fast::hash(file.unwrap()),
                        _ => crc32fast::hash(pixels.image.as_bytes()),
                    };
                    assert_eq!(u64::from(crc), wanted["color_crc"].as_u64().unwrap(), "{shown}, image {colors}");
                    colors += 1;
                }
                (kind, "/camera/depth") => {
                    let depth = match kind {
                        MessageKind::Image => DepthPixels::from_image(name, &Image::parse(name, wire, message.data)?)?,
                        _ => DepthPixels::from_compressed(name, &CompressedImage::parse(name, wire, message.data)?)?,
                    };
                    let unit_m = depth.unit_m.unwrap_or(1e-3);
                    for (count, wanted) in depth.counts.iter().zip(images[depths]["depth"].as_array().unwrap()) {
                        let wanted_m = wanted.as_f64().unwrap() * 1e-3;
                        // Counts are exact; the inverse depth of 16 bits is coarse far away: half a step of z^2 / 2000.
                        let most = match depth_encoding {
                            "compressedDepth32" => 0.5 * wanted_m * wanted_m / 2000.0 + 0.5 * unit_m + 1e-4 * wanted_m,
                            _ => 1e-9,
                        };
                        let got_m = f64::from(*count) * unit_m;
                        assert!((got_m - wanted_m).abs() <= most, "{shown}: {got_m} is not {wanted_m}");
                    }
                    depths += 1;
                }
                (kind, name) => panic!("{shown}: {kind:?} on {name}"),
            }
            Ok(())
        })
        .unwrap_or_else(|error| panic!("{shown}: {error}"));
    assert_eq!((joints, colors, depths, infos), (count, count, count, count), "{shown}");
    4 * count
}
