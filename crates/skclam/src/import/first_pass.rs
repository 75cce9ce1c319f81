//! The first pass through a recording: stamps of all images, the joints, the cameras; no pixels.

use super::cameras::Cameras;
use super::{Chosen, DepthChoice, ImportError, ImportOptions, topics};
use crate::progress::Progress;
use skclam_kinematics::JointKind;
use skclam_recordings::{
    CameraInfo, Float32, ImageHead, ImageStamp, JointNames, JointState, JointTrack, MessageKind, Recording,
    RecordingError, Topic, TransformMessage, Wanted, parse_tf_message,
};
use skclam_rig::Rig;
use std::collections::{BTreeMap, BTreeSet};

/// What the first pass found.
pub(super) struct FirstPass {
    pub chosen: Chosen,
    /// By topic.
    pub images: BTreeMap<usize, Vec<ImageStamp>>,
    pub tracks: Tracks,
    pub cameras: Cameras,
    pub warnings: Vec<String>,
}

/// Joints or poses by topic, and why other topics have none.
#[derive(Default)]
pub(super) struct Tracks {
    pub found: BTreeMap<usize, JointTrack>,
    pub names: BTreeMap<usize, JointNames>,
    pub refused: BTreeMap<usize, RecordingError>,
}

/// Size, encoding and frame of a topic's first image.
#[derive(Debug, Clone, Default)]
pub(super) struct ImageKind {
    pub encoding: String,
    pub frame_id: String,
}

/// Images of a recording at most, over all topics.
const MAX_IMAGES: usize = 1 << 22;
/// Topics with joints at most: each track takes memory.
const MAX_TRACKS: usize = 2;
/// An image's header, size and encoding are within so many bytes.
const HEAD_BYTES: usize = 1024;

pub(super) fn first_pass(
    recording: &mut Recording,
    rig: &Rig,
    wants_joints: bool,
    options: &ImportOptions,
    progress: &dyn Progress,
) -> Result<FirstPass, ImportError> {
    let mut images: BTreeMap<usize, Vec<ImageStamp>> = BTreeMap::new();
    let mut kinds: BTreeMap<usize, ImageKind> = BTreeMap::new();
    let mut tracks = Tracks::default();
    let mut cameras = Cameras::default();
    let mut warnings = Vec::new();
    let mut count = 0;
    let mut seen_cameras = BTreeSet::new();
    let joint_topic = options.joint_topic.as_deref();
    let mut want = |topic: &Topic, _| match topic.kind {
        MessageKind::Image | MessageKind::CompressedImage if is_image_wanted(topic, options) => {
            Wanted::Beginning(HEAD_BYTES)
        }
        MessageKind::ImageFile if is_image_wanted(topic, options) => Wanted::Beginning(0),
        MessageKind::CameraInfo if seen_cameras.insert(topic.id) => Wanted::Whole,
        MessageKind::JointState if wants_joints && joint_topic.is_none_or(|name| name == topic.name) => Wanted::Whole,
        MessageKind::PoseLine if wants_joints => Wanted::Whole,
        MessageKind::Transforms if topic.name.ends_with("tf_static") => Wanted::Whole,
        MessageKind::Transform => Wanted::Whole,
        // With a space in the Viewer's own files, with an underscore where they were converted.
        MessageKind::Float32 if topic.name.replace(' ', "_").ends_with("/option/Depth_Units/value") => Wanted::Whole,
        _ => Wanted::Nothing,
    };
    recording.scan(false, &mut want, &mut |topic, message| {
        if progress.stop_requested() {
            return Err(RecordingError::Stopped);
        }
        let name = &topic.name;
        match (topic.kind, topic.wire) {
            (kind @ (MessageKind::Image | MessageKind::CompressedImage), Some(wire)) => {
                let head = ImageHead::parse(kind, name, wire, message.data)?;
                kinds.entry(topic.id).or_insert_with(|| ImageKind {
                    encoding: head.encoding.to_owned(),
                    frame_id: head.header.frame_id.to_owned(),
                });
                add(&mut images, &mut count, topic, ImageStamp { stamp: head.header.stamp, place: message.place })?;
            }
            (MessageKind::ImageFile, _) => {
                kinds.entry(topic.id).or_default();
                add(&mut images, &mut count, topic, ImageStamp { stamp: message.log_time, place: message.place })?;
            }
            (MessageKind::CameraInfo, Some(wire)) => {
                cameras.infos.insert(name.clone(), CameraInfo::parse(name, wire, message.data)?);
            }
            (MessageKind::JointState, Some(wire)) => {
                tracks.add_joints(topic.id, &JointState::parse(name, wire, message.data)?, rig, options);
            }
            (MessageKind::PoseLine, _) => tracks.add_pose(topic, message.log_time, message.data)?,
            (MessageKind::Transforms, Some(wire)) => {
                cameras.add_transforms(parse_tf_message(name, wire, message.data)?)?
            }
            (MessageKind::Transform, Some(wire)) => {
                cameras.extrinsics.insert(name.clone(), TransformMessage::parse(name, wire, message.data)?.0);
            }
            (MessageKind::Float32, Some(wire)) => {
                cameras.depth_units.insert(name.clone(), Float32::parse(name, wire, message.data)?.0);
            }
            _ => {}
        }
        Ok(())
    })?;
    let chosen = topics::choose(recording, &kinds, options, &mut warnings)?;
    images.retain(|topic, _| *topic == chosen.color || Some(*topic) == chosen.depth);
    cameras.frames = kinds.into_iter().map(|(topic, kind)| (topic, kind.frame_id)).collect();
    Ok(FirstPass { chosen, images, tracks, cameras, warnings })
}

