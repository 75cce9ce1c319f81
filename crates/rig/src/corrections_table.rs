//! `[joint_corrections]` of `rig.toml`: lists of one number a joint, and the time offset.

use crate::joint_corrections::{JointCorrection, JointCorrections};
use serde::{Deserialize, Serialize};
use skclam_kinematics::{JointKind, SerialChain};

/// The table as it is in the file.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CorrectionsTable {
    #[serde(default, alias = "gear_sin_deg", skip_serializing_if = "Vec::is_empty")]
    transmission_sin_deg: Vec<f64>,
    #[serde(default, alias = "gear_cos_deg", skip_serializing_if = "Vec::is_empty")]
    transmission_cos_deg: Vec<f64>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    compliance_deg_per_m: Vec<f64>,
    #[serde(default, skip_serializing_if = "is_zero")]
    time_offset_s: f64,
}

fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

impl CorrectionsTable {
    /// `None` where there is nothing to correct.
    pub(crate) fn of(corrections: &JointCorrections) -> Option<Self> {
        let list = |of: fn(&JointCorrection) -> f64| {
            let values: Vec<f64> = corrections.joints.iter().map(|joint| of(joint).to_degrees()).collect();
            if values.iter().all(is_zero) { Vec::new() } else { values }
        };
        (!corrections.is_none()).then(|| CorrectionsTable {
            transmission_sin_deg: list(|joint| joint.transmission_sin),
            transmission_cos_deg: list(|joint| joint.transmission_cos),
            compliance_deg_per_m: list(|joint| joint.compliance),
            time_offset_s: corrections.time_offset_s,
        })
    }

    /// The corrections for an arm; else the key that is wrong and why.
    pub(crate) fn corrections(&self, arm: Option<&SerialChain>) -> Result<JointCorrections, (String, String)> {
        let key = |name: &str| format!("joint_corrections.{name}");
        let joints = arm.map(SerialChain::joints).unwrap_or_default();
        let lists = [
            ("transmission_sin_deg", &self.transmission_sin_deg),
            ("transmission_cos_deg", &self.transmission_cos_deg),
            ("compliance_deg_per_m", &self.compliance_deg_per_m),
        ];
        for (name, list) in lists {
            if !list.is_empty() && list.len() != joints.len() {
                let expected = format!("{} numbers given; one a joint is needed: {}", list.len(), joints.len());
                return Err((key(name), expected));
            }
            for (value, joint) in list.iter().zip(joints) {
                // A degree is far beyond any transmission error; radians where degrees are meant are small and pass.
                if !(-5.0..=5.0).contains(value) {
                    return Err((key(name), format!("{value} given; a number from -5 to 5 is needed")));
                }
                if *value != 0.0 && joint.kind == JointKind::Prismatic {
                    let reason = format!("{value} given for the prismatic joint {:?}; 0 is needed", joint.name);
                    return Err((key(name), reason));
                }
            }
        }
        if !(-10.0..=10.0).contains(&self.time_offset_s) {
            let reason = format!("{} given; a number of seconds from -10 to 10 is needed", self.time_offset_s);
            return Err((key("time_offset_s"), reason));
        }
        let at = |list: &[f64], joint: usize| list.get(joint).copied().unwrap_or(0.0).to_radians();
        let corrections = JointCorrections {
            joints: (0..joints.len())
                .map(|joint| JointCorrection {
                    transmission_sin: at(&self.transmission_sin_deg, joint),
                    transmission_cos: at(&self.transmission_cos_deg, joint),
                    compliance: at(&self.compliance_deg_per_m, joint),
                })
                .collect(),
            time_offset_s: self.time_offset_s,
        };
        Ok(if corrections.is_none() { JointCorrections::default() } else { corrections })
    }
}

#[cfg(test)]
mod tests {
    use crate::{JointCorrection, Rig, RigFileError, builtin_rig};

    fn arm() -> Rig {
        builtin_rig("hp3j").unwrap().unwrap()
    }

    fn with(table: &str) -> Result<Rig, RigFileError> {
        Rig::from_toml(&format!("{}\n[joint_corrections]\n{table}\n", arm().to_toml().unwrap()), "rig.toml")
    }

    #[test]
    fn what_was_written_is_read_back() {
        let mut rig = arm();
        assert!(!rig.to_toml().unwrap().contains("joint_corrections"));
        rig.joint_corrections.joints = vec![JointCorrection::default(); 6];
        assert!(!rig.to_toml().unwrap().contains("joint_corrections"), "zeros are no corrections");
        rig.joint_corrections.joints[2] =
            JointCorrection { transmission_sin: 1e-3, transmission_cos: 0.0, compliance: -2e-4 };
        rig.joint_corrections.time_offset_s = 0.012;
        let text = rig.to_toml().unwrap();
        assert!(text.contains("transmission_sin_deg") && !text.contains("transmission_cos_deg"), "{text}");
        let back = Rig::from_toml(&text, "rig.toml").unwrap().joint_corrections;
        for (back, was) in back.joints.iter().zip(&rig.joint_corrections.joints) {
            assert!(
                (back.transmission_sin - was.transmission_sin).abs() < 1e-16
                    && (back.compliance - was.compliance).abs() < 1e-16
            );
        }
        assert_eq!((back.joints.len(), back.time_offset_s), (6, 0.012));
    }

    #[test]
    fn errors_name_the_key() {
        let wrong = [
            ("transmission_sin_deg = [0.1, 0.2]", "joint_corrections.transmission_sin_deg"),
            ("compliance_deg_per_m = [0, 0, nan, 0, 0, 0]", "joint_corrections.compliance_deg_per_m"),
            ("transmission_cos_deg = [0, 0, 50, 0, 0, 0]", "from -5 to 5"),
            ("time_offset_s = inf", "joint_corrections.time_offset_s"),
            ("backlash_deg = [0.1]", "backlash_deg"),
        ];
        for (table, named) in wrong {
            let message = with(table).unwrap_err().to_string();
            assert!(message.contains(named), "{table}: {message}");
        }
        assert!(with("transmission_sin_deg = [0, 0, 0, 0, 0, 0]").unwrap().joint_corrections.joints.is_empty());
    }

    #[test]
    fn earlier_keys_are_read() {
        let rig = with("gear_sin_deg = [0, 0.1, 0, 0, 0, 0]\ngear_cos_deg = [0.2, 0, 0, 0, 0, 0]").unwrap();
        let joints = &rig.joint_corrections.joints;
        assert!((joints[1].transmission_sin.to_degrees() - 0.1).abs() < 1e-12);
        assert!((joints[0].transmission_cos.to_degrees() - 0.2).abs() < 1e-12);
    }
}
