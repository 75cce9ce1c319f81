//! Where an image is taken from: a pose with a perspective or a parallel projection, and views that frame a map.

use crate::{Error, Model};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, PinholeCamera, Point3};

/// Largest edge of an image, pixels.
const LARGEST_EDGE: u32 = 8192;

/// How space becomes an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projection {
    /// Through a pinhole.
    Perspective {
        /// Horizontal field of view, radians.
        hfov: f64,
    },
    /// Along parallel rays.
    Orthographic {
        /// Height of what the image shows, metres.
        height_m: f64,
    },
}

/// A viewer: axes x right, y down, z forward, as of any camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderCamera {
    /// Columns of the image.
    pub width: u32,
    /// Rows of the image.
    pub height: u32,
    /// How space becomes an image.
    pub projection: Projection,
    /// The viewer's pose.
    pub base_from_eye: Isometry3,
}

/// Views that frame a whole map; the base's x axis points forward, y left, z up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ViewPreset {
    /// Against the x axis: what is in front of the robot is nearest.
    Front,
    /// Along the x axis, from behind the robot.
    Back,
    /// Against the y axis.
    Left,
    /// Along the y axis.
    Right,
    /// From above, x up in the image.
    Top,
    /// From above, the left and the front, parallel projection.
    Isometric,
    /// As isometric, in perspective.
    Perspective,
}

impl RenderCamera {
    /// The image that a camera takes at a pose, without its distortion and off-centre principal point.
    pub fn from_camera(camera: &PinholeCamera, base_from_camera: Isometry3) -> Self {
        RenderCamera {
            width: camera.width,
            height: camera.height,
            projection: Projection::Perspective { hfov: camera.hfov() },
            base_from_eye: base_from_camera,
        }
    }

    /// A viewer at `eye` who looks at `target`, the base's z axis upwards in the image.
    pub fn looking_at(eye: Point3, target: Point3, projection: Projection, width: u32, height: u32) -> Self {
        let forward = (target - eye).try_normalize(1e-12).unwrap_or(-Vector3::z());
        // Straight up or down there is no "up": the base's x axis takes its place.
        let up = if forward.z.abs() > 1.0 - 1e-9 { Vector3::x() } else { Vector3::z() };
        let right = forward.cross(&up).normalize();
        let down = forward.cross(&right);
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
        RenderCamera {
            width,
            height,
            projection,
            base_from_eye: Isometry3::from_parts(eye.coords.into(), UnitQuaternion::from_rotation_matrix(&rotation)),
        }
    }

