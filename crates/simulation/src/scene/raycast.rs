//! Where a ray meets the scene: a bounding volume hierarchy over triangles.
//!
//! For light that is painted into the textures once, for postures that must see something and hit nothing, and as
//! an independent check of the rasteriser. Intersection after Moeller and Trumbore, "Fast, minimum storage
//! ray/triangle intersection", 1997.

use super::model::Model;
use nalgebra::Vector3;
use skclam_geometry::Point3;

/// A ray's first meeting with a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance in units of the direction's length.
    pub distance: f64,
    /// Index of the triangle.
    pub triangle: u32,
    /// Index of its face.
    pub face: u32,
}

/// A model prepared for rays. Both sides of a triangle are met.
#[derive(Debug, Clone)]
pub struct RayCaster {
    nodes: Vec<Node>,
    triangles: Vec<Prepared>,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    low: Vector3<f64>,
    high: Vector3<f64>,
    /// Inner node: index of the right child (the left one follows its parent). Leaf: first triangle.
    next: u32,
    /// Triangles of a leaf; 0 for an inner node.
    count: u32,
}

#[derive(Debug, Clone, Copy)]
struct Prepared {
    corner: Point3,
    edge_1: Vector3<f64>,
    edge_2: Vector3<f64>,
    triangle: u32,
    face: u32,
}

const LEAF: usize = 4;

impl RayCaster {
    /// Builds the hierarchy by halving the longest side's order.
    pub fn new(model: &Model) -> Self {
        let mut triangles: Vec<Prepared> = model
            .triangles
            .iter()
            .enumerate()
            .map(|(index, triangle)| {
                let [a, b, c] = model.corners(triangle);
                Prepared { corner: a, edge_1: b - a, edge_2: c - a, triangle: index as u32, face: triangle.face }
            })
            .collect();
        let mut nodes = Vec::with_capacity(triangles.len());
        if !triangles.is_empty() {
            build(&mut nodes, &mut triangles, 0);
        }
        RayCaster { nodes, triangles }
    }

    /// The nearest meeting within `longest` lengths of `direction`.
    pub fn first_hit(&self, origin: &Point3, direction: &Vector3<f64>, longest: f64) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        self.traverse(origin, direction, longest, |hit| {
            // Ties go to the lower index, whatever the order of the tree.
            if best.is_none_or(|known| (hit.distance, hit.triangle) < (known.distance, known.triangle)) {
                best = Some(hit);
            }
            hit.distance
        });
        best
    }

    /// Whether anything lies within `longest` lengths of `direction`.
    pub fn is_blocked(&self, origin: &Point3, direction: &Vector3<f64>, longest: f64) -> bool {
        let mut blocked = false;
        self.traverse(origin, direction, longest, |_| {
            blocked = true;
            f64::NEG_INFINITY
        });
        blocked
    }

    /// Visits meetings; `visit` returns the distance beyond which nothing more is wanted.
    fn traverse(&self, origin: &Point3, direction: &Vector3<f64>, longest: f64, mut visit: impl FnMut(Hit) -> f64) {
        if self.nodes.is_empty() {
            return;
        }
        let inverse = direction.map(|component| 1.0 / component);
        let mut limit = longest;
        let mut stack = [0u32; 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            if !node.is_met(origin, &inverse, limit) {
                continue;
            }
            if node.count == 0 {
                stack[depth] = node.next;
                stack[depth + 1] = index as u32 + 1;
                depth += 2;
                continue;
            }
            for prepared in &self.triangles[node.next as usize..(node.next + node.count) as usize] {
                if let Some(distance) = prepared.meet(origin, direction)
                    && distance <= limit
                {
                    limit = limit.min(visit(Hit { distance, triangle: prepared.triangle, face: prepared.face }));
                }
            }
        }
    }
}

