//! The depth of a pixel of the *colour* image, looked up in a depth image that another camera took.
//!
//! A colour pixel is a ray; where the ray meets the measured surface is found by iteration: guess a depth, project the
//! guess into the depth camera, read the depth there, see how far along the ray that point lies, and guess again.

use nalgebra::Vector3;
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera, Pixel, Point3};

/// Neighbouring depths that differ by more than this part of the depth belong to two surfaces.
const MAX_RELATIVE_STEP: f64 = 0.04;
/// Iterations at the most; with a baseline of centimetres three or four do.
const MAX_ITERATIONS: usize = 12;

/// A depth image that answers for pixels of the colour image.
#[derive(Debug)]
pub struct RegisteredDepth<'a> {
    depth: &'a DepthImage,
    depth_camera: &'a DepthCamera,
    color_camera: &'a PinholeCamera,
    depth_from_color: Isometry3,
    median_m: f64,
}

impl<'a> RegisteredDepth<'a> {
    /// `None` for a depth image without any value.
    pub fn new(depth: &'a DepthImage, depth_camera: &'a DepthCamera, color_camera: &'a PinholeCamera) -> Option<Self> {
        let mut values: Vec<f32> = depth.as_slice().iter().copied().step_by(7).filter(|&z| z > 0.0).collect();
        if values.is_empty() {
            return None;
        }
        let middle = values.len() / 2;
        let (_, median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
        let median_m = f64::from(*median);
        Some(RegisteredDepth {
            depth,
            depth_camera,
            color_camera,
            depth_from_color: depth_camera.color_from_depth.inverse(),
            median_m,
        })
    }

    /// z-depth in the colour camera's frame, metres, of what a colour pixel (distortion included) shows; `None` at holes, at
    /// depth edges and outside the depth image.
    pub fn at(&self, pixel: &Pixel) -> Option<f64> {
        let ray = self.color_camera.unproject(pixel);
        self.along(&ray, self.median_m)
    }

    fn along(&self, ray: &Vector3<f64>, start_m: f64) -> Option<f64> {
        let mut guess_m = start_m;
        for _ in 0..MAX_ITERATIONS {
            let in_depth = self.depth_from_color * Point3::from(ray * guess_m);
            let seen_at = self.depth_camera.camera.project(&in_depth)?;
            let measured_m = self.depth.interpolate(&seen_at, MAX_RELATIVE_STEP)?;
            let next_m = self.depth_camera.point_in_color(&seen_at, measured_m).z;
            if next_m <= 0.0 {
                return None;
            }
            let moved = (next_m - guess_m).abs();
            guess_m = next_m;
            if moved < 1e-5 * guess_m {
                return Some(guess_m);
            }
        }
        // Between two surfaces the iteration swings from one to the other; neither is the answer.
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane `n . p = c` in the colour frame, seen by a depth camera beside it.
    #[test]
    fn depth_of_a_slanted_plane_is_found_through_the_baseline() {
        let color = PinholeCamera::from_hfov(1280, 720, 1.2);
        let depth_camera = DepthCamera {
            camera: PinholeCamera::from_hfov(480, 360, 1.0),
            unit_m: 1e-3,
            offset_m: 0.0,
            color_from_depth: Isometry3::new(Vector3::new(0.03, -0.01, 0.005), Vector3::new(0.01, -0.02, 0.03)),
        };
        let (normal, offset) = (Vector3::new(0.3, -0.2, 1.0), 1.1);
        let mut values = Vec::new();
        for y in 0..360 {
            for x in 0..480 {
                let ray = depth_camera.camera.unproject(&Pixel::new(f64::from(x), f64::from(y)));
                let color_from_depth = &depth_camera.color_from_depth;
                let direction = color_from_depth.rotation * ray;
                let depth = (offset - normal.dot(&color_from_depth.translation.vector)) / normal.dot(&direction);
                values.push(depth as f32);
            }
        }
        let image = DepthImage::new(480, 360, values).unwrap();
        let registered = RegisteredDepth::new(&image, &depth_camera, &color).unwrap();
        for pixel in [Pixel::new(640.0, 360.0), Pixel::new(400.2, 500.7), Pixel::new(800.0, 200.0)] {
            let expected = offset / normal.dot(&color.unproject(&pixel));
            // Bilinear depth of a plane is exact only in inverse depth; a tenth of a millimetre is what remains.
            assert!((registered.at(&pixel).unwrap() - expected).abs() < 1e-4);
        }
        assert_eq!(registered.at(&Pixel::new(-5000.0, 0.0)), None);
        let empty = DepthImage::new(2, 2, vec![0.0; 4]).unwrap();
        assert!(RegisteredDepth::new(&empty, &depth_camera, &color).is_none());
    }
}
