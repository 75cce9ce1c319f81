//! OctoMap's files: `.bt` (free, occupied, unknown) and `.ot` (log-odds), written from a real octree with equal leaves
//! merged.
//!
//! A tree has sixteen levels over indices shifted by 2^15; child `i` lies at `(i & 1, i >> 1 & 1, i >> 2 & 1)`. In
//! `.bt` a node is two bits a child: 01 free, 10 occupied, 11 has children, 00 unknown (least significant first), then
//! the nodes of its children, depth first. In `.ot` a node is its log-odds as a float and a byte of which children
//! exist.

use super::{INDEX_LIMIT, OccupancyGrid};
use crate::Error;
use std::io::Write;

const LEVELS: u32 = 16;

/// A node of the tree; children of an inner node are not all the same leaf.
enum Node {
    Leaf(f32),
    /// The largest log-odds below, and the children.
    Inner(f32, Box<[Option<Node>; 8]>),
}

impl Node {
    fn value(&self) -> f32 {
        match self {
            Node::Leaf(value) | Node::Inner(value, _) => *value,
        }
    }

    fn count(&self) -> usize {
        match self {
            Node::Leaf(_) => 1,
            Node::Inner(_, children) => 1 + children.iter().flatten().map(Node::count).sum::<usize>(),
        }
    }

    fn write_binary(&self, out: &mut impl Write) -> Result<(), Error> {
        let Node::Inner(_, children) = self else {
            // A single leaf for all of space; cannot happen below the root, where leaves are bits of their parents.
            return Ok(());
        };
        let mut bits = 0u16;
        for (index, child) in children.iter().enumerate() {
            let code = match child {
                None => 0b00,
                Some(Node::Leaf(value)) if *value >= 0.0 => 0b10,
                Some(Node::Leaf(_)) => 0b01,
                Some(Node::Inner(..)) => 0b11,
            };
            bits |= code << (2 * index);
        }
        out.write_all(&bits.to_le_bytes())?;
        for child in children.iter().flatten() {
            child.write_binary(out)?;
        }
        Ok(())
    }

    fn write_full(&self, out: &mut impl Write) -> Result<(), Error> {
        out.write_all(&self.value().to_le_bytes())?;
        let Node::Inner(_, children) = self else {
            return Ok(out.write_all(&[0])?);
        };
        let exist = children.iter().enumerate().fold(0u8, |bits, (i, child)| bits | u8::from(child.is_some()) << i);
        out.write_all(&[exist])?;
        for child in children.iter().flatten() {
            child.write_full(out)?;
        }
        Ok(())
    }
}

impl OccupancyGrid {
    /// Writes OctoMap's binary file: every leaf is free or occupied. The writer should be buffered.
    pub fn write_bt(&self, mut out: impl Write) -> Result<(), Error> {
        // Only the decision counts, so leaves merge that differ in their log-odds.
        let tree = self.tree(|log_odds| if log_odds >= 0.0 { 1.0 } else { -1.0 });
        self.write_header("# Octomap OcTree binary file", tree.as_ref(), &mut out)?;
        if let Some(tree) = tree {
            tree.write_binary(&mut out)?;
        }
        Ok(out.flush()?)
    }

    /// Writes OctoMap's full file with the log-odds of every leaf. The writer should be buffered.
    pub fn write_ot(&self, mut out: impl Write) -> Result<(), Error> {
        let tree = self.tree(|log_odds| log_odds);
        self.write_header("# Octomap OcTree file", tree.as_ref(), &mut out)?;
        if let Some(tree) = tree {
            tree.write_full(&mut out)?;
        }
        Ok(out.flush()?)
    }

    fn write_header(&self, first: &str, tree: Option<&Node>, out: &mut impl Write) -> Result<(), Error> {
        let size = tree.map_or(0, Node::count);
        let resolution = self.resolution_m();
        Ok(writeln!(out, "{first}\n# base frame, metres\nid OcTree\nsize {size}\nres {resolution}\ndata")?)
    }

