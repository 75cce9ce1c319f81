//! The transforms that a recording holds: the tree in which the camera's driver puts its frames.

use skclam_geometry::Isometry3;
use skclam_recordings::{RecordingError, TransformStamped};
use std::collections::BTreeMap;

/// Pose of a frame in its parent.
#[derive(Debug, Clone)]
struct Edge {
    parent: String,
    parent_from_child: Isometry3,
    is_static: bool,
    /// Said in two ways that differ.
    changes: bool,
}

/// Frames by name.
#[derive(Debug, Default)]
pub(super) struct Frames {
    edges: BTreeMap<String, Edge>,
}

/// Frames of a tree of transforms at the most.
const MAX_FRAMES: usize = 1 << 14;
/// Metres and radians that are the same place.
const SAME: f64 = 1e-6;

fn plain(frame: &str) -> String {
    frame.trim_start_matches('/').to_owned()
}

impl Frames {
    /// Adds the transforms of a message. Those of `/tf` count as long as they do not change: some drivers publish their
    /// fixed frames there.
    pub fn add(&mut self, transforms: Vec<TransformStamped>, is_static: bool) -> Result<(), RecordingError> {
        for TransformStamped { parent, child, parent_from_child } in transforms {
            let edge = Edge { parent: plain(&parent), parent_from_child, is_static, changes: false };
            let count = self.edges.len();
            match self.edges.get_mut(&plain(&child)) {
                Some(known) if known.is_static && !is_static => {}
                Some(known) if is_static && !known.is_static => *known = edge,
                Some(known) => known.changes |= differ(known, &edge),
                None if count == MAX_FRAMES => {
                    let problem = format!("there are more than {MAX_FRAMES} frames");
                    return Err(RecordingError::Message { topic: "/tf_static".to_owned(), problem });
                }
                None => drop(self.edges.insert(plain(&child), edge)),
            }
        }
        Ok(())
    }

    /// The highest frame that a frame is fixed to, and `root_from_frame`; the frame itself where nothing is recorded.
    pub fn to_root(&self, frame: &str) -> (String, Isometry3) {
        let mut at = plain(frame);
        let mut root_from_frame = Isometry3::identity();
        // A tree has no more steps than frames; more are a circle.
        for _ in 0..=self.edges.len() {
            match self.edges.get(&at).filter(|edge| !edge.changes) {
                Some(edge) => {
                    root_from_frame = edge.parent_from_child * root_from_frame;
                    at = edge.parent.clone();
                }
                None => return (at, root_from_frame),
            }
        }
        (plain(frame), Isometry3::identity())
    }

    /// The frames above one, from itself to its root: each with its parent and `parent_from_child`.
    pub fn chain(&self, frame: &str) -> Vec<(String, String, Isometry3)> {
        let (root, _) = self.to_root(frame);
        let mut at = plain(frame);
        let mut chain = Vec::new();
        while at != root
            && let Some(edge) = self.edges.get(&at)
        {
            chain.push((at, edge.parent.clone(), edge.parent_from_child));
            at = edge.parent.clone();
        }
        chain
    }

    /// A frame on the way from one to its root that is said to be in two places.
    pub fn contradiction(&self, frame: &str) -> Option<String> {
        let (root, _) = self.to_root(frame);
        self.edges
            .get(&root)
            .filter(|edge| edge.is_static && edge.changes)
            .map(|edge| format!("/tf_static puts \"{root}\" into \"{}\" in two different ways", edge.parent))
    }
}

fn differ(a: &Edge, b: &Edge) -> bool {
    let off = a.parent_from_child.inverse() * b.parent_from_child;
    a.parent != b.parent || off.translation.vector.norm() > SAME || off.rotation.angle() > SAME
}
