//! Targets for a controller that accepts no parameters: what to command so that the true arm goes where it should.
//!
//! A target is a flange pose, or joint values that mean the pose that the nominal arm has there. Inverse kinematics
//! on the calibrated chain, begun at the nominal solution, gives the joints to command; for a controller that takes
//! poses only, the nominal chain's pose at these joints is the pose to command, since the controller will find the
//! same joints from it.

mod table;

pub use table::{CompensationError, Target, TargetTable, read_targets, write_compensated};

use nalgebra::Unit;
use serde::{Deserialize, Serialize};
use skclam_kinematics::{
    Isometry3, JointKind, JointLimits, KinematicsError, RefinementOptions, SerialChain, Termination, nearby,
    refine_inverse_kinematics, spherical_wrist_solutions,
};
use skclam_rig::{JointCorrections, joint_readings};

/// Options of a compensation.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CompensationOptions {
    /// The refinement on the calibrated chain. Its `largest_change` keeps the branch of the nominal solution.
    pub refinement: RefinementOptions,
}

/// What to command for one target.
#[derive(Debug, Clone, PartialEq)]
pub struct Compensated {
    /// The flange pose that is wanted.
    pub base_from_flange: Isometry3,
    /// Joints that reach it on the nominal arm, radians or metres.
    pub nominal_joints: Vec<f64>,
    /// What the encoders must say for the calibrated arm to be there: to be commanded.
    pub joints: Vec<f64>,
    /// Pose to be commanded where the controller takes poses and thinks the arm nominal.
    pub commanded_pose: Isometry3,
}

/// The arm as it is: its chain, and what its joints do beside their encoders.
#[derive(Debug, Clone, Copy)]
pub struct TrueArm<'a> {
    /// The calibrated chain.
    pub chain: &'a SerialChain,
    /// Corrections of its joints; the time offset does not matter to an arm at rest.
    pub joint_corrections: &'a JointCorrections,
}

impl<'a> From<&'a SerialChain> for TrueArm<'a> {
    fn from(chain: &'a SerialChain) -> Self {
        static NONE: JointCorrections = JointCorrections { joints: Vec::new(), time_offset_s: 0.0 };
        TrueArm { chain, joint_corrections: &NONE }
    }
}

impl TrueArm<'_> {
    /// Where the flange comes to rest for commanded joint values.
    ///
    /// # Errors
    /// What the arm refuses of the joint values.
    pub fn base_from_flange(&self, commanded: &[f64]) -> Result<Isometry3, KinematicsError> {
        self.chain.base_from_flange(&self.joint_corrections.applied(&joint_readings(self.chain, commanded, &[])?))
    }
}

/// Why there is nothing to command for a target.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TargetProblem {
    /// Wrong number of joints, numbers that are not finite.
    #[error(transparent)]
    Kinematics(#[from] KinematicsError),
    /// The nominal arm does not get there.
    #[error("the nominal arm does not reach the pose: {closest_mm:.3} mm and {closest_deg:.4} deg are missing at best")]
    NominalOutOfReach {
        /// What is missing at best, millimetres.
        closest_mm: f64,
        /// What is missing at best, degrees.
        closest_deg: f64,
    },
    /// The calibrated arm does not get there on the nominal solution's branch.
    #[error(
        "the calibrated arm does not reach the pose near the nominal solution: {missing_mm:.3} mm and {missing_deg:.4} deg are missing; {reason}"
    )]
    CalibratedOutOfReach {
        /// Why, as far as is known.
        reason: String,
        /// What is missing, millimetres.
        missing_mm: f64,
        /// What is missing, degrees.
        missing_deg: f64,
    },
}

/// Compensates targets one after the other: where a pose leaves a choice of branches, the one nearest to the target
/// before is taken, so that a path stays a path.
#[derive(Debug, Clone)]
pub struct Compensator<'a> {
    nominal: &'a SerialChain,
    calibrated: TrueArm<'a>,
    options: &'a CompensationOptions,
    last: Option<Vec<f64>>,
}

impl<'a> Compensator<'a> {
    /// For an arm by its nominal chain and what it is by its calibration.
    ///
    /// # Errors
    /// [`KinematicsError::JointCount`] if they differ in the number of joints.
    pub fn new(
        nominal: &'a SerialChain,
        calibrated: impl Into<TrueArm<'a>>,
        options: &'a CompensationOptions,
    ) -> Result<Self, KinematicsError> {
        let calibrated = calibrated.into();
        let (need, got) = (nominal.joint_count(), calibrated.chain.joint_count());
        if need != got {
            return Err(KinematicsError::JointCount { need, got });
        }
        Ok(Compensator { nominal, calibrated, options, last: None })
    }

