//! Where the pixels of a depth image are seen in the colour image, a row at a time.

use crate::View;
use crate::projector::Projector;
use crate::rays::Rays;
use image::{GrayImage, RgbImage};
use multiversion::multiversion;
use nalgebra::{Matrix3, Vector3};

/// Takes pixels with a depth to the colour image.
pub(crate) struct ColorLookup {
    projector: Projector,
    rotation: Matrix3<f32>,
    translation: Vector3<f32>,
}

/// Positions in the colour image, counted from its outer corner; negative where it does not show the point.
#[derive(Debug, Default, Clone)]
pub(crate) struct ColorPlaces {
    u: Vec<f32>,
    v: Vec<f32>,
}

impl ColorLookup {
    pub(crate) fn new(view: &View<'_>) -> Self {
        let color_from_depth = view.depth_camera.color_from_depth.cast::<f32>();
        ColorLookup {
            projector: Projector::new(view.color_camera),
            rotation: *color_from_depth.rotation.to_rotation_matrix().matrix(),
            translation: color_from_depth.translation.vector,
        }
    }

    /// Projects a row of depths.
    pub(crate) fn find(&self, rays: &Rays, y: usize, depth: &[f32], places: &mut ColorPlaces) {
        places.u.resize(depth.len(), -1.0);
        places.v.resize(depth.len(), -1.0);
        let (ray_x, ray_y) = rays.row(y);
        if self.projector.is_distorted() {
            project_row::<true>(self, ray_x, ray_y, depth, &mut places.u, &mut places.v);
        } else {
            project_row::<false>(self, ray_x, ray_y, depth, &mut places.u, &mut places.v);
        }
    }
}

impl ColorPlaces {
    /// Column and row of the nearest pixel.
    #[inline]
    pub(crate) fn nearest(&self, x: usize) -> Option<(u32, u32)> {
        (self.u[x] >= 0.0).then(|| (self.u[x] as u32, self.v[x] as u32))
    }

    /// Whether a mask of the colour image takes a pixel out.
    #[inline]
    pub(crate) fn is_masked(&self, x: usize, mask: &GrayImage) -> bool {
        self.nearest(x).is_some_and(|(u, v)| mask.get_pixel(u, v).0[0] == 0)
    }

    /// The colour of the nearest pixel and 1, or zeros.
    #[inline]
    pub(crate) fn nearest_color(&self, x: usize, image: &RgbImage) -> [u8; 4] {
        self.nearest(x).map_or([0; 4], |(u, v)| {
            let [r, g, b] = image.get_pixel(u, v).0;
            [r, g, b, 1]
        })
    }

    /// The colour interpolated between four pixels.
    #[inline]
    pub(crate) fn color(&self, x: usize, image: &RgbImage) -> Option<[f32; 3]> {
        if self.u[x] < 0.0 {
            return None;
        }
        let (width, height) = image.dimensions();
        let u = (self.u[x] - 0.5).clamp(0.0, (width - 1) as f32);
        let v = (self.v[x] - 0.5).clamp(0.0, (height - 1) as f32);
        let (x0, y0) = (u as u32, v as u32);
        let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
        let (u, v) = (u - x0 as f32, v - y0 as f32);
        let (p00, p10) = (image.get_pixel(x0, y0), image.get_pixel(x1, y0));
        let (p01, p11) = (image.get_pixel(x0, y1), image.get_pixel(x1, y1));
        Some(std::array::from_fn(|channel| {
            let value = |p: &image::Rgb<u8>| f32::from(p.0[channel]);
            (1.0 - v) * ((1.0 - u) * value(p00) + u * value(p10)) + v * ((1.0 - u) * value(p01) + u * value(p11))
        }))
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn project_row<const DISTORTED: bool>(
    lookup: &ColorLookup,
    ray_x: &[f32],
    ray_y: &[f32],
    depth: &[f32],
    u: &mut [f32],
    v: &mut [f32],
) {
    let length = depth.len();
    let (ray_x, ray_y, u, v) = (&ray_x[..length], &ray_y[..length], &mut u[..length], &mut v[..length]);
    let (rotation, translation) = (&lookup.rotation, &lookup.translation);
    for x in 0..length {
        let z = depth[x];
        let axis = |row: usize| {
            z * (rotation[(row, 0)] * ray_x[x] + rotation[(row, 1)] * ray_y[x] + rotation[(row, 2)]) + translation[row]
        };
        let (px, py, pz) = (axis(0), axis(1), axis(2));
        let (at_u, at_v) = if DISTORTED {
            lookup.projector.project_distorted(px, py, pz)
        } else {
            lookup.projector.project_straight(px, py, pz)
        };
        let seen = (z > 0.0) & lookup.projector.sees(pz, at_u, at_v);
        u[x] = if seen { at_u } else { -1.0 };
        v[x] = if seen { at_v } else { -1.0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::tests::{plain_camera, view};
    use image::Rgb;
    use skclam_geometry::{DepthImage, Isometry3};

    #[test]
    fn colours_come_from_where_the_colour_camera_sees_the_point() {
        let mut camera = plain_camera(40, 30);
        camera.color_from_depth = Isometry3::translation(0.02, 0.0, 0.0);
        let depth = DepthImage::new(40, 30, vec![1.0; 1200]).unwrap();
        let image = RgbImage::from_fn(40, 30, |x, y| Rgb([4 * x as u8, 5 * y as u8, 7]));
        let mask = GrayImage::from_fn(40, 30, |x, _| image::Luma([if x < 20 { 0 } else { 255 }]));
        let view = View { color: Some(&image), ..view(&depth, &camera) };
        let rays = Rays::new(&camera.camera);
        let mut places = ColorPlaces::default();
        ColorLookup::new(&view).find(&rays, 12, &depth.as_slice()[..40], &mut places);
        // At 1 m, 2 cm are 2 % of the focal length.
        let shift = 0.02 * camera.camera.fx as f32;
        let color = places.color(10, &image).unwrap();
        assert!((color[0] - 4.0 * (10.0 + shift)).abs() < 1e-3 && (color[1] - 60.0).abs() < 1e-3, "{color:?}");
        assert_eq!(places.nearest(10), Some(((10.5 + shift) as u32, 12)));
        assert_eq!(places.nearest_color(39, &image)[3], 0, "it leaves the image on the right");
        assert!(places.is_masked(10, &mask) && !places.is_masked(30, &mask) && !places.is_masked(39, &mask));
    }
}
