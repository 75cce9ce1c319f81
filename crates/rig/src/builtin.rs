//! The rigs that come with the program: `robots/*.toml`, each with its source.

use crate::{Rig, RigFileError};

/// Name and text of each rig. The names are those of the files.
const RIGS: [(&str, &str); 13] = [
    ("abb-irb120", include_str!("../robots/abb-irb120.toml")),
    ("abb-irb1600-6-120", include_str!("../robots/abb-irb1600-6-120.toml")),
    ("fanuc-lrmate-200id", include_str!("../robots/fanuc-lrmate-200id.toml")),
    ("franka-fr3", include_str!("../robots/franka-fr3.toml")),
    ("hp3-like", include_str!("../robots/hp3-like.toml")),
    ("hp3j", include_str!("../robots/hp3j.toml")),
    ("kuka-kr6-r900", include_str!("../robots/kuka-kr6-r900.toml")),
    ("staubli-tx2-60", include_str!("../robots/staubli-tx2-60.toml")),
    ("ur10e", include_str!("../robots/ur10e.toml")),
    ("ur16e", include_str!("../robots/ur16e.toml")),
    ("ur3e", include_str!("../robots/ur3e.toml")),
    ("ur5e", include_str!("../robots/ur5e.toml")),
    ("yaskawa-gp7", include_str!("../robots/yaskawa-gp7.toml")),
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