    fn tree(&self, value: impl Fn(f32) -> f32) -> Option<Node> {
        let mut leaves: Vec<(u64, f32)> =
            self.cells().into_iter().map(|(index, log_odds)| (interleaved(index), value(log_odds))).collect();
        leaves.sort_unstable_by_key(|(place, _)| *place);
        (!leaves.is_empty()).then(|| subtree(&leaves, LEVELS))
    }
}

/// Bits of the shifted indices, x lowest: the path from the root, three bits a level.
fn interleaved(index: [i32; 3]) -> u64 {
    let mut place = 0;
    for (axis, index) in index.into_iter().enumerate() {
        let shifted = (index + INDEX_LIMIT) as u64;
        for bit in 0..LEVELS {
            place |= (shifted >> bit & 1) << (3 * bit + axis as u32);
        }
    }
    place
}

/// The tree over leaves that share everything above `level`.
fn subtree(leaves: &[(u64, f32)], level: u32) -> Node {
    if level == 0 {
        return Node::Leaf(leaves[0].1);
    }
    let child_of = |place: u64| (place >> (3 * (level - 1)) & 7) as usize;
    let mut children: [Option<Node>; 8] = Default::default();
    for part in leaves.chunk_by(|a, b| child_of(a.0) == child_of(b.0)) {
        children[child_of(part[0].0)] = Some(subtree(part, level - 1));
    }
    // Never merged at the root, which must have children in a binary file.
    if level < LEVELS
        && let Some(Node::Leaf(first)) = children[0]
        && children.iter().all(|child| matches!(child, Some(Node::Leaf(value)) if *value == first))
    {
        return Node::Leaf(first);
    }
    let most = children.iter().flatten().map(Node::value).fold(f32::NEG_INFINITY, f32::max);
    Node::Inner(most, Box::new(children))
}

#[cfg(test)]
mod tests {
    use super::super::tests::seen_wall;
    use super::*;
    use crate::OccupancyOptions;

    #[test]
    fn a_path_is_three_bits_a_level() {
        assert_eq!(interleaved([-INDEX_LIMIT; 3]), 0);
        assert_eq!(interleaved([1 - INDEX_LIMIT, -INDEX_LIMIT, -INDEX_LIMIT]), 1);
        assert_eq!(interleaved([0, -INDEX_LIMIT, -INDEX_LIMIT]), 1 << 45);
        assert_eq!(interleaved([-INDEX_LIMIT, -INDEX_LIMIT, 0]), 1 << 47);
    }

    #[test]
    fn eight_equal_leaves_become_one() {
        let same: Vec<(u64, f32)> = (0..8).map(|place| (place, 1.0)).collect();
        assert!(matches!(subtree(&same, 1), Node::Leaf(value) if value == 1.0));
        let mut mixed = same;
        mixed[3].1 = -1.0;
        assert_eq!(subtree(&mixed, 1).count(), 9);
    }

    #[test]
    fn files_have_a_header_and_as_many_nodes_as_it_says() {
        let grid = seen_wall();
        let (mut binary, mut full) = (Vec::new(), Vec::new());
        grid.write_bt(&mut binary).unwrap();
        grid.write_ot(&mut full).unwrap();
        let data = |bytes: &[u8]| bytes.windows(6).position(|w| w == b"\ndata\n").unwrap() + 6;
        let header = String::from_utf8(full[..data(&full)].to_vec()).unwrap();
        assert!(header.starts_with("# Octomap OcTree file\n"));
        let size: usize = header.lines().find_map(|line| line.strip_prefix("size ")).unwrap().parse().unwrap();
        assert_eq!(full.len() - data(&full), 5 * size);
        assert!(binary.starts_with(b"# Octomap OcTree binary file\n"));
        assert!(binary.len() < full.len() / 3);
        let mut empty = Vec::new();
        OccupancyGrid::new(OccupancyOptions::default()).unwrap().write_bt(&mut empty).unwrap();
        assert!(empty.ends_with(b"size 0\nres 0.02\ndata\n"));
    }
}
