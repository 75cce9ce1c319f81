//! The directions `(x/z, y/z, 1)` in which a camera's pixels look: unprojection under distortion is iterative, so it is
//! done once a camera and not once an image.

use nalgebra::Vector3;
use rayon::prelude::*;
use skclam_geometry::{PinholeCamera, Pixel, Point3};

/// Row-major; the two planes are separate for loops over several pixels at a time.
#[derive(Debug, Clone)]
pub(crate) struct Rays {
    camera: PinholeCamera,
    x: Vec<f32>,
    y: Vec<f32>,
}

impl Rays {
    pub(crate) fn new(camera: &PinholeCamera) -> Self {
        let width = camera.width as usize;
        let (x, y) = (0..width * camera.height as usize)
            .into_par_iter()
            .map(|index| {
                let pixel = Pixel::new((index % width) as f64, (index / width) as f64);
                let ray = camera.unproject(&pixel);
                (ray.x as f32, ray.y as f32)
            })
            .unzip();
        Rays { camera: *camera, x, y }
    }

    /// Whether these rays are those of a camera.
    pub(crate) fn are_of(&self, camera: &PinholeCamera) -> bool {
        self.camera == *camera
    }

    /// The camera they belong to.
    pub(crate) fn camera(&self) -> &PinholeCamera {
        &self.camera
    }

    /// Columns of the image.
    pub(crate) fn width(&self) -> usize {
        self.camera.width as usize
    }

    /// `x/z` and `y/z` of a row of pixels.
    pub(crate) fn row(&self, y: usize) -> (&[f32], &[f32]) {
        let span = y * self.width()..(y + 1) * self.width();
        (&self.x[span.clone()], &self.y[span])
    }

    /// The direction of a pixel (row-major index).
    pub(crate) fn direction(&self, index: usize) -> Vector3<f32> {
        Vector3::new(self.x[index], self.y[index], 1.0)
    }

    /// Width and height of a pixel in the normalised image at the principal point.
    pub(crate) fn pixel_pitch(&self) -> (f32, f32) {
        (1.0 / self.camera.fx as f32, 1.0 / self.camera.fy as f32)
    }

    /// The point at a depth on the ray of a pixel (row-major index), in the camera's frame.
    pub(crate) fn point(&self, index: usize, depth_m: f32) -> Point3 {
        Point3::from(self.direction(index).cast::<f64>() * f64::from(depth_m))
    }
}
