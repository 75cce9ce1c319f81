//! The robot's own body, taken out of the depth images: the URDF's collision shapes at each posture.

use super::DatasetError;
use skclam_files::{Kind, inside};
use skclam_geometry::{DepthCamera, DepthImage};
use skclam_kinematics::{CollisionModel, CollisionShape};
use skclam_mapping::{Body, BodyShape, Model, SurfaceIndex, TriangleMesh, read_stl, without_bodies};
use skclam_rig::{Posture, PostureState, Rig};
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// How the robot's body is taken out.
#[derive(Debug, Clone)]
pub struct SelfFilterOptions {
    /// The link whose frame is the rig's base; `None`: the URDF's root.
    pub base_link: Option<String>,
    /// Points this near to a shape are taken for the robot: what pose, depth and cables leave uncertain. Metres.
    pub margin_m: f64,
}

impl Default for SelfFilterOptions {
    fn default() -> Self {
        SelfFilterOptions { base_link: None, margin_m: 0.02 }
    }
}

/// Collision shapes that are placed anew for each image.
#[derive(Debug, Clone)]
pub struct SelfFilter {
    model: CollisionModel,
    /// One for each of the model's shapes; `None` where its mesh could not be had.
    shapes: Vec<Option<BodyShape>>,
    left_out: Vec<String>,
    margin_m: f64,
    urdf: PathBuf,
}

impl SelfFilter {
    /// Reads a URDF and the STL files it names (`package://name/...` is looked for in the URDF's folder and in those
    /// above it).
    ///
    /// # Errors
    /// A URDF that is none, one without any usable shape, or one that lacks a joint of the rig's arm.
    pub fn read(urdf: impl AsRef<Path>, rig: &Rig, options: SelfFilterOptions) -> Result<Self, DatasetError> {
        let path = urdf.as_ref();
        let wrong = |problem: String| DatasetError::SelfFilter { path: path.to_owned(), problem };
        let text = skclam_files::read_text(path, Kind::RobotDescription)
            .map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
        let model =
            CollisionModel::from_urdf(&text, options.base_link.as_deref()).map_err(|error| wrong(error.to_string()))?;
        let Some(robot) = &rig.robot else {
            return Err(wrong("the rig has no arm, so nobody knows where its body is; a [robot] is needed".to_owned()));
        };
        let known = model.joints();
        let missing: Vec<&str> =
            robot.joints().iter().map(|joint| joint.name.as_str()).filter(|name| !known.contains(name)).collect();
        // A joint after which no link has a shape moves nothing; a rig whose names are all others is another robot's.
        if !missing.is_empty() && missing.len() == robot.joint_count() {
            let (first, has) = (missing[0], known.iter().copied().collect::<Vec<_>>().join(", "));
            return Err(wrong(format!(
                "its joints that move a shape ({has}) do not bear the names of the rig's ({first}, ...)"
            )));
        }
        let mut left_out = Vec::new();
        let mut shapes = Vec::new();
        for body in model.bodies() {
            let shape = match &body.shape {
                CollisionShape::Box { edges_m } => {
                    Ok(BodyShape::Cuboid { half_edges_m: edges_m.map(|edge| 0.5 * edge) })
                }
                CollisionShape::Cylinder { radius_m, length_m } => {
                    Ok(BodyShape::Cylinder { radius_m: *radius_m, half_length_m: 0.5 * length_m })
                }
                CollisionShape::Sphere { radius_m } => Ok(BodyShape::Sphere { radius_m: *radius_m }),
                CollisionShape::Mesh { file, scale } => mesh(path, file, *scale),
            };
            match shape {
                Ok(shape) => shapes.push(Some(shape)),
                Err(problem) => {
                    left_out.push(format!("link '{}': {problem}", body.link));
                    shapes.push(None);
                }
            }
        }
        if shapes.iter().all(Option::is_none) {
            let why = left_out.first().map_or("no link has a <collision>", String::as_str);
            return Err(wrong(format!("it has no usable collision geometry: {why}")));
        }
        Ok(SelfFilter { model, shapes, left_out, margin_m: options.margin_m, urdf: path.to_owned() })
    }

