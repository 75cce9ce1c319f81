//! Which parameters are free: the user's choice, and the ordered list that it means.

use crate::{CalibrationError, Intrinsic, MountComponent, Parameter};
use serde::{Deserialize, Serialize};
use skclam_kinematics::{LinkForm, ParameterId, ParameterKind};
use skclam_rig::Rig;
use std::fmt;
use std::str::FromStr;

/// Which parameters an estimator frees.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Free {
    /// What the data can identify: see [`Free::candidates`]. The gauge is fixed, priors hold the rest.
    #[default]
    Auto,
    /// The paper's: `alpha` and `theta_offset` between the axes; ten for a 6R arm (section 3.1).
    Angles,
    /// Every parameter of arm, mount, camera and depth; priors hold what cannot be seen.
    All,
    /// These, in this order.
    List(Vec<Parameter>),
    /// What [`Free::Auto`] or [`Free::All`] frees, and these besides: `auto,gears`.
    With(Box<Free>, Vec<Parameter>),
}

/// The text is no selection of parameters.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "\"{word}\" is neither auto, angles, all, nor a group (arm, lengths, mount, intrinsics, focal, depth, extrinsics, gears, compliance), nor a parameter: {reason}"
)]
pub struct ParseFreeError {
    /// The word that could not be read.
    pub word: String,
    /// Why.
    pub reason: String,
}

impl Free {
    /// Reads `auto`, `angles`, `all`, or a comma-separated list of parameters and groups:
    /// `alpha_2,theta_offset_3,mount,fx`. A list that begins with `auto` or `all` adds to it: `auto,gears`. Groups of
    /// the arm depend on the rig.
    pub fn parse(text: &str, rig: &Rig) -> Result<Self, CalibrationError> {
        let (base, rest) = split_base(text);
        let Some(rest) = rest else { return Ok(base.unwrap_or_default()) };
        if rest == "angles" && base.is_none() {
            return Ok(Free::Angles);
        }
        let mut list = Vec::new();
        for word in rest.split(',').map(str::trim) {
            let joints = rig.robot.as_ref().map_or(0, |robot| robot.joint_count());
            let of_arm = |keep: &dyn Fn(ParameterKind) -> bool| {
                arm(rig).into_iter().filter(|id| keep(id.kind)).map(Parameter::Chain).collect::<Vec<_>>()
            };
            let group = match word {
                "angles" => angles(rig),
                "arm" => of_arm(&|_| true),
                "lengths" => of_arm(&|kind| !kind.is_angle()),
                "mount" => MountComponent::ALL.map(Parameter::Mount).to_vec(),
                "intrinsics" => Intrinsic::ALL.map(Parameter::Intrinsic).to_vec(),
                "focal" => vec![Parameter::Intrinsic(Intrinsic::Fx), Parameter::Intrinsic(Intrinsic::Fy)],
                "depth" => vec![Parameter::DepthScale, Parameter::DepthOffset],
                "extrinsics" => MountComponent::ALL.map(Parameter::DepthExtrinsic).to_vec(),
                "gears" => {
                    (0..joints).flat_map(|j| [Parameter::TransmissionSin(j), Parameter::TransmissionCos(j)]).collect()
                }
                "compliance" => (0..joints).map(Parameter::Compliance).collect(),
                _ => vec![
                    word.parse::<Parameter>()
                        .map_err(|error| ParseFreeError { word: word.to_owned(), reason: error.to_string() })?,
                ],
            };
            list.extend(group.into_iter().filter(|parameter| !list.contains(parameter)).collect::<Vec<_>>());
        }
        Ok(Free::joined(base, list))
    }

    fn joined(base: Option<Free>, list: Vec<Parameter>) -> Self {
        match base {
            None => Free::List(list),
            Some(base) => Free::With(Box::new(base), list),
        }
    }

    /// Whether it frees what the data can identify, or everything, whatever besides: then priors and the gauge hold
    /// what cannot be seen.
    pub(crate) fn is_open(&self) -> bool {
        match self {
            Free::Auto | Free::All | Free::With(..) => true,
            Free::Angles | Free::List(_) => false,
        }
    }

