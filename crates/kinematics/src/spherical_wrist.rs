//! Closed-form inverse kinematics of a 6R arm with parallel axes 2 and 3 and a spherical wrist.
//!
//! Everything is read off the six joint axes at zero joint values, so that the link form (modified or standard DH,
//! Hayati), offsets, senses of rotation and the frames at both ends do not matter. With `T = E1 ... E6 T0`, `Ei` the
//! rotation about axis i, and `w0` the point where axes 4 to 6 meet, `w = T T0^-1 w0` depends on joints 1 to 3 alone:
//! joint 1 from the component of `w` along axis 2, joint 3 from its distance to axis 2, joint 2 from its direction;
//! then `R = R4 R5 R6` by the spherical law of cosines. These are the Paden-Kahan subproblems of Murray, Li and
//! Sastry, "A Mathematical Introduction to Robotic Manipulation", section 3.3.
//!
//! Libraries for this geometry take fixed parameter sets with right angles, drop the branch a solution belongs to
//! where one is missing, and would bring a second linear algebra; these equations are shorter than an adapter.

use crate::chain::JointKind;
use crate::wrapping::{admitted_revolutions, wrapped};
use crate::{Isometry3, KinematicsError, SerialChain};
use nalgebra::{Point3, Rotation3, Unit, UnitQuaternion, Vector3};
use std::f64::consts::PI;

/// What counts as parallel (radians) and as meeting in a point (metres): rounding of a nominal arm, and nothing else.
const GEOMETRY_TOLERANCE: f64 = 1e-10;
/// Below this an angle or a length (radians, metres) leaves a joint undetermined.
const SINGULAR: f64 = 1e-10;
/// A cosine beyond 1 by no more than this is rounding at the edge of the workspace.
const REACH_TOLERANCE: f64 = 1e-12;

/// On which side of axis 1 the wrist is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Shoulder {
    /// The wrist centre is on the side where axis 2 is; where axes 1 and 2 meet, on the side of `axis 1 x axis 2`.
    Front,
    /// The arm reaches over its shoulder.
    Back,
}

/// To which side joint 3 bends the stretched arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Elbow {
    /// Positive direction of joint 3, from the value at which the arm is stretched.
    Positive,
    /// Negative direction.
    Negative,
}

/// To which side joint 5 bends the straight wrist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Wrist {
    /// Positive direction of joint 5, from the value at which axes 4 and 6 are aligned.
    Positive,
    /// Negative direction.
    Negative,
}

/// One closed-form solution.
#[derive(Debug, Clone, PartialEq)]
pub struct SphericalWristSolution {
    /// Six angles in radians, in `(-pi, pi]`.
    pub joint_values: Vec<f64>,
    /// Whether every angle, wrapped where needed, lies within the joint's limits.
    /// [`nearby`](crate::nearby) wraps them.
    pub within_limits: bool,
    /// Side of the shoulder.
    pub shoulder: Shoulder,
    /// Side of the elbow.
    pub elbow: Elbow,
    /// Side of the wrist.
    pub wrist: Wrist,
}

