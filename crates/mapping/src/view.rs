//! One posed depth image, and whether it makes sense.

use crate::Error;
use image::{GrayImage, RgbImage};
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera};

/// A camera farther than this from the base is taken for a mistake in the pose: single precision, in which maps are
/// kept, is coarser than a millimetre there.
const FARTHEST_POSE_M: f64 = 1e4;

/// A depth image, perhaps with the colour image of the same moment, and the pose of the colour camera.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// z-depth, metres; 0 = no value.
    pub depth: &'a DepthImage,
    /// The colour image of the same moment.
    pub color: Option<&'a RgbImage>,
    /// Intrinsics of the depth image and `color_from_depth`.
    pub depth_camera: &'a DepthCamera,
    /// Intrinsics of the colour image.
    pub color_camera: &'a PinholeCamera,
    /// The pose of the colour camera.
    pub base_from_color: Isometry3,
    /// Depth pixels that are 0 in this image (of the depth image's size) are ignored: what moves with the camera.
    pub depth_mask: Option<&'a GrayImage>,
    /// Points seen at pixels that are 0 in this image (of the colour image's size) are ignored.
    pub color_mask: Option<&'a GrayImage>,
}

impl View<'_> {
    /// Checks image sizes, cameras and the pose.
    pub fn check(&self) -> Result<(), Error> {
        let depth_camera = &self.depth_camera.camera;
        same_size("depth image", (self.depth.width(), self.depth.height()), depth_camera)?;
        if let Some(color) = self.color {
            same_size("colour image", color.dimensions(), self.color_camera)?;
        }
        if let Some(mask) = self.depth_mask {
            same_size("depth mask", mask.dimensions(), depth_camera)?;
        }
        if let Some(mask) = self.color_mask {
            same_size("colour mask", mask.dimensions(), self.color_camera)?;
        }
        check_camera("the depth camera", depth_camera)?;
        check_camera("the colour camera", self.color_camera)?;
        check_isometry("color_from_depth", &self.depth_camera.color_from_depth)?;
        check_isometry("base_from_color", &self.base_from_color)
    }

    /// The pose of the depth camera.
    pub fn base_from_depth(&self) -> Isometry3 {
        self.base_from_color * self.depth_camera.color_from_depth
    }
}

fn same_size(what: &'static str, got: (u32, u32), camera: &PinholeCamera) -> Result<(), Error> {
    if got == (camera.width, camera.height) {
        return Ok(());
    }
    Err(Error::ImageSize {
        what,
        got_width: got.0,
        got_height: got.1,
        need_width: camera.width,
        need_height: camera.height,
    })
}

fn check_camera(what: &'static str, camera: &PinholeCamera) -> Result<(), Error> {
    if let Some(bad) = camera.intrinsics().iter().find(|value| !value.is_finite()) {
        return Err(Error::BadNumber { what, value: bad.to_string(), need: "a finite number" });
    }
    match [camera.fx, camera.fy].into_iter().find(|&focal| focal <= 0.0) {
        Some(bad) => Err(Error::BadNumber { what, value: bad.to_string(), need: "a positive focal length" }),
        None => Ok(()),
    }
}

pub(crate) fn check_isometry(what: &'static str, pose: &Isometry3) -> Result<(), Error> {
    let numbers = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
    if let Some(bad) = numbers.clone().find(|value| !value.is_finite()) {
        return Err(Error::BadNumber { what, value: bad.to_string(), need: "a finite number" });
    }
    let norm = pose.rotation.coords.norm();
    if (norm - 1.0).abs() > 1e-6 {
        return Err(Error::BadNumber {
            what,
            value: format!("a quaternion of norm {norm}"),
            need: "a unit quaternion",
        });
    }
    let distance_m = pose.translation.vector.norm();
    if distance_m > FARTHEST_POSE_M {
        return Err(Error::PoseFarAway { distance_m, limit_m: FARTHEST_POSE_M });
    }
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A depth camera that is the colour camera.
    pub(crate) fn plain_camera(width: u32, height: u32) -> DepthCamera {
        DepthCamera {
            camera: PinholeCamera::from_hfov(width, height, 1.0),
            unit_m: 0.001,
            offset_m: 0.0,
            color_from_depth: Isometry3::identity(),
        }
    }

    pub(crate) fn view<'a>(depth: &'a DepthImage, camera: &'a DepthCamera) -> View<'a> {
        View {
            depth,
            color: None,
            depth_camera: camera,
            color_camera: &camera.camera,
            base_from_color: Isometry3::identity(),
            depth_mask: None,
            color_mask: None,
        }
    }

    #[test]
    fn bad_views_are_refused_with_the_reason() {
        let camera = plain_camera(4, 2);
        let depth = DepthImage::new(4, 2, vec![1.0; 8]).unwrap();
        assert!(view(&depth, &camera).check().is_ok());
        let mut far = view(&depth, &camera);
        far.base_from_color.translation.x = 1e7;
        assert!(matches!(far.check(), Err(Error::PoseFarAway { .. })));
        far.base_from_color.translation.x = f64::NAN;
        assert!(matches!(far.check(), Err(Error::BadNumber { what: "base_from_color", .. })));
        let small = DepthImage::new(2, 2, vec![1.0; 4]).unwrap();
        assert!(matches!(view(&small, &camera).check(), Err(Error::ImageSize { what: "depth image", .. })));
        let color = RgbImage::new(3, 2);
        let with_color = View { color: Some(&color), ..view(&depth, &camera) };
        assert!(matches!(with_color.check(), Err(Error::ImageSize { what: "colour image", .. })));
        let mut blind = camera;
        blind.camera.fx = 0.0;
        assert!(matches!(view(&depth, &blind).check(), Err(Error::BadNumber { .. })));
    }
}
