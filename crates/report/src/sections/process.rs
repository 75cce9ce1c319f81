//! What went on: the filters, the solver, time and memory, warnings.

use crate::RunResult;
use crate::charts::{Digits, Numbers};
use crate::html::{bar, escaped, table};
use crate::page::Section;
use serde_json::Value;

pub(crate) fn section(run: &RunResult) -> Section {
    let html = format!("{}{}{}{}", warnings(run), filters(run), solver(run), stages(run));
    Section { id: "process", title: "Run details", html, charts: Vec::new() }
}

fn warnings(run: &RunResult) -> String {
    let list = run.list("/warnings");
    if list.is_empty() {
        return "<h3>Warnings</h3>\n<p>None.</p>\n".to_owned();
    }
    let items: String =
        list.iter().filter_map(Value::as_str).map(|text| format!("<li>{}</li>\n", escaped(text))).collect();
    format!("<h3>Warnings</h3>\n<ul>\n{items}</ul>\n")
}

fn filters(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let steps = [
        ("Keypoints of the first images", "/matching/keypoints_a"),
        ("with a nearest neighbour", "/matching/candidates"),
        ("after the limit on the distance", "/matching/after_max_distance"),
        ("after the epipolar gate", "/matching/after_gate"),
        ("after the ratio test", "/matching/after_ratio"),
        ("after the cross-check", "/matching/after_cross_check"),
        ("after taking the best", "/matching/after_best"),
        ("after RANSAC", "/matching/after_ransac"),
        ("matches given to the estimator", "/counts/matches"),
    ];
    let mut steps: Vec<(&str, &str, f64)> =
        steps.into_iter().filter_map(|(name, pointer)| Some((name, pointer, run.number(pointer)?))).collect();
    // The order of gate and ratio test depends on the search; what is left only shrinks. The first and the last stay.
    if steps.len() > 3 {
        let last = steps.len() - 1;
        steps[2..last].sort_by(|x, y| y.2.total_cmp(&x.2));
    }
    let most = steps.iter().map(|step| step.2).fold(1.0, f64::max);
    let mut rows: Vec<Vec<String>> = steps
        .iter()
        .map(|(name, pointer, count)| {
            vec![(*name).to_owned(), numbers.show(pointer, Digits::Whole), bar(count / most, "neutral")]
        })
        .collect();
    for (name, pointer) in [
        ("tracks (points followed over several images)", "/counts/tracks"),
        ("observations of tracks", "/counts/observations"),
        ("positions refined to a fraction of a pixel", "/tracks/refined"),
        ("positions rejected by the refinement", "/tracks/rejected"),
        ("links that conflicted with a track", "/tracks/links/conflicts"),
    ] {
        if run.number(pointer).is_some() {
            rows.push(vec![name.to_owned(), numbers.show(pointer, Digits::Whole), String::new()]);
        }
    }
    let mut html = format!(
        "<h3>Filters</h3>\n{}",
        table("numbers bars", "What each step left, summed over all pairs", &["Step", "Left", "Fraction"], &rows)
    );
    if run.number("/ego_mask/dropped_keypoints").is_some_and(|dropped| dropped > 0.0) {
        html += &format!(
            "<p>{} keypoints on what moves with the camera were left out ({}&nbsp;of the image, as a fraction of 1).</p>\n",
            numbers.show("/ego_mask/dropped_keypoints", Digits::Whole),
            numbers.show("/ego_mask/masked_fraction", Digits::Decimals(2)),
        );
    }
    html
}

fn solver(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let rows = [
        ("Iterations", "/calibration/termination/iterations", Digits::Whole, ""),
        ("Evaluations of the cost", "/calibration/termination/evaluations", Digits::Whole, ""),
        ("Rounds (noise re-estimated)", "/calibration/termination/rounds", Digits::Whole, ""),
        (
            "Cost at the start, by the first estimate of the noise",
            "/calibration/termination/initial_cost",
            Digits::Significant(4),
            "",
        ),
        ("Cost at the end, by the last", "/calibration/termination/final_cost", Digits::Significant(4), ""),
        ("Noise of pixels, times their own sigmas", "/calibration/pixel_sigma", Digits::Significant(3), ""),
        ("Noise of a depth, sigma / depth\u{b2}", "/calibration/depth_sigma_per_m2", Digits::Significant(3), "1/m"),
        ("Noise of the joints, sigma", "/calibration/joint_error_sigma_deg", Digits::Significant(3), "deg"),
        ("Fraction of correspondences that do not fit", "/calibration/outlier_fraction", Digits::Significant(3), ""),
    ];
    let rows: Vec<Vec<String>> = rows
        .into_iter()
        .map(|(name, pointer, digits, unit)| vec![name.to_owned(), numbers.show(pointer, digits), escaped(unit)])
        .collect();
    format!(
        "<h3>Solver</h3>\n<p>The solver {}.</p>\n{}",
        escaped(run.text("/calibration/ended")),
        table("numbers", "The estimate", &["Metric", "Value", "Unit"], &rows)
    )
}

fn stages(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let list = run.list("/stages");
    let longest = list.iter().filter_map(|stage| stage["wall_s"].as_f64()).fold(1e-9, f64::max);
    let rows: Vec<Vec<String>> = list
        .iter()
        .enumerate()
        .map(|(at, stage)| {
            let metric = |field: &str, digits| numbers.show(&format!("/stages/{at}/{field}"), digits);
            vec![
                escaped(stage["stage"].as_str().unwrap_or_default()),
                metric("steps", Digits::Whole),
                metric("wall_s", Digits::Decimals(2)),
                metric("cpu_s", Digits::Decimals(2)),
                bar(stage["wall_s"].as_f64().unwrap_or_default() / longest, "neutral"),
            ]
        })
        .collect();
    if rows.is_empty() {
        return "<h3>Time and memory</h3>\n<p class=\"none\">Not measured.</p>\n".to_owned();
    }
    format!(
        "<h3>Time and memory</h3>\n{}<p>Largest memory: {}.</p>\n",
        table(
            "numbers bars",
            "Time by stage; CPU time is summed over all threads",
            &["Stage", "Steps", "Time (s)", "CPU time (s)", "Fraction"],
            &rows
        ),
        numbers.with_unit("/peak_memory_mib", Digits::Whole, "MiB")
    )
}
