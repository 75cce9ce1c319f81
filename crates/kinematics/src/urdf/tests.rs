use super::*;
use crate::chain::JointKind;
use crate::{KinematicsError, LinkForm};
use nalgebra::{Rotation3, Translation3, Unit, UnitQuaternion, Vector3};
use proptest::prelude::*;

/// A joint of a URDF written for the tests: type, xyz, rpy, axis.
type Row = (&'static str, [f64; 3], [f64; 3], [f64; 3]);

const HALF_PI: f64 = std::f64::consts::FRAC_PI_2;
const PI: f64 = std::f64::consts::PI;
const X: [f64; 3] = [1.0, 0.0, 0.0];
const Y: [f64; 3] = [0.0, 1.0, 0.0];
const Z: [f64; 3] = [0.0, 0.0, 1.0];
const O: [f64; 3] = [0.0, 0.0, 0.0];

/// The robots: name and joints from link l0 to the last.
fn robots() -> Vec<(&'static str, Vec<Row>)> {
    vec![
        (
            "six axes with signs and a turned tool",
            vec![
                ("revolute", [0.0, 0.0, 0.4], O, [0.0, 0.0, -1.0]),
                ("revolute", [0.025, 0.0, 0.0], O, Y),
                ("revolute", [0.455, 0.0, 0.0], O, Y),
                ("revolute", [0.0, 0.0, 0.035], O, [-1.0, 0.0, 0.0]),
                ("revolute", [0.42, 0.0, 0.0], O, Y),
                ("revolute", [0.08, 0.0, 0.0], O, [-1.0, 0.0, 0.0]),
                ("fixed", O, [0.0, HALF_PI, 0.0], Z),
            ],
        ),
        (
            "two parallel pairs",
            vec![
                ("revolute", [0.0, 0.0, 0.16], O, Z),
                ("revolute", [0.0, 0.14, 0.0], [0.0, HALF_PI, 0.0], Y),
                ("revolute", [0.0, -0.12, 0.42], O, Y),
                ("revolute", [0.0, 0.0, 0.39], [0.0, HALF_PI, 0.0], Y),
                ("revolute", [0.0, 0.09, 0.0], O, Z),
                ("revolute", [0.0, 0.0, 0.09], O, Y),
                ("fixed", [0.0, 0.08, 0.0], [0.0, 0.0, HALF_PI], Z),
            ],
        ),
        (
            "seven axes",
            vec![
                ("revolute", [0.0, 0.0, 0.333], O, Z),
                ("revolute", O, [-HALF_PI, 0.0, 0.0], Z),
                ("revolute", [0.0, -0.316, 0.0], [HALF_PI, 0.0, 0.0], Z),
                ("revolute", [0.0825, 0.0, 0.0], [HALF_PI, 0.0, 0.0], Z),
                ("revolute", [-0.0825, 0.384, 0.0], [-HALF_PI, 0.0, 0.0], Z),
                ("revolute", O, [HALF_PI, 0.0, 0.0], Z),
                ("revolute", [0.088, 0.0, 0.0], [HALF_PI, 0.0, 0.0], Z),
                ("fixed", [0.0, 0.0, 0.107], O, Z),
            ],
        ),
        (
            "odd axes",
            vec![
                ("revolute", [0.1, -0.2, 0.3], [0.1, 0.2, 0.3], [0.3, -0.5, 0.8]),
                ("continuous", [0.3, 0.1, -0.2], [-1.0, 0.4, 2.0], [1.0, 1.0, 1.0]),
                ("revolute", [0.2, 0.2, 0.1], [2.0, -0.9, 0.5], [0.0, -0.6, 0.8]),
                ("revolute", [-0.1, 0.3, 0.2], [0.4, 1.4, -2.2], [2.0, 0.1, -0.3]),
                ("continuous", [0.1, 0.1, 0.1], [1.0, 1.0, 1.0], [-1.0, 0.0, 1.0]),
            ],
        ),
        (
            "fixed joints everywhere",
            vec![
                ("fixed", [0.5, -0.1, 0.8], [0.3, 0.2, 0.1], Z),
                ("fixed", [0.0, 0.1, 0.0], [0.0, 0.0, 1.0], Z),
                ("revolute", [0.0, 0.0, 0.2], O, Z),
                ("fixed", [0.1, 0.0, 0.05], [HALF_PI, 0.0, 0.0], Z),
                ("revolute", [0.0, 0.05, 0.0], O, Z),
                ("fixed", [0.3, 0.0, 0.0], O, Z),
                ("fixed", [0.0, 0.0, 0.02], [0.0, 0.4, 0.0], Z),
                ("revolute", [0.0, 0.1, 0.0], [0.1, 0.0, 0.0], X),
                ("fixed", [0.0, 0.0, 0.1], [0.0, PI, 0.0], Z),
                ("fixed", [0.0, 0.01, 0.1], [0.2, 0.0, -0.1], Z),
            ],
        ),
        (
            "SCARA: three parallel axes and a slide",
            vec![
                ("revolute", [0.0, 0.0, 0.3], O, Z),
                ("revolute", [0.25, 0.0, 0.05], O, Z),
                ("prismatic", [0.2, 0.0, 0.0], O, [0.0, 0.0, -1.0]),
                ("continuous", O, O, [0.0, 0.0, -1.0]),
                ("fixed", [0.0, 0.0, -0.1], [PI, 0.0, 0.0], Z),
            ],
        ),
        (
            "gantry with a wrist",
            vec![
                ("prismatic", [0.1, 0.2, 0.3], O, X),
                ("prismatic", [0.0, 0.0, 0.4], O, Y),
                ("prismatic", [0.2, 0.0, 0.0], O, [0.0, 0.0, -1.0]),
                ("continuous", [0.0, 0.0, -0.1], O, Z),
                ("revolute", [0.05, 0.0, -0.1], O, Y),
                ("revolute", [0.0, 0.0, -0.05], O, X),
                ("fixed", [0.0, 0.0, -0.02], [0.0, PI, 0.0], Z),
            ],
        ),
        (
            "arm on a rail that is not straight",
            vec![
                ("prismatic", [0.0, 0.0, 0.1], [0.01, 0.02, 0.3], [0.999, 0.01, -0.02]),
                ("revolute", [0.0, 0.1, 0.3], O, Z),
                ("revolute", [0.1, 0.0, 0.1], O, [0.0, 1.0, 1e-5]),
                ("prismatic", [0.4, 0.0, 0.0], O, [1.0, 0.0, 0.0]),
                ("revolute", [0.1, 0.0, 0.0], O, [0.0, 1.0, 0.0]),
            ],
        ),
        (
            "nearly parallel axes of a calibrated description",
            vec![
                ("revolute", [1e-4, -2e-4, 0.16], [1e-3, -2e-3, 5e-4], Z),
                ("revolute", [0.0, 0.0, 1e-5], [HALF_PI + 1e-4, 2e-5, -1e-5], Z),
                ("revolute", [-0.425, 3e-4, 2e-4], [1e-3, -1e-9, 2e-3], Z),
                ("revolute", [-0.392, -4e-3, 0.133], [-1e-7, 3e-4, 1e-3], Z),
                ("revolute", [1e-5, -0.0997, 2e-5], [HALF_PI, 0.0, 1e-6], Z),
                ("revolute", [-1e-5, 0.0996, 3e-5], [HALF_PI, PI, PI], Z),
            ],
        ),
        (
            "coincident, antiparallel and doubled axes",
            vec![
                ("revolute", [0.0, 0.0, 0.2], O, Z),
                ("revolute", [0.0, 0.0, 0.1], O, Z),
                ("revolute", [0.0, 0.0, 0.1], [PI, 0.0, 0.0], Z),
                ("revolute", [0.2, 0.0, 0.0], [PI, 0.0, 0.0], Z),
                ("revolute", O, [0.0, HALF_PI, 0.0], Z),
                ("revolute", [0.0, 0.0, 0.1], O, [0.0, 0.0, -1.0]),
            ],
        ),
        ("one joint, upside down", vec![("continuous", [0.3, -0.2, 1.5], [PI, 0.0, 0.0], Z)]),
        (
            "an axis that nearly is the base's, reversed",
            vec![
                ("revolute", [0.0, 0.0, 0.1], [PI - 1e-9, 0.0, 0.0], Z),
                ("revolute", [0.1, 0.0, 0.1], [0.0, -HALF_PI, 0.0], Z),
                ("prismatic", [0.0, 0.0, 0.1], [0.0, HALF_PI, 0.0], Z),
            ],
        ),
    ]
}

fn urdf_of(rows: &[Row]) -> String {
    let mut text = String::from(
        "<?xml version=\"1.0\"?>\n<!-- for tests -->\n<robot name='r' xmlns:xacro=\"http://www.ros.org/wiki/xacro\">\n  <link name=\"l0\"/>\n",
    );
    for (index, (kind, xyz, rpy, axis)) in rows.iter().enumerate() {
        let three = |v: &[f64; 3]| format!("{} {}  {}", v[0], v[1], v[2]);
        let origin = match index % 4 {
            // What is zero by default may be left out.
            _ if *xyz == O && *rpy == O => String::new(),
            _ if *rpy == O => format!("    <origin xyz=\"{}\"/>\n", three(xyz)),
            1 => format!("    <origin rpy='{}'\n            xyz='{}' />\n", three(rpy), three(xyz)),
            _ => format!("    <origin xyz=\"{}\" rpy=\"{}\"></origin> <!-- measured -->\n", three(xyz), three(rpy)),
        };
        let limit = if *kind == "revolute" || *kind == "prismatic" {
            "    <limit effort=\"1\" velocity=\"1\" lower=\"-3.1\" upper=\"2.9\"/>\n"
        } else {
            ""
        };
        let axis = if *axis == X { String::new() } else { format!("    <axis xyz=\"{}\"/>\n", three(axis)) };
        let next = index + 1;
        text += &format!(
            "  <link name=\"l{next}\">\n    <visual><origin xyz=\"0.1 0 0\" rpy=\"0 0 1\"/><geometry><box size=\"1 1 1\"/></geometry></visual>\n  </link>\n\
             \x20 <joint type=\"{kind}\" name=\"j{next}\">\n{origin}    <parent link=\"l{index}\"/><child link=\"l{next}\"/>\n{axis}{limit}  </joint>\n",
        );
    }
    // Beside the chain: a gripper whose finger mimics, a transmission with elements named joint.
    text + "  <link name=\"finger\"/><link name=\"thumb\"/>\n\
        \x20 <joint name=\"grip\" type=\"prismatic\"><parent link=\"l1\"/><child link=\"finger\"/><axis xyz=\"0 1 0\"/></joint>\n\
        \x20 <joint name=\"follow\" type=\"prismatic\"><parent link=\"l1\"/><child link=\"thumb\"/><mimic joint=\"grip\"/></joint>\n\
        \x20 <transmission name=\"t\"><joint name=\"j1\"><hardwareInterface>x</hardwareInterface></joint></transmission>\n</robot>\n"
}

/// Forward kinematics by the definition of URDF, from the table and not from the text.
fn forward(rows: &[Row], joint_values: &[f64]) -> Isometry3 {
    let mut values = joint_values.iter();
    rows.iter().fold(Isometry3::identity(), |pose, (kind, xyz, rpy, axis)| {
        let about = |axis: Unit<Vector3<f64>>, angle| Rotation3::from_axis_angle(&axis, angle);
        let rotation =
            about(Vector3::z_axis(), rpy[2]) * about(Vector3::y_axis(), rpy[1]) * about(Vector3::x_axis(), rpy[0]);
        let origin = Isometry3::from_parts(
            Translation3::from(Vector3::from(*xyz)),
            UnitQuaternion::from_rotation_matrix(&rotation),
        );
        let axis = Unit::new_normalize(Vector3::from(*axis));
        let motion = match *kind {
            "fixed" => Isometry3::identity(),
            "prismatic" => {
                Isometry3::from_parts((axis.into_inner() * *values.next().unwrap()).into(), UnitQuaternion::identity())
            }
            _ => Isometry3::rotation(axis.into_inner() * *values.next().unwrap()),
        };
        pose * origin * motion
    })
}

fn difference(a: &Isometry3, b: &Isometry3) -> f64 {
    (a.to_homogeneous() - b.to_homogeneous()).norm()
}

fn tip_of(rows: &[Row]) -> String {
    format!("l{}", rows.len())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    #[test]
    fn forward_kinematics_are_those_of_the_urdf(values in prop::collection::vec(-3.1..3.1f64, 8)) {
        for (name, rows) in robots() {
            let chain = chain_from_urdf(&urdf_of(&rows), "l0", &tip_of(&rows)).unwrap();
            let values = &values[..chain.joint_count()];
            let off = difference(&chain.base_from_flange(values).unwrap(), &forward(&rows, values));
            prop_assert!(off < 1e-11, "{name}: {off:.2e}");
        }
    }

    #[test]
    fn calibrated_chains_are_written_and_read_again(
        values in prop::collection::vec(-3.1..3.1f64, 8),
        draws in prop::collection::vec(-1.0..1.0f64, 32),
    ) {
        for (name, rows) in robots() {
            let (text, tip) = (urdf_of(&rows), tip_of(&rows));
            let nominal = chain_from_urdf(&text, "l0", &tip).unwrap();
            let calibrated = crate::arms::perturbed(&nominal, 0.02, 0.002, &draws);
            let written = write_urdf(&text, "l0", &tip, &nominal, &calibrated).unwrap();
            let again = chain_from_urdf(&written, "l0", &tip).unwrap();
            let values = &values[..nominal.joint_count()];
            let off = difference(&again.base_from_flange(values).unwrap(), &calibrated.base_from_flange(values).unwrap());
            prop_assert!(off < 1e-11, "{name}: {off:.2e}");
        }
    }
}

#[test]
fn axes_names_limits_and_forms() {
    let robots = robots();
    let rows = &robots[0].1;
    let chain = chain_from_urdf(&urdf_of(rows), "l0", &tip_of(rows)).unwrap();
    assert_eq!(chain.joint_count(), 6);
    assert_eq!(chain.joints()[3].name, "j4");
    assert_eq!(chain.joints()[3].limits, Some([-3.1, 2.9]));
    let hayati = |chain: &SerialChain| -> Vec<usize> {
        let is_hayati =
            |(index, joint): (usize, &crate::Joint)| (joint.link.form == LinkForm::Hayati).then_some(index + 1);
        chain.joints().iter().enumerate().filter_map(is_hayati).collect()
    };
    assert_eq!(hayati(&chain), [3]);
    // The closed form reads the axes, so that it serves here too.
    let pose = chain.base_from_flange(&[0.3, -0.9, 1.2, 0.4, 0.8, -0.5]).unwrap();
    assert_eq!(crate::spherical_wrist_solutions(&chain, &pose).unwrap().len(), 8);
    let rows = &robots[1].1;
    assert_eq!(hayati(&chain_from_urdf(&urdf_of(rows), "l0", &tip_of(rows)).unwrap()), [3, 4]);
    let rows = &robots[5].1;
    let scara = chain_from_urdf(&urdf_of(rows), "l0", &tip_of(rows)).unwrap();
    assert_eq!(scara.joints()[2].kind, JointKind::Prismatic);
    assert_eq!(scara.joints()[3].limits, None);
    // A part of a robot is a robot.
    assert_eq!(chain_from_urdf(&urdf_of(rows), "l1", "l3").unwrap().joint_count(), 2);
    assert_eq!(
        urdf_ends(&urdf_of(rows)).unwrap(),
        (vec!["l0".into()], vec!["l5".into(), "finger".into(), "thumb".into()])
    );
}

#[test]
fn only_origins_of_the_chain_change() {
    for (name, rows) in robots() {
        let (text, tip) = (urdf_of(&rows), tip_of(&rows));
        let nominal = chain_from_urdf(&text, "l0", &tip).unwrap();
        assert_eq!(write_urdf(&text, "l0", &tip, &nominal, &nominal).unwrap(), text, "{name}");
        let calibrated = crate::arms::perturbed(&nominal, 0.01, 0.001, &[0.7; 32]);
        let written = write_urdf(&text, "l0", &tip, &nominal, &calibrated).unwrap();
        // With the joints' origins cut out, both are the same.
        let without_origins = |text: &str| -> String {
            let mut rest = text;
            let mut kept = String::new();
            while let Some(at) = rest.find("<joint type") {
                let (before, joint) = rest.split_at(at);
                kept += before;
                let end = joint.find("</joint>").unwrap();
                let inside = &joint[..end];
                match inside.find("<origin") {
                    Some(at) => {
                        let close = at + inside[at..].find('>').unwrap() + 1;
                        kept += inside[..at].trim_end();
                        kept += inside[close..].trim_start();
                    }
                    None => kept += inside,
                }
                rest = &joint[end..];
            }
            (kept + rest).split_whitespace().collect::<Vec<_>>().concat()
        };
        assert_eq!(without_origins(&written), without_origins(&text), "{name}");
        assert_eq!(written.lines().count(), text.lines().count());
        let fixed = rows.iter().zip(1..).filter(|(row, _)| row.0 == "fixed").map(|(_, number)| number);
        for number in fixed {
            let of = |text: &str| {
                text[text.find(&format!("name=\"j{number}\"")).unwrap()..].lines().nth(1).map(str::to_owned)
            };
            assert_eq!(of(&written), of(&text), "{name} joint {number} is fixed");
        }
        let diff = line_diff(&text, &written);
        assert!(
            diff.lines()
                .filter(|line| line.starts_with("- "))
                .all(|line| line.contains("origin") || line.contains("xyz") || line.contains("parent")),
            "{diff}"
        );
        assert!(diff.contains("@@ line "));
    }
}

#[test]
fn links_carry_their_visuals_along() {
    // A joint's zero moves by 0.1 rad: the links after it turn as a whole, their shape on the link is the same.
    let robots = robots();
    let rows = &robots[1].1;
    let (text, tip) = (urdf_of(rows), tip_of(rows));
    let nominal = chain_from_urdf(&text, "l0", &tip).unwrap();
    let mut calibrated = nominal.clone();
    let zero = crate::ParameterId { joint: 1, kind: crate::ParameterKind::ThetaOffset };
    calibrated.set_parameter(zero, nominal.parameter(zero).unwrap() + 0.1).unwrap();
    let written = write_urdf(&text, "l0", &tip, &nominal, &calibrated).unwrap();
    let frame = |text: &str, link: &str, q2: f64| {
        let chain = chain_from_urdf(text, "l0", link).unwrap();
        let mut values = vec![0.0; chain.joint_count()];
        values[1] = q2;
        chain.base_from_flange(&values).unwrap()
    };
    for link in ["l2", "l3", "l4", "l5", "l6"] {
        assert!(difference(&frame(&written, link, 0.0), &frame(&text, link, 0.1)) < 1e-12, "{link}");
    }
    // One line changed: that joint's origin.
    assert_eq!(line_diff(&text, &written).lines().filter(|line| line.starts_with("@@")).count(), 1);
}

#[test]
fn a_dh_table_of_the_same_arm_is_written_too() {
    let text = urdf_of(&[
        ("revolute", [0.0, 0.0, 0.1625], O, Z),
        ("revolute", O, [HALF_PI, 0.0, 0.0], Z),
        ("revolute", [-0.425, 0.0, 0.0], O, Z),
        ("revolute", [-0.3922, 0.0, 0.1333], O, Z),
        ("revolute", [0.0, -0.0997, 0.0], [HALF_PI, 0.0, 0.0], Z),
        ("revolute", [0.0, 0.0996, 0.0], [HALF_PI, PI, PI], Z),
        ("fixed", O, O, Z),
    ]);
    let nominal = crate::arms::ur5e();
    let calibrated = crate::arms::perturbed(
        &nominal,
        0.01,
        0.001,
        &(0..24).map(|i| f64::from(i % 5) / 2.0 - 1.0).collect::<Vec<_>>(),
    );
    // The classic form turns and moves the flange after the last axis; the fixed joint at the end takes that.
    let written = write_urdf(&text, "l0", "l7", &nominal, &calibrated).unwrap();
    let again = chain_from_urdf(&written, "l0", "l7").unwrap();
    let values = [0.3, -1.0, 1.4, -0.3, 0.8, 2.0];
    assert!(
        difference(&again.base_from_flange(&values).unwrap(), &calibrated.base_from_flange(&values).unwrap()) < 1e-11
    );
    // Without one there, the origins alone cannot.
    let error = write_urdf(&text, "l0", "l6", &nominal, &calibrated).unwrap_err().to_string();
    assert!(error.contains("cannot be written by origins alone"), "{error}");
    // Another arm is refused.
    let error = write_urdf(&text, "l0", "l6", &crate::arms::hp3j(), &calibrated).unwrap_err().to_string();
    assert!(error.contains("the axis of joint 'j1' is") || error.contains("off the nominal chain's"), "{error}");
    let error = write_urdf(&text, "l0", "l5", &nominal, &calibrated).unwrap_err().to_string();
    assert!(error.contains("the nominal chain has 6 joints"), "{error}");
}

#[test]
fn a_flange_at_the_edge_of_roll_pitch_yaw() {
    for pitch in [HALF_PI, -HALF_PI, HALF_PI - 1e-9, HALF_PI - 1e-6, -HALF_PI + 1e-12, HALF_PI - 1e-11] {
        let text =
            urdf_of(&[("revolute", O, [0.3, pitch, 0.7], Y), ("revolute", [0.1, 0.0, 0.0], [0.2, pitch, 1.0], X)]);
        let nominal = chain_from_urdf(&text, "l0", "l2").unwrap();
        let mut calibrated = nominal.clone();
        for id in nominal.parameter_ids() {
            calibrated.set_parameter(id, nominal.parameter(id).unwrap() + 1e-9).unwrap();
        }
        let written = write_urdf(&text, "l0", "l2", &nominal, &calibrated).unwrap();
        let again = chain_from_urdf(&written, "l0", "l2").unwrap();
        let off = difference(
            &again.base_from_flange(&[0.1, 0.2]).unwrap(),
            &calibrated.base_from_flange(&[0.1, 0.2]).unwrap(),
        );
        assert!(off < 1e-12, "{pitch}: {off:.2e}");
    }
}

fn message(text: &str, base: &str, tip: &str) -> String {
    match chain_from_urdf(text, base, tip) {
        Err(error @ KinematicsError::Urdf { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn what_is_no_chain_is_refused_with_its_line() {
    let two = |joint: &str| format!("<robot name=\"r\">\n<link name=\"a\"/><link name=\"b\"/>\n{joint}\n</robot>");
    let joint = |kind: &str, inside: &str| {
        two(&format!("<joint name=\"j\" type=\"{kind}\"><parent link=\"a\"/><child link=\"b\"/>{inside}</joint>"))
    };
    for (text, wanted) in [
        ("", "not XML"),
        ("<robot>", "not XML"),
        ("<robot></robot", "not XML"),
        ("<sdf/>", "the root element is <sdf>, not <robot>"),
        ("<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\"><xacro:macro name=\"m\"/></robot>", "expand it first"),
        ("<robot><xacro:macro name=\"m\"/></robot>", "expand it first"),
        ("<robot><link/></robot>", "a <link> has no name"),
        ("<robot><link name=\"b\"/></robot>", "no link 'a'; it begins at 'b' and ends at 'b'"),
        (&joint("fixed", "<origin xyz=\"0 0 ${height}\"/>"), "line 3: this is a xacro"),
        (&joint("fixed", "<origin xyz=\"0 0\"/>"), "line 3: joint 'j' has origin xyz=\"0 0\"; three finite numbers"),
        (&joint("fixed", "<origin xyz=\"0 0 0 0\"/>"), "three finite numbers"),
        (&joint("fixed", "<origin rpy=\"0 nan 0\"/>"), "has origin rpy=\"0 nan 0\""),
        (&joint("fixed", "<origin rpy=\"0 1e999 0\"/>"), "three finite numbers"),
        (&joint("revolute", "<axis xyz=\"0 0 0\"/>"), "has an axis of length 0"),
        (&joint("revolute", "<limit lower=\"2\" upper=\"1\"/>"), "lower limit 2 above its upper limit 1"),
        (&joint("revolute", "<limit lower=\"x\" upper=\"1\"/>"), "has lower=\"x\"; a finite number"),
        (&joint("revolute", "<mimic joint=\"k\"/>"), "joint 'j' mimics 'k'"),
        (&joint("floating", ""), "joint 'j' is floating"),
        (&joint("planar", ""), "joint 'j' is planar"),
        (&two("<joint name=\"j\" type=\"fixed\"><parent link=\"a\"/></joint>"), "line 3: joint 'j' has no <child link"),
        (&two("<joint type=\"fixed\"><parent link=\"a\"/></joint>"), "a <joint> has no name"),
        (&two("<joint name=\"j\"><parent link=\"a\"/><child link=\"b\"/></joint>"), "joint 'j' has no type"),
        (&two(""), "link 'b' does not hang on 'a'"),
        (
            &(joint("fixed", "").replace(
                "</robot>",
                "<joint name=\"k\" type=\"fixed\"><parent link=\"a\"/><child link=\"b\"/></joint></robot>",
            )),
            "child of two joints, 'j' and 'k'",
        ),
        (&two("<joint name=\"j\" type=\"fixed\"><parent link=\"b\"/><child link=\"b\"/></joint>"), "go in a circle"),
    ] {
        let got = message(text, "a", "b");
        assert!(got.contains(wanted), "{text}\n{got}\n{wanted}");
    }
    let bomb = "<!DOCTYPE r [<!ENTITY a \"aaaaaaaaaa\"><!ENTITY b \"&a;&a;&a;&a;\">]><robot>&b;</robot>";
    assert!(message(bomb, "a", "b").contains("not XML"));
}

#[test]
fn large_and_deep_texts_end() {
    let deep = format!("<robot name=\"r\">{}{}</robot>", "<a>".repeat(200_000), "</a>".repeat(200_000));
    assert!(message(&deep, "a", "b").contains("no link 'a'"));
    let unclosed = "<a>".repeat(200_000);
    assert!(message(&unclosed, "a", "b").contains("not XML"));
    let mut long = String::from("<robot name=\"r\">\n<link name=\"l0\"/>\n");
    for index in 0..20_000 {
        let next = index + 1;
        long += &format!(
            "<link name=\"l{next}\"/><joint name=\"j{next}\" type=\"fixed\"><parent link=\"l{index}\"/><child link=\"l{next}\"/><origin xyz=\"0 0 0.001\"/></joint>\n"
        );
    }
    long += "</robot>";
    let chain = chain_from_urdf(&long, "l0", "l20000").unwrap();
    assert!((chain.base_from_flange(&[]).unwrap().translation.vector.z - 20.0).abs() < 1e-9);
}

/// Numbers in place of numbers, so that the text stays a URDF: what comes out is a chain of finite numbers or an error.
fn number_damage() -> impl Strategy<Value = Vec<(prop::sample::Index, &'static str)>> {
    let numbers =
        ["0", "-0", "1e308", "-1e308", "1e-320", "1e160", "3.141592653589793", "nan", "inf", "1e-9", "0x1", "", "1 2"];
    prop::collection::vec((any::<prop::sample::Index>(), prop::sample::select(numbers.to_vec())), 1..4)
}

proptest! {
    #[test]
    fn damaged_numbers_are_refused_or_read(robot in 0..12usize, damage in number_damage()) {
        let rows = &robots()[robot].1;
        let mut text = urdf_of(rows);
        for (place, number) in damage {
            let digits: Vec<usize> = text.match_indices(|c: char| c.is_ascii_digit()).map(|(at, _)| at).collect();
            let start = digits[place.index(digits.len())];
            let end = start + text[start..].find(|c: char| !(c.is_ascii_digit() || ".e-".contains(c))).unwrap();
            text.replace_range(start..end, number);
        }
        match chain_from_urdf(&text, "l0", &tip_of(rows)) {
            Ok(chain) => {
                prop_assert!(chain.parameter_ids().into_iter().all(|id| chain.parameter(id).unwrap().is_finite()));
                let calibrated = crate::arms::perturbed(&chain, 0.01, 0.001, &[0.5; 32]);
                if let Ok(written) = write_urdf(&text, "l0", &tip_of(rows), &chain, &calibrated) {
                    prop_assert!(chain_from_urdf(&written, "l0", &tip_of(rows)).is_ok());
                }
            }
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }

    /// A text with random damage is read or refused, and neither panics nor hangs.
    #[test]
    fn damaged_texts_are_refused_or_read(
        robot in 0..12usize,
        damage in prop::collection::vec((any::<prop::sample::Index>(), prop::sample::select(vec!["", "<", ">", "\"", "/", "&", " ", "-", "1e308", "nan", "é", "<joint ", "l1", "<!--", "]]>", "${", "\0"]), 0..9usize), 1..6),
    ) {
        let rows = &robots()[robot].1;
        let mut text = urdf_of(rows);
        for (place, insert, cut) in damage {
            let mut at = place.index(text.len());
            while !text.is_char_boundary(at) { at -= 1; }
            let mut end = (at + cut).min(text.len());
            while !text.is_char_boundary(end) { end += 1; }
            text.replace_range(at..end, insert);
        }
        if let Ok(chain) = chain_from_urdf(&text, "l0", &tip_of(rows)) {
            let calibrated = crate::arms::perturbed(&chain, 0.01, 0.001, &[0.5; 32]);
            if let Ok(written) = write_urdf(&text, "l0", &tip_of(rows), &chain, &calibrated) {
                prop_assert!(chain_from_urdf(&written, "l0", &tip_of(rows)).is_ok());
            }
        }
    }
}
