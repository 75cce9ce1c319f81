//! The laser experiment of section 4.2.3 and Fig. 8, in simulation.
//!
//! One flange pose can be reached by eight postures. A controller with wrong parameters sends the arm to eight
//! slightly different places instead of one; a displacement sensor that looks at the end effector along X, Y and Z
//! sees the spread. No ground truth is needed, which is why the paper used it on the real arm.

use crate::SimulationError;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use skclam_kinematics::{
    RefinementOptions, SerialChain, Termination, refine_inverse_kinematics, spherical_wrist_solutions,
};

/// How the experiment is made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LaserOptions {
    /// Flange positions in base, millimetres; the paper has five.
    pub positions_mm: Vec<[f64; 3]>,
    /// Flange orientations beside them: rotation vectors in degrees applied to a flange that points straight down.
    pub rotations_deg: Vec<[f64; 3]>,
    /// Resolution of the sensor, millimetres; the paper's SUNX HL-C135C-BK10: 0.010.
    pub resolution_mm: f64,
}

impl Default for LaserOptions {
    fn default() -> Self {
        LaserOptions {
            positions_mm: vec![
                [280.0, 0.0, 330.0],
                [250.0, 160.0, 380.0],
                [220.0, -200.0, 300.0],
                [330.0, 90.0, 260.0],
                [180.0, 230.0, 420.0],
            ],
            rotations_deg: vec![
                [20.0, -35.0, 0.0],
                [-15.0, -30.0, 40.0],
                [35.0, 15.0, -30.0],
                [10.0, -50.0, 70.0],
                [-30.0, 20.0, 110.0],
            ],
            resolution_mm: 0.010,
        }
    }
}

/// Standard deviations at one flange pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LaserPose {
    /// Postures that reached the pose on the nominal and on the calibrated chain.
    pub postures: [usize; 2],
    /// Standard deviation of the readings in X, Y, Z with the nominal parameters, millimetres.
    pub nominal_sd_mm: [f64; 3],
    /// The same with the calibrated parameters.
    pub calibrated_sd_mm: [f64; 3],
}

/// Fig. 8: before and after, a pose at a time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaserExperiment {
    /// One entry a flange pose.
    pub poses: Vec<LaserPose>,
}

impl LaserExperiment {
    /// Mean of the standard deviations over poses and directions, before and after, millimetres.
    pub fn mean_sd_mm(&self) -> [f64; 2] {
        let mean = |take: fn(&LaserPose) -> &[f64; 3]| {
            let values = self.poses.iter().flat_map(|pose| take(pose).iter());
            values.sum::<f64>() / (3 * self.poses.len().max(1)) as f64
        };
        [mean(|pose| &pose.nominal_sd_mm), mean(|pose| &pose.calibrated_sd_mm)]
    }
}

/// Sends the true arm to five flange poses by the eight solutions of the nominal and of the calibrated chain, and
/// reads where the flange is.
///
/// The closed-form solutions of the nominal chain are the starts of a numerical refinement on each chain (a calibrated
/// chain has no closed form). A solution that does not converge is left out and not counted.
///
/// # Errors
/// Options that do not fit together, a nominal chain without a closed form, a pose out of its reach.
pub fn laser_experiment(
    nominal: &SerialChain,
    calibrated: &SerialChain,
    truth: &SerialChain,
    options: &LaserOptions,
) -> Result<LaserExperiment, SimulationError> {
    if options.positions_mm.is_empty() || options.positions_mm.len() != options.rotations_deg.len() {
        return Err(SimulationError::Option {
            option: "positions_mm",
            value: format!("{} positions beside {} rotations", options.positions_mm.len(), options.rotations_deg.len()),
            need: "as many positions as rotations are needed, at least one",
        });
    }
    if !(options.resolution_mm >= 0.0 && options.resolution_mm.is_finite()) {
        return Err(SimulationError::Option {
            option: "resolution_mm",
            value: options.resolution_mm.to_string(),
            need: "a finite number of at least 0 is needed (0 = exact)",
        });
    }
    let mut poses = Vec::with_capacity(options.positions_mm.len());
    for (position, rotation) in options.positions_mm.iter().zip(&options.rotations_deg) {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from(rotation.map(f64::to_radians)));
        let translation = Translation3::from(Vector3::from(position.map(|value| 1e-3 * value)));
        let base_from_flange = Isometry3::from_parts(translation, turn * down);
        let starts = spherical_wrist_solutions(nominal, &base_from_flange)?;
        if starts.len() != 8 {
            return Err(SimulationError::Solutions { need: 8, got: starts.len() });
        }
        let mut postures = [0; 2];
        let mut deviations = [[0.0; 3]; 2];
        for (which, chain) in [nominal, calibrated].into_iter().enumerate() {
            let mut readings = Vec::with_capacity(starts.len());
            for start in &starts {
                let found = refine_inverse_kinematics(
                    chain,
                    &base_from_flange,
                    &start.joint_values,
                    &RefinementOptions::default(),
                )?;
                if found.termination == Termination::Converged {
                    let flange = truth.base_from_flange(&found.joint_values)?.translation.vector;
                    readings.push(flange.map(|metres| reading_mm(1e3 * metres, options.resolution_mm)));
                }
            }
            if readings.len() < 2 {
                return Err(SimulationError::Solutions { need: 2, got: readings.len() });
            }
            postures[which] = readings.len();
            deviations[which] = standard_deviation(&readings);
        }
        poses.push(LaserPose { postures, nominal_sd_mm: deviations[0], calibrated_sd_mm: deviations[1] });
    }
    Ok(LaserExperiment { poses })
}

