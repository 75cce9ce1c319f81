//! The kinds of map that are made of points: clouds and triangle meshes, in the base frame.

use crate::Error;
use nalgebra::Vector3;
use skclam_geometry::{Isometry3, Point3};

/// Points with optional colours and normals. The optional lists are empty or as long as `points`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions in the base frame, metres.
    pub points: Vec<[f32; 3]>,
    /// Red, green, blue; empty when there is no colour.
    pub colors: Vec<[u8; 3]>,
    /// Unit normals in the base frame, towards the side the surface was seen from; empty when there are none.
    pub normals: Vec<[f32; 3]>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Checks that the lists fit each other and that all numbers are finite.
    pub fn check(&self) -> Result<(), Error> {
        let need = self.points.len();
        for (what, got) in [("colours of a cloud", self.colors.len()), ("normals of a cloud", self.normals.len())] {
            if got != 0 && got != need {
                return Err(Error::Inconsistent { what, got, need });
            }
        }
        for (what, list) in [("a point of a cloud", &self.points), ("a normal of a cloud", &self.normals)] {
            if let Some(bad) = list.iter().flatten().find(|value| !value.is_finite()) {
                return Err(Error::BadNumber { what, value: bad.to_string(), need: "a finite number" });
            }
        }
        Ok(())
    }

    /// The smallest and largest coordinates; `None` for an empty cloud.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        let first = *self.points.first()?;
        Some(self.points.iter().fold((first, first), |(mut low, mut high), point| {
            for axis in 0..3 {
                low[axis] = low[axis].min(point[axis]);
                high[axis] = high[axis].max(point[axis]);
            }
            (low, high)
        }))
    }
}

/// A surface of triangles over shared vertices; counter-clockwise as seen from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// The vertices, with their colours and normals.
    pub vertices: PointCloud,
    /// Three indices into `vertices` each.
    pub triangles: Vec<[u32; 3]>,
}

impl TriangleMesh {
    /// Checks the vertices and that every triangle names vertices that exist.
    pub fn check(&self) -> Result<(), Error> {
        self.vertices.check()?;
        match self.triangles.iter().flatten().find(|&&index| index as usize >= self.vertices.len()) {
            Some(&index) => Err(Error::Inconsistent {
                what: "a triangle names a vertex that does not exist",
                got: index as usize,
                need: self.vertices.len(),
            }),
            None => Ok(()),
        }
    }
}

/// What a map file may hold.
#[derive(Debug, Clone, PartialEq)]
pub enum Model {
    /// Points alone.
    Cloud(PointCloud),
    /// Points and the triangles between them.
    Mesh(TriangleMesh),
}

impl Model {
    /// The points, or the mesh's vertices.
    pub fn points(&self) -> &PointCloud {
        match self {
            Model::Cloud(cloud) => cloud,
            Model::Mesh(mesh) => &mesh.vertices,
        }
    }

    /// The triangles; none for a cloud.
    pub fn triangles(&self) -> &[[u32; 3]] {
        match self {
            Model::Cloud(_) => &[],
            Model::Mesh(mesh) => &mesh.triangles,
        }
    }

    /// The same map in another frame: points and normals are taken along.
    pub fn transformed(mut self, a_from_b: &Isometry3) -> Self {
        let cloud = match &mut self {
            Model::Cloud(cloud) => cloud,
            Model::Mesh(mesh) => &mut mesh.vertices,
        };
        for point in &mut cloud.points {
            *point = (a_from_b * Point3::from(point.map(f64::from))).coords.cast::<f32>().into();
        }
        for normal in &mut cloud.normals {
            *normal = (a_from_b.rotation * Vector3::from(normal.map(f64::from))).cast::<f32>().into();
        }
        self
    }

    /// Checks whichever it is.
    pub fn check(&self) -> Result<(), Error> {
        match self {
            Model::Cloud(cloud) => cloud.check(),
            Model::Mesh(mesh) => mesh.check(),
        }
    }
}

impl From<PointCloud> for Model {
    fn from(cloud: PointCloud) -> Self {
        Model::Cloud(cloud)
    }
}

impl From<TriangleMesh> for Model {
    fn from(mesh: TriangleMesh) -> Self {
        Model::Mesh(mesh)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_enclose_all_points() {
        let cloud = PointCloud { points: vec![[1.0, 2.0, 3.0], [-1.0, 5.0, 0.0]], ..Default::default() };
        assert_eq!(cloud.bounds(), Some(([-1.0, 2.0, 0.0], [1.0, 5.0, 3.0])));
        assert_eq!(PointCloud::default().bounds(), None);
    }

    #[test]
    fn a_map_moves_with_its_frame() {
        let cloud = PointCloud { points: vec![[1.0, 0.0, 0.0]], normals: vec![[1.0, 0.0, 0.0]], ..Default::default() };
        let quarter = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let motion = Isometry3::from_parts(nalgebra::Translation3::new(0.0, 0.0, 2.0), quarter);
        let moved = Model::Cloud(cloud).transformed(&motion);
        let near = |a: [f32; 3], b: [f32; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(near(moved.points().points[0], [0.0, 1.0, 2.0]));
        assert!(near(moved.points().normals[0], [0.0, 1.0, 0.0]));
    }

    #[test]
    fn lists_that_do_not_fit_and_bad_numbers_are_named() {
        let mut cloud = PointCloud { points: vec![[0.0; 3]; 2], colors: vec![[0; 3]], ..Default::default() };
        assert!(matches!(cloud.check(), Err(Error::Inconsistent { got: 1, need: 2, .. })));
        cloud.colors.clear();
        let mesh = TriangleMesh { vertices: cloud.clone(), triangles: vec![[0, 1, 2]] };
        assert!(matches!(mesh.check(), Err(Error::Inconsistent { got: 2, need: 2, .. })));
        cloud.points[1][1] = f32::NAN;
        assert!(matches!(cloud.check(), Err(Error::BadNumber { .. })));
    }
}
