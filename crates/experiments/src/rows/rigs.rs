//! What is wrong with the nominal rig.

use super::{POSTURES, Row, Variant};
use crate::causes::Cause;
use crate::cells::Cell;
use anyhow::{Context, Result};
use nalgebra::{UnitQuaternion, Vector3};
use skclam::rig::{Rig, builtin_rig};

pub(super) fn rows() -> Vec<Row> {
    vec![
        Row {
            name: "focal length 1 %",
            expected: &[Cause::FocalLength],
            make: |cell| {
                with_rig(cell, |rig| (rig.color.fx, rig.color.fy) = (1.01 * rig.color.fx, 1.01 * rig.color.fy))
            },
        },
        Row {
            name: "principal point 10 px",
            expected: &[Cause::PrincipalPoint],
            make: |cell| with_rig(cell, |rig| rig.color.cx += 10.0),
        },
        Row {
            name: "k1 -0.05",
            expected: &[Cause::Distortion],
            make: |cell| with_rig(cell, |rig| rig.color.distortion[0] -= 0.05),
        },
        Row { name: "mount turned by 90 deg", expected: &[Cause::MountFarOff], make: turned_mount },
        Row { name: "lengths 10 to 20 mm", expected: &[], make: other_lengths },
        Row { name: "another robot's rig", expected: &[Cause::WrongArm], make: other_robot },
    ]
}

fn with_rig(cell: &Cell, change: impl Fn(&mut Rig)) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    change(&mut variant.rig);
    Ok(variant)
}

/// About the camera's own axis, as a holder screwed on in another of its four ways.
fn turned_mount(cell: &Cell) -> Result<Variant> {
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    with_rig(cell, |rig| rig.flange_from_color *= quarter)
}

/// Every length of the nominal arm that is not zero is 10 to 20 mm off, alternately to either side.
fn other_lengths(cell: &Cell) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    let robot = variant.rig.robot.as_mut().context("a cell has an arm")?;
    let lengths = robot.parameter_ids().into_iter().filter(|id| !id.kind.is_angle());
    let lengths: Vec<_> = lengths.filter(|&id| robot.parameter(id).is_some_and(|length| length != 0.0)).collect();
    for (at, &id) in lengths.iter().enumerate() {
        let size = 0.010 + 0.010 * (at as f64 * 0.382).fract();
        let off = if at.is_multiple_of(2) { size } else { -size };
        robot.set_parameter(id, robot.parameter(id).unwrap_or_default() + off)?;
    }
    Ok(variant)
}

fn other_robot(cell: &Cell) -> Result<Variant> {
    let other = builtin_rig("ur5e").context("the rig ur5e is built in")??;
    with_rig(cell, |rig| rig.robot.clone_from(&other.robot))
}
