//! Flat faces with textures: what the renderer draws and the ray caster meets.

use crate::Texture;
use nalgebra::Vector3;
use skclam_geometry::{Isometry3, Point3};
use std::sync::Arc;

/// A flat piece of surface and how its texture lies on it.
///
/// The texture position of a point P on the face is `origin_texel + (s_axis . (P - origin), t_axis . (P - origin))`.
#[derive(Debug, Clone, Copy)]
pub struct Face {
    /// A point on the face, in base.
    pub origin: Point3,
    /// Unit normal; the face is seen only from the side that it points to.
    pub normal: Vector3<f64>,
    /// Texels a metre along the texture's columns and its direction; lies in the face.
    pub s_axis: Vector3<f64>,
    /// Texels a metre along the texture's rows and its direction; lies in the face.
    pub t_axis: Vector3<f64>,
    /// Texture position of `origin`, texels.
    pub origin_texel: [f64; 2],
    /// Index of the texture.
    pub texture: u32,
    /// Light on the face; 1 where it is already in the texture.
    pub brightness: f32,
}

/// A triangle of a face, counter-clockwise as seen from the side that the normal points to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Triangle {
    /// Indices of its vertices.
    pub vertices: [u32; 3],
    /// Index of its face.
    pub face: u32,
}

/// Faces, their triangles and their textures. The base frame, metres.
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// Corners in base.
    pub vertices: Vec<Point3>,
    /// Triangles; those of one face follow each other.
    pub triangles: Vec<Triangle>,
    /// Faces.
    pub faces: Vec<Face>,
    /// Textures, shared between copies of a model.
    pub textures: Arc<Vec<Texture>>,
}

impl Model {
    /// Appends a convex polygon as a fan; corners counter-clockwise as seen from outside.
    pub(crate) fn add_polygon(&mut self, face: Face, corners: &[Point3]) {
        let face_index = self.faces.len() as u32;
        let first = self.vertices.len() as u32;
        self.faces.push(face);
        self.vertices.extend_from_slice(corners);
        for corner in 1..corners.len().saturating_sub(1) as u32 {
            let vertices = [first, first + corner, first + corner + 1];
            self.triangles.push(Triangle { vertices, face: face_index });
        }
    }

    /// Appends the other model's geometry, moved; its texture indices are kept.
    pub(crate) fn append_moved(&mut self, other: &Model, base_from_other: &Isometry3) {
        let (first_vertex, first_face) = (self.vertices.len() as u32, self.faces.len() as u32);
        self.vertices.extend(other.vertices.iter().map(|vertex| base_from_other * vertex));
        self.triangles.extend(other.triangles.iter().map(|triangle| Triangle {
            vertices: triangle.vertices.map(|vertex| vertex + first_vertex),
            face: triangle.face + first_face,
        }));
        self.faces.extend(other.faces.iter().map(|face| Face {
            origin: base_from_other * face.origin,
            normal: base_from_other * face.normal,
            s_axis: base_from_other * face.s_axis,
            t_axis: base_from_other * face.t_axis,
            ..*face
        }));
    }

    /// The three corners of a triangle, in base.
    pub fn corners(&self, triangle: &Triangle) -> [Point3; 3] {
        triangle.vertices.map(|vertex| self.vertices[vertex as usize])
    }

    /// Total area of the triangles, square metres.
    pub fn area(&self) -> f64 {
        self.triangles
            .iter()
            .map(|triangle| {
                let [a, b, c] = self.corners(triangle);
                0.5 * (b - a).cross(&(c - a)).norm()
            })
            .sum()
    }
}
