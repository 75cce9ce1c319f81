//! Known bodies in view, the arm and its gripper above all, kept out of the map.
//!
//! A pixel is dropped when its point lies in a body, or nearer to it than a margin that covers what is uncertain: the
//! pose, the noise of the depth, cables. This crate knows no robot: bodies come as shapes in the camera's frame.

use crate::rays::Rays;
use crate::{Error, SurfaceIndex};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use skclam_geometry::{DepthCamera, DepthImage, Isometry3};
use std::sync::Arc;

/// Margins beyond this hide more than a robot.
const WIDEST_MARGIN_M: f64 = 0.5;

/// A shape around its own origin, metres.
#[derive(Debug, Clone)]
pub enum BodyShape {
    /// A box with its centre at the origin.
    Cuboid {
        /// Half its edges along x, y and z.
        half_edges_m: [f64; 3],
    },
    /// A cylinder along z with its centre at the origin.
    Cylinder {
        /// Radius.
        radius_m: f64,
        /// Half its length.
        half_length_m: f64,
    },
    /// A ball.
    Sphere {
        /// Radius.
        radius_m: f64,
    },
    /// A surface; points within the margin of it count, whether inside or outside.
    Mesh {
        /// Its triangles, in the body's frame.
        surface: Arc<SurfaceIndex>,
        /// A ball around the origin that holds them.
        radius_m: f64,
    },
}

impl BodyShape {
    /// Distance of a point from the solid, 0 inside; of a mesh, from the surface. Exact up to `limit_m`, beyond it
    /// anything larger.
    fn distance(&self, point: &Vector3<f64>, limit_m: f64) -> f64 {
        match self {
            BodyShape::Cuboid { half_edges_m } => {
                let outside = Vector3::from_fn(|axis, _| (point[axis].abs() - half_edges_m[axis]).max(0.0));
                outside.norm()
            }
            BodyShape::Cylinder { radius_m, half_length_m } => {
                let across = (point.xy().norm() - radius_m).max(0.0);
                across.hypot((point.z.abs() - half_length_m).max(0.0))
            }
            BodyShape::Sphere { radius_m } => (point.norm() - radius_m).max(0.0),
            BodyShape::Mesh { surface, .. } => {
                surface.distance(point.cast::<f32>().into(), limit_m as f32).map_or(f64::INFINITY, f64::from)
            }
        }
    }

    /// Radius of a ball around the origin that holds the shape.
    fn radius_m(&self) -> f64 {
        match self {
            BodyShape::Cuboid { half_edges_m } => Vector3::from(*half_edges_m).norm(),
            BodyShape::Cylinder { radius_m, half_length_m } => radius_m.hypot(*half_length_m),
            BodyShape::Sphere { radius_m } | BodyShape::Mesh { radius_m, .. } => *radius_m,
        }
    }
}

/// A body at the moment of an image.
#[derive(Debug, Clone)]
pub struct Body {
    /// Its pose in the colour camera's frame.
    pub color_from_body: Isometry3,
    /// Its shape.
    pub shape: BodyShape,
}

