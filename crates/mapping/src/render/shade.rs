//! From depth and colour to the image: eye-dome lighting, then the mean over each pixel's samples.

use super::raster::Canvas;
use super::{Projection, RenderCamera, RenderOptions};
use crate::cloud_cell::to_byte;
use image::{Rgb, RgbImage};
use rayon::prelude::*;

/// Where the neighbours are that can cast a shade, in pixels of the image; two rings.
const RINGS: [f32; 2] = [1.0, 2.5];
const DIRECTIONS: [(f32, f32); 8] =
    [(1.0, 0.0), (0.7, 0.7), (0.0, 1.0), (-0.7, 0.7), (-1.0, 0.0), (-0.7, -0.7), (0.0, -1.0), (0.7, -0.7)];

pub(super) fn develop(canvas: &Canvas, fine: &RenderCamera, options: &RenderOptions) -> RgbImage {
    let factor = options.supersampling as usize;
    let (width, height) = (canvas.width / factor, fine.height as usize / factor);
    // Depth on a scale on which an equal step looks equally deep: logarithmic in perspective; in parallel projection
    // in units of the image's height.
    let relief = |z: f32| match fine.projection {
        Projection::Perspective { .. } => z.ln() * 40.0,
        Projection::Orthographic { height_m } => z / height_m as f32 * 40.0,
    };
    let strength = options.eye_dome as f32;
    let shade = |x: usize, y: usize| {
        let own = canvas.depth[y * canvas.width + x];
        if !own.is_finite() || strength <= 0.0 {
            return 1.0;
        }
        let own = relief(own);
        let mut obscurance = 0.0;
        for ring in RINGS {
            for (dx, dy) in DIRECTIONS {
                let reach = ring * factor as f32;
                let (nx, ny) = (x as f32 + (dx * reach).round(), y as f32 + (dy * reach).round());
                if nx < 0.0 || ny < 0.0 || nx >= canvas.width as f32 || ny >= fine.height as f32 {
                    continue;
                }
                let other = canvas.depth[ny as usize * canvas.width + nx as usize];
                if other.is_finite() {
                    // Steps beyond 1 darken no further: a far background needs no black halo.
                    obscurance += ((own - relief(other)) / ring).clamp(0.0, 1.0);
                }
            }
        }
        (-strength * obscurance / DIRECTIONS.len() as f32).exp()
    };
    let pixels: Vec<[u8; 3]> = (0..width * height)
        .into_par_iter()
        .map(|index| {
            let (x, y) = (index % width * factor, index / width * factor);
            let mut sum = [0f32; 3];
            for sample in 0..factor * factor {
                let (sx, sy) = (x + sample % factor, y + sample / factor);
                let light = shade(sx, sy);
                for (total, value) in sum.iter_mut().zip(canvas.color[sy * canvas.width + sx]) {
                    *total += light * value;
                }
            }
            sum.map(|total| to_byte(total / (factor * factor) as f32))
        })
        .collect();
    RgbImage::from_fn(width as u32, height as u32, |x, y| Rgb(pixels[y as usize * width + x as usize]))
}
