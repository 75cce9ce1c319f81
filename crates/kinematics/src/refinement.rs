//! Numerical inverse kinematics on any chain, by a damped Gauss-Newton method from a start near the solution.
//!
//! Minimises `|e(q)|^2`, `e = (t* - t, l log(R* R^T))`, with `l` a length that makes radians comparable to metres. The
//! step is `J^T (J J^T + mu I)^-1 e = (J^T J + mu I)^-1 J^T e` (Wampler, "Manipulator inverse kinematic solutions based
//! on vector formulations and damped least-squares methods", 1986), on a redundant arm the least motion that does it;
//! of the two forms the one with the smaller system is solved. `mu` follows Levenberg and Marquardt.

use crate::chain::JointKind;
use crate::{ChainJacobian, Isometry3, KinematicsError, SerialChain};
use nalgebra::{DMatrix, DVector, Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// Whether joint values may leave their limits.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointLimits {
    /// Limits are ignored.
    #[default]
    Ignored,
    /// No joint value leaves its limits: a joint that would is held there, and the others make up for it.
    Respected,
}

/// How [`refine_inverse_kinematics`] works.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefinementOptions {
    /// Converged when the position error is at most this, metres.
    pub position_tolerance: f64,
    /// ... and the rotation error at most this, radians.
    pub rotation_tolerance: f64,
    /// Most forward kinematics computed after the start.
    pub max_iterations: usize,
    /// Length by which radians are multiplied to weigh as metres.
    pub metres_per_radian: f64,
    /// Longest change of a joint in one step, radians or, for a prismatic joint, multiples of `metres_per_radian`.
    pub largest_step: f64,
    /// A solution with a joint further from the start than this is on another branch, as far as a caller is concerned
    /// ([`Termination::LeftStart`]); in the units of `largest_step`. `None`: as far as it likes.
    pub largest_change: Option<f64>,
    /// Whether joint limits are respected.
    pub joint_limits: JointLimits,
}

impl Default for RefinementOptions {
    fn default() -> Self {
        RefinementOptions {
            position_tolerance: 1e-10,
            rotation_tolerance: 1e-10,
            max_iterations: 100,
            metres_per_radian: 0.3,
            largest_step: 0.2,
            largest_change: Some(0.8),
            joint_limits: JointLimits::Ignored,
        }
    }
}

/// How a refinement ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Termination {
    /// Both errors are within tolerance, and no joint is further from the start than allowed.
    Converged,
    /// Both errors are within tolerance, but some joint is further from the start than `largest_change`.
    LeftStart,
    /// No step reduces the error any more: out of reach, at a singularity, or held by joint limits.
    Stalled,
    /// `max_iterations` were not enough.
    IterationLimit,
}

/// Joint values and how well they reach the pose.
#[derive(Debug, Clone, PartialEq)]
pub struct InverseKinematics {
    /// The best joint values found, radians or metres. Wrapped as the start is.
    pub joint_values: Vec<f64>,
    /// Distance between the flange's position and the wanted one, metres.
    pub position_error: f64,
    /// Angle between the flange's orientation and the wanted one, radians.
    pub rotation_error: f64,
    /// Forward kinematics computed after the start.
    pub iterations: usize,
    /// How it ended. Only [`Termination::Converged`] is a success.
    pub termination: Termination,
}

