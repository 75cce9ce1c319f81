//! The arms in `crates/rig/robots/` against published descriptions of the same arms.
//!
//! The tables below are the joint origins and axes of public URDFs (facts; sources are named in the rig files), typed
//! in as URDF has them. Forward kinematics by URDF's definition must be those of the rig file, at zero and elsewhere.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use skclam_kinematics::{JointKind, LinkForm, SerialChain, chain_from_urdf, spherical_wrist_solutions, write_urdf};
use skclam_rig::Rig;
use std::path::Path;

/// A revolute joint: xyz in mm, rpy in degrees, axis.
type Revolute = ([f64; 3], [f64; 3], [f64; 3]);

struct Published {
    file: &'static str,
    joints: &'static [Revolute],
    /// The last joint's frame to the tool frame: xyz in mm, rpy in degrees.
    tool: ([f64; 3], [f64; 3]),
    closed_form: bool,
}

const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];
const Z: [f64; 3] = [0.0, 0.0, 1.0];
const MINUS_X: [f64; 3] = [-1.0, 0.0, 0.0];
const MINUS_Y: [f64; 3] = [0.0, -1.0, 0.0];
const MINUS_Z: [f64; 3] = [0.0, 0.0, -1.0];
const O: [f64; 3] = [0.0, 0.0, 0.0];

