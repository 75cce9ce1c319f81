//! One position and covariance for every observation of a track.

use super::{Observation, Tracks};
use crate::refine::{Bend, Pyramid, RefineOptions, Refined, Refiner, Rejection, Seed};
use crate::{FeaturesError, KeyPoint};
use nalgebra::{Matrix2, Point2};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// What is predicted of the change from the patch at an observation (the reference) to the patch at another one.
pub trait WarpPrediction: Sync {
    /// The linear part, to start from: a small offset `d` in the first image becomes `M d` in the second. `None` where
    /// nothing is predicted: then sizes and orientations of the keypoints give it.
    fn linear(&self, _reference: Observation, _observation: Observation) -> Option<Matrix2<f64>> {
        None
    }

    /// The part of second order, when the linear part was found to be `b_from_a` and the point of the reference at
    /// `in_b`, px. `None` where nothing is predicted: then the change is taken as affine.
    fn bend(
        &self,
        _reference: Observation,
        _observation: Observation,
        _b_from_a: &Matrix2<f64>,
        _in_b: &Point2<f64>,
    ) -> Option<Bend> {
        None
    }
}

/// Where the point of a track is in one of its images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TrackPoint {
    /// This observation names the point: it is where its keypoint is, by definition.
    Reference {
        /// The keypoint's position, px.
        position: Point2<f64>,
    },
    /// Aligned with the reference.
    Refined(Refined),
    /// Not aligned: the observation shows something else, or not well enough.
    Rejected(Rejection),
}

impl TrackPoint {
    /// Position in px and covariance in px², if the observation is to be used; `reference_sigma_px` is what the
    /// reference is granted. The noise of the reference's patch is in the covariance of the others, so it need only
    /// cover what the model of the camera leaves.
    pub fn measurement(&self, reference_sigma_px: f64) -> Option<(Point2<f64>, Matrix2<f64>)> {
        match self {
            TrackPoint::Reference { position } => {
                Some((*position, Matrix2::identity() * reference_sigma_px * reference_sigma_px))
            }
            TrackPoint::Refined(refined) => Some((refined.in_b, refined.covariance)),
            TrackPoint::Rejected(_) => None,
        }
    }
}

/// The refined points of [`Tracks`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RefinedTracks {
    /// One an observation, in the order of [`Tracks::observations`].
    pub points: Vec<TrackPoint>,
}

impl RefinedTracks {
    /// Observations that were aligned with a reference.
    pub fn refined(&self) -> usize {
        self.points.iter().filter(|point| matches!(point, TrackPoint::Refined(_))).count()
    }

    /// Observations that could not be.
    pub fn rejected(&self) -> usize {
        self.points.iter().filter(|point| matches!(point, TrackPoint::Rejected(_))).count()
    }
}

/// Aligns every observation of a track with the track's reference.
///
/// The reference is the observation whose keypoint's size is nearest to all others' (least sum of logarithms'
/// distances), of equals the one of strongest response, then the first. `keypoints` and `pyramids` hold one entry an
/// image. Where `predicted` gives nothing, the linear part comes from the sizes and orientations of the keypoints, and
/// there is none of second order.
///
/// Runs on rayon's current pool; the result does not depend on it.
///
/// # Errors
/// Options out of range, lists of different length, observations that do not exist.
pub fn refine_tracks(
    tracks: &Tracks,
    keypoints: &[&[KeyPoint]],
    pyramids: &[Pyramid],
    predicted: Option<&dyn WarpPrediction>,
    options: &RefineOptions,
) -> Result<RefinedTracks, FeaturesError> {
    if pyramids.len() != keypoints.len() {
        let what = "prepared images for lists of keypoints";
        return Err(FeaturesError::CountMismatch { what, got: pyramids.len(), need: keypoints.len() });
    }
    let work = Work::new(tracks, keypoints, predicted, options)?;
    let mut points = work.unaligned();
    work.align(&work.alignments(), |image| &pyramids[image as usize], &mut points);
    Ok(RefinedTracks { points })
}

/// [`refine_tracks`] with at most `window` prepared images at a time (at least two), which `prepare` makes as they are
/// needed. The result is the same; an image is prepared again when its turn comes again.
///
/// Images are taken in groups of half a window, and all pairs of groups that share a track in ascending order.
///
/// # Errors
/// As [`refine_tracks`], and those of `prepare`.
pub fn refine_tracks_in_windows<E: From<FeaturesError> + Send>(
    tracks: &Tracks,
    keypoints: &[&[KeyPoint]],
    window: usize,
    prepare: impl Fn(usize) -> Result<Pyramid, E> + Sync,
    predicted: Option<&dyn WarpPrediction>,
    options: &RefineOptions,
) -> Result<RefinedTracks, E> {
    let work = Work::new(tracks, keypoints, predicted, options)?;
    let mut points = work.unaligned();
    let group_of = |image: u32| image as usize / (window / 2).max(1);
    let groups = |alignment: &Alignment| {
        let [from, to] = [alignment.reference, alignment.observation].map(|at| group_of(tracks.observations[at].image));
        (from.min(to), from.max(to))
    };
    let mut alignments = work.alignments();
    alignments.sort_by_key(|alignment| (groups(alignment), alignment.observation));
    let mut ready: BTreeMap<u32, Pyramid> = BTreeMap::new();
    for together in alignments.chunk_by(|a, b| groups(a) == groups(b)) {
        let (first, second) = groups(&together[0]);
        ready.retain(|&image, _| group_of(image) == first || group_of(image) == second);
        let images = together.iter().flat_map(|alignment| [alignment.reference, alignment.observation]);
        let mut missing: Vec<u32> = images.map(|at| tracks.observations[at].image).collect();
        missing.sort_unstable();
        missing.dedup();
        missing.retain(|image| !ready.contains_key(image));
        let made: Vec<(u32, Pyramid)> =
            missing.into_par_iter().map(|image| Ok((image, prepare(image as usize)?))).collect::<Result<_, E>>()?;
        ready.extend(made);
        work.align(together, |image| &ready[&image], &mut points);
    }
    Ok(RefinedTracks { points })
}

