//! A DH chain from joint axes: Denavit-Hartenberg links where neighbouring axes are clearly not parallel, Hayati links
//! where they nearly are.
//!
//! Frame i has its z along axis i. It meets axis i+1 at the foot of the common normal (DH: `Rx(alpha) Tx(a)` leads
//! there, `Rz(theta) Tz(d)` turns and slides on), or, for nearly parallel axes, at the point where axis i+1 crosses the
//! plane `z = 0` of frame i (Hayati: `Rx(alpha) Tx(a) Ry(beta)`), because the common normal of such a pair lies
//! anywhere and may be far away. What DH cannot express goes to the two fixed transforms at the ends.

use crate::chain::JointKind;
use crate::{ElementaryMotion, Isometry3, Joint, KinematicsError, Link, SerialChain};
use nalgebra::{Point3, Quaternion, Translation3, Unit, UnitQuaternion, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};

/// Sine of the angle (10 deg) below which axes count as nearly parallel.
const NEARLY_PARALLEL: f64 = 0.174;
/// Axes nearer than this (metres) coincide: the direction between them is rounding.
const COINCIDENT: f64 = 1e-12;

/// A joint by its axis when all joint values are zero.
#[derive(Debug, Clone, PartialEq)]
pub struct JointAxis {
    /// What the controller calls it.
    pub name: String,
    /// Revolute or prismatic.
    pub kind: JointKind,
    /// Lower and upper limit of the joint value, radians or metres.
    pub limits: Option<[f64; 2]>,
    /// A point on the axis, base frame, metres. Of no matter for a prismatic joint.
    pub point_in_base: Point3<f64>,
    /// The axis, base frame; a revolute joint turns about it by the right-hand rule, a prismatic one slides along it.
    pub direction_in_base: Unit<Vector3<f64>>,
}

impl SerialChain {
    /// The chain with these axes and with this flange pose when all joint values are zero.
    ///
    /// Joint 1 has `alpha = a = 0`: where the axis is in the base is in
    /// [`base_from_first`](SerialChain::base_from_first), the identity if it is the z axis of the base. The
    /// [`last_from_flange`](SerialChain::last_from_flange) is the identity if the flange's z axis is the last axis and
    /// the last link is a DH link.
    ///
    /// # Errors
    /// A number that is not finite; limits the wrong way round.
    pub fn from_axes(axes: &[JointAxis], base_from_flange_at_zero: &Isometry3) -> Result<Self, KinematicsError> {
        for (index, axis) in axes.iter().enumerate() {
            let numbers = axis.point_in_base.iter().chain(axis.direction_in_base.iter());
            if let Some(value) = numbers.into_iter().find(|value| !value.is_finite()) {
                let what = format!("the axis of joint {}", index + 1);
                return Err(KinematicsError::NotFinite { what, value: value.to_string() });
            }
        }
        let Some(first) = axes.first() else {
            return SerialChain::with_ends(Isometry3::identity(), Vec::new(), *base_from_flange_at_zero);
        };
        let mut lines = axes.to_vec();
        if first.kind == JointKind::Prismatic {
            lines[0].point_in_base = Point3::origin();
        }
        let base_from_first = frame_on(&lines[0], &Isometry3::identity());
        let mut joints: Vec<Joint> = Vec::with_capacity(axes.len());
        // The frame of the latest joint before its own theta and d; those follow from the next axis.
        let mut frame = base_from_first;
        let mut link = Link::modified_dh(0.0, 0.0, 0.0, 0.0);
        for index in 0..axes.len() {
            let slides = link.get(crate::ParameterKind::D).is_some();
            if index + 1 == axes.len() {
                towards_flange(&mut link, &frame, base_from_flange_at_zero, slides);
                joints.push(joint(&lines[index], link));
                frame *= turn_and_slide(&link);
                break;
            }
            if lines[index + 1].kind == JointKind::Prismatic {
                // Any parallel line will do; this one needs no length.
                lines[index + 1].point_in_base = Point3::from(frame.translation.vector);
            }
            let next = match relation(&lines[index], &lines[index + 1]) {
                Relation::Skew => {
                    let normal = CommonNormal::new(&lines[index], &lines[index + 1]);
                    if slides {
                        link.d = along(&frame, &normal.foot);
                    }
                    link.theta_offset = turn_to(&frame, &normal.direction);
                    // Intersecting axes: either direction of the normal serves; take the smaller turn.
                    let flip = normal.a == 0.0 && link.theta_offset.abs() > FRAC_PI_2 + 1e-9;
                    if flip {
                        link.theta_offset = turn_to(&frame, &-normal.direction);
                    }
                    Link::modified_dh(if flip { -normal.alpha } else { normal.alpha }, normal.a, 0.0, 0.0)
                }
                Relation::NearlyParallel => {
                    if slides {
                        link.d = along(&frame, &crossing(&lines[index..]).unwrap_or(frame.translation.vector.into()));
                    }
                    let across = frame * ElementaryMotion::TranslateZ(link.d).transform();
                    let (x, a) = offset_in_plane(&across, &lines[index + 1]);
                    link.theta_offset = if a < COINCIDENT { 0.0 } else { turn_to(&frame, &x) };
                    let z = (frame * turn_and_slide(&link)).rotation.inverse() * lines[index + 1].direction_in_base;
                    Link::hayati(
                        snapped((-z.y).atan2(z.z)),
                        if a < COINCIDENT { 0.0 } else { a },
                        snapped(z.x.atan2(z.y.hypot(z.z))),
                        0.0,
                    )
                }
                Relation::Sliding => {
                    let x = lines[index].direction_in_base.cross(&lines[index + 1].direction_in_base);
                    link.theta_offset = if x.norm() > COINCIDENT { turn_to(&frame, &x) } else { 0.0 };
                    if link.theta_offset.abs() > FRAC_PI_2 + 1e-9 {
                        link.theta_offset = turn_to(&frame, &-x);
                    }
                    let z = (frame * turn_and_slide(&link)).rotation.inverse() * lines[index + 1].direction_in_base;
                    Link::modified_dh(snapped((-z.y).atan2(z.z)), 0.0, 0.0, 0.0)
                }
            };
            joints.push(joint(&lines[index], link));
            frame *= turn_and_slide(&link);
            link = next;
            frame *= link.transform(0.0, 0.0);
        }
        let last_from_flange = tidied(frame.inverse() * base_from_flange_at_zero);
        SerialChain::with_ends(tidied(base_from_first), joints, last_from_flange)
    }
}