/// All closed-form solutions for a flange pose, at most eight, ordered by shoulder, then elbow, then wrist; the first
/// of each pair is [`Shoulder::Front`], [`Elbow::Positive`], [`Wrist::Positive`].
///
/// A pose out of reach has no solution, and the vector is empty. Where two branches coincide (arm stretched, wrist
/// straight, within rounding) the solution appears once, as the first branch; a joint that the pose leaves
/// undetermined is then 0 (joint 1 with the wrist centre on axis 1, joint 2 with it on axis 2, joint 4 with a straight
/// wrist). Solutions outside the joint limits are not left out: see [`SphericalWristSolution::within_limits`].
///
/// # Errors
/// [`KinematicsError::NoClosedForm`] with the measured deviation if the chain is not six revolute joints with axes 2
/// and 3 parallel and axes 4, 5 and 6 through one point (a calibrated chain never is: use
/// [`refine_inverse_kinematics`](crate::refine_inverse_kinematics) there); [`KinematicsError::NotFinite`] for the pose.
pub fn spherical_wrist_solutions(
    chain: &SerialChain,
    base_from_flange: &Isometry3,
) -> Result<Vec<SphericalWristSolution>, KinematicsError> {
    let arm = Arm::new(chain)?;
    for value in base_from_flange.to_homogeneous().iter() {
        if !value.is_finite() {
            return Err(KinematicsError::NotFinite { what: "base_from_flange".to_owned(), value: value.to_string() });
        }
    }
    let motion = base_from_flange * arm.base_from_flange_at_zero.inverse();
    let mut solutions = Vec::with_capacity(8);
    for (shoulder, q1) in arm.shoulders(&(motion * arm.wrist)) {
        let undo_1 = arm.axes[0].turn(-q1);
        for (elbow, q2, q3) in arm.elbows(&(undo_1 * (motion * arm.wrist))) {
            let rest = arm.axes[2].turn(-q3) * arm.axes[1].turn(-q2) * undo_1 * motion;
            for (wrist, q4, q5, q6) in arm.wrists(&rest.rotation) {
                let joint_values: Vec<f64> = [q1, q2, q3, q4, q5, q6].into_iter().map(wrapped).collect();
                let within_limits = chain
                    .joints()
                    .iter()
                    .zip(&joint_values)
                    .all(|(joint, &q)| admitted_revolutions(joint, q).next().is_some());
                solutions.push(SphericalWristSolution { joint_values, within_limits, shoulder, elbow, wrist });
            }
        }
    }
    Ok(solutions)
}

/// A joint axis at zero joint values, in the base frame.
struct Axis {
    direction: Unit<Vector3<f64>>,
    /// The point on the axis that is nearest to the base's origin.
    point: Point3<f64>,
}

impl Axis {
    fn turn(&self, angle: f64) -> Isometry3 {
        let rotation = UnitQuaternion::from_axis_angle(&self.direction, angle);
        Isometry3::rotation_wrt_point(rotation, self.point)
    }

    /// The part of a vector that is perpendicular to the axis.
    fn across(&self, vector: &Vector3<f64>) -> Vector3<f64> {
        vector - self.direction.into_inner() * self.direction.dot(vector)
    }

    /// The angle about the axis from one direction to the other; 0 where one of them is along the axis.
    fn angle(&self, from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
        let (from, to) = (self.across(from), self.across(to));
        if from.norm() < SINGULAR || to.norm() < SINGULAR {
            return 0.0;
        }
        self.direction.dot(&from.cross(&to)).atan2(from.dot(&to))
    }
}

struct Arm {
    axes: [Axis; 6],
    /// Where axes 4, 5 and 6 meet.
    wrist: Point3<f64>,
    base_from_flange_at_zero: Isometry3,
    /// Perpendicular to axes 1 and 2, towards [`Shoulder::Front`].
    front: Vector3<f64>,
}

