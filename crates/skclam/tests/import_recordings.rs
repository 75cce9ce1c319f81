//! The five recordings of the same three postures become the same dataset. They lie in `../shared/data/recordings`, or
//! where `SKCLAM_DATA` says.

use skclam::dataset::Dataset;
use skclam::import::{ImportOptions, import_recording};
use skclam::output::{Contents, StagedFolder};
use skclam::progress::Silent;
use skclam::recordings::{Recording, Selection};
use skclam::rig::{PostureState, Rig};
use std::path::PathBuf;

fn data() -> PathBuf {
    let beside = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data"));
    std::env::var_os("SKCLAM_DATA").map_or(beside, PathBuf::from)
}

const RECORDINGS: [&str; 5] = ["sample_none.bag", "sample_lz4.bag", "sample_bz2.bag", "ros2_mcap", "ros2_sqlite3"];

/// As written into the recordings: radians, to eight digits.
const JOINTS: [[f64; 6]; 3] = [
    [0.32977891, 0.33462349, -0.70792323, -0.38271448, -1.15580809, 3.13945723],
    [-0.22377281, 0.58482546, -0.90466362, -0.12286006, -0.93085301, -0.16792233],
    [0.36117929, 0.4106566, -0.78144002, -0.49215767, -1.06694996, 0.89251977],
];

/// Joints, pixels and rig of a dataset.
type Imported = (Vec<Vec<f64>>, Vec<Vec<u8>>, Rig);

#[test]
fn five_recordings_give_the_same_three_postures() {
    let (recordings, rig) = (data().join("recordings"), data().join("nachi-mz25/rig.toml"));
    if !recordings.is_dir() || !rig.is_file() {
        println!("skipped: {} or {} is not there", recordings.display(), rig.display());
        return;
    }
    let rig = Rig::read(rig).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut first: Option<Imported> = None;
    for name in RECORDINGS {
        for color_topic in ["/camera/color/image_raw", "/camera/color/image_raw/compressed"] {
            let raw = color_topic.ends_with("raw");
            let out = folder.path().join(format!("{name}-{raw}"));
            let staged = StagedFolder::new(&out, Contents::DataSet).unwrap();
            // The raw topic is the one that is found without a name.
            let options =
                ImportOptions { color_topic: (!raw).then(|| color_topic.to_owned()), ..ImportOptions::default() };
            let mut recording = Recording::open(recordings.join(name)).unwrap();
            let summary = import_recording(&mut recording, &rig, None, &options, &staged, &Silent).unwrap();
            staged.publish().unwrap();
            assert_eq!((summary.postures, summary.selection), (3, Selection::Snapshots), "{name}");
            assert_eq!((summary.color_topic.as_str(), summary.joint_topic.as_str()), (color_topic, "/joint_states"));
            assert!(summary.warnings.iter().any(|warning| warning.contains("J1 = joint_1")), "{:?}", summary.warnings);

            let dataset = Dataset::open(&out).unwrap();
            let joints: Vec<Vec<f64>> = dataset
                .records
                .iter()
                .map(|record| match &record.posture.state {
                    PostureState::Joints(values) => values.clone(),
                    PostureState::FlangePose(_) => panic!("joints expected"),
                })
                .collect();
            let images: Vec<Vec<u8>> = (0..3).map(|index| dataset.gray(index).unwrap().into_raw()).collect();
            assert_eq!(images[0].len(), 600 * 450);
            for (got, expected) in joints.iter().flatten().zip(JOINTS.iter().flatten()) {
                assert!((got - expected).abs() < 1e-8, "{name}: {got} is not {expected}");
            }
            assert_eq!(dataset.rig.color.fx, 570.2);
            match &first {
                None => first = Some((joints, images, dataset.rig)),
                Some((first_joints, first_images, first_rig)) => {
                    for (a, b) in joints.iter().flatten().zip(first_joints.iter().flatten()) {
                        assert!((a - b).abs() <= 1e-9, "{name}");
                    }
                    assert!(*first_images == images, "{name}: pixels differ");
                    assert_eq!(*first_rig, dataset.rig);
                }
            }
        }
    }
}

/// Frames without headers, as librealsense wrote into its first .db3 files, are refused by name, with what to record
/// instead.
#[test]
fn bare_frames_of_librealsense_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bare.mcap");
    let mut writer = mcap::Writer::new(std::fs::File::create(&path).unwrap()).unwrap();
    let schema = writer.add_schema("librealsense/raw_frame", "ros2msg", b"").unwrap();
    let topic = "/device_0/sensor_1/Color_0/image/data";
    let channel_id = writer.add_channel(schema, topic, "cdr", &Default::default()).unwrap();
    for sequence in 0..3 {
        let log_time = 1_000_000_000 * u64::from(sequence);
        let header = mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, &[7; 48]).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    let rig = skclam::rig::builtin_rig("hp3j").unwrap().unwrap();
    let staged = StagedFolder::new(folder.path().join("out"), Contents::DataSet).unwrap();
    let mut recording = Recording::open(&path).unwrap();
    let error = import_recording(&mut recording, &rig, None, &ImportOptions::default(), &staged, &Silent).unwrap_err();
    let message = error.to_string();
    for word in [topic, "librealsense/raw_frame", "record as .bag"] {
        assert!(message.contains(word), "{message}");
    }
}
