//! The calibrated chain written back into its URDF.
//!
//! A link of the chain is where its frame on the joint's axis is: with `F_i` that frame at joint values 0 and `C_i`
//! URDF's frame of the same link, `X_i = F_i^-1 C_i` is a property of the link, and the calibrated `C_i' = F_i' X_i`.
//! So visuals, collisions and everything that hangs on the link stay where they are *on it*. The origin of joint i
//! follows from `C_(i-1)'`, the fixed joints between, and `C_i'`; joint axes and fixed joints keep their text.

use super::document::{Document, OriginPlace, UrdfJoint, refuse};
use crate::chain::JointKind;
use crate::{Isometry3, KinematicsError, SerialChain};
use nalgebra::{Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
use std::ops::Range;

/// How far the nominal chain may be from the URDF (metres, radians): the digits of a rig file.
const SAME_ARM: f64 = 1e-6;
/// How far the written file may be from the calibrated chain (metres, radians).
const SAME_RESULT: f64 = 1e-9;

/// The text of a URDF in which the origins of the joints between two links are those of a calibrated chain.
///
/// `nominal` is the chain that the calibration began with: [`chain_from_urdf`](super::chain_from_urdf) of the same
/// text, or another description (a DH table) of the same arm with the same base, flange and joint zeros. Only `xyz` and
/// `rpy` of `<origin>` of the movable joints on the way change (and of the fixed joint at the end, if the calibrated
/// flange asks for it); every other byte stays, and forward kinematics of the result equal the calibrated chain's to
/// 1e-9.
///
/// # Errors
/// As [`chain_from_urdf`](super::chain_from_urdf); [`KinematicsError::Urdf`] if `nominal` is not the arm of the URDF,
/// or if the calibrated chain cannot be written by origins alone.
pub fn write_urdf(
    text: &str,
    base_link: &str,
    tip_link: &str,
    nominal: &SerialChain,
    calibrated: &SerialChain,
) -> Result<String, KinematicsError> {
    let document = Document::parse(text)?;
    let path = document.path(base_link, tip_link)?;
    let movable: Vec<&UrdfJoint<'_>> = path.iter().filter(|joint| joint.motion.is_some()).collect();
    for (what, chain) in [("nominal", nominal), ("calibrated", calibrated)] {
        let kinds = chain.joints().iter().map(|joint| Some(joint.kind));
        if !kinds.eq(movable.iter().map(|joint| joint.motion.as_ref().map(|motion| motion.kind))) {
            let count = chain.joint_count();
            let problem =
                format!("the {what} chain has {count} joints, and the URDF {} of other kinds or number", movable.len());
            return Err(refuse(1, problem));
        }
    }
    let zeros = vec![0.0; movable.len()];
    let nominal_links = nominal.base_from_joint_frames(&zeros)?;
    let calibrated_links = calibrated.base_from_joint_frames(&zeros)?;
    let calibrated_flange = calibrated.base_from_flange(&zeros)?;

    let mut before = Isometry3::identity();
    let mut after = Isometry3::identity();
    let mut index = 0;
    let mut edits = Edits::default();
    for (step, joint) in path.iter().enumerate() {
        before *= joint.origin;
        let mut written = joint.origin;
        if let Some(motion) = &joint.motion {
            let (old, new) = (&nominal_links[index], &calibrated_links[index]);
            let off = off_axis(&before, old, motion.kind, &motion.axis);
            if off > SAME_ARM {
                let problem =
                    format!("the axis of joint '{}' is {off:.2e} m or rad off the nominal chain's", joint.name);
                return Err(refuse(1, problem));
            }
            let mut child = new * (old.inverse() * before);
            if index + 1 == movable.len() {
                // What follows the last joint is fixed; where turning and sliding on the axis can, end at the flange.
                let tail = path[step + 1..].iter().fold(Isometry3::identity(), |tail, joint| tail * joint.origin);
                let ending = calibrated_flange * tail.inverse();
                if off_axis(&ending, new, motion.kind, &motion.axis) < SAME_ARM {
                    child = ending;
                }
            }
            written = after.inverse() * on_axis(&child, new, motion.kind, &motion.axis);
            index += 1;
        } else if step + 1 == path.len() && index == movable.len() {
            written = after.inverse() * calibrated_flange;
        }
        let kept = edits.set(joint, &written);
        after *= kept;
    }
    let result = edits.apply(text);
    check_result(&result, base_link, tip_link, calibrated)?;
    Ok(result)
}

/// Distance of URDF's joint axis from that of a DH frame: the larger of an angle (radians) and a length (metres).
fn off_axis(child: &Isometry3, frame: &Isometry3, kind: JointKind, axis: &Unit<Vector3<f64>>) -> f64 {
    let z = frame.rotation * Vector3::z();
    let angle = (child.rotation * axis.into_inner() - z).norm();
    let offset = child.translation.vector - frame.translation.vector;
    match kind {
        JointKind::Revolute => angle.max((offset - z * z.dot(&offset)).norm()),
        JointKind::Prismatic => angle,
    }
}

/// The child frame turned and moved by the least that puts its axis on the z axis of a DH frame: rounding.
fn on_axis(child: &Isometry3, frame: &Isometry3, kind: JointKind, axis: &Unit<Vector3<f64>>) -> Isometry3 {
    let z = frame.rotation * Vector3::z();
    let now = child.rotation * axis.into_inner();
    let turn = UnitQuaternion::new_normalize(Quaternion::from_parts(1.0 + now.dot(&z), now.cross(&z)));
    let offset = child.translation.vector - frame.translation.vector;
    let position = match kind {
        JointKind::Revolute => frame.translation.vector + z * z.dot(&offset),
        JointKind::Prismatic => child.translation.vector,
    };
    Isometry3::from_parts(Translation3::from(position), turn * child.rotation)
}

/// The file as a reader will see it, against the chain that was to be written.
fn check_result(text: &str, base: &str, tip: &str, calibrated: &SerialChain) -> Result<(), KinematicsError> {
    let written = super::chain_from_urdf(text, base, tip)?;
    for step in [0.0, 0.3] {
        let values: Vec<f64> = (0..calibrated.joint_count()).map(|joint| step * (1.0 + joint as f64)).collect();
        let off = written.base_from_flange(&values)?.inverse() * calibrated.base_from_flange(&values)?;
        let (length, angle) = (off.translation.vector.norm(), off.rotation.angle());
        if length.max(angle) > SAME_RESULT {
            let problem = format!(
                "the calibrated chain cannot be written by origins alone: the flange would be off by {length:.2e} m and \
                 {angle:.2e} rad; is the nominal chain that of this URDF, with the same base, tip and joint zeros?"
            );
            return Err(refuse(1, problem));
        }
    }
    Ok(())
}

/// A part of an origin that differs by no more than this (metres, radians) keeps its text.
pub(crate) const UNCHANGED: f64 = 1e-13;

/// Replacements in a text, by place.
#[derive(Default)]
struct Edits(Vec<(Range<usize>, String)>);

impl Edits {
    /// Writes what has changed of an origin, and returns the origin as a reader will have it.
    fn set(&mut self, joint: &UrdfJoint<'_>, origin: &Isometry3) -> Isometry3 {
        let moves = (joint.origin.translation.vector - origin.translation.vector).norm() > UNCHANGED;
        let turns = (joint.origin.rotation.inverse() * origin.rotation).imag().norm() > UNCHANGED;
        let position = origin.translation.vector.map(rounded);
        let angles = roll_pitch_yaw(&origin.rotation).map(rounded);
        let shown = |v: &Vector3<f64>| format!("{} {} {}", v.x, v.y, v.z);
        let mut kept = joint.origin;
        let mut added = String::new();
        let mut write = |key: &str, value: String, place: Option<&Range<usize>>| match place {
            Some(range) => self.0.push((range.clone(), value)),
            None => added.push_str(&format!(" {key}=\"{value}\"")),
        };
        let (xyz_place, rpy_place) = match &joint.place {
            OriginPlace::Element { xyz, rpy, .. } => (xyz.as_ref(), rpy.as_ref()),
            OriginPlace::Missing { .. } => (None, None),
        };
        if moves {
            write("xyz", shown(&position), xyz_place);
            kept.translation = Translation3::from(position);
        }
        if turns {
            write("rpy", shown(&angles), rpy_place);
            kept.rotation = UnitQuaternion::from_euler_angles(angles.x, angles.y, angles.z);
        }
        if !added.is_empty() {
            self.0.push(match joint.place {
                OriginPlace::Element { after_name, .. } => (after_name..after_name, added),
                // On the line of the element that it goes before, so that no other line moves.
                OriginPlace::Missing { before } => (before..before, format!("<origin{added}/>")),
            });
        }
        kept
    }

    fn apply(mut self, text: &str) -> String {
        self.0.sort_by_key(|(range, _)| range.start);
        let mut result = String::with_capacity(text.len() + 64 * self.0.len());
        let mut done = 0;
        for (range, value) in self.0 {
            result.push_str(&text[done..range.start]);
            result.push_str(&value);
            done = range.end;
        }
        result.push_str(&text[done..]);
        result
    }
}

/// Fourteen decimals: far below what forward kinematics show, and no tails of binary fractions. Never minus zero.
pub(crate) fn rounded(value: f64) -> f64 {
    (value * 1e14).round() / 1e14 + 0.0
}

/// `R = Rz(yaw) Ry(pitch) Rx(roll)`, precise at a pitch of 90 deg too: roll is read with yaw undone.
pub(crate) fn roll_pitch_yaw(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    let matrix = rotation.to_rotation_matrix();
    let across = matrix[(0, 0)].hypot(matrix[(1, 0)]);
    let yaw = if across > 1e-12 { matrix[(1, 0)].atan2(matrix[(0, 0)]) } else { 0.0 };
    let rest = UnitQuaternion::from_euler_angles(0.0, 0.0, -yaw).to_rotation_matrix() * matrix;
    Vector3::new((-rest[(1, 2)]).atan2(rest[(1, 1)]), (-rest[(2, 0)]).atan2(rest[(0, 0)]), yaw)
}

/// The changed lines of two texts, for people: `@@ line n @@`, `- before`, `+ after`. Empty if there are none.
///
/// Lines are compared at the same place, as [`write_urdf`] never adds or removes one; of texts with different numbers
/// of lines everything between the common beginning and end is shown as one change.
pub fn line_diff(before: &str, after: &str) -> String {
    let (old, new): (Vec<&str>, Vec<&str>) = (before.lines().collect(), after.lines().collect());
    let mut shown = String::new();
    let mut show = |line: usize, old: &[&str], new: &[&str]| {
        shown += &format!("@@ line {} @@\n", line + 1);
        shown.extend(old.iter().map(|line| format!("- {line}\n")));
        shown.extend(new.iter().map(|line| format!("+ {line}\n")));
    };
    if old.len() == new.len() {
        for (line, (old, new)) in old.iter().zip(&new).enumerate().filter(|(_, (old, new))| old != new) {
            show(line, &[old], &[new]);
        }
    } else {
        let start = old.iter().zip(&new).take_while(|(old, new)| old == new).count();
        let (old_rest, new_rest) = (&old[start..], &new[start..]);
        let same_end = old_rest.iter().rev().zip(new_rest.iter().rev()).take_while(|(old, new)| old == new).count();
        show(start, &old_rest[..old_rest.len() - same_end], &new_rest[..new_rest.len() - same_end]);
    }
    shown
}
