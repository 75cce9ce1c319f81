//! A coarser mesh for collision checking: vertex clustering with quadric placement (Lindstrom 2000).
//!
//! All vertices in one cell of a grid whose normals point the same way become one, at the point nearest to the planes
//! of their triangles, so that flat parts stay flat and edges sharp. Merging vertices cannot tear a surface open, and
//! since the direction counts, the two sides of a thin wall do not collapse onto each other.

use super::vertex_normals;
use crate::voxel::{VoxelKey, VoxelMap};
use crate::{Error, PointCloud, TriangleMesh};
use nalgebra::{Matrix3, Vector3};
use std::collections::HashSet;

/// What a cluster accumulates, relative to its cell's centre.
#[derive(Clone)]
struct Cluster {
    centre: Vector3<f64>,
    sum: Vector3<f64>,
    color: [u64; 3],
    vertices: u32,
    planes: Matrix3<f64>,
    weighted_sum: Vector3<f64>,
}

/// Merges vertices within cells of `cell_m` metres. Normals are made anew; colours are means.
pub fn decimate(mesh: &TriangleMesh, cell_m: f64) -> Result<TriangleMesh, Error> {
    mesh.check()?;
    if !(cell_m.is_finite() && cell_m > 0.0) {
        return Err(Error::Option { option: "cell_m", value: cell_m.to_string(), need: "a positive length is needed" });
    }
    let normals = vertex_normals(mesh);
    let mut places: [VoxelMap<u32>; 6] = Default::default();
    let mut clusters: Vec<Cluster> = Vec::new();
    let mut cluster_of = Vec::with_capacity(mesh.vertices.len());
    for (vertex, point) in mesh.vertices.points.iter().enumerate() {
        let point = point.map(f64::from);
        let key = VoxelKey::of_point(point, 1.0 / cell_m)?;
        let normal = Vector3::from(normals[vertex]);
        let axis = normal.iamax();
        let direction = 2 * axis + usize::from(normal[axis] < 0.0);
        let place = *places[direction].entry(key).or_insert_with(|| {
            let centre = Vector3::from(key.index().map(|index| (f64::from(index) + 0.5) * cell_m));
            clusters.push(Cluster {
                centre,
                sum: Vector3::zeros(),
                color: [0; 3],
                vertices: 0,
                planes: Matrix3::zeros(),
                weighted_sum: Vector3::zeros(),
            });
            clusters.len() as u32 - 1
        });
        let cluster = &mut clusters[place as usize];
        cluster.sum += Vector3::from(point) - cluster.centre;
        cluster.vertices += 1;
        if let Some(color) = mesh.vertices.colors.get(vertex) {
            for (sum, value) in cluster.color.iter_mut().zip(color) {
                *sum += u64::from(*value);
            }
        }
        cluster_of.push(place);
    }
    let mut seen = HashSet::new();
    let mut triangles = Vec::new();
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|corner| Vector3::from(mesh.vertices.points[corner as usize].map(f64::from)));
        let area = (b - a).cross(&(c - a));
        let merged = triangle.map(|corner| cluster_of[corner as usize]);
        for &place in &merged {
            // Planes weighted by squared areas: the volume between the old surface and the new point.
            let cluster = &mut clusters[place as usize];
            cluster.planes += area * area.transpose();
            cluster.weighted_sum += area * area.dot(&(a - cluster.centre));
        }
        let [a, b, c] = merged;
        if a == b || b == c || c == a {
            continue;
        }
        // The same triangle, whichever corner it starts with.
        let start = (0..3).min_by_key(|&corner| merged[corner]).expect("three corners");
        let rotated = [merged[start], merged[(start + 1) % 3], merged[(start + 2) % 3]];
        if seen.insert(rotated) {
            triangles.push(rotated);
        }
    }
    let points = clusters.iter().map(|cluster| position(cluster, cell_m).cast::<f32>().into()).collect();
    let mean = |cluster: &Cluster| cluster.color.map(|sum| (sum / u64::from(cluster.vertices)) as u8);
    let colors = if mesh.vertices.colors.is_empty() { Vec::new() } else { clusters.iter().map(mean).collect() };
    let vertices = PointCloud { points, colors, normals: Vec::new() };
    let mut coarse = TriangleMesh { vertices, triangles };
    super::extract::drop_unused_vertices(&mut coarse);
    coarse.vertices.normals = vertex_normals(&coarse);
    Ok(coarse)
}

