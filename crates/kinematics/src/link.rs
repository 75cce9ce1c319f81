//! One link as a product of elementary motions.
//!
//! Every supported form is a product of rotations about and translations along coordinate axes, one parameter
//! each. Forward kinematics multiplies them; the Jacobian reads one twist off each. References: Craig,
//! "Introduction to Robotics" (modified DH); Hayati and Mirmirani, "Improving the absolute positioning accuracy
//! of robot manipulators", 1985 (the form for nearly parallel axes).

use crate::Isometry3;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::fmt;

/// The order of the elementary motions of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkForm {
    /// `Rx(alpha) Tx(a) Rz(q + theta_offset) Tz(d)`: Craig's modified DH, the paper's convention.
    ModifiedDh,
    /// `Rz(q + theta_offset) Tz(d) Tx(a) Rx(alpha)`: classic DH.
    StandardDh,
    /// `Rx(alpha) Tx(a) Ry(beta) Rz(q + theta_offset)`: for an axis nearly parallel to the one before, modified order.
    Hayati,
    /// `Rz(q + theta_offset) Tx(a) Rx(alpha) Ry(beta)`: for an axis nearly parallel to the next one, classic order.
    StandardHayati,
}

/// Which of a link's numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ParameterKind {
    /// Twist between neighbouring axes, a rotation about x. Radians.
    Alpha,
    /// Distance between neighbouring axes, along x. Metres.
    A,
    /// Hayati's second angle, about y. Radians.
    Beta,
    /// Offset added to the joint value of a revolute joint, about z. Radians.
    ThetaOffset,
    /// Offset along the joint axis z. Metres.
    D,
}

impl ParameterKind {
    /// Whether the parameter is an angle (radians) and not a length (metres).
    pub fn is_angle(self) -> bool {
        matches!(self, ParameterKind::Alpha | ParameterKind::Beta | ParameterKind::ThetaOffset)
    }
}

/// A kinematic parameter of a chain: which number of which joint.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ParameterId {
    /// Joint, counted from 0. It is shown counted from 1, as in the paper.
    pub joint: usize,
    /// Which of the joint's parameters.
    pub kind: ParameterKind,
}

impl fmt::Display for ParameterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = match self.kind {
            ParameterKind::Alpha => "alpha",
            ParameterKind::A => "a",
            ParameterKind::Beta => "beta",
            ParameterKind::ThetaOffset => "theta_offset",
            ParameterKind::D => "d",
        };
        write!(f, "{name}_{}", self.joint + 1)
    }
}

/// The geometry of one link.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Which product the numbers belong to.
    pub form: LinkForm,
    /// Radians.
    pub alpha: f64,
    /// Metres.
    pub a: f64,
    /// Radians; only in the Hayati forms.
    pub beta: f64,
    /// Radians.
    pub theta_offset: f64,
    /// Metres; only in the DH forms.
    pub d: f64,
}

/// A rotation about or a translation along a coordinate axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ElementaryMotion {
    /// About x, radians.
    RotateX(f64),
    /// About y, radians.
    RotateY(f64),
    /// About z, radians.
    RotateZ(f64),
    /// Along x, metres.
    TranslateX(f64),
    /// Along z, metres.
    TranslateZ(f64),
}

impl ElementaryMotion {
    /// The motion as a transform.
    pub fn transform(self) -> Isometry3 {
        let rotation = |axis, angle| {
            Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_axis_angle(&axis, angle))
        };
        match self {
            ElementaryMotion::RotateX(angle) => rotation(Vector3::x_axis(), angle),
            ElementaryMotion::RotateY(angle) => rotation(Vector3::y_axis(), angle),
            ElementaryMotion::RotateZ(angle) => rotation(Vector3::z_axis(), angle),
            ElementaryMotion::TranslateX(length) => Isometry3::translation(length, 0.0, 0.0),
            ElementaryMotion::TranslateZ(length) => Isometry3::translation(0.0, 0.0, length),
        }
    }
}

impl Link {
    /// A modified DH link: `Rx(alpha) Tx(a) Rz(q + theta_offset) Tz(d)`. Radians and metres.
    pub fn modified_dh(alpha: f64, a: f64, theta_offset: f64, d: f64) -> Self {
        Link { form: LinkForm::ModifiedDh, alpha, a, beta: 0.0, theta_offset, d }
    }

