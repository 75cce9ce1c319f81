//! How sure the parameters are together, and what follows for the position over the workspace.

use crate::RunResult;
use crate::charts::{Chart, Digits, Numbers, number, width_for};
use crate::html::{escaped, table};
use crate::page::Section;
use serde_json::json;
use skclam::pipeline::{PoseSigma, PostureSource};

/// From this correlation on two parameters are named as hardly separable.
const STRONG: f64 = 0.9;
/// Pairs that are named at most.
const NAMED: usize = 12;

pub(crate) fn section(run: &RunResult) -> Section {
    let mut html = String::new();
    let mut charts = Vec::new();
    html += "<h3>Expected position error over the workspace</h3>\n";
    html += &pose_metrics(run);
    if let Some(chart) = run.data.as_ref().and_then(|data| workspace(&data.pose_sigmas)) {
        html += &chart.html();
        charts.push(chart);
    }
    let names: Vec<String> = run
        .list("/calibration/parameters")
        .iter()
        .map(|parameter| parameter["name"].as_str().unwrap_or_default().to_owned())
        .collect();
    html += "<h3>Correlations between parameters</h3>\n";
    let found = run.data.as_ref().and_then(|data| data.correlations.as_ref());
    match found.filter(|matrix| matrix.len() == names.len() && !names.is_empty()) {
        Some(matrix) => {
            let chart = heat_map(&names, matrix);
            html += &chart.html();
            charts.push(chart);
            html += &strongest(&names, matrix);
        }
        None => html += "<p class=\"none\">Not measured: this estimator gives no covariance.</p>\n",
    }
    Section { id: "uncertainty", title: "Uncertainty", html, charts }
}

/// The metrics of the summary: flange and camera, at the recorded postures and over the workspace.
fn pose_metrics(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let mut rows = Vec::new();
    for (of, poses) in [("your postures", "recorded_poses"), ("the workspace", "workspace_poses")] {
        for (name, field, unit) in [
            ("Camera position", "camera_sigma_mm", "mm"),
            ("Camera orientation", "camera_sigma_deg", "deg"),
            ("Flange position", "flange_sigma_mm", "mm"),
            ("Flange orientation", "flange_sigma_deg", "deg"),
        ] {
            let pointer = |statistic: &str| format!("/{poses}/{field}/{statistic}");
            if run.number(&pointer("mean")).is_some() {
                let metric = |statistic: &str| numbers.show(&pointer(statistic), Digits::Significant(2));
                rows.push(vec![format!("{name}, {of}"), metric("mean"), metric("sd"), metric("max"), unit.to_owned()]);
            }
        }
        let change = |statistic: &str| format!("/{poses}/camera_change_mm/{statistic}");
        if run.number(&change("mean")).is_some() {
            let metric = |statistic: &str| numbers.show(&change(statistic), Digits::Significant(3));
            rows.push(vec![
                format!("Correction of the camera, {of}"),
                metric("mean"),
                metric("sd"),
                metric("max"),
                "mm".to_owned(),
            ]);
        }
    }
    if rows.is_empty() {
        return "<p class=\"none\">Not measured: this estimator gives no covariance.</p>\n".to_owned();
    }
    table(
        "numbers",
        "Expected error (one sigma) by the covariance of the parameters, and how far the calibration moves the camera",
        &["What", "Mean", "Spread", "Largest", "Unit"],
        &rows,
    )
}

/// Height of the plot of the workspace, CSS pixels.
const HEIGHT: u32 = 500;

