//! Matching that looks only where the prediction says: in a band around the epipolar line and, where the depth is
//! known, near a point.
//!
//! # What differs from matching everything and gating afterwards
//! Here the gate comes first: nearest, second nearest and cross-check are taken over the admitted pairs alone, exactly
//! as if every other entry of the distance matrix were missing. The ratio test is thereby held against fewer
//! descriptors, and a keypoint whose nearest descriptor lies outside of the band may still find its partner inside.
//! Every match that survives [`match_and_filter`] up to the cross-check is also found here
//! (the same nearest, no nearer second, no better rival; one exception would be a lone candidate whose true second lay
//! beyond [`UNRELATED_DISTANCE`](crate::matching::UNRELATED_DISTANCE)), and some more. In a band so
//! narrow that it holds one or two candidates the ratio test says little: set
//! [`MatchOptions::max_distance`](crate::MatchOptions::max_distance) there.
//!
//! A pair in the band costs some ten times as much here as a pair in [`match_and_filter`], which compares sixteen at
//! once: a band as wide as a tenth of the image takes as long as comparing everything.

mod strips;

use crate::filter::{DescribedPoints, FilterOptions, FilteredMatches, Gate, GateOutcome, check_positions};
use crate::filter::{match_and_filter, select_and_verify};
use crate::{Descriptor, FeaturesError, Match, MatchCounts};
use multiversion::multiversion;
use nalgebra::{Matrix3, Point2, Vector2, Vector3};
use rayon::prelude::*;
use strips::{Across, Stored, Strips, TOGETHER};

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
/// Rows in the smallest band, and bands at most.
const BAND_ROWS: usize = 512;
const MAX_BANDS: usize = 32;

/// Matches image A with image B where the prediction allows it, and filters by the rest of the chain.
///
/// Keypoints with a predicted point are searched near it (and in the band, if there is one), others in the band; without
/// a band they find nothing. If the prediction says nothing at all (neither points nor a matrix with a gate, or the
/// zero matrix of one posture taken twice), everything is compared as in [`match_and_filter`]; the outcome of the gate
/// tells. In the counts, `after_gate` is the number of keypoints of A with a candidate.
///
/// # Errors
/// As [`match_and_filter`]; also predicted points that are not finite or not as many as keypoints of A.
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

    let (of_a, of_b) = nearest_admitted(a, b, gate.as_ref(), prediction.points)?;
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

/// Two best keys of each keypoint of A (`distance << 32 | b`), and the best of each of B (`distance << 32 | a`).
type NearestAdmitted = (Vec<[u64; 2]>, Vec<u64>);

fn nearest_admitted(
    a: DescribedPoints<'_>,
    b: DescribedPoints<'_>,
    gate: Option<&Gate>,
    points: Option<PredictedPoints<'_>>,
) -> Result<NearestAdmitted, FeaturesError> {
    if a.positions.is_empty() || b.positions.is_empty() {
        return Ok((vec![[NO_KEY; 2]; a.positions.len()], vec![NO_KEY; b.positions.len()]));
    }
    let lines: Vec<Vector3<f64>> = match gate {
        Some(gate) => a.positions.par_iter().with_min_len(1024).map(|in_a| gate.line_in_b(in_a)).collect(),
        None => vec![Vector3::zeros(); a.positions.len()],
    };
    let level = Across::most(&lines);
    let suited: Vec<bool> = lines.iter().map(|line| level.suits(line)).collect();
    let sort = |across, needed: bool| {
        let line = |in_b: &Point2<f64>| gate.map_or(Vector3::zeros(), |gate| gate.line_in_a(in_b));
        needed.then(|| Strips::new(across, b.positions, b.descriptors, line)).transpose()
    };
    let (level, upright) =
        rayon::join(|| sort(level, suited.contains(&true)), || sort(level.turned(), suited.contains(&false)));
    let (level, upright) = (level?, upright?);

    // Neighbouring lines one after the other: what they meet of B stays in the cache. The result does not depend on it.
    let order = by_line(&lines, b.positions);
    let band_rows = BAND_ROWS.max(order.len().div_ceil(MAX_BANDS));
    let bands: Vec<NearestAdmitted> = order
        .par_chunks(band_rows)
        .map(|rows| {
            let mut of_b = vec![NO_KEY; b.positions.len()];
            let mut held = [0; HELD + 2];
            let of_a = rows.iter().map(|&index| {
                let index = index as usize;
                let Some(strips) = (if suited[index] { &level } else { &upright }) else { return [NO_KEY; 2] };
                let expected = points.and_then(|points| points.in_b[index].map(|point| (point, points.radius_px)));
                if gate.is_none() && expected.is_none() {
                    return [NO_KEY; 2];
                }
                let row = Row {
                    descriptor: &a.descriptors[index],
                    in_a: a.positions[index],
                    index: index as u32,
                    line: lines[index],
                    half_width_px: gate.map_or(f64::INFINITY, Gate::half_width_px),
                    expected,
                    near: expected.map_or(Point2::origin(), |(point, _)| point),
                    radius_squared: expected.map_or(f64::INFINITY, |(_, radius)| radius * radius),
                };
                search(&row, strips, &mut held, &mut of_b)
            });
            (of_a.collect(), of_b)
        })
        .collect();
    let mut of_a = vec![[NO_KEY; 2]; a.positions.len()];
    let mut of_b = vec![NO_KEY; b.positions.len()];
    for ((rows, columns), indices) in bands.into_iter().zip(order.chunks(band_rows)) {
        for (row, &index) in rows.into_iter().zip(indices) {
            of_a[index as usize] = row;
        }
        of_b.iter_mut().zip(columns).for_each(|(best, column)| *best = (*best).min(column));
    }
    Ok((of_a, of_b))
}

