//! The traffic light: whether the calibration can be trusted, and why.

use crate::RunResult;

/// Three answers; each has a word and a shape beside its colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Light {
    /// Use it.
    Green,
    /// Look at the reasons first.
    Amber,
    /// Do not use it.
    Red,
}

/// The light and what speaks for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Judgement {
    /// The worst that any reason calls for.
    pub light: Light,
    /// What was looked at, with what each calls for; worst first.
    pub reasons: Vec<(Light, String)>,
}

impl Light {
    /// What it says.
    pub fn word(self) -> &'static str {
        match self {
            Light::Green => "Use it",
            Light::Amber => "Check first",
            Light::Red => "Do not use it",
        }
    }

    /// Name of its style and of its picture.
    pub(crate) fn class(self) -> &'static str {
        match self {
            Light::Green => "green",
            Light::Amber => "amber",
            Light::Red => "red",
        }
    }
}

/// Matches farther from their lines than this in the median are not explained by the rig, px.
const UNEXPLAINED_PX: f64 = 2.0;
/// From this ratio on the depth images are said to agree less, or more.
const WORSE_AGREEMENT: f64 = 1.05;
/// More outliers than this are many.
const MANY_OUTLIERS: f64 = 0.2;

/// Judges a run by its summary.
pub fn judge(run: &RunResult) -> Judgement {
    let mut reasons = Vec::new();
    grade(run, &mut reasons);
    surfaces(run, &mut reasons);
    estimate(run, &mut reasons);
    // Stable: among equals, the order in which they were looked at.
    reasons.sort_by_key(|(light, _)| std::cmp::Reverse(*light));
    // The run's own grade is heard even where no reason here calls for as much.
    let light = reasons.iter().map(|(light, _)| *light).fold(graded(run), Light::max);
    Judgement { light, reasons }
}

/// The run's own judgement.
fn graded(run: &RunResult) -> Light {
    match run.text("/grade") {
        "good" => Light::Green,
        "bad" => Light::Red,
        _ => Light::Amber,
    }
}

/// What the run's judgement rests on.
fn grade(run: &RunResult, reasons: &mut Vec<(Light, String)>) {
    let light = graded(run);
    let px = |which: &str| run.number(&format!("/held_out/figure_px/{which}"));
    let beats_nominal = px("calibrated").zip(px("nominal")).is_some_and(|(calibrated, nominal)| calibrated < nominal);
    let beats_mount = px("calibrated").zip(px("mount_only")).is_none_or(|(calibrated, mount)| calibrated < mount);
    let told = match (px("nominal"), px("calibrated"), px("mount_only")) {
        (Some(nominal), Some(calibrated), _) if calibrated >= nominal => {
            "On postures that it was not fitted to (held out) it is no better than the nominal rig."
        }
        (Some(_), Some(calibrated), Some(mount)) if calibrated >= mount => {
            "On postures that it was not fitted to (held out), correcting the mount alone does as well as correcting the arm."
        }
        (Some(_), Some(_), _) if light == Light::Green => "It holds on postures that it was not fitted to (held out).",
        // What is wrong then is said by another reason.
        (Some(_), Some(_), _) => "It is better than the nominal rig on postures that it was not fitted to (held out).",
        _ => "It was not tried on postures that it was not fitted to (no held-out test).",
    };
    let median = |which: &str| run.number(&format!("/calibration/epipolar_{which}/median_px"));
    if let (Some(before), Some(after)) = (median("before"), median("after")) {
        if after > UNEXPLAINED_PX {
            let text = format!(
                "The calibrated rig does not explain the images: matches stay {after:.1} px from their lines in the median."
            );
            reasons.push((Light::Red, text));
        } else if after >= before && before > 0.0 {
            reasons.push((light.max(Light::Amber), "The matches fit no better than with the nominal rig.".to_owned()));
        }
    }
    reasons.push((if beats_nominal && beats_mount { Light::Green } else { light }, told.to_owned()));
    if let Some(outliers) = run.number("/calibration/outlier_fraction").filter(|&share| share > MANY_OUTLIERS) {
        reasons.push((Light::Amber, format!("{:.0} % of the correspondences do not fit.", outliers * 100.0)));
    }
}

