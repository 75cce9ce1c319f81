//! Distance from a point to the nearest point of a cloud or of a mesh's triangles, exactly.
//!
//! A bounding volume hierarchy over triangles, points being triangles of no extent. Distances to samples of a surface,
//! as a k-d tree gives them, would add the spacing of the samples to every distance.

use crate::{Error, Model};
use nalgebra::Vector3;

/// Triangles in a leaf at most.
const LEAF: usize = 4;

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f32; 3],
    high: [f32; 3],
    /// Leaf: first triangle; else: the second child (the first one follows its parent).
    link: u32,
    /// Triangles of a leaf; 0 = not a leaf.
    count: u32,
}

/// A surface prepared for questions of distance.
#[derive(Debug, Clone)]
pub struct SurfaceIndex {
    nodes: Vec<Node>,
    /// Corners of the triangles in the order of the leaves.
    triangles: Vec<[[f32; 3]; 3]>,
}

impl SurfaceIndex {
    /// Indexes the triangles of a mesh, or the points of a cloud (or of a mesh without triangles).
    pub fn new(model: &Model) -> Result<Self, Error> {
        model.check()?;
        let points = &model.points().points;
        let mut triangles: Vec<[[f32; 3]; 3]> = if model.triangles().is_empty() {
            points.iter().map(|point| [*point; 3]).collect()
        } else {
            model.triangles().iter().map(|triangle| triangle.map(|corner| points[corner as usize])).collect()
        };
        if triangles.is_empty() {
            return Err(Error::Empty { what: "a surface to measure against", advice: "a map with points is needed" });
        }
        let mut nodes = Vec::with_capacity(triangles.len());
        build(&mut nodes, &mut triangles, 0);
        Ok(SurfaceIndex { nodes, triangles })
    }

    /// Distance from a point to the surface, metres; `None` if it is more than `limit_m`.
    pub fn distance(&self, point: [f32; 3], limit_m: f32) -> Option<f32> {
        let mut best = limit_m * limit_m;
        let mut found = false;
        // Depth of the tree: it halves down to the leaves, so 64 levels hold anything that fits into memory.
        let mut stack = [(0u32, 0f32); 64];
        stack[0] = (0, to_box(point, &self.nodes[0]));
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let (index, squared) = stack[waiting];
            if squared > best {
                continue;
            }
            let node = &self.nodes[index as usize];
            if node.count > 0 {
                for triangle in &self.triangles[node.link as usize..(node.link + node.count) as usize] {
                    let squared = to_triangle(point, triangle);
                    if squared <= best {
                        best = squared;
                        found = true;
                    }
                }
                continue;
            }
            let (left, right) = (index + 1, node.link);
            let to_left = to_box(point, &self.nodes[left as usize]);
            let to_right = to_box(point, &self.nodes[right as usize]);
            // The nearer one is put on top.
            let (near, far) = if to_left <= to_right {
                ((left, to_left), (right, to_right))
            } else {
                ((right, to_right), (left, to_left))
            };
            stack[waiting] = far;
            stack[waiting + 1] = near;
            waiting += 2;
        }
        found.then(|| best.sqrt())
    }
}

impl SurfaceIndex {
    /// Whether a triangle is between two points, not counting the last `clearance_m` before the second. Points
    /// of a cloud hide nothing.
    pub fn hides(&self, from: [f32; 3], to: [f32; 3], clearance_m: f32) -> bool {
        let origin = Vector3::from(from);
        let whole = Vector3::from(to) - origin;
        let length = whole.norm();
        if length <= clearance_m {
            return false;
        }
        let direction = whole / length;
        let inverse = direction.map(|value| 1.0 / value);
        let farthest = length - clearance_m;
        let mut stack = [0u32; 64];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let index = stack[waiting];
            let node = &self.nodes[index as usize];
            let (mut enter, mut leave) = (0f32, farthest);
            for axis in 0..3 {
                let one = (node.low[axis] - origin[axis]) * inverse[axis];
                let two = (node.high[axis] - origin[axis]) * inverse[axis];
                // A ray within a slab's plane gives NaN, which min and max pass over.
                enter = enter.max(one.min(two));
                leave = leave.min(one.max(two));
            }
            if enter > leave {
                continue;
            }
            if node.count == 0 {
                stack[waiting] = node.link;
                stack[waiting + 1] = index + 1;
                waiting += 2;
                continue;
            }
            let triangles = &self.triangles[node.link as usize..(node.link + node.count) as usize];
            if triangles.iter().any(|triangle| crosses(&origin, &direction, farthest, triangle)) {
                return true;
            }
        }
        false
    }
}

/// Whether a ray meets a triangle before `farthest` (Moeller and Trumbore 1997).
fn crosses(origin: &Vector3<f32>, direction: &Vector3<f32>, farthest: f32, triangle: &[[f32; 3]; 3]) -> bool {
    let [a, b, c] = triangle.map(Vector3::from);
    let (ab, ac) = (b - a, c - a);
    let p = direction.cross(&ac);
    let determinant = ab.dot(&p);
    if determinant.abs() < 1e-12 {
        return false;
    }
    let t = origin - a;
    let u = t.dot(&p) / determinant;
    let q = t.cross(&ab);
    let v = direction.dot(&q) / determinant;
    let distance = ac.dot(&q) / determinant;
    u >= 0.0 && v >= 0.0 && u + v <= 1.0 && distance > 0.0 && distance < farthest
}

