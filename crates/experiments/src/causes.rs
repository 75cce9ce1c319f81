//! Which cause a text names. The program's words are read by their key words, so that a table can say whether the right
//! cause comes first.

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// What can be wrong with a recording or a rig.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[allow(missing_docs)]
pub enum Cause {
    FocalLength,
    PrincipalPoint,
    Distortion,
    DepthScale,
    DepthBias,
    Extrinsics,
    TimeOffset,
    Compliance,
    Gears,
    JointStep,
    MountStep,
    JointSign,
    JointOrder,
    Degrees,
    WrongArm,
    ImageShift,
    MountFarOff,
    FewPostures,
    BoardSquares,
    DepthNoise,
    PostureNoise,
}

/// Causes and the words by which a statement names them. Longer phrases come first where one contains another.
const WORDS: [(Cause, &[&str]); 18] = [
    (Cause::FocalLength, &["focal", "fx ", "fy "]),
    (Cause::PrincipalPoint, &["principal point", "optical centre", "image centre", "cx ", "cy "]),
    (Cause::Distortion, &["distortion", "k1 ", "k2 "]),
    (
        Cause::DepthBias,
        &["depth bias", "depth offset", "depth error grows", "bias of the depth", "quadratic depth", "depth_offset"],
    ),
    (
        Cause::DepthScale,
        &["depth scale", "scale of the depth", "depth camera's unit", "depth unit", "unit_mm", "depth_scale"],
    ),
    (
        Cause::Extrinsics,
        &[
            "extrinsic",
            "color_from_depth",
            "depth camera is mounted",
            "colour and depth",
            "depth to colour",
            "depth_x ",
            "depth_y ",
            "depth_z ",
            "depth_rx ",
            "depth_ry ",
            "depth_rz ",
        ],
    ),
    (Cause::TimeOffset, &["time offset", "time_offset", "joints are late", "images are late", "clock"]),
    (Cause::Compliance, &["complian", "gives way", "give way", "sag"]),
    (Cause::Gears, &["gear", "transmission error"]),
    (
        Cause::MountStep,
        &["camera moved", "camera slipped", "mount moved", "mount steps", "step of the mount", "mount slipped"],
    ),
    (Cause::JointStep, &["encoder", "step in time", "steps by", "step of joint", "jumps by", "joint step"]),
    (Cause::JointSign, &["sign of", "wrong sign", "turns the other way", "reversed"]),
    (Cause::JointOrder, &["swapped", "joint order", "order of the joints", "order of joints", "columns of joints"]),
    (Cause::Degrees, &["radian"]),
    (
        Cause::WrongArm,
        &[
            "another robot",
            "other robot",
            "wrong robot",
            "another arm",
            "wrong arm",
            "convention",
            "belongs to the recording",
        ],
    ),
    (Cause::ImageShift, &["shifted by", "rows of postures.csv", "row of postures.csv", "one posture late", "one row"]),
    (Cause::MountFarOff, &["mount was found", "mount is far off", "mount far off", "find-mount", "nominal mount was"]),
    (
        Cause::FewPostures,
        &["few postures", "more postures", "postures are too few", "postures are few", "too few postures"],
    ),
];

/// The cause that an entry of the summary's list names by its type; `None` for one that blames nothing which these rows
/// make wrong (a parameter of the arm).
///
/// # Errors
/// A type that is not known.
pub fn of_entry(entry: &Value) -> Result<Option<Cause>> {
    let text = |key: &str| entry.pointer(key).and_then(Value::as_str).unwrap_or_default();
    Ok(Some(match (text("/kind"), text("/what"), text("/pattern/kind")) {
        ("beyond" | "ruler", "focal_length", _) => Cause::FocalLength,
        ("beyond" | "ruler", "principal_point", _) => Cause::PrincipalPoint,
        ("beyond" | "ruler", "distortion", _) => Cause::Distortion,
        ("beyond" | "ruler", "depth_scale", _) => Cause::DepthScale,
        ("beyond" | "ruler", "depth_offset", _) => Cause::DepthBias,
        ("beyond" | "ruler", "extrinsics", _) => Cause::Extrinsics,
        ("beyond" | "ruler", "board_squares", _) => Cause::BoardSquares,
        ("beyond", "mount", _) => Cause::MountFarOff,
        ("beyond", "clock", _) | ("pattern", _, "time_offset") => Cause::TimeOffset,
        ("pattern", _, "joint_step") => Cause::JointStep,
        ("pattern", _, "camera_slip") => Cause::MountStep,
        ("pattern", _, "transmission") => Cause::Gears,
        ("pattern", _, "compliance") => Cause::Compliance,
        ("few_postures", ..) => Cause::FewPostures,
        ("depth_shift", ..) => Cause::ImageShift,
        ("gross", ..) => of_gross(text("/finding/cause/kind"), entry)?,
        ("depth_noise", ..) => Cause::DepthNoise,
        ("posture_noise", ..) => Cause::PostureNoise,
        ("beyond", "arm", _) => return Ok(None),
        _ => bail!("the cause {entry} is not known"),
    }))
}

