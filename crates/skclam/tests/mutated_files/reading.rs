//! Everything that is done with a file that can be read. What is written of it must be readable again.

use super::seeds::{IMAGE_SIZE, URDF};
use skclam::compensation::{CompensationOptions, read_targets, write_compensated};
use skclam::dataset::{Dataset, PostureRecord, read_postures, write_postures};
use skclam::import::read_joint_log;
use skclam::kinematics::{
    CollisionModel, JointKind, ParameterKind, SerialChain, chain_from_urdf, line_diff, urdf_ends, write_urdf,
};
use skclam::mapping::{
    Model, RenderCamera, RenderOptions, SurfaceIndex, ViewPreset, read_ply, read_stl, render, write_ply,
};
use skclam::pipeline::Config;
use skclam::rig::{Posture, PostureState, Rig, builtin_rig};
use skclam::trajectory::{read_trajectory, trajectory_text};
use std::path::Path;
use std::sync::OnceLock;

fn arm() -> &'static SerialChain {
    static ARM: OnceLock<SerialChain> = OnceLock::new();
    ARM.get_or_init(|| builtin_rig("hp3j").unwrap().unwrap().robot.unwrap())
}

/// An arm a little beside another, as a calibration finds it.
fn calibrated(chain: &SerialChain) -> SerialChain {
    let mut changed = chain.clone();
    for (at, id) in chain.parameter_ids().into_iter().enumerate() {
        let value = changed.parameter(id).unwrap();
        let length = matches!(id.kind, ParameterKind::A | ParameterKind::D);
        let step = if length { 1e-4 } else { 1e-3 };
        changed.set_parameter(id, value + step * (1.0 + at as f64 * 0.1).sin()).unwrap();
    }
    changed
}

/// A rig that is read works: it moves, is written and read again.
pub fn rig(path: &Path) -> bool {
    let urdf = path.with_file_name("robot.urdf");
    if !urdf.exists() {
        std::fs::write(urdf, URDF).unwrap();
    }
    let Ok(rig) = Rig::read(path) else { return false };
    if let Some(robot) = &rig.robot {
        let state = PostureState::Joints(vec![0.3; robot.joint_count()]);
        let _ = rig.base_from_color(&Posture::new(0, state));
    }
    let text = rig.to_toml().unwrap();
    Rig::from_toml(&text, "again").unwrap();
    true
}

/// A description that is read gives a chain that can be written back into it, and bodies that are somewhere.
pub fn urdf(path: &Path) -> bool {
    let Ok(text) = std::fs::read_to_string(path) else { return false };
    if let Ok(bodies) = CollisionModel::from_urdf(&text, None) {
        bodies.base_from_shapes(|_| Some(0.1));
    }
    let Ok((bases, tips)) = urdf_ends(&text) else { return false };
    let base = bases.first().map_or("base", String::as_str);
    // The last one, as a gripper's finger comes before it.
    let tip = tips.last().map_or("tip", String::as_str);
    let Ok(chain) = chain_from_urdf(&text, base, tip) else { return false };
    let Ok(written) = write_urdf(&text, base, tip, &chain, &calibrated(&chain)) else { return false };
    chain_from_urdf(&written, base, tip).unwrap();
    line_diff(&text, &written);
    true
}

pub fn postures(path: &Path) -> bool {
    let Ok(records) = read_postures(path) else { return false };
    let count = |record: &PostureRecord| match &record.posture.state {
        PostureState::Joints(values) => values.len(),
        PostureState::FlangePose(_) => 0,
    };
    let kinds = vec![JointKind::Revolute; records.first().map_or(0, count)];
    let text = write_postures(&records, &kinds).unwrap();
    let again = path.with_file_name("again.csv");
    std::fs::write(&again, text).unwrap();
    assert_eq!(read_postures(&again).unwrap().len(), records.len());
    true
}