/// Joint values at which a chain, calibrated or not, reaches a flange pose, found from a start near them.
///
/// `start`: radians or metres, one a joint; a solution of the nominal arm is a good one. For a redundant arm the result
/// is the solution near the start. Not to converge is no error: see [`InverseKinematics::termination`].
///
/// # Errors
/// Wrong number of joints in `start`; a number in the pose, the start or the options that is not finite, or an option
/// that is not positive.
pub fn refine_inverse_kinematics(
    chain: &SerialChain,
    base_from_flange: &Isometry3,
    start: &[f64],
    options: &RefinementOptions,
) -> Result<InverseKinematics, KinematicsError> {
    chain.check(start)?;
    check(base_from_flange, options)?;
    let solver = Solver { chain, base_from_flange, options };
    let mut current = solver.at(solver.within_limits(start))?;
    let mut damping = 1e-6;
    let mut iterations = 0;
    let ending = loop {
        if current.position.norm() <= options.position_tolerance
            && current.rotation.norm() <= options.rotation_tolerance
        {
            break Termination::Converged;
        }
        if iterations == options.max_iterations {
            break Termination::IterationLimit;
        }
        let next = match solver.step(&current, damping) {
            Some(step) => Some(solver.at(solver.within_limits(&moved(&current.joint_values, &step)))?),
            None => None,
        };
        iterations += 1;
        match next {
            Some(next) if next.cost < current.cost => {
                damping = f64::max(damping * 0.1, 1e-12);
                current = next;
            }
            // A step so damped changes nothing that a double can hold.
            _ if damping > 1e8 => break Termination::Stalled,
            _ => damping *= 10.0,
        }
    };
    let left = options.largest_change.is_some_and(|largest| {
        chain
            .joints()
            .iter()
            .zip(current.joint_values.iter().zip(start))
            .any(|(joint, (now, then))| (now - then).abs() > largest * solver.unit(joint.kind))
    });
    let termination = if ending == Termination::Converged && left { Termination::LeftStart } else { ending };
    Ok(InverseKinematics {
        position_error: current.position.norm(),
        rotation_error: current.rotation.norm(),
        joint_values: current.joint_values,
        iterations,
        termination,
    })
}

fn check(base_from_flange: &Isometry3, options: &RefinementOptions) -> Result<(), KinematicsError> {
    if let Some(value) = base_from_flange.to_homogeneous().iter().find(|value| !value.is_finite()) {
        return Err(KinematicsError::NotFinite { what: "base_from_flange".to_owned(), value: value.to_string() });
    }
    let positive = [
        ("position_tolerance", options.position_tolerance),
        ("rotation_tolerance", options.rotation_tolerance),
        ("metres_per_radian", options.metres_per_radian),
        ("largest_step", options.largest_step),
        ("largest_change", options.largest_change.unwrap_or(1.0)),
    ];
    match positive.into_iter().find(|(_, value)| !(value.is_finite() && *value > 0.0)) {
        Some((option, value)) => Err(KinematicsError::Option { option, value: value.to_string() }),
        None => Ok(()),
    }
}

fn moved(joint_values: &[f64], step: &[f64]) -> Vec<f64> {
    joint_values.iter().zip(step).map(|(value, change)| value + change).collect()
}

struct State {
    joint_values: Vec<f64>,
    jacobian: ChainJacobian,
    /// `t* - t`, metres.
    position: Vector3<f64>,
    /// `log(R* R^T)`, radians, in the base frame.
    rotation: Vector3<f64>,
    cost: f64,
}

struct Solver<'a> {
    chain: &'a SerialChain,
    base_from_flange: &'a Isometry3,
    options: &'a RefinementOptions,
}

