//! A calibrated arm in the forms that people use: URDF, `kinematics.yaml`, a static transform, a table of corrections,
//! JSON.

mod mount;

use crate::camera_frames::CameraFrames;
use crate::output::{OutputError, StagedFolder};
use mount::{ExportedMount, ExportedPose, mount};
use serde::Serialize;
use skclam_kinematics::{
    KinematicsError, ParameterId, SerialChain, bare_urdf, chain_from_urdf, corrections_csv, kinematics_yaml,
    kinematics_yaml_of_table, line_diff, static_transform_line, write_urdf,
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
    /// Whether it was asked for: what cannot be written into it is an error then, and else left out with the reason.
    pub is_wanted: bool,
}

/// Options of an export.
#[derive(Debug, Clone, PartialEq)]
pub struct ExportOptions {
    /// First link of a URDF that is written for an arm without one.
    pub base_frame: String,
    /// Frame of the flange in the static transform.
    pub flange_frame: String,
    /// Optical frame of the colour camera, z forward, for the static transform. `None`: the frame at the root of the
    /// driver's tree of `frames`, or the usual name.
    pub camera_frame: Option<String>,
    /// How the camera's driver names its frames.
    pub frames: Option<CameraFrames>,
    /// Word that distinguishes one arm's calibration from another's in `kinematics.yaml`.
    pub hash: String,
}

impl Default for ExportOptions {
    fn default() -> Self {
        ExportOptions {
            base_frame: "base_link".to_owned(),
            flange_frame: "tool0".to_owned(),
            camera_frame: None,
            frames: None,
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

/// Name of the optical frame where nobody says it.
pub const USUAL_CAMERA_FRAME: &str = "camera_color_optical_frame";

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
    /// What to know of the files that were written.
    pub notes: Vec<String>,
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
/// Written are `static_transform.sh` and `mount.json`, and for a rig with an arm `corrections.csv`, `parameters.json`,
/// `robot.urdf` (with a URDF that one corrected, beside `robot.urdf.diff`; without one a bare description of the chain),
/// and for the arms of Universal Robots `kinematics.yaml`. Every file with numbers says its units.
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
    let mut files = Files { staged, names: vec![], left_out: vec![] };
    let mount = mount(calibrated, options);
    let static_transform = static_transform_line(&mount.flange_from_child, &options.flange_frame, &mount.child_frame)?;
    files.write("static_transform.sh", &format!("#!/bin/sh\n# Metres.\nexec {static_transform}\n"))?;
    let exported = ExportedMount {
        flange_frame: options.flange_frame.clone(),
        child_frame: mount.child_frame,
        flange_from_child: (&mount.flange_from_child).into(),
        flange_from_color: (&calibrated.flange_from_color).into(),
        flange_from_color_nominal: nominal.map(|rig| (&rig.flange_from_color).into()),
    };
    files.write("mount.json", &json(&exported)?)?;
    let urdf_diff = match &calibrated.robot {
        Some(arm) => export_arm(nominal, calibrated, arm, urdf, options, &mut files)?,
        None => {
            let reason = "corrections.csv, parameters.json, robot.urdf, kinematics.yaml: the calibrated rig has no [robot]; flange poses give the mount alone";
            files.left_out.push(reason.to_owned());
            None
        }
    };
    let Files { names, left_out, .. } = files;
    Ok(Exported { files: names, urdf_diff, static_transform, left_out, notes: mount.notes })
}

/// What was written, and what was not.
struct Files<'a> {
    staged: &'a StagedFolder,
    names: Vec<String>,
    left_out: Vec<String>,
}

impl Files<'_> {
    fn write(&mut self, name: &str, text: &str) -> Result<(), ExportError> {
        self.staged.write(name, text)?;
        self.names.push(name.to_owned());
        Ok(())
    }
}

fn json(value: &impl Serialize) -> Result<String, ExportError> {
    let text =
        serde_json::to_string_pretty(value).map_err(|error| KinematicsError::Export { problem: error.to_string() })?;
    Ok(text + "\n")
}

