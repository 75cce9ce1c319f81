//! `kinematics.yaml` of Universal Robots' ROS driver (`kinematics_parameters_file`): the origins of the six joints of
//! the maker's robot description, in the maker's own frames, on which its meshes and collision bodies hang.
//!
//! A chain alone does not have these frames: a frame may slide and turn on its joint's axis without any change of where
//! the flange is. So the calibrated chain is first written into the description by its joint origins
//! ([`write_urdf`](super::write_urdf)), which leaves each link where it is on its axes, and the origins are read from there.

use super::document::Document;
use super::write::{UNCHANGED, roll_pitch_yaw, rounded, write_urdf};
use crate::{Isometry3, KinematicsError, SerialChain};
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::fmt::Write;

/// What the file calls the links after each joint.
const LINKS: [&str; 6] = ["shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"];
/// The link that carries the first joint.
const BASE: &str = "base_link_inertia";

/// The maker's published arms: d1, a2, a3, d4, d5, d6 of the classic DH table, metres.
const ARMS: [(&str, [f64; 6]); 4] = [
    ("UR3e", [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921]),
    ("UR5e", [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996]),
    ("UR10e", [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655]),
    ("UR16e", [0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655]),
];

fn refused(problem: impl Into<String>) -> KinematicsError {
    KinematicsError::Export { problem: problem.into() }
}

/// The file for a calibrated arm whose description `urdf` is one of `ur_description`: from its link `base_link` to
/// `tip_link` the chain was `nominal` and is `calibrated`.
///
/// The file ends at the link wrist_3. Where the calibrated flange is placed otherwise on it than in the description, a
/// comment at the head of the file gives the new transform. `hash`: with which the driver distinguishes arms.
///
/// # Errors
/// [`KinematicsError::Export`] with the reason if the description is not of these arms, does not begin at the maker's
/// base, or `hash` is not a plain word; as [`write_urdf`](super::write_urdf).
pub fn kinematics_yaml(
    urdf: &str,
    base_link: &str,
    tip_link: &str,
    nominal: &SerialChain,
    calibrated: &SerialChain,
    hash: &str,
) -> Result<String, KinematicsError> {
    check_hash(hash)?;
    check_description(urdf, base_link, tip_link)?;
    let written = write_urdf(urdf, base_link, tip_link, nominal, calibrated)?;
    let (before, after) = (Document::parse(urdf)?, Document::parse(&written)?);
    let (before, after) = (before.path(base_link, tip_link)?, after.path(base_link, tip_link)?);
    let last = after.iter().rposition(|joint| joint.motion.is_some()).unwrap_or(0);
    let rest = |path: &[super::document::UrdfJoint<'_>]| {
        path[last + 1..].iter().fold(Isometry3::identity(), |pose, joint| pose * joint.origin)
    };
    let (rest_before, rest_after) = (rest(&before), rest(&after));
    let mut text = String::new();
    let moved = rest_before.inverse() * rest_after;
    if moved.translation.vector.norm() > UNCHANGED || moved.rotation.imag().norm() > UNCHANGED {
        let (xyz, rpy) =
            (rest_after.translation.vector.map(rounded), roll_pitch_yaw(&rest_after.rotation).map(rounded));
        text += &format!(
            "# wrist_3_link to {tip_link}, which this file has no place for; put it into the description or before the tool:\n\
             #   x {} y {} z {} roll {} pitch {} yaw {}\n",
            xyz.x, xyz.y, xyz.z, rpy.x, rpy.y, rpy.z
        );
    }
    text += "kinematics:\n";
    let nominal_angles = before.iter().filter(|joint| joint.motion.is_some()).map(|joint| joint.angles);
    let movable = after.iter().filter(|joint| joint.motion.is_some());
    for ((link, joint), nominal_angles) in LINKS.iter().zip(movable).zip(nominal_angles) {
        let (xyz, rpy) = (joint.origin.translation.vector.map(rounded), nearest(&joint.angles, &nominal_angles));
        let entries = [("x", xyz.x), ("y", xyz.y), ("z", xyz.z), ("roll", rpy.x), ("pitch", rpy.y), ("yaw", rpy.z)];
        // Writing to a string cannot fail.
        let _ = writeln!(text, "  {link}:");
        text.extend(entries.map(|(key, value)| format!("    {key}: {value}\n")));
    }
    Ok(text + &format!("  hash: {hash}\n"))
}

