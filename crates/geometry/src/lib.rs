//! Cameras with distortion, depth images and epipolar geometry.
//!
//! This crate knows rays, pixels and rigid transforms, and nothing of robots or of what an image shows.
//! Transforms are named `a_from_b`, camera axes are x right, y down, z forward, and pixel (0, 0) is the
//! *centre* of the top-left pixel. Lengths are metres, angles radians.
//!
#![doc = include_str!("../README.md")]

mod camera;
mod depth;
mod epipolar;

pub use camera::{DISTORTION_COEFFICIENTS, INTRINSICS, PinholeCamera, ProjectionJacobian};
pub use depth::{DepthCamera, DepthImage, DepthImageError};
pub use epipolar::{EpipolarLine, FundamentalMatrix, essential_matrix};

/// A rigid transform `a_from_b`: takes the coordinates of a point in b to those in a. Metres.
pub type Isometry3 = nalgebra::Isometry3<f64>;
/// A pixel position (x right, y down; the centre of the top-left pixel is the origin).
pub type Pixel = nalgebra::Point2<f64>;
/// A point in space, metres.
pub type Point3 = nalgebra::Point3<f64>;