const PUBLISHED: &[Published] = &[
    Published {
        file: "ur3e.toml",
        joints: &[
            ([0.0, 0.0, 151.85], O, Z),
            (O, [90.0, 0.0, 0.0], Z),
            ([-243.55, 0.0, 0.0], O, Z),
            ([-213.2, 0.0, 131.05], O, Z),
            ([0.0, -85.35, 0.0], [90.0, 0.0, 0.0], Z),
            ([0.0, 92.1, 0.0], [90.0, 180.0, 180.0], Z),
        ],
        tool: (O, O),
        closed_form: false,
    },
    Published {
        file: "ur5e.toml",
        joints: &[
            ([0.0, 0.0, 162.5], O, Z),
            (O, [90.0, 0.0, 0.0], Z),
            ([-425.0, 0.0, 0.0], O, Z),
            ([-392.2, 0.0, 133.3], O, Z),
            ([0.0, -99.7, 0.0], [90.0, 0.0, 0.0], Z),
            ([0.0, 99.6, 0.0], [90.0, 180.0, 180.0], Z),
        ],
        tool: (O, O),
        closed_form: false,
    },
    Published {
        file: "ur10e.toml",
        joints: &[
            ([0.0, 0.0, 180.7], O, Z),
            (O, [90.0, 0.0, 0.0], Z),
            ([-612.7, 0.0, 0.0], O, Z),
            ([-571.55, 0.0, 174.15], O, Z),
            ([0.0, -119.85, 0.0], [90.0, 0.0, 0.0], Z),
            ([0.0, 116.55, 0.0], [90.0, 180.0, 180.0], Z),
        ],
        tool: (O, O),
        closed_form: false,
    },
    Published {
        file: "ur16e.toml",
        joints: &[
            ([0.0, 0.0, 180.7], O, Z),
            (O, [90.0, 0.0, 0.0], Z),
            ([-478.4, 0.0, 0.0], O, Z),
            ([-360.0, 0.0, 174.15], O, Z),
            ([0.0, -119.85, 0.0], [90.0, 0.0, 0.0], Z),
            ([0.0, 116.55, 0.0], [90.0, 180.0, 180.0], Z),
        ],
        tool: (O, O),
        closed_form: false,
    },
    Published {
        file: "kuka-kr6-r900.toml",
        joints: &[
            ([0.0, 0.0, 400.0], O, MINUS_Z),
            ([25.0, 0.0, 0.0], O, Y),
            ([455.0, 0.0, 0.0], O, Y),
            ([0.0, 0.0, 35.0], O, MINUS_X),
            ([420.0, 0.0, 0.0], O, Y),
            ([80.0, 0.0, 0.0], O, MINUS_X),
        ],
        tool: (O, [0.0, 90.0, 0.0]),
        closed_form: true,
    },
    Published {
        file: "abb-irb120.toml",
        joints: &[
            (O, O, Z),
            ([0.0, 0.0, 290.0], O, Y),
            ([0.0, 0.0, 270.0], O, Y),
            ([0.0, 0.0, 70.0], O, X),
            ([302.0, 0.0, 0.0], O, Y),
            ([72.0, 0.0, 0.0], O, X),
        ],
        tool: (O, [0.0, 90.0, 0.0]),
        closed_form: true,
    },
    Published {
        file: "abb-irb1600-6-120.toml",
        joints: &[
            (O, O, Z),
            ([150.0, 0.0, 486.5], O, Y),
            ([0.0, 0.0, 475.0], O, Y),
            ([300.0, 0.0, 0.0], O, X),
            ([300.0, 0.0, 0.0], O, Y),
            ([65.0, 0.0, 0.0], O, X),
        ],
        tool: (O, [0.0, 90.0, 0.0]),
        closed_form: true,
    },
    Published {
        file: "fanuc-lrmate-200id.toml",
        joints: &[
            ([0.0, 0.0, 330.0], O, Z),
            ([50.0, 0.0, 0.0], O, Y),
            ([0.0, 0.0, 330.0], O, MINUS_Y),
            ([0.0, 0.0, 35.0], O, MINUS_X),
            ([335.0, 0.0, 0.0], O, MINUS_Y),
            ([80.0, 0.0, 0.0], O, MINUS_X),
        ],
        tool: (O, [180.0, -90.0, 0.0]),
        closed_form: true,
    },
    Published {
        file: "staubli-tx2-60.toml",
        joints: &[
            ([0.0, 0.0, 375.0], O, Z),
            (O, O, Y),
            ([0.0, 20.0, 290.0], O, Y),
            (O, O, Z),
            ([0.0, 0.0, 310.0], O, Y),
            ([0.0, 0.0, 70.0], O, Z),
        ],
        tool: (O, O),
        closed_form: true,
    },
    Published {
        file: "yaskawa-gp7.toml",
        joints: &[
            ([0.0, 0.0, 330.0], O, Z),
            ([40.0, 0.0, 0.0], O, Y),
            ([0.0, 0.0, 445.0], O, MINUS_Y),
            ([440.0, 0.0, 40.0], O, MINUS_X),
            (O, O, MINUS_Y),
            (O, O, MINUS_X),
        ],
        tool: ([80.0, 0.0, 0.0], [180.0, -90.0, 0.0]),
        closed_form: true,
    },
    Published {
        file: "franka-fr3.toml",
        joints: &[
            ([0.0, 0.0, 333.0], O, Z),
            (O, [-90.0, 0.0, 0.0], Z),
            ([0.0, -316.0, 0.0], [90.0, 0.0, 0.0], Z),
            ([82.5, 0.0, 0.0], [90.0, 0.0, 0.0], Z),
            ([-82.5, 384.0, 0.0], [-90.0, 0.0, 0.0], Z),
            (O, [90.0, 0.0, 0.0], Z),
            ([88.0, 0.0, 0.0], [90.0, 0.0, 0.0], Z),
        ],
        tool: ([0.0, 0.0, 107.0], O),
        closed_form: false,
    },
];

fn robots() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../rig/robots"))
}

fn rig(file: &str) -> Rig {
    Rig::read(robots().join(file)).unwrap_or_else(|error| panic!("{file}: {error}"))
}

fn arm(file: &str) -> SerialChain {
    rig(file).robot.unwrap_or_else(|| panic!("{file} has no [robot]"))
}

