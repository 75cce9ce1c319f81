//! Angle wrapping: of all angles that are the same posture, the one that a controller wants.

use crate::{Joint, JointKind, KinematicsError, SerialChain};
use std::f64::consts::{PI, TAU};

/// An angle brought into `(-pi, pi]`, radians.
pub(crate) fn wrapped(angle: f64) -> f64 {
    let turned = angle - TAU * ((angle + PI) / TAU).floor();
    // Rounding may leave either end; -pi is written as pi.
    if turned <= -PI {
        turned + TAU
    } else if turned > PI {
        turned - TAU
    } else {
        turned
    }
}

/// The joint value with multiples of 2 pi added, every one that lies within the limits, upwards; without limits, one:
/// in `(-pi, pi]`. A prismatic joint is not wrapped.
pub(crate) fn admitted_revolutions(joint: &Joint, value: f64) -> impl Iterator<Item = f64> {
    let (first, count) = match (joint.kind, joint.limits) {
        (JointKind::Prismatic, _) => (value, usize::from(joint.admits(value))),
        (JointKind::Revolute, None) => (wrapped(value), 1),
        (JointKind::Revolute, Some([lower, upper])) => {
            let first = value + TAU * ((lower - value) / TAU).ceil();
            // Rounding can put a value that lies on the limit one turn up.
            let first = if first - TAU >= lower { first - TAU } else { first };
            (first, if first <= upper { ((upper - first) / TAU) as usize + 1 } else { 0 })
        }
    };
    (0..count).map(move |turn| first + TAU * turn as f64)
}

/// The same posture with multiples of 2 pi added to the revolute joints so that each joint is as near as it can be to a
/// reference and within its limits; `None` where some joint cannot be brought within them.
///
/// `joint_values`, `reference`: radians or metres, one a joint.
///
/// # Errors
/// Wrong number of joints; a value that is not finite.
pub fn nearby(
    chain: &SerialChain,
    joint_values: &[f64],
    reference: &[f64],
) -> Result<Option<Vec<f64>>, KinematicsError> {
    chain.check(joint_values)?;
    chain.check(reference)?;
    let nearest = |(joint, (&value, &reference)): (&Joint, (&f64, &f64))| match (joint.kind, joint.limits) {
        (JointKind::Prismatic, _) => joint.admits(value).then_some(value),
        (JointKind::Revolute, None) => Some(reference + wrapped(value - reference)),
        (JointKind::Revolute, Some([lower, upper])) => {
            // Candidates are TAU apart: the nearest admitted one is the first or last one, or next to the reference.
            let free = reference + wrapped(value - reference);
            let wraps_up = if free < lower { ((lower - free) / TAU).ceil() } else { 0.0 };
            let wraps_down = if free > upper { ((free - upper) / TAU).ceil() } else { 0.0 };
            let inside = free + TAU * (wraps_up - wraps_down);
            joint.admits(inside).then_some(inside)
        }
    };
    Ok(chain.joints().iter().zip(joint_values.iter().zip(reference)).map(nearest).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Link;
    use proptest::prelude::*;

    fn joint() -> Joint {
        Joint::revolute("1", Link::modified_dh(0.0, 0.0, 0.0, 0.0))
    }

    #[test]
    fn pi_is_positive() {
        assert_eq!(wrapped(-PI), PI);
        assert_eq!(wrapped(PI), PI);
        assert_eq!(wrapped(3.0 * PI), PI);
        assert!((wrapped(-7.0) - (TAU - 7.0)).abs() < 1e-15);
    }

    #[test]
    fn wrapped_values_stay_within_limits() {
        let degrees = |angles: &[f64]| angles.iter().map(|a| a.to_radians()).collect::<Vec<f64>>();
        let arm =
            SerialChain::new(vec![joint().with_limits(-105f64.to_radians(), 260f64.to_radians()), joint()]).unwrap();
        let near = |values: &[f64], reference: &[f64]| nearby(&arm, &degrees(values), &degrees(reference)).unwrap();
        let close = |got: Option<Vec<f64>>, want: &[f64]| {
            got.unwrap().iter().zip(degrees(want)).for_each(|(a, b)| assert!((a - b).abs() < 1e-12, "{a} {b}"));
        };
        close(near(&[-120.0, 350.0], &[0.0, 0.0]), &[240.0, -10.0]);
        close(near(&[-104.0, 10.0], &[250.0, 720.0]), &[256.0, 730.0]);
        close(near(&[-98.0, 10.0], &[250.0, -720.0]), &[-98.0, -710.0]);
        let narrow = SerialChain::new(vec![joint().with_limits(-1.0, 1.0)]).unwrap();
        assert_eq!(nearby(&narrow, &[2.0], &[0.0]).unwrap(), None);
        assert!(nearby(&narrow, &[f64::NAN], &[0.0]).is_err());
        assert!(nearby(&narrow, &[0.0], &[]).is_err());
    }

    proptest! {
        #[test]
        fn the_nearest_wrapped_value_is_found(value in -30.0..30.0f64, reference in -30.0..30.0f64, lower in -9.0..9.0f64, span in 0.0..20.0f64) {
            let arm = SerialChain::new(vec![joint().with_limits(lower, lower + span)]).unwrap();
            let got = nearby(&arm, &[value], &[reference]).unwrap();
            let candidates: Vec<f64> =
                (-12..=12).map(|turn| value + TAU * f64::from(turn)).filter(|q| (lower..=lower + span).contains(q)).collect();
            let best = candidates.iter().map(|q| (q - reference).abs()).fold(f64::INFINITY, f64::min);
            prop_assert_eq!(got.is_none(), candidates.is_empty());
            if let Some(got) = got {
                prop_assert!(((got[0] - reference).abs() - best).abs() < 1e-9);
                prop_assert!(((got[0] - value) / TAU).fract().abs().min(1.0 - ((got[0] - value) / TAU).fract().abs()) < 1e-9);
            }
            prop_assert_eq!(admitted_revolutions(&arm.joints()[0], value).count(), candidates.len());
        }
    }
}
