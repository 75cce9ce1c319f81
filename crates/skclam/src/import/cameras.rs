//! The dataset's rig: arm and mount from the rig that was given, cameras from the recording where it has them.

use super::frames::Frames;
use super::images::ImageKind;
use super::write::Written;
use super::{CameraSource, Chosen, ImportError, ImportOptions};
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera};
use skclam_recordings::{CameraInfo, Recording, RecordingError, RecordingFormat, Topic, pinhole_from_info};
use skclam_rig::Rig;
use std::collections::BTreeMap;

/// What a recording says of its cameras.
#[derive(Debug, Default)]
pub(super) struct Cameras {
    /// By topic: the different messages, each with how often it came.
    infos: BTreeMap<String, Vec<(CameraInfo, usize)>>,
    pub frames: Frames,
    /// `stream_from_reference` of the RealSense Viewer, by topic.
    pub extrinsics: BTreeMap<String, Isometry3>,
    /// Metres a count of the RealSense Viewer, by topic.
    pub depth_units: BTreeMap<String, f32>,
    /// What the images of a topic are.
    pub kinds: BTreeMap<usize, ImageKind>,
}

/// Different `CameraInfo` of a topic that are distinguished.
const MAX_INFOS: usize = 32;
/// A second camera on a topic with more than this fraction of the messages is no accident.
const ACCIDENT: f64 = 0.05;
/// Metres a count in the TUM benchmark: 5000 counts a metre.
const TUM_UNIT_M: f64 = 1.0 / 5000.0;
/// Metres a count by REP 118.
const ROS_UNIT_M: f64 = 1e-3;

impl Cameras {
    pub fn add_info(&mut self, topic: &str, info: CameraInfo) {
        let infos = self.infos.entry(topic.to_owned()).or_default();
        if let Some((_, count)) = infos.iter_mut().find(|(known, _)| is_same(known, &info)) {
            *count += 1;
        } else if infos.len() < MAX_INFOS {
            infos.push((info, 1));
        }
    }

    /// The rig of the dataset. `rig`: without a depth camera where it is a built-in one, whose cameras are nobody's.
    pub fn rig(
        &mut self,
        recording: &Recording,
        rig: &Rig,
        chosen: &Chosen,
        written: &Written,
        options: &ImportOptions,
        warnings: &mut Vec<String>,
    ) -> Result<Rig, ImportError> {
        let topics = recording.topics();
        let mut result = rig.clone();
        let of_rig = (!options.builtin_rig).then_some(rig.color);
        result.color = self.camera("colour", &topics[chosen.color], written.color_size, of_rig, options, warnings)?;
        let Some(depth_topic) = chosen.depth.map(|topic| &topics[topic]) else {
            result.depth = None;
            result.depth_mask = None;
            return Ok(result);
        };
        let of_rig = match (&rig.depth, recording.format()) {
            (Some(depth), _) => Some(depth.camera),
            // The benchmark's depth images are registered to the colour images.
            (None, RecordingFormat::Tum) => Some(result.color),
            (None, _) => None,
        };
        let size = written.depth_size.unwrap_or_default();
        let depth_camera = self.camera("depth", depth_topic, size, of_rig, options, warnings)?;
        let color_from_depth = self.color_from_depth(recording, rig, chosen, options, warnings)?;
        let unit_m = self.unit_m(recording, rig, depth_topic, written);
        result.depth = Some(DepthCamera { camera: depth_camera, unit_m, offset_m: 0.0, color_from_depth });
        if recording.format() == RecordingFormat::Tum && rig.robot.is_none() {
            result.flange_from_color = Isometry3::identity();
        }
        Ok(result)
    }

    /// A camera from its `CameraInfo`; from the rig where there is none, or none that can be read.
    fn camera(
        &self,
        camera: &'static str,
        topic: &Topic,
        size: (u32, u32),
        of_rig: Option<PinholeCamera>,
        options: &ImportOptions,
        warnings: &mut Vec<String>,
    ) -> Result<PinholeCamera, ImportError> {
        let table = if camera == "depth" { "depth" } else { "color" };
        let why = match self.recorded(topic, size, options, warnings) {
            Ok(Some(camera)) => return Ok(camera),
            Ok(None) if options.cameras == CameraSource::Rig => None,
            Ok(None) => Some(format!("the recording has no CameraInfo for {}", topic.name)),
            Err(error) => Some(error.to_string()),
        };
        let fits = |rig: &PinholeCamera| size == (0, 0) || (rig.width, rig.height) == size;
        match (of_rig.filter(fits), of_rig, why) {
            (Some(rig), _, why) => {
                let why = why.map_or(String::new(), |why| format!(": {why}"));
                warnings.push(format!(
                    "the intrinsics of the {camera} camera are those of [{table}] in the given rig{why}"
                ));
                Ok(rig)
            }
            (None, Some(rig), why) => {
                let problem = format!(
                    "the images have {} x {} pixels, but [{table}] of the rig describes {} x {}; give the intrinsics for this size{}",
                    size.0,
                    size.1,
                    rig.width,
                    rig.height,
                    why.map_or(String::new(), |why| format!(". They are needed because {why}"))
                );
                Err(ImportError::Camera { camera, problem })
            }
            (None, None, why) => {
                let why = why.unwrap_or_else(|| "--rig-cameras is given".to_owned());
                let leave = if camera == "depth" { ", or leave depth out with --depth-topic none" } else { "" };
                let problem = format!(
                    "{why}; describe the camera that took the images as [{table}] in a rig and give it with --rig (a built-in robot's camera is not yours){leave}"
                );
                Err(ImportError::Camera { camera, problem })
            }
        }
    }