    /// The ordered list of parameters that the selection means before the data are used: arm (base to flange), mount,
    /// intrinsics, depth. `Auto` leaves out the gauge of relative camera motion: the base gauge (what moves the whole
    /// world), and the last joint's `theta_offset` and `d`, which are the mount's. `Auto` and `All` take only what the
    /// data may determine: without depth no depth parameter, without joint values nothing of the arm. What cameras and
    /// board are off is free too, within the tolerances of such devices ([`default_sigma`](crate::default_sigma)): it
    /// would else be booked on the arm.
    pub fn candidates(&self, rig: &Rig, has_joints: bool, has_depth: bool) -> Result<Vec<Parameter>, CalibrationError> {
        let mut list = match self {
            Free::Angles => angles(rig),
            Free::List(list) => list.clone(),
            Free::With(base, more) => {
                let mut list = base.candidates(rig, has_joints, has_depth)?;
                list.extend(more.iter().filter(|parameter| !list.contains(parameter)).collect::<Vec<_>>());
                list
            }
            Free::Auto | Free::All => {
                let gauge = if *self == Free::Auto { gauge(rig) } else { Vec::new() };
                let chain = arm(rig).into_iter().map(Parameter::Chain).filter(|p| !gauge.contains(p));
                let mut list: Vec<Parameter> = chain.collect();
                list.extend(MountComponent::ALL.map(Parameter::Mount));
                // The third radial coefficient is all but the second one's by another name.
                let intrinsics = if *self == Free::All { 9 } else { 8 };
                list.extend(Intrinsic::ALL[..intrinsics].iter().copied().map(Parameter::Intrinsic));
                if has_depth {
                    list.extend([Parameter::DepthScale, Parameter::DepthOffset]);
                    // Along the optical axis the depth camera's place is its offset by another name.
                    let along = MountComponent::TranslationZ;
                    let place = MountComponent::ALL.into_iter().filter(|of| *self == Free::All || *of != along);
                    list.extend(place.map(Parameter::DepthExtrinsic));
                }
                if rig.board.is_some() {
                    list.push(Parameter::BoardScale);
                }
                list.retain(|parameter| has_joints || !parameter.needs_joints());
                list
            }
        };
        for (at, &parameter) in list.iter().enumerate() {
            if list[..at].contains(&parameter) {
                return Err(CalibrationError::Duplicate { parameter });
            }
            let missing = |reason: &str| CalibrationError::NoSuchParameter { parameter, reason: reason.to_owned() };
            if parameter.needs_joints() && rig.robot.is_none() {
                return Err(missing("it has no [robot]"));
            }
            if parameter.needs_joints() && !has_joints {
                return Err(missing("the postures give flange poses and no joint values"));
            }
            let joints = rig.robot.as_ref().map_or(0, |robot| robot.joint_count());
            match parameter {
                Parameter::Chain(id) if !arm(rig).contains(&id) => {
                    return Err(missing("no joint has such a parameter in its link form"));
                }
                Parameter::TransmissionSin(joint)
                | Parameter::TransmissionCos(joint)
                | Parameter::Compliance(joint)
                    if joint >= joints =>
                {
                    return Err(missing("the arm has no such joint"));
                }
                _ => {}
            }
        }
        list.shrink_to_fit();
        Ok(list)
    }
}

/// `auto` or `all` at the head of a list, and the rest of it; one of the two is there.
fn split_base(text: &str) -> (Option<Free>, Option<&str>) {
    let text = text.trim();
    let (first, rest) = text.split_once(',').map_or((text, None), |(first, rest)| (first.trim(), Some(rest.trim())));
    match first {
        "auto" => (Some(Free::Auto), rest),
        "all" => (Some(Free::All), rest),
        _ => (None, Some(text)),
    }
}

/// The standard of length whose own error no residual shows: the board's squares, or the depth's scale where there is
/// no board. `None` where lengths are held, where the controller's poses are the standard, or the free parameters are a
/// list.
pub(crate) fn ruler(rig: &Rig, free: &Free, parameters: &[Parameter], has_joints: bool) -> Option<Parameter> {
    let lengths = parameters.iter().any(|p| matches!(p, Parameter::Chain(_)) && p.unit() == crate::Unit::Metre);
    if !(free.is_open() && has_joints && lengths && rig.robot.is_some()) {
        return None;
    }
    [Parameter::BoardScale, Parameter::DepthScale].into_iter().find(|ruler| parameters.contains(ruler))
}

fn arm(rig: &Rig) -> Vec<ParameterId> {
    rig.robot.as_ref().map(|robot| robot.parameter_ids()).unwrap_or_default()
}

/// Angles between two axes: `alpha` of the links that lie between axes, and the offsets of all joints but the first.
fn angles(rig: &Rig) -> Vec<Parameter> {
    let Some(robot) = &rig.robot else { return Vec::new() };
    let last = robot.joint_count().saturating_sub(1);
    arm(rig)
        .into_iter()
        .filter(|id| match (id.kind, robot.joints()[id.joint].link.form) {
            (ParameterKind::Alpha, LinkForm::ModifiedDh | LinkForm::Hayati) => id.joint > 0,
            (ParameterKind::Alpha, LinkForm::StandardDh | LinkForm::StandardHayati) => id.joint < last,
            (ParameterKind::ThetaOffset, _) => id.joint > 0,
            _ => false,
        })
        .map(Parameter::Chain)
        .collect()
}