fn joint(axis: &JointAxis, link: Link) -> Joint {
    Joint { name: axis.name.clone(), kind: axis.kind, link, limits: axis.limits }
}

/// The part of a link that turns about and slides along its own axis.
fn turn_and_slide(link: &Link) -> Isometry3 {
    ElementaryMotion::RotateZ(link.theta_offset).transform() * ElementaryMotion::TranslateZ(link.d).transform()
}

/// How a link gets from one axis to the next.
enum Relation {
    /// Not parallel: along the common normal.
    Skew,
    /// Nearly parallel, the next joint revolute: within the plane across the first axis.
    NearlyParallel,
    /// Nearly parallel, the next joint prismatic: its axis is taken through the frame's origin.
    Sliding,
}

fn relation(axis: &JointAxis, next: &JointAxis) -> Relation {
    let sine = axis.direction_in_base.cross(&next.direction_in_base).norm();
    match (sine > NEARLY_PARALLEL, next.kind) {
        (true, JointKind::Revolute) => Relation::Skew,
        (false, JointKind::Revolute) => Relation::NearlyParallel,
        (_, JointKind::Prismatic) => Relation::Sliding,
    }
}

struct CommonNormal {
    /// Where it leaves the first axis.
    foot: Point3<f64>,
    direction: Vector3<f64>,
    alpha: f64,
    a: f64,
}

impl CommonNormal {
    fn new(axis: &JointAxis, next: &JointAxis) -> Self {
        let (u, v) = (axis.direction_in_base.into_inner(), next.direction_in_base.into_inner());
        let cross = u.cross(&v);
        let sine = cross.norm();
        let between = next.point_in_base - axis.point_in_base;
        let foot = axis.point_in_base + u * (between.cross(&v).dot(&cross) / (sine * sine));
        let a = between.dot(&cross) / sine;
        let (direction, a, sine) = if a < -COINCIDENT { (-cross / sine, -a, -sine) } else { (cross / sine, a, sine) };
        CommonNormal { foot, direction, alpha: sine.atan2(u.dot(&v)), a: if a.abs() < COINCIDENT { 0.0 } else { a } }
    }
}