/// Where topics are named, no other's stamps are collected.
fn is_image_wanted(topic: &Topic, options: &ImportOptions) -> bool {
    let color = options.color_topic.as_deref();
    match &options.depth {
        DepthChoice::Topic(depth) => *depth == topic.name || color.is_none_or(|color| color == topic.name),
        DepthChoice::Automatic => true,
        DepthChoice::None => color.is_none_or(|color| color == topic.name),
    }
}

fn add(
    images: &mut BTreeMap<usize, Vec<ImageStamp>>,
    count: &mut usize,
    topic: &Topic,
    image: ImageStamp,
) -> Result<(), RecordingError> {
    *count += 1;
    if *count > MAX_IMAGES {
        let problem = format!("there are more than {MAX_IMAGES} images; name the topics, or cut the recording");
        return Err(RecordingError::Message { topic: topic.name.clone(), problem });
    }
    images.entry(topic.id).or_default().push(image);
    Ok(())
}

impl Tracks {
    fn add_joints(&mut self, topic: usize, state: &JointState<'_>, rig: &Rig, options: &ImportOptions) {
        let Some(robot) = &rig.robot else { return };
        if !self.names.contains_key(&topic) {
            if state.positions.is_empty() {
                return;
            }
            let arm: Vec<String> = match &options.joint_names {
                Some(names) => names.clone(),
                None => robot.joints().iter().map(|joint| joint.name.clone()).collect(),
            };
            let resolved = match &options.joint_names {
                Some(names) if names.len() != robot.joint_count() => Err(RecordingError::Joints {
                    problem: format!("{} names are given, but the arm has {}", names.len(), robot.joint_count()),
                }),
                _ => JointNames::resolve(&arm, &state.names),
            };
            match resolved {
                Ok(names) if self.found.len() < MAX_TRACKS => {
                    let wraps = robot.joints().iter().map(|joint| joint.kind == JointKind::Revolute).collect();
                    self.found.insert(topic, JointTrack::new(wraps));
                    self.names.insert(topic, names);
                    self.refused.remove(&topic);
                }
                Ok(_) => return,
                Err(error) => {
                    // A later message of the topic may have the arm's joints: a gripper may speak first.
                    self.refused.entry(topic).or_insert(error);
                    return;
                }
            }
        }
        let values = self.names.get(&topic).and_then(|names| names.values(&state.names, &state.positions));
        if let (Some(values), Some(track)) = (values, self.found.get_mut(&topic)) {
            track.push(state.header.stamp, &values);
        }
    }

    /// A pose as seven values: metres and a quaternion.
    fn add_pose(&mut self, topic: &Topic, stamp: i64, line: &[u8]) -> Result<(), RecordingError> {
        let text = String::from_utf8_lossy(line);
        let mut values: Vec<f64> =
            text.split_whitespace().map_while(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        let norm = values.get(3..).unwrap_or_default().iter().map(|v| v * v).sum::<f64>().sqrt();
        if values.len() != 7 || (norm - 1.0).abs() > 1e-2 {
            let problem = format!("{text:?} is no pose; \"tx ty tz qx qy qz qw\" is expected");
            return Err(RecordingError::Message { topic: topic.name.clone(), problem });
        }
        let track = self.found.entry(topic.id).or_insert_with(|| JointTrack::new(vec![false; 7]));
        // Of the two quaternions of a rotation the one near the last, so that the mean of neighbours is between them.
        if let Some(last) = track.len().checked_sub(1) {
            let product: f64 = values[3..].iter().zip(&track.at(last)[3..]).map(|(a, b)| a * b).sum();
            if product < 0.0 {
                values[3..].iter_mut().for_each(|value| *value = -*value);
            }
        }
        track.push(stamp, &values);
        Ok(())
    }
}