/// The depth image without the pixels whose points lie in a body or within `margin_m` of one; they become 0.
///
/// # Errors
/// A size that is not the camera's, a margin that is not between 0 and 0.5 m, a shape or a pose with numbers that make
/// no sense.
pub fn without_bodies(
    depth: &DepthImage,
    camera: &DepthCamera,
    bodies: &[Body],
    margin_m: f64,
) -> Result<DepthImage, Error> {
    if !(0.0..=WIDEST_MARGIN_M).contains(&margin_m) {
        let need = "0 to 0.5 m are needed";
        return Err(Error::Option { option: "margin_m", value: margin_m.to_string(), need });
    }
    let (width, height) = (depth.width(), depth.height());
    if (width, height) != (camera.camera.width, camera.camera.height) {
        return Err(Error::ImageSize {
            what: "depth image",
            got_width: width,
            got_height: height,
            need_width: camera.camera.width,
            need_height: camera.camera.height,
        });
    }
    let depth_from_color = camera.color_from_depth.inverse();
    let mut placed = Vec::with_capacity(bodies.len());
    for body in bodies {
        let radius_m = body.shape.radius_m();
        let depth_from_body = depth_from_color * body.color_from_body;
        let centre = depth_from_body.translation.vector;
        if !(radius_m.is_finite() && radius_m >= 0.0 && centre.iter().all(|value| value.is_finite())) {
            let value = format!("a ball of {radius_m} m at {centre:?}");
            return Err(Error::BadNumber { what: "a body", value, need: "finite numbers and no negative size" });
        }
        // What lies behind the camera, ball and all, is not in the image.
        if centre.z + radius_m + margin_m > 0.0 {
            let reach = radius_m + margin_m;
            placed.push((depth_from_body.inverse(), Point3::from(centre), reach * reach, &body.shape));
        }
    }
    let mut kept = depth.as_slice().to_vec();
    if !placed.is_empty() {
        let rays = Rays::new(&camera.camera);
        kept.par_chunks_mut(width.max(1) as usize).enumerate().for_each(|(y, row)| {
            for (x, z) in row.iter_mut().enumerate().filter(|(_, z)| **z > 0.0) {
                let point = rays.point(y * width as usize + x, *z);
                let hit = placed.iter().any(|(body_from_depth, centre, reach_squared, shape)| {
                    (point - centre).norm_squared() <= *reach_squared
                        && shape.distance(&(body_from_depth * point).coords, margin_m.max(1e-6)) <= margin_m
                });
                if hit {
                    *z = 0.0;
                }
            }
        });
    }
    DepthImage::new(width, height, kept).map_err(|error| Error::Format { format: "depth", reason: error.to_string() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tsdf::tests::wall;
    use crate::view::tests::plain_camera;
    use crate::{Model, PointCloud, TriangleMesh};

    /// Pixels of a wall at 1 m that are dropped, as (column, row) from the middle of the image, metres on the wall.
    fn dropped(shape: BodyShape, margin_m: f64) -> Vec<(f64, f64)> {
        let mut camera = plain_camera(80, 60);
        camera.color_from_depth = Isometry3::translation(0.02, 0.0, 0.0);
        let depth = wall(80, 60, 1.0);
        // In front of the depth camera's middle.
        let body = Body { color_from_body: Isometry3::translation(0.02, 0.0, 1.0), shape };
        let kept = without_bodies(&depth, &camera, &[body], margin_m).unwrap();
        let metres = |index: usize, middle: f64, focal: f64| (index as f64 - middle) / focal;
        let (cx, cy, f) = (camera.camera.cx, camera.camera.cy, camera.camera.fx);
        let lost = kept.as_slice().iter().enumerate().filter(|(_, z)| **z == 0.0);
        lost.map(|(i, _)| (metres(i % 80, cx, f), metres(i / 80, cy, f))).collect()
    }

    #[test]
    fn what_a_shape_covers_on_a_wall_is_dropped_with_a_margin_and_nothing_else() {
        let sphere = dropped(BodyShape::Sphere { radius_m: 0.1 }, 0.02);
        assert!(sphere.len() > 100 && sphere.iter().all(|(x, y)| x.hypot(*y) <= 0.12 + 1e-6));
        assert!(sphere.iter().any(|(x, y)| x.hypot(*y) > 0.105), "the margin");
        let cuboid = dropped(BodyShape::Cuboid { half_edges_m: [0.2, 0.05, 0.1] }, 0.0);
        assert!(!cuboid.is_empty() && cuboid.iter().all(|(x, y)| x.abs() <= 0.2 + 1e-6 && y.abs() <= 0.05 + 1e-6));
        assert!(cuboid.iter().any(|(x, _)| x.abs() > 0.18));
        let cylinder = dropped(BodyShape::Cylinder { radius_m: 0.15, half_length_m: 0.3 }, 0.01);
        assert!(!cylinder.is_empty() && cylinder.iter().all(|(x, y)| x.hypot(*y) <= 0.16 + 1e-6));
        let vertices =
            PointCloud { points: vec![[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.1, 0.1, 0.0]], ..PointCloud::default() };
        let mesh = Model::Mesh(TriangleMesh { vertices, triangles: vec![[0, 1, 2]] });
        let surface = Arc::new(SurfaceIndex::new(&mesh).unwrap());
        let mesh = dropped(BodyShape::Mesh { surface, radius_m: 0.15 }, 0.005);
        assert!(!mesh.is_empty() && mesh.iter().all(|(x, y)| *x >= *y - 0.01), "one half of the square");
    }

    #[test]
    fn bodies_elsewhere_change_nothing_and_nonsense_is_refused() {
        let camera = plain_camera(20, 15);
        let depth = wall(20, 15, 1.0);
        let at = |z: f64, radius_m: f64| Body {
            color_from_body: Isometry3::translation(0.0, 0.0, z),
            shape: BodyShape::Sphere { radius_m },
        };
        for body in [at(0.5, 0.3), at(-0.2, 0.1), at(3.0, 0.5)] {
            assert_eq!(without_bodies(&depth, &camera, &[body], 0.02).unwrap().as_slice(), depth.as_slice());
        }
        assert!(without_bodies(&depth, &camera, &[at(f64::NAN, 0.1)], 0.02).is_err());
        assert!(without_bodies(&depth, &camera, &[at(1.0, f64::INFINITY)], 0.02).is_err());
        assert!(without_bodies(&depth, &camera, &[], f64::NAN).is_err());
        assert!(without_bodies(&wall(10, 10, 1.0), &camera, &[], 0.02).is_err());
    }
}
