//! The triangles of marching cubes, made by rule instead of being written down.
//!
//! Corner `c` of a cell lies at `(c & 1, c >> 1 & 1, c >> 2 & 1)`. Edge `4 axis + i` runs along `axis` from
//! [`EDGES`]`[..].from`. On every face of the cell the surface separates each run of inside corners from the rest, so
//! two cells that share a face agree on it whatever the rest of them looks like, and the surface is closed. The
//! separating lines join to loops around the cell; a loop becomes a fan of triangles, counter-clockwise seen from the
//! free side.

use std::sync::LazyLock;

/// An edge of a cell.
#[derive(Debug, Clone, Copy)]
pub(super) struct Edge {
    /// 0, 1, 2 for x, y, z.
    pub(super) axis: usize,
    /// The corner at its lower end.
    pub(super) from: usize,
    /// The corner at its upper end.
    pub(super) to: usize,
}

/// The twelve edges.
pub(super) static EDGES: LazyLock<[Edge; 12]> = LazyLock::new(|| {
    std::array::from_fn(|edge| {
        let axis = edge / 4;
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        let from = ((edge & 1) << u) | ((edge >> 1 & 1) << v);
        Edge { axis, from, to: from | 1 << axis }
    })
});

/// For each set of inside corners (bit = corner), the triangles as edges of the cell.
pub(super) static TRIANGLES: LazyLock<Vec<Vec<[u8; 3]>>> = LazyLock::new(|| (0..256).map(triangles).collect());

fn edge_between(a: usize, b: usize) -> usize {
    EDGES.iter().position(|edge| (edge.from, edge.to) == (a.min(b), a.max(b))).expect("the corners are neighbours")
}

fn triangles(inside: usize) -> Vec<[u8; 3]> {
    let is_inside = |corner: usize| inside >> corner & 1 == 1;
    // From the edge where a walk around a face (counter-clockwise from outside the cell) enters the inside to the edge
    // where it leaves it. Every crossed edge is entered in one of its faces and left in the other.
    let mut next = [None; 12];
    for axis in 0..3 {
        let (u, v) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
        for side in [0, 1 << axis] {
            let mut corners = [side, side | u, side | u | v, side | v];
            if side == 0 {
                corners.reverse();
            }
            for start in 0..4 {
                if is_inside(corners[start]) || !is_inside(corners[(start + 1) % 4]) {
                    continue;
                }
                let mut end = start + 1;
                while is_inside(corners[(end + 1) % 4]) {
                    end += 1;
                }
                let enters = edge_between(corners[start], corners[(start + 1) % 4]);
                next[enters] = Some(edge_between(corners[end % 4], corners[(end + 1) % 4]));
            }
        }
    }
    let mut triangles = Vec::new();
    let mut done = [false; 12];
    for start in 0..12 {
        if next[start].is_none() || done[start] {
            continue;
        }
        let mut ring = Vec::new();
        let mut edge = start;
        while !done[edge] {
            done[edge] = true;
            ring.push(edge as u8);
            edge = next[edge].expect("loops are closed");
        }
        for corner in 2..ring.len() {
            triangles.push([ring[0], ring[corner - 1], ring[corner]]);
        }
    }
    triangles
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_corner_is_cut_off_by_a_triangle_that_faces_the_free_side() {
        for corner in 0..8usize {
            let [triangle] = TRIANGLES[1 << corner][..] else { panic!("one triangle") };
            let middle = |edge: u8| {
                let Edge { axis, from, .. } = EDGES[edge as usize];
                let mut point = nalgebra::Vector3::from([0, 1, 2].map(|bit| (from >> bit & 1) as f32));
                point[axis] = 0.5;
                point
            };
            let [a, b, c] = triangle.map(middle);
            let outwards = nalgebra::Vector3::repeat(0.5)
                - nalgebra::Vector3::from([0, 1, 2].map(|bit| (corner >> bit & 1) as f32));
            assert!((b - a).cross(&(c - a)).dot(&outwards) > 0.0, "corner {corner}");
        }
    }

    #[test]
    fn every_crossed_edge_is_used_and_no_other() {
        for inside in 0..256usize {
            let mut used = [false; 12];
            TRIANGLES[inside].iter().flatten().for_each(|&edge| used[edge as usize] = true);
            for (edge, ends) in EDGES.iter().enumerate() {
                let crossed = (inside >> ends.from ^ inside >> ends.to) & 1 == 1;
                assert_eq!(used[edge], crossed, "case {inside}, edge {edge}");
            }
        }
    }
}
