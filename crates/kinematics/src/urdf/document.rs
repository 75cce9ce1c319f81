//! The joints of a URDF text, with the places of what the writer changes.

use crate::chain::JointKind;
use crate::{Isometry3, KinematicsError};
use nalgebra::{Translation3, Unit, UnitQuaternion, Vector3};
use roxmltree::{Node, ParsingOptions};
use std::collections::{HashMap, HashSet};
use std::ops::Range;

/// More nodes than this are not a robot; it bounds the memory.
const MAX_NODES: u32 = 4_000_000;

/// What to do about a xacro.
const EXPAND: &str =
    "this is a xacro, not a URDF; expand it first, for instance with `xacro robot.urdf.xacro > robot.urdf`";

/// A joint on the way from base to tip.
pub(super) struct UrdfJoint<'a> {
    pub(super) name: &'a str,
    pub(super) parent: &'a str,
    pub(super) child: &'a str,
    /// `rpy` of the origin as the text has it, radians.
    pub(super) angles: Vector3<f64>,
    /// `parent_from_child` at joint value 0.
    pub(super) origin: Isometry3,
    /// `None`: fixed.
    pub(super) motion: Option<Motion>,
    pub(super) place: OriginPlace,
}

pub(super) struct Motion {
    pub(super) kind: JointKind,
    /// In the child's frame.
    pub(super) axis: Unit<Vector3<f64>>,
    pub(super) limits: Option<[f64; 2]>,
}

/// Where in the text an origin is or belongs, bytes.
pub(super) enum OriginPlace {
    /// There is an `<origin`: the values of its attributes, and where a missing one goes.
    Element { xyz: Option<Range<usize>>, rpy: Option<Range<usize>>, after_name: usize },
    /// There is none: it goes before the joint's first element.
    Missing { before: usize },
}

/// The joints of a URDF by child link. Every link is the child of at most one joint.
pub(super) struct Document<'a> {
    text: &'a str,
    links: Vec<&'a str>,
    joints: HashMap<&'a str, RawJoint<'a>>,
    parents: HashSet<&'a str>,
    /// Of the joints.
    names: HashSet<&'a str>,
}

struct RawJoint<'a> {
    text: &'a str,
    /// Where it begins, bytes.
    at: usize,
    name: &'a str,
    kind: &'a str,
    parent: &'a str,
    child: &'a str,
    mimics: Option<&'a str>,
    origin: Option<RawOrigin<'a>>,
    axis: Option<&'a str>,
    lower: Option<&'a str>,
    upper: Option<&'a str>,
    /// Where the first element inside the joint begins.
    inside: usize,
}

