//! What can be calibrated: one name, one unit and one natural scale a parameter.

use serde::{Deserialize, Serialize};
use skclam_kinematics::{ParameterId, ParameterKind};
use std::fmt;
use std::str::FromStr;

/// The six numbers of the mount `flange_from_color`. Rotations are about the flange's axes through the camera's centre,
/// relative to the nominal mount; translations are along the flange's axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum MountComponent {
    RotationX,
    RotationY,
    RotationZ,
    TranslationX,
    TranslationY,
    TranslationZ,
}

/// An intrinsic parameter of the colour camera, in the order of [`skclam_geometry::INTRINSICS`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum Intrinsic {
    Fx,
    Fy,
    Cx,
    Cy,
    K1,
    K2,
    P1,
    P2,
    K3,
}

/// A number that an estimator may free. Joints are counted from 0 in values and from 1 in names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Parameter {
    /// A DH or Hayati parameter of the arm.
    Chain(ParameterId),
    /// A component of the mount.
    Mount(MountComponent),
    /// An intrinsic parameter of the colour camera.
    Intrinsic(Intrinsic),
    /// `b` of `z = a + b z_measured`.
    DepthScale,
    /// `a` of `z = a + b z_measured`, metres.
    DepthOffset,
    /// A component of what `color_from_depth` is off: the depth camera's place beside the colour camera, in the colour
    /// camera's axes, about its centre.
    DepthExtrinsic(MountComponent),
    /// The board's squares as a multiple of what the rig says.
    BoardScale,
    /// Seconds by which the joints must be taken later than the posture's timestamp says.
    TimeOffset,
    /// Gear error of a joint: its true value is greater by this times the sine of its encoder value. Radians.
    TransmissionSin(usize),
    /// The same with the cosine.
    TransmissionCos(usize),
    /// Compliance of a joint: radians of deflection per metre of gravity torque arm (horizontal distance between its
    /// axis and the flange).
    Compliance(usize),
}

/// The unit of a parameter inside the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum Unit {
    Radian,
    Metre,
    Pixel,
    One,
    Second,
    RadianPerMetre,
}

impl Unit {
    /// Factor to the unit of files and screens, and its name ("" for plain numbers).
    pub fn of_files(self) -> (f64, &'static str) {
        match self {
            Unit::Radian => (1f64.to_degrees(), "deg"),
            Unit::Metre => (1e3, "mm"),
            Unit::Pixel => (1.0, "px"),
            Unit::One => (1.0, ""),
            Unit::Second => (1.0, "s"),
            Unit::RadianPerMetre => (1f64.to_degrees(), "deg/m"),
        }
    }
}

impl MountComponent {
    /// All six: rotations, then translations.
    pub const ALL: [MountComponent; 6] = [
        MountComponent::RotationX,
        MountComponent::RotationY,
        MountComponent::RotationZ,
        MountComponent::TranslationX,
        MountComponent::TranslationY,
        MountComponent::TranslationZ,
    ];

    /// The axis (0 to 2) about or along which it moves.
    pub fn axis(self) -> usize {
        self as usize % 3
    }

    /// Whether it is a rotation.
    pub fn is_rotation(self) -> bool {
        (self as usize) < 3
    }
}

impl Intrinsic {
    /// All nine, in the order of [`skclam_geometry::INTRINSICS`].
    pub const ALL: [Intrinsic; 9] = [
        Intrinsic::Fx,
        Intrinsic::Fy,
        Intrinsic::Cx,
        Intrinsic::Cy,
        Intrinsic::K1,
        Intrinsic::K2,
        Intrinsic::P1,
        Intrinsic::P2,
        Intrinsic::K3,
    ];
}

const MOUNT_NAMES: [&str; 6] = ["mount_rx", "mount_ry", "mount_rz", "mount_x", "mount_y", "mount_z"];
const EXTRINSIC_NAMES: [&str; 6] = ["depth_rx", "depth_ry", "depth_rz", "depth_x", "depth_y", "depth_z"];
const INTRINSIC_NAMES: [&str; 9] = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];

impl Parameter {
    /// The unit inside the program.
    pub fn unit(self) -> Unit {
        match self {
            Parameter::Chain(id) if id.kind.is_angle() => Unit::Radian,
            Parameter::Chain(_) | Parameter::DepthOffset => Unit::Metre,
            Parameter::Mount(component) | Parameter::DepthExtrinsic(component) if component.is_rotation() => {
                Unit::Radian
            }
            Parameter::Mount(_) | Parameter::DepthExtrinsic(_) => Unit::Metre,
            Parameter::Intrinsic(Intrinsic::Fx | Intrinsic::Fy | Intrinsic::Cx | Intrinsic::Cy) => Unit::Pixel,
            Parameter::Intrinsic(_) | Parameter::DepthScale | Parameter::BoardScale => Unit::One,
            Parameter::TimeOffset => Unit::Second,
            Parameter::TransmissionSin(_) | Parameter::TransmissionCos(_) => Unit::Radian,
            Parameter::Compliance(_) => Unit::RadianPerMetre,
        }
    }

    /// A change that counts as one: 0.01 rad, 1 cm, 10 px, 0.01, 10 ms, 0.001 rad of gear error or a metre of gravity
    /// torque arm. It turns steps and singular values into comparable numbers.
    pub fn scale(self) -> f64 {
        match self {
            Parameter::TransmissionSin(_) | Parameter::TransmissionCos(_) | Parameter::Compliance(_) => 1e-3,
            _ => match self.unit() {
                Unit::Pixel => 10.0,
                _ => 1e-2,
            },
        }
    }

