//! From `CameraInfo` to a pinhole camera with OpenCV's five distortion coefficients.

use crate::{CameraInfo, RecordingError};
use skclam_geometry::{DISTORTION_COEFFICIENTS, PinholeCamera};

/// The largest image side that is accepted, pixels.
pub(crate) const MAX_SIDE: u32 = 32_768;

/// The camera of a `CameraInfo`, and a remark where something had to be assumed.
///
/// `rectified`: the image is one that was rectified (`image_rect`): its camera is in `P` and has no distortion. Drivers
/// fill in half of the message: where the images have no distortion `K` and `P` are the same camera, and the one that is
/// there is taken. `image_size`: of the images, for a message that leaves its size at 0. What is not used may be anything.
/// ROS and OpenCV count pixels alike: (0, 0) is the centre of the top-left pixel.
///
/// # Errors
/// [`RecordingError::Message`] with the topic for a model that five coefficients cannot say, a size of 0 or beyond
/// 32768, numbers that are not finite, no focal length (an uncalibrated camera).
pub fn pinhole_from_info(
    topic: &str,
    info: &CameraInfo,
    rectified: bool,
    image_size: Option<(u32, u32)>,
) -> Result<(PinholeCamera, Option<String>), RecordingError> {
    let wrong = |problem: String| RecordingError::message(topic, problem);
    let mut remarks = Vec::new();
    let (width, height) = match (info.width, info.height, image_size) {
        (0, _, Some(size)) | (_, 0, Some(size)) => {
            remarks.push(format!("{topic}: CameraInfo leaves width or height at 0; the size of the images is taken"));
            size
        }
        (width, height, _) => (width, height),
    };
    if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
        return Err(wrong(format!("the camera has {width} x {height} pixels; 1 to {MAX_SIDE} are possible")));
    }
    let undistorted = info.distortion.iter().all(|&value| value == 0.0);
    let of_k = [info.matrix[0], info.matrix[4], info.matrix[2], info.matrix[5]];
    let of_p = [info.projection[0], info.projection[5], info.projection[2], info.projection[6]];
    let (wanted, other, name, other_name) = if rectified { (of_p, of_k, "P", "K") } else { (of_k, of_p, "K", "P") };
    let [fx, fy, cx, cy] = match (is_filled_in(wanted), is_filled_in(other), undistorted) {
        (true, _, _) => wanted,
        (false, true, true) => {
            remarks.push(format!(
                "{topic}: {name} of CameraInfo is not filled in; the images have no distortion, so {other_name} is taken"
            ));
            other
        }
        (false, other_there, _) => return Err(wrong(not_calibrated(wanted, name, other_there.then_some(other_name)))),
    };
    let mut distortion = [0.0; DISTORTION_COEFFICIENTS];
    if !rectified && !undistorted {
        let (coefficients, remark) = coefficients(topic, info)?;
        distortion = coefficients;
        remarks.extend(remark);
    }
    let remark = (!remarks.is_empty()).then(|| remarks.join("; "));
    Ok((PinholeCamera { width, height, fx, fy, cx, cy, distortion }, remark))
}

/// Whether four numbers are a camera: a driver that knows nothing leaves zeros, or a focal length without a centre.
fn is_filled_in([fx, fy, cx, cy]: [f64; 4]) -> bool {
    let finite = [fx, fy, cx, cy].iter().all(|value| value.is_finite());
    finite && fx > 0.0 && fy > 0.0 && (cx != 0.0 || cy != 0.0)
}

fn not_calibrated([fx, fy, cx, cy]: [f64; 4], name: &str, other: Option<&str>) -> String {
    let found = format!("{name} of CameraInfo has fx {fx}, fy {fy}, cx {cx}, cy {cy}");
    match other {
        Some(other) => format!(
            "{found}; {other} is filled in, but is another camera where D is not zero: give the intrinsics in a rig (--rig RIG --rig-cameras)"
        ),
        None => {
            format!("{found}; the camera is not calibrated: give the intrinsics in a rig (--rig RIG --rig-cameras)")
        }
    }
}