/// One observation to align, and what with; indices of observations.
#[derive(Debug, Clone, Copy)]
struct Alignment {
    reference: usize,
    observation: usize,
}

/// What is the same for all alignments.
struct Work<'a> {
    tracks: &'a Tracks,
    keypoints: &'a [&'a [KeyPoint]],
    predicted: Option<&'a dyn WarpPrediction>,
    refiner: Refiner,
}

impl<'a> Work<'a> {
    fn new(
        tracks: &'a Tracks,
        keypoints: &'a [&'a [KeyPoint]],
        predicted: Option<&'a dyn WarpPrediction>,
        options: &RefineOptions,
    ) -> Result<Self, FeaturesError> {
        for observation in &tracks.observations {
            let (image, keypoint) = (observation.image as usize, observation.keypoint as usize);
            let Some(of_image) = keypoints.get(image) else {
                return Err(FeaturesError::NoSuchIndex { what: "image", index: image, count: keypoints.len() });
            };
            if keypoint >= of_image.len() {
                return Err(FeaturesError::NoSuchIndex { what: "keypoint", index: keypoint, count: of_image.len() });
            }
        }
        Ok(Work { tracks, keypoints, predicted, refiner: Refiner::new(options)? })
    }

    fn keypoint(&self, observation: &Observation) -> &'a KeyPoint {
        &self.keypoints[observation.image as usize][observation.keypoint as usize]
    }

    /// Every observation where its keypoint is.
    fn unaligned(&self) -> Vec<TrackPoint> {
        let position = |observation| {
            let keypoint = self.keypoint(observation);
            Point2::new(f64::from(keypoint.x), f64::from(keypoint.y))
        };
        self.tracks
            .observations
            .iter()
            .map(|observation| TrackPoint::Reference { position: position(observation) })
            .collect()
    }

    /// All that is to be done, in the order of the observations.
    fn alignments(&self) -> Vec<Alignment> {
        let mut alignments = Vec::with_capacity(self.tracks.observations.len());
        for ends in self.tracks.starts.windows(2) {
            let range = ends[0]..ends[1];
            let reference =
                ends[0] + reference(&self.tracks.observations[range.clone()], |observation| self.keypoint(observation));
            let others = range.filter(|&observation| observation != reference);
            alignments.extend(others.map(|observation| Alignment { reference, observation }));
        }
        alignments
    }

    /// Aligns, and puts each answer in its observation's place.
    fn align<'p>(
        &self,
        alignments: &[Alignment],
        pyramid: impl Fn(u32) -> &'p Pyramid + Sync,
        points: &mut [TrackPoint],
    ) {
        let align = |refiner: &mut Refiner, alignment: &Alignment| {
            let [from, to] =
                [alignment.reference, alignment.observation].map(|observation| &self.tracks.observations[observation]);
            let mut seed = Seed::from_keypoints(self.keypoint(from), self.keypoint(to));
            if let Some(linear) = self.predicted.and_then(|predicted| predicted.linear(*from, *to)) {
                seed.b_from_a = linear;
            }
            let bend = |b_from_a: &Matrix2<f64>, in_b: &Point2<f64>| {
                self.predicted.and_then(|predicted| predicted.bend(*from, *to, b_from_a, in_b))
            };
            match refiner.refine_bent(pyramid(from.image), pyramid(to.image), &seed, &bend) {
                Ok(refined) => TrackPoint::Refined(refined),
                Err(rejection) => TrackPoint::Rejected(rejection),
            }
        };
        let aligned: Vec<TrackPoint> =
            alignments.par_iter().with_min_len(64).map_init(|| self.refiner.clone(), align).collect();
        for (alignment, point) in alignments.iter().zip(aligned) {
            points[alignment.observation] = point;
        }
    }
}