    /// For joint values of the nominal arm, radians or metres.
    pub fn joints(&mut self, nominal_joints: &[f64]) -> Result<Compensated, TargetProblem> {
        let base_from_flange = self.nominal.base_from_flange(nominal_joints)?;
        self.near(base_from_flange, nominal_joints.to_vec())
    }

    /// For a flange pose, metres. `near`: joints to stay near to, where the caller knows.
    pub fn pose(&mut self, base_from_flange: &Isometry3, near: Option<&[f64]>) -> Result<Compensated, TargetProblem> {
        let (reference, branch_is_free) = match (near, &self.last) {
            (Some(near), _) => (near.to_vec(), false),
            (None, Some(last)) => (last.clone(), false),
            (None, None) => (middle(self.nominal), true),
        };
        let solutions = nominal_solutions(self.nominal, base_from_flange, &reference)?;
        // Where nothing says which branch is meant, one that ends at a joint limit is left for the next.
        let tried = if branch_is_free { solutions.len() } else { 1 };
        let mut first_problem = None;
        for nominal_joints in solutions.into_iter().take(tried) {
            match self.near(*base_from_flange, nominal_joints) {
                Ok(answer) => return Ok(answer),
                Err(problem) => first_problem = first_problem.or(Some(problem)),
            }
        }
        Err(first_problem.unwrap_or(TargetProblem::NominalOutOfReach { closest_mm: 0.0, closest_deg: 0.0 }))
    }

    fn reason(&self, joints: &[f64], termination: Termination) -> String {
        let held: Vec<&str> = self
            .calibrated
            .chain
            .joints()
            .iter()
            .zip(joints)
            .filter(|(joint, value)| joint.limits.is_some_and(|limits| limits.contains(value)))
            .map(|(joint, _)| joint.name.as_str())
            .collect();
        match (held.is_empty(), termination) {
            (false, _) => format!("joint {} is at its limit", held.join(", ")),
            (true, Termination::LeftStart) => {
                "the solution is on another branch: the pose is nearly singular".to_owned()
            }
            (true, _) => "the pose is at the edge of reach or nearly singular".to_owned(),
        }
    }

    fn near(&mut self, base_from_flange: Isometry3, nominal_joints: Vec<f64>) -> Result<Compensated, TargetProblem> {
        // A controller refuses what is beyond a limit, unless the target itself was.
        let joint_limits =
            if self.nominal.admits(&nominal_joints) { JointLimits::Respected } else { JointLimits::Ignored };
        let options = RefinementOptions { joint_limits, ..self.options.refinement.clone() };
        let found = refine_inverse_kinematics(self.calibrated.chain, &base_from_flange, &nominal_joints, &options)?;
        if found.termination != Termination::Converged {
            return Err(TargetProblem::CalibratedOutOfReach {
                reason: self.reason(&found.joint_values, found.termination),
                missing_mm: found.position_error * 1e3,
                missing_deg: found.rotation_error.to_degrees(),
            });
        }
        let TrueArm { chain, joint_corrections } = self.calibrated;
        let joints = joint_corrections.encoder_values(chain, &found.joint_values)?;
        let commanded_pose = self.nominal.base_from_flange(&joints)?;
        self.last = Some(nominal_joints.clone());
        Ok(Compensated { base_from_flange, nominal_joints, joints, commanded_pose })
    }
}

/// The middle of each joint's range; 0 where it has no limits.
fn middle(chain: &SerialChain) -> Vec<f64> {
    chain.joints().iter().map(|joint| joint.limits.map_or(0.0, |[lower, upper]| 0.5 * (lower + upper))).collect()
}

/// Joints that reach a pose on the nominal arm, those nearest to a reference first, at least one: in closed form where
/// there is one, else by searches from the reference and from points spread over the joints' ranges.
fn nominal_solutions(
    chain: &SerialChain,
    base_from_flange: &Isometry3,
    reference: &[f64],
) -> Result<Vec<Vec<f64>>, TargetProblem> {
    chain.base_from_flange(reference)?;
    if let Ok(solutions) = spherical_wrist_solutions(chain, base_from_flange) {
        let mut candidates = Vec::new();
        for solution in solutions {
            candidates.extend(nearby(chain, &solution.joint_values, reference)?);
        }
        let ordered = nearest_first(chain, candidates, reference);
        if !ordered.is_empty() {
            return Ok(ordered);
        }
    }
    searched(chain, base_from_flange, reference)
}

/// The most searches for one pose.
const SEARCHES: u32 = 48;

