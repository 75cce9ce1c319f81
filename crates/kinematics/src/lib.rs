//! Serial chains in Denavit-Hartenberg and Hayati form: forward kinematics, Jacobians, inverse kinematics, URDF.
//!
//! This crate knows axes and joint values, and nothing of cameras or images. Metres and radians.
//!
#![doc = include_str!("../README.md")]

#[cfg(test)]
mod arms;
mod chain;
mod error;
mod exports;
mod from_axes;
mod jacobian;
mod link;
mod refinement;
mod spherical_wrist;
mod urdf;
mod wrapping;

pub use chain::{Joint, JointKind, SerialChain};
pub use error::KinematicsError;
pub use exports::{corrections_csv, static_transform_line};
pub use from_axes::JointAxis;
pub use jacobian::ChainJacobian;
pub use link::{ElementaryMotion, Link, LinkForm, ParameterId, ParameterKind};
pub use refinement::{InverseKinematics, JointLimits, RefinementOptions, Termination, refine_inverse_kinematics};
pub use spherical_wrist::{Elbow, Shoulder, SphericalWristSolution, Wrist, spherical_wrist_solutions};
pub use urdf::{
    CollisionBody, CollisionModel, CollisionShape, bare_urdf, chain_from_urdf, kinematics_yaml,
    kinematics_yaml_of_table, line_diff, urdf_ends, write_urdf,
};
pub use wrapping::nearby;

/// A rigid transform `a_from_b`, metres.
pub type Isometry3 = nalgebra::Isometry3<f64>;
/// A twist `(v, omega)` in the base frame: a small change `s` of what it belongs to turns a pose `T` into
/// `Exp(s (v, omega)) T`; `v` is the velocity of the point at the base's origin.
pub type Twist = nalgebra::Vector6<f64>;
