//! One run beside its truth: the only module that reads what a run says.
//!
//! Numbers of the estimate come from [`Outcome`]; what a person is shown (status, first sentence, causes) from the
//! summary as JSON, where keys are looked up by name and a missing one is an error.

use crate::causes::{Cause, named, of_entry};
use crate::gauge::{Score, score};
use crate::true_poses::{CameraError, TruePoses, workspace_postures};
use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use skclam::calibration::{orientation_sigma_rad, pose_covariances, position_sigma_m};
use skclam::dataset::Dataset;
use skclam::pipeline::{self, Config, Outcome};
use skclam::progress::Silent;
use skclam::rig::{Posture, Rig};

/// The status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Status {
    /// Use it.
    Green,
    /// Look first.
    Amber,
    /// Do not use it.
    Red,
    /// The run ended with an error instead of an answer.
    Refused,
}

/// True and claimed error of the camera over some postures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Compared {
    /// Of the answer, RMS after the base's gauge.
    pub truth: CameraError,
    /// Of the nominal rig, the same.
    pub nominal: CameraError,
    /// Of the answer, RMS of positions after the best rigid motion of the base, mm: what a value "with the base frame
    /// fitted" means.
    pub aligned_mm: f64,
    /// Root of the mean claimed variance; `None` where the estimator claims nothing.
    pub claimed: Option<CameraError>,
}

impl Compared {
    /// True over claimed error of the position; `None` where nothing is claimed.
    pub fn ratio(&self) -> Option<f64> {
        self.claimed.map(|claimed| self.truth.mm / claimed.mm)
    }
}

/// What a run is given and shown as.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shown {
    /// The status.
    pub status: Status,
    /// The first sentence, or the error's text.
    pub sentence: String,
    /// What the first sentence claims of the camera's position over the recorded postures, mm: with the base frame
    /// fitted, or (older versions) the mean sigma.
    pub sentence_sigma_mm: Option<f64>,
    /// Mean standard deviation of the camera's position over the recorded postures, mm: what `inspect` predicts.
    pub camera_sigma_mm: Option<f64>,
    /// What is wrong in the order in which it is shown: sentence, checks that are not passed, warnings.
    pub statements: Vec<String>,
    /// The causes that the summary lists by type, then those that the statements name in words.
    pub causes: Vec<Cause>,
    /// Held-out metrics of the nominal rig, the mount alone and the calibrated rig.
    pub held_out: Option<[Option<f64>; 3]>,
}

/// One run beside its truth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measured {
    /// Over the recorded postures; `None` where the run was refused.
    pub recorded: Option<Compared>,
    /// Over the workspace; `None` for flange poses.
    pub workspace: Option<Compared>,
    /// What a person sees.
    pub shown: Shown,
    /// Scale error of camera positions over the workspace, percent.
    pub scale_error_percent: Option<f64>,
    /// CPU seconds of the run over all threads.
    pub seconds: f64,
}

/// Postures over the workspace.
const WORKSPACE_POSTURES: usize = 200;

/// Runs a recording with all defaults, the map included, as `skclam run` does.
///
/// # Errors
/// Those of the pipeline.
pub fn run_default(dataset: &Dataset) -> Result<Outcome> {
    Ok(pipeline::run(dataset, &Config::default(), &Silent)?)
}

/// Measures an outcome. `recorded`: what the rig should say at the recording's postures. `truth`: the true rig, for the
/// workspace.
///
/// # Errors
/// Postures that do not belong to the rig, a summary without the keys that are read.
pub fn measure(nominal: &Rig, truth: &Rig, recorded: &TruePoses, outcome: &Outcome, seconds: f64) -> Result<Measured> {
    let workspace = workspace_of(truth, outcome)?;
    Ok(Measured {
        recorded: Some(compare(nominal, recorded, outcome)?),
        workspace: workspace.as_ref().map(|poses| compare(nominal, poses, outcome)).transpose()?,
        shown: shown(&serde_json::to_value(&outcome.summary)?)?,
        scale_error_percent: workspace.map(|poses| poses.scale_error_percent(&outcome.rig)).transpose()?,
        seconds,
    })
}

/// The parameters of an outcome beside their truth.
///
/// # Errors
/// No covariance, or a truth that the free parameters cannot express.
pub fn parameters(nominal: &Rig, truth: &Rig, outcome: &Outcome) -> Result<Score> {
    let poses = workspace_of(truth, outcome)?.context("flange poses have no arm to judge")?;
    score(nominal, truth, &outcome.calibration, &poses)
}

/// A run that ended with an error: it shows a text and claims nothing.
pub fn refused(error: &anyhow::Error, seconds: f64) -> Measured {
    let sentence = format!("{error:#}");
    let statements = vec![sentence.clone()];
    let causes = named(&statements);
    let shown = Shown {
        status: Status::Refused,
        sentence,
        sentence_sigma_mm: None,
        camera_sigma_mm: None,
        statements,
        causes,
        held_out: None,
    };
    Measured { recorded: None, workspace: None, shown, scale_error_percent: None, seconds }
}