impl Solver<'_> {
    /// What one unit of a step is: a radian, or the length that weighs as one.
    fn unit(&self, kind: JointKind) -> f64 {
        match kind {
            JointKind::Revolute => 1.0,
            JointKind::Prismatic => self.options.metres_per_radian,
        }
    }

    fn within_limits(&self, joint_values: &[f64]) -> Vec<f64> {
        let clamp = |(joint, &value): (&crate::Joint, &f64)| match (self.options.joint_limits, joint.limits) {
            (JointLimits::Respected, Some([lower, upper])) => value.clamp(lower, upper),
            _ => value,
        };
        self.chain.joints().iter().zip(joint_values).map(clamp).collect()
    }

    fn at(&self, joint_values: Vec<f64>) -> Result<State, KinematicsError> {
        let jacobian = self.chain.jacobian(&joint_values)?;
        let now = &jacobian.base_from_flange;
        let position = self.base_from_flange.translation.vector - now.translation.vector;
        let rotation = (self.base_from_flange.rotation * now.rotation.inverse()).scaled_axis();
        let cost = position.norm_squared() + (self.options.metres_per_radian * rotation).norm_squared();
        Ok(State { joint_values, jacobian, position, rotation, cost })
    }

    /// The damped step; a joint that it would take over a limit goes to the limit, and the rest is solved again.
    fn step(&self, state: &State, damping: f64) -> Option<Vec<f64>> {
        let weight = self.options.metres_per_radian;
        let flange = state.jacobian.base_from_flange.translation.vector;
        let stack = |position: Vector3<f64>, rotation: Vector3<f64>| {
            Vector6::new(
                position.x,
                position.y,
                position.z,
                weight * rotation.x,
                weight * rotation.y,
                weight * rotation.z,
            )
        };
        let joints = self.chain.joints();
        let columns: Vec<Vector6<f64>> = joints
            .iter()
            .zip(&state.jacobian.by_joint)
            .map(|(joint, twist)| {
                // The twist's v belongs to the point at the base's origin; the error is that of the flange's origin.
                let omega = Vector3::new(twist[3], twist[4], twist[5]);
                let velocity = Vector3::new(twist[0], twist[1], twist[2]) + omega.cross(&flange);
                self.unit(joint.kind) * stack(velocity, omega)
            })
            .collect();
        let mut held: Vec<Option<f64>> = vec![None; joints.len()];
        loop {
            let mut error = stack(state.position, state.rotation);
            for (column, change) in columns.iter().zip(&held) {
                error -= column * change.unwrap_or(0.0);
            }
            let free: Vec<Vector6<f64>> =
                columns.iter().zip(&held).filter(|(_, held)| held.is_none()).map(|(column, _)| *column).collect();
            let mut changes = damped_least_squares(&free, &error, damping)?.into_iter();
            let mut step: Vec<f64> =
                held.iter().map(|held| held.or_else(|| changes.next()).unwrap_or_default()).collect();
            let longest = step.iter().fold(0.0, |longest, change| f64::max(longest, change.abs()));
            if longest > self.options.largest_step {
                step.iter_mut().for_each(|change| *change *= self.options.largest_step / longest);
            }
            let mut again = false;
            for (index, joint) in joints.iter().enumerate() {
                let (JointLimits::Respected, Some([lower, upper]), None) =
                    (self.options.joint_limits, joint.limits, held[index])
                else {
                    continue;
                };
                let value = state.joint_values[index];
                let next = value + step[index] * self.unit(joint.kind);
                if next < lower || next > upper {
                    held[index] = Some((next.clamp(lower, upper) - value) / self.unit(joint.kind));
                    again = true;
                }
            }
            if !again {
                return Some(joints.iter().zip(step).map(|(joint, change)| change * self.unit(joint.kind)).collect());
            }
        }
    }
}

