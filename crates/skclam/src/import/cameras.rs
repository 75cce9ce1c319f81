//! The dataset's rig: arm and mount from the rig that was given, cameras from the recording where it has them.

use super::write::Written;
use super::{CameraSource, Chosen, ImportError, ImportOptions};
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera};
use skclam_recordings::{
    CameraInfo, Recording, RecordingError, RecordingFormat, Topic, TransformStamped, pinhole_from_info,
};
use skclam_rig::Rig;
use std::collections::BTreeMap;

/// What a recording says of its cameras.
#[derive(Debug, Default)]
pub(super) struct Cameras {
    /// By topic.
    pub infos: BTreeMap<String, CameraInfo>,
    /// Child frame to parent frame and `parent_from_child`.
    pub transforms: BTreeMap<String, (String, Isometry3)>,
    /// `stream_from_reference` of the RealSense Viewer, by topic.
    pub extrinsics: BTreeMap<String, Isometry3>,
    /// Metres a count of the RealSense Viewer, by topic.
    pub depth_units: BTreeMap<String, f32>,
    /// Frames of the image topics.
    pub frames: BTreeMap<usize, String>,
}

/// Frames of a tree of transforms at most.
const MAX_FRAMES: usize = 1 << 14;
/// Metres a count in the TUM benchmark: 5000 counts a metre.
const TUM_UNIT_M: f64 = 1.0 / 5000.0;
/// Metres a count by REP 118.
const ROS_UNIT_M: f64 = 1e-3;

impl Cameras {
    pub fn add_transforms(&mut self, transforms: Vec<TransformStamped>) -> Result<(), RecordingError> {
        let plain = |frame: &str| frame.trim_start_matches('/').to_owned();
        for TransformStamped { parent, child, parent_from_child } in transforms {
            if self.transforms.len() == MAX_FRAMES {
                let problem = format!("there are more than {MAX_FRAMES} frames");
                return Err(RecordingError::Message { topic: "/tf_static".to_owned(), problem });
            }
            self.transforms.insert(plain(&child), (plain(&parent), parent_from_child));
        }
        Ok(())
    }

    /// The rig of the dataset.
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
        let color_topic = &topics[chosen.color];
        if let Some((topic, info)) = self.info(color_topic, options) {
            let (camera, remark) = pinhole_from_info(topic, info, is_rectified(color_topic))?;
            warnings.extend(remark);
            result.color = camera;
        } else {
            warnings.push("the intrinsics of the colour camera are those of the given rig".to_owned());
        }
        check_size("colour", &result.color, written.color_size)?;
        let Some(depth_topic) = chosen.depth.map(|topic| &topics[topic]) else {
            result.depth = None;
            result.depth_mask = None;
            return Ok(result);
        };
        let depth_camera = match self.info(depth_topic, options) {
            Some((topic, info)) => {
                let (camera, remark) = pinhole_from_info(topic, info, is_rectified(depth_topic))?;
                warnings.extend(remark);
                camera
            }
            None => match (&rig.depth, recording.format()) {
                (Some(depth), _) => depth.camera,
                // The benchmark's depth images are registered to the colour images.
                (None, RecordingFormat::Tum) => result.color,
                (None, _) => {
                    let problem = format!(
                        "the recording has no CameraInfo beside {}, and the rig no [depth]; describe the depth camera in a rig, or leave it out with --depth-topic none",
                        depth_topic.name
                    );
                    return Err(ImportError::Camera { camera: "depth", problem });
                }
            },
        };
        if let Some(size) = written.depth_size {
            check_size("depth", &depth_camera, size)?;
        }
        let color_from_depth = self.color_from_depth(recording, rig, chosen, options)?;
        let unit_m = self.unit_m(recording, rig, depth_topic, written);
        result.depth = Some(DepthCamera { camera: depth_camera, unit_m, offset_m: 0.0, color_from_depth });
        if recording.format() == RecordingFormat::Tum && rig.robot.is_none() {
            result.flange_from_color = Isometry3::identity();
        }
        Ok(result)
    }

    /// The `CameraInfo` of an image topic: the one beside it, or the only one of its frame.
    fn info(&self, topic: &Topic, options: &ImportOptions) -> Option<(&str, &CameraInfo)> {
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
        let frame = self.frames.get(&topic.id).filter(|frame| !frame.is_empty());
        let of_frame = || {
            let mut same = self.infos.iter().filter(|(_, info)| Some(&info.frame_id) == frame);
            same.next().filter(|_| same.next().is_none())
        };
        found.or_else(of_frame).map(|(name, info)| (name.as_str(), info))
    }

    fn color_from_depth(
        &self,
        recording: &Recording,
        rig: &Rig,
        chosen: &Chosen,
        options: &ImportOptions,
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
        let frame =
            |topic: Option<&Topic>| topic.and_then(|topic| self.frames.get(&topic.id)).cloned().unwrap_or_default();
        let (color_frame, depth_frame) = (frame(color), frame(depth));
        let realsense_viewer = color.is_some_and(|topic| topic.name.ends_with("/image/data"));
        if !realsense_viewer && !color_frame.is_empty() && color_frame == depth_frame {
            return Ok(Isometry3::identity());
        }
        if recording.format() == RecordingFormat::Tum {
            return Ok(of_rig.unwrap_or_else(Isometry3::identity));
        }
        if let (Some((root_a, root_from_color)), Some((root_b, root_from_depth))) =
            (self.to_root(&color_frame), self.to_root(&depth_frame))
            && root_a == root_b
            && !realsense_viewer
        {
            return Ok(root_from_color.inverse() * root_from_depth);
        }
        of_rig.ok_or_else(|| ImportError::Camera {
            camera: "depth",
            problem: format!("no static transform leads from its frame \"{depth_frame}\" to \"{color_frame}\"; record /tf_static, or give [depth.color_from_depth] in a rig"),
        })
    }

    /// `root_from_frame` along the static transforms.
    fn to_root(&self, frame: &str) -> Option<(String, Isometry3)> {
        let mut at = frame.trim_start_matches('/').to_owned();
        let mut root_from_frame = Isometry3::identity();
        // A tree has no more steps than frames; more are a circle.
        for _ in 0..=self.transforms.len() {
            match self.transforms.get(&at) {
                Some((parent, parent_from_child)) => {
                    root_from_frame = parent_from_child * root_from_frame;
                    at = parent.clone();
                }
                None => return Some((at, root_from_frame)),
            }
        }
        None
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

fn is_rectified(topic: &Topic) -> bool {
    let name = topic.name.trim_end_matches("/compressedDepth").trim_end_matches("/compressed");
    name.rsplit('/').next().is_some_and(|last| last.starts_with("image_rect"))
}

fn check_size(camera: &'static str, described: &PinholeCamera, (width, height): (u32, u32)) -> Result<(), ImportError> {
    if (described.width, described.height) == (width, height) {
        return Ok(());
    }
    let problem = format!(
        "the images have {width} x {height} pixels, but the intrinsics are for {} x {}",
        described.width, described.height
    );
    Err(ImportError::Camera { camera, problem })
}
