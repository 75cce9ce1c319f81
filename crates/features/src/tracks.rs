//! One point seen in many images: pairwise matches joined to tracks, and one consistent position for each observation.
//!
//! # Joining
//! Links (matches) are taken from the strongest to the weakest; a link joins two tracks only if they have no image in
//! common, since a point is seen once in an image. So where links contradict each other, the weakest of them is left
//! out, whatever the order in which the pairs were given.
//!
//! # Positions
//! Refining the second point of each pair on its own would give a keypoint as many positions as it has matches.
//! [`refine_tracks`] instead lets one observation name the point, the *reference*, and aligns all others with its
//! patch: each observation has one position with one covariance, as bundle adjustment asks.

mod refine;

pub use refine::{RefinedTracks, TrackPoint, WarpPrediction, refine_tracks, refine_tracks_in_windows};

use crate::{FeaturesError, Match};
use serde::{Deserialize, Serialize};

/// Matches between two images, which are named by number.
#[derive(Debug, Clone, Copy)]
pub struct ImagePair<'a> {
    /// Number of image A.
    pub a: u32,
    /// Number of image B.
    pub b: u32,
    /// Matches of keypoints of A with keypoints of B.
    pub matches: &'a [Match],
}

/// An observation: a keypoint of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Observation {
    /// Number of the image.
    pub image: u32,
    /// Index of the keypoint in it.
    pub keypoint: u32,
}

/// Which tracks are kept.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrackOptions {
    /// Fewest observations; at least 2.
    pub min_length: usize,
}

impl Default for TrackOptions {
    fn default() -> Self {
        TrackOptions { min_length: 2 }
    }
}

/// What became of the links.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrackCounts {
    /// Links given.
    pub links: usize,
    /// Links that joined two tracks.
    pub merges: usize,
    /// Links within a track, which confirm it.
    pub confirming: usize,
    /// Links left out, since they would have put two keypoints of one image into a track.
    pub conflicts: usize,
    /// Tracks kept.
    pub tracks: usize,
    /// Tracks dropped for being too short.
    pub short: usize,
    /// Observations in the tracks kept.
    pub observations: usize,
}

/// Tracks in ascending order of their first observation; observations in ascending order of their image.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Tracks {
    /// The observations of all tracks, one track after the other.
    pub observations: Vec<Observation>,
    /// Where each track starts in the observations, and at the end their number.
    pub starts: Vec<usize>,
    /// What became of the links.
    pub counts: TrackCounts,
}