/// The damped least-squares solution of `J x = e`, J given by its columns. The damping is relative to the mean square
/// of a column, so that the same numbers do for an arm of any size. `None` where rounding makes the system indefinite.
fn damped_least_squares(columns: &[Vector6<f64>], error: &Vector6<f64>, damping: f64) -> Option<Vec<f64>> {
    if columns.is_empty() {
        return Some(Vec::new());
    }
    let total: f64 = columns.iter().map(Vector6::norm_squared).sum();
    let mu = damping * (total / columns.len() as f64).max(f64::MIN_POSITIVE);
    if columns.len() >= 6 {
        let normal: Matrix6<f64> = columns.iter().map(|column| column * column.transpose()).sum();
        let reaction = (normal + Matrix6::identity() * mu).cholesky()?.solve(error);
        return Some(columns.iter().map(|column| column.dot(&reaction)).collect());
    }
    let mut normal = DMatrix::from_fn(columns.len(), columns.len(), |i, j| columns[i].dot(&columns[j]));
    (0..columns.len()).for_each(|index| normal[(index, index)] += mu);
    let gradient = DVector::from_iterator(columns.len(), columns.iter().map(|column| column.dot(error)));
    Some(normal.cholesky()?.solve(&gradient).iter().copied().collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arms::{distance_from_singularity, hp3j, perturbed, seven_joints, ur5e};
    use crate::{Joint, Link, SphericalWristSolution, nearby, spherical_wrist_solutions};
    use proptest::prelude::*;
    use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};

    /// Numbers in [-1, 1] that are the same in every run.
    fn numbers(count: usize) -> Vec<f64> {
        let mut runner = TestRunner::new_with_rng(Config::default(), TestRng::deterministic_rng(RngAlgorithm::ChaCha));
        let tree = prop::collection::vec(-1.0..1.0f64, count).new_tree(&mut runner).unwrap();
        proptest::strategy::ValueTree::current(&tree)
    }

    fn error(chain: &SerialChain, joint_values: &[f64], pose: &Isometry3) -> f64 {
        (chain.base_from_flange(joint_values).unwrap().to_homogeneous() - pose.to_homogeneous()).norm()
    }

    #[test]
    fn nominal_branches_refine_on_a_perturbed_arm() {
        let (nominal, draws) = (hp3j(), numbers(300 * 30));
        let (mut near_all, mut near_converged, mut all, mut iterations, mut furthest) = (0, 0, 0, 0, 0.0_f64);
        for draw in draws.chunks_exact(30) {
            let real = perturbed(&nominal, 1f64.to_radians(), 1e-3, &draw[6..]);
            let values: Vec<f64> = draw[..6].iter().map(|x| 3.1 * x).collect();
            let pose = nominal.base_from_flange(&values).unwrap();
            for SphericalWristSolution { joint_values, .. } in spherical_wrist_solutions(&nominal, &pose).unwrap() {
                let got =
                    refine_inverse_kinematics(&real, &pose, &joint_values, &RefinementOptions::default()).unwrap();
                all += usize::from(got.termination == Termination::Converged);
                if distance_from_singularity(&nominal, &joint_values) < 0.02 {
                    continue;
                }
                near_all += 1;
                if got.termination == Termination::Converged {
                    near_converged += 1;
                    iterations += got.iterations;
                    assert!(error(&real, &got.joint_values, &pose) < 1e-9);
                    let change = got.joint_values.iter().zip(&joint_values).map(|(a, b)| (a - b).abs());
                    furthest = change.fold(furthest, f64::max);
                }
            }
        }
        println!(
            "away from singularities {near_converged} of {near_all} converged, {:.2} iterations, furthest joint \
             {:.1} deg from its start; of all branches {all} of {}",
            iterations as f64 / near_converged as f64,
            furthest.to_degrees(),
            300 * 8,
        );
        assert!(near_all > 1000);
        assert!(near_converged as f64 >= 0.98 * near_all as f64, "{near_converged} of {near_all}");
    }

    #[test]
    fn other_arms_refine_from_nearby() {
        for (name, chain) in [("UR5e", ur5e()), ("seven joints", seven_joints())] {
            for draw in numbers(50 * 14).chunks_exact(14) {
                let values: Vec<f64> = draw[..chain.joint_count()].iter().map(|x| 2.5 * x).collect();
                let start: Vec<f64> = values.iter().zip(&draw[7..]).map(|(q, x)| q + 0.05 * x).collect();
                let pose = chain.base_from_flange(&values).unwrap();
                let options = RefinementOptions { largest_change: None, ..Default::default() };
                let got = refine_inverse_kinematics(&chain, &pose, &start, &options).unwrap();
                assert_eq!(got.termination, Termination::Converged, "{name} {got:?}");
                assert!(error(&chain, &got.joint_values, &pose) < 1e-9);
                if chain.joint_count() == 7 {
                    // The redundant arm has no reason to go far.
                    let change = got.joint_values.iter().zip(&start).map(|(a, b)| (a - b).abs());
                    assert!(change.fold(0.0, f64::max) < 0.6, "{got:?}");
                }
            }
        }
    }

    #[test]
    fn a_joint_at_its_limit_is_held_and_the_redundant_arm_makes_up_for_it() {
        let free = seven_joints();
        let values = [0.3, 0.7, -0.4, -1.5, 0.5, 1.2, 0.2];
        let start: Vec<f64> = values.iter().map(|q| q + 0.1).collect();
        let pose = free.base_from_flange(&values).unwrap();
        let got = refine_inverse_kinematics(&free, &pose, &start, &RefinementOptions::default()).unwrap();
        assert_eq!(got.termination, Termination::Converged);
        // Forbid joint 3 what it did.
        let mut joints = free.joints().to_vec();
        joints[2].limits = Some([got.joint_values[2] + 0.03, 3.0]);
        let limited = SerialChain::new(joints).unwrap();
        let options = RefinementOptions { joint_limits: JointLimits::Respected, ..Default::default() };
        let held = refine_inverse_kinematics(&limited, &pose, &start, &options).unwrap();
        assert_eq!(held.termination, Termination::Converged, "{held:?}");
        assert!(limited.admits(&held.joint_values));
        assert!(error(&free, &held.joint_values, &pose) < 1e-9);
        // Six joints have no other way.
        let arm = hp3j();
        let pose = arm.base_from_flange(&values[..6]).unwrap();
        let mut joints = arm.joints().to_vec();
        joints[2].limits = Some([-0.35, 3.0]);
        let limited = SerialChain::new(joints).unwrap();
        let stuck = refine_inverse_kinematics(&limited, &pose, &start[..6], &options).unwrap();
        assert!(matches!(stuck.termination, Termination::Stalled | Termination::IterationLimit), "{stuck:?}");
        assert!(limited.admits(&stuck.joint_values));
        assert!(stuck.position_error > 1e-4);
    }

    #[test]
    fn out_of_reach_ends_with_its_error() {
        let arm = hp3j();
        let pose = Isometry3::translation(5.0, 0.0, 0.0);
        let got = refine_inverse_kinematics(&arm, &pose, &[0.1; 6], &RefinementOptions::default()).unwrap();
        assert!(matches!(got.termination, Termination::Stalled | Termination::IterationLimit), "{got:?}");
        assert!(got.position_error > 4.0);
    }

    #[test]
    fn another_branch_is_reported() {
        let arm = hp3j();
        let pose = arm.base_from_flange(&[0.3, 0.2, -0.4, 0.5, 0.9, 0.2]).unwrap();
        let options = RefinementOptions { largest_change: Some(0.01), ..Default::default() };
        let got = refine_inverse_kinematics(&arm, &pose, &[0.35, 0.2, -0.4, 0.5, 0.9, 0.2], &options).unwrap();
        assert_eq!(got.termination, Termination::LeftStart);
    }

    #[test]
    fn fewer_than_six_joints_and_prismatic_ones() {
        let slide = Joint { kind: JointKind::Prismatic, ..Joint::revolute("2", Link::modified_dh(1.0, 0.2, 0.3, 0.0)) };
        let chain = SerialChain::new(vec![
            Joint::revolute("1", Link::modified_dh(0.0, 0.0, 0.0, 0.3)),
            slide,
            Joint::revolute("3", Link::modified_dh(-0.7, 0.1, 0.0, 0.1)),
        ])
        .unwrap();
        let pose = chain.base_from_flange(&[0.4, 0.25, -0.8]).unwrap();
        let got = refine_inverse_kinematics(&chain, &pose, &[0.2, 0.2, -0.6], &RefinementOptions::default()).unwrap();
        assert_eq!(got.termination, Termination::Converged);
        assert!(got.joint_values.iter().zip([0.4, 0.25, -0.8]).all(|(a, b)| (a - b).abs() < 1e-8));
    }

    #[test]
    fn wrong_input_is_named() {
        let arm = hp3j();
        let pose = Isometry3::identity();
        let with = |options: RefinementOptions, start: &[f64], pose: &Isometry3| {
            refine_inverse_kinematics(&arm, pose, start, &options).unwrap_err().to_string()
        };
        assert!(with(Default::default(), &[0.0; 5], &pose).contains("6 joints, got 5"));
        let nowhere = Isometry3::translation(f64::NAN, 0.0, 0.0);
        assert!(with(Default::default(), &[0.0; 6], &nowhere).contains("base_from_flange is NaN"));
        let options = RefinementOptions { largest_step: 0.0, ..Default::default() };
        assert!(with(options, &[0.0; 6], &pose).contains("largest_step is 0"));
    }

    proptest! {
        #[test]
        fn wrapping_of_the_start_is_kept(wraps in prop::collection::vec(-2..=2i32, 6)) {
            let arm = hp3j();
            let values = [0.3, 0.2, -0.4, 0.5, 0.9, 0.2];
            let pose = arm.base_from_flange(&values).unwrap();
            let start: Vec<f64> = values.iter().zip(&wraps).map(|(q, wraps)| q + 0.01 + std::f64::consts::TAU * f64::from(*wraps)).collect();
            let got = refine_inverse_kinematics(&arm, &pose, &start, &RefinementOptions::default()).unwrap();
            prop_assert_eq!(got.termination, Termination::Converged);
            let near = nearby(&SerialChain::new(arm.joints().iter().cloned().map(|joint| Joint { limits: None, ..joint }).collect()).unwrap(), &values, &start).unwrap().unwrap();
            prop_assert!(got.joint_values.iter().zip(&near).all(|(a, b)| (a - b).abs() < 1e-7));
        }
    }
}
