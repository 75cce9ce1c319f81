//! Calibrated numbers in the forms that controllers and ROS take: a DH table of corrections, a static transform.

use crate::urdf::rounded;
use crate::{Isometry3, KinematicsError, ParameterKind, SerialChain};

/// The shell command that publishes a transform in ROS 2: `parent_from_child`, metres.
///
/// For a mount: `flange_from_color` with the flange's and the camera's optical frame.
///
/// # Errors
/// [`KinematicsError::Export`] if a frame name is not one of tf2's (letters, digits, `_`, `-`, `.`, `/`).
pub fn static_transform_line(
    parent_from_child: &Isometry3,
    parent_frame: &str,
    child_frame: &str,
) -> Result<String, KinematicsError> {
    for name in [parent_frame, child_frame] {
        // A name goes into a shell command.
        if name.is_empty()
            || name.starts_with('-')
            || !name.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c))
        {
            let problem = format!("the frame name {name:?} is not letters, digits, '_', '-', '.' and '/'");
            return Err(KinematicsError::Export { problem });
        }
    }
    let t = parent_from_child.translation.vector.map(rounded);
    let q = parent_from_child.rotation.coords.map(rounded);
    Ok(format!(
        "ros2 run tf2_ros static_transform_publisher --x {} --y {} --z {} --qx {} --qy {} --qz {} --qw {} \
         --frame-id {parent_frame} --child-frame-id {child_frame}",
        t.x, t.y, t.z, q.x, q.y, q.z, q.w
    ))
}

/// The parameters before and after as CSV, one line a parameter, for controllers that take a table of corrections:
/// `joint,name,parameter,unit,nominal,calibrated,correction`, lengths in mm, angles in degrees.
///
/// # Errors
/// [`KinematicsError::Export`] if the chains differ in their joints or link forms.
pub fn corrections_csv(nominal: &SerialChain, calibrated: &SerialChain) -> Result<String, KinematicsError> {
    if nominal.parameter_ids() != calibrated.parameter_ids() {
        let problem = "the nominal and the calibrated chain differ in their joints or link forms".to_owned();
        return Err(KinematicsError::Export { problem });
    }
    let mut text = String::from("joint,name,parameter,unit,nominal,calibrated,correction\n");
    for (index, (before, after)) in nominal.joints().iter().zip(calibrated.joints()).enumerate() {
        // A name with a comma or a quote is quoted as CSV wants it.
        let name = skclam_files::csv_cell(&before.name);
        let name = match name.contains([',', '"']) {
            true => format!("\"{}\"", name.replace('"', "\"\"")),
            false => name.into_owned(),
        };
        for kind in before.link.parameters() {
            let (parameter, unit, scale) = match kind {
                ParameterKind::Alpha => ("alpha", "deg", 1f64.to_degrees()),
                ParameterKind::Beta => ("beta", "deg", 1f64.to_degrees()),
                ParameterKind::ThetaOffset => ("theta_offset", "deg", 1f64.to_degrees()),
                ParameterKind::A => ("a", "mm", 1e3),
                ParameterKind::D => ("d", "mm", 1e3),
            };
            let [old, new] = [before, after].map(|joint| scale * joint.link.get(kind).unwrap_or_default());
            // Ten decimals are 1e-10 mm or deg; the difference is that of the numbers as shown.
            text += &format!("{},{name},{parameter},{unit},{old:.10},{new:.10},{:.10}\n", index + 1, new - old);
        }
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ParameterId;
    use crate::arms::{hp3j, ur5e};

    #[test]
    fn what_cannot_be_exported_is_refused() {
        for name in ["", "a b", "$(reboot)", "-x", "a\nb"] {
            assert!(static_transform_line(&Isometry3::identity(), name, "camera").is_err(), "{name:?}");
            assert!(static_transform_line(&Isometry3::identity(), "flange", name).is_err(), "{name:?}");
        }
        assert!(corrections_csv(&ur5e(), &hp3j()).unwrap_err().to_string().contains("link forms"));
    }

    #[test]
    fn a_mount_as_a_static_transform() {
        let quarter = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, -std::f64::consts::FRAC_PI_2);
        let mount = Isometry3::from_parts(nalgebra::Translation3::new(-0.06, 0.0, 0.04), quarter);
        assert_eq!(
            static_transform_line(&mount, "tool0", "camera_color_optical_frame").unwrap(),
            "ros2 run tf2_ros static_transform_publisher --x -0.06 --y 0 --z 0.04 --qx 0 --qy 0 --qz -0.70710678118655 \
             --qw 0.70710678118655 --frame-id tool0 --child-frame-id camera_color_optical_frame"
        );
    }

    #[test]
    fn corrections_in_the_units_of_controllers() {
        let mut calibrated = hp3j();
        let id = |joint, kind| ParameterId { joint, kind };
        calibrated.set_parameter(id(1, ParameterKind::Alpha), 91f64.to_radians()).unwrap();
        calibrated.set_parameter(id(3, ParameterKind::D), 0.2705).unwrap();
        let csv = corrections_csv(&hp3j(), &calibrated).unwrap();
        assert_eq!(csv.lines().count(), 1 + 24);
        assert!(csv.contains("2,L,alpha,deg,90.0000000000,91.0000000000,1.0000000000\n"), "{csv}");
        assert!(csv.contains("4,R,d,mm,270.0000000000,270.5000000000,0.5000000000\n"), "{csv}");
        assert!(csv.contains("3,U,beta,deg,0.0000000000,0.0000000000,0.0000000000\n"), "{csv}");
    }
}
