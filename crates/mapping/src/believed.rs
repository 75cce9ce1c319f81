//! What is left of a depth image after the filter and the masks.

use crate::color_lookup::{ColorLookup, ColorPlaces};
use crate::rays::Rays;
use crate::{DepthFilter, View};
use multiversion::multiversion;
use rayon::prelude::*;

impl View<'_> {
    /// Depths with everything removed that the filter or the masks reject; row-major, 0 = no value.
    pub(crate) fn believed_depth(&self, filter: &DepthFilter) -> Vec<f32> {
        // Only a colour mask asks where the pixels look.
        let rays = self.color_mask.map(|_| Rays::new(&self.depth_camera.camera));
        self.believed(filter, rays.as_ref())
    }

    /// As [`View::believed_depth`], with the rays at hand.
    pub(crate) fn believed_depth_along(&self, filter: &DepthFilter, rays: &Rays) -> Vec<f32> {
        self.believed(filter, Some(rays))
    }

    fn believed(&self, filter: &DepthFilter, rays: Option<&Rays>) -> Vec<f32> {
        let (width, height) = (self.depth.width() as usize, self.depth.height() as usize);
        let range = (filter.min_depth_m as f32, filter.max_depth_m as f32);
        let raw = self.depth.as_slice();
        let at_edge = if filter.edge_margin_px > 0 { edge_pixels(raw, width, filter) } else { Vec::new() };
        let color = self.color_mask.zip(rays).map(|(mask, rays)| (mask, rays, ColorLookup::new(self)));
        let mut believed = vec![0f32; raw.len()];
        believed.par_chunks_mut(width.max(1)).enumerate().for_each_init(ColorPlaces::default, |places, (y, row)| {
            let span = y * width..(y + 1) * width;
            keep_range(&raw[span.clone()], range, row);
            if filter.edge_margin_px == 1 {
                for (out, marked) in row.iter_mut().zip(&at_edge[span.clone()]) {
                    *out = if *marked { 0.0 } else { *out };
                }
            } else if filter.edge_margin_px > 1 {
                for (x, out) in row.iter_mut().enumerate() {
                    if near_marked(&at_edge, width, height, x, y, filter.edge_margin_px - 1) {
                        *out = 0.0;
                    }
                }
            }
            if let Some(mask) = self.depth_mask {
                for (out, kept) in row.iter_mut().zip(&mask.as_raw()[span]) {
                    *out = if *kept == 0 { 0.0 } else { *out };
                }
            }
            if let Some((mask, rays, lookup)) = &color {
                lookup.find(rays, y, row, places);
                for (x, out) in row.iter_mut().enumerate() {
                    if places.is_masked(x, mask) {
                        *out = 0.0;
                    }
                }
            }
        });
        believed
    }
}

/// Depths within the range, 0 for the others.
#[multiversion(targets("x86_64+avx2"))]
fn keep_range(raw: &[f32], (near, far): (f32, f32), row: &mut [f32]) {
    for (out, &depth) in row.iter_mut().zip(raw) {
        *out = if (depth > 0.0) & (depth >= near) & (depth <= far) { depth } else { 0.0 };
    }
}

/// Which pixels of a row differ from one of four neighbours by more than the tolerance.
#[multiversion(targets("x86_64+avx2"))]
fn steps_in_row(rows: [&[f32]; 5], (share, floor, quadratic): (f32, f32, f32), marks: &mut [bool]) {
    let length = marks.len();
    let [own, left, right, above, below] = rows.map(|row| &row[..length]);
    for x in 0..length {
        let here = own[x];
        let tolerance = share * here + floor + quadratic * here * here;
        let is_step = |other: f32| (other > 0.0) & ((other - here).abs() > tolerance);
        marks[x] = (here > 0.0) & (is_step(left[x]) | is_step(right[x]) | is_step(above[x]) | is_step(below[x]));
    }
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
    let coefficients = filter.step_coefficients();
    let (share, tolerance_floor, tolerance_quadratic) = coefficients;
    let mut marked = vec![false; depth.len()];
    marked.par_chunks_mut(width.max(1)).enumerate().for_each(|(row, marks)| {
        let own = &depth[row * width..(row + 1) * width];
        // Rows beyond the border are taken to be this row: no step. The first and the last column are looked at closely.
        let above = if row > 0 { &depth[(row - 1) * width..row * width] } else { own };
        let below = depth.get((row + 1) * width..(row + 2) * width).unwrap_or(own);
        marks.iter_mut().zip(own).for_each(|(mark, z)| *mark = *z > 0.0);
        if width > 2 {
            let inner = [&own[1..], own, &own[2..], &above[1..], &below[1..]];
            steps_in_row(inner, coefficients, &mut marks[1..width - 1]);
        }
        for (column, mark) in marks.iter_mut().enumerate().filter(|(_, mark)| **mark) {
            let here = own[column];
            let tolerance = share * here + tolerance_floor + tolerance_quadratic * here * here;
            let is_step = |other: f32| (other > 0.0) & ((other - here).abs() > tolerance);
            let (x, y) = (column as isize, row as isize);
            *mark = [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().any(|(dx, dy)| {
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
mod tests {
    use super::*;
    use crate::view::tests::{plain_camera, view};
    use image::GrayImage;
    use skclam_geometry::DepthImage;

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
}
