//! From two sets of descriptors to matches: nearest neighbours, the ratio test and the cross-check (paper, 3.2.1 and
//! 3.2.2).
//!
//! The paper calls the distance Euclidean; AKAZE's descriptor is binary and its distance is Hamming's.
//! The filters that need positions, and the paper's whole chain in its order, are in [`filter`](crate::filter);
//! matching along predicted epipolar lines is in [`guided`](crate::guided).

pub(crate) mod kernel;
pub(crate) mod nearest;

pub use nearest::{Nearest, TwoNearest, two_nearest};

use crate::{Descriptor, FeaturesError, Match};
use serde::{Deserialize, Serialize};

/// Replaces the second distance in the ratio test where there is no second neighbour: half of the bits, which is
/// what descriptors that have nothing to do with each other differ by on average.
pub const UNRELATED_DISTANCE: u32 = 243;

/// Which nearest neighbours are accepted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchOptions {
    /// The nearest neighbour must be closer than this times the second nearest (paper, 3.2.2: 0.6; Lowe: 0.8).
    /// From 1 on the test is off. A lone neighbour is compared with [`UNRELATED_DISTANCE`].
    pub ratio: f64,
    /// Keep only pairs that are each other's nearest (paper, 3.2.1).
    pub cross_check: bool,
    /// Keep only pairs with at most this Hamming distance; `None` for no limit, as in the paper.
    pub max_distance: Option<u32>,
}

impl Default for MatchOptions {
    fn default() -> Self {
        MatchOptions { ratio: 0.6, cross_check: true, max_distance: None }
    }
}

impl MatchOptions {
    /// Refuses a ratio that is not a positive number.
    pub(crate) fn check(&self) -> Result<(), FeaturesError> {
        if self.ratio > 0.0 {
            return Ok(());
        }
        Err(FeaturesError::BadOption { option: "ratio", got: self.ratio.to_string(), need: "a positive number" })
    }

    /// Whether the distances pass the ratio test.
    pub(crate) fn passes_ratio(&self, distance: u32, second_distance: u32) -> bool {
        self.ratio >= 1.0
            || second_distance == u32::MAX
            || f64::from(distance) < self.ratio * f64::from(second_distance)
    }
}

/// How many pairs were left after each step, in the order of the steps; `None` for a step that was not taken.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MatchCounts {
    /// Keypoints of the first image.
    pub keypoints_a: usize,
    /// Keypoints of the second image.
    pub keypoints_b: usize,
    /// Keypoints of the first image that have a nearest neighbour.
    pub candidates: usize,
    /// Left by the limit on the distance.
    pub after_max_distance: Option<usize>,
    /// Left by the ratio test.
    pub after_ratio: Option<usize>,
    /// Left by the epipolar gate.
    pub after_gate: Option<usize>,
    /// Left by the cross-check.
    pub after_cross_check: Option<usize>,
    /// Left by the selection of the best.
    pub after_best: Option<usize>,
    /// Left by RANSAC.
    pub after_ransac: Option<usize>,
}

/// Matches in ascending order of `a`, and how they became so few.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Matching {
    /// The matches; no `a` occurs twice, and with the cross-check no `b`.
    pub matches: Vec<Match>,
    /// What each step left.
    pub counts: MatchCounts,
}

/// Matches the descriptors of image A with those of image B by comparing all with all.
///
/// # Errors
/// [`FeaturesError::BadOption`] for a ratio that is not positive.
pub fn match_descriptors(
    a: &[Descriptor],
    b: &[Descriptor],
    options: &MatchOptions,
) -> Result<Matching, FeaturesError> {
    options.check()?;
    let nearest = two_nearest(a, b);
    let mut matching = unusual(&nearest, options, a.len(), b.len());
    if options.cross_check {
        matching.counts.after_cross_check = Some(cross_check(&mut matching.matches, &nearest.of_b));
    }
    Ok(matching)
}

/// The candidates from A to B that pass the distance limit and the ratio test.
pub(crate) fn unusual(nearest: &TwoNearest, options: &MatchOptions, count_a: usize, count_b: usize) -> Matching {
    let mut counts = MatchCounts {
        keypoints_a: count_a,
        keypoints_b: count_b,
        candidates: nearest.of_a.len(),
        ..Default::default()
    };
    let candidates = nearest.of_a.iter().zip(0..).map(|(nearest, a)| Match {
        a,
        b: nearest.index,
        distance: nearest.distance,
        second_distance: nearest.second_distance,
    });
    let mut matches: Vec<Match> =
        candidates.filter(|m| options.max_distance.is_none_or(|limit| m.distance <= limit)).collect();
    counts.after_max_distance = options.max_distance.map(|_| matches.len());
    if options.ratio < 1.0 {
        matches.retain(|m| options.passes_ratio(m.distance, m.second_distance));
        counts.after_ratio = Some(matches.len());
    }
    Matching { matches, counts }
}

/// Keeps matches whose `b` has `a` as its nearest; returns how many.
pub(crate) fn cross_check(matches: &mut Vec<Match>, of_b: &[Nearest]) -> usize {
    matches.retain(|m| of_b[m.b as usize].index == m.a);
    matches.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn descriptor() -> impl Strategy<Value = Descriptor> {
        // Few distinct bits make ties, close seconds and pairs that are not mutual.
        prop::array::uniform8(0..8u64).prop_map(Descriptor)
    }

    proptest! {
        #[test]
        fn matches_are_what_the_options_say(
            a in prop::collection::vec(descriptor(), 0..40),
            b in prop::collection::vec(descriptor(), 0..40),
            ratio in 0.3..1.2f64,
            cross_check: bool,
            max_distance in prop::option::of(0..12u32),
        ) {
            let options = MatchOptions { ratio, cross_check, max_distance };
            let found = match_descriptors(&a, &b, &options).unwrap();
            let mut expected = Vec::new();
            for (i, of_a) in a.iter().enumerate() {
                let mut order: Vec<_> = b.iter().enumerate().map(|(j, of_b)| (of_a.hamming(of_b), j)).collect();
                order.sort_unstable();
                let Some(&(distance, j)) = order.first() else { continue };
                let second_distance = order.get(1).map_or(u32::MAX, |next| next.0);
                let back = a.iter().enumerate().map(|(i, of_a)| (of_a.hamming(&b[j]), i)).min().unwrap().1;
                let against = if order.len() == 1 { UNRELATED_DISTANCE } else { second_distance };
                let unusual = ratio >= 1.0 || f64::from(distance) < ratio * f64::from(against);
                if unusual && (back == i || !cross_check) && max_distance.is_none_or(|limit| distance <= limit) {
                    expected.push(Match { a: i as u32, b: j as u32, distance, second_distance });
                }
            }
            prop_assert_eq!(&found.matches, &expected);
            let counts = found.counts;
            let steps = [Some(counts.candidates), counts.after_max_distance, counts.after_ratio, counts.after_cross_check];
            prop_assert!(steps.iter().flatten().is_sorted_by(|before, after| before >= after));
            prop_assert_eq!(steps.iter().flatten().last().copied(), Some(expected.len()));
        }
    }

    #[test]
    fn a_ratio_that_is_no_ratio_is_refused() {
        for ratio in [f64::NAN, 0.0, -1.0] {
            let options = MatchOptions { ratio, ..Default::default() };
            assert!(matches!(match_descriptors(&[], &[], &options), Err(FeaturesError::BadOption { .. })));
        }
    }
}
