//! What moves with the camera: the gripper, a cable. Found from matches that stay in place while the scene moves.
//!
//! Matches between two images whose camera has moved fall into those of the scene, which move, and those of things
//! fixed to the camera, which do not. A point of the scene, too, may stay in place: where the motion's axis passes, or
//! if the camera hardly moved. So a static match counts only where the scene *should* have moved: a
//! homography is fitted to the matches that moved, and must move the place by far more than the match moved. Such
//! votes are collected over all pairs in cells of the image; a cell is masked if enough pairs voted for it and the
//! scene was seldom seen to move through it. Gaps are closed and the edge is widened, since features at an outline
//! change with the background.
//!
//! Give matches that were *not* gated by predicted epipolar lines: the gate drops what is looked for.

mod cells;

use crate::filter::{check_matches, check_positions, homography};
use crate::{Features, FeaturesError, Match};
use cells::Cells;
use image::{GrayImage, Luma};
use nalgebra::Point2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// When something is taken to be fixed to the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MaskOptions {
    /// A match that moved at most this far is static, px.
    pub static_px: f64,
    /// Where it is static, the scene must have moved at least this far, px.
    pub scene_moves_px: f64,
    /// Fewest pairs of images that must have voted for a place.
    pub min_votes: u32,
    /// Fraction of the votes of a place that must be for static.
    pub min_fraction: f64,
    /// How far from a place with votes the mask reaches, px.
    pub margin_px: f64,
    /// Gaps up to this width within what is fixed are masked too, px, unless the scene was seen in them.
    pub gap_px: f64,
    /// A mask larger than this fraction of the image is rejected.
    pub max_masked_fraction: f64,
}

impl Default for MaskOptions {
    fn default() -> Self {
        MaskOptions {
            static_px: 1.0,
            scene_moves_px: 10.0,
            min_votes: 3,
            min_fraction: 0.75,
            margin_px: 8.0,
            gap_px: 64.0,
            max_masked_fraction: 0.5,
        }
    }
}

/// Matches between two images of one camera, with the positions of the keypoints in the images as they are (px).
#[derive(Debug, Clone, Copy)]
pub struct MatchedPair<'a> {
    /// Positions of the keypoints of image A.
    pub positions_a: &'a [Point2<f64>],
    /// Positions of the keypoints of image B.
    pub positions_b: &'a [Point2<f64>],
    /// Matches, not gated by a prediction.
    pub matches: &'a [Match],
}

/// How the search ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskOutcome {
    /// Something moves with the camera, and the mask covers it.
    Found,
    /// Nothing does that could be seen. The mask covers nothing.
    NothingFixed,
    /// In too few pairs did the scene move enough to decide. The mask covers nothing.
    CameraHardlyMoved,
    /// The static part would cover more than the largest fraction allowed. The mask covers nothing.
    Implausible,
}

/// A mask for what moves with the camera, and where it comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct EgoMask {
    /// 0 where features are to be ignored, 255 elsewhere.
    pub mask: GrayImage,
    /// How the search ended.
    pub outcome: MaskOutcome,
    /// Pairs given.
    pub pairs: usize,
    /// Pairs in which the scene moved enough to decide.
    pub moving_pairs: usize,
    /// Static matches where the scene moved.
    pub static_matches: usize,
    /// Matches that moved with the scene.
    pub scene_matches: usize,
    /// Fraction of the image that was found to be fixed; in the mask unless it was rejected.
    pub masked_fraction: f64,
}

/// Side of a cell, px.
const CELL_PX: u32 = 8;
/// Fewest matches that must agree on how the scene moved, and their fraction of those that moved.
const MIN_AGREEING: usize = 12;
const MIN_AGREEING_FRACTION: f64 = 0.3;
/// How far a match of the scene may be from the homography, px: depth makes it wrong by some.
const AGREEING_PX: f64 = 15.0;

