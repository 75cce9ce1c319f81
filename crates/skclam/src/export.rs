//! A calibrated arm in the forms that people use: URDF, `kinematics.yaml`, a static transform, a table of corrections,
//! JSON.

use crate::output::{OutputError, StagedFolder};
use serde::Serialize;
use skclam_kinematics::{
    Isometry3, KinematicsError, ParameterId, SerialChain, bare_urdf, chain_from_urdf, corrections_csv, kinematics_yaml,
    line_diff, static_transform_line, write_urdf,
};
use skclam_rig::{JointCorrection, JointCorrections, Rig};

/// A robot description into which the calibrated chain is written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UrdfSource {
    /// Its text.
    pub text: String,
    /// Link that is the chain's base.
    pub base_link: String,
    /// Link that is the chain's flange.
    pub tip_link: String,
}

/// Options of an export.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExportOptions {
    /// First link of a URDF that is written for an arm without one.
    pub base_frame: String,
    /// Frame of the flange in the static transform.
    pub flange_frame: String,
    /// Frame of the colour camera in the static transform: the optical one, z forward.
    pub camera_frame: String,
    /// Word that distinguishes one arm's calibration from another's in `kinematics.yaml`.
    pub hash: String,
}

impl Default for ExportOptions {
    fn default() -> Self {
        ExportOptions {
            base_frame: "base_link".to_owned(),
            flange_frame: "tool0".to_owned(),
            camera_frame: "camera_color_optical_frame".to_owned(),
            hash: "calib_skclam".to_owned(),
        }
    }
}

/// Why an export failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ExportError {
    /// A rig without an arm.
    #[error("the {which} rig has no [robot]; there is no arm to export")]
    NoRobot {
        /// "nominal" or "calibrated".
        which: &'static str,
    },
    /// No nominal arm to compare with.
    #[error("there is no nominal arm; give the nominal rig, or the URDF that the calibration began with")]
    NoNominal,
    /// The arms or the URDF do not fit together.
    #[error(transparent)]
    Kinematics(#[from] KinematicsError),
    /// The files could not be written.
    #[error(transparent)]
    Output(#[from] OutputError),
}

/// What was exported.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Exported {
    /// Names of the files.
    pub files: Vec<String>,
    /// The changed lines of the URDF.
    pub urdf_diff: Option<String>,
    /// The shell line that publishes the mount in ROS 2.
    pub static_transform: String,
    /// Files that this arm cannot have, and why.
    pub left_out: Vec<String>,
}

/// One parameter of the arm.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct ExportedParameter {
    name: String,
    unit: &'static str,
    nominal: f64,
    calibrated: f64,
    correction: f64,
}

/// A pose as numbers.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct ExportedPose {
    translation_mm: [f64; 3],
    quaternion_xyzw: [f64; 4],
}

impl From<&Isometry3> for ExportedPose {
    fn from(pose: &Isometry3) -> Self {
        let t = pose.translation.vector * 1e3;
        let q = pose.rotation.coords;
        ExportedPose { translation_mm: [t.x, t.y, t.z], quaternion_xyzw: [q.x, q.y, q.z, q.w] }
    }
}

#[derive(Debug, Serialize)]
struct ExportedJson {
    name: String,
    parameters: Vec<ExportedParameter>,
    flange_from_color_nominal: Option<ExportedPose>,
    flange_from_color: ExportedPose,
    #[serde(skip_serializing_if = "Option::is_none")]
    joint_corrections: Option<ExportedCorrections>,
}

/// What the joints do beside their encoders, one number a joint.
#[derive(Debug, Serialize)]
struct ExportedCorrections {
    transmission_sin_deg: Vec<f64>,
    transmission_cos_deg: Vec<f64>,
    compliance_deg_per_m: Vec<f64>,
    time_offset_s: f64,
}

