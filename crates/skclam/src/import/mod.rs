//! A recording of a robot becomes a dataset: find the topics, pair colour, depth and joints by their stamps, take a
//! posture where the arm stood still, write `rig.toml`, `postures.csv` and the images.
//!
//! The recording is read once for its stamps and joints, past the pixels; then only the images that may be taken are
//! read. Memory does not grow with the recording.

mod cameras;
mod clocks;
mod error;
mod first_pass;
mod frames;
mod images;
mod joint_log;
mod joints;
mod passed_over;
mod poses;
mod timing;
mod topics;
mod write;

pub use clocks::ClockChoice;
pub use error::ImportError;
pub use joint_log::read_joint_log;
pub use poses::{PoseNotation, PoseTableOptions, import_poses};

use crate::dataset::PostureRecord;
use crate::output::StagedFolder;
use crate::progress::{Progress, Stage};
use first_pass::{FirstPass, first_pass};
use passed_over::PassedOver;
use serde::{Deserialize, Serialize};
use skclam_kinematics::JointKind;
use skclam_recordings::{
    ColorPixels, JointTrack, MessageKind, PlannedPosture, PosturePlan, Recording, RecordingError, Selection,
    SelectionOptions, plan_postures, sharpness,
};
use skclam_rig::{PostureState, Rig};
use std::collections::BTreeMap;
use timing::{Timed, timed};
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
    /// Whether the rig is a built-in one: its arm may be that of the recording, its cameras are those of the virtual
    /// cell and never replace real ones.
    pub builtin_rig: bool,
    /// Which times pair images and joints.
    pub clock: ClockChoice,
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
    let mut passed_over = PassedOver::default();
    let imported = import_postures(recording, rig, joint_log, options, staged, progress, &mut passed_over);
    let notes = [passed_over.warnings(), recording.cuts().to_vec()].concat();
    match imported {
        Ok(mut summary) => {
            summary.warnings.splice(0..0, notes);
            Ok(summary)
        }
        // What was wrong with the recording may be why it ended so.
        Err(error) if !notes.is_empty() && !matches!(error, ImportError::Recording(RecordingError::Stopped)) => {
            Err(ImportError::Noted { source: Box::new(error), notes: notes.join("\n") })
        }
        Err(error) => Err(error),
    }
}

fn import_postures(
    recording: &mut Recording,
    rig: &Rig,
    joint_log: Option<JointTrack>,
    options: &ImportOptions,
    staged: &StagedFolder,
    progress: &dyn Progress,
    passed_over: &mut PassedOver,
) -> Result<ImportSummary, ImportError> {
    // The depth camera of a built-in rig is nobody's; the colour camera is asked for where it is used.
    let of_arm = Rig { depth: rig.depth.filter(|_| !options.builtin_rig), ..rig.clone() };
    let rig = &of_arm;
    let mut found = first_pass(recording, rig, joint_log.is_none(), options, passed_over, progress)?;
    let timed = timed(recording, rig, joint_log, &mut found, options)?;
    let mut plan = plan(&mut found, &timed, options)?;
    progress.begin(Stage::Import, plan.postures.iter().map(|posture| posture.candidates.len() as u64).sum());
    let mut taken = sharpest(recording, &plan.postures, progress)?;
    let written = write::images(recording, &found.chosen, &plan.postures, &taken, staged, passed_over, progress)?;
    drop_unread(&mut plan, &mut taken, &written)?;
    let FirstPass { chosen, images, mut cameras, mut warnings, .. } = found;
    let imported = cameras.rig(recording, rig, &chosen, &written, options, &mut warnings)?;
    let robot = rig.robot.as_ref();
    let candidates = plan.postures.iter().zip(&taken).map(|(posture, &candidate)| &posture.candidates[candidate]);
    let records: Vec<PostureRecord> =
        candidates.enumerate().map(|(index, candidate)| write::record(index, candidate, &written, robot)).collect();
    let kinds: Vec<JointKind> = robot.iter().flat_map(|robot| robot.joints()).map(|joint| joint.kind).collect();
    staged.write("postures.csv", crate::dataset::write_postures(&records, &kinds)?)?;
    staged.write("rig.toml", imported.to_toml()?)?;
    write::frames(&cameras, &chosen, staged)?;
    limits_warning(&imported, &records, &mut warnings);
    let name = |topic: usize| recording.topics()[topic].name.clone();
    Ok(ImportSummary {
        postures: records.len(),
        selection: plan.selection,
        color_topic: name(chosen.color),
        depth_topic: chosen.depth.map(name),
        joint_topic: timed.joint_topic,
        color_images: images.stamps(chosen.color, timed.clock).len(),
        moving: plan.moving,
        without_depth: plan.without_depth,
        warnings,
    })
}

/// Which images are worth decoding.
fn plan(found: &mut FirstPass, timed: &Timed, options: &ImportOptions) -> Result<PosturePlan, ImportError> {
    let stamps = |topic: usize| found.images.stamps(topic, timed.clock);
    let color_images = stamps(found.chosen.color);
    let depth_images = found.chosen.depth.map(stamps).unwrap_or_default();
    let plan = plan_postures(&timed.track, &color_images, &depth_images, &options.selection)?;
    enough(&plan, color_images.len(), &timed.track, options)?;
    if options.selection.selection == Selection::Automatic && plan.selection == Selection::Snapshots {
        found.warnings.push(
            "joint states come too seldom to know whether the arm moved; every image with joints beside it is taken"
                .to_owned(),
        );
    }
    if plan.without_depth == plan.postures.len() && !depth_images.is_empty() {
        found.warnings.push(format!(
            "no depth image is within {} s of a colour image: do both cameras stamp with one clock?",
            options.selection.depth_tolerance_s
        ));
    }
    Ok(plan)
}

/// A posture whose image could not be read is none.
fn drop_unread(plan: &mut PosturePlan, taken: &mut Vec<usize>, written: &write::Written) -> Result<(), ImportError> {
    let before = plan.postures.len();
    let postures = std::mem::take(&mut plan.postures).into_iter().zip(std::mem::take(taken));
    let has_image = |(posture, candidate): &(PlannedPosture, usize)| written.has(&posture.candidates[*candidate]);
    (plan.postures, *taken) = postures.filter(has_image).unzip();
    let got = plan.postures.len();
    if got < 2 {
        let reason = format!("the images of {} more could not be read", before - got);
        return Err(ImportError::TooFewPostures { got, reason });
    }
    Ok(())
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
) -> Result<Vec<usize>, ImportError> {
    let choices = postures.iter().filter(|posture| posture.candidates.len() > 1);
    let places: Vec<_> = choices.flat_map(|posture| &posture.candidates).map(|image| image.color.place).collect();
    let mut values = BTreeMap::new();
    recording.read(&places, &mut |topic, message| {
        if progress.stop_requested() {
            return Err(RecordingError::Stopped);
        }
        // What is taken after all is counted when it is written.
        if let Ok(pixels) = decode_color(topic, message.data) {
            values.insert(message.place, sharpness(&pixels.image.to_luma8()));
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