/// Builds the subtree over `triangles`, the first of which is at `first` in the whole list.
fn build(nodes: &mut Vec<Node>, triangles: &mut [[[f32; 3]; 3]], first: usize) {
    let mut node = Node { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3], link: first as u32, count: 0 };
    for corner in triangles.iter().flatten() {
        node.low = std::array::from_fn(|axis| node.low[axis].min(corner[axis]));
        node.high = std::array::from_fn(|axis| node.high[axis].max(corner[axis]));
    }
    let place = nodes.len();
    if triangles.len() <= LEAF {
        node.count = triangles.len() as u32;
        nodes.push(node);
        return;
    }
    let extent: [f32; 3] = std::array::from_fn(|axis| node.high[axis] - node.low[axis]);
    let axis = (0..3).max_by(|&a, &b| extent[a].total_cmp(&extent[b])).expect("three axes");
    nodes.push(node);
    let middle = triangles.len() / 2;
    let centre = |triangle: &[[f32; 3]; 3]| triangle[0][axis] + triangle[1][axis] + triangle[2][axis];
    triangles.select_nth_unstable_by(middle, |a, b| centre(a).total_cmp(&centre(b)));
    let (left, right) = triangles.split_at_mut(middle);
    build(nodes, left, first);
    nodes[place].link = nodes.len() as u32;
    build(nodes, right, first + middle);
}

fn to_box(point: [f32; 3], node: &Node) -> f32 {
    (0..3).map(|axis| (node.low[axis] - point[axis]).max(point[axis] - node.high[axis]).max(0.0).powi(2)).sum()
}

/// Squared distance to a triangle, by the regions of Ericson, Real-Time Collision Detection, section 5.1.5.
fn to_triangle(point: [f32; 3], triangle: &[[f32; 3]; 3]) -> f32 {
    let [a, b, c] = triangle.map(Vector3::from);
    let p = Vector3::from(point);
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return ap.norm_squared();
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return bp.norm_squared();
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 - d3 > 0.0 {
        return (ap - ab * (d1 / (d1 - d3))).norm_squared();
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return cp.norm_squared();
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 - d6 > 0.0 {
        return (ap - ac * (d2 / (d2 - d6))).norm_squared();
    }
    let va = d3 * d6 - d5 * d4;
    let (along, against) = (d4 - d3, d5 - d6);
    if va <= 0.0 && along >= 0.0 && against >= 0.0 && along + against > 0.0 {
        return (bp - (c - b) * (along / (along + against))).norm_squared();
    }
    let total = va + vb + vc;
    if total.abs() < 1e-30 {
        // A sliver without area: its corners are as near as anything.
        return ap.norm_squared().min(bp.norm_squared()).min(cp.norm_squared());
    }
    (ap - ab * (vb / total) - ac * (vc / total)).norm_squared()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{PointCloud, TriangleMesh};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_tree_finds_what_a_search_of_all_finds(
            points in prop::collection::vec(prop::array::uniform3(-1f32..1.0), 3..60),
            query in prop::array::uniform3(-1.5f32..1.5),
        ) {
            let cloud = PointCloud { points: points.clone(), ..Default::default() };
            let index = SurfaceIndex::new(&cloud.clone().into()).unwrap();
            let to = |p: &[f32; 3]| (Vector3::from(*p) - Vector3::from(query)).norm();
            let nearest = points.iter().map(to).fold(f32::INFINITY, f32::min);
            prop_assert!((index.distance(query, 10.0).unwrap() - nearest).abs() < 1e-5);
            prop_assert_eq!(index.distance(query, nearest * 0.99), None);

            // Against a triangle: no point of a fine grid over it is nearer, and one is about as near.
            let triangles: Vec<[u32; 3]> = (0..points.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
            let mut sampled = f32::INFINITY;
            for triangle in &triangles {
                let [a, b, c] = triangle.map(|i| Vector3::from(points[i as usize]));
                for i in 0..=40 {
                    for j in 0..=40 - i {
                        let p = a + (b - a) * (i as f32 / 40.0) + (c - a) * (j as f32 / 40.0);
                        sampled = sampled.min((p - Vector3::from(query)).norm());
                    }
                }
            }
            let mesh = TriangleMesh { vertices: cloud, triangles };
            let exact = SurfaceIndex::new(&mesh.into()).unwrap().distance(query, 10.0).unwrap();
            prop_assert!(exact <= sampled + 1e-5 && exact > sampled - 0.06, "{exact} {sampled}");
        }
    }

    #[test]
    fn a_wall_hides_what_is_behind_it_and_nothing_else() {
        let points = vec![[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]];
        let vertices = PointCloud { points, ..Default::default() };
        let index =
            SurfaceIndex::new(&TriangleMesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }.into()).unwrap();
        assert!(index.hides([0.0; 3], [0.3, 0.2, 2.0], 0.01));
        assert!(!index.hides([0.0; 3], [0.3, 0.2, 0.9], 0.01), "before it");
        assert!(!index.hides([0.0; 3], [0.3, 0.2, 1.0], 0.01), "on it");
        assert!(!index.hides([0.0; 3], [0.3, 2.5, 2.0], 0.01), "beside it");
        assert!(!index.hides([0.0; 3], [0.3, 0.2, -2.0], 0.01), "in the other direction");
    }

    #[test]
    fn nothing_to_measure_against_is_an_error() {
        assert!(matches!(SurfaceIndex::new(&PointCloud::default().into()), Err(Error::Empty { .. })));
    }
}
