//! `camera_frames.json` of a dataset: how the camera's driver names its frames, and how they hang on each other. A frame
//! has one parent, so that a mount is published for the frame at the root of the driver's tree.

use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use std::path::{Path, PathBuf};

/// Its name in the folder of the dataset.
pub const CAMERA_FRAMES: &str = "camera_frames.json";

/// A frame in its parent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameLink {
    /// The frame.
    pub frame: String,
    /// Its parent.
    pub parent: String,
    /// `parent_from_frame`.
    pub translation_mm: [f64; 3],
    /// `parent_from_frame`.
    pub quaternion_xyzw: [f64; 4],
}

/// The frames of the colour camera's driver.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraFrames {
    /// The frame of the colour images, z forward.
    pub optical_frame: String,
    /// From the optical frame upwards, as recorded on `/tf_static`.
    pub links: Vec<FrameLink>,
}

/// Why a file of frames could not be read.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct CameraFramesError {
    path: PathBuf,
    problem: String,
}

impl FrameLink {
    /// A frame in its parent.
    pub fn new(frame: &str, parent: &str, parent_from_frame: &Isometry3) -> Self {
        let (t, q) = (parent_from_frame.translation.vector * 1e3, parent_from_frame.rotation.coords);
        FrameLink {
            frame: frame.to_owned(),
            parent: parent.to_owned(),
            translation_mm: [t.x, t.y, t.z],
            quaternion_xyzw: [q.x, q.y, q.z, q.w],
        }
    }

    fn parent_from_frame(&self) -> Isometry3 {
        let [x, y, z] = self.translation_mm.map(|value| value * 1e-3);
        let [i, j, k, w] = self.quaternion_xyzw;
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_quaternion(Quaternion::new(w, i, j, k)))
    }
}

impl CameraFrames {
    /// As the text of the file.
    pub fn to_json(&self) -> String {
        // Strings and numbers: nothing here cannot be written.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }

    /// Reads the file of a dataset; `None` where it has none.
    ///
    /// # Errors
    /// A file that is not well formed, or numbers that are no rigid transform.
    pub fn read(dataset: &Path) -> Result<Option<Self>, CameraFramesError> {
        let path = dataset.join(CAMERA_FRAMES);
        let wrong = |problem: String| CameraFramesError { path: path.clone(), problem };
        let text = match skclam_files::read_text(&path, skclam_files::Kind::Configuration) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(wrong(error.to_string())),
        };
        let frames: CameraFrames = serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))?;
        for link in &frames.links {
            let norm = link.quaternion_xyzw.iter().map(|value| value * value).sum::<f64>().sqrt();
            if !link.translation_mm.iter().all(|value| value.is_finite()) || (norm - 1.0).abs() > 1e-3 {
                return Err(wrong(format!("links: the transform of \"{}\" is no rigid one", link.frame)));
            }
        }
        Ok(Some(frames))
    }

    /// The frame at the root of the driver's tree below `flange_frame`, `root_from_optical`, and the parent that the
    /// recording gives it already.
    pub fn root(&self, flange_frame: &str) -> (String, Isometry3, Option<String>) {
        let mut root = (self.optical_frame.clone(), Isometry3::identity());
        for link in &self.links {
            if link.parent == flange_frame || is_of_robot(&link.parent) {
                return (root.0, root.1, Some(link.parent.clone()));
            }
            root = (link.parent.clone(), link.parent_from_frame() * root.1);
        }
        (root.0, root.1, None)
    }
}

/// Whether a frame's name is one that robots give to what a camera is mounted on.
fn is_of_robot(frame: &str) -> bool {
    const NAMES: [&str; 6] = ["tool0", "flange", "ee_link", "hand", "wrist_3_link", "tool_link"];
    NAMES.iter().any(|name| frame.rsplit('/').next().is_some_and(|last| last.ends_with(name)))
        || frame.contains("link_6")
        || frame.contains("link6")
        || frame.contains("link8")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_root_is_below_the_flange() {
        let shift = |x| Isometry3::translation(x, 0.0, 0.0);
        let link = |frame, parent, x| FrameLink::new(frame, parent, &shift(x));
        let mut frames = CameraFrames {
            optical_frame: "optical".to_owned(),
            links: vec![link("optical", "color", 0.001), link("color", "camera_link", 0.02)],
        };
        let (root, root_from_optical, parent) = frames.root("tool0");
        assert_eq!((root.as_str(), parent), ("camera_link", None));
        assert!((root_from_optical.translation.x - 0.021).abs() < 1e-12);
        for flange in ["my_flange", "tool0"] {
            frames.links.push(link("camera_link", flange, 0.5));
            let (root, root_from_optical, parent) = frames.root("my_flange");
            assert_eq!((root.as_str(), parent.as_deref()), ("camera_link", Some(flange)));
            assert!((root_from_optical.translation.x - 0.021).abs() < 1e-12);
            frames.links.pop();
        }
    }
}
