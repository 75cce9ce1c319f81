//! Removes small disconnected pieces of a mesh: what noise leaves floating.

use super::extract::drop_unused_vertices;
use crate::TriangleMesh;

/// Removes connected pieces of fewer than `min_triangles` triangles and the vertices that only they used.
pub fn remove_small_clusters(mesh: &mut TriangleMesh, min_triangles: usize) {
    if min_triangles <= 1 {
        return;
    }
    // Union-find over vertices; a root is the smallest vertex of its piece.
    let mut parent: Vec<u32> = (0..mesh.vertices.len() as u32).collect();
    fn root(parent: &mut [u32], mut vertex: u32) -> u32 {
        while parent[vertex as usize] != vertex {
            parent[vertex as usize] = parent[parent[vertex as usize] as usize];
            vertex = parent[vertex as usize];
        }
        vertex
    }
    for [a, b, c] in &mesh.triangles {
        for other in [b, c] {
            let (one, two) = (root(&mut parent, *a), root(&mut parent, *other));
            parent[one.max(two) as usize] = one.min(two);
        }
    }
    let mut size = vec![0usize; mesh.vertices.len()];
    for triangle in &mesh.triangles {
        size[root(&mut parent, triangle[0]) as usize] += 1;
    }
    mesh.triangles.retain(|triangle| size[root(&mut parent, triangle[0]) as usize] >= min_triangles);
    drop_unused_vertices(mesh);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PointCloud;

    #[test]
    fn small_pieces_and_their_vertices_go() {
        let points = (0..8).map(|i| [i as f32, (i * i) as f32, 0.0]).collect();
        let colors = (0..8).map(|i| [i as u8; 3]).collect();
        let vertices = PointCloud { points, colors, ..Default::default() };
        let mut mesh = TriangleMesh { vertices, triangles: vec![[3, 4, 5], [0, 1, 2], [5, 4, 7]] };
        remove_small_clusters(&mut mesh, 2);
        assert_eq!(mesh.triangles, [[0, 1, 2], [2, 1, 3]]);
        assert_eq!(mesh.vertices.colors, [[3; 3], [4; 3], [5; 3], [7; 3]]);
        mesh.check().unwrap();
    }
}