    /// Whether the parameter belongs to the arm and needs joint values.
    pub fn needs_joints(self) -> bool {
        matches!(
            self,
            Parameter::Chain(_)
                | Parameter::TimeOffset
                | Parameter::TransmissionSin(_)
                | Parameter::TransmissionCos(_)
                | Parameter::Compliance(_)
        )
    }

    /// Whether the parameter belongs to the instruments that look at the scene (cameras, board) and to neither arm nor
    /// mount: what the answer has to be independent of.
    pub fn is_nuisance(self) -> bool {
        !self.moves_camera()
    }

    /// Whether the parameter moves the camera.
    pub fn moves_camera(self) -> bool {
        self.needs_joints() || matches!(self, Parameter::Mount(_))
    }
}

impl fmt::Display for Parameter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Parameter::Chain(id) => id.fmt(f),
            Parameter::Mount(component) => f.write_str(MOUNT_NAMES[component as usize]),
            Parameter::Intrinsic(intrinsic) => f.write_str(INTRINSIC_NAMES[intrinsic as usize]),
            Parameter::DepthScale => f.write_str("depth_scale"),
            Parameter::DepthOffset => f.write_str("depth_offset"),
            Parameter::DepthExtrinsic(component) => f.write_str(EXTRINSIC_NAMES[component as usize]),
            Parameter::BoardScale => f.write_str("board_scale"),
            Parameter::TimeOffset => f.write_str("time_offset"),
            Parameter::TransmissionSin(joint) => write!(f, "transmission_sin_{}", joint + 1),
            Parameter::TransmissionCos(joint) => write!(f, "transmission_cos_{}", joint + 1),
            Parameter::Compliance(joint) => write!(f, "compliance_{}", joint + 1),
        }
    }
}

/// The text names no parameter.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "\"{0}\" is no parameter; expected alpha_K, a_K, beta_K, theta_offset_K, d_K (K a joint, from 1), mount_rx|ry|rz|x|y|z, fx, fy, cx, cy, k1, k2, p1, p2, k3, depth_scale, depth_offset, depth_rx|ry|rz|x|y|z, board_scale, time_offset, transmission_sin_K, transmission_cos_K or compliance_K"
)]
pub struct ParseParameterError(pub String);

impl FromStr for Parameter {
    type Err = ParseParameterError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let error = || ParseParameterError(text.to_owned());
        if let Some(at) = MOUNT_NAMES.iter().position(|name| *name == text) {
            return Ok(Parameter::Mount(MountComponent::ALL[at]));
        }
        if let Some(at) = INTRINSIC_NAMES.iter().position(|name| *name == text) {
            return Ok(Parameter::Intrinsic(Intrinsic::ALL[at]));
        }
        if let Some(at) = EXTRINSIC_NAMES.iter().position(|name| *name == text) {
            return Ok(Parameter::DepthExtrinsic(MountComponent::ALL[at]));
        }
        match text {
            "board_scale" => return Ok(Parameter::BoardScale),
            "depth_scale" => return Ok(Parameter::DepthScale),
            "depth_offset" => return Ok(Parameter::DepthOffset),
            "time_offset" => return Ok(Parameter::TimeOffset),
            _ => {}
        }
        let (kind, joint) = text.rsplit_once('_').ok_or_else(error)?;
        if joint.starts_with('+') {
            return Err(error());
        }
        let joint = joint.parse::<usize>().ok().and_then(|joint| joint.checked_sub(1)).ok_or_else(error)?;
        let chain = |kind| Parameter::Chain(ParameterId { joint, kind });
        Ok(match kind {
            "alpha" => chain(ParameterKind::Alpha),
            "a" => chain(ParameterKind::A),
            "beta" => chain(ParameterKind::Beta),
            "theta_offset" => chain(ParameterKind::ThetaOffset),
            "d" => chain(ParameterKind::D),
            "transmission_sin" => Parameter::TransmissionSin(joint),
            "transmission_cos" => Parameter::TransmissionCos(joint),
            "compliance" => Parameter::Compliance(joint),
            _ => return Err(error()),
        })
    }
}

impl TryFrom<String> for Parameter {
    type Error = ParseParameterError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Parameter> for String {
    fn from(parameter: Parameter) -> Self {
        parameter.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        let kinds =
            [ParameterKind::Alpha, ParameterKind::A, ParameterKind::Beta, ParameterKind::ThetaOffset, ParameterKind::D];
        let all = (0..7)
            .flat_map(|joint| kinds.map(|kind| Parameter::Chain(ParameterId { joint, kind })))
            .chain(MountComponent::ALL.map(Parameter::Mount))
            .chain(Intrinsic::ALL.map(Parameter::Intrinsic))
            .chain(MountComponent::ALL.map(Parameter::DepthExtrinsic))
            .chain([Parameter::DepthScale, Parameter::DepthOffset, Parameter::BoardScale, Parameter::TimeOffset])
            .chain([Parameter::TransmissionSin(2), Parameter::TransmissionCos(0), Parameter::Compliance(5)]);
        for parameter in all {
            assert_eq!(parameter.to_string().parse::<Parameter>().unwrap(), parameter);
        }
        for wrong in ["", "alpha", "alpha_0", "alpha_x", "alpha_+1", "gamma_2", "mount", "_1"] {
            assert!(wrong.parse::<Parameter>().is_err(), "{wrong}");
        }
    }
}
