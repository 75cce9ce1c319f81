//! The detector from image to labelled corners.

use super::grid::{Grid, grids};
use super::labelling::{keeps_colours, possible};
use super::pattern::{Aligned, MIN_REACH_PX, Pattern};
use super::saddle::{Plane, candidates};
use super::{BoardLayout, FoundBoard, GridCorner, Labelling, from_markers, markers, plane};
use crate::FeaturesError;
use image::GrayImage;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Settings of the board detector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BoardOptions {
    /// Smoothing before candidates are looked for, px.
    pub smoothing_px: f64,
    /// How often the image is halved at most; strongly blurred boards are found in small images.
    pub levels: u32,
    /// A board with fewer corners in view is not reported.
    pub min_corners: usize,
    /// Half the window within which a corner's print is aligned with the image, in sides of a square.
    pub window: f64,
    /// Half that window at most, px; at least it is 4 px.
    pub max_window_px: f64,
}

impl Default for BoardOptions {
    fn default() -> Self {
        BoardOptions { smoothing_px: 1.2, levels: 3, min_corners: 9, window: 0.3, max_window_px: 40.0 }
    }
}

/// Pixels of an image at most; more would take gigabytes.
const MAX_PIXELS: u64 = 1 << 28;
/// Grids that are looked at in an image.
const GRIDS: usize = 6;

/// The board in an image; `None` where none is seen.
///
/// # Errors
/// Options out of range, a board without corners or markers of impossible size, images above 2^28 pixels.
pub fn detect_board(
    image: &GrayImage,
    layout: &BoardLayout,
    options: &BoardOptions,
) -> Result<Option<FoundBoard>, FeaturesError> {
    check(image, layout, options)?;
    if image.width() < 16 || image.height() < 16 {
        return Ok(None);
    }
    let full = Plane::of(image);
    let search = Search { noise: full.noise(), full: &full, layout, options };
    let mut level = full.clone();
    let mut best: Option<FoundBoard> = None;
    let whole = (layout.columns * layout.rows) as usize;
    let is_whole = |best: &Option<FoundBoard>| best.as_ref().is_some_and(|board| board.corners.len() >= whole);
    for octave in 0..=options.levels {
        if octave > 0 {
            level = level.halved();
        }
        if level.width < 16 || level.height < 16 {
            break;
        }
        search.in_level(&level, octave, &mut best);
        if is_whole(&best) {
            break;
        }
    }
    if let Some(markers) = &layout.markers
        && !is_whole(&best)
    {
        let (grids, is_clipped) = from_markers::grids(&full, layout, markers, options);
        for grid in grids {
            search.judge(&grid, is_clipped, &mut best);
        }
    }
    Ok(best)
}

fn check(image: &GrayImage, layout: &BoardLayout, options: &BoardOptions) -> Result<(), FeaturesError> {
    let (width, height) = image.dimensions();
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(FeaturesError::ImageTooLarge { width, height, max_pixels: MAX_PIXELS });
    }
    let bad = |option, got: String, need| Err(FeaturesError::BadOption { option, got, need });
    if !(0.5..=10.0).contains(&options.smoothing_px) {
        return bad("smoothing_px", options.smoothing_px.to_string(), "0.5 to 10 px");
    }
    if !(0.05..=0.5).contains(&options.window) {
        return bad("window", options.window.to_string(), "0.05 to 0.5 sides of a square");
    }
    if !(MIN_REACH_PX..=100.0).contains(&options.max_window_px) {
        return bad("max_window_px", options.max_window_px.to_string(), "4 to 100 px");
    }
    if !(2..=1000).contains(&layout.columns) || !(2..=1000).contains(&layout.rows) {
        let got = format!("{} x {}", layout.columns, layout.rows);
        return bad("columns, rows", got, "2 to 1000 inner corners each");
    }
    if let Some(markers) = &layout.markers {
        if !(0.1..1.0).contains(&markers.marker_in_square) {
            return bad("marker_in_square", markers.marker_in_square.to_string(), "0.1 to 1 sides of a square");
        }
        let need = ((layout.columns as usize + 1) * (layout.rows as usize + 1)).div_ceil(2);
        if markers.dictionary.len() < need {
            let what = "markers of the dictionary for the board's white squares";
            return Err(FeaturesError::CountMismatch { what, got: markers.dictionary.len(), need });
        }
    }
    Ok(())
}

/// What a board is looked for in.
struct Search<'a> {
    full: &'a Plane,
    /// Sigma of the image's noise, grey levels.
    noise: f64,
    layout: &'a BoardLayout,
    options: &'a BoardOptions,
}