impl Node {
    fn is_met(&self, origin: &Point3, inverse: &Vector3<f64>, limit: f64) -> bool {
        let (mut near, mut far) = (0.0f64, limit);
        for axis in 0..3 {
            let a = (self.low[axis] - origin[axis]) * inverse[axis];
            let b = (self.high[axis] - origin[axis]) * inverse[axis];
            // f64::max and min ignore the NaN of 0 * infinity: the slab does not constrain then.
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far
    }
}

impl Prepared {
    fn meet(&self, origin: &Point3, direction: &Vector3<f64>) -> Option<f64> {
        let p = direction.cross(&self.edge_2);
        let determinant = self.edge_1.dot(&p);
        if determinant == 0.0 {
            return None;
        }
        let inverse = 1.0 / determinant;
        let to_origin = origin - self.corner;
        let u = to_origin.dot(&p) * inverse;
        let q = to_origin.cross(&self.edge_1);
        let v = direction.dot(&q) * inverse;
        let distance = self.edge_2.dot(&q) * inverse;
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && distance > 1e-9).then_some(distance)
    }
}

fn build(nodes: &mut Vec<Node>, triangles: &mut [Prepared], first: usize) {
    let mut low = Vector3::repeat(f64::INFINITY);
    let mut high = Vector3::repeat(f64::NEG_INFINITY);
    for prepared in triangles.iter() {
        for corner in [Vector3::zeros(), prepared.edge_1, prepared.edge_2] {
            let position = prepared.corner.coords + corner;
            low = low.inf(&position);
            high = high.sup(&position);
        }
    }
    // A small margin, so that flat boxes are met despite rounding.
    let (low, high) = (low.add_scalar(-1e-9), high.add_scalar(1e-9));
    let index = nodes.len();
    nodes.push(Node { low, high, next: first as u32, count: triangles.len() as u32 });
    if triangles.len() <= LEAF {
        return;
    }
    let axis = (high - low).imax();
    let centre = |prepared: &Prepared| prepared.corner[axis] + (prepared.edge_1[axis] + prepared.edge_2[axis]) / 3.0;
    let middle = triangles.len() / 2;
    triangles.select_nth_unstable_by(middle, |a, b| centre(a).total_cmp(&centre(b)).then(a.triangle.cmp(&b.triangle)));
    let (left, right) = triangles.split_at_mut(middle);
    build(nodes, left, first);
    nodes[index].next = nodes.len() as u32;
    nodes[index].count = 0;
    build(nodes, right, first + middle);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::model::Triangle;
    use crate::scene_rng::SceneRng;

    #[test]
    fn the_tree_agrees_with_trying_every_triangle() {
        let mut rng = SceneRng::new(11, 0);
        let mut model = Model::default();
        for index in 0..300u32 {
            let centre = Vector3::from_fn(|_, _| rng.range(-1.0, 1.0));
            for _ in 0..3 {
                model.vertices.push((centre + Vector3::from_fn(|_, _| rng.range(-0.2, 0.2))).into());
            }
            model.triangles.push(Triangle { vertices: [3 * index, 3 * index + 1, 3 * index + 2], face: index });
        }
        let caster = RayCaster::new(&model);
        let mut met = 0;
        for _ in 0..500 {
            let origin = Point3::from(Vector3::from_fn(|_, _| rng.range(-1.5, 1.5)));
            let direction = Vector3::from_fn(|_, _| rng.normal());
            let slow = caster
                .triangles
                .iter()
                .filter_map(|prepared| Some((prepared.meet(&origin, &direction)?, prepared.triangle)))
                .filter(|(distance, _)| *distance <= 5.0)
                .min_by(|a, b| a.partial_cmp(b).unwrap());
            let fast = caster.first_hit(&origin, &direction, 5.0);
            assert_eq!(fast.map(|hit| (hit.distance, hit.triangle)), slow);
            assert_eq!(caster.is_blocked(&origin, &direction, 5.0), slow.is_some());
            met += usize::from(slow.is_some());
        }
        assert!(met > 50 && met < 500, "{met}");
        assert_eq!(RayCaster::new(&Model::default()).first_hit(&Point3::origin(), &Vector3::x(), 1.0), None);
    }
}
