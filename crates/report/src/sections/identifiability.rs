//! What is not identifiable, why, and what to record to make it so.

use crate::RunResult;
use crate::charts::{Digits, Numbers};
use crate::html::{escaped, table};
use crate::page::Section;
use serde::Deserialize as _;
use serde_json::Value;
use skclam::calibration::UnobservableCause;
use skclam::summary::NotIdentifiable;

pub(crate) fn section(run: &RunResult) -> Section {
    let numbers = Numbers::of(run);
    let mut html = String::new();
    if run.number("/calibration/rank").is_none() {
        html += "<p>This estimator (Nelder-Mead, the paper's) gives no covariance and does not analyse identifiability. The default preset does.</p>\n";
    } else {
        html += &format!(
            "<p>{} of {} combinations of the free parameters are identifiable. Condition number {}: the best-determined combination is \
             determined so many times more precisely than the worst.</p>\n",
            numbers.show("/calibration/rank", Digits::Whole),
            numbers.show("/calibration/free", Digits::Whole),
            numbers.show("/calibration/condition_number", Digits::Significant(3)),
        );
        let reasons: Vec<Vec<String>> = run
            .list("/calibration/not_identifiable")
            .iter()
            .filter_map(|found| NotIdentifiable::deserialize(found).ok())
            .map(|found| vec![escaped(&found.text), escaped(advice(found.cause))])
            .collect();
        html += &if reasons.is_empty() {
            "<p>All free parameters are identifiable.</p>\n".to_owned()
        } else {
            table("words", "Not identifiable: held by the priors, not by the data", &["What", "What to do"], &reasons)
        };
        let arm = run.summary.pointer("/calibration/arm").and_then(Value::as_bool) == Some(true);
        if arm && run.text("/configuration/free").starts_with("auto") {
            html += GAUGE;
        }
        let names = ["O1", "O2", "O3", "O4", "O5"];
        let row: Vec<String> = std::iter::once("Value".to_owned())
            .chain((0..5).map(|k| numbers.show(&format!("/calibration/observability/{k}"), Digits::Significant(3))))
            .collect();
        let head: Vec<&str> = std::iter::once("Index").chain(names).collect();
        html += &table("numbers", "Observability indices (greater is better)", &head, &[row]);
    }
    Section { id: "identifiability", title: "Identifiability", html, charts: Vec::new() }
}

/// What `auto` holds because no posture makes it identifiable.
const GAUGE: &str = "<p>Held at nominal, because not identifiable from images: where the base is (a rotation about and a shift along axis 1), and how the flange is turned about and \
     shifted along the last axis, which is one with the mount. Camera poses and the map do not depend on the second; the flange's poses, an exported tool frame \
     and compensated targets are only as right as the nominal values there. Measure them by other means if they matter.</p>\n";

/// What to record, or to give, so that it becomes identifiable.
fn advice(cause: UnobservableCause) -> &'static str {
    match cause {
        UnobservableCause::BaseGauge => {
            "No recording of the camera determines it; measure the base's place by other means, or leave it."
        }
        UnobservableCause::ToolGauge => {
            "Nothing to record: only the sum of both matters. Hold one of the two (--free without it)."
        }
        UnobservableCause::Scale => {
            "Give one known length: depth images, or a board in the rig file; or hold the depth's scale."
        }
        UnobservableCause::ParallelAxes => "Nothing to record: hold one of the two, the other takes the sum.",
        UnobservableCause::InsufficientExcitation => {
            "Record postures in which this joint turns by 60 deg or more, in both directions, with the others moving as well."
        }
        _ => {
            "Record more postures that differ in the wrist's orientation and in reach, that look at the same scene from other sides."
        }
    }
}