fn surfaces(run: &RunResult, reasons: &mut Vec<(Light, String)>) {
    let median = |which: &str| run.number(&format!("/map/agreement_{which}/median_mm"));
    let (Some(before), Some(after)) = (median("nominal"), median("calibrated")) else { return };
    if after > before * WORSE_AGREEMENT {
        let text = format!(
            "The depth images agree less than before ({before:.1} mm to {after:.1} mm apart): matches and depth contradict each other."
        );
        reasons.push((Light::Amber, text));
    } else if after * WORSE_AGREEMENT < before {
        reasons.push((Light::Green, "The surfaces of the depth images agree better than before.".to_owned()));
    } else {
        reasons.push((Light::Green, "The surfaces of the depth images agree as well as before.".to_owned()));
    }
}

fn estimate(run: &RunResult, reasons: &mut Vec<(Light, String)>) {
    let reason = run.summary.pointer("/calibration/termination/reason").and_then(|reason| reason.as_object());
    if reason.is_some_and(|reason| reason.contains_key("iteration_limit")) {
        reasons.push((Light::Amber, "The solver stopped at its limit of iterations before it converged.".to_owned()));
    }
    let unseen = run.list("/calibration/not_identifiable").len();
    if unseen > 0 {
        let what = if unseen == 1 { "combination of parameters is" } else { "combinations of parameters are" };
        reasons.push((
            Light::Amber,
            format!("{unseen} {what} not seen by the data; see \u{201c}What the data cannot tell\u{201d}."),
        ));
    }
    if run.summary.pointer("/calibration/arm").and_then(|arm| arm.as_bool()) == Some(false) {
        reasons
            .push((Light::Amber, "Only flange poses are known: the mount is calibrated, the arm is not.".to_owned()));
    }
    let suspects = run.list("/warnings").iter().filter_map(|text| text.as_str());
    let suspects = suspects.filter(|text| text.starts_with("posture ") && text.contains("does not fit")).count();
    if suspects > 0 {
        let what = if suspects == 1 { "posture does" } else { "postures do" };
        reasons.push((Light::Amber, format!("{suspects} {what} not fit the others; see the warnings.")));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn run(summary: serde_json::Value) -> RunResult {
        RunResult { name: "run".to_owned(), summary, data: None }
    }

    fn good() -> serde_json::Value {
        json!({
            "calibration": {
                "arm": true, "outlier_fraction": 0.01, "not_identifiable": [],
                "epipolar_before": {"median_px": 30.0}, "epipolar_after": {"median_px": 0.1},
                "termination": {"reason": {"cost_converged": {}}}
            },
            "map": {"agreement_nominal": {"median_mm": 16.0}, "agreement_calibrated": {"median_mm": 5.0}},
            "grade": "good",
            "held_out": {"figure_px": {"nominal": 30.0, "mount_only": 20.0, "calibrated": 0.2}},
            "warnings": []
        })
    }

    fn changed(pointer: &str, value: serde_json::Value) -> Light {
        let mut summary = good();
        *summary.pointer_mut(pointer).expect("a field") = value;
        judge(&run(summary)).light
    }

    #[test]
    fn each_fault_has_its_light() {
        assert_eq!(judge(&run(good())).light, Light::Green);
        assert_eq!(changed("/calibration/epipolar_after/median_px", json!(2.5)), Light::Red);
        assert_eq!(changed("/calibration/epipolar_after/median_px", json!(1.9)), Light::Green);
        assert_eq!(changed("/calibration/epipolar_before/median_px", json!(0.05)), Light::Amber);
        assert_eq!(changed("/calibration/outlier_fraction", json!(0.3)), Light::Amber);
        assert_eq!(changed("/calibration/not_identifiable", json!(["x"])), Light::Amber);
        assert_eq!(changed("/calibration/arm", json!(false)), Light::Amber);
        assert_eq!(changed("/calibration/termination/reason", json!({"iteration_limit": {"limit": 3}})), Light::Amber);
        assert_eq!(changed("/map/agreement_calibrated/median_mm", json!(17.0)), Light::Amber);
        assert_eq!(changed("/grade", json!("caution")), Light::Amber);
        assert_eq!(changed("/grade", json!("bad")), Light::Red);
        let suspect = json!(["posture 3 (index 3) does not fit: 80 % outliers"]);
        assert_eq!(changed("/warnings", suspect), Light::Amber);
    }

    #[test]
    fn the_worst_reason_comes_first() {
        let mut summary = good();
        summary["held_out"] = json!(null);
        summary["calibration"]["epipolar_after"]["median_px"] = json!(9.0);
        let judgement = judge(&run(summary));
        assert_eq!(judgement.reasons[0].0, Light::Red);
        assert!(judgement.reasons.is_sorted_by_key(|(light, _)| std::cmp::Reverse(*light)));
    }
}
