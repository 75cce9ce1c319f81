//! The five recordings of the same three postures, in `../shared/data/recordings` or where `SKCLAM_DATA` says.

use skclam_recordings::{
    CameraInfo, ColorPixels, CompressedImage, Image, JointState, MessageKind, Recording, Wanted, survey,
};
use std::path::PathBuf;

fn folder() -> Option<PathBuf> {
    let data = std::env::var_os("SKCLAM_DATA")
        .map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data")), PathBuf::from);
    let folder = data.join("recordings");
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: {} is not there", folder.display());
    None
}

const RECORDINGS: [&str; 7] = [
    "sample_none.bag",
    "sample_lz4.bag",
    "sample_bz2.bag",
    "ros2_mcap",
    "ros2_sqlite3",
    "ros2_mcap/ros2_mcap.mcap",
    "ros2_sqlite3/ros2_sqlite3.db3",
];

/// All that matters of a recording: stamps with joints, pixels and cameras.
#[derive(Debug, Default, PartialEq)]
struct Contents {
    joints: Vec<(i64, Vec<String>, Vec<f64>)>,
    raw: Vec<(i64, Vec<u8>)>,
    compressed: Vec<(i64, Vec<u8>)>,
    cameras: Vec<CameraInfo>,
}

fn contents(path: &std::path::Path) -> Contents {
    let mut found = Contents::default();
    let mut recording = Recording::open(path).unwrap();
    let mut places = Vec::new();
    recording
        .scan(true, &mut |_, _| Wanted::Beginning(100), &mut |_, message| {
            places.push(message.place);
            Ok(())
        })
        .unwrap();
    assert_eq!(places.len(), 12);
    // Backwards and twice, as a reader must not mind.
    places.extend(places.clone().into_iter().rev());
    recording
        .read(&places, &mut |topic, message| {
            let (name, wire) = (&topic.name, topic.wire.unwrap());
            match topic.kind {
                MessageKind::JointState => {
                    let state = JointState::parse(name, wire, message.data)?;
                    let names = state.names.iter().map(|&name| name.to_owned()).collect();
                    found.joints.push((state.header.stamp, names, state.positions));
                }
                MessageKind::Image => {
                    let image = Image::parse(name, wire, message.data)?;
                    let pixels = ColorPixels::from_image(name, &image)?.image;
                    found.raw.push((image.head.header.stamp, pixels.into_bytes()));
                }
                MessageKind::CompressedImage => {
                    let image = CompressedImage::parse(name, wire, message.data)?;
                    let pixels = ColorPixels::from_compressed(name, &image)?;
                    assert_eq!(pixels.file_ending, Some("png"));
                    found.compressed.push((image.head.header.stamp, pixels.image.into_bytes()));
                }
                MessageKind::CameraInfo => found.cameras.push(CameraInfo::parse(name, wire, message.data)?),
                other => panic!("{other:?}"),
            }
            Ok(())
        })
        .unwrap();
    found
}

#[test]
fn the_five_recordings_hold_the_same() {
    let Some(folder) = folder() else { return };
    let all: Vec<Contents> = RECORDINGS.iter().map(|name| contents(&folder.join(name))).collect();
    let first = &all[0];
    assert_eq!((first.joints.len(), first.raw.len(), first.compressed.len(), first.cameras.len()), (3, 3, 3, 3));
    assert_eq!(first.raw[0].1.len(), 600 * 450);
    assert_eq!(first.joints[2].1, ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"]);
    assert!((first.joints[0].2[5] - 3.13945723).abs() < 1e-8);
    assert_eq!(first.cameras[0].matrix[0], 570.2);
    for (name, other) in RECORDINGS.iter().zip(&all) {
        for ((_, _, a), (_, _, b)) in first.joints.iter().zip(&other.joints) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-9), "{name}");
        }
        assert!(first == other, "{name} differs");
    }
}

#[test]
fn the_survey_names_topics_and_rates() {
    let Some(folder) = folder() else { return };
    for name in RECORDINGS {
        let survey = survey(&mut Recording::open(folder.join(name)).unwrap()).unwrap();
        let topics: Vec<&str> = survey.topics.iter().map(|topic| topic.topic.as_str()).collect();
        let color = "/camera/color/camera_info";
        assert_eq!(topics, [color, "/camera/color/image_raw", "/camera/color/image_raw/compressed", "/joint_states"]);
        assert_eq!((survey.messages, survey.duration_s), (12, 4.005));
        let image = &survey.topics[1];
        assert!((image.rate_hz - 0.5).abs() < 1e-9 && (image.largest_gap_s - 2.0).abs() < 1e-9, "{image:?}");
        assert_eq!((image.detail.as_str(), image.clock_jumps, image.read), ("mono8 600 x 450", 0, true));
    }
}