    /// Shapes that could not be used, each with the reason.
    pub fn left_out(&self) -> &[String] {
        &self.left_out
    }

    /// A depth image without the robot's body.
    ///
    /// # Errors
    /// A posture without joint values, or options that make no sense.
    pub fn apply(
        &self,
        depth: &DepthImage,
        camera: &DepthCamera,
        rig: &Rig,
        posture: &Posture,
    ) -> Result<DepthImage, DatasetError> {
        let wrong = |problem: String| DatasetError::SelfFilter { path: self.urdf.clone(), problem };
        let (PostureState::Joints(values), Some(robot)) = (&posture.state, &rig.robot) else {
            let index = posture.index;
            return Err(wrong(format!("posture {index} has no joint values, so nobody knows where the arm's body is")));
        };
        let color_from_base = rig.base_from_color(posture).map_err(|error| wrong(error.to_string()))?.inverse();
        let value_of = |name: &str| {
            robot.joints().iter().position(|joint| joint.name == name).and_then(|at| values.get(at).copied())
        };
        let poses = self.model.base_from_shapes(value_of);
        let bodies: Vec<Body> = poses
            .iter()
            .zip(&self.shapes)
            .filter_map(|(pose, shape)| Some(Body { color_from_body: color_from_base * pose, shape: shape.clone()? }))
            .collect();
        without_bodies(depth, camera, &bodies, self.margin_m).map_err(|error| wrong(error.to_string()))
    }
}

fn mesh(urdf: &Path, name: &str, scale: [f64; 3]) -> Result<BodyShape, String> {
    let is_stl = Path::new(name).extension().is_some_and(|ending| ending.eq_ignore_ascii_case("stl"));
    if !is_stl {
        return Err(format!("{name}: only STL meshes are read"));
    }
    let path = find(urdf, name).map_err(|error| format!("{name}: {error}"))?;
    let file = skclam_files::open(&path, Kind::Mesh).map_err(|error| format!("{}: {error}", path.display()))?;
    let mut mesh: TriangleMesh =
        read_stl(BufReader::new(file)).map_err(|error| format!("{}: {error}", path.display()))?;
    let mut radius_m = 0f64;
    for point in &mut mesh.vertices.points {
        for (value, factor) in point.iter_mut().zip(scale) {
            *value = (f64::from(*value) * factor) as f32;
        }
        radius_m = radius_m.max(point.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt());
    }
    let surface = SurfaceIndex::new(&Model::Mesh(mesh)).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(BodyShape::Mesh { surface: Arc::new(surface), radius_m })
}

