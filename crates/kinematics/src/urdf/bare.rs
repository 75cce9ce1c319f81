//! A URDF for an arm that has none: links without shapes, the chain's joints and limits.

use super::{roll_pitch_yaw, rounded};
use crate::{Isometry3, JointKind, ParameterKind, SerialChain};
use std::fmt::Write;

/// Placeholder for the greatest effort, N m or N. Planners that read it want it above zero; none plans with it alone.
const EFFORT: f64 = 100.0;

/// Placeholder for the greatest speed: slow for an arm, so that a motion planned with it is too slow and not too fast;
/// zero would forbid any.
fn velocity(kind: JointKind) -> f64 {
    match kind {
        JointKind::Revolute => 1.0,
        JointKind::Prismatic => 0.1,
    }
}

const PLACEHOLDERS: &str = "  <!-- Effort and velocity of the joints are not known to the calibration: the values are placeholders, chosen slow.\n       \
                         Put those of the maker in their place before you plan with them. -->\n";

/// A robot description of nothing but the chain, from `base_link` to `tip_link`: the forward kinematics of the text are
/// the chain's. Joints without limits are `continuous`; a sliding joint without limits gets 1000 km either way, because
/// URDF knows none without. Its `limit` must have an effort and a velocity too, which a calibration does not know: the
/// text has placeholders (100 N m and 1 rad/s, 100 N and 0.1 m/s) and says so in a comment.
pub fn bare_urdf(chain: &SerialChain, robot: &str, base_link: &str, tip_link: &str) -> String {
    let link = |at: usize| if at == 0 { escaped(base_link) } else { format!("link_{at}") };
    let mut text = format!("<?xml version=\"1.0\"?>\n<robot name=\"{}\">\n{PLACEHOLDERS}", escaped(robot));
    let mut pending = Isometry3::identity();
    for (at, joint) in chain.joints().iter().enumerate() {
        // Motions along and about the joint's own axis commute with the joint: they are in its origin. What follows
        // them belongs to the next origin.
        let motions = joint.link.motions(0.0, 0.0);
        let along_axis = |kind: ParameterKind| matches!(kind, ParameterKind::ThetaOffset | ParameterKind::D);
        let split = motions.iter().rposition(|(kind, _)| along_axis(*kind)).map_or(0, |last| last + 1);
        let product = |part: &[(ParameterKind, crate::ElementaryMotion)]| {
            part.iter().fold(Isometry3::identity(), |pose, (_, motion)| pose * motion.transform())
        };
        let origin = pending * product(&motions[..split]);
        pending = product(&motions[split..]);
        let (kind, limits) = match (joint.kind, joint.limits) {
            (JointKind::Revolute, Some(limits)) => ("revolute", Some(limits)),
            (JointKind::Revolute, None) => ("continuous", None),
            (JointKind::Prismatic, limits) => ("prismatic", Some(limits.unwrap_or([-1e6, 1e6]))),
        };
        let limit = limits.map_or(String::new(), |[lower, upper]| {
            let velocity = velocity(joint.kind);
            format!("    <limit lower=\"{lower}\" upper=\"{upper}\" effort=\"{EFFORT}\" velocity=\"{velocity}\"/>\n")
        });
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "  <link name=\"{}\"/>\n  <joint name=\"{}\" type=\"{kind}\">\n{}    <parent link=\"{}\"/>\n    <child link=\"{}\"/>\n    \
             <axis xyz=\"0 0 1\"/>\n{limit}  </joint>\n",
            link(at),
            escaped(&joint.name),
            element(&origin),
            link(at),
            link(at + 1)
        );
    }
    let last = link(chain.joint_count());
    // Joints have names of their own.
    let mut flange = "flange".to_owned();
    while chain.joints().iter().any(|joint| joint.name == flange) {
        flange.push('_');
    }
    let _ = write!(
        text,
        "  <link name=\"{last}\"/>\n  <joint name=\"{flange}\" type=\"fixed\">\n{}    <parent link=\"{last}\"/>\n    <child link=\"{tip}\"/>\n  </joint>\n  \
         <link name=\"{tip}\"/>\n</robot>\n",
        element(&pending),
        tip = escaped(tip_link)
    );
    text
}

fn element(origin: &Isometry3) -> String {
    let (t, rpy) = (origin.translation.vector.map(rounded), roll_pitch_yaw(&origin.rotation));
    let [roll, pitch, yaw] = [rpy[0], rpy[1], rpy[2]];
    format!("    <origin xyz=\"{} {} {}\" rpy=\"{roll} {pitch} {yaw}\"/>\n", t.x, t.y, t.z)
}

fn escaped(text: &str) -> String {
    // Control characters have no place in XML, not even as references.
    let text = skclam_files::shown(text);
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Joint, Link, LinkForm, chain_from_urdf};

    #[test]
    fn whatever_names_hold_the_text_is_xml() {
        let link = Link { form: LinkForm::ModifiedDh, alpha: 0.3, a: 0.2, beta: 0.0, theta_offset: 0.0, d: 0.1 };
        let evil = "\u{1b}[31m\u{0}\u{fffe}]]>--\u{202e}\n\"'<&";
        let chain = SerialChain::new(vec![Joint::revolute(evil, link), Joint::revolute("flange", link)]).unwrap();
        let text = bare_urdf(&chain, evil, "base_link", "tool0");
        let back = chain_from_urdf(&text, "base_link", "tool0").unwrap();
        assert!(back.joints()[0].name.contains("\\u{1b}[31m"), "{text}");
        assert!(!text.chars().any(|c| skclam_files::is_harmful(c) && c != '\n'), "{text}");
    }

    #[test]
    fn the_text_is_the_chain_in_every_form() {
        let link = |form, k: f64| Link {
            form,
            alpha: 0.3 + k,
            a: 0.2 - 0.1 * k,
            beta: 0.05 * k,
            theta_offset: 0.7 * k,
            d: 0.4,
        };
        for form in [LinkForm::ModifiedDh, LinkForm::StandardDh, LinkForm::Hayati, LinkForm::StandardHayati] {
            let mut last = link(form, -0.8);
            last.form = if matches!(form, LinkForm::Hayati) { LinkForm::ModifiedDh } else { form };
            let chain = SerialChain::new(vec![
                Joint::revolute("shoulder", link(form, 0.1)).with_limits(-2.0, 2.5),
                Joint::revolute("b", link(form, 0.6)),
                Joint::revolute("c", last),
            ])
            .unwrap();
            let text = bare_urdf(&chain, "an \"arm\" & <hand>", "base_link", "tool0");
            let back = chain_from_urdf(&text, "base_link", "tool0").unwrap();
            assert_eq!(back.joints()[0].name, "shoulder");
            assert!(text.contains("effort=\"100\" velocity=\"1\"/>") && text.contains("placeholders"), "{text}");
            assert!(text.contains("<robot name=\"an &quot;arm&quot; &amp; &lt;hand&gt;\">"), "{text}");
            assert_eq!((back.joints()[0].limits, back.joints()[1].limits), (Some([-2.0, 2.5]), None));
            for joints in [[0.0; 3], [0.4, -1.9, 2.2]] {
                let (wanted, found) =
                    (chain.base_from_flange(&joints).unwrap(), back.base_from_flange(&joints).unwrap());
                let error = (wanted.to_homogeneous() - found.to_homogeneous()).norm();
                assert!(error < 1e-9, "{form:?}: {error}\n{text}");
            }
        }
    }
}