/// The same for an arm that is known by a DH table alone: the description is the maker's published one, if the nominal
/// chain is that of a UR3e, UR5e, UR10e or UR16e from the maker's base (or `base_link`) to the flange.
///
/// # Errors
/// [`KinematicsError::Export`] with the reason for any other arm; then the arm's own URDF is needed.
pub fn kinematics_yaml_of_table(
    nominal: &SerialChain,
    calibrated: &SerialChain,
    hash: &str,
) -> Result<String, KinematicsError> {
    check_hash(hash)?;
    for (_, lengths) in ARMS {
        let urdf = published(lengths);
        for base_link in [BASE, "base_link"] {
            for tip_link in ["tool0", "flange"] {
                let described = super::chain_from_urdf(&urdf, base_link, tip_link)?;
                if is_same_arm(nominal, &described)? {
                    return kinematics_yaml(&urdf, base_link, tip_link, nominal, calibrated, hash);
                }
            }
        }
    }
    let names = ARMS.map(|(name, _)| name).join(", ");
    Err(refused(format!(
        "the file is for Universal Robots' arms in the maker's frames, and the nominal arm is not the published {names} from the maker's base to tool0; \
         for another UR arm, or one with its factory calibration, give its description with --urdf"
    )))
}

fn check_hash(hash: &str) -> Result<(), KinematicsError> {
    if hash.is_empty() || !hash.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c)) {
        return Err(refused(format!(
            "the hash of a kinematics.yaml is letters, digits, '_', '-' and '.', not {hash:?}"
        )));
    }
    Ok(())
}

/// Whether a description has the links of `ur_description`, with any prefix.
fn check_description(urdf: &str, base_link: &str, tip_link: &str) -> Result<(), KinematicsError> {
    let document = Document::parse(urdf)?;
    let path = document.path(base_link, tip_link)?;
    let movable: Vec<_> = path.iter().filter(|joint| joint.motion.is_some()).collect();
    let not_ur = |problem: String| refused(format!("the file is for Universal Robots' arms: {problem}"));
    if movable.len() != LINKS.len() {
        return Err(not_ur(format!("this one has {} joints", movable.len())));
    }
    for (joint, link) in movable.iter().zip(LINKS) {
        let wanted = format!("{link}_link");
        if !joint.child.ends_with(&wanted) {
            return Err(not_ur(format!("joint '{}' carries the link '{}', and not {wanted}", joint.name, joint.child)));
        }
        let along_z = joint
            .motion
            .as_ref()
            .is_some_and(|motion| motion.kind == crate::JointKind::Revolute && motion.axis.z > 1.0 - 1e-9);
        if !along_z {
            return Err(not_ur(format!("joint '{}' does not turn about z", joint.name)));
        }
    }
    let first = movable[0];
    if !first.parent.ends_with(BASE) {
        return Err(refused(format!(
            "the driver hangs the first joint on {BASE}, which is turned by 180 deg on base_link; in this URDF joint '{}' hangs on '{}', so that the file would turn the arm. Use the URDF of ur_description",
            first.name, first.parent
        )));
    }
    if let Some(joint) = movable.windows(2).find(|pair| pair[0].child != pair[1].parent) {
        return Err(not_ur(format!("between '{}' and '{}' there is another link", joint[0].child, joint[1].parent)));
    }
    Ok(())
}

/// Whether two chains put all axes and the flange into the same places.
fn is_same_arm(a: &SerialChain, b: &SerialChain) -> Result<bool, KinematicsError> {
    const SAME: f64 = 1e-6;
    if a.joint_count() != b.joint_count() {
        return Ok(false);
    }
    for values in [[0.0; 6], [0.4, -1.1, 0.9, 0.3, 1.3, -0.7]] {
        let off = a.base_from_flange(&values)?.inverse() * b.base_from_flange(&values)?;
        if off.translation.vector.norm() > SAME || off.rotation.angle() > SAME {
            return Ok(false);
        }
    }
    Ok(true)
}

