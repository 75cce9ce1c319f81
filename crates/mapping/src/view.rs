//! One posed depth image: what is believed of it, and where its pixels lie in the base frame.

use crate::Error;
use image::{GrayImage, RgbImage};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera, Pixel, Point3};

/// A camera farther than this from the base is taken for a mistake in the pose: single precision, in which maps are
/// kept, is coarser than a millimetre there.
const FARTHEST_POSE_M: f64 = 1e4;

/// A depth image, perhaps with the colour image of the same moment, and the pose of the colour camera.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// z-depth, metres; 0 = no value.
    pub depth: &'a DepthImage,
    /// The colour image of the same moment.
    pub color: Option<&'a RgbImage>,
    /// Intrinsics of the depth image and `color_from_depth`.
    pub depth_camera: &'a DepthCamera,
    /// Intrinsics of the colour image.
    pub color_camera: &'a PinholeCamera,
    /// The pose of the colour camera.
    pub base_from_color: Isometry3,
    /// Depth pixels that are 0 in this image (of the depth image's size) are ignored: what moves with the camera.
    pub depth_mask: Option<&'a GrayImage>,
    /// Points seen at pixels that are 0 in this image (of the colour image's size) are ignored.
    pub color_mask: Option<&'a GrayImage>,
}

/// How the standard deviation of a depth camera grows with the depth: `sigma = floor_m + quadratic_per_m z^2`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthNoise {
    /// The part that grows with the square of the depth, 1/m; triangulating cameras have about 0.001 to 0.004.
    pub quadratic_per_m: f64,
    /// The part that is always there, metres.
    pub floor_m: f64,
}

impl Default for DepthNoise {
    fn default() -> Self {
        DepthNoise { quadratic_per_m: 0.003, floor_m: 0.0003 }
    }
}

impl DepthNoise {
    /// Standard deviation at a depth, both in metres.
    pub fn sigma(&self, depth_m: f64) -> f64 {
        self.floor_m + self.quadratic_per_m * depth_m * depth_m
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        for (option, value) in [("noise.quadratic_per_m", self.quadratic_per_m), ("noise.floor_m", self.floor_m)] {
            if !(value.is_finite() && (0.0..=1.0).contains(&value)) {
                return Err(Error::Option { option, value: value.to_string(), need: "between 0 and 1 is needed" });
            }
        }
        if self.sigma(1.0) <= 0.0 {
            return Err(Error::Option {
                option: "noise",
                value: "0".into(),
                need: "at least one of quadratic_per_m and floor_m must be positive",
            });
        }
        Ok(())
    }
}

/// Which depth pixels are believed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DepthFilter {
    /// Nearest depth, metres.
    pub min_depth_m: f64,
    /// Farthest depth, metres; beyond it the noise of usual cameras exceeds what a map can use.
    pub max_depth_m: f64,
    /// Pixels this close to a depth discontinuity are dropped, since cameras blend both sides there ("flying pixels");
    /// 0 keeps them.
    pub edge_margin_px: u32,
    /// Neighbours whose depths differ by more than this share of the depth, and four sigma of their noise on top, lie
    /// on different surfaces.
    pub edge_step: f64,
    /// The noise of the depth camera.
    pub noise: DepthNoise,
}

impl Default for DepthFilter {
    fn default() -> Self {
        DepthFilter {
            min_depth_m: 0.05,
            max_depth_m: 4.0,
            edge_margin_px: 1,
            edge_step: 0.02,
            noise: DepthNoise::default(),
        }
    }
}