/// Each posture where it is in space: distance from the base's axis against height, coloured by the expected error.
fn workspace(poses: &[PoseSigma]) -> Option<Chart> {
    let known: Vec<(&PoseSigma, f64)> = poses.iter().filter_map(|pose| Some((pose, pose.camera_sigma_mm?))).collect();
    let greatest = known.iter().map(|(_, sigma)| *sigma).fold(0.0, f64::max);
    if greatest <= 0.0 {
        return None;
    }
    let least = known.iter().map(|(_, sigma)| *sigma).fold(greatest, f64::min);
    let round = |value: f64| (value * 1e4).round() / 1e4;
    let trace = |source: PostureSource, name: &str, symbol: &str, bar: bool| {
        let of: Vec<&(&PoseSigma, f64)> = known.iter().filter(|(pose, _)| pose.source == source).collect();
        let metres = |of: &dyn Fn(&PoseSigma) -> f64, list: &[&(&PoseSigma, f64)]| -> Vec<f64> {
            list.iter().map(|(pose, _)| round(of(pose) * 1e-3)).collect()
        };
        json!({
            "type": "scatter", "mode": "markers", "name": name,
            "x": metres(&|pose| pose.camera_mm[0].hypot(pose.camera_mm[1]), &of),
            "y": metres(&|pose| pose.camera_mm[2], &of),
            "customdata": of.iter().map(|(_, sigma)| *sigma).collect::<Vec<_>>(),
            "marker": {
                "symbol": symbol, "size": if bar { 8 } else { 10 }, "line": {"width": 1, "color": if bar { "#8a94a0" } else { "#000000" }},
                "color": of.iter().map(|(_, sigma)| *sigma).collect::<Vec<_>>(), "colorscale": "Cividis", "cmin": least, "cmax": greatest,
                "showscale": bar, "colorbar": {"title": {"text": "expected error (mm)", "side": "right"}, "thickness": 12, "outlinewidth": 0},
            },
            "hovertemplate": "%{x:.2f} m from the axis, %{y:.2f} m high: %{customdata:.3g} mm<extra></extra>",
        })
    };
    Some(Chart {
        id: "workspace",
        caption: "Expected position error of the camera (one sigma, mm): dots are postures spread over the joints' limits, squares are those of the recording. \
                  Status places were seen too little; record postures there if the arm works there."
            .to_owned(),
        description: format!("Expected position error at {} postures, at most {} mm", known.len(), number(greatest, Digits::Significant(2))),
        data: json!([
            trace(PostureSource::Workspace, "workspace", "circle", true),
            trace(PostureSource::Recorded, "recorded", "square", false),
        ]),
        layout: json!({
            "xaxis": {"title": {"text": "distance from the first axis (m)"}, "zeroline": false, "constrain": "domain"},
            "yaxis": {"title": {"text": "height above the base (m)"}, "scaleanchor": "x", "zeroline": false, "constrain": "domain"},
        }),
        height: HEIGHT,
        max_width: Some(width_for(
            HEIGHT,
            known.iter().map(|(pose, _)| pose.camera_mm[0].hypot(pose.camera_mm[1])),
            known.iter().map(|(pose, _)| pose.camera_mm[2]),
        )),
    })
}

fn heat_map(names: &[String], matrix: &[Vec<f64>]) -> Chart {
    // plotly.js reads a little markup in tick labels.
    let names: Vec<String> = names.iter().map(|name| escaped(name)).collect();
    Chart {
        id: "correlations",
        caption: "Correlations of the estimated parameters: blue and orange far from 0 mean that the data determine only the sum or the difference well.".to_owned(),
        description: format!("Heat map of the correlations between {} parameters", names.len()),
        data: json!([{
            "type": "heatmap", "x": names, "y": names, "z": matrix, "zmin": -1, "zmax": 1, "xgap": 1, "ygap": 1,
            "colorscale": [[0, "#0072B2"], [0.5, "#f4f4f2"], [1, "#D55E00"]],
            "colorbar": {"title": {"text": "correlation", "side": "right"}, "thickness": 12, "outlinewidth": 0},
            "hovertemplate": "%{y} and %{x}: %{z:.2f}<extra></extra>",
        }]),
        layout: json!({
            "xaxis": {"tickangle": -60, "automargin": true, "showgrid": false, "ticks": ""},
            "yaxis": {"autorange": "reversed", "automargin": true, "showgrid": false, "ticks": ""},
        }),
        height: (200 + 15 * names.len() as u32).clamp(320, 900),
        max_width: None,
    }
}

fn strongest(names: &[String], matrix: &[Vec<f64>]) -> String {
    let mut pairs: Vec<(usize, usize, f64)> = (0..names.len())
        .flat_map(|i| (0..i).map(move |j| (j, i)))
        .map(|(j, i)| (j, i, matrix[i].get(j).copied().unwrap_or_default()))
        .filter(|(_, _, value)| value.abs() >= STRONG)
        .collect();
    pairs.sort_by(|x, y| y.2.abs().total_cmp(&x.2.abs()).then((x.0, x.1).cmp(&(y.0, y.1))));
    if pairs.is_empty() {
        return format!("<p>No two parameters are correlated by {STRONG} or more.</p>\n");
    }
    let rows: Vec<Vec<String>> = pairs
        .iter()
        .take(NAMED)
        .map(|(a, b, value)| {
            vec![format!("{} and {}", escaped(&names[*a]), escaped(&names[*b])), format!("{value:+.3}")]
        })
        .collect();
    table(
        "numbers",
        &format!("Parameters that the data hardly separate (correlation {STRONG} or more)"),
        &["Parameters", "Correlation"],
        &rows,
    )
}