/// For a run of nearly parallel axes, the point of the first axis from which the crossings lead to the common normal
/// of the last axis of the run and the one after it; `None` if nothing after the run asks for a point.
fn crossing(lines: &[JointAxis]) -> Option<Point3<f64>> {
    let end = lines.windows(2).position(|pair| !matches!(relation(&pair[0], &pair[1]), Relation::NearlyParallel))?;
    if lines[end + 1].kind == JointKind::Prismatic {
        return None;
    }
    let foot = CommonNormal::new(&lines[end], &lines[end + 1]).foot;
    // The plane across axis i through a point holds the point's projection on axis i.
    Some(lines[..end].iter().rev().fold(foot, |point, line| {
        let direction = line.direction_in_base.into_inner();
        line.point_in_base + direction * direction.dot(&(point - line.point_in_base))
    }))
}

/// Direction and distance from a frame's origin to where a line crosses the frame's plane z = 0.
fn offset_in_plane(frame: &Isometry3, line: &JointAxis) -> (Vector3<f64>, f64) {
    let z = frame.rotation * Vector3::z();
    let origin = Point3::from(frame.translation.vector);
    let direction = line.direction_in_base.into_inner();
    let distance = z.dot(&(origin - line.point_in_base)) / z.dot(&direction);
    let offset = line.point_in_base + direction * distance - origin;
    (offset, offset.norm())
}

/// How far along the frame's z axis a point is.
fn along(frame: &Isometry3, point: &Point3<f64>) -> f64 {
    snapped((frame.rotation * Vector3::z()).dot(&(point.coords - frame.translation.vector)))
}

/// The angle about the frame's z axis from its x axis to a direction.
fn turn_to(frame: &Isometry3, direction: &Vector3<f64>) -> f64 {
    let x = frame.rotation.inverse() * direction;
    snapped(x.y.atan2(x.x))
}

/// Lengths and angles this small are rounding; 0 reads better.
fn snapped(value: f64) -> f64 {
    if value.abs() < 1e-14 { 0.0 } else { value }
}

/// The same for a whole transform at an end of the chain.
fn tidied(pose: Isometry3) -> Isometry3 {
    let rotation = UnitQuaternion::new_normalize(Quaternion::from(pose.rotation.coords.map(snapped)));
    Isometry3::from_parts(Translation3::from(pose.translation.vector.map(snapped)), rotation)
}

/// The frame on an axis that is least turned from a given one, at the point nearest to it.
fn frame_on(axis: &JointAxis, frame: &Isometry3) -> Isometry3 {
    let z = frame.rotation * Vector3::z();
    let direction = axis.direction_in_base.into_inner();
    // A turn by nearly half a turn has no precise axis: reverse z about x first, and turn by what is left.
    let reversed = z.dot(&direction) < 0.0;
    let half_turn = if reversed { PI } else { 0.0 };
    let start = frame.rotation * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), half_turn);
    let z = if reversed { -z } else { z };
    let turn = UnitQuaternion::new_normalize(Quaternion::from_parts(1.0 + z.dot(&direction), z.cross(&direction)));
    let origin = Point3::from(frame.translation.vector);
    let point = axis.point_in_base - direction * direction.dot(&(axis.point_in_base - origin));
    Isometry3::from_parts(point.into(), turn * start)
}

