//! The rigs that come with the program: `robots/*.toml`, each with its source.

use crate::{Rig, RigFileError};

/// Name and text of each rig. The names are those of the files.
const RIGS: [(&str, &str); 3] = [
    ("hp3j", include_str!("../../../robots/hp3j.toml")),
    ("hp3-like", include_str!("../../../robots/hp3-like.toml")),
    ("ur5e", include_str!("../../../robots/ur5e.toml")),
];

/// The names that [`builtin_rig`] knows.
pub fn builtin_names() -> impl Iterator<Item = &'static str> {
    RIGS.iter().map(|(name, _)| *name)
}

/// A rig by its name; `None` for an unknown name.
pub fn builtin_rig(name: &str) -> Option<Result<Rig, RigFileError>> {
    RIGS.iter()
        .find(|(known, _)| *known == name)
        .map(|(name, text)| Rig::from_toml(text, format!("built-in robot {name}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_built_in_rig_is_read_and_its_arm_moves() {
        for name in builtin_names() {
            let rig = builtin_rig(name).unwrap().unwrap();
            let robot = rig.robot.unwrap();
            let flange = robot.base_from_flange(&vec![0.1; robot.joint_count()]).unwrap();
            assert!(flange.translation.vector.norm() > 0.1, "{name}");
        }
        assert!(builtin_rig("r2d2").is_none());
    }
}
