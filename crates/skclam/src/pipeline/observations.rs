//! From matches to what the estimators take: points followed over many images, each observation with one refined
//! position.

use super::{Config, ImageFeatures, MatchedPair, PlaneWarp, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use nalgebra::Matrix2;
use serde::{Deserialize, Serialize};
use skclam_calibration::{Correspondences, PairMatch, PairMatches, Track, TrackObservation, isotropic_covariance};
use skclam_features::tracks::TrackCounts;
use skclam_features::{KeyPoint, Pyramid, Tracks, build_tracks, refine_tracks_in_windows};
use skclam_geometry::Pixel;
use std::sync::atomic::{AtomicBool, Ordering};

/// How tracks were built, for the summary.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct TrackSummary {
    /// What became of the matches.
    pub links: TrackCounts,
    /// Tracks that were used; fewer than there are where there are more than enough.
    pub used: usize,
    /// Observations whose position was refined.
    pub refined: usize,
    /// Observations that could not be aligned with their track's reference, and were dropped.
    pub rejected: usize,
}

/// Memory that the prepared images may take while tracks are refined; beyond it they are prepared some at a time.
const PYRAMID_BYTES: f64 = 1.2e9;
/// Bytes a pixel of a prepared image.
const PYRAMID_BYTES_A_PIXEL: f64 = 2.7;
/// What is granted to the observation that names its track's point, px: it is where it is by definition.
const REFERENCE_SIGMA_PX: f64 = 0.02;
/// Sigma of a position as detected, relative to the size of its keypoint; a keypoint of 8 px has half a pixel.
const DETECTED_SIGMA: f64 = 0.0625;

/// Where one keypoint is, and how surely.
type Measurement = (Pixel, Matrix2<f64>);

/// The matches as the estimators take them: pixels as measured, tracks if the configuration asks for them.
pub fn correspondences(
    dataset: &Dataset,
    images: &[ImageFeatures],
    pairs: &[MatchedPair],
    config: &Config,
    progress: &dyn Progress,
) -> Result<(Correspondences, Option<TrackSummary>), RunError> {
    let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let Some(options) = &config.tracks else {
        let pairs =
            pair_matches(images, pairs, |image, keypoint| Some(detected(&images[image].features.keypoints[keypoint])));
        return Ok((Correspondences { postures, pairs, ..Correspondences::default() }, None));
    };
    progress.begin(Stage::BuildTracks, dataset.len() as u64);
    let keypoints: Vec<&[KeyPoint]> = images.iter().map(|image| image.features.keypoints.as_slice()).collect();
    let counts: Vec<usize> = keypoints.iter().map(|keypoints| keypoints.len()).collect();
    let links: Vec<_> = pairs
        .iter()
        .map(|matched| skclam_features::ImagePair {
            a: matched.pair.a as u32,
            b: matched.pair.b as u32,
            matches: &matched.matches,
        })
        .collect();
    let tracks = thinned(build_tracks(&counts, &links, options)?, config.max_observations);
    let mut summary = TrackSummary { links: tracks.counts, used: tracks.len(), ..TrackSummary::default() };
    let measured = measure(dataset, images, &tracks, &keypoints, config, progress, &mut summary)?;

    // One measurement a keypoint, for the pairs; `None` where an observation was dropped or belongs to no track.
    let mut by_keypoint: Vec<Vec<Option<Measurement>>> = counts.iter().map(|&count| vec![None; count]).collect();
    for (observation, measurement) in tracks.observations.iter().zip(&measured) {
        by_keypoint[observation.image as usize][observation.keypoint as usize] = *measurement;
    }
    let of_track = |range: std::ops::Range<usize>| {
        let observations: Vec<TrackObservation> = range
            .filter_map(|index| {
                let (pixel, covariance) = measured[index]?;
                let observation = tracks.observations[index];
                let (posture, keypoint) = (observation.image as usize, observation.keypoint as usize);
                Some(TrackObservation {
                    posture,
                    pixel,
                    covariance,
                    depth_m: images[posture].depth_m[keypoint],
                    depth_slope: images[posture].depth_slope[keypoint],
                })
            })
            .collect();
        (observations.len() >= 2).then_some(Track { observations })
    };
    let data = Correspondences {
        postures,
        pairs: pair_matches(images, pairs, |image, keypoint| by_keypoint[image][keypoint]),
        tracks: tracks.starts.windows(2).filter_map(|ends| of_track(ends[0]..ends[1])).collect(),
        boards: Vec::new(),
    };
    Ok((data, Some(summary)))
}

