//! Faces and triangles of a view as linear functions of the undistorted pixel.
//!
//! Homogeneous rasterisation (Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997):
//! with `d` the direction of a pixel, a triangle with corners `v_i` in the camera covers it where all
//! `(v_{i+1} x v_i) . d` have one sign, and a plane `n . P = h` is met at `1/z = n . d / h`. Both are linear in the
//! pixel, nothing needs clipping, and neighbours share an edge function to the last bit, so that no gap opens.

use crate::scene::{Face, Footprint, Model, Texture};
use nalgebra::Vector3;
use skclam_geometry::{Isometry3, PinholeCamera, Point3};

/// Surfaces nearer than this are not drawn, metres.
pub(crate) const NEAR_M: f64 = 0.01;

/// `x`, `y` gradient and value at the pixel (0, 0), double precision.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Linear([f64; 3]);

/// The same about a tile's origin, single precision.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct LocalLinear {
    pub x: f32,
    pub y: f32,
    pub at_origin: f32,
}

impl Linear {
    fn of_direction(camera: &PinholeCamera, vector: &Vector3<f64>) -> Self {
        let (x, y) = (vector.x / camera.fx, vector.y / camera.fy);
        Linear([x, y, vector.z - x * camera.cx - y * camera.cy])
    }

    fn divided(self, by: f64) -> Self {
        Linear(self.0.map(|value| value / by))
    }

    pub fn local(&self, origin: (u32, u32)) -> LocalLinear {
        let [x, y, constant] = self.0;
        let at_origin = x * f64::from(origin.0) + y * f64::from(origin.1) + constant;
        LocalLinear { x: x as f32, y: y as f32, at_origin: at_origin as f32 }
    }
}

impl LocalLinear {
    #[inline]
    pub fn at(&self, x: f32, y: f32) -> f32 {
        self.x * x + self.y * y + self.at_origin
    }
}

/// A face that looks at the camera.
#[derive(Debug)]
pub(crate) struct ViewedFace<'a> {
    pub texture: &'a Texture,
    pub brightness: f32,
    /// 1/z, per metre.
    pub inverse_depth: Linear,
    s: Linear,
    t: Linear,
    texel_of_camera: (f64, f64),
}

/// A face's functions about a tile's origin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LocalFace<'a> {
    pub texture: &'a Texture,
    pub brightness: f32,
    inverse_depth: LocalLinear,
    s: LocalLinear,
    t: LocalLinear,
    texel_of_camera: (f32, f32),
}

/// A triangle of a face that looks at the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ViewedTriangle {
    pub edges: [Linear; 3],
    /// Index among the viewed faces.
    pub face: u32,
    /// Left, top, right, bottom of what lies before the near plane, undistorted pixels.
    pub bounds: [f32; 4],
    /// z of the nearest corner, metres.
    nearest_m: f64,
}

impl<'a> ViewedFace<'a> {
    fn new(face: &Face, texture: &'a Texture, camera: &PinholeCamera, color_from_base: &Isometry3) -> Option<Self> {
        let normal = color_from_base * face.normal;
        let origin = color_from_base * face.origin;
        let distance = normal.dot(&origin.coords);
        // The camera must be on the side that the normal points to.
        if distance >= -1e-9 {
            return None;
        }
        let (s_axis, t_axis) = (color_from_base * face.s_axis, color_from_base * face.t_axis);
        let texel_of_camera =
            (face.origin_texel[0] - s_axis.dot(&origin.coords), face.origin_texel[1] - t_axis.dot(&origin.coords));
        Some(ViewedFace {
            texture,
            brightness: face.brightness,
            inverse_depth: Linear::of_direction(camera, &normal).divided(distance),
            s: Linear::of_direction(camera, &s_axis),
            t: Linear::of_direction(camera, &t_axis),
            texel_of_camera,
        })
    }

    pub fn local(&self, origin: (u32, u32)) -> LocalFace<'a> {
        LocalFace {
            texture: self.texture,
            brightness: self.brightness,
            inverse_depth: self.inverse_depth.local(origin),
            s: self.s.local(origin),
            t: self.t.local(origin),
            texel_of_camera: (self.texel_of_camera.0 as f32, self.texel_of_camera.1 as f32),
        }
    }
}