fn origin(xyz: &[f64; 3], rpy: &[f64; 3]) -> Isometry3<f64> {
    let [roll, pitch, yaw] = rpy.map(f64::to_radians);
    let turn = |axis, angle| UnitQuaternion::from_axis_angle(&axis, angle);
    let rotation = turn(Vector3::z_axis(), yaw) * turn(Vector3::y_axis(), pitch) * turn(Vector3::x_axis(), roll);
    Isometry3::from_parts(Translation3::from(Vector3::from(*xyz) * 1e-3), rotation)
}

impl Published {
    fn urdf(&self) -> String {
        let mut text = String::from("<robot name=\"arm\">\n  <link name=\"l0\"/>\n");
        let mut add = |index: usize, kind: &str, xyz: &[f64; 3], rpy: &[f64; 3], axis: &[f64; 3]| {
            let (next, xyz, rpy) = (index + 1, xyz.map(|x| x * 1e-3), rpy.map(f64::to_radians));
            text += &format!(
                "  <link name=\"l{next}\"/>\n  <joint name=\"j{next}\" type=\"{kind}\">\n    \
                 <origin xyz=\"{} {} {}\" rpy=\"{} {} {}\"/>\n    <parent link=\"l{index}\"/>\n    \
                 <child link=\"l{next}\"/>\n    <axis xyz=\"{} {} {}\"/>\n  </joint>\n",
                xyz[0], xyz[1], xyz[2], rpy[0], rpy[1], rpy[2], axis[0], axis[1], axis[2]
            );
        };
        for (index, (xyz, rpy, axis)) in self.joints.iter().enumerate() {
            add(index, "continuous", xyz, rpy, axis);
        }
        add(self.joints.len(), "fixed", &self.tool.0, &self.tool.1, &Z);
        text + "</robot>\n"
    }

    fn base_from_tool(&self, joint_values: &[f64]) -> Isometry3<f64> {
        let arm = self.joints.iter().zip(joint_values).fold(Isometry3::identity(), |pose, ((xyz, rpy, axis), q)| {
            pose * origin(xyz, rpy) * Isometry3::rotation(Vector3::from(*axis) * *q)
        });
        arm * origin(&self.tool.0, &self.tool.1)
    }
}

fn difference(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    (a.to_homogeneous() - b.to_homogeneous()).norm()
}

#[test]
fn every_arm_is_the_published_one() {
    for published in PUBLISHED {
        let chain = arm(published.file);
        assert_eq!(chain.joint_count(), published.joints.len(), "{}", published.file);
        for step in 0..20 {
            let values: Vec<f64> =
                (0..chain.joint_count()).map(|joint| f64::from(step) * (0.31 + 0.17 * joint as f64)).collect();
            let off = difference(&chain.base_from_flange(&values).unwrap(), &published.base_from_tool(&values));
            assert!(off < 1e-9, "{} at {values:?}: {off:.2e}", published.file);
        }
    }
}

/// In, out, in again: the published arm as a URDF, the rig file's chain with every parameter moved as the calibrated
/// one.
#[test]
fn every_arm_goes_through_urdf_and_back() {
    for published in PUBLISHED {
        let (text, tip) = (published.urdf(), format!("l{}", published.joints.len() + 1));
        let read = chain_from_urdf(&text, "l0", &tip).unwrap();
        let table = arm(published.file);
        for nominal in [&read, &table] {
            let mut calibrated = nominal.clone();
            for (index, id) in nominal.parameter_ids().into_iter().enumerate() {
                let size = if id.kind.is_angle() { 0.02 } else { 0.002 };
                let change = size * ((index * 7 % 11) as f64 / 5.0 - 1.0);
                calibrated.set_parameter(id, nominal.parameter(id).unwrap() + change).unwrap();
            }
            let written = write_urdf(&text, "l0", &tip, nominal, &calibrated).unwrap();
            let again = chain_from_urdf(&written, "l0", &tip).unwrap();
            for step in 0..20 {
                let values: Vec<f64> =
                    (0..nominal.joint_count()).map(|joint| f64::from(step) * (0.31 + 0.17 * joint as f64)).collect();
                let [a, b, c] = [&again, &calibrated, &read].map(|chain| chain.base_from_flange(&values).unwrap());
                assert!(difference(&a, &b) < 1e-9, "{} {:.2e}", published.file, difference(&a, &b));
                assert!(difference(&c, &published.base_from_tool(&values)) < 1e-9, "{}", published.file);
            }
        }
    }
}

