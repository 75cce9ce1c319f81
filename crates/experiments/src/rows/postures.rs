//! What is wrong with the table of postures, or with how the arm follows it.

use super::{POSTURES, Row, Variant, joints};
use crate::causes::Cause;
use crate::cells::Cell;
use anyhow::{Context, Result, ensure};
use nalgebra::{UnitQuaternion, Vector3};
use skclam::dataset::PostureRecord;
use skclam::kinematics::{RefinementOptions, Termination, refine_inverse_kinematics};
use skclam::rig::{JointCorrection, JointCorrections, Posture, PostureState, joint_readings};

pub(super) fn rows() -> Vec<Row> {
    vec![
        Row { name: "1 ms late", expected: &[Cause::TimeOffset], make: |cell| late(cell, 0.001) },
        Row { name: "10 ms late", expected: &[Cause::TimeOffset], make: |cell| late(cell, 0.010) },
        Row { name: "encoder 2 +0.02 deg half way", expected: &[Cause::JointStep], make: |cell| stepped(cell, 0.02) },
        Row { name: "encoder 2 +0.1 deg half way", expected: &[Cause::JointStep], make: |cell| stepped(cell, 0.1) },
        Row { name: "slip 0.2 deg half way", expected: &[Cause::MountStep], make: slipped },
        Row { name: "sag 0.1 deg", expected: &[Cause::Compliance], make: sagging },
        Row { name: "gears sin 2q 0.1 deg", expected: &[Cause::Gears], make: geared },
        Row { name: "joints 2 and 3 swapped", expected: &[Cause::JointOrder], make: |cell| swapped(cell, 1, 2) },
        Row { name: "joints 4 and 6 swapped", expected: &[Cause::JointOrder], make: |cell| swapped(cell, 3, 5) },
        Row { name: "sign of joint 5", expected: &[Cause::JointSign], make: reversed },
        Row {
            name: "radians as degrees",
            expected: &[Cause::Degrees],
            make: |cell| read_otherwise(cell, |values| values.iter().map(|value| value.to_radians()).collect()),
        },
        Row {
            name: "degrees as radians",
            expected: &[Cause::Degrees],
            make: |cell| read_otherwise(cell, |values| values.iter().map(|value| value.to_degrees()).collect()),
        },
        Row { name: "one branch", expected: &[], make: one_branch },
    ]
}

/// Other joint values in the table than the arm had; a right answer is the true rig as it is.
fn read_otherwise(cell: &Cell, read: impl Fn(&[f64]) -> Vec<f64>) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    for record in &mut variant.records {
        record.posture.state = PostureState::Joints(read(joints(&record.posture)));
    }
    Ok(variant)
}

/// The table holds where the joints were before the image was taken.
fn late(cell: &Cell, seconds: f64) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    for record in &mut variant.records {
        let posture = &mut record.posture;
        ensure!(posture.joint_rates.len() == joints(posture).len(), "the cell's postures have no times");
        let earlier =
            joints(posture).iter().zip(&posture.joint_rates).map(|(value, rate)| value - seconds * rate).collect();
        posture.state = PostureState::Joints(earlier);
    }
    Ok(variant)
}

/// Joint 2's encoder says more from the middle of the recording on.
fn stepped(cell: &Cell, degrees: f64) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    for record in variant.records.iter_mut().skip(POSTURES / 2) {
        let mut values = joints(&record.posture).to_vec();
        values[1] += degrees.to_radians();
        record.posture.state = PostureState::Joints(values);
    }
    Ok(variant)
}

fn swapped(cell: &Cell, a: usize, b: usize) -> Result<Variant> {
    read_otherwise(cell, |values| {
        let mut values = values.to_vec();
        values.swap(a, b);
        values
    })
}

fn reversed(cell: &Cell) -> Result<Variant> {
    read_otherwise(cell, |values| {
        let mut values = values.to_vec();
        values[4] = -values[4];
        values
    })
}

/// The images of an arm whose encoders would have said other values: the table holds these, and a right answer is given
/// them too.
fn behaving_otherwise(cell: &Cell, said: impl Fn(&[f64]) -> Result<Vec<f64>>) -> Result<Variant> {
    let mut variant = Variant::unchanged(cell, POSTURES)?;
    for (record, posture) in variant.records.iter_mut().zip(&mut variant.truth.postures) {
        record.posture.state = PostureState::Joints(said(joints(&record.posture))?);
        posture.state = record.posture.state.clone();
    }
    Ok(variant)
}