impl DepthFilter {
    pub(crate) fn check(&self) -> Result<(), Error> {
        self.noise.check()?;
        if !(self.min_depth_m >= 0.0 && self.max_depth_m > self.min_depth_m && self.max_depth_m.is_finite()) {
            return Err(Error::Option {
                option: "min_depth_m, max_depth_m",
                value: format!("{}, {}", self.min_depth_m, self.max_depth_m),
                need: "0 <= min_depth_m < max_depth_m is needed",
            });
        }
        if !(self.edge_step > 0.0 && self.edge_step.is_finite()) {
            return Err(Error::Option {
                option: "edge_step",
                value: self.edge_step.to_string(),
                need: "a positive share of the depth is needed",
            });
        }
        if self.edge_margin_px > 64 {
            return Err(Error::Option {
                option: "edge_margin_px",
                value: self.edge_margin_px.to_string(),
                need: "at most 64 pixels make sense",
            });
        }
        Ok(())
    }

    /// Largest difference between neighbours on one surface.
    pub(crate) fn step_tolerance(&self, depth_m: f32) -> f32 {
        let (share, floor, quadratic) = self.step_coefficients();
        share * depth_m + floor + quadratic * depth_m * depth_m
    }

    /// The tolerance's coefficients of depth, 1 and squared depth.
    fn step_coefficients(&self) -> (f32, f32, f32) {
        let sigmas = 4.0 * std::f64::consts::SQRT_2;
        let DepthNoise { quadratic_per_m, floor_m } = self.noise;
        (self.edge_step as f32, (sigmas * floor_m) as f32, (sigmas * quadratic_per_m) as f32)
    }
}

impl View<'_> {
    /// Checks image sizes, cameras and the pose.
    pub fn check(&self) -> Result<(), Error> {
        let depth_camera = &self.depth_camera.camera;
        same_size("depth image", (self.depth.width(), self.depth.height()), depth_camera)?;
        if let Some(color) = self.color {
            same_size("colour image", color.dimensions(), self.color_camera)?;
        }
        if let Some(mask) = self.depth_mask {
            same_size("depth mask", mask.dimensions(), depth_camera)?;
        }
        if let Some(mask) = self.color_mask {
            same_size("colour mask", mask.dimensions(), self.color_camera)?;
        }
        check_camera("the depth camera", depth_camera)?;
        check_camera("the colour camera", self.color_camera)?;
        check_isometry("color_from_depth", &self.depth_camera.color_from_depth)?;
        check_isometry("base_from_color", &self.base_from_color)
    }

    /// The pose of the depth camera.
    pub fn base_from_depth(&self) -> Isometry3 {
        self.base_from_color * self.depth_camera.color_from_depth
    }

    /// Depths with everything removed that the filter or the masks reject; row-major, 0 = no value.
    pub(crate) fn believed_depth(&self, filter: &DepthFilter) -> Vec<f32> {
        let (width, height) = (self.depth.width() as usize, self.depth.height() as usize);
        let (near, far) = (filter.min_depth_m as f32, filter.max_depth_m as f32);
        let raw = self.depth.as_slice();
        let at_edge = if filter.edge_margin_px > 0 { edge_pixels(raw, width, filter) } else { Vec::new() };
        let color_pixels = self.color_mask.map(|mask| (mask, Rays::new(&self.depth_camera.camera)));
        let mut believed = vec![0f32; raw.len()];
        believed.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
            for (x, out) in row.iter_mut().enumerate() {
                let index = y * width + x;
                let depth = raw[index];
                if !(depth > 0.0 && depth >= near && depth <= far) {
                    continue;
                }
                if self.depth_mask.is_some_and(|mask| mask.get_pixel(x as u32, y as u32).0[0] == 0) {
                    continue;
                }
                if filter.edge_margin_px == 1 && at_edge[index] {
                    continue;
                }
                if filter.edge_margin_px > 1 && near_marked(&at_edge, width, height, x, y, filter.edge_margin_px - 1) {
                    continue;
                }
                if let Some((mask, rays)) = &color_pixels {
                    let point = self.depth_camera.color_from_depth * rays.point(index, depth);
                    if self.color_pixel(&point).is_some_and(|pixel| {
                        mask.get_pixel_checked(pixel.x.round() as u32, pixel.y.round() as u32)
                            .is_some_and(|value| value.0[0] == 0)
                    }) {
                        continue;
                    }
                }
                *out = depth;
            }
        });
        believed
    }

    /// Where a point is seen in the colour image; `None` outside it.
    fn color_pixel(&self, point_in_color: &Point3) -> Option<Pixel> {
        self.color_camera.project(point_in_color).filter(|pixel| self.color_camera.contains(pixel))
    }

    /// Colour of a point, interpolated between four pixels; `None` outside the colour image or without one.
    pub(crate) fn color_of(&self, point_in_color: &Point3) -> Option<[f32; 3]> {
        let color = self.color?;
        let pixel = self.color_pixel(point_in_color)?;
        let (width, height) = color.dimensions();
        let x = pixel.x.clamp(0.0, f64::from(width - 1));
        let y = pixel.y.clamp(0.0, f64::from(height - 1));
        let (x0, y0) = (x as u32, y as u32);
        let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
        let (u, v) = ((x - f64::from(x0)) as f32, (y - f64::from(y0)) as f32);
        let (p00, p10) = (color.get_pixel(x0, y0), color.get_pixel(x1, y0));
        let (p01, p11) = (color.get_pixel(x0, y1), color.get_pixel(x1, y1));
        Some(std::array::from_fn(|channel| {
            let value = |p: &image::Rgb<u8>| f32::from(p.0[channel]);
            (1.0 - v) * ((1.0 - u) * value(p00) + u * value(p10)) + v * ((1.0 - u) * value(p01) + u * value(p11))
        }))
    }
}

