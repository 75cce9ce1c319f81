//! Matching that looks only where the prediction says: in a band around the epipolar line and, where the depth is
//! known, near a point.
//!
//! # What differs from matching everything and gating afterwards
//! Here the gate comes first: nearest, second nearest and cross-check are taken over the admitted pairs alone, exactly
//! as if every other entry of the distance matrix were missing. The ratio test thereby compares with fewer
//! descriptors, and a keypoint whose nearest descriptor lies outside of the band may still find its match inside.
//! Every match that survives [`match_and_filter`] up to the cross-check is also found here
//! (the same nearest, no nearer second, no better rival; one exception would be a lone candidate whose true second lay
//! beyond [`UNRELATED_DISTANCE`](crate::matching::UNRELATED_DISTANCE)), and some more. In a band so
//! narrow that it holds one or two candidates the ratio test says little: set
//! [`MatchOptions::max_distance`](crate::MatchOptions::max_distance) there.
//!
//! What it costs: a pair that is looked at costs about a third more than a pair in [`match_and_filter`] (the same
//! kernel, and the mask), and the pairs looked at are those admitted and some at the ragged ends of bands. Only a band
//! that holds most of the image takes longer than comparing everything.

mod chart;
mod search;
mod strips;

use crate::filter::{DescribedPoints, FilterOptions, FilteredMatches, Gate, GateOutcome, check_positions};
use crate::filter::{match_and_filter, select_and_verify};
use crate::matching::kernel;
use crate::{FeaturesError, Match, MatchCounts};
use nalgebra::{Matrix3, Point2};
use search::nearest_admitted;

/// What is known about where the keypoints of image A are in image B.
#[derive(Debug, Clone, Copy, Default)]
pub struct Prediction<'a> {
    /// Fundamental matrix, `in_a^T F in_b = 0`; the band's half width is [`FilterOptions::gate_px`].
    pub fundamental: Option<&'a Matrix3<f64>>,
    /// Predicted positions, where there are any.
    pub points: Option<PredictedPoints<'a>>,
}

/// Where single keypoints of image A are expected in image B.
#[derive(Debug, Clone, Copy)]
pub struct PredictedPoints<'a> {
    /// For each keypoint of image A its undistorted pixel in image B; `None` where it is not known (no depth).
    pub in_b: &'a [Option<Point2<f64>>],
    /// How far the match may be from it, px.
    pub radius_px: f64,
}

/// No admitted candidate yet.
const NO_KEY: u64 = u64::MAX;

/// Matches image A with image B where the prediction allows it, and filters by the rest of the chain.
///
/// Keypoints with a predicted point are searched near it (and in the band, if there is one), others in the band;
/// without a band they find nothing. If the prediction says nothing at all (neither points nor a matrix with a gate, or
/// the zero matrix of one posture taken twice), everything is compared as in [`match_and_filter`]; the outcome of the
/// gate says so. In the counts, `after_gate` is the number of keypoints of A with a candidate.
///
/// # Errors
/// As [`match_and_filter`]; also predicted points that are not finite or not as many as keypoints of A, positions whose
/// extent is not finite, and [`FeaturesError::TooManyKeypoints`] from 2^22 keypoints on.
pub fn match_guided(
    a: DescribedPoints<'_>,
    b: DescribedPoints<'_>,
    prediction: &Prediction<'_>,
    options: &FilterOptions,
) -> Result<FilteredMatches, FeaturesError> {
    options.matching.check()?;
    a.check()?;
    b.check()?;
    check_points(prediction.points, a.positions.len())?;
    let gate = match (prediction.fundamental, options.gate_px) {
        (Some(fundamental), Some(half_width_px)) => Gate::new(fundamental, half_width_px)?,
        _ => None,
    };
    if gate.is_none() && prediction.points.is_none() {
        return match_and_filter(a, b, prediction.fundamental, options);
    }
    let outcome = match (&gate, prediction.fundamental, options.gate_px) {
        (Some(_), ..) => GateOutcome::Applied,
        (None, Some(_), Some(_)) => GateOutcome::NoBaseline,
        _ => GateOutcome::NotAsked,
    };

    let (of_a, of_b) = nearest_admitted(a, b, gate.as_ref(), prediction.points, kernel::fastest())?;
    let mut counts = MatchCounts {
        keypoints_a: a.positions.len(),
        keypoints_b: b.positions.len(),
        candidates: of_a.iter().filter(|best| best[0] != NO_KEY).count(),
        ..MatchCounts::default()
    };
    counts.after_gate = Some(counts.candidates);
    let candidates = of_a.iter().zip(0..).filter(|(best, _)| best[0] != NO_KEY).map(|(best, index)| Match {
        a: index,
        b: best[0] as u32,
        distance: (best[0] >> 32) as u32,
        // The upper half of "none" is `u32::MAX`, which means just that.
        second_distance: (best[1] >> 32) as u32,
    });
    let limit = options.matching.max_distance;
    let mut matches: Vec<Match> = candidates.filter(|m| limit.is_none_or(|limit| m.distance <= limit)).collect();
    counts.after_max_distance = limit.map(|_| matches.len());
    if options.matching.ratio < 1.0 {
        matches.retain(|m| options.matching.passes_ratio(m.distance, m.second_distance));
        counts.after_ratio = Some(matches.len());
    }
    if options.matching.cross_check {
        matches.retain(|m| of_b[m.b as usize] as u32 == m.a);
        counts.after_cross_check = Some(matches.len());
    }
    let verification = select_and_verify(&mut matches, &mut counts, a.positions, b.positions, options)?;
    Ok(FilteredMatches { matches, counts, gate: outcome, verification })
}

fn check_points(points: Option<PredictedPoints<'_>>, need: usize) -> Result<(), FeaturesError> {
    let Some(points) = points else { return Ok(()) };
    if points.in_b.len() != need {
        let what = "predicted points for the keypoints of image A";
        return Err(FeaturesError::CountMismatch { what, got: points.in_b.len(), need });
    }
    if !(points.radius_px > 0.0 && points.radius_px.is_finite()) {
        let got = points.radius_px.to_string();
        return Err(FeaturesError::BadOption { option: "radius_px", got, need: "a positive number of pixels" });
    }
    points.in_b.iter().flatten().try_for_each(|point| check_positions(std::slice::from_ref(point)))
}

#[cfg(test)]
mod tests;