/// The point of the cell nearest to all planes; where they leave it open, nearest to the mean of the vertices.
fn position(cluster: &Cluster, cell_m: f64) -> Vector3<f64> {
    let mean = cluster.sum / f64::from(cluster.vertices);
    let eigen = cluster.planes.symmetric_eigen();
    let most = eigen.eigenvalues.amax();
    let mut point = mean;
    if most > 0.0 {
        let rest = cluster.weighted_sum - cluster.planes * mean;
        for axis in 0..3 {
            // Directions that the planes hardly determine are left to the mean.
            if eigen.eigenvalues[axis] > 0.02 * most {
                let direction = eigen.eigenvectors.column(axis);
                point += direction * (direction.dot(&rest) / eigen.eigenvalues[axis]);
            }
        }
    }
    cluster.centre + point.map(|offset| offset.clamp(-0.5 * cell_m, 0.5 * cell_m))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of 1 m in the plane z = x / 2, of 50 x 50 x 2 triangles.
    fn ramp() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for y in 0..=50u32 {
            for x in 0..=50u32 {
                let (x, y) = (x as f32 / 50.0, y as f32 / 50.0);
                mesh.vertices.points.push([x, y, 0.5 * x + 0.1]);
                mesh.vertices.colors.push([100, 50, 25]);
            }
        }
        for y in 0..50 {
            for x in 0..50 {
                let corner = y * 51 + x;
                mesh.triangles.push([corner, corner + 1, corner + 52]);
                mesh.triangles.push([corner, corner + 52, corner + 51]);
            }
        }
        mesh
    }

    #[test]
    fn a_plane_stays_a_plane_with_fewer_triangles() {
        let coarse = decimate(&ramp(), 0.1).unwrap();
        coarse.check().unwrap();
        assert!(coarse.triangles.len() < 600 && coarse.triangles.len() > 100, "{}", coarse.triangles.len());
        for point in &coarse.vertices.points {
            assert!((point[2] - 0.5 * point[0] - 0.1).abs() < 1e-5, "{point:?}");
        }
        assert!(coarse.vertices.normals.iter().all(|normal| normal[2] > 0.85), "all face upwards");
        assert!(coarse.vertices.colors.iter().all(|color| *color == [100, 50, 25]));
    }

    #[test]
    fn a_thin_wall_keeps_its_two_sides() {
        let mut wall = ramp();
        let other = ramp();
        let count = wall.vertices.len() as u32;
        wall.vertices.points.extend(other.vertices.points.iter().map(|[x, y, z]| [*x, *y, z - 0.02]));
        wall.vertices.colors.extend(other.vertices.colors);
        wall.triangles.extend(other.triangles.iter().map(|[a, b, c]| [a + count, c + count, b + count]));
        let coarse = decimate(&wall, 0.1).unwrap();
        let upper = coarse.vertices.points.iter().filter(|[x, _, z]| (z - 0.5 * x - 0.1).abs() < 0.005).count();
        let lower = coarse.vertices.points.iter().filter(|[x, _, z]| (z - 0.5 * x - 0.08).abs() < 0.005).count();
        assert_eq!(upper + lower, coarse.vertices.len());
        assert!(upper.abs_diff(lower) < coarse.vertices.len() / 5, "{upper} {lower}");
    }

    #[test]
    fn bad_cells_are_refused() {
        assert!(matches!(decimate(&ramp(), 0.0), Err(Error::Option { option: "cell_m", .. })));
        assert!(matches!(decimate(&ramp(), 1e-9), Err(Error::OutOfRange { .. })));
        assert!(decimate(&TriangleMesh::default(), 0.1).unwrap().triangles.is_empty());
    }
}