    /// The camera of an image topic as the recording has it.
    fn recorded(
        &self,
        topic: &Topic,
        size: (u32, u32),
        options: &ImportOptions,
        warnings: &mut Vec<String>,
    ) -> Result<Option<PinholeCamera>, RecordingError> {
        let Some((name, infos)) = self.infos_of(topic, options) else { return Ok(None) };
        let size = (size != (0, 0)).then_some(size);
        let mut read: Vec<(PinholeCamera, Option<String>, usize)> = Vec::new();
        let mut refused: Option<(RecordingError, usize)> = None;
        for (info, count) in infos {
            match pinhole_from_info(name, info, is_rectified(topic), size).and_then(|read| of_size(name, read, size)) {
                Ok((camera, remark)) => match read.iter_mut().find(|(known, ..)| *known == camera) {
                    Some((.., known)) => *known += count,
                    None => read.push((camera, remark, *count)),
                },
                Err(error) if refused.as_ref().is_none_or(|(_, most)| count > most) => refused = Some((error, *count)),
                Err(_) => {}
            }
        }
        read.sort_by_key(|&(.., count)| std::cmp::Reverse(count));
        let all: usize = read.iter().map(|&(.., count)| count).sum();
        if let [(a, _, count_a), (b, _, count_b), ..] = read.as_slice()
            && *count_b as f64 > ACCIDENT * all as f64
        {
            let problem = format!(
                "its CameraInfo changes: {count_a} messages have fx {:.3}, cx {:.3}, {count_b} have fx {:.3}, cx {:.3}; two cameras write into it, or its settings were changed. Give the right intrinsics in a rig (--rig RIG --rig-cameras)",
                a.fx, a.cx, b.fx, b.cx
            );
            return Err(RecordingError::Message { topic: name.to_owned(), problem });
        }
        match (read.into_iter().next(), refused) {
            (Some((camera, remark, count)), _) => {
                warnings.extend(remark);
                let all: usize = infos.iter().map(|(_, count)| count).sum();
                if count < all {
                    warnings.push(format!(
                        "{name}: {} of {all} CameraInfo were passed over: empty, or not as the others",
                        all - count
                    ));
                }
                Ok(Some(camera))
            }
            (None, Some((error, _))) => Err(error),
            (None, None) => Ok(None),
        }
    }

    /// The `CameraInfo` of an image topic: those beside it, or of the only topic of its frame.
    fn infos_of(&self, topic: &Topic, options: &ImportOptions) -> Option<(&str, &[(CameraInfo, usize)])> {
        if options.cameras == CameraSource::Rig {
            return None;
        }
        let image = topic.name.trim_end_matches("/compressedDepth").trim_end_matches("/compressed");
        let parent = image.rsplit_once('/').map_or("", |(parent, _)| parent);
        // camera/image_raw has camera/camera_info; the RealSense Viewer's .../image/data has .../info/camera_info.
        let beside = [
            Some(format!("{parent}/camera_info")),
            parent.strip_suffix("/image").map(|stream| format!("{stream}/info/camera_info")),
        ];
        let found = beside.iter().flatten().find_map(|name| self.infos.get_key_value(name));
        let frame = self.kinds.get(&topic.id).map(|kind| &kind.frame_id).filter(|frame| !frame.is_empty());
        let of_frame = || {
            let is_of_frame =
                |infos: &[(CameraInfo, usize)]| infos.iter().any(|(info, _)| Some(&info.frame_id) == frame);
            let mut same = self.infos.iter().filter(|(_, infos)| is_of_frame(infos));
            same.next().filter(|_| same.next().is_none())
        };
        found.or_else(of_frame).map(|(name, infos)| (name.as_str(), infos.as_slice()))
    }

    /// The optical frame of the colour camera, as its images name it.
    pub fn color_frame(&self, chosen: &Chosen) -> Option<&str> {
        let frame = self.kinds.get(&chosen.color)?.frame_id.as_str();
        (!frame.is_empty()).then_some(frame)
    }

