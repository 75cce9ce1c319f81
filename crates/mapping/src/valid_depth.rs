//! What is left of a depth image after the filter and the masks.

use crate::color_lookup::{ColorLookup, ColorPlaces};
use crate::rays::Rays;
use crate::{DepthFilter, View};
use image::GrayImage;
use multiversion::multiversion;
use rayon::prelude::*;
use skclam_geometry::DepthImage;

impl View<'_> {
    /// Depths with everything removed that the filter or the masks reject; row-major, 0 = no value.
    pub(crate) fn valid_depth(&self, filter: &DepthFilter) -> Vec<f32> {
        // Only a colour mask asks where the pixels look.
        let rays = self.color_mask.map(|_| Rays::new(&self.depth_camera.camera));
        self.valid(filter, rays.as_ref())
    }

    /// As [`View::valid_depth`], with the rays at hand.
    pub(crate) fn valid_depth_along(&self, filter: &DepthFilter, rays: &Rays) -> Vec<f32> {
        self.valid(filter, Some(rays))
    }

    fn valid(&self, filter: &DepthFilter, rays: Option<&Rays>) -> Vec<f32> {
        let width = self.depth.width().max(1) as usize;
        let rows = ValidRows::new(self, filter, rays, 1);
        let mut valid = vec![0f32; self.depth.as_slice().len()];
        let bands = valid.par_chunks_mut(width).enumerate();
        bands.for_each_init(RowScratch::default, |scratch, (y, row)| rows.row(y, row, scratch));
        valid
    }
}

/// What is valid of a view, row by row.
pub(crate) struct ValidRows<'a> {
    view: &'a View<'a>,
    filter: &'a DepthFilter,
    /// Pixels of the view between two that are asked for, in both directions.
    thinning: usize,
    /// Pixels at edges, where the margin is wider than one.
    edges: Option<Vec<bool>>,
    mask: Option<(&'a GrayImage, &'a Rays, ColorLookup)>,
}

/// What one thread keeps from row to row.
#[derive(Debug, Default)]
pub(crate) struct RowScratch {
    marks: Vec<bool>,
    places: ColorPlaces,
}

impl<'a> ValidRows<'a> {
    /// `rays` are those of the pixels that are asked for; only a colour mask needs them.
    pub(crate) fn new(view: &'a View<'a>, filter: &'a DepthFilter, rays: Option<&'a Rays>, thinning: usize) -> Self {
        let edges = (filter.edge_margin_px > 1).then(|| edge_pixels(view.depth, filter));
        let mask = view.color_mask.zip(rays).map(|(mask, rays)| (mask, rays, ColorLookup::new(view)));
        ValidRows { view, filter, thinning, edges, mask }
    }

    /// Writes a row of valid depths, 0 where there is none.
    pub(crate) fn row(&self, y: usize, row: &mut [f32], scratch: &mut RowScratch) {
        let (width, height) = (self.view.depth.width() as usize, self.view.depth.height() as usize);
        let (raw, thinning) = (self.view.depth.as_slice(), self.thinning);
        let full_y = y * thinning;
        let span = full_y * width..(full_y + 1) * width;
        keep_range(&raw[span.clone()], (self.filter.min_depth_m as f32, self.filter.max_depth_m as f32), thinning, row);
        if let Some(edges) = &self.edges {
            let margin = self.filter.edge_margin_px - 1;
            for (x, out) in row.iter_mut().enumerate() {
                if near_marked(edges, width, height, x * thinning, full_y, margin) {
                    *out = 0.0;
                }
            }
        } else if self.filter.edge_margin_px == 1 {
            scratch.marks.resize(width, false);
            mark_edges(raw, width, full_y, self.filter, thinning, &mut scratch.marks);
            for (out, marked) in row.iter_mut().zip(scratch.marks.iter().step_by(thinning)) {
                *out = if *marked { 0.0 } else { *out };
            }
        }
        if let Some(mask) = self.view.depth_mask {
            for (out, kept) in row.iter_mut().zip(mask.as_raw()[span].iter().step_by(thinning)) {
                *out = if *kept == 0 { 0.0 } else { *out };
            }
        }
        if let Some((mask, rays, lookup)) = &self.mask {
            lookup.find(rays, y, row, &mut scratch.places);
            for (x, out) in row.iter_mut().enumerate() {
                if scratch.places.is_masked(x, mask) {
                    *out = 0.0;
                }
            }
        }
    }
}

/// Every `thinning`-th depth where it is within the range, 0 for the others.
#[multiversion(targets("x86_64+avx2"))]
fn keep_range(raw: &[f32], (near, far): (f32, f32), thinning: usize, row: &mut [f32]) {
    let kept = |depth: f32| if (depth > 0.0) & (depth >= near) & (depth <= far) { depth } else { 0.0 };
    if thinning == 1 {
        row.iter_mut().zip(raw).for_each(|(out, &depth)| *out = kept(depth));
    } else {
        row.iter_mut().zip(raw.iter().step_by(thinning)).for_each(|(out, &depth)| *out = kept(depth));
    }
}

