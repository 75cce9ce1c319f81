//! The paper's chain of filters in the paper's order (3.2): brute-force two nearest neighbours, the ratio test, the
//! epipolar gate of Eq. (6), the cross-check, the best by distance, RANSAC. Every step is an option, and what it left
//! is counted.

mod epipolar;
pub(crate) mod homography;
mod ransac;
mod seven_point;

pub(crate) use epipolar::{Gate, check_matches, check_positions};
pub use epipolar::{GateOutcome, epipolar_gate};
pub use ransac::{FundamentalFit, RansacOptions, Verification, verify_epipolar};

use crate::matching::{self, MatchCounts, MatchOptions, two_nearest};
use crate::{Descriptor, FeaturesError, Match};
use nalgebra::{Matrix3, Point2};
use serde::{Deserialize, Serialize};

/// Which steps are taken, and how strictly.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FilterOptions {
    /// Ratio test, cross-check and the limit on the distance.
    pub matching: MatchOptions,
    /// Largest distance to a predicted epipolar line in either image, px: `theta_th / theta_h * q_h` of Eq. (6), in
    /// the paper 200 px at 7.3 deg. `None` for no gate.
    pub gate_px: Option<f64>,
    /// Keep this many, those of smallest distance; `None` for all, which carry more information (the paper keeps 30).
    pub best: Option<usize>,
    /// Verification by RANSAC; `None` for none. Where it finds no consensus, no match is left.
    pub ransac: Option<RansacOptions>,
}

impl Default for FilterOptions {
    /// All good matches: the paper's steps without its limit to thirty.
    fn default() -> Self {
        FilterOptions {
            matching: MatchOptions::default(),
            gate_px: Some(200.0),
            best: None,
            ransac: Some(RansacOptions::default()),
        }
    }
}

impl FilterOptions {
    /// The paper's settings: ratio 0.6, gate 200 px, cross-check, the best 30, RANSAC.
    pub fn paper() -> Self {
        FilterOptions { best: Some(30), ..FilterOptions::default() }
    }
}

/// One image's descriptors and, index by index, where their keypoints are in undistorted pixels.
#[derive(Debug, Clone, Copy)]
pub struct DescribedPoints<'a> {
    /// Descriptors.
    pub descriptors: &'a [Descriptor],
    /// Positions, px.
    pub positions: &'a [Point2<f64>],
}

impl DescribedPoints<'_> {
    /// Refuses lists of different length and positions that are not finite.
    pub(crate) fn check(&self) -> Result<(), FeaturesError> {
        if self.descriptors.len() != self.positions.len() {
            return Err(FeaturesError::CountMismatch {
                what: "positions of keypoints",
                got: self.positions.len(),
                need: self.descriptors.len(),
            });
        }
        check_positions(self.positions)
    }
}

/// What the chain left, and why.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FilteredMatches {
    /// Matches in ascending order of `a`.
    pub matches: Vec<Match>,
    /// What each step left.
    pub counts: MatchCounts,
    /// Whether there were epipolar lines to hold matches against.
    pub gate: GateOutcome,
    /// How RANSAC ended; `None` if it was not asked for. Inliers index the matches that RANSAC was given.
    pub verification: Option<Verification>,
}

/// Matches image A with image B and filters by the paper's chain.
///
/// `predicted` is the fundamental matrix that the nominal kinematics predicts, `in_a^T F in_b = 0`; without it, or with
/// a zero one (no baseline), the gate lets everything pass and [`FilteredMatches::gate`] says so.
///
/// # Errors
/// Options out of range, lists of different length, numbers that are not finite.
pub fn match_and_filter(
    a: DescribedPoints<'_>,
    b: DescribedPoints<'_>,
    predicted: Option<&Matrix3<f64>>,
    options: &FilterOptions,
) -> Result<FilteredMatches, FeaturesError> {
    options.matching.check()?;
    a.check()?;
    b.check()?;
    let nearest = two_nearest(a.descriptors, b.descriptors);
    let matching = matching::unusual(&nearest, &options.matching, a.descriptors.len(), b.descriptors.len());
    let (mut matches, mut counts) = (matching.matches, matching.counts);

    let mut gate = GateOutcome::NotAsked;
    if let (Some(fundamental), Some(threshold_px)) = (predicted, options.gate_px) {
        gate = epipolar_gate(&mut matches, a.positions, b.positions, fundamental, threshold_px)?;
        counts.after_gate = Some(matches.len());
    }
    if options.matching.cross_check {
        counts.after_cross_check = Some(matching::cross_check(&mut matches, &nearest.of_b));
    }
    let verification = select_and_verify(&mut matches, &mut counts, a.positions, b.positions, options)?;
    Ok(FilteredMatches { matches, counts, gate, verification })
}