/// Indices of lines, sorted by how far and to which side they pass the middle of image B.
fn by_line(lines: &[Vector3<f64>], positions_b: &[Point2<f64>]) -> Vec<u32> {
    let middle = positions_b.iter().fold(Vector2::zeros(), |sum, p| sum + p.coords) / positions_b.len() as f64;
    let offset = |line: &Vector3<f64>| {
        let side = if line.y.abs() >= line.x.abs() { line.y } else { line.x };
        (line.x * middle.x + line.y * middle.y + line.z) * side.signum()
    };
    let mut order: Vec<(f64, u32)> = lines.iter().map(offset).zip(0..).collect();
    order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    order.into_iter().map(|(_, index)| index).collect()
}

/// A keypoint of image A and where its match may be.
struct Row<'a> {
    descriptor: &'a Descriptor,
    in_a: Point2<f64>,
    index: u32,
    line: Vector3<f64>,
    half_width_px: f64,
    expected: Option<(Point2<f64>, f64)>,
    /// The same, infinitely wide if there is none.
    near: Point2<f64>,
    radius_squared: f64,
}

impl Row<'_> {
    #[inline(always)]
    fn admits(&self, other: &Stored) -> bool {
        let off = |line: &Vector3<f64>, point: &Point2<f64>| (line.x * point.x + line.y * point.y + line.z).abs();
        (off(&self.line, &other.at) <= self.half_width_px)
            & (off(&other.line, &self.in_a) <= self.half_width_px)
            & ((other.at - self.near).norm_squared() <= self.radius_squared)
    }
}

/// Keypoints near a line that are collected before their descriptors are compared.
const HELD: usize = 256;

/// The two nearest of a keypoint among those that it admits; lowers the best of those in passing.
// With a population count of the processor this takes a fraction of the time; it computes the same.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512vpopcntdq+popcnt", "x86_64+avx2+popcnt"))]
fn search(row: &Row<'_>, strips: &Strips, held: &mut [u32; HELD + 2], of_b: &mut [u64]) -> [u64; 2] {
    let mut best = [NO_KEY; 2];
    let coarse = strips.coarse(&row.line, row.half_width_px);
    let mut count = 0;
    strips.for_each_run(&row.line, row.half_width_px, row.expected, |run| {
        for start in run.clone().step_by(TOGETHER) {
            if count > HELD - TOGETHER {
                compare(row, strips, &held[..count], &mut best, of_b);
                count = 0;
            }
            let mut near = strips.near(start, &coarse);
            if run.end - start < TOGETHER {
                near &= (1 << (run.end - start)) - 1;
            }
            // Most runs hold none to two: those are taken without a branch.
            for _ in 0..2 {
                held[count] = (start as u32).wrapping_add(near.trailing_zeros());
                count += usize::from(near != 0);
                near &= near.wrapping_sub(1);
            }
            while near != 0 {
                held[count] = start as u32 + near.trailing_zeros();
                count += 1;
                near &= near - 1;
            }
        }
    });
    compare(row, strips, &held[..count], &mut best, of_b);
    best
}

/// Takes in those of the held keypoints that the row admits. Also without a branch: the others get the worst key.
#[inline(always)]
fn compare(row: &Row<'_>, strips: &Strips, held: &[u32], best: &mut [u64; 2], of_b: &mut [u64]) {
    for &at in held {
        let other = &strips.stored[at as usize];
        let refused = u64::from(row.admits(other)).wrapping_sub(1);
        let distance = u64::from(row.descriptor.hamming(&strips.descriptors[at as usize])) << 32;
        let key = (distance | u64::from(other.index)) | refused;
        best[1] = best[1].min(best[0].max(key));
        best[0] = best[0].min(key);
        let of_other = &mut of_b[other.index as usize];
        *of_other = (*of_other).min(distance | u64::from(row.index) | refused);
    }
}

#[cfg(test)]
mod tests;