/// What relative camera motion cannot determine whatever the postures: motions before the first joint's axis or along
/// it move the world as a whole, motions after the last joint's axis or along it are the mount's.
pub(crate) fn gauge(rig: &Rig) -> Vec<Parameter> {
    let Some(robot) = &rig.robot else { return Vec::new() };
    let Some(last) = robot.joint_count().checked_sub(1) else { return Vec::new() };
    arm(rig)
        .into_iter()
        .filter(|id| {
            let along_axis = matches!(id.kind, ParameterKind::ThetaOffset | ParameterKind::D);
            let standard =
                matches!(robot.joints()[id.joint].link.form, LinkForm::StandardDh | LinkForm::StandardHayati);
            (id.joint == 0 && (along_axis || !standard)) || (id.joint == last && (along_axis || standard))
        })
        .map(Parameter::Chain)
        .collect()
}

impl fmt::Display for Free {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Free::Auto => f.write_str("auto"),
            Free::Angles => f.write_str("angles"),
            Free::All => f.write_str("all"),
            Free::With(base, more) => write!(f, "{base},{}", Free::List(more.clone())),
            Free::List(list) => {
                for (at, parameter) in list.iter().enumerate() {
                    write!(f, "{}{parameter}", if at == 0 { "" } else { "," })?;
                }
                Ok(())
            }
        }
    }
}

impl FromStr for Free {
    type Err = ParseFreeError;

    /// As [`Free::parse`], without the groups that need a rig.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (base, rest) = split_base(text);
        let Some(rest) = rest else { return Ok(base.unwrap_or_default()) };
        if rest == "angles" && base.is_none() {
            return Ok(Free::Angles);
        }
        let parameter = |word: &str| {
            let word = word.trim();
            word.parse().map_err(|error| ParseFreeError { word: word.to_owned(), reason: format!("{error}") })
        };
        Ok(Free::joined(base, rest.split(',').map(parameter).collect::<Result<_, _>>()?))
    }
}

impl TryFrom<String> for Free {
    type Error = ParseFreeError;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        text.parse()
    }
}

impl From<Free> for String {
    fn from(free: Free) -> Self {
        free.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::hp3j;

    #[test]
    fn the_papers_ten_in_its_order() {
        let names: Vec<_> =
            Free::Angles.candidates(&hp3j(), true, false).unwrap().iter().map(|p| p.to_string()).collect();
        assert_eq!(
            names,
            [
                "alpha_2",
                "theta_offset_2",
                "alpha_3",
                "theta_offset_3",
                "alpha_4",
                "theta_offset_4",
                "alpha_5",
                "theta_offset_5",
                "alpha_6",
                "theta_offset_6"
            ]
        );
    }

    #[test]
    fn auto_leaves_out_the_gauge_and_counts_24() {
        let list = Free::Auto.candidates(&hp3j(), true, false).unwrap();
        assert_eq!(list.iter().filter(|parameter| !parameter.is_nuisance()).count(), 24);
        assert_eq!(list.len(), 24 + 8, "and the camera's intrinsics");
        assert_eq!(Free::Auto.candidates(&hp3j(), true, true).unwrap().len(), 32 + 7, "and what the depth may be off");
    }

    #[test]
    fn lists_add_to_auto_and_all() {
        let rig = hp3j();
        let free = Free::parse("auto, gears,mount_x", &rig).unwrap();
        let list = free.candidates(&rig, true, true).unwrap();
        assert_eq!(list.len(), 39 + 12, "the mount's x is there already");
        assert_eq!(list[..39], Free::Auto.candidates(&rig, true, true).unwrap());
        assert_eq!(free.to_string().parse::<Free>().unwrap(), free);
        assert!(free.is_open() && Free::parse("all,compliance", &rig).unwrap().is_open());
        let angles = Free::parse("auto,angles", &rig).unwrap().candidates(&rig, true, true).unwrap();
        assert_eq!(angles.len(), 40, "theta_offset_6 is the gauge, which auto leaves out");
        for bad in ["auto,", "gears,auto", "auto,auto", ",", ""] {
            assert!(Free::parse(bad, &rig).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn lists_and_groups_are_read() {
        let rig = hp3j();
        let free = Free::parse("alpha_2, mount,fx,mount_x", &rig).unwrap();
        assert_eq!(free.to_string(), "alpha_2,mount_rx,mount_ry,mount_rz,mount_x,mount_y,mount_z,fx");
        assert_eq!(free.to_string().parse::<Free>().unwrap(), free);
        assert!(Free::parse("alpha_2,nonsense", &rig).unwrap_err().to_string().contains("nonsense"));
        let missing = Free::parse("d_3", &rig).unwrap().candidates(&rig, true, true).unwrap_err();
        assert!(missing.to_string().contains("d_3"), "joint 3 is in Hayati form: {missing}");
        assert!(Free::parse("alpha_2", &rig).unwrap().candidates(&rig, false, true).is_err());
    }
}