impl ExportedCorrections {
    fn new(corrections: &JointCorrections) -> Self {
        let list = |of: fn(&JointCorrection) -> f64| corrections.joints.iter().map(|j| of(j).to_degrees()).collect();
        ExportedCorrections {
            transmission_sin_deg: list(|joint| joint.transmission_sin),
            transmission_cos_deg: list(|joint| joint.transmission_cos),
            compliance_deg_per_m: list(|joint| joint.compliance),
            time_offset_s: corrections.time_offset_s,
        }
    }
}

/// Writes a calibrated rig into a folder that the caller publishes. `nominal`: the rig that the calibration began with;
/// without it the chain of the URDF.
///
/// Written are `corrections.csv`, `parameters.json`, `static_transform.sh`, `robot.urdf` (with a URDF that one
/// corrected, beside `robot.urdf.diff`; without one a bare description of the chain), and for six revolute joints
/// `kinematics.yaml`. Every file with numbers says its units.
///
/// # Errors
/// [`ExportError`].
pub fn export(
    nominal: Option<&Rig>,
    calibrated: &Rig,
    urdf: Option<&UrdfSource>,
    options: &ExportOptions,
    staged: &StagedFolder,
) -> Result<Exported, ExportError> {
    let arm = calibrated.robot.as_ref().ok_or(ExportError::NoRobot { which: "calibrated" })?;
    let nominal_arm: SerialChain = match (nominal, urdf) {
        (Some(rig), _) => rig.robot.clone().ok_or(ExportError::NoRobot { which: "nominal" })?,
        (None, Some(urdf)) => chain_from_urdf(&urdf.text, &urdf.base_link, &urdf.tip_link)?,
        (None, None) => return Err(ExportError::NoNominal),
    };
    let mut files = Vec::new();
    let mut left_out = Vec::new();
    let corrected = !calibrated.joint_corrections.is_none();
    if corrected {
        let reason = "gear errors, compliance and time offset: only parameters.json has a place for them; `compensate` applies gears and compliance";
        left_out.push(reason.to_owned());
    }
    let mut write = |name: &str, text: &str| -> Result<(), ExportError> {
        staged.write(name, text)?;
        files.push(name.to_owned());
        Ok(())
    };
    write("corrections.csv", &corrections_csv(&nominal_arm, arm)?)?;
    let json = ExportedJson {
        name: calibrated.name.clone(),
        parameters: nominal_arm.parameter_ids().into_iter().map(|id| parameter(&nominal_arm, arm, id)).collect(),
        flange_from_color_nominal: nominal.map(|rig| (&rig.flange_from_color).into()),
        flange_from_color: (&calibrated.flange_from_color).into(),
        joint_corrections: corrected.then(|| ExportedCorrections::new(&calibrated.joint_corrections)),
    };
    let json =
        serde_json::to_string_pretty(&json).map_err(|error| KinematicsError::Export { problem: error.to_string() })?;
    write("parameters.json", &(json + "\n"))?;
    let static_transform =
        static_transform_line(&calibrated.flange_from_color, &options.flange_frame, &options.camera_frame)?;
    write("static_transform.sh", &format!("#!/bin/sh\n# Metres.\nexec {static_transform}\n"))?;
    match kinematics_yaml(arm, &options.hash) {
        Ok(yaml) => write("kinematics.yaml", &yaml)?,
        Err(error) => left_out.push(format!("kinematics.yaml: {error}")),
    }
    let mut urdf_diff = None;
    if let Some(urdf) = urdf {
        let text = write_urdf(&urdf.text, &urdf.base_link, &urdf.tip_link, &nominal_arm, arm)?;
        let diff = line_diff(&urdf.text, &text);
        write("robot.urdf", &text)?;
        write("robot.urdf.diff", &diff)?;
        urdf_diff = Some(diff);
    } else {
        write("robot.urdf", &bare_urdf(arm, &calibrated.name, &options.base_frame, &options.flange_frame))?;
    }
    Ok(Exported { files, urdf_diff, static_transform, left_out })
}