#[test]
fn spherical_wrists_have_eight_solutions_and_the_others_none() {
    for published in PUBLISHED {
        let chain = arm(published.file);
        let values = [0.3, -0.5, 0.6, 0.4, 0.8, -0.7, 0.2];
        let pose = chain.base_from_flange(&values[..chain.joint_count()]).unwrap();
        let solutions = spherical_wrist_solutions(&chain, &pose);
        assert_eq!(solutions.is_ok(), published.closed_form, "{}", published.file);
        for solution in solutions.into_iter().flatten() {
            let reached = chain.base_from_flange(&solution.joint_values).unwrap();
            assert!(difference(&reached, &pose) < 1e-9, "{}", published.file);
        }
    }
    for file in ["hp3j.toml", "hp3-like.toml"] {
        let chain = arm(file);
        let pose = chain.base_from_flange(&[0.3, 0.4, -0.2, 0.5, 0.9, -0.7]).unwrap();
        let solutions = spherical_wrist_solutions(&chain, &pose).unwrap();
        assert_eq!(solutions.len(), 8, "{file}");
        assert!(file != "hp3j.toml" || solutions.iter().all(|solution| solution.within_limits));
    }
}

/// No public description of these is known: the lengths are checked by hand. With the angles of the paper's Table 1
/// both arms point straight up at zero; with joint 3 at 90 deg the forearm points ahead, the elbow's offset upwards.
#[test]
fn the_arms_of_the_paper_in_two_poses() {
    for (file, [base, shoulder, lower, elbow, fore, hand]) in [
        ("hp3j.toml", [290.0, 0.0, 260.0, 30.0, 270.0, 90.0]),
        ("hp3-like.toml", [290.0, 100.0, 290.0, 85.0, 300.0, 90.0]),
    ] {
        let up = Vector3::new(shoulder - elbow, 0.0, base + lower + fore + hand);
        let ahead = Vector3::new(shoulder + fore + hand, 0.0, base + lower + elbow);
        for (q3, position, direction) in [(0.0, up, Vector3::z()), (90_f64, ahead, Vector3::x())] {
            let flange = arm(file).base_from_flange(&[0.0, 0.0, q3.to_radians(), 0.0, 0.0, 0.0]).unwrap();
            assert!((flange.translation.vector - position * 1e-3).norm() < 1e-12, "{file} {flange}");
            assert!((flange.rotation * Vector3::z() - direction).norm() < 1e-12, "{file} {flange}");
        }
    }
    // Table 1: joint 3 is the one whose axis is parallel to the one before.
    let forms: Vec<LinkForm> = arm("hp3j.toml").joints().iter().map(|joint| joint.link.form).collect();
    use LinkForm::{Hayati, ModifiedDh};
    assert_eq!(forms, [ModifiedDh, ModifiedDh, Hayati, ModifiedDh, ModifiedDh, ModifiedDh]);
}

#[test]
fn every_file_is_a_usable_rig_and_is_tested() {
    let mut files: Vec<String> = std::fs::read_dir(robots())
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".toml"))
        .collect();
    files.sort();
    let mut tested: Vec<&str> = PUBLISHED.iter().map(|published| published.file).collect();
    tested.extend(["hp3j.toml", "hp3-like.toml"]);
    tested.sort_unstable();
    assert_eq!(files, tested);
    for file in files {
        let rig = rig(&file);
        assert!(rig.depth.is_some(), "{file}");
        let arm = rig.robot.unwrap();
        for joint in arm.joints() {
            assert_eq!(joint.kind, JointKind::Revolute);
            assert!(joint.limits.is_some_and(|[lower, upper]| lower < upper), "{file} {}", joint.name);
        }
    }
}
