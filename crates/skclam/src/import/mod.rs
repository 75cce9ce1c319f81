//! A recording of a robot becomes a dataset: find the topics, pair colour, depth and joints by their stamps, take a
//! posture where the arm stood still, write `rig.toml`, `postures.csv` and the images.
//!
//! The recording is read once for its stamps and joints, past the pixels; then only the images that may be taken are
//! read. Memory does not grow with the recording.

mod cameras;
mod error;
mod first_pass;
mod joint_log;
mod topics;
mod write;

pub use error::ImportError;
pub use joint_log::read_joint_log;

use crate::dataset::PostureRecord;
use crate::output::StagedFolder;
use crate::progress::{Progress, Stage};
use first_pass::{FirstPass, first_pass};
use serde::{Deserialize, Serialize};
use skclam_kinematics::JointKind;
use skclam_recordings::{
    ColorPixels, JointTrack, MessageKind, PlannedPosture, PosturePlan, Recording, RecordingError, Selection,
    SelectionOptions, plan_postures, sharpness,
};
use skclam_rig::{PostureState, Rig};
use std::collections::BTreeMap;
use topics::Chosen;

/// Where the cameras' intrinsics come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CameraSource {
    /// From the recording's `CameraInfo` where it has one, else from the rig.
    #[default]
    Recording,
    /// From the rig.
    Rig,
}

/// Whether depth is taken, and from where.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DepthChoice {
    /// From the only depth topic, if there is one.
    #[default]
    Automatic,
    /// From this topic.
    Topic(String),
    /// Not at all.
    None,
}

/// Options of an import.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImportOptions {
    /// Topic of the colour images; `None`: the only one.
    pub color_topic: Option<String>,
    /// Depth images.
    pub depth: DepthChoice,
    /// Topic of the joint states; `None`: the only one that has the arm's joints.
    pub joint_topic: Option<String>,
    /// The recording's names of the joints, base to flange, where they are not the arm's.
    pub joint_names: Option<Vec<String>>,
    /// Intrinsics.
    pub cameras: CameraSource,
    /// Which images become postures.
    pub selection: SelectionOptions,
}

/// What an import did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImportSummary {
    /// Postures written.
    pub postures: usize,
    /// How they were selected.
    pub selection: Selection,
    /// Topic of the colour images.
    pub color_topic: String,
    /// Topic of the depth images.
    pub depth_topic: Option<String>,
    /// Topic of the joints, or the log or list that they come from.
    pub joint_topic: String,
    /// Colour images in the recording.
    pub color_images: usize,
    /// Images that were taken while the arm moved.
    pub moving: usize,
    /// Postures whose colour image has no depth image beside it.
    pub without_depth: usize,
    /// What a user should know.
    pub warnings: Vec<String>,
}

/// Imports a recording into a folder that is published by the caller. `rig` gives the arm and the mount, and the
/// cameras where the recording does not; `joint_log` joint values that were recorded apart.
///
/// # Errors
/// [`ImportError`]: a damaged recording, topics that cannot be chosen, joints or cameras that do not fit the rig, fewer
/// than two postures.
pub fn import_recording(
    recording: &mut Recording,
    rig: &Rig,
    joint_log: Option<JointTrack>,
    options: &ImportOptions,
    staged: &StagedFolder,
    progress: &dyn Progress,
) -> Result<ImportSummary, ImportError> {
    let FirstPass { chosen, images, tracks, mut cameras, mut warnings } =
        first_pass(recording, rig, joint_log.is_none(), options, progress)?;
    let (joint_topic, mut track) = match joint_log {
        Some(log) => ("the joint log".to_owned(), log),
        None => topics::choose_track(recording, rig, tracks, options.joint_topic.as_deref(), &mut warnings)?,
    };
    track.sort();
    if track.stride() > 1 {
        warnings.push(format!("every {}th joint state was used, to bound memory", track.stride()));
    }
    let color_images = images.get(&chosen.color).cloned().unwrap_or_default();
    let depth_images = chosen.depth.and_then(|topic| images.get(&topic).cloned()).unwrap_or_default();
    let plan = plan_postures(&track, &color_images, &depth_images, &options.selection)?;
    enough(&plan, color_images.len(), &track, options)?;
    if options.selection.selection == Selection::Automatic && plan.selection == Selection::Snapshots {
        warnings.push(
            "joint states come too seldom to know whether the arm moved; every image with joints beside it is taken"
                .to_owned(),
        );
    }
    progress.begin(Stage::Import, plan.postures.iter().map(|posture| posture.candidates.len() as u64).sum());
    let taken = sharpest(recording, &plan.postures, progress, &mut warnings)?;
    let written = write::images(recording, &chosen, &plan.postures, &taken, staged, progress)?;
    let robot = rig.robot.as_ref();
    let rig = cameras.rig(recording, rig, &chosen, &written, options, &mut warnings)?;
    let records: Vec<PostureRecord> = plan
        .postures
        .iter()
        .zip(&taken)
        .enumerate()
        .map(|(index, (posture, &candidate))| write::record(index, &posture.candidates[candidate], &written, robot))
        .collect();
    let kinds: Vec<JointKind> = match robot {
        Some(robot) => robot.joints().iter().map(|joint| joint.kind).collect(),
        None => vec![],
    };
    staged.write("postures.csv", crate::dataset::write_postures(&records, &kinds)?)?;
    staged.write("rig.toml", rig.to_toml()?)?;
    limits_warning(&rig, &records, &mut warnings);
    let name = |topic: usize| recording.topics()[topic].name.clone();
    Ok(ImportSummary {
        postures: records.len(),
        selection: plan.selection,
        color_topic: name(chosen.color),
        depth_topic: chosen.depth.map(name),
        joint_topic,
        color_images: color_images.len(),
        moving: plan.moving,
        without_depth: plan.without_depth,
        warnings,
    })
}