/// Which pixels of a row differ from one of four neighbours by more than the tolerance.
#[multiversion(targets("x86_64+avx2"))]
fn steps_in_row(rows: [&[f32]; 5], (fraction, floor, quadratic): (f32, f32, f32), marks: &mut [bool]) {
    let length = marks.len();
    let [own, left, right, above, below] = rows.map(|row| &row[..length]);
    for x in 0..length {
        let here = own[x];
        let tolerance = fraction * here + floor + quadratic * here * here;
        let is_step = |other: f32| (other > 0.0) & ((other - here).abs() > tolerance);
        marks[x] = (here > 0.0) & (is_step(left[x]) | is_step(right[x]) | is_step(above[x]) | is_step(below[x]));
    }
}

/// All pixels at edges, row-major.
fn edge_pixels(depth: &DepthImage, filter: &DepthFilter) -> Vec<bool> {
    let width = depth.width().max(1) as usize;
    let mut marked = vec![false; depth.as_slice().len()];
    let rows = marked.par_chunks_mut(width).enumerate();
    rows.for_each(|(row, marks)| mark_edges(depth.as_slice(), width, row, filter, 1, marks));
    marked
}

/// Marks the pixels of a row one of whose four neighbours lies on another surface; marks mean something only at every
/// `thinning`-th.
///
/// A steep plane also has large steps, but in inverse depth a plane is linear over the image (without distortion), so
/// a step counts only where inverse depth bends on this side of it or on the other, or where nothing is known of that.
fn mark_edges(depth: &[f32], width: usize, row: usize, filter: &DepthFilter, thinning: usize, marks: &mut [bool]) {
    const GROUP: usize = 32;
    let height = (depth.len() / width) as isize;
    let value = |x: isize, y: isize| {
        let inside = x >= 0 && y >= 0 && x < width as isize && y < height;
        if inside { depth[y as usize * width + x as usize] } else { 0.0 }
    };
    let bend = |before: f32, middle: f32, after: f32| {
        (before > 0.0 && middle > 0.0 && after > 0.0)
            .then(|| (1.0 / before - 2.0 / middle + 1.0 / after).abs() * middle * middle)
    };
    let coefficients = filter.step_coefficients();
    let (fraction, tolerance_floor, tolerance_quadratic) = coefficients;
    let own = &depth[row * width..(row + 1) * width];
    // Rows beyond the border are taken to be this row: no step. The first and the last column are looked at closely.
    let above = if row > 0 { &depth[(row - 1) * width..row * width] } else { own };
    let below = depth.get((row + 1) * width..(row + 2) * width).unwrap_or(own);
    (marks[0], marks[width - 1]) = (own[0] > 0.0, own[width - 1] > 0.0);
    if width > 2 {
        let inner = [&own[1..], own, &own[2..], &above[1..], &below[1..]];
        steps_in_row(inner, coefficients, &mut marks[1..width - 1]);
    }
    for (group, marks) in marks.chunks_mut(GROUP).enumerate() {
        // Most groups have no mark at all; thinning divides their length.
        if !marks.iter().fold(false, |any, mark| any | *mark) {
            continue;
        }
        for (place, mark) in marks.iter_mut().enumerate().step_by(thinning).filter(|(_, mark)| **mark) {
            let column = group * GROUP + place;
            let here = own[column];
            let tolerance = fraction * here + tolerance_floor + tolerance_quadratic * here * here;
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
    }
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

    #[test]
    fn pixels_beside_a_step_are_dropped_and_a_steep_plane_is_kept() {
        let camera = plain_camera(40, 4);
        let step = DepthImage::new(40, 4, (0..160).map(|i| if i % 40 < 20 { 1.0 } else { 1.5 }).collect()).unwrap();
        let valid = view(&step, &camera).valid_depth(&DepthFilter::default());
        let kept: Vec<usize> = (0..40).filter(|&x| valid[40 + x] > 0.0).collect();
        assert_eq!(kept, (0..19).chain(21..40).collect::<Vec<_>>());

        let wide = DepthFilter { edge_margin_px: 3, ..Default::default() };
        let kept = view(&step, &camera).valid_depth(&wide)[40..80].iter().filter(|&&z| z > 0.0).count();
        assert_eq!(kept, 40 - 6);

        // 1/z falls from 2 to 0.4 over the image: neighbours differ by up to 10 %.
        let plane: Vec<f32> = (0..160).map(|i| 1.0 / (2.0 - 1.6 * (i % 40) as f32 / 39.0)).collect();
        let plane = DepthImage::new(40, 4, plane).unwrap();
        let valid = view(&plane, &camera).valid_depth(&DepthFilter::default());
        assert!(valid.iter().all(|&z| z > 0.0), "a plane has no edges");
    }

    #[test]
    fn range_and_masks_are_honoured() {
        let camera = plain_camera(4, 1);
        let depth = DepthImage::new(4, 1, vec![0.02, 0.5, 0.505, 9.0]).unwrap();
        let filter = DepthFilter { edge_margin_px: 0, ..Default::default() };
        assert_eq!(view(&depth, &camera).valid_depth(&filter), vec![0.0, 0.5, 0.505, 0.0]);
        let mask = GrayImage::from_raw(4, 1, vec![255, 0, 255, 255]).unwrap();
        let masked = View { depth_mask: Some(&mask), ..view(&depth, &camera) };
        assert_eq!(masked.valid_depth(&filter), vec![0.0, 0.0, 0.505, 0.0]);
        let masked = View { color_mask: Some(&mask), ..view(&depth, &camera) };
        assert_eq!(masked.valid_depth(&filter), vec![0.0, 0.0, 0.505, 0.0]);
    }
}
