//! The arm's own body: tubes along the links and housings at the joints, placed by forward kinematics.
//!
//! A link is a product of elementary motions; every translation becomes a tube in the frame in which it happens,
//! every joint a short drum about its axis. That fits any convention and any number of joints.

use crate::SimulationError;
use crate::scene::{Builder, CuboidMaterials, Material, Model, TexelRule, light_on_moving};
use skclam_geometry::{Isometry3, Point3};
use skclam_kinematics::{ElementaryMotion, JointKind, SerialChain};
use skclam_rig::Rig;

/// The arm and the camera on it as things that can be drawn.
#[derive(Debug, Clone)]
pub struct ArmBody {
    chain: SerialChain,
    /// Geometry and the number of elementary motions before its frame; the last parts sit on the flange.
    parts: Vec<(usize, Model)>,
    textures: Model,
}

/// Translations shorter than this have no tube, metres.
const SHORTEST_M: f64 = 0.02;
const BLUE: [f32; 3] = [52.0, 96.0, 166.0];
const WHITE: [f32; 3] = [206.0, 208.0, 206.0];
const DARK: [f32; 3] = [58.0, 60.0, 64.0];

impl ArmBody {
    /// The body of a rig's arm. `texel_m`: size of a texel on it. Errors: no arm.
    pub fn new(rig: &Rig, seed: u64, texel_m: f64) -> Result<Self, SimulationError> {
        let chain = rig.robot.as_ref().ok_or(SimulationError::NoRobot)?.clone();
        let joints = chain.joint_count();
        let mut builder = Builder::new(TexelRule::Even(texel_m));
        let mut pieces = Vec::new();
        let mut piece = |frame: usize, builder: &mut Builder, draw: &dyn Fn(&mut Builder)| {
            let first = builder.model.faces.len();
            draw(builder);
            pieces.push((frame, first, builder.model.faces.len()));
        };
        for (index, joint) in chain.joints().iter().enumerate() {
            let fraction = index as f64 / joints.max(2).saturating_sub(1) as f64;
            let radius = 0.062 - 0.034 * fraction;
            for (motion_index, (_, motion)) in joint.link.motions(0.0, 0.0).into_iter().enumerate() {
                let frame = 4 * index + motion_index;
                let colour = if index % 2 == 0 { BLUE } else { WHITE };
                let along = match motion {
                    ElementaryMotion::TranslateX(length) if length.abs() > SHORTEST_M => {
                        Some(Point3::new(length, 0.0, 0.0))
                    }
                    ElementaryMotion::TranslateZ(length) if length.abs() > SHORTEST_M => {
                        Some(Point3::new(0.0, 0.0, length))
                    }
                    _ => None,
                };
                if let Some(end) = along {
                    let caps = [Some(Material::Plain(DARK)); 2];
                    piece(frame, &mut builder, &|b| {
                        b.cylinder(Point3::origin(), end, 0.8 * radius, Material::Lacquer(colour), caps)
                    });
                }
                if matches!(motion, ElementaryMotion::RotateZ(_)) && joint.kind == JointKind::Revolute {
                    let half = 1.15 * radius;
                    let ends = [Point3::new(0.0, 0.0, -half), Point3::new(0.0, 0.0, half)];
                    let caps = [Some(Material::Lacquer(DARK)); 2];
                    piece(frame, &mut builder, &|b| {
                        b.cylinder(ends[0], ends[1], radius, Material::Lacquer(DARK), caps)
                    });
                }
            }
        }
        // The camera behind its optical centre, and a bracket to the flange.
        let camera = rig.flange_from_color * Isometry3::translation(0.0, 0.0, -0.03);
        let dark = CuboidMaterials::all(Material::Plain(DARK));
        piece(4 * joints, &mut builder, &|b| b.cuboid(&camera, [0.1, 0.026, 0.022], &dark));
        let seat = camera * Point3::origin();
        if (seat - Point3::origin()).norm() > 0.01 {
            piece(4 * joints, &mut builder, &|b| {
                b.cylinder(Point3::origin(), seat, 0.01, Material::Steel, [None, None])
            });
        }
        let (textures, _) = builder.finish(seed, 500_000, false);
        let parts = pieces.into_iter().map(|(frame, first, end)| (frame, extract(&textures, first, end))).collect();
        Ok(ArmBody { chain, parts, textures })
    }