/// Every k-th track, evenly over the recording, so that about `max_observations` are left: the error falls only with
/// the root of their number, the time grows with it.
fn thinned(tracks: Tracks, max_observations: Option<usize>) -> Tracks {
    let Some(limit) = max_observations.filter(|&limit| tracks.observations.len() > limit) else { return tracks };
    let keep = limit as f64 / tracks.observations.len() as f64;
    let mut thin = Tracks { starts: vec![0], counts: tracks.counts, ..Tracks::default() };
    for (index, track) in tracks.iter().enumerate() {
        // Track k is kept when the running total of fractions passes a whole number.
        if ((index + 1) as f64 * keep).floor() > (index as f64 * keep).floor() {
            thin.observations.extend_from_slice(track);
            thin.starts.push(thin.observations.len());
        }
    }
    thin
}

/// One entry an observation of the tracks.
fn measure(
    dataset: &Dataset,
    images: &[ImageFeatures],
    tracks: &Tracks,
    keypoints: &[&[KeyPoint]],
    config: &Config,
    progress: &dyn Progress,
    summary: &mut TrackSummary,
) -> Result<Vec<Option<Measurement>>, RunError> {
    let as_detected = || {
        let of = |observation: &skclam_features::Observation| {
            detected(&keypoints[observation.image as usize][observation.keypoint as usize])
        };
        tracks.observations.iter().map(|observation| Some(of(observation))).collect::<Vec<_>>()
    };
    let Some(options) = &config.refine else { return Ok(as_detected()) };
    let camera = &dataset.rig.color;
    let bytes = f64::from(camera.width) * f64::from(camera.height) * PYRAMID_BYTES_A_PIXEL;
    let window = (PYRAMID_BYTES / bytes) as usize;
    let counted: Vec<AtomicBool> = images.iter().map(|_| AtomicBool::new(false)).collect();
    let prepare = |index: usize| {
        if progress.stop_requested() {
            return Err(RunError::Interrupted);
        }
        let pyramid = match &images[index].gray {
            Some(gray) => Pyramid::new(gray),
            None => Pyramid::new(&dataset.gray(index)?),
        };
        // An image that must be prepared again is no further step.
        if !counted[index].swap(true, Ordering::Relaxed) {
            progress.step();
        }
        Ok(pyramid)
    };
    let predicted = PlaneWarp { images, camera };
    let refined = refine_tracks_in_windows(tracks, keypoints, window, prepare, Some(&predicted), options)?;
    summary.refined = refined.refined();
    summary.rejected = refined.rejected();
    Ok(refined.points.iter().map(|point| point.measurement(REFERENCE_SIGMA_PX)).collect())
}

fn detected(keypoint: &KeyPoint) -> Measurement {
    let sigma_px = DETECTED_SIGMA * f64::from(keypoint.size);
    (Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y)), isotropic_covariance(sigma_px))
}

fn pair_matches(
    images: &[ImageFeatures],
    pairs: &[MatchedPair],
    measurement: impl Fn(usize, usize) -> Option<Measurement>,
) -> Vec<PairMatches> {
    debug_assert!(pairs.iter().all(|matched| matched.pair.b < images.len()));
    let of_pair = |matched: &MatchedPair| {
        let (a, b) = (matched.pair.a, matched.pair.b);
        let matches = matched
            .matches
            .iter()
            .filter_map(|m| {
                let ((in_a, covariance_a), (in_b, covariance_b)) =
                    (measurement(a, m.a as usize)?, measurement(b, m.b as usize)?);
                let sigma_px = (0.25 * (covariance_a.trace() + covariance_b.trace())).sqrt();
                Some(PairMatch { in_a, in_b, sigma_px, distance: m.distance })
            })
            .collect();
        PairMatches { a, b, matches }
    };
    pairs.iter().map(of_pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_features::Observation;

    #[test]
    fn thinning_keeps_whole_tracks_evenly() {
        let observation = |image, keypoint| Observation { image, keypoint };
        let tracks = Tracks {
            observations: (0..300).map(|i| observation(i % 3, i / 3)).collect(),
            starts: (0..=100).map(|track| 3 * track).collect(),
            counts: TrackCounts::default(),
        };
        let thin = thinned(tracks.clone(), Some(75));
        assert_eq!(thin.len(), 25);
        assert!(thin.iter().all(|track| track.len() == 3 && track.iter().all(|o| o.keypoint == track[0].keypoint)));
        let kept: Vec<u32> = thin.iter().map(|track| track[0].keypoint).collect();
        assert!(kept.windows(2).all(|two| two[1] - two[0] == 4), "{kept:?}");
        assert_eq!(thinned(tracks.clone(), Some(1000)), tracks);
        assert_eq!(thinned(tracks.clone(), None), tracks);
    }
}
