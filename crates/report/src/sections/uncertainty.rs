//! How sure the parameters are together, and what follows for the position over the workspace.

use crate::RunResult;
use crate::figures::Chart;
use crate::html::{escaped, table};
use crate::page::Section;
use serde_json::{Value, json};

/// From this correlation on two parameters are named as hardly told apart.
const STRONG: f64 = 0.9;
/// Pairs that are named at the most.
const NAMED: usize = 12;

pub(crate) fn section(run: &RunResult) -> Section {
    let mut html = String::new();
    let mut charts = Vec::new();
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
        None => html += "<p class=\"none\">Not measured: this estimator tells no covariance.</p>\n",
    }
    Section { id: "uncertainty", title: "Uncertainty", html, charts }
}

fn heat_map(names: &[String], matrix: &[Vec<f64>]) -> Chart {
    // plotly.js reads a little markup in tick labels.
    let names: Vec<String> = names.iter().map(|name| escaped(name)).collect();
    Chart {
        id: "correlations",
        caption: "Correlations of the estimated parameters: blue and orange far from 0 mean that the data tell only the sum or the difference well.".to_owned(),
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
        &format!("Parameters that the data hardly tell apart (correlation {STRONG} or more)"),
        &["Parameters", "Correlation"],
        &rows,
    )
}

/// Kept for the pointer of the predicted error, see `workspace`.
#[allow(dead_code)]
fn measured(run: &RunResult) -> Option<&Value> {
    run.summary.pointer("/workspace")
}
