//! Normals at the vertices of a mesh.

use crate::TriangleMesh;
use nalgebra::Vector3;

/// Unit normals, one a vertex: the mean of its triangles' normals weighted by their areas, which for the slivers that
/// marching cubes leaves is better than equal weights. A vertex without an area around it gets the z axis.
pub fn vertex_normals(mesh: &TriangleMesh) -> Vec<[f32; 3]> {
    let mut sums = vec![Vector3::<f32>::zeros(); mesh.vertices.len()];
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|vertex| Vector3::from(mesh.vertices.points[vertex as usize]));
        let area = (b - a).cross(&(c - a));
        for vertex in triangle {
            sums[*vertex as usize] += area;
        }
    }
    sums.into_iter().map(|sum| sum.try_normalize(1e-20).unwrap_or(Vector3::z()).into()).collect()
}
