//! Files that other tools read: OBJ, GLB and STL of a mesh, PCD of a cloud.

mod glb;
mod obj;
mod pcd;
mod stl;

pub use glb::write_glb;
pub use obj::write_obj;
pub use pcd::write_pcd;
pub use stl::{read_stl, write_stl};

#[cfg(test)]
mod tests {
    use crate::{PointCloud, TriangleMesh};

    /// Two triangles with everything.
    pub(super) fn square() -> TriangleMesh {
        let vertices = PointCloud {
            points: vec![[0.0, 0.0, 0.5], [1.0, 0.0, 0.5], [1.0, 1.0, 0.5], [0.0, 1.0, 0.5]],
            colors: vec![[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]],
            normals: vec![[0.0, 0.0, 1.0]; 4],
        };
        TriangleMesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }
    }
}