/// Finds what moves with the camera in images of `width` by `height`.
///
/// Deterministic, whatever the threads. Pairs whose camera hardly moved do no harm, nor do they help.
///
/// # Errors
/// Options out of range, positions that are not finite, matches without a position, an image without pixels.
pub fn find_ego_mask(
    width: u32,
    height: u32,
    pairs: &[MatchedPair<'_>],
    options: &MaskOptions,
) -> Result<EgoMask, FeaturesError> {
    check(width, height, options)?;
    for pair in pairs {
        check_positions(pair.positions_a)?;
        check_positions(pair.positions_b)?;
        check_matches(pair.matches, pair.positions_a.len(), pair.positions_b.len())?;
    }
    let votes: Vec<Votes> = pairs.par_iter().map(|pair| votes_of(pair, options)).collect();

    let mut still = Cells::new(width, height, CELL_PX);
    let mut moving = still.clone();
    let mut found = EgoMask {
        mask: GrayImage::from_pixel(width, height, Luma([255])),
        outcome: MaskOutcome::NothingFixed,
        pairs: pairs.len(),
        moving_pairs: votes.iter().filter(|votes| votes.scene_moved).count(),
        static_matches: votes.iter().map(|votes| votes.still.len()).sum(),
        scene_matches: votes.iter().map(|votes| votes.scene.len()).sum(),
        masked_fraction: 0.0,
    };
    for votes in &votes {
        // One vote a pair and cell, however many keypoints are in it.
        still.count_once(&votes.still);
        moving.count_once(&votes.scene);
    }
    if (found.moving_pairs as u32) < options.min_votes {
        found.outcome = MaskOutcome::CameraHardlyMoved;
        return Ok(found);
    }
    // A place is a cell with its neighbours: keypoints of one thing scatter over the cells' borders.
    let (still_around, moving_around) = (still.summed(1), moving.summed(1));
    let voted = |min_votes: u32| {
        let mut shape = still.clone();
        for (at, cell) in shape.counts.iter_mut().enumerate() {
            let (votes, against) = (still_around.counts[at], moving_around.counts[at]);
            let sure = f64::from(votes) >= options.min_fraction * f64::from(votes.saturating_add(against));
            *cell = u32::from(*cell > 0 && votes >= min_votes && sure);
        }
        shape
    };
    let mut shape = voted(options.min_votes);
    if shape.fraction() == 0.0 {
        return Ok(found);
    }
    let cells = |px: f64| (px / f64::from(CELL_PX)).ceil() as usize;
    let (margin, gap) = (cells(options.margin_px), cells(options.gap_px / 2.0));
    // Beside what is sure, a single vote is enough, and beside that again.
    let single = voted(1);
    loop {
        let reached = shape.widened(gap);
        let mut added = false;
        for (cell, (single, reached)) in shape.counts.iter_mut().zip(single.counts.iter().zip(&reached.counts)) {
            added |= *cell == 0 && *single > 0 && *reached > 0;
            *cell |= single & reached;
        }
        if !added {
            break;
        }
    }
    let mut shape = shape.widened(gap).narrowed(gap).widened(margin);
    for (cell, (still, moving)) in shape.counts.iter_mut().zip(still.counts.iter().zip(&moving.counts)) {
        // Where the scene was seen more than once it is not covered, unless the votes say otherwise.
        if *moving > 1 && f64::from(*still) < options.min_fraction * f64::from(still + moving) {
            *cell = 0;
        }
    }
    found.masked_fraction = shape.fraction();
    if found.masked_fraction > options.max_masked_fraction {
        found.outcome = MaskOutcome::Implausible;
        return Ok(found);
    }
    shape.paint(&mut found.mask);
    found.outcome = MaskOutcome::Found;
    Ok(found)
}

fn check(width: u32, height: u32, options: &MaskOptions) -> Result<(), FeaturesError> {
    let bad = |option, got: String, need| Err(FeaturesError::BadOption { option, got, need });
    if width == 0 || height == 0 {
        return bad("width, height", format!("{width} x {height}"), "an image with pixels");
    }
    let positive = [
        ("static_px", options.static_px),
        ("scene_moves_px", options.scene_moves_px),
        ("min_fraction", options.min_fraction),
        ("margin_px", options.margin_px),
        ("gap_px", options.gap_px),
        ("max_masked_fraction", options.max_masked_fraction),
    ];
    for (option, value) in positive {
        if !(value > 0.0 && value.is_finite()) {
            return bad(option, value.to_string(), "a positive number");
        }
    }
    if options.static_px * 2.0 > options.scene_moves_px {
        return bad("scene_moves_px", options.scene_moves_px.to_string(), "at least twice static_px");
    }
    if options.margin_px.max(options.gap_px) > 512.0 {
        let got = format!("{}, {}", options.margin_px, options.gap_px);
        return bad("margin_px, gap_px", got, "at most 512 px");
    }
    Ok(())
}

/// What one pair has to say.
#[derive(Default)]
struct Votes {
    /// Whether the scene was seen to move.
    scene_moved: bool,
    /// Points, in both images, that were static where the scene moved.
    still: Vec<Point2<f64>>,
    /// Points, in both images, that moved as the scene did.
    scene: Vec<Point2<f64>>,
}

fn votes_of(pair: &MatchedPair<'_>, options: &MaskOptions) -> Votes {
    let ends = |m: &Match| (pair.positions_a[m.a as usize], pair.positions_b[m.b as usize]);
    let (mut still, mut in_a, mut in_b) = (Vec::new(), Vec::new(), Vec::new());
    for (a, b) in pair.matches.iter().map(ends) {
        if (a - b).norm() <= options.static_px {
            still.push((a, b));
        } else {
            in_a.push(a);
            in_b.push(b);
        }
    }
    // The seed is fixed: the answer depends on the pair alone.
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let all: Vec<usize> = (0..in_a.len()).collect();
    let Some((a_from_b, _)) = homography::fit(&in_a, &in_b, &all, AGREEING_PX, &mut random) else {
        return Votes::default();
    };
    let moved = |b: &Point2<f64>| {
        let p = a_from_b * b.to_homogeneous();
        Point2::new(p.x / p.z, p.y / p.z)
    };
    let mut votes = Votes::default();
    let mut agreeing = 0;
    for (a, b) in in_a.iter().zip(&in_b) {
        if (moved(b) - a).norm() <= AGREEING_PX {
            agreeing += 1;
            // What the scene's motion leaves in place carries no information.
            if (a - b).norm() >= options.scene_moves_px {
                votes.scene.extend([*a, *b]);
            }
        }
    }
    if agreeing < MIN_AGREEING || (agreeing as f64) < MIN_AGREEING_FRACTION * in_a.len() as f64 {
        return Votes::default();
    }
    votes.scene_moved = votes.scene.len() >= 2 * MIN_AGREEING;
    if !votes.scene_moved {
        return Votes::default();
    }
    for (a, b) in still {
        // Twice: a homography errs with the depth, and nothing is lost by being sure.
        let away = (moved(&b) - b).norm();
        if away.is_finite() && away >= 2.0 * options.scene_moves_px {
            votes.still.extend([a, b]);
        }
    }
    votes
}

/// Whether features at a position are to be kept; outside of the mask they are.
pub fn is_kept(mask: &GrayImage, x: f32, y: f32) -> bool {
    let (x, y) = (x.round(), y.round());
    let inside = x >= 0.0 && y >= 0.0 && x < mask.width() as f32 && y < mask.height() as f32;
    !inside || mask.get_pixel(x as u32, y as u32).0[0] != 0
}

/// The features whose keypoints are not masked, in their order.
pub fn keep_unmasked(features: &Features, mask: &GrayImage) -> Features {
    let mut kept = Features::default();
    for (keypoint, descriptor) in features.keypoints.iter().zip(&features.descriptors) {
        if is_kept(mask, keypoint.x, keypoint.y) {
            kept.keypoints.push(*keypoint);
            kept.descriptors.push(*descriptor);
        }
    }
    kept
}

#[cfg(test)]
mod tests;