    /// The body at joint values (radians or metres), in base.
    pub fn model_at(&self, joint_values: &[f64]) -> Result<Model, SimulationError> {
        let base_from_flange = self.chain.base_from_flange(joint_values)?;
        let mut frames = Vec::with_capacity(4 * self.chain.joint_count() + 1);
        let mut pose = *self.chain.base_from_first();
        for (joint, &value) in self.chain.joints().iter().zip(joint_values) {
            let (angle, length) = match joint.kind {
                JointKind::Revolute => (value, 0.0),
                JointKind::Prismatic => (0.0, value),
            };
            for (_, motion) in joint.link.motions(angle, length) {
                frames.push(pose);
                pose *= motion.transform();
            }
        }
        frames.push(base_from_flange);
        let mut model = Model { textures: self.textures.textures.clone(), ..Model::default() };
        for (frame, part) in &self.parts {
            model.append_moved(part, &frames[*frame]);
        }
        for face in &mut model.faces {
            face.brightness = light_on_moving(&face.normal);
        }
        Ok(model)
    }

    /// Origins of base, of each link and of the flange: a polyline inside the body.
    pub fn skeleton(&self, joint_values: &[f64]) -> Result<Vec<Point3>, SimulationError> {
        let mut points = vec![self.chain.base_from_first() * Point3::origin()];
        for pose in self.chain.base_from_links(joint_values)? {
            points.push(pose * Point3::origin());
        }
        points.push(self.chain.base_from_flange(joint_values)? * Point3::origin());
        Ok(points)
    }
}

/// The faces `first..end` with their triangles as a model of their own.
fn extract(whole: &Model, first: usize, end: usize) -> Model {
    let mut part = Model::default();
    for face in first..end {
        let corners: Vec<_> = whole.triangles.iter().filter(|t| t.face as usize == face).collect();
        // A fan: its first vertex, then one new vertex a triangle, then the last.
        let mut polygon: Vec<Point3> = Vec::with_capacity(corners.len() + 2);
        for (index, triangle) in corners.iter().enumerate() {
            let [a, b, c] = whole.corners(triangle);
            if index == 0 {
                polygon.extend([a, b]);
            }
            polygon.push(c);
        }
        part.add_polygon(whole.faces[face], &polygon);
    }
    part
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_body_follows_forward_kinematics() {
        let rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let body = ArmBody::new(&rig, 1, 0.01).unwrap();
        let joints = [0.5, -0.3, 0.8, 1.0, -0.7, 0.2];
        let model = body.model_at(&joints).unwrap();
        let chain = rig.robot.as_ref().unwrap();
        // The camera's housing ends right behind the optical centre.
        let camera = chain.base_from_flange(&joints).unwrap() * rig.flange_from_color * Point3::origin();
        let nearest = model.vertices.iter().map(|vertex| (vertex - camera).norm()).fold(f64::INFINITY, f64::min);
        assert!((0.01..0.06).contains(&nearest), "{nearest}");
        for face in &model.faces {
            assert!((face.normal.norm() - 1.0).abs() < 1e-9 && face.s_axis.dot(&face.normal).abs() < 1e-6);
        }
        for triangle in &model.triangles {
            let [a, b, c] = model.corners(triangle);
            let face = &model.faces[triangle.face as usize];
            assert!((b - a).cross(&(c - a)).dot(&face.normal) > 0.0, "counter-clockwise from outside");
        }
        assert_eq!(body.skeleton(&joints).unwrap().len(), 8);
        let turned = body.model_at(&[0.6, -0.3, 0.8, 1.0, -0.7, 0.2]).unwrap();
        let turn = nalgebra::UnitQuaternion::from_axis_angle(&nalgebra::Vector3::z_axis(), 0.1);
        for (a, b) in model.vertices.iter().zip(&turned.vertices).skip(model.vertices.len() / 2) {
            assert!((turn * a - b).norm() < 1e-9, "joint 1 turns all beyond it");
        }
        assert!(body.model_at(&[0.0]).is_err());
    }
}