fn parameter(nominal: &SerialChain, calibrated: &SerialChain, id: ParameterId) -> ExportedParameter {
    let (unit, scale) = if id.kind.is_angle() { ("deg", 1f64.to_degrees()) } else { ("mm", 1e3) };
    let value = |chain: &SerialChain| scale * chain.parameter(id).unwrap_or_default();
    let (nominal, calibrated) = (value(nominal), value(calibrated));
    ExportedParameter { name: id.to_string(), unit, nominal, calibrated, correction: calibrated - nominal }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::Contents;
    use skclam_rig::builtin_rig;
    use skclam_simulation::{PerturbationSigmas, perturb_random};

    const URDF: &str = r#"<robot name="r">
  <!-- a comment that stays -->
  <link name="base"/><link name="a"/><link name="tip"/>
  <joint name="j1" type="revolute">
    <parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <joint name="j2" type="revolute">
    <parent link="a"/><child link="tip"/>
    <origin xyz="0.2 0 0.1" rpy="1.5707963267948966 0 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
</robot>
"#;

    #[test]
    fn a_urdf_comes_back_with_the_calibrated_chain() {
        let source = UrdfSource { text: URDF.to_owned(), base_link: "base".to_owned(), tip_link: "tip".to_owned() };
        let chain = chain_from_urdf(URDF, "base", "tip").unwrap();
        let nominal = Rig { robot: Some(chain), ..builtin_rig("hp3j").unwrap().unwrap() };
        let calibrated = perturb_random(&nominal, 3, &PerturbationSigmas::default()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("export");
        let staged = StagedFolder::new(&out, Contents::Export).unwrap();
        let done = export(None, &calibrated, Some(&source), &ExportOptions::default(), &staged).unwrap();
        staged.publish().unwrap();
        let text = std::fs::read_to_string(out.join("robot.urdf")).unwrap();
        assert!(text.contains("a comment that stays") && done.urdf_diff.unwrap().contains("+ "));
        let back = chain_from_urdf(&text, "base", "tip").unwrap();
        for joints in [[0.0, 0.0], [0.7, -1.1]] {
            let wanted = calibrated.robot.as_ref().unwrap().base_from_flange(&joints).unwrap();
            let written = back.base_from_flange(&joints).unwrap();
            assert!((wanted.to_homogeneous() - written.to_homogeneous()).norm() < 1e-9);
        }
        assert!(done.left_out[0].contains("kinematics.yaml") && !out.join("kinematics.yaml").exists());
        for name in &done.files {
            assert!(out.join(name).is_file(), "{name}");
        }
    }

    #[test]
    fn six_joints_have_a_kinematics_yaml_and_every_parameter_is_in_the_json() {
        let nominal = builtin_rig("ur5e").unwrap().unwrap();
        let calibrated = perturb_random(&nominal, 3, &PerturbationSigmas::default()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("export");
        let staged = StagedFolder::new(&out, Contents::Export).unwrap();
        let done = export(Some(&nominal), &calibrated, None, &ExportOptions::default(), &staged).unwrap();
        staged.publish().unwrap();
        assert!(out.join("kinematics.yaml").is_file() && done.left_out.is_empty() && done.urdf_diff.is_none());
        let json: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(out.join("parameters.json")).unwrap()).unwrap();
        let arm = nominal.robot.as_ref().unwrap();
        assert_eq!(json["parameters"].as_array().unwrap().len(), arm.parameter_ids().len());
        assert!(json["parameters"][0]["correction"].as_f64().unwrap() != 0.0);
        assert!(done.static_transform.starts_with("ros2 run tf2_ros static_transform_publisher"));
        let handless = Rig { robot: None, ..nominal };
        let staged = StagedFolder::new(folder.path().join("other"), Contents::Export).unwrap();
        let error = export(Some(&handless), &calibrated, None, &ExportOptions::default(), &staged).unwrap_err();
        assert!(error.to_string().contains("the nominal rig has no [robot]"));
    }
}
