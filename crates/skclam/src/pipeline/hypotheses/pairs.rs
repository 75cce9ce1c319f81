//! Matches that no rig had a say in: neighbours of the recording and the pairs of most shared descriptors, verified by
//! RANSAC alone.

use super::relative_pose::{RelativeRotation, relative_rotation};
use crate::pipeline::{Config, ImageFeatures, RunError};
use crate::progress::{Progress, Stage};
use rayon::prelude::*;
use skclam_calibration::PairMatch;
use skclam_features::filter::Verification;
use skclam_features::{
    DescribedPoints, Descriptor, FilterOptions, MatchOptions, RansacOptions, match_and_filter, match_descriptors,
};
use skclam_geometry::{PinholeCamera, Pixel};

/// The strongest keypoints of an image that are matched.
const KEYPOINTS: usize = 800;
/// The strongest keypoints of an image that show how much two images have in common.
const SKETCH: usize = 150;
/// Pairs whose shared descriptors are counted at most, evenly over all.
const MAX_COMPARED: usize = 2500;
/// Pairs that are matched at most.
const MAX_PAIRS: usize = 240;
/// Neighbours of an image by shared descriptors.
const NEIGHBORS: usize = 4;
/// A pair with fewer verified matches may be an accident.
const MIN_MATCHES: usize = 20;
/// Matches that stay within so many pixels of their place are of what moves with the camera (or of a camera at rest).
const STATIC_PX: f64 = 1.5;

/// Verified matches of two images, and how the camera turned between them.
#[derive(Debug, Clone)]
pub(super) struct FreePair {
    /// Row of the first image.
    pub a: usize,
    /// Row of the second image.
    pub b: usize,
    /// Pixels as measured.
    pub matches: Vec<PairMatch>,
    /// By the intrinsics and the matches alone.
    pub rotation: RelativeRotation,
}

/// An image's strongest keypoints, strongest first.
struct Strongest {
    descriptors: Vec<Descriptor>,
    undistorted: Vec<Pixel>,
    pixels: Vec<Pixel>,
}

/// Matches a modest number of pairs without any prediction; those that keep enough matches, by `a`, then `b`.
pub(super) fn free_pairs(
    images: &[ImageFeatures],
    camera: &PinholeCamera,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Vec<FreePair>, RunError> {
    let images: Vec<Strongest> = images.par_iter().map(strongest).collect();
    let chosen = choose(&images, progress)?;
    // No gate: it would be one about the wrong lines.
    let options = FilterOptions {
        gate_px: None,
        best: None,
        ransac: Some(RansacOptions { seed: config.seed, ..config.filter.ransac.clone().unwrap_or_default() }),
        ..config.filter.clone()
    };
    progress.begin(Stage::FindCause, chosen.len() as u64);
    let found: Vec<Option<FreePair>> = chosen
        .into_par_iter()
        .map(|(a, b)| {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            progress.step();
            one_pair(&images, (a, b), camera, &options)
        })
        .collect::<Result<_, RunError>>()?;
    Ok(found.into_iter().flatten().collect())
}

fn one_pair(
    images: &[Strongest],
    (a, b): (usize, usize),
    camera: &PinholeCamera,
    options: &FilterOptions,
) -> Result<Option<FreePair>, RunError> {
    let described =
        |k: usize| DescribedPoints { descriptors: &images[k].descriptors, positions: &images[k].undistorted };
    let found = match_and_filter(described(a), described(b), None, options)?;
    let Some(Verification::Verified(fit)) = &found.verification else { return Ok(None) };
    let moved = |m: &&skclam_features::Match| {
        (images[a].pixels[m.a as usize] - images[b].pixels[m.b as usize]).norm() > STATIC_PX
    };
    let kept: Vec<_> = found.matches.iter().filter(moved).collect();
    if kept.len() < MIN_MATCHES || 2 * kept.len() < found.matches.len() {
        return Ok(None);
    }
    let ends: Vec<(Pixel, Pixel)> =
        kept.iter().map(|m| (images[a].undistorted[m.a as usize], images[b].undistorted[m.b as usize])).collect();
    let rotation = relative_rotation(camera, &ends, &fit.fundamental);
    let matches = kept.iter().map(|m| PairMatch {
        in_a: images[a].pixels[m.a as usize],
        in_b: images[b].pixels[m.b as usize],
        sigma_px: 1.0,
        distance: m.distance,
    });
    Ok(Some(FreePair { a, b, matches: matches.collect(), rotation }))
}

fn strongest(image: &ImageFeatures) -> Strongest {
    let keypoints = &image.features.keypoints;
    let mut order: Vec<usize> = (0..keypoints.len()).collect();
    order.sort_by(|&x, &y| keypoints[y].response.total_cmp(&keypoints[x].response).then(x.cmp(&y)));
    order.truncate(KEYPOINTS);
    Strongest {
        descriptors: order.iter().map(|&k| image.features.descriptors[k]).collect(),
        undistorted: order.iter().map(|&k| image.undistorted[k]).collect(),
        pixels: order.iter().map(|&k| Pixel::new(f64::from(keypoints[k].x), f64::from(keypoints[k].y))).collect(),
    }
}

/// Neighbours, and for each image those with which it shares most descriptors.
fn choose(images: &[Strongest], progress: &dyn Progress) -> Result<Vec<(usize, usize)>, RunError> {
    let all: Vec<(usize, usize)> = (0..images.len()).flat_map(|a| (a + 1..images.len()).map(move |b| (a, b))).collect();
    let stride = all.len().div_ceil(MAX_COMPARED).max(1);
    let options = MatchOptions { ratio: 0.8, cross_check: true, max_distance: None };
    let shared: Vec<(usize, (usize, usize))> = all
        .into_iter()
        .step_by(stride)
        .collect::<Vec<_>>()
        .into_par_iter()
        .map(|(a, b)| {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            let sketch = |k: usize| &images[k].descriptors[..images[k].descriptors.len().min(SKETCH)];
            Ok((match_descriptors(sketch(a), sketch(b), &options)?.matches.len(), (a, b)))
        })
        .collect::<Result<_, RunError>>()?;
    let mut by_image: Vec<Vec<(usize, (usize, usize))>> = vec![Vec::new(); images.len()];
    for &(count, (a, b)) in shared.iter().filter(|(count, _)| *count > 0) {
        by_image[a].push((count, (a, b)));
        by_image[b].push((count, (a, b)));
    }
    let mut chosen: Vec<(usize, usize)> = (1..images.len()).map(|b| (b - 1, b)).collect();
    for neighbors in &mut by_image {
        neighbors.sort_by(|x, y| y.0.cmp(&x.0).then(x.1.cmp(&y.1)));
        chosen.extend(neighbors.iter().take(NEIGHBORS).map(|(_, pair)| *pair));
    }
    chosen.sort_unstable();
    chosen.dedup();
    let stride = chosen.len().div_ceil(MAX_PAIRS).max(1);
    Ok(chosen.into_iter().step_by(stride).collect())
}