/// Joints 2 and 3 give way under the arm's weight, joint 2 by 0.1 deg at most.
fn sagging(cell: &Cell) -> Result<Variant> {
    const DEGREES: f64 = 0.1;
    let arm = cell.truth.robot.as_ref().context("a cell has an arm")?;
    let mut longest = 0f64;
    for record in cell.dataset.records.iter().take(POSTURES) {
        let readings = joint_readings(arm, joints(&record.posture), &[])?;
        longest = readings.get(1).map_or(longest, |reading| longest.max(reading.gravity_arm.abs()));
    }
    let soft = JointCorrection { compliance: DEGREES.to_radians() / longest, ..JointCorrection::default() };
    let stiff = JointCorrection::default();
    let joints = vec![stiff, soft, soft, stiff, stiff, stiff];
    let corrections = JointCorrections { joints, time_offset_s: 0.0 };
    behaving_otherwise(cell, |values| Ok(corrections.encoder_values(arm, values)?))
}

/// Every joint is `0.1 deg sin(2 q)` beyond its encoder, alternately to either side.
fn geared(cell: &Cell) -> Result<Variant> {
    const DEGREES: f64 = 0.1;
    let beyond = |joint: usize, q: f64| {
        let sign = if joint.is_multiple_of(2) { 1.0 } else { -1.0 };
        sign * DEGREES.to_radians() * (2.0 * q).sin()
    };
    behaving_otherwise(cell, |values| {
        let solve = |(joint, &value): (usize, &f64)| (0..20).fold(value, |q, _| value - beyond(joint, q));
        Ok(values.iter().enumerate().map(solve).collect())
    })
}

/// From the middle of the recording on the camera is turned by 0.2 deg in its holder: an arm that was a little
/// elsewhere would have taken the same images. Postures at which there is no such arm are left out.
fn slipped(cell: &Cell) -> Result<Variant> {
    const DEGREES: f64 = 0.2;
    let whole = Variant::unchanged(cell, POSTURES)?;
    let arm = cell.truth.robot.as_ref().context("a cell has an arm")?;
    let slip = UnitQuaternion::from_scaled_axis(Vector3::new(0.8, 0.6, 0.0) * DEGREES.to_radians());
    let before_slip = cell.truth.flange_from_color * slip.inverse() * cell.truth.flange_from_color.inverse();
    let mut variant = Variant { records: vec![], ..whole.clone() };
    (variant.truth.postures, variant.truth.cameras) = (vec![], vec![]);
    for (at, (record, camera)) in whole.records.iter().zip(&whole.truth.cameras).enumerate() {
        let mut record = record.clone();
        if at >= POSTURES / 2 {
            let wanted = arm.base_from_flange(joints(&record.posture))? * before_slip;
            let options = RefinementOptions { largest_change: Some(0.2), ..RefinementOptions::default() };
            let found = refine_inverse_kinematics(arm, &wanted, joints(&record.posture), &options)?;
            if found.termination != Termination::Converged {
                continue;
            }
            record.posture.state = PostureState::Joints(found.joint_values);
        }
        variant.truth.postures.push(record.posture.clone());
        variant.truth.cameras.push(*camera);
        variant.records.push(record);
    }
    ensure!(variant.records.len() > POSTURES * 3 / 4, "too many postures are singular");
    Ok(variant)
}

/// The postures of the most frequent signs of joints 3 and 5: elbow and wrist on one side.
fn one_branch(cell: &Cell) -> Result<Variant> {
    let branch = |posture: &Posture| [2, 4].map(|joint| joints(posture).get(joint).is_some_and(|value| *value > 0.0));
    let of = |wanted: [bool; 2]| -> Vec<PostureRecord> {
        cell.dataset.records.iter().filter(|record| branch(&record.posture) == wanted).cloned().collect()
    };
    let branches = [[false, false], [false, true], [true, false], [true, true]].map(of);
    let largest = branches.into_iter().max_by_key(Vec::len).unwrap_or_default();
    Variant::of_records(cell, largest)
}