/// The links and joints of `ur_description` for a published arm.
fn published([d1, a2, a3, d4, d5, d6]: [f64; 6]) -> String {
    let origins = [
        ([0.0, 0.0, d1], [0.0; 3]),
        ([0.0; 3], [FRAC_PI_2, 0.0, 0.0]),
        ([a2, 0.0, 0.0], [0.0; 3]),
        ([a3, 0.0, d4], [0.0; 3]),
        ([0.0, -d5, 0.0], [FRAC_PI_2, 0.0, 0.0]),
        ([0.0, d6, 0.0], [FRAC_PI_2, PI, PI]),
    ];
    let mut text = String::from("<robot name=\"ur\"><link name=\"base_link\"/>");
    let mut parent = "base_link".to_owned();
    let mut joint = |child: &str, kind: &str, [x, y, z]: [f64; 3], [roll, pitch, yaw]: [f64; 3]| {
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "<link name=\"{child}\"/><joint name=\"to_{child}\" type=\"{kind}\"><parent link=\"{parent}\"/><child link=\"{child}\"/>\
             <axis xyz=\"0 0 1\"/><origin xyz=\"{x} {y} {z}\" rpy=\"{roll} {pitch} {yaw}\"/></joint>"
        );
        child.clone_into(&mut parent);
    };
    joint(BASE, "fixed", [0.0; 3], [0.0, 0.0, PI]);
    for (link, (xyz, rpy)) in LINKS.iter().zip(origins) {
        joint(&format!("{link}_link"), "continuous", xyz, rpy);
    }
    joint("flange", "fixed", [0.0; 3], [0.0, -FRAC_PI_2, -FRAC_PI_2]);
    joint("tool0", "fixed", [0.0; 3], [FRAC_PI_2, 0.0, FRAC_PI_2]);
    text + "</robot>"
}

