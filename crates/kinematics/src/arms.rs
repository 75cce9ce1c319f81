//! Arms for the tests of this crate.

use crate::{Joint, Link, LinkForm, ParameterKind, SerialChain};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::f64::consts::{FRAC_PI_2, PI};

fn deg(angle: f64) -> f64 {
    angle.to_radians()
}

/// The paper's arm: shoulder offset 0, joint 3 in Hayati form.
pub(crate) fn hp3j() -> SerialChain {
    yaskawa([0.29, 0.0, 0.26, 0.03, 0.27, 0.09], [[-180.0, 180.0]; 6])
}

/// Shoulder offset 100 mm, elbow offset 85 mm, narrow limits.
pub(crate) fn hp3_like() -> SerialChain {
    let limits = [[-180.0, 180.0], [-150.0, 150.0], [-170.0, 170.0], [-190.0, 190.0], [-135.0, 135.0], [-360.0, 360.0]];
    yaskawa([0.29, 0.1, 0.29, 0.085, 0.3, 0.09], limits)
}

fn yaskawa([base, shoulder, lower, elbow, fore, hand]: [f64; 6], limits: [[f64; 2]; 6]) -> SerialChain {
    let links = [
        Link::modified_dh(0.0, 0.0, 0.0, base),
        Link::modified_dh(deg(90.0), shoulder, deg(90.0), 0.0),
        Link::hayati(deg(180.0), lower, 0.0, deg(-90.0)),
        Link::modified_dh(deg(-90.0), elbow, 0.0, fore),
        Link::modified_dh(deg(90.0), 0.0, 0.0, 0.0),
        Link::modified_dh(deg(-90.0), 0.0, deg(-90.0), hand),
    ];
    let joints = ["S", "L", "U", "R", "B", "T"].into_iter().zip(links).zip(limits);
    SerialChain::new(
        joints
            .map(|((name, link), [low, high])| Joint::revolute(name, link).with_limits(deg(low), deg(high)))
            .collect(),
    )
    .unwrap()
}

/// A made-up arm with a spherical wrist in classic DH, with a lateral shoulder offset and a wrist that is not at right
/// angles.
pub(crate) fn spherical_standard_dh() -> SerialChain {
    let links = [
        Link::standard_dh(0.0, 0.4, 0.05, -FRAC_PI_2),
        Link::standard_dh(0.3, 0.08, 0.35, 0.0),
        Link::standard_dh(-0.2, 0.0, 0.04, -FRAC_PI_2),
        Link::standard_dh(0.0, 0.38, 0.0, 1.2),
        Link::standard_dh(0.0, 0.0, 0.0, -1.3),
        Link::standard_dh(PI, 0.1, 0.0, 0.0),
    ];
    SerialChain::new(links.into_iter().map(|link| Joint::revolute("", link)).collect()).unwrap()
}

/// Universal Robots' published parameters of the UR5e: no spherical wrist.
pub(crate) fn ur5e() -> SerialChain {
    let links = [
        Link::standard_dh(0.0, 0.1625, 0.0, FRAC_PI_2),
        Link::standard_dh(0.0, 0.0, -0.425, 0.0),
        Link::standard_dh(0.0, 0.0, -0.3922, 0.0),
        Link::standard_dh(0.0, 0.1333, 0.0, FRAC_PI_2),
        Link::standard_dh(0.0, 0.0997, 0.0, -FRAC_PI_2),
        Link::standard_dh(0.0, 0.0996, 0.0, 0.0),
    ];
    SerialChain::new(links.into_iter().map(|link| Joint::revolute("", link)).collect()).unwrap()
}

/// A redundant arm: seven joints, offsets at the elbow.
pub(crate) fn seven_joints() -> SerialChain {
    let links = [
        Link::modified_dh(0.0, 0.0, 0.0, 0.33),
        Link::modified_dh(-FRAC_PI_2, 0.0, 0.0, 0.0),
        Link::modified_dh(FRAC_PI_2, 0.0, 0.0, 0.32),
        Link::modified_dh(FRAC_PI_2, 0.08, 0.0, 0.0),
        Link::modified_dh(-FRAC_PI_2, -0.08, 0.0, 0.38),
        Link::modified_dh(FRAC_PI_2, 0.0, 0.0, 0.0),
        Link::modified_dh(FRAC_PI_2, 0.09, 0.0, 0.1),
    ];
    SerialChain::new(links.into_iter().map(|link| Joint::revolute("", link)).collect()).unwrap()
}

/// Every parameter moved by up to `angle` (radians) or `length` (metres); `draws` in [-1, 1], one a parameter.
pub(crate) fn perturbed(chain: &SerialChain, angle: f64, length: f64, draws: &[f64]) -> SerialChain {
    let mut moved = chain.clone();
    for (id, draw) in chain.parameter_ids().into_iter().zip(draws) {
        let size = if id.kind.is_angle() { angle } else { length };
        moved.set_parameter(id, chain.parameter(id).unwrap() + size * draw).unwrap();
    }
    moved
}

/// Smallest singular value of the Jacobian at the flange, with 0.3 m a radian.
pub(crate) fn distance_from_singularity(chain: &SerialChain, joint_values: &[f64]) -> f64 {
    let jacobian = chain.jacobian(joint_values).unwrap();
    let flange = jacobian.base_from_flange.translation.vector;
    let columns: Vec<Vector6<f64>> = jacobian
        .by_joint
        .iter()
        .map(|twist| {
            let omega = Vector3::new(twist[3], twist[4], twist[5]);
            let v = Vector3::new(twist[0], twist[1], twist[2]) + omega.cross(&flange);
            Vector6::new(v.x, v.y, v.z, 0.3 * omega.x, 0.3 * omega.y, 0.3 * omega.z)
        })
        .collect();
    Matrix6::from_columns(&columns).singular_values().min()
}

#[test]
fn perturbation_moves_every_parameter() {
    let moved = perturbed(&hp3j(), 0.1, 0.01, &[1.0; 24]);
    assert_eq!(moved.joints()[2].link.form, LinkForm::Hayati);
    assert_eq!(moved.joints()[2].link.get(ParameterKind::Beta), Some(0.1));
    assert!(hp3j().parameter_ids().into_iter().all(|id| moved.parameter(id) != hp3j().parameter(id)));
}