impl Arm {
    fn new(chain: &SerialChain) -> Result<Self, KinematicsError> {
        let refuse = |reason: String| Err(KinematicsError::NoClosedForm { reason });
        if chain.joint_count() != 6 {
            return refuse(format!("it has {} joints instead of 6", chain.joint_count()));
        }
        if let Some(index) = chain.joints().iter().position(|joint| joint.kind != JointKind::Revolute) {
            return refuse(format!("joint {} is not revolute", index + 1));
        }
        let at_zero = chain.jacobian(&[0.0; 6])?;
        let axes = std::array::from_fn(|joint| {
            let twist = at_zero.by_joint[joint];
            let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
            Axis { direction: Unit::new_normalize(omega), point: Point3::from(omega.cross(&v)) }
        });
        let between = |i: usize, j: usize| {
            let (a, b): (&Axis, &Axis) = (&axes[i], &axes[j]);
            let sine = a.direction.cross(&b.direction).norm();
            sine.atan2(a.direction.dot(&b.direction).abs())
        };
        if between(1, 2) > GEOMETRY_TOLERANCE {
            return refuse(format!("axes 2 and 3 are {:.3e} rad off parallel", between(1, 2)));
        }
        for (i, j) in [(0, 1), (3, 4), (4, 5)] {
            if between(i, j) < 1e-3 {
                return refuse(format!("axes {} and {} are parallel", i + 1, j + 1));
            }
        }
        let wrist = meeting_point(&axes[3], &axes[4]);
        let miss = |axis: &Axis| axis.across(&(wrist - axis.point)).norm();
        let worst = axes[3..].iter().map(miss).fold(0.0, f64::max);
        if worst > GEOMETRY_TOLERANCE {
            return refuse(format!("axes 4, 5 and 6 miss a common point by {:.3e} mm", 1e3 * worst));
        }
        let arm_lengths = [axes[1].across(&(axes[2].point - axes[1].point)), axes[2].across(&(wrist - axes[2].point))];
        for (what, length) in ["axes 2 and 3", "axis 3 and the wrist centre"].into_iter().zip(arm_lengths) {
            if length.norm() < 1e-6 {
                return refuse(format!("the distance between {what} is {:.3e} mm", 1e3 * length.norm()));
            }
        }
        let cross = axes[0].direction.cross(&axes[1].direction);
        let offset = cross.dot(&(axes[1].point - axes[0].point));
        let front = if offset < -GEOMETRY_TOLERANCE { -cross } else { cross };
        Ok(Arm { axes, wrist, base_from_flange_at_zero: at_zero.base_from_flange, front })
    }

    /// Joint 1 from the wrist centre: its component along axis 2 is what it was at zero.
    fn shoulders(&self, wrist: &Point3<f64>) -> Vec<(Shoulder, f64)> {
        let [first, second, ..] = &self.axes;
        let arm = wrist - first.point;
        let along = first.direction.into_inner() * first.direction.dot(&arm);
        let constant = second.direction.dot(&(self.wrist - first.point - along));
        let (cosine, sine) =
            (second.direction.dot(&(arm - along)), -second.direction.dot(&first.direction.cross(&arm)));
        let mut found: Vec<(Shoulder, f64)> = angles_where(cosine, sine, constant)
            .into_iter()
            .map(|q1| {
                let ahead = self.front.dot(&(first.turn(-q1) * wrist - first.point));
                (if ahead >= 0.0 { Shoulder::Front } else { Shoulder::Back }, q1)
            })
            .collect();
        found.sort_by_key(|(shoulder, _)| *shoulder);
        found
    }

    /// Joints 2 and 3 from the wrist centre with joint 1 undone: a planar triangle.
    fn elbows(&self, wrist: &Point3<f64>) -> Vec<(Elbow, f64, f64)> {
        let [_, second, third, ..] = &self.axes;
        let upper = second.across(&(third.point - second.point));
        let lower = second.across(&(self.wrist - third.point));
        let reach = second.across(&(wrist - second.point));
        let constant = (reach.norm_squared() - upper.norm_squared() - lower.norm_squared()) / 2.0;
        let (cosine, sine) = (upper.dot(&lower), upper.dot(&third.direction.cross(&lower)));
        [Elbow::Positive, Elbow::Negative]
            .into_iter()
            .zip(angles_where(cosine, sine, constant))
            .map(|(elbow, q3)| {
                let bent = upper + UnitQuaternion::from_axis_angle(&third.direction, q3) * lower;
                (elbow, second.angle(&bent, &reach), q3)
            })
            .collect()
    }

