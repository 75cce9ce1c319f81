//! Which postures share what: the overlap graph.

use crate::RunResult;
use crate::charts::{Chart, Digits, Numbers, width_for};
use crate::page::Section;
use serde_json::{Value, json};
use skclam::report_data::ReportData;

/// Height of the graph, CSS pixels.
const HEIGHT: u32 = 520;
/// Classes of edges by matches: at least so many, width, opacity.
const CLASSES: [(usize, f64, f64); 4] = [(1, 0.6, 0.35), (30, 1.0, 0.5), (100, 1.6, 0.65), (300, 2.4, 0.8)];

pub(crate) fn section(run: &RunResult) -> Section {
    let numbers = Numbers::of(run);
    let mut html = format!(
        "<p>{} postures, {} pairs of images compared, {} matches that reached the estimator, {} points followed over several images.</p>\n",
        numbers.show("/counts/postures", Digits::Whole),
        numbers.show("/counts/pairs", Digits::Whole),
        numbers.show("/counts/matches", Digits::Whole),
        numbers.show("/counts/tracks", Digits::Whole),
    );
    let mut charts = Vec::new();
    match &run.data {
        None => html += super::NO_DATA,
        Some(data) if data.residuals.pairs.is_empty() => {
            html +=
                "<p>No matches between images took part: the postures are connected by the board that they saw.</p>\n";
        }
        Some(data) => {
            let parts = components(data);
            html += &match parts {
                0 | 1 => "<p>All postures are connected: from each, every other can be reached over pairs with matches.</p>\n".to_owned(),
                parts => format!(
                    "<p><strong>The postures fall into {parts} groups without matches between them.</strong> What lies between the groups rests on \
                     the joint values alone; record postures that see parts of both.</p>\n"
                ),
            };
            let chart = graph(data);
            html += &chart.html();
            charts.push(chart);
        }
    }
    Section { id: "overlap", title: "Overlap of the postures", html, charts }
}

/// Groups of postures connected by matches.
fn components(data: &ReportData) -> usize {
    let mut group: Vec<usize> = (0..data.postures.len()).collect();
    fn root(group: &mut [usize], mut at: usize) -> usize {
        while group[at] != at {
            group[at] = group[group[at]];
            at = group[at];
        }
        at
    }
    for pair in &data.residuals.pairs {
        let (a, b) = (root(&mut group, pair.a), root(&mut group, pair.b));
        group[a.max(b)] = a.min(b);
    }
    (0..group.len()).filter(|&at| root(&mut group, at) == at).count()
}

fn graph(data: &ReportData) -> Chart {
    let [across, up] = widest_axes(data);
    let place = |at: usize| {
        let position = data.postures[at].calibrated_m;
        (json!(position[across]), json!(position[up]))
    };
    let mut traces = Vec::new();
    for (class, &(least, width, opacity)) in CLASSES.iter().enumerate() {
        let below = CLASSES.get(class + 1).map_or(usize::MAX, |next| next.0);
        let (mut x, mut y) = (Vec::new(), Vec::new());
        for pair in data.residuals.pairs.iter().filter(|pair| (least..below).contains(&pair.matches)) {
            let ((ax, ay), (bx, by)) = (place(pair.a), place(pair.b));
            x.extend([ax, bx, Value::Null]);
            y.extend([ay, by, Value::Null]);
        }
        let name = if below == usize::MAX {
            format!("{least} or more matches")
        } else {
            format!("{least} to {} matches", below - 1)
        };
        traces.push(json!({
            "type": "scatter", "mode": "lines", "x": x, "y": y, "name": name, "hoverinfo": "skip", "opacity": opacity,
            "line": {"width": width, "color": "#6b7785"},
        }));
    }
    let mut matches = vec![0usize; data.postures.len()];
    for pair in &data.residuals.pairs {
        matches[pair.a] += pair.matches;
        matches[pair.b] += pair.matches;
    }
    let (x, y): (Vec<Value>, Vec<Value>) = (0..data.postures.len()).map(place).unzip();
    traces.push(json!({
        "type": "scatter", "mode": "markers", "x": x, "y": y, "name": "posture",
        "text": data.postures.iter().map(|posture| posture.index).collect::<Vec<_>>(), "customdata": matches,
        "hovertemplate": "posture %{text}: %{customdata} matches<extra></extra>",
        "marker": {
            "size": 9, "color": matches, "colorscale": "Viridis", "line": {"width": 1, "color": "#ffffff"}, "cmin": 0,
            "colorbar": {"title": {"text": "matches", "side": "right"}, "thickness": 12, "outlinewidth": 0},
        },
    }));
    let names = ["x", "y", "z"];
    Chart {
        id: "overlap-graph",
        caption: format!(
            "Each dot is a posture, where the camera was ({} against {} of the base frame); lines join postures whose images have matches in common. Dots with few \
             lines hang by little.",
            names[across], names[up]
        ),
        description: format!(
            "Graph of {} postures and {} pairs with matches",
            data.postures.len(),
            data.residuals.pairs.len()
        ),
        data: json!(traces),
        layout: json!({
            "xaxis": {"title": {"text": format!("{} (m)", names[across])}, "zeroline": false, "constrain": "domain"},
            "yaxis": {"title": {"text": format!("{} (m)", names[up])}, "scaleanchor": "x", "zeroline": false, "constrain": "domain"},
        }),
        height: HEIGHT,
        max_width: Some(width_for(
            HEIGHT,
            data.postures.iter().map(|posture| posture.calibrated_m[across]),
            data.postures.iter().map(|posture| posture.calibrated_m[up]),
        )),
    }
}

/// The two axes along which the camera moved most, the widest first: screens are wider than high.
fn widest_axes(data: &ReportData) -> [usize; 2] {
    let extent = |axis: usize| {
        let values = data.postures.iter().map(|posture| posture.calibrated_m[axis]);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        high - low
    };
    let mut axes = [0, 1, 2];
    axes.sort_by(|&a, &b| extent(b).total_cmp(&extent(a)));
    [axes[0], axes[1]]
}
