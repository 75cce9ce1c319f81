//! True arms: nominal ones with errors.

use crate::SimulationError;
use crate::scene_rng::SceneRng;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_kinematics::{LinkForm, ParameterId, ParameterKind, SerialChain};
use skclam_rig::Rig;

/// The error that the paper adds to each of its angles, section 4.1.1.
pub const PAPER_ERROR_DEG: f64 = 1.0;

/// The ten angles of the paper: alpha and theta offset of joints 2 to 6 (of fewer, where the arm has fewer).
pub fn paper_parameters(joint_count: usize) -> Vec<ParameterId> {
    (1..joint_count.min(6))
        .flat_map(|joint| [ParameterKind::Alpha, ParameterKind::ThetaOffset].map(|kind| ParameterId { joint, kind }))
        .collect()
}

/// The paper's true arm: +1 deg on each of [`paper_parameters`], all else nominal. Errors: no arm.
pub fn perturb_paper(nominal: &Rig) -> Result<Rig, SimulationError> {
    let mut truth = nominal.clone();
    let chain = truth.robot.as_mut().ok_or(SimulationError::NoRobot)?;
    for id in paper_parameters(chain.joint_count()) {
        let value = chain.parameter(id).unwrap_or_default() + PAPER_ERROR_DEG.to_radians();
        chain.set_parameter(id, value)?;
    }
    truth.name = format!("{} (true arm: +1 deg on the paper's angles)", nominal.name);
    Ok(truth)
}

/// Standard deviations of the errors of a true arm drawn at random.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PerturbationSigmas {
    /// Angles of the arm, degrees.
    pub angle_deg: f64,
    /// Lengths of the arm, millimetres.
    pub length_mm: f64,
    /// Rotation of the mount about each axis, degrees.
    pub mount_rotation_deg: f64,
    /// Translation of the mount along each axis, millimetres.
    pub mount_translation_mm: f64,
}

impl Default for PerturbationSigmas {
    fn default() -> Self {
        PerturbationSigmas { angle_deg: 0.5, length_mm: 1.0, mount_rotation_deg: 0.5, mount_translation_mm: 2.0 }
    }
}

/// Whether a parameter only says how the base frame lies about the first axis: in the modified order, `alpha_1` and
/// `a_1`. What is called the base is drawn on the floor along that axis, so that a true arm has no error there.
fn defines_the_base(id: ParameterId, chain: &SerialChain) -> bool {
    let modified = matches!(chain.joints()[id.joint].link.form, LinkForm::ModifiedDh | LinkForm::Hayati);
    id.joint == 0 && modified && matches!(id.kind, ParameterKind::Alpha | ParameterKind::A | ParameterKind::Beta)
}

/// A true arm with normal errors on the mount and on every parameter but those that only define the base frame. Errors:
/// no arm, a sigma that is negative or not finite.
pub fn perturb_random(nominal: &Rig, seed: u64, sigmas: &PerturbationSigmas) -> Result<Rig, SimulationError> {
    for (option, value) in [
        ("angle_deg", sigmas.angle_deg),
        ("length_mm", sigmas.length_mm),
        ("mount_rotation_deg", sigmas.mount_rotation_deg),
        ("mount_translation_mm", sigmas.mount_translation_mm),
    ] {
        if !(0.0..=1000.0).contains(&value) {
            let need = "a number from 0 to 1000 is needed";
            return Err(SimulationError::Option { option, value: value.to_string(), need });
        }
    }
    let mut truth = nominal.clone();
    let mut rng = SceneRng::new(seed, 30);
    let chain = truth.robot.as_mut().ok_or(SimulationError::NoRobot)?;
    for id in chain.parameter_ids() {
        let sigma = if id.kind.is_angle() { sigmas.angle_deg.to_radians() } else { 1e-3 * sigmas.length_mm };
        let value = chain.parameter(id).unwrap_or_default() + sigma * rng.normal();
        if !defines_the_base(id, chain) {
            chain.set_parameter(id, value)?;
        }
    }
    let mut draw = |sigma: f64| Vector3::from_fn(|_, _| sigma * rng.normal());
    let turn = UnitQuaternion::from_scaled_axis(draw(sigmas.mount_rotation_deg.to_radians()));
    let shift = draw(1e-3 * sigmas.mount_translation_mm);
    let mount = &mut truth.flange_from_color;
    *mount =
        nalgebra::Isometry3::from_parts(Translation3::from(mount.translation.vector + shift), mount.rotation * turn);
    truth.name = format!("{} (true arm drawn from seed {seed})", nominal.name);
    Ok(truth)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hp3j() -> Rig {
        skclam_rig::builtin_rig("hp3j").unwrap().unwrap()
    }

    #[test]
    fn the_papers_arm_differs_in_ten_angles_by_one_degree() {
        let nominal = hp3j();
        let truth = perturb_paper(&nominal).unwrap();
        let (before, after) = (nominal.robot.unwrap(), truth.robot.unwrap());
        let mut changed = Vec::new();
        for id in before.parameter_ids() {
            let difference = after.parameter(id).unwrap() - before.parameter(id).unwrap();
            if difference != 0.0 {
                assert!((difference.to_degrees() - 1.0).abs() < 1e-12);
                changed.push(id.to_string());
            }
        }
        changed.sort();
        let mut expected: Vec<String> =
            (2..=6).flat_map(|i| [format!("alpha_{i}"), format!("theta_offset_{i}")]).collect();
        expected.sort();
        assert_eq!(changed, expected);
        assert_eq!(truth.flange_from_color, nominal.flange_from_color);
    }

    #[test]
    fn a_drawn_arm_differs_everywhere_and_only_by_its_seed() {
        let nominal = hp3j();
        let sigmas = PerturbationSigmas::default();
        let truth = perturb_random(&nominal, 3, &sigmas).unwrap();
        assert_eq!(truth, perturb_random(&nominal, 3, &sigmas).unwrap());
        let (before, after) = (nominal.robot.as_ref().unwrap(), truth.robot.as_ref().unwrap());
        for id in before.parameter_ids() {
            let error = (after.parameter(id).unwrap() - before.parameter(id).unwrap()).abs();
            let sigma = if id.kind.is_angle() { 0.5f64.to_radians() } else { 1e-3 };
            let moved = !defines_the_base(id, before);
            assert!((error > 0.0) == moved && error < 5.0 * sigma, "{id}: {error}");
        }
        assert_ne!(truth.flange_from_color, nominal.flange_from_color);
        assert_ne!(truth.robot, perturb_random(&nominal, 4, &sigmas).unwrap().robot);
        let bad = PerturbationSigmas { angle_deg: f64::NAN, ..sigmas };
        assert!(matches!(perturb_random(&nominal, 3, &bad), Err(SimulationError::Option { option: "angle_deg", .. })));
        let handless = Rig { robot: None, ..nominal };
        assert!(matches!(perturb_paper(&handless), Err(SimulationError::NoRobot)));
    }
}