fn searched(
    chain: &SerialChain,
    base_from_flange: &Isometry3,
    reference: &[f64],
) -> Result<Vec<Vec<f64>>, TargetProblem> {
    let options = RefinementOptions { largest_change: None, ..RefinementOptions::default() };
    let mut closest = (f64::INFINITY, f64::INFINITY);
    let mut candidates = Vec::new();
    for search in 0..SEARCHES {
        let start = if search == 0 { reference.to_vec() } else { spread(chain, reference, search) };
        let found = refine_inverse_kinematics(chain, base_from_flange, &start, &options)?;
        if found.termination == Termination::Converged {
            candidates.extend(nearby(chain, &found.joint_values, reference)?);
            // The one that was led to from the reference is on its branch.
            if search == 0 && !candidates.is_empty() {
                break;
            }
        } else if found.position_error + found.rotation_error < closest.0 + closest.1 {
            closest = (found.position_error, found.rotation_error);
        }
    }
    let ordered = nearest_first(chain, candidates, reference);
    if !ordered.is_empty() {
        return Ok(ordered);
    }
    Err(TargetProblem::NominalOutOfReach {
        closest_mm: if closest.0.is_finite() { closest.0 * 1e3 } else { 0.0 },
        closest_deg: if closest.1.is_finite() { closest.1.to_degrees() } else { 0.0 },
    })
}

/// The n-th point of a Halton sequence over the joints' ranges.
fn spread(chain: &SerialChain, reference: &[f64], n: u32) -> Vec<f64> {
    const PRIMES: [u32; 8] = [2, 3, 5, 7, 11, 13, 17, 19];
    let radical_inverse = |base: u32| {
        let (mut value, mut weight, mut rest) = (0.0, 1.0, n);
        while rest > 0 {
            weight /= f64::from(base);
            value += weight * f64::from(rest % base);
            rest /= base;
        }
        value
    };
    chain
        .joints()
        .iter()
        .zip(reference)
        .enumerate()
        .map(|(index, (joint, &reference))| {
            let around = if joint.kind == JointKind::Revolute { std::f64::consts::PI } else { 0.5 };
            let [lower, upper] = joint.limits.unwrap_or([reference - around, reference + around]);
            lower + (upper - lower) * radical_inverse(PRIMES[index % PRIMES.len()])
        })
        .collect()
}

fn nearest_first(chain: &SerialChain, mut candidates: Vec<Vec<f64>>, reference: &[f64]) -> Vec<Vec<f64>> {
    // A metre of a slide weighs as a radian.
    let distance = |joints: &[f64]| joints.iter().zip(reference).map(|(a, b)| (a - b).powi(2)).sum::<f64>();
    candidates.retain(|joints| chain.admits(joints));
    candidates.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
    candidates
}

