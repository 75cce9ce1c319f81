//! What joints do beside their encoders: eccentric gears, joints that give way under the arm's weight, a clock that is
//! late.
//!
//! All of it is linear in the numbers of [`JointCorrections`]; what multiplies them is a [`JointReading`].

use crate::{Posture, PostureState};
use nalgebra::Vector3;
use skclam_kinematics::{KinematicsError, SerialChain};

/// Where one joint truly is: `q + transmission_sin sin(q) + transmission_cos cos(q) + compliance * gravity_arm`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointCorrection {
    /// Radians.
    pub transmission_sin: f64,
    /// Radians.
    pub transmission_cos: f64,
    /// Radians per metre of gravity torque arm.
    pub compliance: f64,
}

/// Corrections of all joints. The default is none.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct JointCorrections {
    /// One a joint, or empty for none.
    pub joints: Vec<JointCorrection>,
    /// Seconds by which the joints must be taken later than the posture's timestamp says.
    pub time_offset_s: f64,
}

/// What multiplies the corrections of one joint in one posture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointReading {
    /// The encoder's value, radians or metres.
    pub value: f64,
    /// Its change a second.
    pub rate: f64,
    /// Torque about the axis of a unit weight at the flange, metres; the base's z points up.
    pub gravity_arm: f64,
}

/// The readings of a posture; a joint whose rate is not known is at rest.
///
/// # Errors
/// What the arm refuses of the joint values.
pub fn joint_readings(arm: &SerialChain, values: &[f64], rates: &[f64]) -> Result<Vec<JointReading>, KinematicsError> {
    let jacobian = arm.jacobian(values)?;
    let flange = jacobian.base_from_flange.translation.vector;
    let reading = |(joint, &value): (usize, &f64)| {
        let twist = jacobian.by_joint[joint];
        let omega = Vector3::new(twist[3], twist[4], twist[5]);
        let gravity_arm = -(twist[2] + omega.cross(&flange).z);
        JointReading { value, rate: rates.get(joint).copied().unwrap_or(0.0), gravity_arm }
    };
    Ok(values.iter().enumerate().map(reading).collect())
}

/// Fills in the rates of postures in the order of a recording, from the values and timestamps of their neighbours.
/// Where these do not give them, there are none.
pub fn fill_joint_rates<'a>(postures: impl IntoIterator<Item = &'a mut Posture>) {
    let mut postures: Vec<&mut Posture> = postures.into_iter().collect();
    let joints_of = |posture: &Posture| match &posture.state {
        PostureState::Joints(values) => Some((posture.timestamp_s?, values.clone())),
        PostureState::FlangePose(_) => None,
    };
    let known: Vec<_> = postures.iter().map(|posture| joints_of(posture)).collect();
    for (at, posture) in postures.iter_mut().enumerate() {
        let (before, after) = (&known[at.saturating_sub(1)], &known[(at + 1).min(known.len() - 1)]);
        posture.joint_rates = match (before, after) {
            (Some((t0, q0)), Some((t1, q1))) if t1 > t0 && q0.len() == q1.len() => {
                q0.iter().zip(q1).map(|(q0, q1)| (q1 - q0) / (t1 - t0)).collect()
            }
            _ => Vec::new(),
        };
    }
}

impl JointCorrections {
    /// Whether there is nothing to correct.
    pub fn is_none(&self) -> bool {
        self.time_offset_s == 0.0 && self.joints.iter().all(|joint| *joint == JointCorrection::default())
    }

    /// Of one joint.
    pub fn of(&self, joint: usize) -> JointCorrection {
        self.joints.get(joint).copied().unwrap_or_default()
    }

    /// Where the joints truly are.
    pub fn applied(&self, readings: &[JointReading]) -> Vec<f64> {
        let correct = |(joint, reading): (usize, &JointReading)| {
            let own = self.of(joint);
            let gear = own.transmission_sin * reading.value.sin() + own.transmission_cos * reading.value.cos();
            reading.value + gear + own.compliance * reading.gravity_arm + self.time_offset_s * reading.rate
        };
        readings.iter().enumerate().map(correct).collect()
    }