    /// Joints 4 to 6 from the rotation that they make together.
    fn wrists(&self, rotation: &UnitQuaternion<f64>) -> Vec<(Wrist, f64, f64, f64)> {
        let [_, _, _, fourth, fifth, sixth] = &self.axes;
        let target = rotation * sixth.direction.into_inner();
        let arc = |a: &Vector3<f64>, b: &Vector3<f64>| a.cross(b).norm().atan2(a.dot(b));
        let (side_4, side_6) = (arc(&fourth.direction, &fifth.direction), arc(&fifth.direction, &sixth.direction));
        let opposite = arc(&fourth.direction, &target);
        // Half-angle form of the spherical law of cosines: as precise at a nearly straight wrist as anywhere.
        let sine_2 = ((opposite + side_4 - side_6) / 2.0).sin() * ((opposite - side_4 + side_6) / 2.0).sin();
        let cosine_2 = ((side_4 + side_6 + opposite) / 2.0).sin() * ((side_4 + side_6 - opposite) / 2.0).sin();
        if sine_2 < -REACH_TOLERANCE || cosine_2 < -REACH_TOLERANCE {
            return Vec::new();
        }
        let bend = 2.0 * sine_2.max(0.0).sqrt().atan2(cosine_2.max(0.0).sqrt());
        // At this value of joint 5 axes 4 and 6 are as near to aligned as they come.
        let straight = fifth.angle(&sixth.direction, &fourth.direction);
        let coincide = !(SINGULAR..=PI - SINGULAR).contains(&bend);
        let sides = [(Wrist::Positive, bend), (Wrist::Negative, -bend)];
        sides
            .into_iter()
            .take(if coincide { 1 } else { 2 })
            .map(|(wrist, bend)| {
                let q5 = straight + bend;
                let turn_5 = UnitQuaternion::from_axis_angle(&fifth.direction, q5);
                let q4 = fourth.angle(&(turn_5 * sixth.direction.into_inner()), &target);
                let turn_4 = UnitQuaternion::from_axis_angle(&fourth.direction, q4);
                let turn_6 = (turn_4 * turn_5).inverse() * rotation;
                let probe = Rotation3::rotation_between(&Vector3::z(), &sixth.direction)
                    .map_or(Vector3::x(), |z_to_axis| z_to_axis * Vector3::x());
                (wrist, q4, q5, sixth.angle(&probe, &(turn_6 * probe)))
            })
            .collect()
    }
}

/// The point nearest to two axes that are not parallel.
fn meeting_point(a: &Axis, b: &Axis) -> Point3<f64> {
    let cosine = a.direction.dot(&b.direction);
    let between = b.point - a.point;
    let along = (between.dot(&a.direction) - between.dot(&b.direction) * cosine) / (1.0 - cosine * cosine);
    a.point + a.direction.into_inner() * along
}

