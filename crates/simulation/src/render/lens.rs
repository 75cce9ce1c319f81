//! Which ideal pixel a real pixel looks through.
//!
//! Triangles are linear only in an image without distortion. The rasteriser therefore tests them at the place where
//! each pixel of the distorted image would have been seen without distortion: exact, with no warping of images.

use skclam_geometry::{PinholeCamera, Pixel};

/// Undistorted positions of an image's pixels.
#[derive(Debug, Clone)]
pub(crate) struct Lens {
    camera: PinholeCamera,
    /// Undistorted minus real position a pixel, row by row; empty where there is no distortion.
    shifts: Vec<[f32; 2]>,
}

/// A pixel in the undistorted image: its position, and how that moves for one real pixel right and down.
#[derive(Debug, Clone, Copy)]
pub(crate) struct IdealPixel {
    pub x: f32,
    pub y: f32,
    pub by_x: (f32, f32),
    pub by_y: (f32, f32),
}

impl Lens {
    pub fn new(camera: &PinholeCamera) -> Self {
        let mut shifts = Vec::new();
        if camera.is_distorted() {
            shifts.reserve(camera.width as usize * camera.height as usize);
            for y in 0..camera.height {
                for x in 0..camera.width {
                    let pixel = Pixel::new(f64::from(x), f64::from(y));
                    let shift = camera.undistort(&pixel) - pixel;
                    shifts.push([shift.x as f32, shift.y as f32]);
                }
            }
        }
        Lens { camera: *camera, shifts }
    }

    /// Whether every pixel of the image has an undistorted place to which distortion leads back.
    pub fn is_invertible(&self) -> bool {
        let camera = &self.camera;
        let corner = |x: u32, y: u32| {
            let pixel = Pixel::new(f64::from(x), f64::from(y));
            let back = camera.project(&camera.unproject(&pixel).into());
            back.is_some_and(|back| (back - pixel).norm() < 1e-3)
        };
        let (right, bottom) = (camera.width - 1, camera.height - 1);
        let columns = (0..=16).map(|i| right * i / 16);
        let rows = (0..=16).map(|i| bottom * i / 16);
        columns.into_iter().all(|x| corner(x, 0) && corner(x, bottom))
            && rows.into_iter().all(|y| corner(0, y) && corner(right, y))
    }

    /// The ideal place of a real pixel, relative to `origin` (an integral pixel).
    #[inline]
    pub fn ideal(&self, x: u32, y: u32, origin: (u32, u32)) -> IdealPixel {
        let local = ((x as i64 - i64::from(origin.0)) as f32, (y as i64 - i64::from(origin.1)) as f32);
        if self.shifts.is_empty() {
            return IdealPixel { x: local.0, y: local.1, by_x: (1.0, 0.0), by_y: (0.0, 1.0) };
        }
        let shift = |x: u32, y: u32| self.shifts[y as usize * self.camera.width as usize + x as usize];
        let [dx, dy] = shift(x, y);
        // Central differences inside, one-sided at the border.
        let (left, right) = (x.saturating_sub(1), (x + 1).min(self.camera.width - 1));
        let (upper, lower) = (y.saturating_sub(1), (y + 1).min(self.camera.height - 1));
        let difference = |a: [f32; 2], b: [f32; 2], steps: u32| {
            let steps = steps.max(1) as f32;
            ((b[0] - a[0]) / steps, (b[1] - a[1]) / steps)
        };
        let by_x = difference(shift(left, y), shift(right, y), right - left);
        let by_y = difference(shift(x, upper), shift(x, lower), lower - upper);
        IdealPixel { x: local.0 + dx, y: local.1 + dy, by_x: (1.0 + by_x.0, by_x.1), by_y: (by_y.0, 1.0 + by_y.1) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ideal_pixels_agree_with_the_camera() {
        let mut camera = PinholeCamera::from_hfov(320, 240, 1.0);
        camera.distortion = [-0.15, 0.05, 1e-3, -5e-4, 0.01];
        let lens = Lens::new(&camera);
        assert!(lens.is_invertible());
        let expected = camera.undistort(&Pixel::new(300.0, 20.0));
        let ideal = lens.ideal(300, 20, (256, 0));
        assert!((f64::from(ideal.x) + 256.0 - expected.x).abs() < 1e-4);
        assert!((f64::from(ideal.y) - expected.y).abs() < 1e-4);
        let next = camera.undistort(&Pixel::new(300.5, 20.0)) - camera.undistort(&Pixel::new(299.5, 20.0));
        assert!((f64::from(ideal.by_x.0) - next.x).abs() < 1e-3 && (f64::from(ideal.by_x.1) - next.y).abs() < 1e-3);
        camera.distortion = [-2.0, 0.0, 0.0, 0.0, 0.0];
        assert!(!Lens::new(&camera).is_invertible());
    }
}