impl Search<'_> {
    /// Looks for a larger board than the best one in one level of the pyramid.
    fn in_level(&self, level: &Plane, octave: u32, best: &mut Option<FoundBoard>) {
        let smooth = level.smoothed(self.options.smoothing_px as f32);
        let strength = smooth.saddle_strength();
        let found = candidates(&smooth, &strength);
        let most = (self.layout.columns as i32, self.layout.rows as i32);
        let scale = f64::from(1u32 << octave);
        // Pixel x of a level is at scale x + (scale - 1) / 2 of the full image.
        let to_full = |v: f32| (f64::from(v) * scale + 0.5 * (scale - 1.0)) as f32;
        for mut grid in grids(&found).into_iter().take(GRIDS) {
            grid.complete(&smooth, &strength, most);
            grid.drop_bent();
            for place in grid.corners.values_mut() {
                *place = (to_full(place.0), to_full(place.1));
            }
            self.judge(&grid, false, best);
        }
    }

    /// Makes a grid the best board, if it is one, and a larger one. A clipped grid holds corners of the board only,
    /// under one of its possible beginnings.
    fn judge(&self, grid: &Grid, is_clipped: bool, best: &mut Option<FoundBoard>) {
        let larger = |count: usize| best.as_ref().is_none_or(|other| other.corners.len() < count);
        if grid.corners.len() < self.options.min_corners || !larger(grid.corners.len()) {
            return;
        }
        let (labellings, markers) = match &self.layout.markers {
            None => (possible(grid, self.layout), 0),
            Some(markers) => match markers::read(self.full, grid, self.layout, markers, is_clipped) {
                Some(found) => found,
                None => return,
            },
        };
        if labellings.is_empty() {
            return;
        }
        let Some(corners) = self.on_a_plane(self.refined(grid, &labellings[0])) else { return };
        if larger(corners.len()) {
            let squares = corners.iter().map(|corner| corner.sigma_px.powi(2)).sum::<f64>();
            let sigma_px = (squares / corners.len() as f64).sqrt();
            *best = Some(FoundBoard { corners, labellings, markers, sigma_px });
        }
    }

    /// The grid's corners, refined, with the sigma that the image's noise gives them, and their squares' widths; those
    /// that cannot be are left out.
    fn refined(&self, grid: &Grid, labelling: &Labelling) -> Vec<(GridCorner, f64)> {
        // Where a grid can be labelled in several ways, the print about its corners is the same in all.
        let print = Print::new(self.layout, grid, labelling, self.options);
        let refine = |&(row, column): &(i32, i32)| {
            let step_px = f64::from(grid.step(row, column)?);
            let found = print.align(self.full, labelling.of(column, row))?;
            let sigma_px = self.noise * found.noise_gain;
            Some((GridCorner { column, row, x: found.x, y: found.y, sigma_px }, step_px))
        };
        grid.corners.keys().filter_map(refine).collect()
    }

    /// The corners that lie on a plane, their sigmas raised to what they scatter about it; `None` where they are none.
    fn on_a_plane(&self, corners: Vec<(GridCorner, f64)>) -> Option<Vec<GridCorner>> {
        let counted = |corner: &GridCorner| plane::Counted {
            column: f64::from(corner.column),
            row: f64::from(corner.row),
            x: corner.x,
            y: corner.y,
        };
        let points: Vec<plane::Counted> = corners.iter().map(|(corner, _)| counted(corner)).collect();
        let mut steps: Vec<f64> = corners.iter().map(|(_, step_px)| *step_px).collect();
        steps.sort_by(f64::total_cmp);
        let fit = plane::fit(&points, *steps.get(steps.len() / 2)?, self.options.min_corners)?;
        let kept = corners.into_iter().zip(fit.keeps).filter(|(_, keep)| *keep).map(|((corner, _), _)| corner);
        let mut kept: Vec<GridCorner> = kept.collect();
        let noise = kept.iter().map(|corner| corner.sigma_px.powi(2)).sum::<f64>() / kept.len() as f64;
        let excess = (fit.scatter_px.powi(2) - noise).max(0.0);
        for corner in &mut kept {
            corner.sigma_px = (corner.sigma_px.powi(2) + excess).sqrt();
        }
        Some(kept)
    }
}

/// The print of a board over a grid that is counted.
struct Print<'a> {
    pattern: Pattern<'a>,
    /// The grid's corners by the board's row and column.
    corners: BTreeMap<(i32, i32), (f64, f64)>,
}

impl<'a> Print<'a> {
    fn new(layout: &'a BoardLayout, grid: &Grid, labelling: &Labelling, options: &BoardOptions) -> Self {
        let on_board = |(&(row, column), &(x, y)): (&(i32, i32), &(f32, f32))| {
            let (column, row) = labelling.of(column, row);
            ((row, column), (f64::from(x), f64::from(y)))
        };
        let pattern = Pattern::of(layout, keeps_colours(grid, labelling), options);
        Print { pattern, corners: grid.corners.iter().map(on_board).collect() }
    }

    /// A corner (column, row) by the whole print about it.
    fn align(&self, image: &Plane, (column, row): (i32, i32)) -> Option<Aligned> {
        let h = from_markers::nearby(&self.corners, (row, column))?;
        let place = *self.corners.get(&(row, column))?;
        self.pattern.align(image, (column, row), place, &h, 0)
    }
}