/// Of the roll, pitch and yaw that are the same rotation, those next to the maker's.
fn nearest(angles: &Vector3<f64>, wanted: &Vector3<f64>) -> Vector3<f64> {
    let turned =
        |angles: Vector3<f64>| angles.zip_map(wanted, |angle, wanted| angle + TAU * ((wanted - angle) / TAU).round());
    let same = [turned(*angles), turned(Vector3::new(angles.x + PI, PI - angles.y, angles.z + PI))];
    let [a, b] = same;
    // The text unchanged, where it is the nearest already.
    let chosen = if (b - wanted).norm() + 1e-9 < (a - wanted).norm() { b } else { a };
    chosen.map(rounded)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arms::{hp3j, perturbed, seven_joints, ur5e};
    use crate::chain_from_urdf;

    /// Where the driver puts the links for a file: `base_link` from each, at joint values. Read by hand.
    fn links_of(yaml: &str, values: &[f64]) -> Vec<Isometry3> {
        let mut pose = Isometry3::rotation(Vector3::new(0.0, 0.0, PI));
        let mut found = vec![];
        for (link, value) in LINKS.iter().zip(values) {
            let block = &yaml[yaml.find(&format!("  {link}:\n")).unwrap()..];
            let v: Vec<f64> =
                block.lines().skip(1).take(6).map(|line| line.split(": ").nth(1).unwrap().parse().unwrap()).collect();
            let turn = nalgebra::UnitQuaternion::from_euler_angles(v[3], v[4], v[5]);
            pose *= Isometry3::from_parts(nalgebra::Translation3::new(v[0], v[1], v[2]), turn);
            pose *= Isometry3::rotation(Vector3::new(0.0, 0.0, *value));
            found.push(pose);
        }
        found
    }

    #[test]
    fn the_published_arms_give_the_makers_numbers() {
        let yaml = kinematics_yaml_of_table(&ur5e(), &ur5e(), "calib_0").unwrap();
        for part in [
            "kinematics:\n  shoulder:\n    x: 0\n    y: 0\n    z: 0.1625\n    roll: 0\n    pitch: 0\n    yaw: 0\n",
            "  upper_arm:\n    x: 0\n    y: 0\n    z: 0\n    roll: 1.5707963267949\n    pitch: 0\n    yaw: 0\n",
            "  forearm:\n    x: -0.425\n    y: 0\n    z: 0\n    roll: 0\n",
            "  wrist_1:\n    x: -0.3922\n    y: 0\n    z: 0.1333\n    roll: 0\n",
            "  wrist_2:\n    x: 0\n    y: -0.0997\n    z: 0\n    roll: 1.5707963267949\n",
            "  wrist_3:\n    x: 0\n    y: 0.0996\n    z: 0\n    roll: 1.5707963267949\n    pitch: 3.14159265358979\n    yaw: 3.14159265358979\n",
            "  hash: calib_0\n",
        ] {
            assert!(yaml.contains(part), "{part}\n{yaml}");
        }
        assert!(!yaml.starts_with('#'));
    }

    #[test]
    fn every_link_is_where_the_calibrated_description_has_it() {
        let draws: Vec<f64> = (0..24).map(|i| f64::from(i % 7) / 3.0 - 1.0).collect();
        let values = [0.3, -1.0, 0.8, 0.5, 1.2, -2.0];
        for (_, lengths) in ARMS {
            let urdf = published(lengths);
            for (base_link, tip_link) in [("base_link", "tool0"), (BASE, "wrist_3_link"), ("base_link", "flange")] {
                let nominal = chain_from_urdf(&urdf, base_link, tip_link).unwrap();
                let calibrated = perturbed(&nominal, 0.01, 0.002, &draws);
                let Ok(yaml) = kinematics_yaml(&urdf, base_link, tip_link, &nominal, &calibrated, "a") else {
                    // A flange that has left the last axis needs a joint behind it.
                    assert_eq!(tip_link, "wrist_3_link");
                    continue;
                };
                let written = write_urdf(&urdf, base_link, tip_link, &nominal, &calibrated).unwrap();
                for (link, found) in LINKS.iter().zip(links_of(&yaml, &values)) {
                    // The link's pose by the corrected description, which ends the chain there.
                    let chain = chain_from_urdf(&written, "base_link", &format!("{link}_link")).unwrap();
                    let wanted = chain.base_from_flange(&values[..chain.joint_count()]).unwrap();
                    let off = wanted.inverse() * found;
                    assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-9, "{link}: {off}");
                    // Links stay near their nominal places: no frame slides along its axis.
                    let at_nominal = chain_from_urdf(&urdf, "base_link", &format!("{link}_link")).unwrap();
                    let moved = at_nominal.base_from_flange(&values[..chain.joint_count()]).unwrap().inverse() * found;
                    assert!(moved.translation.vector.norm() < 0.05 && moved.rotation.angle() < 0.2, "{link}: {moved}");
                }
            }
        }
    }

    #[test]
    fn other_arms_and_bases_are_refused_with_the_reason() {
        let message = |chain: &SerialChain| kinematics_yaml_of_table(chain, chain, "x").unwrap_err().to_string();
        assert!(message(&hp3j()).contains("--urdf") && message(&seven_joints()).contains("Universal Robots"));
        assert!(kinematics_yaml_of_table(&ur5e(), &ur5e(), "a: b").is_err());
        let urdf = published(ARMS[1].1);
        // The first joint on base_link itself, as before the maker turned it.
        let old = urdf.replace("<link name=\"base_link\"/>", "").replace(BASE, "base_link");
        let old = old.replacen(
            "<joint name=\"to_base_link\" type=\"fixed\"><parent link=\"base_link\"/><child link=\"base_link\"/>",
            "<link name=\"world\"/><joint name=\"to_base_link\" type=\"fixed\"><parent link=\"world\"/><child link=\"base_link\"/>",
            1,
        );
        let refusal = |urdf: &str, base: &str| {
            let chain = chain_from_urdf(urdf, base, "tool0").unwrap();
            kinematics_yaml(urdf, base, "tool0", &chain, &chain, "x").unwrap_err().to_string()
        };
        assert!(refusal(&old, "base_link").contains("hangs on 'base_link'"));
        let kuka = urdf.replace("forearm_link", "link_3");
        assert!(refusal(&kuka, "base_link").contains("'link_3', and not forearm_link"));
    }
}
