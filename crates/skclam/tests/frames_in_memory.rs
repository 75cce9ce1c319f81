//! Images in memory give what the same images give from a folder, bit for bit, and what does not fit is refused.

use image::{DynamicImage, GrayImage};
use skclam::dataset::{Dataset, DatasetError, Frame, Frames, PostureRecord, write_depth_png, write_postures};
use skclam::pipeline::{Config, run};
use skclam::progress::Silent;
use skclam::rig::{PostureState, Rig, builtin_rig};
use skclam::robot_recording::write_robot_recording;
use skclam::simulation::{DiverseOptions, PosturePlan, Simulation, SimulationConfig};
use skclam::virtual_cell::{render_frames, scaled_rig};
use std::io::Cursor;
use std::path::Path;
use std::sync::OnceLock;

/// A small cell, rendered once.
fn cell() -> &'static (Rig, Vec<Frame>) {
    static CELL: OnceLock<(Rig, Vec<Frame>)> = OnceLock::new();
    CELL.get_or_init(|| {
        let nominal = scaled_rig(&builtin_rig("hp3j").unwrap().unwrap(), 0.25);
        let postures = PosturePlan::Diverse { options: DiverseOptions { count: 10, ..Default::default() } };
        let cell = Simulation::new(&nominal, &SimulationConfig { postures, ..Default::default() }).unwrap();
        let frames = render_frames(&cell, &Silent).unwrap();
        (nominal, frames)
    })
}

/// The frames as files without loss.
fn written(folder: &Path, rig: &Rig, frames: &[Frame]) -> Dataset {
    let camera = rig.depth.unwrap();
    let records: Vec<PostureRecord> = frames
        .iter()
        .map(|frame| {
            let index = frame.posture.index;
            let (color, depth) = (format!("{index}.png"), format!("{index}-depth.png"));
            frame.color.save(folder.join(&color)).unwrap();
            let counts = frame.depth.as_ref().unwrap();
            let metres = skclam::geometry::DepthImage::from_counts(&camera, counts.as_raw()).unwrap();
            write_depth_png(&folder.join(&depth), &metres, camera.unit_m).unwrap();
            PostureRecord { posture: frame.posture.clone(), color: color.into(), depth: Some(depth.into()) }
        })
        .collect();
    let kinds: Vec<_> = rig.robot.as_ref().unwrap().joints().iter().map(|joint| joint.kind).collect();
    std::fs::write(folder.join("rig.toml"), rig.to_toml().unwrap()).unwrap();
    std::fs::write(folder.join("postures.csv"), write_postures(&records, &kinds).unwrap()).unwrap();
    Dataset::open(folder).unwrap()
}

#[test]
fn memory_and_folder_give_the_same_rig_map_and_summary() {
    let (nominal, frames) = cell();
    let folder = tempfile::tempdir().unwrap();
    let from_folder = written(folder.path(), nominal, frames);
    // The table rounds joint values: the same postures in both.
    let mut same = frames.clone();
    for (frame, record) in same.iter_mut().zip(&from_folder.records) {
        frame.posture = record.posture.clone();
        frame.posture.joint_rates.clear();
    }
    let in_memory = Dataset::from_frames(from_folder.rig.clone(), same).unwrap();
    for (one, other) in in_memory.records.iter().zip(&from_folder.records) {
        assert_eq!(one.posture, other.posture, "with the rates that were left out");
    }
    let config = Config { held_out: None, ..Config::default() };
    let [one, other] = [&in_memory, &from_folder].map(|dataset| run(dataset, &config, &Silent).unwrap());
    assert_eq!(one.rig.to_toml().unwrap(), other.rig.to_toml().unwrap());
    assert_eq!(one.maps.unwrap().calibrated, other.maps.unwrap().calibrated);
    assert_eq!(serde_json::to_string(&one.summary).unwrap(), serde_json::to_string(&other.summary).unwrap());
    assert_eq!(one.report.dataset, "images in memory");
    // A recording of either holds the same image.
    let recorded = [&in_memory, &from_folder].map(|dataset| {
        let mut bytes = Cursor::new(Vec::new());
        write_robot_recording(dataset, &mut bytes, &Silent).unwrap();
        bytes.into_inner()
    });
    assert!(recorded.iter().all(|bytes| bytes.windows(4).any(|word| word == b"\x89PNG")));
    let (format, png) = in_memory.color_file(3).unwrap();
    assert_eq!(format, image::ImageFormat::Png);
    assert_eq!(image::load_from_memory(&png).unwrap().into_rgb8(), from_folder.color(3).unwrap());
}

#[test]
fn masks_in_memory_are_those_of_the_rig() {
    let (nominal, frames) = cell();
    let mask = GrayImage::from_pixel(nominal.color.width, nominal.color.height, image::Luma([255]));
    let given = Frames { color_mask: Some(mask.clone()), ..Frames::from(frames.clone()) };
    let dataset = Dataset::from_frames(nominal.clone(), given).unwrap();
    assert_eq!(dataset.color_mask().unwrap(), Some(mask));
    assert_eq!(dataset.depth_mask().unwrap(), None);
    let named = Rig { color_mask: Some("gripper.png".into()), ..nominal.clone() };
    let message = Dataset::from_frames(named, frames.clone()).unwrap_err().to_string();
    assert!(message.contains("gripper.png") && message.contains("color_mask"), "{message}");
}

#[test]
fn what_does_not_fit_is_named() {
    let (nominal, frames) = cell();
    let refused = |rig: &Rig, change: &dyn Fn(&mut Vec<Frame>)| {
        let mut changed = frames.clone();
        change(&mut changed);
        Dataset::from_frames(rig.clone(), changed).unwrap_err()
    };
    assert!(matches!(refused(nominal, &|f| f.truncate(1)), DatasetError::TooFewPostures { got: 1, .. }));
    let small = refused(nominal, &|f| f[2].color = DynamicImage::new_rgb8(4, 3));
    assert!(matches!(small, DatasetError::ImageSize { got_width: 4, table: "color", .. }), "{small}");
    let double = refused(nominal, &|f| f[1].posture.index = 0).to_string();
    assert!(double.contains("posture 0 follows 0"), "{double}");
    let nan = refused(nominal, &|f| f[1].posture.state = PostureState::Joints(vec![f64::NAN; 6])).to_string();
    assert!(nan.contains("posture 1") && nan.contains("NaN"), "{nan}");
    let few = refused(nominal, &|f| f[1].posture.state = PostureState::Joints(vec![0.0; 5])).to_string();
    assert!(few.contains("posture 1"), "{few}");
    let blind = refused(&Rig { depth: None, ..nominal.clone() }, &|_| ()).to_string();
    assert!(blind.contains("rig.depth"), "{blind}");
}