/// Turns and slides the last frame to the flange's, as far as its own axis lets it.
fn towards_flange(link: &mut Link, frame: &Isometry3, base_from_flange: &Isometry3, slides: bool) {
    let flange = frame.inverse() * base_from_flange;
    if slides {
        link.d = snapped(flange.translation.vector.z);
    }
    let (x, z) = (flange.rotation * Vector3::x(), flange.rotation * Vector3::z());
    if z.z > 1.0 - 1e-12 {
        link.theta_offset = snapped(x.y.atan2(x.x));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LinkForm;
    use crate::arms::{hp3_like, hp3j, perturbed, seven_joints, spherical_standard_dh, ur5e};
    use proptest::prelude::*;

    fn axes_of(chain: &SerialChain) -> (Vec<JointAxis>, Isometry3) {
        let at_zero = chain.jacobian(&vec![0.0; chain.joint_count()]).unwrap();
        let axis = |(joint, twist): (&Joint, &crate::Twist)| {
            let (v, omega) = (Vector3::new(twist[0], twist[1], twist[2]), Vector3::new(twist[3], twist[4], twist[5]));
            let (point, direction) = match joint.kind {
                JointKind::Revolute => (omega.cross(&v), omega),
                JointKind::Prismatic => (Vector3::new(0.3, -0.2, 0.7), v),
            };
            JointAxis {
                name: joint.name.clone(),
                kind: joint.kind,
                limits: joint.limits,
                point_in_base: point.into(),
                direction_in_base: Unit::new_normalize(direction),
            }
        };
        (chain.joints().iter().zip(&at_zero.by_joint).map(axis).collect(), at_zero.base_from_flange)
    }

    fn rebuilt(chain: &SerialChain) -> SerialChain {
        let (axes, flange) = axes_of(chain);
        SerialChain::from_axes(&axes, &flange).unwrap()
    }

    fn difference(a: &SerialChain, b: &SerialChain, joint_values: &[f64]) -> f64 {
        let pose = |chain: &SerialChain| chain.base_from_flange(joint_values).unwrap().to_homogeneous();
        (pose(a) - pose(b)).norm()
    }

    #[test]
    fn parallel_axes_become_hayati() {
        let form = |chain: &SerialChain| chain.joints().iter().map(|joint| joint.link.form).collect::<Vec<_>>();
        use LinkForm::{Hayati, ModifiedDh};
        assert_eq!(form(&rebuilt(&hp3j())), [ModifiedDh, ModifiedDh, Hayati, ModifiedDh, ModifiedDh, ModifiedDh]);
        assert_eq!(form(&rebuilt(&ur5e())), [ModifiedDh, ModifiedDh, Hayati, Hayati, ModifiedDh, ModifiedDh]);
    }

    #[test]
    fn a_dh_table_is_found_again() {
        let (given, got) = (hp3_like(), rebuilt(&hp3_like()));
        assert!(got.base_from_first().to_homogeneous() == nalgebra::Matrix4::identity());
        assert!((got.last_from_flange().to_homogeneous() - nalgebra::Matrix4::identity()).norm() < 1e-12);
        for id in given.parameter_ids() {
            let (a, b) = (given.parameter(id).unwrap(), got.parameter(id).unwrap());
            assert!(
                (a - b).abs() < 1e-12 || (a.abs() - std::f64::consts::PI).abs() + (b.abs() - PI).abs() < 1e-12,
                "{id}: {a} {b}"
            );
        }
    }

    #[test]
    fn antiparallel_and_reversed_bases() {
        for tilt in [0.0, 1e-15, 1e-12, 1e-10, 1e-8, 1e-5] {
            let down = Isometry3::rotation(Vector3::new(PI + tilt, 0.0, 0.0));
            let chain = SerialChain::with_ends(down, hp3j().joints().to_vec(), down).unwrap();
            let values = [0.3, -0.8, 1.1, 0.4, 0.5, -2.0];
            assert!(difference(&rebuilt(&chain), &chain, &values) < 1e-13, "{tilt}");
        }
    }

    #[test]
    fn wrong_numbers_are_refused() {
        let (mut axes, flange) = axes_of(&hp3j());
        axes[3].point_in_base.y = f64::INFINITY;
        assert!(SerialChain::from_axes(&axes, &flange).unwrap_err().to_string().contains("the axis of joint 4 is inf"));
        assert_eq!(SerialChain::from_axes(&[], &flange).unwrap().base_from_flange(&[]).unwrap(), flange);
    }

    proptest! {
        #[test]
        fn forward_kinematics_are_kept(
            arm in 0..6usize,
            draws in prop::collection::vec(-1.0..1.0f64, 28),
            size in prop::sample::select(vec![0.0, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3, 0.02, 0.2, 1.0]),
            values in prop::collection::vec(-3.0..3.0f64, 7),
            ends in prop::collection::vec(-1.0..1.0f64, 12),
            slides in 0..128u32,
        ) {
            let slide_between = arm == 5;
            let plain = [hp3j(), hp3_like(), ur5e(), spherical_standard_dh(), seven_joints(), seven_joints()][arm].clone();
            let moved = perturbed(&plain, size, 0.1 * size, &draws);
            let mut joints = moved.joints().to_vec();
            if slide_between {
                for (index, joint) in joints.iter_mut().enumerate().filter(|(index, _)| slides & (1 << index) != 0) {
                    joint.kind = JointKind::Prismatic;
                    joint.name = format!("slide {index}");
                }
            }
            let end = |v: &[f64]| Isometry3::new(Vector3::new(v[0], v[1], v[2]), 3.0 * Vector3::new(v[3], v[4], v[5]));
            let chain = SerialChain::with_ends(end(&ends[..6]), joints, end(&ends[6..])).unwrap();
            let got = rebuilt(&chain);
            let values = &values[..chain.joint_count()];
            prop_assert!(difference(&got, &chain, values) < 1e-11, "{}", difference(&got, &chain, values));
            prop_assert!(got.parameter_ids().into_iter().all(|id| got.parameter(id).unwrap().abs() < 40.0));
        }
    }
}
