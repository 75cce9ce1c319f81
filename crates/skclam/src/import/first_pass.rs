//! The first pass through a recording: stamps of all images, the joints, the cameras; no pixels. A message that cannot
//! be read is passed over and counted.

use super::cameras::Cameras;
use super::images::Images;
use super::passed_over::PassedOver;
use super::{Chosen, DepthChoice, ImportError, ImportOptions, topics};
use crate::progress::Progress;
use skclam_recordings::{
    CameraInfo, Float32, ImageHead, JointCollector, JointNames, JointState, JointTrack, Message, MessageKind,
    Recording, RecordingError, Topic, TransformMessage, Wanted, WireFormat, parse_tf_message,
};
use skclam_rig::Rig;
use std::collections::BTreeMap;

/// What the first pass found.
pub(super) struct FirstPass {
    pub chosen: Chosen,
    pub images: Images,
    pub joints: JointCollector,
    /// Poses instead of joints, by topic.
    pub poses: BTreeMap<usize, JointTrack>,
    pub cameras: Cameras,
    pub warnings: Vec<String>,
}

/// An image's header, size and encoding are within so many bytes.
const HEAD_BYTES: usize = 1024;

pub(super) fn first_pass(
    recording: &mut Recording,
    rig: &Rig,
    wants_joints: bool,
    options: &ImportOptions,
    passed_over: &mut PassedOver,
    progress: &dyn Progress,
) -> Result<FirstPass, ImportError> {
    let joint_topic = options.joint_topic.as_deref();
    let mut want = |topic: &Topic, _| match topic.kind {
        MessageKind::Image | MessageKind::CompressedImage if is_image_wanted(topic, options) => {
            Wanted::Beginning(HEAD_BYTES)
        }
        MessageKind::ImageFile if is_image_wanted(topic, options) => Wanted::Beginning(0),
        MessageKind::JointState if wants_joints && joint_topic.is_none_or(|name| name == topic.name) => Wanted::Whole,
        MessageKind::PoseLine if wants_joints => Wanted::Whole,
        MessageKind::CameraInfo | MessageKind::Transforms | MessageKind::Transform => Wanted::Whole,
        // With a space in the Viewer's own files, with an underscore where they were converted.
        MessageKind::Float32 if topic.name.replace(' ', "_").ends_with("/option/Depth_Units/value") => Wanted::Whole,
        _ => Wanted::Nothing,
    };
    let mut found = Found::new(rig, options);
    recording.scan(false, &mut want, &mut |topic, message| {
        if progress.stop_requested() {
            return Err(RecordingError::Stopped);
        }
        let read = match topic.wire {
            Some(wire) => found.message(topic, wire, message),
            None => found.file(topic, message),
        };
        passed_over.check(&topic.name, read).map(drop)
    })?;
    let Found { mut images, joints, poses, mut cameras, .. } = found;
    let mut warnings = Vec::new();
    let chosen = topics::choose(recording, &images, options, &mut warnings)?;
    images.topics.retain(|topic, _| *topic == chosen.color || Some(*topic) == chosen.depth);
    for (id, topic) in &mut images.topics {
        let named = &recording.topics()[*id];
        let others = topic.keep_main(named)?;
        if others > 0 {
            let kind = topic.kind();
            let ((width, height), encoding) = (kind.size, &kind.encoding);
            let problem = format!("it is not {width} x {height} in {encoding:?}, as the others are");
            passed_over.add_many(&named.name, others as u64, problem);
        }
        cameras.kinds.insert(*id, topic.kind().clone());
    }
    Ok(FirstPass { chosen, images, joints, poses, cameras, warnings })
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

struct Found<'a> {
    images: Images,
    joints: JointCollector,
    poses: BTreeMap<usize, JointTrack>,
    cameras: Cameras,
    /// Names that the arm's joints may have.
    arm: Vec<String>,
    given: Option<&'a [String]>,
}

impl<'a> Found<'a> {
    fn new(rig: &Rig, options: &'a ImportOptions) -> Self {
        let arm = rig.robot.iter().flat_map(|robot| robot.joints()).map(|joint| joint.name.clone()).collect();
        Found {
            images: Images::default(),
            joints: JointCollector::default(),
            poses: BTreeMap::new(),
            cameras: Cameras::default(),
            arm,
            given: options.joint_names.as_deref(),
        }
    }

    fn message(&mut self, topic: &Topic, wire: WireFormat, message: &Message<'_>) -> Result<(), RecordingError> {
        let (name, data) = (&topic.name, message.data);
        match topic.kind {
            kind @ (MessageKind::Image | MessageKind::CompressedImage) => {
                let head = ImageHead::parse(kind, name, wire, data)?;
                self.images.add(topic, Some(&head), (head.header.stamp, message.log_time, message.place))?;
            }
            MessageKind::CameraInfo => self.cameras.add_info(name, CameraInfo::parse(name, wire, data)?),
            MessageKind::JointState => {
                let state = JointState::parse(name, wire, data)?;
                let keep = |name: &str| match self.given {
                    Some(given) => given.iter().any(|wanted| wanted == name),
                    None => JointNames::may_match(&self.arm, name),
                };
                self.joints.add(topic.id, message.log_time, &state, self.given, &keep);
            }
            MessageKind::Transforms => {
                let is_static = name.ends_with("tf_static");
                self.cameras.frames.add(parse_tf_message(name, wire, data)?, is_static)?;
            }
            MessageKind::Transform => {
                self.cameras.extrinsics.insert(name.clone(), TransformMessage::parse(name, wire, data)?.0);
            }
            MessageKind::Float32 => {
                self.cameras.depth_units.insert(name.clone(), Float32::parse(name, wire, data)?.0);
            }
            _ => {}
        }
        Ok(())
    }

    fn file(&mut self, topic: &Topic, message: &Message<'_>) -> Result<(), RecordingError> {
        match topic.kind {
            MessageKind::ImageFile => self.images.add(topic, None, (message.log_time, message.log_time, message.place)),
            MessageKind::PoseLine => self.pose(topic, message.log_time, message.data),
            _ => Ok(()),
        }
    }

    /// A pose as seven values: metres and a quaternion.
    fn pose(&mut self, topic: &Topic, stamp: i64, line: &[u8]) -> Result<(), RecordingError> {
        let text = String::from_utf8_lossy(line);
        let mut values: Vec<f64> =
            text.split_whitespace().map_while(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect();
        let norm = values.get(3..).unwrap_or_default().iter().map(|v| v * v).sum::<f64>().sqrt();
        if values.len() != 7 || (norm - 1.0).abs() > 1e-2 {
            let problem = format!("{text:?} is no pose; \"tx ty tz qx qy qz qw\" is expected");
            return Err(RecordingError::Message { topic: topic.name.clone(), problem });
        }
        let track = self.poses.entry(topic.id).or_insert_with(|| JointTrack::new(vec![false; 7]));
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
