//! Depth images: z-depth in metres on a pinhole camera's grid.

use crate::{Isometry3, PinholeCamera, Pixel, Point3};
use serde::{Deserialize, Serialize};

/// A camera that measures z-depth, and where it sits beside the colour camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthCamera {
    /// Its intrinsics.
    pub camera: PinholeCamera,
    /// Metres a count of the 16-bit image.
    pub unit_m: f64,
    /// Metres that are added to every measured depth: a bias of the camera.
    pub offset_m: f64,
    /// Takes points from the depth camera to the colour camera.
    pub color_from_depth: Isometry3,
}

/// z-depth (not the length of the ray) in metres, row by row; 0 where nothing was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthImage {
    width: u32,
    height: u32,
    depth_m: Vec<f32>,
}

/// Why a depth image could not be made.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum DepthImageError {
    /// The buffer does not hold width x height values.
    #[error("a depth image of {width} x {height} needs {need} values, got {got}", need = u64::from(*width) * u64::from(*height))]
    Size {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Values in the buffer.
        got: usize,
    },
    /// A value is negative, infinite or not a number.
    #[error("depth at column {x}, row {y} is {value} m; a finite value of at least 0 is needed (0 = no value)")]
    Value {
        /// Column.
        x: u32,
        /// Row.
        y: u32,
        /// The value as text, since NaN equals nothing.
        value: String,
    },
}

impl DepthImage {
    /// Takes row-major depths in metres.
    pub fn new(width: u32, height: u32, depth_m: Vec<f32>) -> Result<Self, DepthImageError> {
        if depth_m.len() as u64 != u64::from(width) * u64::from(height) {
            return Err(DepthImageError::Size { width, height, got: depth_m.len() });
        }
        if let Some(index) = depth_m.iter().position(|z| !z.is_finite() || *z < 0.0) {
            let (x, y) = (index as u32 % width, index as u32 / width);
            return Err(DepthImageError::Value { x, y, value: depth_m[index].to_string() });
        }
        Ok(DepthImage { width, height, depth_m })
    }

    /// Takes the counts of a camera's 16-bit image: `offset_m + count unit_m`. A count of 0, and what the offset brings
    /// to zero or below, is no value.
    pub fn from_counts(camera: &DepthCamera, counts: &[u16]) -> Result<Self, DepthImageError> {
        let metres = |&count: &u16| match count {
            0 => 0.0,
            count => (f64::from(count) * camera.unit_m + camera.offset_m).max(0.0) as f32,
        };
        Self::new(camera.camera.width, camera.camera.height, counts.iter().map(metres).collect())
    }

    /// Columns.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Row-major depths in metres.
    pub fn as_slice(&self) -> &[f32] {
        &self.depth_m
    }

    /// Depth at a pixel; `None` outside the image and where nothing was measured.
    pub fn at(&self, x: u32, y: u32) -> Option<f32> {
        if x >= self.width || y >= self.height {
            return None;
        }
        let depth = self.depth_m[y as usize * self.width as usize + x as usize];
        (depth > 0.0).then_some(depth)
    }

    /// Bilinear depth between four pixels that lie on one surface: `None` where one of them is missing or their
    /// spread exceeds `max_relative_step` of the depth (an edge).
    pub fn interpolate(&self, pixel: &Pixel, max_relative_step: f64) -> Option<f64> {
        if !(pixel.x >= 0.0 && pixel.y >= 0.0) {
            return None;
        }
        let (x0, y0) = (pixel.x.floor(), pixel.y.floor());
        let (x, y) = (x0 as u32, y0 as u32);
        let corner = |dx: u32, dy: u32| self.at(x.checked_add(dx)?, y.checked_add(dy)?).map(f64::from);
        let (z00, z10, z01, z11) = (corner(0, 0)?, corner(1, 0)?, corner(0, 1)?, corner(1, 1)?);
        let low = z00.min(z10).min(z01).min(z11);
        let high = z00.max(z10).max(z01).max(z11);
        if high - low > max_relative_step * low {
            return None;
        }
        let (u, v) = (pixel.x - x0, pixel.y - y0);
        Some((1.0 - v) * ((1.0 - u) * z00 + u * z10) + v * ((1.0 - u) * z01 + u * z11))
    }
}

impl DepthCamera {
    /// The point seen at a pixel with a depth, in the colour camera's frame.
    pub fn point_in_color(&self, pixel: &Pixel, depth_m: f64) -> Point3 {
        self.color_from_depth * Point3::from(self.camera.unproject(pixel) * depth_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolation_is_exact_on_a_ramp_and_refuses_edges_and_holes() {
        let ramp = DepthImage::new(3, 2, vec![1.0, 1.01, 1.02, 1.0, 1.01, 0.0]).unwrap();
        let depth = ramp.interpolate(&Pixel::new(0.5, 0.5), 0.05).unwrap();
        assert!((depth - 1.005).abs() < 1e-6);
        assert_eq!(ramp.interpolate(&Pixel::new(1.5, 0.5), 0.05), None, "a hole");
        assert_eq!(ramp.interpolate(&Pixel::new(0.5, 0.5), 0.005), None, "an edge");
        assert_eq!(ramp.interpolate(&Pixel::new(f64::NAN, 0.5), 0.05), None);
        assert_eq!(ramp.interpolate(&Pixel::new(1e300, 0.5), 0.05), None);
    }

    #[test]
    fn bad_values_are_named() {
        assert!(matches!(DepthImage::new(2, 2, vec![1.0; 3]), Err(DepthImageError::Size { got: 3, .. })));
        assert!(matches!(
            DepthImage::new(2, 2, vec![1.0, 1.0, f32::NAN, 1.0]),
            Err(DepthImageError::Value { x: 0, y: 1, .. })
        ));
    }
}