impl Tracks {
    /// Number of tracks.
    pub fn len(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Whether there is no track.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The observations of each track.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &[Observation]> {
        self.starts.windows(2).map(|ends| &self.observations[ends[0]..ends[1]])
    }
}

/// Joins pairwise matches to tracks. `keypoint_counts` holds the number of keypoints of each image.
///
/// # Errors
/// Images or keypoints that do not exist, an image paired with itself, more than 2^32 - 2 keypoints in all.
pub fn build_tracks(
    keypoint_counts: &[usize],
    pairs: &[ImagePair<'_>],
    options: &TrackOptions,
) -> Result<Tracks, FeaturesError> {
    check(keypoint_counts, pairs)?;
    let mut first_nodes = vec![0usize];
    for count in keypoint_counts {
        first_nodes.push(first_nodes[first_nodes.len() - 1] + count);
    }
    let nodes = first_nodes[keypoint_counts.len()];
    if nodes >= u32::MAX as usize {
        let what = "keypoints in all images";
        return Err(FeaturesError::CountMismatch { what, got: nodes, need: u32::MAX as usize - 1 });
    }
    let node = |image: u32, keypoint: u32| (first_nodes[image as usize] + keypoint as usize) as u32;

    // Ascending by distance, then by the nodes: the order of the pairs must not matter.
    let mut links: Vec<(u32, u32, u32)> = Vec::with_capacity(pairs.iter().map(|pair| pair.matches.len()).sum());
    for pair in pairs {
        links.extend(pair.matches.iter().map(|m| {
            let (a, b) = (node(pair.a, m.a), node(pair.b, m.b));
            (m.distance, a.min(b), a.max(b))
        }));
    }
    links.sort_unstable();

    let mut forest = Forest::new(&first_nodes);
    let mut counts = TrackCounts { links: links.len(), ..TrackCounts::default() };
    for (_, a, b) in links {
        match forest.join(a, b) {
            Joined::Now => counts.merges += 1,
            Joined::Before => counts.confirming += 1,
            Joined::Never => counts.conflicts += 1,
        }
    }

    let mut tracks = Tracks { starts: vec![0], ..Tracks::default() };
    let least = options.min_length.max(2);
    // Nodes ascend by image, so the first node met of a track is its first observation.
    let mut visited = vec![false; nodes];
    for first in 0..nodes as u32 {
        if visited[first as usize] || forest.next[first as usize] == first {
            continue;
        }
        let start = tracks.observations.len();
        let mut at = first;
        loop {
            visited[at as usize] = true;
            let image = forest.images[at as usize];
            let keypoint = at - first_nodes[image as usize] as u32;
            tracks.observations.push(Observation { image, keypoint });
            at = forest.next[at as usize];
            if at == first {
                break;
            }
        }
        if tracks.observations.len() - start < least {
            tracks.observations.truncate(start);
            counts.short += 1;
        } else {
            tracks.observations[start..].sort_unstable();
            tracks.starts.push(tracks.observations.len());
        }
    }
    counts.tracks = tracks.len();
    counts.observations = tracks.observations.len();
    tracks.counts = counts;
    Ok(tracks)
}

fn check(keypoint_counts: &[usize], pairs: &[ImagePair<'_>]) -> Result<(), FeaturesError> {
    for pair in pairs {
        if pair.a == pair.b {
            let got = pair.a.to_string();
            return Err(FeaturesError::BadOption { option: "pairs", got, need: "pairs of two different images" });
        }
        for image in [pair.a, pair.b] {
            if image as usize >= keypoint_counts.len() {
                let (index, count) = (image as usize, keypoint_counts.len());
                return Err(FeaturesError::NoSuchIndex { what: "image", index, count });
            }
        }
        let (count_a, count_b) = (keypoint_counts[pair.a as usize], keypoint_counts[pair.b as usize]);
        crate::filter::check_matches(pair.matches, count_a, count_b)?;
    }
    Ok(())
}

/// Disjoint sets of nodes (union by size, paths halved), each also a ring to walk along.
struct Forest {
    parent: Vec<u32>,
    size: Vec<u32>,
    next: Vec<u32>,
    /// The image of each node.
    images: Vec<u32>,
    /// For each image, the last attempt at joining in which it was seen.
    seen: Vec<u64>,
    attempt: u64,
}

enum Joined {
    Now,
    Before,
    Never,
}

impl Forest {
    fn new(first_nodes: &[usize]) -> Self {
        let nodes = first_nodes[first_nodes.len() - 1] as u32;
        let mut images = Vec::with_capacity(nodes as usize);
        for (ends, image) in first_nodes.windows(2).zip(0..) {
            images.extend(std::iter::repeat_n(image, ends[1] - ends[0]));
        }
        Forest {
            parent: (0..nodes).collect(),
            size: vec![1; nodes as usize],
            next: (0..nodes).collect(),
            images,
            seen: vec![0; first_nodes.len() - 1],
            attempt: 0,
        }
    }

    fn root(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let grandparent = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = grandparent;
            node = grandparent;
        }
        node
    }

    /// Joins the sets of two nodes unless an image is in both.
    fn join(&mut self, a: u32, b: u32) -> Joined {
        let (mut a, mut b) = (self.root(a), self.root(b));
        if a == b {
            return Joined::Before;
        }
        self.attempt += 1;
        for root in [a, b] {
            let mut at = root;
            loop {
                let image = self.images[at as usize] as usize;
                if self.seen[image] == self.attempt {
                    return Joined::Never;
                }
                self.seen[image] = self.attempt;
                at = self.next[at as usize];
                if at == root {
                    break;
                }
            }
        }
        if self.size[a as usize] < self.size[b as usize] {
            std::mem::swap(&mut a, &mut b);
        }
        self.parent[b as usize] = a;
        self.size[a as usize] += self.size[b as usize];
        // Two rings become one.
        self.next.swap(a as usize, b as usize);
        Joined::Now
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn link(a: u32, b: u32, distance: u32) -> Match {
        Match { a, b, distance, second_distance: 200 }
    }

    fn lists(tracks: &Tracks) -> Vec<Vec<(u32, u32)>> {
        tracks.iter().map(|track| track.iter().map(|o| (o.image, o.keypoint)).collect()).collect()
    }

    #[test]
    fn links_make_tracks_and_the_weakest_contradiction_is_left_out() {
        let (ab, bc) = ([link(0, 0, 10), link(1, 1, 20)], [link(0, 0, 10), link(1, 1, 20)]);
        // Keypoint 0 of A with 1 of C contradicts what is known of both, and is weak.
        let ac = [link(0, 1, 90), link(1, 1, 30)];
        let pairs = [(0, 1, &ab), (1, 2, &bc), (0, 2, &ac)].map(|(a, b, matches)| ImagePair { a, b, matches });
        let tracks = build_tracks(&[2, 2, 3], &pairs, &TrackOptions::default()).unwrap();
        assert_eq!(lists(&tracks), [[(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 1), (2, 1)]]);
        let counts = tracks.counts;
        assert_eq!((counts.merges, counts.confirming, counts.conflicts), (4, 1, 1));
        let long = build_tracks(&[2, 2, 3], &pairs, &TrackOptions { min_length: 4 }).unwrap();
        assert_eq!((long.len(), long.counts.short), (0, 2));
    }

    #[test]
    fn what_does_not_exist_is_refused() {
        let matches = [link(0, 5, 1)];
        let build = |a, b, counts: &[usize]| {
            build_tracks(counts, &[ImagePair { a, b, matches: &matches }], &TrackOptions::default())
        };
        assert!(matches!(build(0, 1, &[3, 5]), Err(FeaturesError::NoSuchIndex { index: 5, count: 5, .. })));
        assert!(matches!(build(0, 2, &[3, 6]), Err(FeaturesError::NoSuchIndex { index: 2, count: 2, .. })));
        assert!(matches!(build(1, 1, &[3, 6]), Err(FeaturesError::BadOption { .. })));
        assert!(build(0, 1, &[3, 6]).is_ok());
        assert!(build_tracks(&[], &[], &TrackOptions::default()).unwrap().is_empty());
    }

    proptest! {
        #[test]
        fn no_image_twice_and_no_order(
            links in prop::collection::vec((0..6u32, 0..6u32, 0..8u32, 0..8u32, 0..40u32), 0..120),
        ) {
            let links: Vec<_> = links.into_iter().filter(|link| link.0 != link.1).collect();
            let singles: Vec<_> = links.iter().map(|&(a, b, i, j, d)| (a, b, [link(i, j, d)])).collect();
            let pairs = |order: Vec<usize>| -> Vec<ImagePair<'_>> {
                order.into_iter().map(|at| ImagePair { a: singles[at].0, b: singles[at].1, matches: &singles[at].2 }).collect()
            };
            let tracks = build_tracks(&[8; 6], &pairs((0..links.len()).collect()), &TrackOptions::default()).unwrap();
            let reversed = build_tracks(&[8; 6], &pairs((0..links.len()).rev().collect()), &TrackOptions::default());
            prop_assert_eq!(&tracks, &reversed.unwrap());
            let mut all: Vec<_> = tracks.observations.clone();
            for track in tracks.iter() {
                prop_assert!(track.len() >= 2);
                // Strictly ascending images: none twice.
                prop_assert!(track.windows(2).all(|two| two[0].image < two[1].image));
            }
            prop_assert!(tracks.iter().map(|track| track[0]).is_sorted());
            all.sort();
            all.dedup();
            prop_assert_eq!(all.len(), tracks.observations.len());
            let c = tracks.counts;
            prop_assert_eq!(c.merges + c.confirming + c.conflicts, c.links);
            prop_assert_eq!(c.merges, c.observations - c.tracks);
        }
    }
}
