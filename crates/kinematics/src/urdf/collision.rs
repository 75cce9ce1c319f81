//! The collision geometry of a URDF: which shapes hang on which link, and where they are at given joint values.

use super::document::{Document, UrdfJoint, refuse};
use crate::chain::JointKind;
use crate::{Isometry3, KinematicsError};
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use roxmltree::Node;
use std::collections::BTreeSet;

/// A shape around its own origin, metres; a cylinder's axis is z.
#[derive(Debug, Clone, PartialEq)]
pub enum CollisionShape {
    /// A box with these edges.
    Box {
        /// Along x, y and z.
        edges_m: [f64; 3],
    },
    /// A cylinder.
    Cylinder {
        /// Radius.
        radius_m: f64,
        /// Length.
        length_m: f64,
    },
    /// A ball.
    Sphere {
        /// Radius.
        radius_m: f64,
    },
    /// A file with triangles.
    Mesh {
        /// As written in the URDF: a path, or `package://...`.
        file: String,
        /// Factors along x, y and z.
        scale: [f64; 3],
    },
}

/// A shape on a link.
#[derive(Debug, Clone, PartialEq)]
pub struct CollisionBody {
    /// The link.
    pub link: String,
    /// Pose on the link.
    pub link_from_shape: Isometry3,
    /// The shape.
    pub shape: CollisionShape,
}

/// One joint on the way to a link.
#[derive(Debug, Clone)]
struct Step {
    parent_from_child: Isometry3,
    motion: Option<(String, JointKind, Vector3<f64>)>,
}

/// The shapes of a URDF with the joints that carry them.
#[derive(Debug, Clone)]
pub struct CollisionModel {
    bodies: Vec<CollisionBody>,
    /// From the root to each body's link.
    paths: Vec<Vec<Step>>,
    base: Vec<Step>,
}

impl CollisionModel {
    /// Reads all `<collision>` elements of the links that hang on the URDF's root.
    ///
    /// `base_link` is the link whose frame is the base; `None`: the root. Mimic, planar and floating joints are at 0.
    ///
    /// # Errors
    /// [`KinematicsError::Urdf`] with the line, as for [`crate::chain_from_urdf`]; several roots; shapes without their
    /// sizes.
    pub fn from_urdf(text: &str, base_link: Option<&str>) -> Result<Self, KinematicsError> {
        let document = Document::parse(text)?;
        let roots = document.roots();
        let &[root] = roots.as_slice() else {
            return Err(refuse(1, format!("{} links are no joint's child; one root is needed", roots.len())));
        };
        let steps = |link: &str| -> Result<Vec<Step>, KinematicsError> {
            Ok(document.path_at_rest(root, link)?.into_iter().map(Step::of).collect())
        };
        let mut bodies = Vec::new();
        let tree = document.tree()?;
        for link in tree.root_element().children().filter(|node| node.has_tag_name("link")) {
            for node in link.children().filter(|node| node.has_tag_name("collision")) {
                bodies.push(body(text, link.attribute("name").unwrap_or_default(), &node)?);
            }
        }
        let paths = bodies.iter().map(|body| steps(&body.link)).collect::<Result<_, _>>()?;
        Ok(CollisionModel { bodies, paths, base: steps(base_link.unwrap_or(root))? })
    }

    /// The shapes, in the order of the text.
    pub fn bodies(&self) -> &[CollisionBody] {
        &self.bodies
    }

    /// Names of the joints that move a shape or the base.
    pub fn joints(&self) -> BTreeSet<&str> {
        let steps = self.paths.iter().flatten().chain(&self.base);
        steps.filter_map(|step| step.motion.as_ref()).map(|(name, ..)| name.as_str()).collect()
    }

    /// `base_from_shape` of every shape at the values (radians or metres) that `value_of` gives the joints by name;
    /// joints without one are at 0.
    pub fn base_from_shapes(&self, value_of: impl Fn(&str) -> Option<f64>) -> Vec<Isometry3> {
        let root_from =
            |steps: &[Step]| steps.iter().fold(Isometry3::identity(), |pose, step| pose * step.pose(&value_of));
        let base_from_root = root_from(&self.base).inverse();
        let bodies = self.paths.iter().zip(&self.bodies);
        bodies.map(|(path, body)| base_from_root * root_from(path) * body.link_from_shape).collect()
    }
}

impl Step {
    fn of(joint: UrdfJoint<'_>) -> Self {
        let motion = joint.motion.map(|motion| (joint.name.to_owned(), motion.kind, motion.axis.into_inner()));
        Step { parent_from_child: joint.origin, motion }
    }

    fn pose(&self, value_of: &impl Fn(&str) -> Option<f64>) -> Isometry3 {
        let Some((name, kind, axis)) = &self.motion else { return self.parent_from_child };
        let moved = axis * value_of(name).unwrap_or(0.0);
        let motion = match kind {
            JointKind::Revolute => {
                Isometry3::from_parts(Translation3::identity(), UnitQuaternion::from_scaled_axis(moved))
            }
            JointKind::Prismatic => Isometry3::from_parts(Translation3::from(moved), UnitQuaternion::identity()),
        };
        self.parent_from_child * motion
    }
}