    fn color_from_depth(
        &self,
        recording: &Recording,
        rig: &Rig,
        chosen: &Chosen,
        options: &ImportOptions,
        warnings: &mut Vec<String>,
    ) -> Result<Isometry3, ImportError> {
        let of_rig = rig.depth.as_ref().map(|depth| depth.color_from_depth);
        if let (CameraSource::Rig, Some(transform)) = (options.cameras, of_rig) {
            return Ok(transform);
        }
        let topics = recording.topics();
        let [color, depth] = [Some(chosen.color), chosen.depth].map(|topic| topic.map(|topic| &topics[topic]));
        let stream = |topic: Option<&Topic>| {
            let prefix = topic?.name.strip_suffix("/image/data")?;
            let mut found = self.extrinsics.iter().filter(|(name, _)| name.starts_with(&format!("{prefix}/tf/")));
            found.next().map(|(_, transform)| *transform)
        };
        if let (Some(color_from_reference), Some(depth_from_reference)) = (stream(color), stream(depth)) {
            return Ok(color_from_reference * depth_from_reference.inverse());
        }
        let frame = |topic: Option<&Topic>| {
            topic.and_then(|topic| self.kinds.get(&topic.id)).map(|kind| kind.frame_id.clone()).unwrap_or_default()
        };
        let (color_frame, depth_frame) = (frame(color), frame(depth));
        let realsense_viewer = color.is_some_and(|topic| topic.name.ends_with("/image/data"));
        if !realsense_viewer && !color_frame.is_empty() && color_frame == depth_frame {
            return Ok(Isometry3::identity());
        }
        if recording.format() == RecordingFormat::Tum {
            return Ok(of_rig.unwrap_or_else(Isometry3::identity));
        }
        let ((root_a, root_from_color), (root_b, root_from_depth)) =
            (self.frames.to_root(&color_frame), self.frames.to_root(&depth_frame));
        if root_a == root_b && !root_a.is_empty() && !realsense_viewer {
            return Ok(root_from_color.inverse() * root_from_depth);
        }
        let contradiction = [&color_frame, &depth_frame].into_iter().find_map(|frame| self.frames.contradiction(frame));
        let why = contradiction
            .unwrap_or_else(|| format!("no static transform leads from \"{depth_frame}\" to \"{color_frame}\""));
        match of_rig {
            Some(transform) => {
                let t = transform.translation.vector * 1e3;
                warnings.push(format!(
                    "color_from_depth is that of the given rig ({:.1}, {:.1}, {:.1} mm): {why}",
                    t.x, t.y, t.z
                ));
                Ok(transform)
            }
            None => Err(ImportError::Camera {
                camera: "depth",
                problem: format!(
                    "color_from_depth is not known: {why}. Record /tf_static too, give [depth.color_from_depth] in a rig (--rig), or leave depth out with --depth-topic none"
                ),
            }),
        }
    }

    fn unit_m(&self, recording: &Recording, rig: &Rig, topic: &Topic, written: &Written) -> f64 {
        let sensor = topic.name.split("/Depth_").next().unwrap_or_default();
        let option = self.depth_units.iter().find(|(name, _)| !sensor.is_empty() && name.starts_with(sensor));
        let option = option.map(|(_, unit)| f64::from(*unit)).filter(|unit| unit.is_finite() && *unit > 0.0);
        let convention = if recording.format() == RecordingFormat::Tum { TUM_UNIT_M } else { ROS_UNIT_M };
        let unit = written.depth_unit_m.or(option);
        // Floats of binary fractions as decimal ones: 0.001f32 is meant as a millimetre.
        let unit = unit.map(|unit| (unit as f32).to_string().parse().unwrap_or(unit));
        unit.or(rig.depth.as_ref().map(|depth| depth.unit_m)).unwrap_or(convention)
    }
}

/// Whether two messages are the same bit for bit: what is NaN in both is the same too.
fn is_same(a: &CameraInfo, b: &CameraInfo) -> bool {
    let numbers = |info: &CameraInfo| -> Vec<u64> {
        info.distortion.iter().chain(&info.matrix).chain(&info.projection).map(|value| value.to_bits()).collect()
    };
    (a.width, a.height) == (b.width, b.height)
        && (&a.frame_id, &a.distortion_model) == (&b.frame_id, &b.distortion_model)
        && a.distortion.len() == b.distortion.len()
        && numbers(a) == numbers(b)
}

fn is_rectified(topic: &Topic) -> bool {
    let name = topic.name.trim_end_matches("/compressedDepth").trim_end_matches("/compressed");
    name.rsplit('/').next().is_some_and(|last| last.starts_with("image_rect"))
}

/// A camera that was read, if it is as large as the images.
fn of_size(
    topic: &str,
    read: (PinholeCamera, Option<String>),
    size: Option<(u32, u32)>,
) -> Result<(PinholeCamera, Option<String>), RecordingError> {
    let described = (read.0.width, read.0.height);
    match size {
        Some((width, height)) if described != (width, height) => {
            let problem = format!(
                "the images have {width} x {height} pixels, but CameraInfo is for {} x {}; give the intrinsics for this size in a rig (--rig RIG --rig-cameras)",
                described.0, described.1
            );
            Err(RecordingError::Message { topic: topic.to_owned(), problem })
        }
        _ => Ok(read),
    }
}
