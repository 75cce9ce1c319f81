//! The hand-eye transform for software that has a tree of frames.

use super::{ExportOptions, USUAL_CAMERA_FRAME};
use serde::Serialize;
use skclam_kinematics::Isometry3;
use skclam_rig::Rig;

/// A pose as numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ExportedPose {
    translation_mm: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

impl From<&Isometry3> for ExportedPose {
    fn from(pose: &Isometry3) -> Self {
        let t = pose.translation.vector * 1e3;
        let q = pose.rotation.coords;
        ExportedPose { translation_mm: [t.x, t.y, t.z], quaternion_xyzw: [q.x, q.y, q.z, q.w] }
    }
}

/// The hand-eye transform, in the frames of the reader.
#[derive(Debug, Serialize)]
pub(super) struct ExportedMount {
    pub flange_frame: String,
    /// The frame that the camera's driver has at the root of its tree, or the optical one.
    pub child_frame: String,
    /// Of `child_frame`.
    pub flange_from_child: ExportedPose,
    /// Of the optical frame, z forward.
    pub flange_from_color: ExportedPose,
    pub flange_from_color_nominal: Option<ExportedPose>,
}

/// A mount as a static transform.
pub(super) struct Mount {
    pub child_frame: String,
    pub flange_from_child: Isometry3,
    pub notes: Vec<String>,
}

/// A frame has one parent: where the optical frame hangs in the tree of the camera's driver already, the mount is that of
/// the frame at the root of this tree.
pub(super) fn mount(calibrated: &Rig, options: &ExportOptions) -> Mount {
    let flange_from_color = calibrated.flange_from_color;
    let as_optical =
        |frame: &str, notes| Mount { child_frame: frame.to_owned(), flange_from_child: flange_from_color, notes };
    match (&options.camera_frame, &options.frames) {
        (Some(frame), Some(frames)) if *frame == frames.optical_frame && !frames.links.is_empty() => {
            let parent = &frames.links[0].parent;
            let note = format!(
                "the camera's driver publishes \"{frame}\" below \"{parent}\" already, and a frame has one parent: without --camera-frame the transform of the driver's root frame is written"
            );
            as_optical(frame, vec![note])
        }
        (Some(frame), _) => as_optical(frame, vec![]),
        (None, None) => as_optical(USUAL_CAMERA_FRAME, vec![]),
        (None, Some(frames)) => {
            let (root, root_from_optical, parent) = frames.root(&options.flange_frame);
            let mut notes = Vec::new();
            if root != frames.optical_frame {
                notes.push(format!(
                    "the transform is that of \"{root}\", the root of the camera driver's tree, by the static transforms of the recording: \"{}\" has a parent already",
                    frames.optical_frame
                ));
            }
            if let Some(parent) = parent {
                notes.push(format!(
                    "the recording has a transform from \"{parent}\" to \"{root}\" already; take it out of the description or the launch file before you publish this one"
                ));
            }
            Mount { child_frame: root, flange_from_child: flange_from_color * root_from_optical.inverse(), notes }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera_frames::{CameraFrames, FrameLink};
    use skclam_rig::builtin_rig;

    #[test]
    fn a_mount_hangs_on_the_root_of_the_drivers_tree() {
        let rig = builtin_rig("ur5e").unwrap().unwrap();
        let turn = nalgebra::UnitQuaternion::from_euler_angles(-1.57, 0.0, -1.57);
        let pose = Isometry3::from_parts(nalgebra::Translation3::new(0.0, 0.015, 0.002), turn);
        let links = vec![FrameLink::new("optical", "camera_link", &pose)];
        let frames = CameraFrames { optical_frame: "optical".to_owned(), links };
        let mut options = ExportOptions { frames: Some(frames), ..ExportOptions::default() };
        let found = mount(&rig, &options);
        assert_eq!((found.child_frame.as_str(), found.notes.len()), ("camera_link", 1));
        let off = (found.flange_from_child * pose).inverse() * rig.flange_from_color;
        assert!(off.translation.vector.norm() < 1e-12 && off.rotation.angle() < 1e-9);
        options.camera_frame = Some("optical".to_owned());
        let found = mount(&rig, &options);
        assert!(found.child_frame == "optical" && found.notes[0].contains("has one parent"), "{:?}", found.notes);
    }
}