impl LocalFace<'_> {
    /// Where a pixel falls on the texture, with the derivatives by the *real* pixel (`by_x`, `by_y`: how the
    /// undistorted position moves with it). The quotient rule on `s = s_0 + S(d) / W(d)`.
    #[inline]
    pub fn footprint(&self, x: f32, y: f32, by_x: (f32, f32), by_y: (f32, f32)) -> Footprint {
        let depth = 1.0 / self.inverse_depth.at(x, y).max(1e-6);
        let (s, t) = (self.s.at(x, y) * depth, self.t.at(x, y) * depth);
        let w = &self.inverse_depth;
        let ds = ((self.s.x - s * w.x) * depth, (self.s.y - s * w.y) * depth);
        let dt = ((self.t.x - t * w.x) * depth, (self.t.y - t * w.y) * depth);
        let along = |step: (f32, f32)| (ds.0 * step.0 + ds.1 * step.1, dt.0 * step.0 + dt.1 * step.1);
        Footprint { s: self.texel_of_camera.0 + s, t: self.texel_of_camera.1 + t, by_x: along(by_x), by_y: along(by_y) }
    }
}

/// All faces and triangles that may be seen.
pub(crate) fn view<'a>(
    models: &[&'a Model],
    camera: &PinholeCamera,
    color_from_base: &Isometry3,
) -> (Vec<ViewedFace<'a>>, Vec<ViewedTriangle>) {
    let (mut faces, mut triangles) = (Vec::new(), Vec::new());
    for model in models {
        let in_camera: Vec<Point3> = model.vertices.iter().map(|vertex| color_from_base * vertex).collect();
        let viewed: Vec<Option<u32>> = model
            .faces
            .iter()
            .map(|face| {
                let texture = &model.textures[face.texture as usize];
                faces.push(ViewedFace::new(face, texture, camera, color_from_base)?);
                Some(faces.len() as u32 - 1)
            })
            .collect();
        for triangle in &model.triangles {
            let Some(face) = viewed[triangle.face as usize] else { continue };
            let corners = triangle.vertices.map(|vertex| in_camera[vertex as usize]);
            let Some(bounds) = bounds(&corners, camera) else { continue };
            let edge = |a: usize, b: usize| {
                let linear = Linear::of_direction(camera, &corners[b].coords.cross(&corners[a].coords));
                // In pixels of distance from the edge; the norm is the same for the neighbour's edge.
                let norm = (linear.0[0] * linear.0[0] + linear.0[1] * linear.0[1]).sqrt();
                linear.divided(if norm > 0.0 { norm } else { 1.0 })
            };
            let nearest_m = corners.iter().map(|corner| corner.z).fold(f64::INFINITY, f64::min);
            triangles.push(ViewedTriangle { edges: [edge(0, 1), edge(1, 2), edge(2, 0)], face, bounds, nearest_m });
        }
    }
    // Near ones first: what lies behind them is then dismissed at a glance. Stable, so that ties keep their order.
    triangles.sort_by(|a, b| a.nearest_m.total_cmp(&b.nearest_m));
    (faces, triangles)
}

/// Bounds in the undistorted image of the part before the near plane; `None` where there is none.
fn bounds(corners: &[Point3; 3], camera: &PinholeCamera) -> Option<[f32; 4]> {
    let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
    let mut extend = |point: &Point3| {
        let x = camera.fx * point.x / point.z + camera.cx;
        let y = camera.fy * point.y / point.z + camera.cy;
        bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
    };
    for index in 0..3 {
        let (a, b) = (&corners[index], &corners[(index + 1) % 3]);
        if a.z >= NEAR_M {
            extend(a);
        }
        if (a.z >= NEAR_M) != (b.z >= NEAR_M) {
            let fraction = (NEAR_M - a.z) / (b.z - a.z);
            let mut crossing = a + (b - a) * fraction;
            crossing.z = NEAR_M;
            extend(&crossing);
        }
    }
    (bounds[0] <= bounds[2]).then(|| bounds.map(|value| value as f32))
}
