//! Our own visibility-buffer rasteriser: colour and z-depth of models as a pinhole camera sees them.
//!
//! Exactness is the point: a simulated corner must be where the camera model says, to a few hundredths of a pixel,
//! or the cell would teach a calibration errors of its own. Each pixel's value is the mean over its square, by
//! visibility samples for edges and by the texture filter within faces; light is a property of surfaces, never of
//! the view. Tiles are independent, so the bytes do not depend on the number of threads.

mod lens;
mod samples;
mod setup;
mod tile;

pub use samples::Antialiasing;

use crate::{Model, SimulationError};
use image::RgbImage;
use lens::Lens;
use rayon::prelude::*;
use samples::{Pattern, Samples};
use setup::{ViewedFace, ViewedTriangle};
use skclam_geometry::{DepthImage, Isometry3, PinholeCamera};
use tile::{LocalFaces, TILE, Tile, TileArea};

/// A camera that draws models.
#[derive(Debug, Clone)]
pub struct Renderer {
    camera: PinholeCamera,
    antialiasing: Antialiasing,
    lens: Lens,
}

/// Larger images are refused: their buffers would not fit a common machine.
const MOST_PIXELS: u64 = 1 << 27;

impl Renderer {
    /// Prepares a camera. Errors: no pixels, too many, focal lengths that are not positive and finite, or a
    /// distortion that folds back within the image.
    pub fn new(camera: &PinholeCamera, antialiasing: Antialiasing) -> Result<Self, SimulationError> {
        let pixels = u64::from(camera.width) * u64::from(camera.height);
        let finite = camera.intrinsics().iter().all(|value| value.is_finite());
        if pixels == 0 || pixels > MOST_PIXELS || !finite || camera.fx <= 0.0 || camera.fy <= 0.0 {
            return Err(SimulationError::Camera {
                width: camera.width,
                height: camera.height,
                fx: camera.fx,
                fy: camera.fy,
            });
        }
        let lens = Lens::new(camera);
        if camera.is_distorted() && !lens.is_invertible() {
            return Err(SimulationError::Distortion { distortion: camera.distortion });
        }
        Ok(Renderer { camera: *camera, antialiasing, lens })
    }

    /// The camera.
    pub fn camera(&self) -> &PinholeCamera {
        &self.camera
    }

    /// What the camera sees in colour. Black where there is no surface.
    pub fn color(&self, base_from_camera: &Isometry3, models: &[&Model]) -> RgbImage {
        match self.antialiasing {
            Antialiasing::None => self.color_with::<1>(base_from_camera, models),
            Antialiasing::Four => self.color_with::<4>(base_from_camera, models),
            Antialiasing::Eight => self.color_with::<8>(base_from_camera, models),
            Antialiasing::Sixteen => self.color_with::<16>(base_from_camera, models),
        }
    }

    /// z-depth at the pixels' centres, metres, without any noise; 0 where there is no surface.
    pub fn depth(&self, base_from_camera: &Isometry3, models: &[&Model]) -> DepthImage {
        let (faces, triangles) = setup::view(models, &self.camera, &base_from_camera.inverse());
        let (width, height) = (self.camera.width, self.camera.height);
        let mut depth_m = vec![0.0f32; width as usize * height as usize];
        depth_m.par_chunks_mut((width * TILE) as usize).enumerate().for_each_init(
            Tile::<1>::new,
            |tile, (band, row)| {
                self.band(tile, band as u32, &faces, &triangles, |tile| {
                    for_each_pixel(tile, |column, line| {
                        row[(line * width + tile.area.origin.0 + column) as usize] = tile.depth(column, line);
                    });
                });
            },
        );
        // A face is never nearer than the near plane, so that every value is finite and positive or zero.
        DepthImage::new(width, height, depth_m).expect("depths of faces before the near plane are finite")
    }

    fn color_with<const N: usize>(&self, base_from_camera: &Isometry3, models: &[&Model]) -> RgbImage
    where
        Samples: Pattern<N>,
    {
        let (faces, triangles) = setup::view(models, &self.camera, &base_from_camera.inverse());
        let (width, height) = (self.camera.width, self.camera.height);
        let mut image = RgbImage::new(width, height);
        image.par_chunks_mut((width * 3 * TILE) as usize).enumerate().for_each_init(
            Tile::<N>::new,
            |tile, (band, bytes)| {
                self.band(tile, band as u32, &faces, &triangles, |tile| {
                    let mut local = LocalFaces::new(&faces);
                    for_each_pixel(tile, |column, line| {
                        let start = 3 * (line * width + tile.area.origin.0 + column) as usize;
                        let colour = tile.colour(column, line, &mut local);
                        for channel in 0..3 {
                            bytes[start + channel] = (colour[channel] + 0.5) as u8;
                        }
                    });
                });
            },
        );
        image
    }

    /// Resolves the tiles of one band of rows, left to right.
    fn band<const N: usize>(
        &self,
        tile: &mut Tile<N>,
        band: u32,
        faces: &[ViewedFace<'_>],
        triangles: &[ViewedTriangle],
        mut finish: impl FnMut(&Tile<N>),
    ) where
        Samples: Pattern<N>,
    {
        let (width, height) = (self.camera.width, self.camera.height);
        let top = band * TILE;
        for left in (0..width).step_by(TILE as usize) {
            let area = TileArea { origin: (left, top), width: TILE.min(width - left), height: TILE.min(height - top) };
            tile.resolve(area, &self.lens, faces, triangles);
            finish(tile);
        }
    }
}

fn for_each_pixel<const N: usize>(tile: &Tile<N>, mut visit: impl FnMut(u32, u32)) {
    for row in 0..tile.area.height {
        for column in 0..tile.area.width {
            visit(column, row);
        }
    }
}