fn enough(plan: &PosturePlan, images: usize, track: &JointTrack, options: &ImportOptions) -> Result<(), ImportError> {
    if plan.postures.len() >= 2 {
        return Ok(());
    }
    let selection = &options.selection;
    let reason = match plan.selection {
        Selection::Still | Selection::Automatic => format!(
            "the arm stood still {} times ({} of {images} images fall into these times): slower than {} rad/s for {} s, {} s after it had stopped; for a recording in motion use --moving",
            plan.intervals,
            images - plan.moving,
            selection.max_joint_speed,
            selection.min_stationary_s,
            selection.settle_s
        ),
        _ => format!(
            "{} of {images} images have no joint values at their time ({} samples); do camera and robot stamp with one clock?",
            plan.without_joints,
            track.len()
        ),
    };
    Err(ImportError::TooFewPostures { got: plan.postures.len(), reason })
}

/// Which candidate of each posture is the sharpest.
fn sharpest(
    recording: &mut Recording,
    postures: &[PlannedPosture],
    progress: &dyn Progress,
    warnings: &mut Vec<String>,
) -> Result<Vec<usize>, ImportError> {
    let choices = postures.iter().filter(|posture| posture.candidates.len() > 1);
    let places: Vec<_> = choices.flat_map(|posture| &posture.candidates).map(|image| image.color.place).collect();
    let mut values = BTreeMap::new();
    recording.read(&places, &mut |topic, message| {
        if progress.stop_requested() {
            return Err(RecordingError::Stopped);
        }
        match decode_color(topic, message.data) {
            Ok(pixels) => drop(values.insert(message.place, sharpness(&pixels.image.to_luma8()))),
            Err(error) => warnings.push(format!("an image was passed over: {error}")),
        }
        progress.step();
        Ok(())
    })?;
    let value = |posture: &PlannedPosture, index: usize| {
        values.get(&posture.candidates[index].color.place).copied().unwrap_or(-1.0)
    };
    // Of equally sharp ones the later, which had more time to settle.
    let best = |posture: &PlannedPosture| {
        (0..posture.candidates.len()).max_by(|&a, &b| value(posture, a).total_cmp(&value(posture, b))).unwrap_or(0)
    };
    Ok(postures.iter().map(best).collect())
}

fn decode_color(topic: &skclam_recordings::Topic, data: &[u8]) -> Result<ColorPixels, RecordingError> {
    use skclam_recordings::{CompressedImage, Image};
    match (topic.kind, topic.wire) {
        (MessageKind::Image, Some(wire)) => {
            ColorPixels::from_image(&topic.name, &Image::parse(&topic.name, wire, data)?)
        }
        (MessageKind::CompressedImage, Some(wire)) => {
            ColorPixels::from_compressed(&topic.name, &CompressedImage::parse(&topic.name, wire, data)?)
        }
        _ => ColorPixels::from_file(&topic.name, data),
    }
}

/// An arm beyond its limits says that joints are mixed up or in other units.
fn limits_warning(rig: &Rig, records: &[PostureRecord], warnings: &mut Vec<String>) {
    let Some(robot) = &rig.robot else { return };
    for (index, joint) in robot.joints().iter().enumerate() {
        let outside = |record: &&PostureRecord| match &record.posture.state {
            PostureState::Joints(values) => !joint.admits(values[index]),
            PostureState::FlangePose(_) => false,
        };
        let count = records.iter().filter(outside).count();
        if count > 0 {
            warnings.push(format!(
                "joint {} is outside its limits in {count} of {} postures; are the joints those of the rig?",
                joint.name,
                records.len()
            ));
        }
    }
}
