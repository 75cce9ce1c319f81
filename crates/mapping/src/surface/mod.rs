//! From the distance field to triangles: marching cubes (Lorensen and Cline 1987) over the blocks of a [`Tsdf`].

mod clusters;
mod decimate;
mod extract;
mod table;
mod vertex_normals;

pub use clusters::remove_small_clusters;
pub use decimate::decimate;
pub use vertex_normals::vertex_normals;

use crate::{Error, TriangleMesh, Tsdf};
use serde::{Deserialize, Serialize};

/// Which parts of the field become surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceOptions {
    /// Voxels count that are known to this standard deviation at least, metres, if the noise of the images is
    /// independent: weights of one pixel at 1 m seen straight on add up to `(sigma(1 m) / max_sigma_m)^2`.
    pub max_sigma_m: f64,
    /// Connected pieces of fewer triangles are removed.
    pub min_cluster_triangles: usize,
}

impl Default for SurfaceOptions {
    fn default() -> Self {
        SurfaceOptions { max_sigma_m: 0.05, min_cluster_triangles: 60 }
    }
}

impl Tsdf {
    /// The surface as triangles with vertex normals and, where any view had colour, colours.
    pub fn surface(&self, options: &SurfaceOptions) -> Result<TriangleMesh, Error> {
        if !(options.max_sigma_m.is_finite() && options.max_sigma_m > 0.0) {
            return Err(Error::Option {
                option: "max_sigma_m",
                value: options.max_sigma_m.to_string(),
                need: "a positive length is needed",
            });
        }
        let sigma_at_1m = self.options().filter.noise.sigma(1.0);
        let min_weight = (sigma_at_1m / options.max_sigma_m).powi(2) as f32;
        let mut mesh = extract::marching_cubes(self, min_weight);
        remove_small_clusters(&mut mesh, options.min_cluster_triangles);
        mesh.vertices.normals = vertex_normals(&mesh);
        Ok(mesh)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::tests::{plain_camera, view};
    use crate::{TsdfOptions, View};
    use nalgebra::{Point3, Vector3};
    use skclam_geometry::{DepthCamera, DepthImage, Isometry3, Pixel};
    use std::collections::HashMap;

    const RADIUS: f64 = 0.2;

    /// A ball of 0.2 m at the origin as a camera at `base_from_depth` sees it.
    fn ball(camera: &DepthCamera, base_from_depth: &Isometry3) -> DepthImage {
        let (width, height) = (camera.camera.width, camera.camera.height);
        let centre = base_from_depth.inverse_transform_point(&Point3::origin()).coords;
        let depth = (0..width * height).map(|i| {
            let ray = camera.camera.unproject(&Pixel::new(f64::from(i % width), f64::from(i / width)));
            let (a, b) = (ray.norm_squared(), ray.dot(&centre));
            let discriminant = b * b - a * (centre.norm_squared() - RADIUS * RADIUS);
            if discriminant > 0.0 { ((b - discriminant.sqrt()) / a) as f32 } else { 0.0 }
        });
        DepthImage::new(width, height, depth.collect()).unwrap()
    }

    fn fused_ball(color: Option<&image::RgbImage>) -> Tsdf {
        let camera = plain_camera(200, 150);
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
        for direction in [Vector3::x(), -Vector3::x(), Vector3::y(), -Vector3::y(), Vector3::z(), -Vector3::z()] {
            let up = Vector3::new(direction.y, direction.z, direction.x);
            let eye = Point3::from(direction * 0.9);
            let base_from_color = Isometry3::look_at_rh(&eye, &Point3::origin(), &up).inverse()
                * Isometry3::from_parts(
                    nalgebra::Translation3::identity(),
                    nalgebra::UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI),
                );
            let depth = ball(&camera, &base_from_color);
            tsdf.integrate(&View { base_from_color, color, ..view(&depth, &camera) }).unwrap();
        }
        tsdf
    }

    #[test]
    fn a_ball_comes_out_round_closed_and_facing_outwards() {
        let mesh = fused_ball(None).surface(&SurfaceOptions::default()).unwrap();
        mesh.check().unwrap();
        assert!(mesh.vertices.colors.is_empty());
        let mut errors_m = 0.0;
        for (point, normal) in mesh.vertices.points.iter().zip(&mesh.vertices.normals) {
            let (point, normal) = (Vector3::from(*point).cast::<f64>(), Vector3::from(*normal).cast::<f64>());
            // Voxels of 10 mm on a curvature of 5/m; where all cameras graze it, it is worst.
            assert!((point.norm() - RADIUS).abs() < 0.004, "{}", point.norm());
            assert!(normal.dot(&point.normalize()) > 0.95);
            errors_m += (point.norm() - RADIUS).abs();
        }
        assert!(errors_m / (mesh.vertices.len() as f64) < 0.0006, "{}", errors_m / mesh.vertices.len() as f64);
        let mut edges: HashMap<(u32, u32), i32> = HashMap::new();
        for [a, b, c] in &mesh.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *edges.entry((*from.min(to), *from.max(to))).or_default() += if from < to { 1 } else { -1 };
            }
        }
        assert!(edges.values().all(|&balance| balance == 0), "every edge is used once each way: no holes");
        let euler = mesh.vertices.len() as i64 - edges.len() as i64 + mesh.triangles.len() as i64;
        assert_eq!(euler, 2, "one ball");
    }

    #[test]
    fn colours_reach_the_surface() {
        let color = image::RgbImage::from_pixel(200, 150, image::Rgb([200, 100, 50]));
        let mesh = fused_ball(Some(&color)).surface(&SurfaceOptions::default()).unwrap();
        assert_eq!(mesh.vertices.colors.len(), mesh.vertices.len());
        assert!(mesh.vertices.colors.iter().all(|c| c[0].abs_diff(200) <= 1 && c[2].abs_diff(50) <= 1));
    }

    #[test]
    fn small_pieces_go_and_an_empty_field_has_no_surface() {
        let tsdf = fused_ball(None);
        let all = tsdf.surface(&SurfaceOptions::default()).unwrap();
        let options = SurfaceOptions { min_cluster_triangles: all.triangles.len() + 1, ..Default::default() };
        assert_eq!(tsdf.surface(&options).unwrap(), TriangleMesh::default());
        let empty = Tsdf::new(TsdfOptions::default()).unwrap();
        assert!(empty.surface(&SurfaceOptions::default()).unwrap().triangles.is_empty());
        let bad = SurfaceOptions { max_sigma_m: 0.0, ..Default::default() };
        assert!(matches!(empty.surface(&bad), Err(Error::Option { .. })));
    }

    #[test]
    fn the_same_surface_on_any_number_of_threads() {
        let tsdf = fused_ball(None);
        let extract = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| tsdf.surface(&SurfaceOptions::default()).unwrap())
        };
        assert_eq!(extract(1), extract(4));
    }
}
