//! What the examples that measure against the truth share: the true cameras, the true surface, and robust summaries.

#![allow(dead_code)] // Each example uses its part.

use nalgebra::Vector3;
use skclam::dataset::Dataset;
use skclam::geometry::{Isometry3, PinholeCamera, Pixel, Point3};
use skclam::mapping::read_ply;
use skclam::rig::Rig;
use skclam::simulation::{Model, RayCaster, Triangle};
use skclam::trajectory::read_trajectory;
use std::error::Error;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// The farthest surface that is looked for, in units of a ray whose z is 1, m.
const FARTHEST_M: f64 = 30.0;

/// `truth/` of a dataset.
pub struct Truth {
    pub rig: Rig,
    /// One per posture.
    pub base_from_color: Vec<Isometry3>,
    caster: RayCaster,
    /// Unit normals in base, one per triangle.
    normals: Vec<Vector3<f64>>,
}

/// The true surface where a ray meets it, in the frame of the camera.
#[derive(Debug, Clone, Copy)]
pub struct Surface {
    pub z_m: f64,
    /// Unit normal; its sign is not defined.
    pub normal: Vector3<f64>,
    /// Where the ray points: z = 1.
    ray: Vector3<f64>,
}

impl Surface {
    /// z-depth at which the plane of this surface meets another ray (z = 1), m.
    pub fn plane_z_m(&self, ray: &Vector3<f64>) -> f64 {
        self.z_m * self.normal.dot(&self.ray) / self.normal.dot(ray)
    }

    /// Cosine between the ray and the normal: 1 where the surface is seen head on.
    pub fn incidence(&self) -> f64 {
        (self.normal.dot(&self.ray) / self.ray.norm()).abs()
    }
}

/// How the surface around a pixel departs from the plane at the pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surroundings {
    /// Radius of the smallest ring on which the surface leaves the plane, px; infinite where none does.
    pub radius_px: f64,
    /// Whether what is there is nearer to the camera than the plane (else farther).
    pub nearer: bool,
}

impl Truth {
    pub fn read(folder: &Path) -> Result<Self, Box<dyn Error>> {
        let rig = Rig::read(folder.join("truth/rig.toml"))?;
        let stamped = read_trajectory(&folder.join("truth/trajectory.txt"))?;
        let mesh = read_ply(BufReader::new(File::open(folder.join("truth/scene.ply"))?))?;
        let vertices: Vec<Point3> = mesh.points().points.iter().map(|p| Point3::from(p.map(f64::from))).collect();
        let triangles = mesh.triangles().iter().map(|&vertices| Triangle { vertices, face: 0 }).collect();
        let model = Model { vertices, triangles, ..Model::default() };
        let normals = model.triangles.iter().map(|triangle| {
            let [a, b, c] = model.corners(triangle);
            (b - a).cross(&(c - a)).normalize()
        });
        Ok(Truth {
            rig,
            base_from_color: stamped.iter().map(|stamped| stamped.base_from_camera).collect(),
            caster: RayCaster::new(&model),
            normals: normals.collect(),
        })
    }

    /// What a camera sees along a ray of its own frame (z = 1).
    pub fn along(&self, base_from_camera: &Isometry3, ray: &Vector3<f64>) -> Option<Surface> {
        let eye = Point3::from(base_from_camera.translation.vector);
        let hit = self.caster.first_hit(&eye, &(base_from_camera.rotation * ray), FARTHEST_M)?;
        let normal = base_from_camera.rotation.inverse() * self.normals[hit.triangle as usize];
        Some(Surface { z_m: hit.distance, normal, ray: *ray })
    }

    /// What the colour camera of a posture sees at a pixel.
    pub fn at(&self, posture: usize, pixel: &Pixel) -> Option<Surface> {
        self.along(&self.base_from_color[posture], &self.rig.color.unproject(pixel))
    }

    /// Looks around a pixel on rings of growing radius for what is not on the plane seen at the pixel, by more than
    /// `tolerance` of the depth.
    pub fn surroundings(&self, posture: usize, pixel: &Pixel, tolerance: f64) -> Option<Surroundings> {
        const RADII_PX: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];
        const DIRECTIONS: u32 = 8;
        let here = self.at(posture, pixel)?;
        for radius_px in RADII_PX {
            for k in 0..DIRECTIONS {
                let angle = std::f64::consts::TAU * f64::from(k) / f64::from(DIRECTIONS);
                let there = Pixel::new(pixel.x + radius_px * angle.cos(), pixel.y + radius_px * angle.sin());
                let ray = self.rig.color.unproject(&there);
                let Some(found) = self.along(&self.base_from_color[posture], &ray) else {
                    return Some(Surroundings { radius_px, nearer: false });
                };
                let off = found.z_m - here.plane_z_m(&ray);
                if off.abs() > tolerance * here.z_m {
                    return Some(Surroundings { radius_px, nearer: off < 0.0 });
                }
            }
        }
        Some(Surroundings { radius_px: f64::INFINITY, nearer: false })
    }
}

/// The dataset named on the command line, else `virtual-cell` of the shared data.
pub fn dataset() -> Result<(PathBuf, Dataset), Box<dyn Error>> {
    let shared = std::env::var_os("SKCLAM_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    let folder = std::env::args().nth(1).map_or_else(|| shared.join("virtual-cell"), PathBuf::from);
    let dataset = Dataset::open(&folder)?;
    Ok((folder, dataset))
}

/// The point nearest to rays of pixels with covariances, by Gauss-Newton on the reprojection; `None` where it does not
/// settle before all cameras.
pub fn triangulate(
    camera: &PinholeCamera,
    seen: &[(Isometry3, Pixel, nalgebra::Matrix2<f64>)],
    start: &Point3,
) -> Option<(Point3, nalgebra::Matrix3<f64>)> {
    let mut point = *start;
    for _ in 0..10 {
        let mut normal = nalgebra::Matrix3::zeros();
        let mut right = Vector3::zeros();
        for (base_from_camera, pixel, covariance) in seen {
            let in_camera = base_from_camera.inverse() * point;
            let (projected, by_point) = camera.project_with_point_jacobian(&in_camera)?;
            let by_base = by_point * base_from_camera.rotation.to_rotation_matrix().matrix().transpose();
            let weighted = by_base.transpose() * covariance.try_inverse()?;
            normal += weighted * by_base;
            right += weighted * (pixel - projected);
        }
        let step = normal.try_inverse()? * right;
        point += step;
        if step.norm() < 1e-9 {
            return Some((point, normal.try_inverse()?));
        }
    }
    None
}

/// Count, mean, median and standard deviation of numbers; the mean and the deviation without what lies beyond `gate`.
pub fn summary(values: &[f64], gate: f64) -> String {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let Some(&median) = sorted.get(sorted.len() / 2) else { return "-".to_owned() };
    let kept: Vec<f64> = values.iter().copied().filter(|value| value.abs() <= gate).collect();
    let count = kept.len().max(1) as f64;
    let mean = kept.iter().sum::<f64>() / count;
    let sigma = (kept.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt();
    let out = 1.0 - kept.len() as f64 / values.len() as f64;
    format!(
        "{:>7} {mean:>9.4} +- {:<7.4} {median:>9.4} {sigma:>8.4} {:>6.2} %",
        values.len(),
        sigma / count.sqrt(),
        100.0 * out
    )
}
