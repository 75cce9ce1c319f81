//! The detector from image to labelled corners.

use super::grid::{Grid, grids};
use super::labelling::possible;
use super::saddle::{Plane, candidates};
use super::{BoardLayout, FoundBoard, GridCorner, markers, subpixel};
use crate::FeaturesError;
use image::GrayImage;
use serde::{Deserialize, Serialize};

/// Settings of the board detector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BoardOptions {
    /// Smoothing before candidates are looked for, px.
    pub smoothing_px: f64,
    /// How often the image is halved at most; strongly blurred boards are found in small images.
    pub halvings: u32,
    /// A board with fewer corners in view is not told.
    pub least_corners: usize,
    /// Half the window of the refinement, in sides of a square.
    pub window: f64,
    /// Half the window at most, px.
    pub most_window_px: f64,
}

impl Default for BoardOptions {
    fn default() -> Self {
        BoardOptions { smoothing_px: 1.2, halvings: 3, least_corners: 9, window: 0.35, most_window_px: 14.0 }
    }
}

/// Pixels of an image at most; more would take gigabytes.
const MOST_PIXELS: u64 = 1 << 28;
/// Half the window of the refinement at least, px.
const LEAST_WINDOW_PX: f64 = 2.5;
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
    let mut level = full.clone();
    let mut best: Option<(FoundBoard, Grid)> = None;
    let whole = (layout.columns * layout.rows) as usize;
    for halving in 0..=options.halvings {
        if halving > 0 {
            level = level.halved();
        }
        if level.width < 16 || level.height < 16 {
            break;
        }
        if let Some(found) = in_level(&level, &full, halving, layout, options)
            && best.as_ref().is_none_or(|(board, _)| board.corners.len() < found.0.corners.len())
        {
            best = Some(found);
        }
        if best.as_ref().is_some_and(|(board, _)| board.corners.len() >= whole) {
            break;
        }
    }
    Ok(best.map(|(board, _)| board).filter(|board| board.corners.len() >= options.least_corners))
}

fn check(image: &GrayImage, layout: &BoardLayout, options: &BoardOptions) -> Result<(), FeaturesError> {
    let (width, height) = image.dimensions();
    if u64::from(width) * u64::from(height) > MOST_PIXELS {
        return Err(FeaturesError::ImageTooLarge { width, height, max_pixels: MOST_PIXELS });
    }
    let bad = |option, got: String, need| Err(FeaturesError::BadOption { option, got, need });
    if !(0.5..=10.0).contains(&options.smoothing_px) {
        return bad("smoothing_px", options.smoothing_px.to_string(), "0.5 to 10 px");
    }
    if !(0.05..=0.5).contains(&options.window) {
        return bad("window", options.window.to_string(), "0.05 to 0.5 sides of a square");
    }
    if !(LEAST_WINDOW_PX..=100.0).contains(&options.most_window_px) {
        return bad("most_window_px", options.most_window_px.to_string(), "2.5 to 100 px");
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

/// The largest board of one level of the pyramid, its corners refined in the full image.
fn in_level(
    level: &Plane,
    full: &Plane,
    halving: u32,
    layout: &BoardLayout,
    options: &BoardOptions,
) -> Option<(FoundBoard, Grid)> {
    let smooth = level.smoothed(options.smoothing_px as f32);
    let strength = smooth.saddle_strength();
    let found = candidates(&smooth, &strength);
    let most = (layout.columns as i32, layout.rows as i32);
    let scale = f64::from(1u32 << halving);
    // Pixel x of a level is at scale x + (scale - 1) / 2 of the full image.
    let to_full = |v: f32| (f64::from(v) * scale + 0.5 * (scale - 1.0)) as f32;
    let mut best: Option<(FoundBoard, Grid)> = None;
    for mut grid in grids(&found).into_iter().take(GRIDS) {
        grid.complete(&smooth, &strength, most);
        grid.drop_bent();
        for place in grid.corners.values_mut() {
            *place = (to_full(place.0), to_full(place.1));
        }
        if grid.corners.len() < options.least_corners {
            continue;
        }
        let (labellings, markers) = match &layout.markers {
            None => (possible(&grid, layout), 0),
            Some(markers) => match markers::read(full, &grid, layout, markers) {
                Some(found) => found,
                None => continue,
            },
        };
        if labellings.is_empty() {
            continue;
        }
        let board = FoundBoard { corners: refined(full, &grid, layout, options), labellings, markers };
        if best.as_ref().is_none_or(|(other, _)| other.corners.len() < board.corners.len()) {
            best = Some((board, grid));
        }
    }
    best
}

/// The grid's corners, refined; those that cannot be are left out.
fn refined(full: &Plane, grid: &Grid, layout: &BoardLayout, options: &BoardOptions) -> Vec<GridCorner> {
    // No marker may reach into the window: it begins half of what it leaves free from the corner, on both axes.
    let free = layout
        .markers
        .as_ref()
        .map_or(0.5, |markers| 0.5 * (1.0 - markers.marker_in_square) * std::f64::consts::SQRT_2);
    grid.corners
        .iter()
        .filter_map(|(&(row, column), &(x, y))| {
            let step = f64::from(grid.step(row, column)?);
            let radius = (options.window.min(free) * step).clamp(LEAST_WINDOW_PX, options.most_window_px);
            let (x, y) = subpixel::refine(full, (f64::from(x), f64::from(y)), radius)?;
            Some(GridCorner { column, row, x, y })
        })
        .collect()
}