    /// What the encoders of an arm at rest say where its joints truly are at `values`: the inverse of
    /// [`JointCorrections::applied`].
    ///
    /// # Errors
    /// What the arm refuses of the joint values.
    pub fn encoder_values(&self, arm: &SerialChain, values: &[f64]) -> Result<Vec<f64>, KinematicsError> {
        // Corrections are small and smooth, so that each round gains a factor of about their size.
        const MAX_ROUNDS: usize = 30;
        let mut encoders = values.to_vec();
        if self.joints.is_empty() {
            return Ok(encoders);
        }
        for _ in 0..MAX_ROUNDS {
            let reached = self.applied(&joint_readings(arm, &encoders, &[])?);
            let mut largest = 0f64;
            for ((encoder, reached), wanted) in encoders.iter_mut().zip(reached).zip(values) {
                *encoder += wanted - reached;
                largest = largest.max((wanted - reached).abs());
            }
            if largest < 1e-14 {
                break;
            }
        }
        Ok(encoders)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::builtin_rig;

    fn corrections() -> JointCorrections {
        let one = |k: f64| JointCorrection {
            transmission_sin: 1e-3 * k,
            transmission_cos: -5e-4,
            compliance: 2e-3 / (k + 1.0),
        };
        JointCorrections { joints: (0..6).map(|k| one(f64::from(k))).collect(), time_offset_s: 0.0 }
    }

    #[test]
    fn encoders_say_what_puts_the_joints_where_they_are() {
        let rig = builtin_rig("hp3j").unwrap().unwrap();
        let arm = rig.robot.as_ref().unwrap();
        let values = [0.3, -0.4, 0.5, 1.1, -0.7, 2.0];
        let encoders = corrections().encoder_values(arm, &values).unwrap();
        assert!(encoders.iter().zip(values).any(|(encoder, value)| (encoder - value).abs() > 1e-3));
        let reached = corrections().applied(&joint_readings(arm, &encoders, &[]).unwrap());
        for (reached, wanted) in reached.iter().zip(values) {
            assert!((reached - wanted).abs() < 1e-13);
        }
        assert_eq!(JointCorrections::default().encoder_values(arm, &values).unwrap(), values);
    }

    #[test]
    fn the_gravity_torque_arm_of_an_upright_axis_is_zero_and_of_a_level_one_the_reach() {
        let rig = builtin_rig("hp3j").unwrap().unwrap();
        let arm = rig.robot.as_ref().unwrap();
        let values = [0.0, 0.3, 0.2, 0.0, 0.1, 0.0];
        let readings = joint_readings(arm, &values, &[]).unwrap();
        assert!(readings[0].gravity_arm.abs() < 1e-12);
        // By how much the flange sinks as the joint turns.
        let height = |change: f64| {
            let mut moved = values;
            moved[1] += change;
            arm.base_from_flange(&moved).unwrap().translation.vector.z
        };
        assert!((readings[1].gravity_arm + (height(1e-6) - height(-1e-6)) / 2e-6).abs() < 1e-8);
        assert!(readings[1].gravity_arm.abs() > 0.05);
    }

    #[test]
    fn rates_come_from_the_neighbours_where_these_give_them() {
        let posture = |at: u64, timestamp_s, value: f64| Posture {
            index: at,
            timestamp_s,
            state: PostureState::Joints(vec![value]),
            joint_rates: Vec::new(),
        };
        let mut postures = [posture(0, Some(1.0), 0.0), posture(1, Some(2.0), 0.2), posture(2, Some(4.0), 0.9)];
        fill_joint_rates(&mut postures);
        assert!((postures[0].joint_rates[0] - 0.2).abs() < 1e-12);
        assert!((postures[1].joint_rates[0] - 0.3).abs() < 1e-12);
        postures[2].timestamp_s = None;
        fill_joint_rates(&mut postures);
        assert_eq!((postures[0].joint_rates.len(), postures[1].joint_rates.len()), (1, 0));
        fill_joint_rates([]);
    }
}