/// The cause that a gross mistake is.
fn of_gross(kind: &str, entry: &Value) -> Result<Cause> {
    Ok(match kind {
        "joint_sign" => Cause::JointSign,
        "joints_swapped" => Cause::JointOrder,
        "degrees_for_radians" | "radians_for_degrees" => Cause::Degrees,
        "postures_shifted" => Cause::ImageShift,
        "mount_far_off" => Cause::MountFarOff,
        "link_convention" | "other_arm" => Cause::WrongArm,
        "scene_or_camera" => Cause::FocalLength,
        _ => bail!("the cause {entry} is not known"),
    })
}

/// Causes that a statement names, in the order of their first mention. What it only asks ("Are the intrinsics right?")
/// is no naming.
pub fn named_in(statement: &str) -> Vec<Cause> {
    let text = assertions(statement).to_lowercase();
    let first = |words: &[&str]| words.iter().filter_map(|word| position(&text, word)).min();
    let mut found: Vec<(usize, Cause)> =
        WORDS.iter().filter_map(|(cause, words)| first(words).map(|at| (at, *cause))).collect();
    found.sort_by_key(|(at, _)| *at);
    found.into_iter().map(|(_, cause)| cause).collect()
}

/// Causes in the order in which statements name them, each once.
pub fn named(statements: &[String]) -> Vec<Cause> {
    let mut causes = Vec::new();
    for cause in statements.iter().flat_map(|statement| named_in(statement)) {
        if !causes.contains(&cause) {
            causes.push(cause);
        }
    }
    causes
}

/// Where a word begins in a text: "sag" is not found in "message".
fn position(text: &str, word: &str) -> Option<usize> {
    let begins = |at: usize| !text[..at].ends_with(|before: char| before.is_alphanumeric());
    text.match_indices(word).map(|(at, _)| at).find(|&at| begins(at))
}

/// A text without its questions.
fn assertions(text: &str) -> String {
    let mut kept = String::new();
    let mut sentence = String::new();
    let mut characters = text.chars().peekable();
    while let Some(character) = characters.next() {
        sentence.push(character);
        let ends =
            matches!(character, '.' | '!' | '?' | ';') && characters.peek().is_none_or(|next| next.is_whitespace());
        if ends {
            if character != '?' {
                kept.push_str(&sentence);
            }
            sentence.clear();
        }
    }
    kept + &sentence
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn typed_causes_are_known_by_their_kind_and_others_are_errors() {
        let of = |text: &str| of_entry(&serde_json::from_str(text).unwrap());
        let step = r#"{"kind": "pattern", "pattern": {"kind": "joint_step", "joint": 1, "from": 24}, "size": 0.1}"#;
        assert_eq!(of(step).unwrap(), Some(Cause::JointStep));
        assert_eq!(of(r#"{"kind": "beyond", "what": "focal_length"}"#).unwrap(), Some(Cause::FocalLength));
        assert_eq!(of(r#"{"kind": "beyond", "what": "arm"}"#).unwrap(), None);
        assert!(of(r#"{"kind": "weather"}"#).is_err());
    }

    #[test]
    fn causes_come_in_the_order_of_their_mention_and_questions_name_none() {
        let found =
            named_in("The depth scale is 0.5 % off. Are the focal lengths right? If not: the time offset is 1.5 ms.");
        assert_eq!(found, [Cause::DepthScale, Cause::TimeOffset]);
        assert!(named_in("Are the intrinsics right? Is the focal length?").is_empty());
        assert!(named_in("a new message").is_empty());
        assert_eq!(named_in("fx moved by +13.7 px, 5.0 times what is expected of it"), [Cause::FocalLength]);
        assert_eq!(named_in("depth_rx moved by +1.000 deg"), [Cause::Extrinsics]);
        let all =
            ["check the depth camera's unit_mm".to_owned(), "focal length 1.01 explains it; depth scale".to_owned()];
        assert_eq!(named(&all), [Cause::DepthScale, Cause::FocalLength]);
    }
}