/// Index of the observation that names the point.
fn reference<'a>(track: &[Observation], of: impl Fn(&Observation) -> &'a KeyPoint) -> usize {
    let sizes: Vec<f64> = track.iter().map(|observation| f64::from(of(observation).size).ln()).collect();
    let mut best = (0, f64::INFINITY, f32::NEG_INFINITY);
    for (index, size) in sizes.iter().enumerate() {
        let apart: f64 = sizes.iter().map(|other| (other - size).abs()).sum();
        let response = of(&track[index]).response;
        if apart < best.1 || (apart == best.1 && response > best.2) {
            best = (index, apart, response);
        }
    }
    best.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Match;
    use crate::tracks::{ImagePair, TrackOptions, build_tracks};
    use image::{GrayImage, Luma};

    /// A smooth pattern without repetition, moved by a fraction of a pixel.
    fn pattern(dx: f64, dy: f64) -> GrayImage {
        GrayImage::from_fn(200, 160, |x, y| {
            let (x, y) = (f64::from(x) - dx, f64::from(y) - dy);
            let waves = (0.31 * x + 0.17 * y).sin() + (0.22 * x - 0.41 * y).sin() + (0.013 * x * y / 2.0).sin();
            Luma([(127.0 + 35.0 * waves) as u8])
        })
    }

    #[test]
    fn each_observation_has_one_position_and_a_wrong_one_is_rejected() {
        let shifts = [(0.0, 0.0), (5.3, -2.6), (-3.75, 4.2), (8.5, 1.1)];
        let pyramids: Vec<Pyramid> = shifts.iter().map(|(dx, dy)| Pyramid::new(&pattern(*dx, *dy))).collect();
        let keypoint = |x: f64, y: f64, response: f32| KeyPoint {
            x: x as f32,
            y: y as f32,
            size: 5.0,
            angle: 0.0,
            response,
            octave: 0,
            level: 0,
        };
        let points: Vec<(f64, f64)> =
            (0..12).map(|i| (40.0 + 10.0 * f64::from(i), 40.0 + 7.0 * f64::from(i % 9))).collect();
        let mut keypoints: Vec<Vec<KeyPoint>> = Vec::new();
        for (image, (dx, dy)) in shifts.iter().enumerate() {
            // Off by up to half a pixel, but for the reference (of strongest response).
            let off = if image == 1 { 0.0 } else { 0.4 };
            let response = if image == 1 { 2.0 } else { 1.0 };
            keypoints.push(points.iter().map(|(x, y)| keypoint(x + dx + off, y + dy - off, response)).collect());
        }
        // The last image's third keypoint is somewhere else altogether.
        keypoints[3][2].x += 40.0;
        let matches: Vec<Match> =
            (0..12).map(|index| Match { a: index, b: index, distance: 10, second_distance: 90 }).collect();
        let pairs: Vec<_> = (0..3).map(|a| ImagePair { a, b: a + 1, matches: &matches }).collect();
        let tracks = build_tracks(&[12; 4], &pairs, &TrackOptions::default()).unwrap();
        assert_eq!(tracks.len(), 12);
        let lists: Vec<&[KeyPoint]> = keypoints.iter().map(Vec::as_slice).collect();
        let options = RefineOptions { min_correlation: 0.95, ..RefineOptions::default() };
        let refined = refine_tracks(&tracks, &lists, &pyramids, None, &options).unwrap();
        for (observation, point) in tracks.observations.iter().zip(&refined.points) {
            let ((x, y), (dx, dy)) = (points[observation.keypoint as usize], shifts[observation.image as usize]);
            match point {
                TrackPoint::Rejected(_) => assert_eq!((observation.image, observation.keypoint), (3, 2)),
                point => {
                    let (position, covariance) = point.measurement(0.02).unwrap();
                    let error = position - Point2::new(x + dx, y + dy);
                    assert!(error.norm() < 0.03, "{observation:?}: {error:?}");
                    assert!(covariance.trace() < 0.05);
                }
            }
        }
        assert_eq!((refined.refined(), refined.rejected()), (35, 1));
        // However few images are at hand at a time, the answers are the same.
        for window in 0..6 {
            let made = std::sync::atomic::AtomicUsize::new(0);
            let prepare = |image: usize| {
                made.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
                Ok::<_, FeaturesError>(pyramids[image].clone())
            };
            let windowed = refine_tracks_in_windows(&tracks, &lists, window, prepare, None, &options).unwrap();
            assert_eq!(windowed, refined, "{window}");
            assert!(made.into_inner() <= 8);
        }
        let failing = |image| Err(FeaturesError::NoSuchIndex { what: "image", index: image, count: 0 });
        assert!(refine_tracks_in_windows(&tracks, &lists, 2, failing, None, &options).is_err());
        // A prediction that is nonsense is used, and shows.
        struct Nonsense;
        impl WarpPrediction for Nonsense {
            fn linear(&self, _: Observation, _: Observation) -> Option<Matrix2<f64>> {
                Some(Matrix2::new(0.0, -1.0, 1.0, 0.0))
            }
        }
        let wrong = refine_tracks(&tracks, &lists, &pyramids, Some(&Nonsense), &options).unwrap();
        assert!(wrong.refined() <= 2, "{}", wrong.refined());
        assert!(refine_tracks(&tracks, &lists[..3], &pyramids, None, &options).is_err());
    }
}
