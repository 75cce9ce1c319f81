//! What is wrong with the depth camera or its images.

use super::{POSTURES, Row, Variant};
use crate::causes::Cause;
use crate::cells::Cell;
use anyhow::{Context, Result};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use skclam::rig::Rig;

pub(super) fn rows() -> Vec<Row> {
    vec![
        Row {
            name: "depth scale 0.5 %",
            expected: &[Cause::DepthScale],
            make: |cell| measured_as(cell, |depth| 1.005 * depth),
        },
        Row {
            name: "depth bias 5 mm z^2",
            expected: &[Cause::DepthBias, Cause::DepthScale],
            make: |cell| measured_as(cell, |depth| depth + 0.005 * depth * depth),
        },
        Row { name: "depth images one row late", expected: &[Cause::ImageShift], make: shifted },
        Row {
            name: "extrinsics 5 mm in z",
            // Along the optical axis the two are one.
            expected: &[Cause::Extrinsics, Cause::DepthBias],
            make: |cell| extrinsics(cell, Vector3::new(0.0, 0.0, 0.005), 0.0),
        },
        Row {
            name: "extrinsics 15 mm in x",
            expected: &[Cause::Extrinsics],
            make: |cell| extrinsics(cell, Vector3::new(0.015, 0.0, 0.0), 0.0),
        },
        Row {
            name: "extrinsics 1 deg",
            expected: &[Cause::Extrinsics],
            make: |cell| extrinsics(cell, Vector3::zeros(), 1.0),
        },
    ]
}

fn measured_as(cell: &Cell, depth: fn(f64) -> f64) -> Result<Variant> {
    Ok(Variant { depth: Some(depth), ..Variant::unchanged(cell, POSTURES)? })
}

/// Each posture is given the depth image of the one before; the first has none.
fn shifted(cell: &Cell) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    let mut before = None;
    for record in &mut variant.records {
        std::mem::swap(&mut record.depth, &mut before);
    }
    Ok(variant)
}

/// The nominal place of the depth camera beside the colour camera is moved, then turned about its own upright axis.
fn extrinsics(cell: &Cell, shift_m: Vector3<f64>, degrees: f64) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), degrees.to_radians());
    let Rig { depth, .. } = &mut variant.rig;
    let pose = &mut depth.as_mut().context("a cell has a depth camera")?.color_from_depth;
    *pose = Translation3::from(shift_m) * *pose * turn;
    Ok(variant)
}