fn workspace_of(truth: &Rig, outcome: &Outcome) -> Result<Option<TruePoses>> {
    let has_arm = outcome.calibration.parameters.iter().any(|estimate| estimate.parameter.needs_joints());
    let (Some(robot), true) = (&truth.robot, has_arm) else { return Ok(None) };
    Ok(Some(TruePoses::of_rig(truth, &workspace_postures(robot, WORKSPACE_POSTURES, 1))?))
}

fn compare(nominal: &Rig, poses: &TruePoses, outcome: &Outcome) -> Result<Compared> {
    let claimed = claimed(nominal, outcome, &poses.postures)?;
    Ok(Compared {
        truth: poses.error_of(&outcome.rig)?,
        nominal: poses.error_of(nominal)?,
        aligned_mm: poses.aligned_error_mm(&outcome.rig)?,
        claimed,
    })
}

/// Root of the mean claimed variance over postures.
///
/// # Errors
/// Postures that do not belong to the rig.
pub fn claimed(nominal: &Rig, outcome: &Outcome, postures: &[Posture]) -> Result<Option<CameraError>> {
    let Some(covariances) = pose_covariances(nominal, &outcome.calibration, postures)? else { return Ok(None) };
    let rms = |sigma: &dyn Fn(usize) -> f64| {
        ((0..postures.len()).map(|at| sigma(at).powi(2)).sum::<f64>() / postures.len() as f64).sqrt()
    };
    Ok(Some(CameraError {
        mm: 1e3 * rms(&|at| position_sigma_m(&covariances[at].camera)),
        deg: rms(&|at| orientation_sigma_rad(&covariances[at].camera)).to_degrees(),
    }))
}

/// What a summary shows.
///
/// # Errors
/// A summary without status or sentence, or with a status that is not known.
pub fn shown(summary: &Value) -> Result<Shown> {
    let sentence = first(summary, &["/verdict/sentence", "/verdict"])?;
    let sentence = sentence.as_str().map_or_else(|| sentence.to_string(), str::to_owned);
    let status = first(summary, &["/status"])?;
    let status = match status.as_str().unwrap_or_default() {
        "good" | "green" | "use" => Status::Green,
        "caution" | "amber" => Status::Amber,
        "bad" | "red" | "do_not_use" => Status::Red,
        other => bail!("the summary's status \"{other}\" is not known"),
    };
    let statements = statements(summary, &sentence)?;
    let mut causes = Vec::new();
    for entry in summary.pointer("/causes").and_then(Value::as_array).into_iter().flatten() {
        causes.extend(of_entry(entry)?);
    }
    causes.extend(named(&statements));
    let held_out = summary.pointer("/held_out").filter(|value| !value.is_null());
    let held_out = held_out.map(|value| first(value, &["/metric_px", "/figure_px"])).transpose()?;
    let sigma = ["/recorded_poses/registered/sigma_mm", "/recorded_poses/camera_sigma_mm/mean"];
    Ok(Shown {
        status,
        sentence,
        sentence_sigma_mm: sigma.iter().find_map(|key| summary.pointer(key)?.as_f64()),
        camera_sigma_mm: summary.pointer(sigma[1]).and_then(Value::as_f64),
        causes,
        statements,
        held_out: held_out
            .map(|px| ["/nominal", "/mount_only", "/calibrated"].map(|key| px.pointer(key).and_then(Value::as_f64))),
    })
}

/// The sentence, the checks that are not passed, and the warnings.
fn statements(summary: &Value, sentence: &str) -> Result<Vec<String>> {
    let list = |key: &str| summary.pointer(key).and_then(Value::as_array).cloned();
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let checks = list("/checks").context("the summary has no checks")?;
    let good = |check: &&Value| {
        let status = check.pointer("/status");
        !matches!(status.and_then(Value::as_str), Some("good" | "green"))
    };
    let mut statements = vec![sentence.to_owned()];
    statements.extend(checks.iter().filter(good).map(|check| check.pointer("/text").map_or_else(|| text(check), text)));
    statements.extend(list("/warnings").context("the summary has no warnings")?.iter().map(text));
    Ok(statements)
}

fn first<'a>(value: &'a Value, keys: &[&str]) -> Result<&'a Value> {
    keys.iter()
        .find_map(|key| value.pointer(key))
        .with_context(|| format!("the summary has none of {}", keys.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_summary_is_read_by_its_keys_and_a_missing_one_is_an_error() {
        let summary = json!({
            "verdict": "DO NOT TRUST this.", "status": "bad", "warnings": ["the focal length is off"],
            "checks": [{"status": "good", "text": "a time offset would be named here"}, {"status": "caution", "text": "few postures"}],
            "recorded_poses": {"camera_sigma_mm": {"mean": 0.3}},
            "held_out": {"figure_px": {"nominal": 3.0, "mount_only": null, "calibrated": 1.0}}
        });
        let found = shown(&summary).unwrap();
        assert_eq!((found.status, found.sentence_sigma_mm), (Status::Red, Some(0.3)));
        assert_eq!(found.causes, [Cause::FewPostures, Cause::FocalLength]);
        assert_eq!(found.held_out, Some([Some(3.0), None, Some(1.0)]));
        let mut unknown = summary.clone();
        unknown["status"] = json!("purple");
        assert!(shown(&unknown).is_err());
        let mut bare = summary;
        bare.as_object_mut().unwrap().remove("verdict");
        assert!(shown(&bare).unwrap_err().to_string().contains("/verdict"));
    }
}