/// The directions `(x/z, y/z, 1)` in which a camera's pixels look, row-major: unprojection under distortion is
/// iterative, so it is done once a camera and not once an image.
#[derive(Debug, Clone)]
pub(crate) struct Rays {
    camera: PinholeCamera,
    directions: Vec<Vector3<f32>>,
}

impl Rays {
    pub(crate) fn new(camera: &PinholeCamera) -> Self {
        let width = camera.width as usize;
        let directions = (0..width * camera.height as usize)
            .into_par_iter()
            .map(|index| {
                let pixel = Pixel::new((index % width) as f64, (index / width) as f64);
                camera.unproject(&pixel).cast::<f32>()
            })
            .collect();
        Rays { camera: *camera, directions }
    }

    /// Whether these rays are those of a camera.
    pub(crate) fn are_of(&self, camera: &PinholeCamera) -> bool {
        self.camera == *camera
    }

    /// Columns of the image.
    pub(crate) fn width(&self) -> usize {
        self.camera.width as usize
    }

    /// The direction of a pixel (row-major index).
    pub(crate) fn direction(&self, index: usize) -> Vector3<f32> {
        self.directions[index]
    }

    /// Width and height of a pixel in the normalised image at the principal point.
    pub(crate) fn pixel_pitch(&self) -> (f32, f32) {
        (1.0 / self.camera.fx as f32, 1.0 / self.camera.fy as f32)
    }

    /// The point at a depth on the ray of a pixel (row-major index), in the camera's frame.
    pub(crate) fn point(&self, index: usize, depth_m: f32) -> Point3 {
        Point3::from(self.directions[index].cast::<f64>() * f64::from(depth_m))
    }
}

fn same_size(what: &'static str, got: (u32, u32), camera: &PinholeCamera) -> Result<(), Error> {
    if got == (camera.width, camera.height) {
        return Ok(());
    }
    Err(Error::ImageSize {
        what,
        got_width: got.0,
        got_height: got.1,
        need_width: camera.width,
        need_height: camera.height,
    })
}

fn check_camera(what: &'static str, camera: &PinholeCamera) -> Result<(), Error> {
    if let Some(bad) = camera.intrinsics().iter().find(|value| !value.is_finite()) {
        return Err(Error::BadNumber { what, value: bad.to_string(), need: "a finite number" });
    }
    match [camera.fx, camera.fy].into_iter().find(|&focal| focal <= 0.0) {
        Some(bad) => Err(Error::BadNumber { what, value: bad.to_string(), need: "a positive focal length" }),
        None => Ok(()),
    }
}