pub fn targets(path: &Path) -> bool {
    static CALIBRATED: OnceLock<SerialChain> = OnceLock::new();
    let (nominal, calibrated) = (arm(), CALIBRATED.get_or_init(|| calibrated(arm())));
    let Ok(table) = read_targets(path, nominal) else { return false };
    let Ok(answers) = table.compensate(nominal, calibrated, &CompensationOptions::default()) else { return false };
    let again = path.with_file_name("again.csv");
    std::fs::write(&again, write_compensated(&table, &answers, nominal)).unwrap();
    // Rows without a command have empty cells, which are no targets.
    let all = answers.iter().all(Result::is_ok);
    let read = read_targets(&again, nominal);
    assert_eq!(read.ok().map(|table| table.targets.len()), all.then_some(answers.len()));
    all
}

pub fn joint_log(path: &Path) -> bool {
    let Ok(mut track) = read_joint_log(path, arm(), 0.25) else { return false };
    track.sort();
    skclam::recordings::find_stationary_intervals(&track, &skclam::recordings::SelectionOptions::default());
    true
}

pub fn trajectory(path: &Path) -> bool {
    let Ok(poses) = read_trajectory(path) else { return false };
    let again = path.with_file_name("again.txt");
    std::fs::write(&again, trajectory_text(&poses)).unwrap();
    assert_eq!(read_trajectory(&again).unwrap().len(), poses.len());
    true
}

pub fn settings(path: &Path) -> bool {
    let Ok(text) = std::fs::read_to_string(path) else { return false };
    let Ok(config) = Config::default().overlaid(&text) else { return false };
    let written = serde_json::to_string(&config).unwrap();
    assert_eq!(Config::default().overlaid(&written).unwrap(), config);
    true
}

/// A map that is read can be measured against, drawn, written and read again.
pub fn map(path: &Path) -> bool {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let stl = path.extension().is_some_and(|ending| ending == "stl");
    let read = if stl { read_stl(file).map(Model::Mesh) } else { read_ply(file) };
    let Ok(model) = read else { return false };
    if let Ok(index) = SurfaceIndex::new(&model) {
        index.distance([0.1, 0.2, 0.3], 10.0);
    }
    let camera = RenderCamera::framing(&model, ViewPreset::Perspective, 24, 16);
    let _ = render(&model, &camera, &RenderOptions::default());
    let mut again = Vec::new();
    write_ply(&model, &mut again).unwrap();
    assert_eq!(read_ply(again.as_slice()).unwrap().points().len(), model.points().len());
    true
}

/// The image of both postures of a data set.
pub fn image(path: &Path) -> bool {
    static RIG: OnceLock<Rig> = OnceLock::new();
    let rig = RIG.get_or_init(|| {
        let mut rig = builtin_rig("hp3j").unwrap().unwrap();
        let mut depth = rig.depth.unwrap();
        (rig.color.width, rig.color.height) = IMAGE_SIZE;
        (depth.camera.width, depth.camera.height) = IMAGE_SIZE;
        rig.depth = Some(depth);
        rig
    });
    let name = path.file_name().unwrap().to_str().unwrap();
    let depth = name.starts_with("depth");
    let folder = path.parent().unwrap();
    // The image that is not damaged replaces itself.
    let (color, depth_name) = if depth { ("whole.png", name) } else { (name, "") };
    if depth && !folder.join("whole.png").exists() {
        image::RgbImage::new(IMAGE_SIZE.0, IMAGE_SIZE.1).save(folder.join("whole.png")).unwrap();
    }
    let row = |index: u32| format!("{index},0,0,0,0,0,{index},{color},{depth_name}\n");
    let table = format!("index,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,color,depth\n{}{}", row(0), row(1));
    std::fs::write(folder.join("postures.csv"), table).unwrap();
    let Ok(dataset) = Dataset::open_with_rig(folder, rig.clone()) else { return false };
    dataset.color(0).is_ok() & dataset.gray(0).is_ok() & dataset.depth(1).is_ok()
}