/// `D` as OpenCV's five coefficients, and a remark where something had to be assumed.
fn coefficients(
    topic: &str,
    info: &CameraInfo,
) -> Result<([f64; DISTORTION_COEFFICIENTS], Option<String>), RecordingError> {
    let wrong = |problem: String| Err(RecordingError::message(topic, problem));
    if let Some(value) = info.distortion.iter().find(|value| !value.is_finite()) {
        return wrong(format!(
            "a distortion coefficient (D) is {value}; give the intrinsics in a rig (--rig RIG --rig-cameras)"
        ));
    }
    let mut distortion = [0.0; DISTORTION_COEFFICIENTS];
    let (first, more) = info.distortion.split_at(info.distortion.len().min(DISTORTION_COEFFICIENTS));
    let model = info.distortion_model.to_ascii_lowercase();
    let mut remark = None;
    let five = more.iter().all(|&value| value == 0.0);
    match model.replace([' ', '_'], "").as_str() {
        "plumbbob" | "browncon" | "brownconrady" | "radtan" | "rationalpolynomial" | "" if five => {}
        "inversebrownconrady" | "modifiedbrownconrady" if five => {
            remark = Some(format!(
                "{topic}: the distortion model \"{}\" is taken as plumb_bob; let the coefficients be free, or give measured ones in a rig (--rig RIG --rig-cameras)",
                info.distortion_model
            ));
        }
        _ => {
            return wrong(format!(
                "the distortion model \"{}\" with {} coefficients is not k1 k2 p1 p2 k3; rectify the images (image_proc) and import the rectified topic, or give the intrinsics in a rig (--rig RIG --rig-cameras)",
                info.distortion_model,
                info.distortion.len()
            ));
        }
    }
    distortion[..first.len()].copy_from_slice(first);
    Ok((distortion, remark))
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
        let (camera, remark) = pinhole_from_info("/c", &info("plumb_bob", &[0.1, 0.2, 0.3, 0.4]), false, None).unwrap();
        assert_eq!((camera.distortion, camera.fx, remark), ([0.1, 0.2, 0.3, 0.4, 0.0], 600.0, None));
        let rational = info("rational_polynomial", &[0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0]);
        assert_eq!(pinhole_from_info("/c", &rational, false, None).unwrap().0.distortion[4], 0.5);
        assert_eq!(pinhole_from_info("/c", &info("equidistant", &[0.0; 4]), false, None).unwrap().1, None);
        let (rectified, _) = pinhole_from_info("/c", &info("equidistant", &[0.1; 4]), true, None).unwrap();
        assert_eq!((rectified.fx, rectified.cy, rectified.distortion), (500.0, 230.0, [0.0; 5]));
        assert!(pinhole_from_info("/c", &info("Inverse Brown Conrady", &[0.1; 5]), false, None).unwrap().1.is_some());
    }

    #[test]
    fn other_models_are_refused_with_advice() {
        let message = |info: &CameraInfo| pinhole_from_info("/c", info, false, None).unwrap_err().to_string();
        assert!(message(&info("equidistant", &[0.1; 4])).contains("rectify"));
        assert!(message(&info("rational_polynomial", &[0.1; 8])).contains("8 coefficients"));
        let mut blind = info("plumb_bob", &[]);
        (blind.matrix, blind.projection) = ([0.0; 9], [0.0; 12]);
        assert!(message(&blind).contains("not calibrated") && message(&blind).contains("--rig RIG --rig-cameras"));
        blind.width = 0;
        assert!(message(&blind).contains("0 x 480"));
        // P is another camera where the image has distortion.
        let mut half = info("plumb_bob", &[0.1; 5]);
        half.matrix = [0.0; 9];
        assert!(message(&half).contains("P is filled in, but is another camera"));
    }

    #[test]
    fn half_filled_messages_are_read_as_far_as_they_are_right() {
        let taken = |info: &CameraInfo, rectified| pinhole_from_info("/c", info, rectified, Some((64, 48))).unwrap();
        let mut half = info("", &[0.0; 5]);
        half.projection = [0.0; 12];
        assert_eq!((taken(&half, true).0.fx, taken(&half, true).1.is_some()), (600.0, true));
        half.projection = [f64::NAN; 12];
        assert_eq!((taken(&half, false).0.fx, taken(&half, false).1), (600.0, None));
        let mut half = info("plumb_bob", &[]);
        half.matrix = [0.0; 9];
        assert_eq!(taken(&half, false).0.fx, 500.0);
        half.matrix = [600.0, 0.0, 0.0, 0.0, 600.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(taken(&half, false).0.cx, 310.0, "a focal length without a centre is no camera");
        half.width = 0;
        assert_eq!((taken(&half, false).0.width, taken(&half, false).0.height), (64, 48));
        // What a rectified image does not use may be anything.
        let odd = info("equidistant", &[f64::NAN; 4]);
        assert_eq!(taken(&odd, true).0.fx, 500.0);
    }
}
