//! From `CameraInfo` to a pinhole camera with OpenCV's five distortion coefficients.

use crate::{CameraInfo, RecordingError};
use skclam_geometry::{DISTORTION_COEFFICIENTS, PinholeCamera};

/// The largest image side that is accepted, pixels.
pub(crate) const MAX_SIDE: u32 = 32_768;

/// The camera of a `CameraInfo`, and a remark where something had to be assumed.
///
/// `rectified`: the image is one that was rectified (`image_rect`): its camera is in `P` and has no distortion.
/// ROS and OpenCV count pixels alike: (0, 0) is the centre of the top-left pixel.
///
/// # Errors
/// [`RecordingError::Message`] with the topic for a model that five coefficients cannot say, a size of 0 or beyond
/// 32768, numbers that are not finite, a focal length of 0 (an uncalibrated camera).
pub fn pinhole_from_info(
    topic: &str,
    info: &CameraInfo,
    rectified: bool,
) -> Result<(PinholeCamera, Option<String>), RecordingError> {
    let wrong = |problem: String| RecordingError::message(topic, problem);
    if !(1..=MAX_SIDE).contains(&info.width) || !(1..=MAX_SIDE).contains(&info.height) {
        return Err(wrong(format!(
            "the camera has {} x {} pixels; 1 to {MAX_SIDE} are possible",
            info.width, info.height
        )));
    }
    let [fx, fy, cx, cy] = match rectified {
        true => [info.projection[0], info.projection[5], info.projection[2], info.projection[6]],
        false => [info.matrix[0], info.matrix[4], info.matrix[2], info.matrix[5]],
    };
    if !(fx.is_finite() && fy.is_finite() && cx.is_finite() && cy.is_finite() && fx > 0.0 && fy > 0.0) {
        let matrix = if rectified { "P" } else { "K" };
        return Err(wrong(format!(
            "{matrix} has fx {fx}, fy {fy}, cx {cx}, cy {cy}; the camera is not calibrated: give the intrinsics in a rig"
        )));
    }
    if let Some(value) = info.distortion.iter().find(|value| !value.is_finite()) {
        return Err(wrong(format!("a distortion coefficient is {value}")));
    }
    let mut distortion = [0.0; DISTORTION_COEFFICIENTS];
    let mut remark = None;
    if !rectified && info.distortion.iter().any(|&value| value != 0.0) {
        let (first, more) = info.distortion.split_at(info.distortion.len().min(DISTORTION_COEFFICIENTS));
        let model = info.distortion_model.to_ascii_lowercase();
        match model.replace([' ', '_'], "").as_str() {
            "plumbbob" | "browncon" | "brownconrady" | "radtan" | "" => {}
            "rationalpolynomial" if more.iter().all(|&value| value == 0.0) => {}
            "inversebrownconrady" | "modifiedbrownconrady" => {
                remark = Some(format!(
                    "{topic}: the distortion model \"{}\" is taken as plumb_bob; let the coefficients be free, or give measured ones in a rig",
                    info.distortion_model
                ));
            }
            _ => {
                return Err(wrong(format!(
                    "the distortion model \"{}\" with {} coefficients is not k1 k2 p1 p2 k3; rectify the images (image_proc) and import the rectified topic, or give the intrinsics in a rig",
                    info.distortion_model,
                    info.distortion.len()
                )));
            }
        }
        if more.iter().any(|&value| value != 0.0) {
            return Err(wrong(format!("{} distortion coefficients; 5 are read", info.distortion.len())));
        }
        distortion[..first.len()].copy_from_slice(first);
    }
    Ok((PinholeCamera { width: info.width, height: info.height, fx, fy, cx, cy, distortion }, remark))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info(model: &str, distortion: &[f64]) -> CameraInfo {
        CameraInfo {
            frame_id: "camera".into(),
            width: 640,
            height: 480,
            distortion_model: model.into(),
            distortion: distortion.to_vec(),
            matrix: [600.0, 0.0, 320.0, 0.0, 601.0, 240.0, 0.0, 0.0, 1.0],
            projection: [500.0, 0.0, 310.0, 0.0, 0.0, 502.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        }
    }

    #[test]
    fn models_that_five_coefficients_can_say() {
        let (camera, remark) = pinhole_from_info("/c", &info("plumb_bob", &[0.1, 0.2, 0.3, 0.4]), false).unwrap();
        assert_eq!((camera.distortion, camera.fx, remark), ([0.1, 0.2, 0.3, 0.4, 0.0], 600.0, None));
        let rational = info("rational_polynomial", &[0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0]);
        assert_eq!(pinhole_from_info("/c", &rational, false).unwrap().0.distortion[4], 0.5);
        assert_eq!(pinhole_from_info("/c", &info("equidistant", &[0.0; 4]), false).unwrap().1, None);
        let (rectified, _) = pinhole_from_info("/c", &info("equidistant", &[0.1; 4]), true).unwrap();
        assert_eq!((rectified.fx, rectified.cy, rectified.distortion), (500.0, 230.0, [0.0; 5]));
        assert!(pinhole_from_info("/c", &info("Inverse Brown Conrady", &[0.1; 5]), false).unwrap().1.is_some());
    }

    #[test]
    fn other_models_are_refused_with_advice() {
        let message = |info: &CameraInfo| pinhole_from_info("/c", info, false).unwrap_err().to_string();
        assert!(message(&info("equidistant", &[0.1; 4])).contains("rectify"));
        assert!(message(&info("rational_polynomial", &[0.1; 8])).contains("8 coefficients"));
        let mut blind = info("plumb_bob", &[]);
        blind.matrix = [0.0; 9];
        assert!(message(&blind).contains("not calibrated"));
        blind.width = 0;
        assert!(message(&blind).contains("0 x 480"));
    }
}