fn body(text: &str, link: &str, node: &Node<'_, '_>) -> Result<CollisionBody, KinematicsError> {
    let line = text.as_bytes()[..node.range().start].iter().filter(|byte| **byte == b'\n').count() as u32 + 1;
    let wrong = |what: String| refuse(line, format!("the collision geometry of link '{link}' {what}"));
    let child = |parent: &Node<'_, '_>, tag: &str| -> Option<roxmltree::NodeId> {
        parent.children().find(|child| child.has_tag_name(tag)).map(|child| child.id())
    };
    let numbers = |text: Option<&str>, default: Option<Vec<f64>>, what: &str, count: usize| {
        let found = match text {
            None => default,
            Some(text) => {
                text.split_whitespace().map(|word| word.parse().ok().filter(|v: &f64| v.is_finite())).collect()
            }
        };
        found
            .filter(|list| list.len() == count)
            .ok_or_else(|| wrong(format!("has no {what}; {count} finite numbers are needed")))
    };
    let document = node.document();
    let origin = child(node, "origin").and_then(|id| document.get_node(id));
    let attribute = |key: &str| origin.and_then(|origin| origin.attribute(key));
    let xyz = numbers(attribute("xyz"), Some(vec![0.0; 3]), "origin xyz", 3)?;
    let rpy = numbers(attribute("rpy"), Some(vec![0.0; 3]), "origin rpy", 3)?;
    let geometry = child(node, "geometry").and_then(|id| document.get_node(id));
    let shape = geometry.and_then(|geometry| geometry.children().find(Node::is_element));
    let Some(shape) = shape else { return Err(wrong("is empty".to_owned())) };
    let sizes = |key: &str, count: usize| -> Result<Vec<f64>, KinematicsError> {
        let list = numbers(shape.attribute(key), None, key, count)?;
        if list.iter().any(|size| *size < 0.0) {
            return Err(wrong(format!("has a negative {key}")));
        }
        Ok(list)
    };
    let shape = match shape.tag_name().name() {
        "box" => {
            let list = sizes("size", 3)?;
            CollisionShape::Box { edges_m: [list[0], list[1], list[2]] }
        }
        "cylinder" => CollisionShape::Cylinder { radius_m: sizes("radius", 1)?[0], length_m: sizes("length", 1)?[0] },
        "sphere" => CollisionShape::Sphere { radius_m: sizes("radius", 1)?[0] },
        "mesh" => {
            let file = shape.attribute("filename").ok_or_else(|| wrong("is a mesh without a filename".to_owned()))?;
            let scale = numbers(shape.attribute("scale"), Some(vec![1.0; 3]), "scale", 3)?;
            CollisionShape::Mesh { file: file.to_owned(), scale: [scale[0], scale[1], scale[2]] }
        }
        other => return Err(wrong(format!("is a <{other}>; box, cylinder, sphere and mesh are known"))),
    };
    let rotation = UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]);
    let link_from_shape = Isometry3::from_parts(Translation3::new(xyz[0], xyz[1], xyz[2]), rotation);
    Ok(CollisionBody { link: link.to_owned(), link_from_shape, shape })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    const ARM: &str = r#"<robot name="two">
  <link name="base"/>
  <link name="upper"><collision><origin xyz="0.2 0 0" rpy="0 1.5707963267948966 0"/>
    <geometry><cylinder radius="0.05" length="0.4"/></geometry></collision></link>
  <link name="finger"><collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision>
    <collision><geometry><mesh filename="package://two/finger.stl" scale="0.001 0.001 0.001"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="upper"/><child link="finger"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><mimic joint="turn"/></joint>
</robot>"#;

    #[test]
    fn shapes_follow_the_joints() {
        let model = CollisionModel::from_urdf(ARM, None).unwrap();
        assert_eq!(model.bodies().len(), 3);
        assert_eq!(model.bodies()[0].shape, CollisionShape::Cylinder { radius_m: 0.05, length_m: 0.4 });
        assert!(
            matches!(&model.bodies()[2].shape, CollisionShape::Mesh { file, scale } if file.ends_with("finger.stl") && scale[1] == 0.001)
        );
        assert_eq!(model.joints().into_iter().collect::<Vec<_>>(), ["turn"], "a mimic joint stays at rest");
        let quarter = std::f64::consts::FRAC_PI_2;
        let poses = model.base_from_shapes(|name| (name == "turn").then_some(quarter));
        assert!((poses[0] * Point3::origin() - Point3::new(0.0, 0.2, 0.5)).norm() < 1e-12);
        assert!((poses[0] * Point3::new(0.0, 0.0, 0.2) - Point3::new(0.0, 0.4, 0.5)).norm() < 1e-12, "its end");
        assert!((poses[1] * Point3::origin() - Point3::new(0.0, 0.4, 0.5)).norm() < 1e-12);
        let from_upper = CollisionModel::from_urdf(ARM, Some("upper")).unwrap();
        let poses = from_upper.base_from_shapes(|_| Some(quarter));
        assert!((poses[0] * Point3::origin() - Point3::new(0.2, 0.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let refusal = |text: &str| CollisionModel::from_urdf(text, None).unwrap_err().to_string();
        assert!(
            refusal(&ARM.replace(r#"radius="0.05" "#, "")).contains("line 3"),
            "{}",
            refusal(&ARM.replace(r#"radius="0.05" "#, ""))
        );
        assert!(refusal(&ARM.replace("0.1 0.02 0.02", "0.1 NaN 0.02")).contains("'finger'"));
        assert!(refusal(&ARM.replace("0.1 0.02 0.02", "0.1 -1 0.02")).contains("negative"));
        assert!(refusal(&ARM.replace("<box size=\"0.1 0.02 0.02\"/>", "<capsule/>")).contains("capsule"));
        assert!(CollisionModel::from_urdf(ARM, Some("wrist")).is_err());
    }
}