struct RawOrigin<'a> {
    xyz: Option<(&'a str, Range<usize>)>,
    rpy: Option<(&'a str, Range<usize>)>,
    after_name: usize,
}

pub(super) fn refuse(line: u32, problem: impl Into<String>) -> KinematicsError {
    KinematicsError::Urdf { line, problem: problem.into() }
}

impl<'a> Document<'a> {
    pub(super) fn parse(text: &'a str) -> Result<Self, KinematicsError> {
        let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
        let tree = roxmltree::Document::parse_with_options(text, options).map_err(|error| {
            let problem = if text.contains("<xacro:") { EXPAND.to_owned() } else { format!("not XML: {error}") };
            refuse(error.pos().row, problem)
        })?;
        let line = |node: &Node<'_, '_>| line_of(text, node.range().start);
        let robot = tree.root_element();
        if robot.tag_name().name() != "robot" {
            return Err(refuse(
                line(&robot),
                format!("the root element is <{}>, not <robot>", robot.tag_name().name()),
            ));
        }
        if let Some(node) = robot.descendants().find(is_xacro) {
            return Err(refuse(line(&node), EXPAND));
        }
        let mut document = Document {
            text,
            links: Vec::new(),
            joints: HashMap::new(),
            parents: HashSet::new(),
            names: HashSet::new(),
        };
        for node in robot.children().filter(Node::is_element) {
            match node.tag_name().name() {
                "link" => document
                    .links
                    .push(text_of(text, &node, "name").ok_or_else(|| refuse(line(&node), "a <link> has no name"))?),
                // Transmissions and plug-ins have elements of this name too, but not as children of <robot>.
                "joint" => document.add_joint(&node)?,
                _ => {}
            }
        }
        Ok(document)
    }

    fn add_joint(&mut self, node: &Node<'_, '_>) -> Result<(), KinematicsError> {
        let text = self.text;
        let at = node.range().start;
        let refuse = |problem: String| refuse(line_of(text, at), problem);
        let name = text_of(text, node, "name").ok_or_else(|| refuse("a <joint> has no name".to_owned()))?;
        let child_node = |tag: &str| node.children().find(|child| child.is_element() && child.has_tag_name(tag));
        let attribute = |tag: &str, key: &str| child_node(tag).and_then(|child| text_of(text, &child, key));
        let need = |tag: &str, key: &str| {
            attribute(tag, key).ok_or_else(|| refuse(format!("joint '{name}' has no <{tag} {key}=\"...\"/>")))
        };
        if !self.names.insert(name) {
            return Err(refuse(format!("'{name}' is the name of two joints")));
        }
        let kind = text_of(text, node, "type").ok_or_else(|| refuse(format!("joint '{name}' has no type")))?;
        let (parent, child) = (need("parent", "link")?, need("child", "link")?);
        let origin = child_node("origin").map(|origin| {
            let place = |key: &str| {
                let attribute = origin.attributes().find(|attribute| attribute.name() == key)?;
                let range = attribute.range_value();
                Some((&text[range.clone()], range))
            };
            let after_name = origin.range().start + "<".len() + qualified_name_length(&text[origin.range()]);
            RawOrigin { xyz: place("xyz"), rpy: place("rpy"), after_name }
        });
        let first = node.children().find(Node::is_element).map_or(node.range().end, |first| first.range().start);
        let joint = RawJoint {
            text,
            at,
            name,
            kind,
            parent,
            child,
            mimics: child_node("mimic").map(|mimic| text_of(text, &mimic, "joint").unwrap_or("another joint")),
            origin,
            axis: attribute("axis", "xyz"),
            lower: attribute("limit", "lower"),
            upper: attribute("limit", "upper"),
            inside: first,
        };
        self.parents.insert(parent);
        match self.joints.insert(child, joint) {
            None => Ok(()),
            Some(before) => {
                Err(refuse(format!("link '{child}' is the child of two joints, '{}' and '{name}'", before.name)))
            }
        }
    }

    /// Links that are no joint's child.
    pub(super) fn roots(&self) -> Vec<&'a str> {
        self.links.iter().copied().filter(|link| !self.joints.contains_key(link)).collect()
    }

    /// Links that are no joint's parent.
    pub(super) fn tips(&self) -> Vec<&'a str> {
        self.links.iter().copied().filter(|link| !self.parents.contains(link)).collect()
    }

    /// The text's elements, once more.
    pub(super) fn tree(&self) -> Result<roxmltree::Document<'a>, KinematicsError> {
        let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
        roxmltree::Document::parse_with_options(self.text, options)
            .map_err(|error| refuse(error.pos().row, error.to_string()))
    }

    /// The joints from one link to another, in order.
    pub(super) fn path(&self, base_link: &str, tip_link: &str) -> Result<Vec<UrdfJoint<'a>>, KinematicsError> {
        self.path_with(base_link, tip_link, RawJoint::read)
    }

    /// As [`Document::path`], with joints that no chain has (mimic, planar, floating) as fixed ones.
    pub(super) fn path_at_rest(&self, base_link: &str, tip_link: &str) -> Result<Vec<UrdfJoint<'a>>, KinematicsError> {
        self.path_with(base_link, tip_link, |joint| {
            let follows = joint.mimics.is_some() || matches!(joint.kind, "planar" | "floating");
            joint.read_as(if follows { "fixed" } else { joint.kind })
        })
    }

    fn path_with(
        &self,
        base_link: &str,
        tip_link: &str,
        read: impl Fn(&RawJoint<'a>) -> Result<UrdfJoint<'a>, KinematicsError>,
    ) -> Result<Vec<UrdfJoint<'a>>, KinematicsError> {
        for link in [base_link, tip_link] {
            if !self.links.contains(&link) {
                let ends = format!("it begins at {} and ends at {}", listed(&self.roots()), listed(&self.tips()));
                return Err(refuse(1, format!("the URDF has no link '{link}'; {ends}")));
            }
        }
        let mut found = Vec::new();
        let mut link = tip_link;
        while link != base_link {
            let Some(joint) = self.joints.get(link) else {
                return Err(refuse(
                    1,
                    format!("link '{tip_link}' does not hang on '{base_link}': from it the joints lead up to '{link}'"),
                ));
            };
            if found.len() == self.joints.len() {
                return Err(refuse(
                    line_of(self.text, joint.at),
                    format!("the joints above '{tip_link}' go in a circle"),
                ));
            }
            found.push(read(joint)?);
            link = joint.parent;
        }
        found.reverse();
        Ok(found)
    }
}