    /// A standard DH link: `Rz(q + theta_offset) Tz(d) Tx(a) Rx(alpha)`. Radians and metres.
    pub fn standard_dh(theta_offset: f64, d: f64, a: f64, alpha: f64) -> Self {
        Link { form: LinkForm::StandardDh, alpha, a, beta: 0.0, theta_offset, d }
    }

    /// A Hayati link: `Rx(alpha) Tx(a) Ry(beta) Rz(q + theta_offset)`. Radians and metres.
    pub fn hayati(alpha: f64, a: f64, beta: f64, theta_offset: f64) -> Self {
        Link { form: LinkForm::Hayati, alpha, a, beta, theta_offset, d: 0.0 }
    }

    /// The four parameters that the form has, in the order in which they are applied.
    pub fn parameters(&self) -> [ParameterKind; 4] {
        use ParameterKind::*;
        match self.form {
            LinkForm::ModifiedDh => [Alpha, A, ThetaOffset, D],
            LinkForm::StandardDh => [ThetaOffset, D, A, Alpha],
            LinkForm::Hayati => [Alpha, A, Beta, ThetaOffset],
            LinkForm::StandardHayati => [ThetaOffset, A, Alpha, Beta],
        }
    }

    /// The value of a parameter, radians or metres; `None` where the form lacks it.
    pub fn get(&self, kind: ParameterKind) -> Option<f64> {
        self.parameters().contains(&kind).then_some(match kind {
            ParameterKind::Alpha => self.alpha,
            ParameterKind::A => self.a,
            ParameterKind::Beta => self.beta,
            ParameterKind::ThetaOffset => self.theta_offset,
            ParameterKind::D => self.d,
        })
    }

    /// Sets a parameter, radians or metres; `false` where the form lacks it.
    #[must_use]
    pub fn set(&mut self, kind: ParameterKind, value: f64) -> bool {
        if !self.parameters().contains(&kind) {
            return false;
        }
        *match kind {
            ParameterKind::Alpha => &mut self.alpha,
            ParameterKind::A => &mut self.a,
            ParameterKind::Beta => &mut self.beta,
            ParameterKind::ThetaOffset => &mut self.theta_offset,
            ParameterKind::D => &mut self.d,
        } = value;
        true
    }

    /// The elementary motions, each with the parameter that drives it, when the joint's rotation is `q_angle`
    /// (revolute) or its translation `q_length` (prismatic); the other one is zero.
    pub fn motions(&self, q_angle: f64, q_length: f64) -> [(ParameterKind, ElementaryMotion); 4] {
        use ElementaryMotion::*;
        self.parameters().map(|kind| {
            let motion = match kind {
                ParameterKind::Alpha => RotateX(self.alpha),
                ParameterKind::A => TranslateX(self.a),
                ParameterKind::Beta => RotateY(self.beta),
                ParameterKind::ThetaOffset => RotateZ(self.theta_offset + q_angle),
                ParameterKind::D => TranslateZ(self.d + q_length),
            };
            (kind, motion)
        })
    }

    /// The link's transform when the joint's rotation is `q_angle` or its translation `q_length`.
    pub fn transform(&self, q_angle: f64, q_length: f64) -> Isometry3 {
        self.motions(q_angle, q_length)
            .into_iter()
            .fold(Isometry3::identity(), |pose, (_, motion)| pose * motion.transform())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn hayati_with_beta_zero_is_dh_with_d_zero(alpha in -3.0..3.0f64, a in -1.0..1.0f64, offset in -3.0..3.0f64, q in -3.0..3.0f64) {
            let hayati = Link::hayati(alpha, a, 0.0, offset).transform(q, 0.0);
            let dh = Link::modified_dh(alpha, a, offset, 0.0).transform(q, 0.0);
            prop_assert!((hayati.to_homogeneous() - dh.to_homogeneous()).norm() < 1e-12);
            let standard = Link::standard_dh(offset, 0.0, a, alpha);
            let standard_hayati = Link { form: LinkForm::StandardHayati, ..standard };
            prop_assert!((standard.transform(q, 0.0).to_homogeneous() - standard_hayati.transform(q, 0.0).to_homogeneous()).norm() < 1e-12);
        }
    }

    #[test]
    fn a_form_refuses_the_parameter_it_lacks() {
        let mut link = Link::hayati(0.1, 0.2, 0.0, 0.3);
        assert_eq!(link.get(ParameterKind::D), None);
        assert!(!link.set(ParameterKind::D, 1.0));
        assert!(link.set(ParameterKind::Beta, 1.0));
        assert_eq!(link.get(ParameterKind::Beta), Some(1.0));
    }
}