/// A mesh by its name in the URDF. Plain names and `file://` stay in the URDF's folder. `package://p/rest` is
/// `p/rest` or `rest` in that folder; in a folder above it that is called `p` or is a ROS package (`package.xml`),
/// `rest`; and beside such folders `rest` in a package `p`. Nothing else outside of the folder is opened, whatever
/// the URDF names.
fn find(urdf: &Path, name: &str) -> io::Result<PathBuf> {
    let folder = match urdf.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let Some(in_package) = name.strip_prefix("package://") else {
        return inside(folder, name.strip_prefix("file://").unwrap_or(name));
    };
    let (package, rest) = in_package.split_once('/').unwrap_or(("", in_package));
    let beside = inside(folder, in_package).or_else(|_| inside(folder, rest));
    let real = folder.canonicalize()?;
    let is_package = |folder: &Path| folder.join("package.xml").is_file();
    let roots = real.ancestors().flat_map(|above| {
        let is_named = above.file_name().is_some_and(|name| name == package);
        let sibling = Some(above.join(package))
            .filter(|folder| skclam_files::is_inside(Path::new(package)) && is_package(folder));
        [Some(above.to_owned()).filter(|above| is_named || is_package(above)), sibling]
    });
    let mut above = roots.flatten().filter_map(|root| inside(root, rest).ok());
    beside.or_else(|error| above.next().ok_or(error))
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_geometry::{Isometry3, PinholeCamera};
    use skclam_mapping::TriangleMesh as Mesh;
    use std::fs::File;

    /// One turning joint, a camera 0.3 m above it that looks along the arm, and a gripper's ball and plate in its view.
    const URDF: &str = r#"<robot name="one"><link name="base"/><link name="arm">
      <collision><origin xyz="0.5 0 0.3"/><geometry><sphere radius="0.05"/></geometry></collision>
      <collision><origin xyz="0.6 0 0.3"/><geometry><mesh filename="package://one/plate.stl"/></geometry></collision>
      <collision><geometry><mesh filename="package://one/gone.dae"/></geometry></collision></link>
      <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/></joint></robot>"#;

    #[test]
    fn the_arm_is_taken_out_wherever_it_turns_and_the_wall_stays() {
        let folder = tempfile::tempdir().unwrap();
        let urdf = folder.path().join("one.urdf");
        std::fs::write(&urdf, URDF).unwrap();
        let vertices = skclam_mapping::PointCloud {
            points: vec![[0.0, 0.1, -0.1], [0.0, 0.2, -0.1], [0.0, 0.2, 0.1], [0.0, 0.1, 0.1]],
            ..Default::default()
        };
        let plate = Mesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] };
        skclam_mapping::write_stl(&plate, File::create(folder.path().join("plate.stl")).unwrap()).unwrap();
        let mut rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let robot = skclam_kinematics::chain_from_urdf(URDF, "base", "arm").unwrap();
        rig.robot = Some(robot);
        // z of the camera is x of the arm.
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(
            0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0,
        ));
        rig.flange_from_color = Isometry3::from_parts(
            nalgebra::Translation3::new(0.0, 0.0, 0.3),
            nalgebra::UnitQuaternion::from_rotation_matrix(&rotation),
        );
        let camera = DepthCamera {
            camera: PinholeCamera::from_hfov(160, 120, 1.2),
            unit_m: 1e-3,
            offset_m: 0.0,
            color_from_depth: Isometry3::identity(),
        };
        rig.depth = Some(camera);
        let filter = SelfFilter::read(&urdf, &rig, SelfFilterOptions::default()).unwrap();
        assert_eq!(filter.left_out().len(), 1);
        assert!(filter.left_out()[0].contains("gone.dae"));
        // What the camera sees of ball and plate before a wall at 1 m.
        let seen: Vec<f32> = (0..160 * 120)
            .map(|i| {
                let ray = camera.camera.unproject(&skclam_geometry::Pixel::new(f64::from(i % 160), f64::from(i / 160)));
                let middle = 0.5 * ray.z;
                let discriminant = middle * middle - ray.norm_squared() * (0.25 - 0.05f64.powi(2));
                let on_plate = ray * 0.6;
                if discriminant >= 0.0 {
                    ((middle - discriminant.sqrt()) / ray.norm_squared()) as f32
                } else if (-0.2..=-0.1).contains(&on_plate.x) && on_plate.y.abs() <= 0.1 {
                    0.6
                } else {
                    1.0
                }
            })
            .collect();
        let body = seen.iter().filter(|z| **z < 0.9).count();
        assert!(body > 500);
        let depth = DepthImage::new(160, 120, seen.clone()).unwrap();
        for turn in [0.0, 1.0, -2.5] {
            let posture = Posture::new(0, PostureState::Joints(vec![turn]));
            let kept = filter.apply(&depth, &camera, &rig, &posture).unwrap();
            let as_wished =
                kept.as_slice().iter().zip(&seen).all(|(kept, seen)| *kept == if *seen < 0.9 { 0.0 } else { *seen });
            assert!(as_wished, "turned by {turn}");
        }
    }

    #[test]
    fn a_urdf_of_another_robot_or_without_shapes_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let urdf = folder.path().join("one.urdf");
        let rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let refusal = |text: &str| {
            std::fs::write(&urdf, text).unwrap();
            SelfFilter::read(&urdf, &rig, SelfFilterOptions::default()).unwrap_err().to_string()
        };
        assert!(refusal(URDF).contains("turn"));
        assert!(refusal(r#"<robot name="x"><link name="base"/></robot>"#).contains("do not bear the names"));
        assert!(refusal("<robot").contains("XML"));
    }
}