    /// A view that frames a map; the outermost percent of its points on each side may be cut off, so that a few stray
    /// points do not make the rest tiny.
    pub fn framing(model: &Model, preset: ViewPreset, width: u32, height: u32) -> Self {
        let (low, high) = trimmed_bounds(&model.points().points);
        let centre = nalgebra::center(&low, &high);
        let radius = 0.5 * (high - low).norm().max(1e-3);
        let from = match preset {
            ViewPreset::Front => Vector3::x(),
            ViewPreset::Back => -Vector3::x(),
            ViewPreset::Left => Vector3::y(),
            ViewPreset::Right => -Vector3::y(),
            ViewPreset::Top => Vector3::z(),
            ViewPreset::Isometric | ViewPreset::Perspective => Vector3::new(1.0, 0.7, 0.75).normalize(),
        };
        let at =
            |distance: f64, projection| Self::looking_at(centre + from * distance, centre, projection, width, height);
        // The eight corners of the box as the viewer sees them decide how much must fit.
        let corners = (0..8).map(|corner: usize| {
            let pick = |axis: usize| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] };
            Point3::new(pick(0), pick(1), pick(2))
        });
        let aspect = f64::from(width.max(1)) / f64::from(height.max(1));
        const MARGIN: f64 = 1.04;
        if preset == ViewPreset::Perspective {
            let hfov = 0.8f64;
            let vertical = ((0.5 * hfov).tan() / aspect).atan();
            let distance = radius / (0.5 * hfov).min(vertical).sin();
            return at(distance * 0.85, Projection::Perspective { hfov });
        }
        let mut viewer = at(2.0 * radius + 1.0, Projection::Orthographic { height_m: 1.0 });
        let (mut half_width, mut half_height) = (0f64, 0f64);
        for corner in corners {
            let seen = viewer.base_from_eye.inverse_transform_point(&corner);
            half_width = half_width.max(seen.x.abs());
            half_height = half_height.max(seen.y.abs());
        }
        viewer.projection =
            Projection::Orthographic { height_m: 2.0 * MARGIN * half_height.max(half_width / aspect).max(1e-6) };
        viewer
    }

    pub(crate) fn check(&self) -> Result<(), Error> {
        let edges = 1..=LARGEST_EDGE;
        if !edges.contains(&self.width) || !edges.contains(&self.height) {
            return Err(Error::Option {
                option: "width, height",
                value: format!("{} x {}", self.width, self.height),
                need: "1 to 8192 pixels are needed",
            });
        }
        let (what, value, good) = match self.projection {
            Projection::Perspective { hfov } => ("hfov", hfov, hfov > 1e-3 && hfov < 3.1),
            Projection::Orthographic { height_m } => ("height_m", height_m, height_m > 1e-6 && height_m < 1e6),
        };
        if !good {
            let need = "a field of view between 0.001 and 3.1 rad, or a height between 1e-6 and 1e6 m";
            return Err(Error::BadNumber { what, value: value.to_string(), need });
        }
        let mut numbers = self.base_from_eye.translation.vector.iter().chain(self.base_from_eye.rotation.coords.iter());
        match numbers.find(|value| !value.is_finite()) {
            Some(bad) => {
                Err(Error::BadNumber { what: "the viewer's pose", value: bad.to_string(), need: "a finite number" })
            }
            None => Ok(()),
        }
    }

    pub(super) fn supersampled(&self, factor: u32) -> Self {
        RenderCamera { width: self.width * factor, height: self.height * factor, ..*self }
    }

    /// Pixels a metre: at 1 m in perspective, everywhere in parallel projection.
    pub(super) fn pixels_per_metre(&self) -> f64 {
        match self.projection {
            Projection::Perspective { hfov } => 0.5 * f64::from(self.width) / (0.5 * hfov).tan(),
            Projection::Orthographic { height_m } => f64::from(self.height) / height_m,
        }
    }
}

fn trimmed_bounds(points: &[[f32; 3]]) -> (Point3, Point3) {
    // A regular sample of the points is enough to know where most of them are.
    let stride = points.len().div_ceil(50_000).max(1);
    let (mut low, mut high) = (Point3::origin(), Point3::origin());
    for axis in 0..3 {
        let mut values: Vec<f32> = points.iter().step_by(stride).map(|point| point[axis]).collect();
        if values.is_empty() {
            break;
        }
        values.sort_unstable_by(f32::total_cmp);
        let trim = values.len() / 100;
        low[axis] = f64::from(values[trim]);
        high[axis] = f64::from(values[values.len() - 1 - trim]);
    }
    (low, high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::PointCloud;

    #[test]
    fn from_above_the_base_x_axis_points_up_in_the_image_and_y_left() {
        let projection = Projection::Orthographic { height_m: 2.0 };
        let camera = RenderCamera::looking_at(Point3::new(0.0, 0.0, 3.0), Point3::origin(), projection, 10, 10);
        let seen = camera.base_from_eye.inverse_transform_point(&Point3::new(1.0, 0.5, 0.0));
        assert!((seen - Point3::new(-0.5, -1.0, 3.0)).norm() < 1e-12, "{seen}");
    }

    #[test]
    fn every_preset_has_the_map_in_its_image() {
        let points =
            (0..1000).map(|i| [2.0 + (i % 10) as f32 * 0.1, (i / 10 % 10) as f32 * 0.2, (i / 100) as f32 * 0.05]);
        let model: Model = PointCloud { points: points.collect(), ..Default::default() }.into();
        use ViewPreset::*;
        for preset in [Front, Back, Left, Right, Top, Isometric, Perspective] {
            let camera = RenderCamera::framing(&model, preset, 300, 200);
            camera.check().unwrap();
            let scale = camera.pixels_per_metre();
            for point in &model.points().points {
                let seen = camera.base_from_eye.inverse_transform_point(&Point3::from(point.map(f64::from)));
                assert!(seen.z > 0.0, "{preset:?}");
                let scale = if preset == Perspective { scale / seen.z } else { scale };
                assert!((seen.x * scale).abs() <= 160.0 && (seen.y * scale).abs() <= 110.0, "{preset:?} {seen}");
            }
        }
    }

    #[test]
    fn an_empty_map_can_be_framed() {
        RenderCamera::framing(&PointCloud::default().into(), ViewPreset::Top, 10, 10).check().unwrap();
    }
}
