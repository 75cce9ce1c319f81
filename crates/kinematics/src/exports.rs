//! Calibrated numbers in the forms that controllers and ROS take: joint poses as a `kinematics.yaml`, a DH table of
//! corrections, a static transform.

use crate::urdf::{UNCHANGED, roll_pitch_yaw, rounded};
use crate::{Isometry3, KinematicsError, ParameterKind, SerialChain};
use nalgebra::Vector3;

/// What Universal Robots' ROS driver calls the links after each joint.
const UR_LINKS: [&str; 6] = ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"];

/// The chain as a `kinematics.yaml` in the layout of Universal Robots' ROS driver (`kinematics_parameters_file`): for
/// each of six revolute joints the pose of its frame (z along the axis) in the frame of the joint before; metres,
/// radians.
///
/// That layout has no place for what follows the last axis (`a_6` and `alpha_6` of a classic DH table, a fixed
/// transform to the flange). Where it is not the identity, a comment at the head of the file gives it, to be added to
/// the tool. `hash`: goes to the `hash` entry, with which the driver distinguishes one arm's calibration from
/// another's.
///
/// # Errors
/// [`KinematicsError::Export`] if the chain is not six revolute joints or `hash` is not a plain word.
pub fn kinematics_yaml(chain: &SerialChain, hash: &str) -> Result<String, KinematicsError> {
    let revolute = chain.joints().iter().all(|joint| joint.kind == crate::JointKind::Revolute);
    if chain.joint_count() != UR_LINKS.len() || !revolute {
        let count = chain.joint_count();
        let problem = format!("kinematics.yaml describes six revolute joints; the chain has {count} joints");
        return Err(KinematicsError::Export {
            problem: format!("{problem}{}", if revolute { "" } else { ", not all revolute" }),
        });
    }
    if hash.is_empty() || !hash.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c)) {
        let problem = format!("the hash of a kinematics.yaml is letters, digits, '_', '-' and '.', not {hash:?}");
        return Err(KinematicsError::Export { problem });
    }
    let frames = chain.base_from_joint_frames(&[0.0; 6])?;
    let rest = frames[5].inverse() * chain.base_from_flange(&[0.0; 6])?;
    let mut text = String::new();
    if rest.translation.vector.norm() > UNCHANGED || rest.rotation.imag().norm() > UNCHANGED {
        let (xyz, rpy) = xyz_rpy(&rest);
        text += &format!(
            "# wrist_3 to flange, which this file has no place for; put it before the tool:\n\
             #   x {} y {} z {} roll {} pitch {} yaw {}\n",
            xyz.x, xyz.y, xyz.z, rpy.x, rpy.y, rpy.z
        );
    }
    text += "kinematics:\n";
    let mut before = Isometry3::identity();
    for (link, frame) in UR_LINKS.iter().zip(&frames) {
        let (xyz, rpy) = xyz_rpy(&(before.inverse() * frame));
        text += &format!("  {link}:\n");
        let entries = [("x", xyz.x), ("y", xyz.y), ("z", xyz.z), ("roll", rpy.x), ("pitch", rpy.y), ("yaw", rpy.z)];
        text.extend(entries.map(|(key, value)| format!("    {key}: {value}\n")));
        before = *frame;
    }
    Ok(text + &format!("  hash: {hash}\n"))
}

fn xyz_rpy(pose: &Isometry3) -> (Vector3<f64>, Vector3<f64>) {
    (pose.translation.vector.map(rounded), roll_pitch_yaw(&pose.rotation).map(rounded))
}

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
    use crate::arms::{hp3j, perturbed, seven_joints, ur5e};
    use crate::{ParameterId, chain_from_urdf};

    /// The poses of a `kinematics.yaml` as a URDF with z axes, which is what the driver makes of it.
    fn urdf_of(yaml: &str) -> String {
        let mut text = String::from("<robot name=\"r\"><link name=\"l0\"/>");
        let numbers = |block: &str| -> Vec<f64> {
            block.lines().skip(1).take(6).map(|line| line.split(": ").nth(1).unwrap().parse().unwrap()).collect()
        };
        for (index, link) in UR_LINKS.iter().enumerate() {
            let v = numbers(&yaml[yaml.find(&format!("  {link}:\n")).unwrap()..]);
            text += &format!(
                "<link name=\"l{next}\"/><joint name=\"{link}\" type=\"continuous\"><parent link=\"l{index}\"/><child link=\"l{next}\"/>\
                 <axis xyz=\"0 0 1\"/><origin xyz=\"{} {} {}\" rpy=\"{} {} {}\"/></joint>",
                v[0],
                v[1],
                v[2],
                v[3],
                v[4],
                v[5],
                next = index + 1
            );
        }
        text + "</robot>"
    }

    #[test]
    fn the_nominal_ur5e_gives_the_makers_file() {
        let yaml = kinematics_yaml(&ur5e(), "calib_0").unwrap();
        let wanted = "kinematics:\n  shoulder:\n    x: 0\n    y: 0\n    z: 0.1625\n    roll: 0\n    pitch: 0\n    yaw: 0\n  \
            upper_arm:\n    x: 0\n    y: 0\n    z: 0\n    roll: 1.5707963267949\n    pitch: 0\n    yaw: 0\n  \
            forearm:\n    x: -0.425\n    y: 0\n    z: 0\n    roll: 0\n    pitch: 0\n    yaw: 0\n  \
            wrist_1:\n    x: -0.3922\n    y: 0\n    z: 0.1333\n    roll: 0\n    pitch: 0\n    yaw: 0\n  \
            wrist_2:\n    x: 0\n    y: -0.0997\n    z: 0\n    roll: 1.5707963267949\n    pitch: 0\n    yaw: 0\n  \
            wrist_3:\n    x: 0\n    y: 0.0996\n    z: 0\n    roll: -1.5707963267949\n    pitch: 0\n    yaw: 0\n  hash: calib_0\n";
        assert_eq!(yaml, wanted);
    }

    #[test]
    fn a_calibrated_file_has_the_chains_forward_kinematics() {
        let draws: Vec<f64> = (0..24).map(|i| f64::from(i % 7) / 3.0 - 1.0).collect();
        for nominal in [ur5e(), hp3j()] {
            let chain = perturbed(&nominal, 0.02, 0.002, &draws);
            let yaml = kinematics_yaml(&chain, "calib_1").unwrap();
            let driver = chain_from_urdf(&urdf_of(&yaml), "l0", "l6").unwrap();
            let values = [0.3, -1.0, 0.8, 0.5, 1.2, -2.0];
            let wrist_3 = chain.base_from_joint_frames(&values).unwrap()[5];
            let off = driver.base_from_flange(&values).unwrap().to_homogeneous() - wrist_3.to_homogeneous();
            assert!(off.norm() < 1e-12, "{off}");
            // Classic DH goes on after the last axis, and says so.
            assert_eq!(yaml.starts_with("# wrist_3 to flange"), nominal == ur5e());
        }
    }

    #[test]
    fn what_cannot_be_exported_is_refused() {
        let seven = kinematics_yaml(&seven_joints(), "x").unwrap_err().to_string();
        assert!(seven.contains("six revolute joints; the chain has 7 joints"), "{seven}");
        assert!(kinematics_yaml(&ur5e(), "a: b").is_err());
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
