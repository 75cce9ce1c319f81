//! The mount when nothing is known of it: matches that need no prediction, and a search over all orientations.

use super::{Config, ImageFeatures, ImagePair, RunError, Search, extract_features, match_pairs};
use crate::dataset::Dataset;
use crate::progress::Progress;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Correspondences, PairMatch, PairMatches, find_mount as search};
use skclam_features::FilterOptions;
use skclam_geometry::{Isometry3, Pixel};

/// A mount that was found from the images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FoundMount {
    /// The mount.
    pub flange_from_color: Isometry3,
    /// How far it is turned from the rig's own, degrees.
    pub turned_by_deg: f64,
    /// How far it is shifted from the rig's own, millimetres.
    pub shifted_by_mm: f64,
    /// Pairs of images that took part.
    pub pairs: usize,
    /// Their matches.
    pub matches: usize,
    /// Median Sampson distance of the matches with this mount and the nominal arm, px.
    pub median_sampson_px: f64,
}

/// The strongest keypoints of an image that take part: every image is matched with every other.
const KEYPOINTS: usize = 1500;
/// Pairs that are matched at most, evenly over all.
const PAIRS: usize = 3000;
/// No camera is mounted farther from a flange.
const FARTHEST_M: f64 = 1.0;
/// A pair with fewer verified matches may be an accident.
const MIN_MATCHES: usize = 20;

/// Finds `flange_from_color` with the arm as it is nominally; the data set's own mount is only compared with.
pub fn find_mount(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<FoundMount, RunError> {
    let mut images = extract_features(dataset, config, progress)?;
    images.iter_mut().for_each(keep_strongest);
    let all = |a: usize| (a + 1..images.len()).map(move |b| ImagePair { a, b, overlap: 0.0 });
    let mut chosen: Vec<ImagePair> = (0..images.len()).flat_map(all).collect();
    let stride = chosen.len().div_ceil(PAIRS).max(1);
    chosen = chosen.into_iter().step_by(stride).collect();
    // No gate: it would be one about the wrong lines. RANSAC alone decides which pairs see the same.
    let free = Config {
        search: Search::Exhaustive,
        epipolar_gate_deg: None,
        filter: FilterOptions {
            best: None,
            ransac: Some(config.filter.ransac.clone().unwrap_or_default()),
            ..config.filter.clone()
        },
        ..config.clone()
    };
    let matched = match_pairs(dataset, &images, chosen, &free, progress)?;
    let position = |image: usize, keypoint: u32| {
        let keypoint = &images[image].features.keypoints[keypoint as usize];
        Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))
    };
    let pairs: Vec<PairMatches> = matched
        .iter()
        .filter(|matched| matched.matches.len() >= MIN_MATCHES)
        .map(|matched| {
            let (a, b) = (matched.pair.a, matched.pair.b);
            let matches = matched.matches.iter().map(|m| PairMatch {
                in_a: position(a, m.a),
                in_b: position(b, m.b),
                sigma_px: 1.0,
                distance: m.distance,
            });
            PairMatches { a, b, matches: matches.collect() }
        })
        .collect();
    let data = Correspondences {
        postures: dataset.records.iter().map(|record| record.posture.clone()).collect(),
        pairs,
        ..Correspondences::default()
    };
    let found = search(&dataset.rig, &data)?;
    let flange_from_color = found.model.rig.flange_from_color;
    let distance_m = flange_from_color.translation.vector.norm();
    if distance_m > FARTHEST_M {
        return Err(RunError::AbsurdMount {
            distance_m,
            matches: data.match_count(),
            pairs: data.pairs.len(),
            median_px: found.epipolar_after.median_sampson_px,
        });
    }
    let change = dataset.rig.flange_from_color.inverse() * flange_from_color;
    Ok(FoundMount {
        flange_from_color,
        turned_by_deg: change.rotation.angle().to_degrees(),
        shifted_by_mm: change.translation.vector.norm() * 1e3,
        pairs: data.pairs.len(),
        matches: data.match_count(),
        median_sampson_px: found.epipolar_after.median_sampson_px,
    })
}

fn keep_strongest(image: &mut ImageFeatures) {
    let mut responses: Vec<f32> = image.features.keypoints.iter().map(|keypoint| keypoint.response).collect();
    if responses.len() <= KEYPOINTS {
        return;
    }
    responses.sort_by(|a, b| b.total_cmp(a));
    let least = responses[KEYPOINTS - 1];
    let strong: Vec<bool> = image.features.keypoints.iter().map(|keypoint| keypoint.response >= least).collect();
    let mut at = 0;
    image.retain(|_| {
        at += 1;
        strong[at - 1]
    });
}