fn check_isometry(what: &'static str, pose: &Isometry3) -> Result<(), Error> {
    let numbers = pose.translation.vector.iter().chain(pose.rotation.coords.iter());
    if let Some(bad) = numbers.clone().find(|value| !value.is_finite()) {
        return Err(Error::BadNumber { what, value: bad.to_string(), need: "a finite number" });
    }
    let norm = pose.rotation.coords.norm();
    if (norm - 1.0).abs() > 1e-6 {
        return Err(Error::BadNumber {
            what,
            value: format!("a quaternion of norm {norm}"),
            need: "a unit quaternion",
        });
    }
    let distance_m = pose.translation.vector.norm();
    if distance_m > FARTHEST_POSE_M {
        return Err(Error::PoseFarAway { distance_m, limit_m: FARTHEST_POSE_M });
    }
    Ok(())
}

/// Marks pixels one of whose four neighbours lies on another surface.
///
/// A steep plane also has large steps, but in inverse depth a plane is linear over the image (without distortion), so
/// a step counts only where inverse depth bends on this side of it or on the other, or where nothing is known of that.
fn edge_pixels(depth: &[f32], width: usize, filter: &DepthFilter) -> Vec<bool> {
    let height = (depth.len() / width.max(1)) as isize;
    let value = |x: isize, y: isize| {
        let inside = x >= 0 && y >= 0 && x < width as isize && y < height;
        if inside { depth[y as usize * width + x as usize] } else { 0.0 }
    };
    let bend = |before: f32, middle: f32, after: f32| {
        (before > 0.0 && middle > 0.0 && after > 0.0)
            .then(|| (1.0 / before - 2.0 / middle + 1.0 / after).abs() * middle * middle)
    };
    let (share, tolerance_floor, tolerance_quadratic) = filter.step_coefficients();
    let mut marked = vec![false; depth.len()];
    marked.par_chunks_mut(width.max(1)).enumerate().for_each(|(row, marks)| {
        let own = &depth[row * width..(row + 1) * width];
        // Rows beyond the border are taken to be this row: no step.
        let above = if row > 0 { &depth[(row - 1) * width..row * width] } else { own };
        let below = depth.get((row + 1) * width..(row + 2) * width).unwrap_or(own);
        for column in 0..width {
            let here = own[column];
            if here <= 0.0 {
                continue;
            }
            let tolerance = share * here + tolerance_floor + tolerance_quadratic * here * here;
            let is_step = |other: f32| (other > 0.0) & ((other - here).abs() > tolerance);
            let left = own[column.saturating_sub(1)];
            let right = own[(column + 1).min(width - 1)];
            if !(is_step(left) | is_step(right) | is_step(above[column]) | is_step(below[column])) {
                continue;
            }
            let (x, y) = (column as isize, row as isize);
            marks[column] = [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().any(|(dx, dy)| {
                let other = value(x + dx, y + dy);
                if !is_step(other) {
                    return false;
                }
                let this_side = bend(value(x - dx, y - dy), here, other);
                let that_side = bend(here, other, value(x + 2 * dx, y + 2 * dy));
                match (this_side, that_side) {
                    (None, None) => true,
                    (this_side, that_side) => this_side.unwrap_or(0.0).max(that_side.unwrap_or(0.0)) > tolerance,
                }
            });
        }
    });
    marked
}

fn near_marked(marked: &[bool], width: usize, height: usize, x: usize, y: usize, margin: u32) -> bool {
    let margin = margin as usize;
    let rows = y.saturating_sub(margin)..=(y + margin).min(height - 1);
    let columns = x.saturating_sub(margin)..=(x + margin).min(width - 1);
    rows.into_iter().any(|row| columns.clone().any(|column| marked[row * width + column]))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A depth camera that is the colour camera.
    pub(crate) fn plain_camera(width: u32, height: u32) -> DepthCamera {
        DepthCamera {
            camera: PinholeCamera::from_hfov(width, height, 1.0),
            unit_m: 0.001,
            color_from_depth: Isometry3::identity(),
        }
    }

    pub(crate) fn view<'a>(depth: &'a DepthImage, camera: &'a DepthCamera) -> View<'a> {
        View {
            depth,
            color: None,
            depth_camera: camera,
            color_camera: &camera.camera,
            base_from_color: Isometry3::identity(),
            depth_mask: None,
            color_mask: None,
        }
    }

    #[test]
    fn pixels_beside_a_step_are_dropped_and_a_steep_plane_is_kept() {
        let camera = plain_camera(40, 4);
        let step = DepthImage::new(40, 4, (0..160).map(|i| if i % 40 < 20 { 1.0 } else { 1.5 }).collect()).unwrap();
        let believed = view(&step, &camera).believed_depth(&DepthFilter::default());
        let kept: Vec<usize> = (0..40).filter(|&x| believed[40 + x] > 0.0).collect();
        assert_eq!(kept, (0..19).chain(21..40).collect::<Vec<_>>());

        let wide = DepthFilter { edge_margin_px: 3, ..Default::default() };
        let kept = view(&step, &camera).believed_depth(&wide)[40..80].iter().filter(|&&z| z > 0.0).count();
        assert_eq!(kept, 40 - 6);

        // 1/z falls from 2 to 0.4 over the image: neighbours differ by up to 10 %.
        let plane: Vec<f32> = (0..160).map(|i| 1.0 / (2.0 - 1.6 * (i % 40) as f32 / 39.0)).collect();
        let plane = DepthImage::new(40, 4, plane).unwrap();
        let believed = view(&plane, &camera).believed_depth(&DepthFilter::default());
        assert!(believed.iter().all(|&z| z > 0.0), "a plane has no edges");
    }

    #[test]
    fn range_and_masks_are_honoured() {
        let camera = plain_camera(4, 1);
        let depth = DepthImage::new(4, 1, vec![0.02, 0.5, 0.505, 9.0]).unwrap();
        let filter = DepthFilter { edge_margin_px: 0, ..Default::default() };
        assert_eq!(view(&depth, &camera).believed_depth(&filter), vec![0.0, 0.5, 0.505, 0.0]);
        let mask = GrayImage::from_raw(4, 1, vec![255, 0, 255, 255]).unwrap();
        let masked = View { depth_mask: Some(&mask), ..view(&depth, &camera) };
        assert_eq!(masked.believed_depth(&filter), vec![0.0, 0.0, 0.505, 0.0]);
        let masked = View { color_mask: Some(&mask), ..view(&depth, &camera) };
        assert_eq!(masked.believed_depth(&filter), vec![0.0, 0.0, 0.505, 0.0]);
    }

    #[test]
    fn bad_views_are_refused_with_the_reason() {
        let camera = plain_camera(4, 2);
        let depth = DepthImage::new(4, 2, vec![1.0; 8]).unwrap();
        assert!(view(&depth, &camera).check().is_ok());
        let mut far = view(&depth, &camera);
        far.base_from_color.translation.x = 1e7;
        assert!(matches!(far.check(), Err(Error::PoseFarAway { .. })));
        far.base_from_color.translation.x = f64::NAN;
        assert!(matches!(far.check(), Err(Error::BadNumber { what: "base_from_color", .. })));
        let small = DepthImage::new(2, 2, vec![1.0; 4]).unwrap();
        assert!(matches!(view(&small, &camera).check(), Err(Error::ImageSize { what: "depth image", .. })));
        let color = RgbImage::new(3, 2);
        let with_color = View { color: Some(&color), ..view(&depth, &camera) };
        assert!(matches!(with_color.check(), Err(Error::ImageSize { what: "colour image", .. })));
        let mut blind = camera;
        blind.camera.fx = 0.0;
        assert!(matches!(view(&depth, &blind).check(), Err(Error::BadNumber { .. })));
    }
}
