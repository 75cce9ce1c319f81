//! URDF in and out: a chain from a robot description, and the description with the calibrated chain's origins.
//!
//! Of URDF's elements only the joints between two links matter here: `origin` (`xyz` in metres, `rpy` in radians,
//! `R = Rz(yaw) Ry(pitch) Rx(roll)`), `axis`, `limit`, `parent`, `child`, `mimic`. The reader keeps the places of
//! the attributes in the text, so that the writer changes those and nothing else.

mod bare;
mod collision;
mod document;
mod ur;
mod write;

pub use bare::bare_urdf;
pub use collision::{CollisionBody, CollisionModel, CollisionShape};
pub use ur::{kinematics_yaml, kinematics_yaml_of_table};
pub use write::{line_diff, write_urdf};
pub(crate) use write::{roll_pitch_yaw, rounded};

use crate::{Isometry3, JointAxis, KinematicsError, SerialChain};
use document::Document;

/// The chain from one link of a URDF to another, `base_from_flange` being `base_link` from `tip_link`.
///
/// Fixed joints are folded in; revolute, continuous and prismatic ones become joints under their names, with their
/// limits (`continuous`: none). The links are DH, and Hayati where neighbouring axes are nearly parallel: see
/// [`SerialChain::from_axes`].
///
/// # Errors
/// [`KinematicsError::Urdf`] with the line: text that is not XML, a xacro (it is to be expanded first), links that are
/// not there or not connected, a planar, floating or mimic joint on the way, a number that is none.
pub fn chain_from_urdf(text: &str, base_link: &str, tip_link: &str) -> Result<SerialChain, KinematicsError> {
    let document = Document::parse(text)?;
    let path = document.path(base_link, tip_link)?;
    let mut pose = Isometry3::identity();
    let mut axes = Vec::new();
    for joint in &path {
        pose *= joint.origin;
        if let Some(motion) = &joint.motion {
            axes.push(JointAxis {
                name: joint.name.to_owned(),
                kind: motion.kind,
                limits: motion.limits,
                point_in_base: pose.translation.vector.into(),
                direction_in_base: pose.rotation * motion.axis,
            });
        }
    }
    SerialChain::from_axes(&axes, &pose)
}

/// The links of a URDF that are no joint's child, and those that are no joint's parent: where a chain may start and
/// where it may end, in the order of the text. For messages and defaults.
///
/// # Errors
/// As [`chain_from_urdf`], for the text as a whole.
pub fn urdf_ends(text: &str) -> Result<(Vec<String>, Vec<String>), KinematicsError> {
    let document = Document::parse(text)?;
    let names = |links: Vec<&str>| links.into_iter().map(str::to_owned).collect();
    Ok((names(document.roots()), names(document.tips())))
}

#[cfg(test)]
mod tests;