/// The angles where `cosine cos(q) + sine sin(q) = constant`: above and below the middle one; one where they
/// coincide, none out of reach; 0 where every angle will do.
fn angles_where(cosine: f64, sine: f64, constant: f64) -> Vec<f64> {
    let amplitude = cosine.hypot(sine);
    if amplitude < SINGULAR {
        return if constant.abs() < SINGULAR { vec![0.0] } else { Vec::new() };
    }
    let ratio = constant / amplitude;
    if ratio.abs() > 1.0 + REACH_TOLERANCE {
        return Vec::new();
    }
    let middle = sine.atan2(cosine);
    if ratio.abs() >= 1.0 {
        return vec![if ratio > 0.0 { middle } else { middle + PI }];
    }
    let away = ratio.acos();
    vec![middle + away, middle - away]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arms::{distance_from_singularity, hp3_like, hp3j, perturbed, spherical_standard_dh, ur5e};
    use crate::{Joint, Link, ParameterId, ParameterKind, nearby};
    use proptest::prelude::*;

    fn worst_error(chain: &SerialChain, solutions: &[SphericalWristSolution], pose: &Isometry3) -> f64 {
        let error = |solution: &SphericalWristSolution| {
            let reached = chain.base_from_flange(&solution.joint_values).unwrap();
            (reached.to_homogeneous() - pose.to_homogeneous()).norm()
        };
        solutions.iter().map(error).fold(0.0, f64::max)
    }

    fn branches(solutions: &[SphericalWristSolution]) -> Vec<(Shoulder, Elbow, Wrist)> {
        solutions.iter().map(|solution| (solution.shoulder, solution.elbow, solution.wrist)).collect()
    }

    #[test]
    fn eight_solutions_in_branch_order() {
        for (chain, joint_values) in [
            (hp3j(), [0.3, 0.4, -0.2, 0.5, 0.9, -0.7]),
            (hp3_like(), [0.3, 0.4, -0.2, 0.5, 0.9, -0.7]),
            (spherical_standard_dh(), [0.3, -1.2, 0.6, 0.5, 0.9, -0.7]),
        ] {
            let pose = chain.base_from_flange(&joint_values).unwrap();
            let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
            assert_eq!(solutions.len(), 8);
            assert!(worst_error(&chain, &solutions, &pose) < 1e-12);
            let found = branches(&solutions);
            assert!(found.is_sorted() && found.windows(2).all(|pair| pair[0] != pair[1]), "{found:?}");
            assert!(solutions.iter().any(|solution| {
                solution.joint_values.iter().zip(&joint_values).all(|(a, b)| (a - b).abs() < 1e-10)
            }));
        }
    }

    /// The paper's postures: joint 1 moves on, and each branch moves along with it.
    #[test]
    fn the_branch_order_is_stable_along_a_motion() {
        let chain = hp3j();
        let mut before: Option<Vec<SphericalWristSolution>> = None;
        for step in 0..200 {
            let t = f64::from(step) / 200.0;
            let joint_values = [0.1 + t, 0.3 + 0.2 * t, 0.4 - 0.3 * t, 0.2 + t, 0.4 + 0.7 * t, 0.3 - 2.0 * t];
            let pose = chain.base_from_flange(&joint_values).unwrap();
            let now = spherical_wrist_solutions(&chain, &pose).unwrap();
            assert_eq!(now.len(), 8);
            for (a, b) in before.iter().flatten().zip(&now) {
                let change = a.joint_values.iter().zip(&b.joint_values).map(|(a, b)| wrapped(a - b).abs());
                assert!(change.fold(0.0, f64::max) < 0.1);
            }
            before = Some(now);
        }
    }

    #[test]
    fn front_is_where_the_arm_reaches_at_positive_x() {
        let chain = hp3j();
        let joint_values = [0.0, -0.6, 0.2, 0.0, 0.5, 0.0];
        let pose = chain.base_from_flange(&joint_values).unwrap();
        let front = &spherical_wrist_solutions(&chain, &pose).unwrap()[0];
        let wrist = chain.base_from_links(&front.joint_values).unwrap()[3].translation.vector;
        assert_eq!(front.shoulder, Shoulder::Front);
        let ahead = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), front.joint_values[0]) * Vector3::x();
        assert!(ahead.dot(&wrist) > 0.0);
    }

    #[test]
    fn limits_are_reported_and_wrapped_values_found() {
        let mut joints = hp3_like().joints().to_vec();
        // Shoulder::Back only by a turn; Wrist::Negative not at all.
        joints[0].limits = Some([0.0, 4.0]);
        joints[4].limits = Some([0.0, 2.5]);
        let chain = SerialChain::new(joints).unwrap();
        let pose = chain.base_from_flange(&[0.3, 0.4, -0.2, 0.5, 0.9, -0.7]).unwrap();
        let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
        for shoulder in [Shoulder::Front, Shoulder::Back] {
            let of_side = solutions.iter().filter(|solution| solution.shoulder == shoulder);
            assert_eq!(of_side.filter(|solution| solution.within_limits).count(), 2);
        }
        for solution in &solutions {
            let near = nearby(&chain, &solution.joint_values, &[0.0; 6]).unwrap();
            assert_eq!(near.is_some(), solution.within_limits);
            assert!(near.is_none_or(|values| chain.admits(&values)));
        }
    }

    #[test]
    fn poses_at_the_edges() {
        let chain = hp3j();
        // Straight wrist: the pair of wrist branches is one.
        let pose = chain.base_from_flange(&[0.3, 0.4, -0.2, 0.5, 0.0, -0.7]).unwrap();
        let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
        assert!(solutions.len() < 8 && worst_error(&chain, &solutions, &pose) < 1e-9);
        // Nearly straight, down to where both are one.
        for exponent in 1..16 {
            let pose = chain.base_from_flange(&[0.3, 0.4, -0.2, 0.5, 0.1f64.powi(exponent), -0.7]).unwrap();
            let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
            assert!(solutions.len() >= 6 && worst_error(&chain, &solutions, &pose) < 1e-9, "1e-{exponent}");
        }
        // Stretched arm, within rounding.
        let stretched = (30f64 / 270.0).atan();
        let bend = [1.0, -1.0].map(|sign| {
            let pose =
                chain.base_from_flange(&[0.3, 0.4, std::f64::consts::FRAC_PI_2 + sign * stretched, 0.5, 0.6, -0.7]);
            spherical_wrist_solutions(&chain, &pose.unwrap()).unwrap().len()
        });
        assert!(bend.iter().all(|&count| count >= 2), "{bend:?}");
        // Wrist centre on axis 1: joint 1 is free and set to 0.
        let above = |height: f64| Isometry3::translation(0.0, 0.0, height);
        let solutions = spherical_wrist_solutions(&chain, &above(0.8)).unwrap();
        assert!(!solutions.is_empty() && worst_error(&chain, &solutions, &above(0.8)) < 1e-9);
        assert!(solutions.iter().all(|solution| solution.joint_values[0] == 0.0));
        // Out of reach.
        assert_eq!(spherical_wrist_solutions(&chain, &above(5.0)).unwrap(), vec![]);
        assert!(spherical_wrist_solutions(&chain, &above(f64::NAN)).is_err());
    }

    #[test]
    fn other_geometries_are_refused_with_the_reason() {
        let reason =
            |chain: &SerialChain| spherical_wrist_solutions(chain, &Isometry3::identity()).unwrap_err().to_string();
        assert!(reason(&ur5e()).contains("axes 4, 5 and 6 miss a common point by"), "{}", reason(&ur5e()));
        let mut bent = hp3j();
        bent.set_parameter(ParameterId { joint: 2, kind: ParameterKind::Alpha }, 181f64.to_radians()).unwrap();
        assert!(reason(&bent).contains("axes 2 and 3 are 1.745e-2 rad off parallel"), "{}", reason(&bent));
        let short = SerialChain::new(hp3j().joints()[..5].to_vec()).unwrap();
        assert!(reason(&short).contains("it has 5 joints instead of 6"));
        let mut joints = hp3j().joints().to_vec();
        joints[5].kind = JointKind::Prismatic;
        assert!(reason(&SerialChain::new(joints).unwrap()).contains("joint 6 is not revolute"));
        let flat = SerialChain::new(vec![Joint::revolute("", Link::modified_dh(0.0, 0.1, 0.0, 0.0)); 6]).unwrap();
        assert!(reason(&flat).contains("axes 1 and 2 are parallel"));
        assert!(reason(&perturbed(&hp3j(), 0.01, 0.001, &[0.5; 24])).contains("off parallel"));
    }

    proptest! {
        #[test]
        fn every_solution_reaches_the_pose(values in prop::collection::vec(-3.1..3.1f64, 6), arm in 0..3usize, tool in prop::collection::vec(-1.0..1.0f64, 6)) {
            let plain = [hp3j(), hp3_like(), spherical_standard_dh()][arm].clone();
            let end = |v: &[f64]| Isometry3::new(Vector3::new(v[0], v[1], v[2]), 2.0 * Vector3::new(v[3], v[4], v[5]));
            let chain = SerialChain::with_ends(end(&tool).inverse(), plain.joints().to_vec(), end(&tool)).unwrap();
            let pose = chain.base_from_flange(&values).unwrap();
            let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
            prop_assert!(worst_error(&chain, &solutions, &pose) < 1e-9);
            // The wrist centre is within reach on this side at least: two elbows; two wrists, and both for each elbow
            // where the wrist's right angles let it reach every orientation.
            prop_assert!(solutions.len() >= [4, 4, 2][arm]);
            let found = branches(&solutions);
            prop_assert!(found.is_sorted() && found.windows(2).all(|pair| pair[0] != pair[1]), "{found:?}");
            for solution in &solutions {
                prop_assert!(solution.joint_values.iter().all(|q| *q > -PI && *q <= PI));
            }
            prop_assert!(distance_from_singularity(&plain, &values) < 1e-3 || solutions.iter().any(|solution| solution.joint_values.iter().zip(&values).all(|(a, b)| wrapped(a - b).abs() < 1e-6)));
        }
    }
}