impl<'a> RawJoint<'a> {
    fn read(&self) -> Result<UrdfJoint<'a>, KinematicsError> {
        if let Some(other) = self.mimics {
            return Err(self.refuse(format!(
                "mimics '{other}': its value is not its own, and a serial chain has no such joint; choose a base and \
                 a tip link that leave it out"
            )));
        }
        self.read_as(self.kind)
    }

    fn refuse(&self, problem: String) -> KinematicsError {
        refuse(line_of(self.text, self.at), format!("joint '{}' {problem}", self.name))
    }

    /// As if its type were `kind`, and without a look at what it mimics.
    fn read_as(&self, kind: &str) -> Result<UrdfJoint<'a>, KinematicsError> {
        let refuse = |problem: String| self.refuse(problem);
        let vector = |what: &str, text: Option<&str>, default: Vector3<f64>| match text {
            None => Ok(default),
            Some(text) => three_numbers(text)
                .ok_or_else(|| refuse(format!("has {what}=\"{}\"; three finite numbers are needed", shortened(text)))),
        };
        let motion = match kind {
            "fixed" => None,
            "revolute" | "continuous" | "prismatic" => {
                let axis = vector("axis xyz", self.axis, Vector3::x())?;
                // The standard wants a unit vector and readers normalise; zero has no direction. Scaled first, as the
                // square of a large number is infinite.
                let scale = axis.amax().max(1.0);
                let axis =
                    Unit::try_new(axis / scale, 1e-9).ok_or_else(|| refuse("has an axis of length 0".to_owned()))?;
                let number = |what: &str, text: Option<&str>| match text {
                    None => Ok(0.0),
                    Some(text) => one_number(text).ok_or_else(|| {
                        refuse(format!("has {what}=\"{}\"; a finite number is needed", shortened(text)))
                    }),
                };
                let given = self.lower.is_some() || self.upper.is_some();
                let limits = match kind != "continuous" && given {
                    false => None,
                    true => Some([number("lower", self.lower)?, number("upper", self.upper)?]),
                };
                if let Some([lower, upper]) = limits.filter(|[lower, upper]| lower > upper) {
                    return Err(refuse(format!("has its lower limit {lower} above its upper limit {upper}")));
                }
                let kind = if kind == "prismatic" { JointKind::Prismatic } else { JointKind::Revolute };
                Some(Motion { kind, axis, limits })
            }
            other => {
                return Err(refuse(format!(
                    "is {}; fixed, revolute, continuous and prismatic joints make a serial chain",
                    shortened(other)
                )));
            }
        };
        let xyz = self.origin.as_ref().and_then(|origin| origin.xyz.as_ref());
        let rpy = self.origin.as_ref().and_then(|origin| origin.rpy.as_ref());
        let translation = vector("origin xyz", xyz.map(|(text, _)| *text), Vector3::zeros())?;
        let angles = vector("origin rpy", rpy.map(|(text, _)| *text), Vector3::zeros())?;
        let place = match &self.origin {
            Some(origin) => OriginPlace::Element {
                xyz: xyz.map(|(_, range)| range.clone()),
                rpy: rpy.map(|(_, range)| range.clone()),
                after_name: origin.after_name,
            },
            None => OriginPlace::Missing { before: self.inside },
        };
        let rotation = UnitQuaternion::from_euler_angles(angles.x, angles.y, angles.z);
        let origin = Isometry3::from_parts(Translation3::from(translation), rotation);
        Ok(UrdfJoint { name: self.name, parent: self.parent, child: self.child, angles, origin, motion, place })
    }
}

/// The value of an attribute as written in the text (character references in names are left as they are).
fn text_of<'a>(text: &'a str, node: &Node<'_, '_>, key: &str) -> Option<&'a str> {
    let attribute = node.attributes().find(|attribute| attribute.name() == key && attribute.namespace().is_none())?;
    Some(&text[attribute.range_value()])
}

/// An element of the xacro language, or an attribute that it has yet to evaluate.
fn is_xacro(node: &Node<'_, '_>) -> bool {
    let of_language =
        node.is_element() && node.tag_name().namespace().is_some_and(|namespace| namespace.contains("xacro"));
    of_language
        || node.attributes().any(|attribute| attribute.value().contains("${") || attribute.value().contains("$("))
}

/// The line, from 1, of a place in a text.
fn line_of(text: &str, at: usize) -> u32 {
    let before = text.as_bytes().iter().take(at).filter(|byte| **byte == b'\n').count();
    u32::try_from(before + 1).unwrap_or(u32::MAX)
}

/// The length of the name at the start of an element's text `<name ...`.
fn qualified_name_length(element: &str) -> usize {
    element[1..].find(|c: char| c.is_whitespace() || c == '/' || c == '>').unwrap_or(0)
}

fn one_number(text: &str) -> Option<f64> {
    text.trim().parse().ok().filter(|value: &f64| value.is_finite())
}

fn three_numbers(text: &str) -> Option<Vector3<f64>> {
    let mut numbers = text.split_whitespace().map(one_number);
    let found = [numbers.next()??, numbers.next()??, numbers.next()??];
    numbers.next().is_none().then_some(Vector3::from(found))
}

/// Text for a message.
fn shortened(text: &str) -> String {
    if text.chars().count() > 60 { text.chars().take(60).chain("...".chars()).collect() } else { text.to_owned() }
}

fn listed(links: &[&str]) -> String {
    let some: Vec<String> = links.iter().take(8).map(|link| format!("'{}'", shortened(link))).collect();
    let more = links.len().saturating_sub(8);
    match (some.is_empty(), more) {
        (true, _) => "none".to_owned(),
        (false, 0) => some.join(", "),
        (false, more) => format!("{} and {more} more", some.join(", ")),
    }
}