/// The last two steps, for exhaustive and guided matching alike.
pub(crate) fn select_and_verify(
    matches: &mut Vec<Match>,
    counts: &mut MatchCounts,
    positions_a: &[Point2<f64>],
    positions_b: &[Point2<f64>],
    options: &FilterOptions,
) -> Result<Option<Verification>, FeaturesError> {
    if let Some(count) = options.best {
        keep_best(matches, count);
        counts.after_best = Some(matches.len());
    }
    let Some(ransac) = &options.ransac else { return Ok(None) };
    let in_a: Vec<_> = matches.iter().map(|m| positions_a[m.a as usize]).collect();
    let in_b: Vec<_> = matches.iter().map(|m| positions_b[m.b as usize]).collect();
    let verification = verify_epipolar(&in_a, &in_b, ransac)?;
    *matches = match &verification {
        Verification::Verified(fit) => fit.inliers.iter().map(|&index| matches[index]).collect(),
        Verification::TooFewMatches { .. } | Verification::NoConsensus { .. } => Vec::new(),
    };
    counts.after_ransac = Some(matches.len());
    Ok(Some(verification))
}

/// Keeps the `count` matches of smallest distance, of equals those of lowest `a` and `b`; the order stays.
pub fn keep_best(matches: &mut Vec<Match>, count: usize) {
    if matches.len() <= count {
        return;
    }
    let key = |m: &Match| (m.distance, m.a, m.b);
    let mut keys: Vec<_> = matches.iter().map(key).collect();
    keys.sort_unstable();
    let first_dropped = keys[count];
    matches.retain(|m| key(m) < first_dropped);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// `in_a^T F in_b = 0` for a camera that moved along x: rows agree.
    const LEVEL: Matrix3<f64> = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);

    /// `count` true pairs in noise: descriptors with a few flipped bits, shuffled by reversal, a tenth of them moved
    /// off its row.
    struct Pair {
        descriptors: [Vec<Descriptor>; 2],
        positions: [Vec<Point2<f64>>; 2],
    }

    fn pair(count: usize, seed: u64) -> Pair {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let (mut descriptors, mut positions) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
        for index in 0..count {
            let descriptor = Descriptor(std::array::from_fn(|_| random.random()));
            let mut other = descriptor;
            for _ in 0..random.random_range(0..90u32) {
                other.0[random.random_range(0..8usize)] ^= 1 << random.random_range(0..64u32);
            }
            let at = Point2::new(random.random::<f64>() * 640.0, random.random::<f64>() * 480.0);
            let off = if index % 10 == 0 { 50.0 } else { random.random::<f64>() - 0.5 };
            descriptors[0].push(descriptor);
            descriptors[1].push(other);
            positions[0].push(at);
            positions[1].push(Point2::new(at.x - 20.0 - random.random::<f64>() * 60.0, at.y + off));
        }
        descriptors[1].reverse();
        positions[1].reverse();
        Pair { descriptors, positions }
    }

    impl Pair {
        fn points(&self) -> [DescribedPoints<'_>; 2] {
            [0, 1].map(|image| DescribedPoints {
                descriptors: &self.descriptors[image],
                positions: &self.positions[image],
            })
        }
    }

    #[test]
    fn the_papers_chain_leaves_true_matches() {
        let pair = pair(400, 1);
        let [a, b] = pair.points();
        let found = match_and_filter(a, b, Some(&LEVEL), &FilterOptions::paper()).unwrap();
        // The gate of 200 px admits those that were moved by 50, RANSAC drops them.
        assert_eq!(found.counts.after_best, Some(30));
        assert!(found.matches.len() >= 24 && found.matches.iter().all(|m| m.a + m.b == 399 && m.a % 10 != 0));
        assert_eq!(found.gate, GateOutcome::Applied);
        // A gate of 5 px drops the tenth that was moved off its row.
        let narrow = FilterOptions { gate_px: Some(5.0), ransac: None, ..FilterOptions::default() };
        let found = match_and_filter(a, b, Some(&LEVEL), &narrow).unwrap();
        assert_eq!((found.counts.after_ratio, found.counts.after_gate), (Some(400), Some(360)));
        assert!(found.matches.iter().all(|m| m.a % 10 != 0 && m.distance < 90));
    }

    #[test]
    fn the_same_image_twice_is_matched_without_a_gate() {
        let pair = pair(100, 2);
        let [a, _] = pair.points();
        let found = match_and_filter(a, a, Some(&Matrix3::zeros()), &FilterOptions::default()).unwrap();
        assert_eq!((found.gate, found.matches.len()), (GateOutcome::NoBaseline, 100));
        assert!(found.matches.iter().all(|m| m.a == m.b && m.distance == 0));
    }

    #[test]
    fn nothing_matches_nothing() {
        let pair = pair(10, 3);
        let [a, _] = pair.points();
        let none = DescribedPoints { descriptors: &[], positions: &[] };
        for (a, b) in [(a, none), (none, a), (none, none)] {
            let found = match_and_filter(a, b, Some(&LEVEL), &FilterOptions::paper()).unwrap();
            assert!(found.matches.is_empty());
            assert_eq!(found.verification, Some(Verification::TooFewMatches { got: 0, need: 10 }));
        }
        let short = DescribedPoints { descriptors: a.descriptors, positions: &a.positions[1..] };
        let refused = match_and_filter(a, short, None, &FilterOptions::default());
        assert!(matches!(refused, Err(FeaturesError::CountMismatch { got: 9, need: 10, .. })));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn every_step_only_takes_away(
            seed: u64, count in 0..150usize, ratio in 0.3..1.1f64, cross_check: bool,
            gate_px in prop::option::of(0.1..100.0f64), best in prop::option::of(0..60usize), verify: bool,
        ) {
            let pair = pair(count, seed);
            let [a, b] = pair.points();
            let options = FilterOptions {
                matching: MatchOptions { ratio, cross_check, max_distance: None },
                gate_px,
                best,
                ransac: verify.then(RansacOptions::default),
            };
            let found = match_and_filter(a, b, Some(&LEVEL), &options).unwrap();
            let c = found.counts;
            let steps = [Some(c.candidates), c.after_ratio, c.after_gate, c.after_cross_check, c.after_best, c.after_ransac];
            prop_assert!(steps.iter().flatten().is_sorted_by(|before, after| before >= after), "{:?}", c);
            prop_assert_eq!(steps.iter().flatten().last().copied(), Some(found.matches.len()));
            prop_assert!(found.matches.is_sorted_by_key(|m| m.a));
            prop_assert!(best.is_none_or(|best| found.matches.len() <= best));
            if let Some(gate_px) = gate_px {
                // With rows for lines, the distance is the difference of the rows.
                let rows = |m: &Match| (a.positions[m.a as usize].y - b.positions[m.b as usize].y).abs();
                prop_assert!(found.matches.iter().all(|m| rows(m) <= gate_px + 1e-9));
            }
            // The same steps one by one.
            let plain = matching::match_descriptors(a.descriptors, b.descriptors, &options.matching).unwrap();
            prop_assert!(found.matches.iter().all(|m| plain.matches.contains(m)));
        }
    }
}