/// The files of an arm; the changed lines of its URDF.
fn export_arm(
    nominal: Option<&Rig>,
    calibrated: &Rig,
    arm: &SerialChain,
    urdf: Option<&UrdfSource>,
    options: &ExportOptions,
    files: &mut Files<'_>,
) -> Result<Option<String>, ExportError> {
    let nominal_arm: SerialChain = match (nominal, urdf) {
        (Some(rig), _) => rig.robot.clone().ok_or(ExportError::NoRobot { which: "nominal" })?,
        (None, Some(urdf)) => chain_from_urdf(&urdf.text, &urdf.base_link, &urdf.tip_link)?,
        (None, None) => return Err(ExportError::NoNominal),
    };
    let corrected = !calibrated.joint_corrections.is_none();
    if corrected {
        let reason = "gear errors, compliance and time offset: only parameters.json has a place for them; `compensate` applies gears and compliance";
        files.left_out.push(reason.to_owned());
    }
    files.write("corrections.csv", &corrections_csv(&nominal_arm, arm)?)?;
    let parameters = ExportedJson {
        name: calibrated.name.clone(),
        parameters: nominal_arm.parameter_ids().into_iter().map(|id| parameter(&nominal_arm, arm, id)).collect(),
        flange_from_color_nominal: nominal.map(|rig| (&rig.flange_from_color).into()),
        flange_from_color: (&calibrated.flange_from_color).into(),
        joint_corrections: corrected.then(|| ExportedCorrections::new(&calibrated.joint_corrections)),
    };
    files.write("parameters.json", &json(&parameters)?)?;
    let yaml = match urdf {
        Some(urdf) => kinematics_yaml(&urdf.text, &urdf.base_link, &urdf.tip_link, &nominal_arm, arm, &options.hash),
        None => kinematics_yaml_of_table(&nominal_arm, arm, &options.hash),
    };
    match yaml {
        Ok(yaml) => files.write("kinematics.yaml", &yaml)?,
        Err(error) => files.left_out.push(format!("kinematics.yaml: {error}")),
    }
    let written = urdf.map(|urdf| (urdf, write_urdf(&urdf.text, &urdf.base_link, &urdf.tip_link, &nominal_arm, arm)));
    match written {
        Some((urdf, Ok(text))) => {
            let diff = line_diff(&urdf.text, &text);
            files.write("robot.urdf", &text)?;
            files.write("robot.urdf.diff", &diff)?;
            return Ok(Some(diff));
        }
        Some((urdf, Err(error))) if urdf.is_wanted => return Err(error.into()),
        Some((_, Err(error))) => {
            files
                .left_out
                .push(format!("the corrected URDF of the rig, for which a bare robot.urdf is written: {error}"));
        }
        None => {}
    }
    let bare = bare_urdf(arm, &calibrated.name, &options.base_frame, &options.flange_frame);
    files.write("robot.urdf", &bare)?;
    Ok(None)
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
        let source = UrdfSource {
            text: URDF.to_owned(),
            base_link: "base".to_owned(),
            tip_link: "tip".to_owned(),
            is_wanted: true,
        };
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

    #[test]
    fn a_mount_without_an_arm_is_exported_and_the_rest_left_out() {
        let rig = Rig { robot: None, ..builtin_rig("ur5e").unwrap().unwrap() };
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("export");
        let staged = StagedFolder::new(&out, Contents::Export).unwrap();
        let done = export(Some(&rig), &rig, None, &ExportOptions::default(), &staged).unwrap();
        staged.publish().unwrap();
        assert_eq!(done.files, ["static_transform.sh", "mount.json"]);
        assert!(done.left_out[0].contains("no [robot]"), "{:?}", done.left_out);
        let mount: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(out.join("mount.json")).unwrap()).unwrap();
        assert_eq!(mount["child_frame"], USUAL_CAMERA_FRAME);
    }
}