/// Position (metres) and orientation (radians) by which a reached pose misses the wanted one.
pub fn miss(wanted: &Isometry3, reached: &Isometry3) -> (f64, f64) {
    let turn = Unit::new_normalize((wanted.rotation.inverse() * reached.rotation).into_inner());
    let angle = 2.0 * turn.imag().norm().atan2(turn.w.abs());
    ((wanted.translation.vector - reached.translation.vector).norm(), angle)
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_rig::JointCorrection;
    use skclam_rig::builtin_rig;
    use skclam_simulation::{PerturbationSigmas, perturb_random};

    fn arms(name: &str, calibration_error: f64) -> (SerialChain, SerialChain, SerialChain) {
        let nominal = builtin_rig(name).unwrap().unwrap();
        let truth = perturb_random(&nominal, 7, &PerturbationSigmas::default()).unwrap();
        let left = PerturbationSigmas {
            angle_deg: 0.5 * calibration_error,
            length_mm: calibration_error,
            ..PerturbationSigmas::default()
        };
        let calibrated = perturb_random(&truth, 8, &left).unwrap();
        (nominal.robot.unwrap(), calibrated.robot.unwrap(), truth.robot.unwrap())
    }

    /// Postures spread over the middle of the joints' ranges, away from singular ones: a stretched elbow is at the edge
    /// of reach, and a shorter true arm cannot get where the nominal one is.
    fn postures(chain: &SerialChain, count: usize) -> Vec<Vec<f64>> {
        let centre = middle(chain);
        (1..)
            .map(|n| {
                let spread = spread(chain, &centre, n);
                centre.iter().zip(spread).map(|(centre, value)| centre + 0.5 * (value - centre)).collect()
            })
            .filter(|joints: &Vec<f64>| {
                let twists = chain.jacobian(joints).unwrap().by_joint;
                let flange = chain.base_from_flange(joints).unwrap().translation.vector;
                let gram: nalgebra::Matrix6<f64> = twists
                    .iter()
                    .map(|twist| {
                        let (v, omega) = (twist.fixed_rows::<3>(0).into_owned(), twist.fixed_rows::<3>(3).into_owned());
                        let at_flange = v + omega.cross(&flange);
                        let column = nalgebra::Vector6::new(
                            at_flange.x,
                            at_flange.y,
                            at_flange.z,
                            0.3 * omega.x,
                            0.3 * omega.y,
                            0.3 * omega.z,
                        );
                        column * column.transpose()
                    })
                    .sum();
                gram.symmetric_eigenvalues().min() > 0.05f64.powi(2)
            })
            .take(count)
            .collect()
    }

    /// Root mean squares of the positions' errors on the true arm, nominal and compensated, metres.
    fn errors(name: &str, by_pose: bool, calibration_error: f64) -> (f64, f64) {
        let (nominal, calibrated, truth) = arms(name, calibration_error);
        let options = CompensationOptions::default();
        let mut compensator = Compensator::new(&nominal, &calibrated, &options).unwrap();
        let (mut before, mut after) = (0.0, 0.0);
        let postures = postures(&nominal, 100);
        for joints in &postures {
            let wanted = nominal.base_from_flange(joints).unwrap();
            let answer = match by_pose {
                true => compensator.pose(&wanted, Some(&joints.iter().map(|value| value + 0.05).collect::<Vec<_>>())),
                false => compensator.joints(joints),
            }
            .unwrap();
            let reached = |joints: &[f64]| truth.base_from_flange(joints).unwrap();
            before += miss(&wanted, &reached(&answer.nominal_joints)).0.powi(2);
            after += miss(&wanted, &reached(&answer.joints)).0.powi(2);
            // A controller that takes poses finds the same joints from the commanded one.
            let again = nominal.base_from_flange(&answer.joints).unwrap();
            assert!(miss(&again, &answer.commanded_pose).0 < 1e-12);
        }
        let count = postures.len() as f64;
        ((before / count).sqrt(), (after / count).sqrt())
    }

    #[test]
    fn compensated_targets_are_reached_fifty_times_better() {
        for (name, by_pose) in [("hp3j", true), ("hp3j", false), ("ur5e", true), ("franka-fr3", false)] {
            // A calibration that leaves 1 % of the errors.
            let (before, after) = errors(name, by_pose, 0.01);
            println!("{name}: {:.3} mm nominal, {:.4} mm compensated", before * 1e3, after * 1e3);
            assert!(before > 2e-3 && before / after >= 50.0, "{name}: {before} to {after}");
        }
        let (_, exact) = errors("hp3j", true, 0.0);
        assert!(exact < 1e-9, "{exact}");
    }

    #[test]
    fn gears_and_bending_are_compensated_too() {
        let (nominal, calibrated, _) = arms("hp3j", 0.0);
        let one = JointCorrection { transmission_sin: 2e-3, transmission_cos: -1e-3, compliance: 3e-3 };
        let joint_corrections = JointCorrections { joints: vec![one; 6], time_offset_s: 0.0 };
        let truth = TrueArm { chain: &calibrated, joint_corrections: &joint_corrections };
        let options = CompensationOptions::default();
        let mut compensator = Compensator::new(&nominal, truth, &options).unwrap();
        for joints in postures(&nominal, 20) {
            let answer = compensator.joints(&joints).unwrap();
            let reached = truth.base_from_flange(&answer.joints).unwrap();
            assert!(miss(&answer.base_from_flange, &reached).0 < 1e-9);
            assert!(miss(&reached, &calibrated.base_from_flange(&answer.joints).unwrap()).0 > 1e-4);
        }
    }

    #[test]
    fn a_path_stays_on_its_branch() {
        let (nominal, calibrated, _) = arms("hp3j", 0.0);
        let options = CompensationOptions::default();
        let mut compensator = Compensator::new(&nominal, &calibrated, &options).unwrap();
        let mut last: Option<Vec<f64>> = None;
        for step in 0..100 {
            let t = f64::from(step) / 100.0;
            let joints = [0.2 + t, 0.3 + 0.3 * t, -0.8 - 0.2 * t, 0.3 + t, 0.9, -1.5 * t];
            let wanted = nominal.base_from_flange(&joints).unwrap();
            let answer = compensator.pose(&wanted, (step == 0).then_some(&joints[..])).unwrap();
            let jump = last.iter().flatten().zip(&answer.joints).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(jump < 0.03, "step {step}: {jump}");
            last = Some(answer.joints);
        }
    }

    #[test]
    fn what_cannot_be_reached_is_reported() {
        let (nominal, calibrated, _) = arms("hp3j", 0.0);
        let options = CompensationOptions::default();
        let mut compensator = Compensator::new(&nominal, &calibrated, &options).unwrap();
        let far = Isometry3::translation(5.0, 0.0, 0.0);
        let message = compensator.pose(&far, None).unwrap_err().to_string();
        assert!(message.starts_with("the nominal arm does not reach the pose"), "{message}");
        assert!(compensator.joints(&[0.0; 5]).is_err());
        assert!(compensator.pose(&Isometry3::translation(f64::NAN, 0.0, 0.0), None).is_err());
    }
}