/// A value as the sensor shows it, in whole steps.
fn reading_mm(value_mm: f64, resolution_mm: f64) -> f64 {
    if resolution_mm > 0.0 { (value_mm / resolution_mm).round() * resolution_mm } else { value_mm }
}

/// Sample standard deviation of each component.
fn standard_deviation(readings: &[Vector3<f64>]) -> [f64; 3] {
    let mean = readings.iter().sum::<Vector3<f64>>() / readings.len() as f64;
    let squares: Vector3<f64> = readings.iter().map(|reading| (reading - mean).map(|value| value * value)).sum();
    (squares / (readings.len() - 1) as f64).map(f64::sqrt).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::perturb_paper;

    fn chains() -> (SerialChain, SerialChain) {
        let nominal = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let truth = perturb_paper(&nominal).unwrap();
        (nominal.robot.unwrap(), truth.robot.unwrap())
    }

    #[test]
    fn calibration_brings_the_spread_down_to_the_sensors_resolution() {
        let (nominal, truth) = chains();
        let result = laser_experiment(&nominal, &truth, &truth, &LaserOptions::default()).unwrap();
        assert_eq!(result.poses.len(), 5);
        for pose in &result.poses {
            assert_eq!(pose.postures, [8, 8]);
            assert!(pose.calibrated_sd_mm.iter().all(|sd| *sd <= 0.010), "{pose:?}");
            assert!(pose.nominal_sd_mm.iter().sum::<f64>() > 3.0, "{pose:?}");
        }
        let [before, after] = result.mean_sd_mm();
        println!("mean standard deviation: {before:.3} mm before, {after:.4} mm after");
        assert!(before > 2.0 && after < 0.006);
        // A calibration that is wrong by a hundredth of the error leaves about a hundredth of the spread.
        let mut nearly = truth.clone();
        for id in crate::paper_parameters(6) {
            nearly.set_parameter(id, nearly.parameter(id).unwrap() - 0.01f64.to_radians()).unwrap();
        }
        let exact = LaserOptions { resolution_mm: 0.0, ..Default::default() };
        let [_, near] = laser_experiment(&nominal, &nearly, &truth, &exact).unwrap().mean_sd_mm();
        assert!((near / before - 0.01).abs() < 0.002, "{near} of {before}");
    }

    #[test]
    fn options_that_do_not_fit_are_named() {
        let (nominal, truth) = chains();
        let uneven = LaserOptions { rotations_deg: vec![], ..Default::default() };
        let error = laser_experiment(&nominal, &truth, &truth, &uneven).unwrap_err();
        assert!(error.to_string().contains("5 positions beside 0 rotations"), "{error}");
        let far = LaserOptions {
            positions_mm: vec![[9000.0, 0.0, 0.0]],
            rotations_deg: vec![[0.0; 3]],
            ..Default::default()
        };
        let error = laser_experiment(&nominal, &truth, &truth, &far).unwrap_err();
        assert!(matches!(error, SimulationError::Solutions { need: 8, got: 0 }));
    }
}
