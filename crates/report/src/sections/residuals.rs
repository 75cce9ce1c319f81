//! Residuals before and after: how large, in which postures, where in the image, at which joint angles.

use crate::RunResult;
use crate::charts::{CALIBRATED, Chart, Digits, NOMINAL, Numbers};
use crate::html::{escaped, table};
use crate::page::Section;
use serde_json::{Value, json};
use skclam::report_data::{Histogram, ImageCell, ReportData, ResidualKind};

pub(crate) fn section(run: &RunResult) -> Section {
    let mut html = metrics(run);
    let mut charts = Vec::new();
    match &run.data {
        None => html += super::NO_DATA,
        Some(data) => {
            if let Some(chart) = by_fold(run) {
                html += &chart.html();
                charts.push(chart);
            }
            let mut add = |chart: Chart, html: &mut String| {
                html.push_str(&chart.html());
                charts.push(chart);
            };
            // Results of programs that did not yet sum up observations have none without matches.
            if data.residuals.postures.iter().any(|posture| posture.endpoints > 0) {
                add(histogram(&data.residuals.histogram, data.residuals.distances), &mut html);
                add(by_posture(data), &mut html);
            }
            let cells = &data.residuals.cells;
            if !cells.is_empty() {
                html += "<h3>By place in the image</h3>\n<div class=\"pair\">\n";
                add(arrows("arrows-before", "nominal", NOMINAL, data, cells, |cell| cell.before_px), &mut html);
                add(arrows("arrows-after", "calibrated", CALIBRATED, data, cells, |cell| cell.after_px), &mut html);
                html += "</div>\n";
            }
            if let Some(chart) = by_joint(data) {
                html += "<h3>By joint angle</h3>\n";
                add(chart, &mut html);
            }
        }
    }
    Section { id: "residuals", title: "Residuals", html, charts }
}

fn metrics(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let mut rows = Vec::new();
    let mut row = |name: &str, unit: &str, before: &str, after: &str| {
        if run.number(after).is_some() || run.number(before).is_some() {
            let digits = Digits::Significant(3);
            rows.push(vec![
                name.to_owned(),
                numbers.show(before, digits),
                numbers.show(after, digits),
                unit.to_owned(),
            ]);
        }
    };
    let epipolar = [
        ("Distance to the epipolar line, median", "median_px", "px"),
        ("Distance to the epipolar line, RMS", "rms_px", "px"),
        ("Sampson distance, median", "median_sampson_px", "px"),
        ("Error function, Eq. (7)", "error_function", "px<sup>1/2</sup>"),
    ];
    for (name, field, unit) in epipolar {
        let pointer = |which: &str| format!("/calibration/epipolar_{which}/{field}");
        row(name, unit, &pointer("before"), &pointer("after"));
    }
    for (name, field) in [("Reprojection, median", "median_px"), ("Reprojection, RMS", "rms_px")] {
        let pointer = |which: &str| format!("/calibration/reprojection_{which}/{field}");
        row(name, "px", &pointer("before"), &pointer("after"));
    }
    let held_out = format!("Held out: {}", escaped(run.text("/held_out/metric")));
    row(&held_out, "px", "/held_out/metric_px/nominal", "/held_out/metric_px/calibrated");
    for (name, field) in [
        ("Depth consistency, point to plane, median", "median_mm"),
        ("Depth consistency, point to plane, 90 %", "p90_mm"),
    ] {
        let pointer = |which: &str| format!("/map/depth_consistency_{which}/{field}");
        row(name, "mm", &pointer("nominal"), &pointer("calibrated"));
    }
    let mut html = table(
        "numbers",
        "Residuals. Fitted: all postures took part in the estimate. Held out: estimated without the postures that it is tried on.",
        &["Residual", "Nominal", "Calibrated", "Unit"],
        &rows,
    );
    if run.number("/held_out/metric_px/mount_only").is_some() {
        html += &format!(
            "<p>Held out, with the nominal arm and only its mount fitted: {}. What lies between that and the calibrated rig is the arm's.</p>\n",
            numbers.with_unit("/held_out/metric_px/mount_only", Digits::Significant(3), "px")
        );
    }
    html
}

/// Each group of postures that was held out in turn.
fn by_fold(run: &RunResult) -> Option<Chart> {
    let folds = run.list("/held_out/folds");
    let name = |fold: &Value| {
        let indices: Vec<u64> = fold["postures"].as_array()?.iter().filter_map(Value::as_u64).collect();
        Some(format!("{}\u{2013}{}", indices.first()?, indices.last()?))
    };
    let names: Vec<String> = folds.iter().map(|fold| name(fold).unwrap_or_default()).collect();
    // Points and no bars: a logarithmic axis has no zero for a bar to start from.
    let trace = |label: &str, field: &str, color: &str, symbol: &str| {
        let y: Vec<Option<f64>> = folds.iter().map(|fold| fold["metric_px"][field].as_f64()).collect();
        y.iter().any(Option::is_some).then(|| {
            json!({
                "type": "scatter", "mode": "markers", "name": label, "x": names, "y": y, "hovertemplate": "%{y:.3g} px<extra></extra>",
                "marker": {"color": color, "symbol": symbol, "size": 10},
            })
        })
    };
    let traces: Vec<Value> = [
        trace("nominal", "nominal", NOMINAL, "diamond-open"),
        trace("mount alone fitted", "mount_only", "#8a94a0", "square-open"),
        trace("calibrated", "calibrated", CALIBRATED, "circle"),
    ]
    .into_iter()
    .flatten()
    .collect();
    (!folds.is_empty() && !traces.is_empty()).then(|| Chart {
        id: "held-out",
        caption: format!(
            "Held out: {} of each group of postures under rigs that were fitted without them; calibrated is better than nominal in {} of {} groups.",
            run.text("/held_out/metric"),
            run.number("/held_out/better_folds").unwrap_or_default(),
            folds.len()
        ),
        description: "Held-out residuals of each group of postures".to_owned(),
        data: json!(traces),
        layout: json!({
            "xaxis": {"type": "category", "title": {"text": "held-out postures (indices)"}},
            "yaxis": {"type": "log", "title": {"text": "residual (px)"}, "exponentformat": "none", "dtick": "D2"},
        }),
        height: 320,
        max_width: None,
    })
}

/// Lines of a histogram over bins whose widths grow by a factor.
fn histogram(histogram: &Histogram, kind: ResidualKind) -> Chart {
    let total = histogram.before.iter().sum::<u64>().max(1) as f64;
    // A file that a stranger made may have lists of different lengths.
    let count = |counts: &[u64], k: usize| counts.get(k).copied().unwrap_or(0);
    let occupied = |k: &usize| count(&histogram.before, *k) > 0 || count(&histogram.after, *k) > 0;
    let bins = histogram.before.len();
    let first = (0..bins).find(occupied).unwrap_or(0);
    let last = (0..bins).rev().find(occupied).unwrap_or(bins.saturating_sub(1));
    let trace = |name: &str, counts: &[u64], color: &str, dash: &str| {
        // A bin without a neighbour on either side closes the shape at zero.
        let (mut x, mut y) = (Vec::new(), Vec::new());
        for (edges, &count) in histogram.edges_px.windows(2).zip(counts).take(last + 1).skip(first) {
            x.extend_from_slice(edges);
            let fraction = 100.0 * count as f64 / total;
            y.extend([fraction, fraction]);
        }
        json!({
            "type": "scatter", "mode": "lines", "name": name, "x": x, "y": y, "fill": "tozeroy",
            "line": {"color": color, "width": 2, "dash": dash}, "fillcolor": format!("{color}33"),
            "hovertemplate": "%{x:.3g} px: %{y:.1f} %<extra></extra>",
        })
    };
    Chart {
        id: "histogram",
        caption: match kind {
            ResidualKind::Epipolar => "Distances of all matches to their epipolar lines, both images of each match; bins grow by a constant factor.",
            ResidualKind::Reprojection => "Distances of all points and board corners to where they should appear; bins grow by a constant factor.",
        }
        .to_owned(),
        description: format!("Histogram of distances to {}, nominal and calibrated", aim(kind)),
        data: json!([
            trace("nominal", &histogram.before, NOMINAL, "dash"),
            trace("calibrated", &histogram.after, CALIBRATED, "solid"),
        ]),
        layout: json!({
            "xaxis": {"type": "log", "title": {"text": format!("distance to {} (px)", aim(kind))}, "exponentformat": "none", "dtick": 1},
            "yaxis": {"title": {"text": "fraction (%)"}, "rangemode": "tozero"},
        }),
        height: 320,
        max_width: None,
    }
}

/// What a distance is measured to.
fn aim(kind: ResidualKind) -> &'static str {
    match kind {
        ResidualKind::Epipolar => "the epipolar line",
        ResidualKind::Reprojection => "the projected point",
    }
}

fn by_posture(data: &ReportData) -> Chart {
    let used: Vec<usize> = (0..data.postures.len()).filter(|&at| data.residuals.postures[at].endpoints > 0).collect();
    let x: Vec<u64> = used.iter().map(|&at| data.postures[at].index).collect();
    let trace = |name: &str, color: &str, symbol: &str, of: &dyn Fn(usize) -> (f64, f64)| {
        let values: Vec<(f64, f64)> = used.iter().map(|&at| of(at)).collect();
        json!({
            "type": "scatter", "mode": "markers", "name": name, "x": x,
            "y": values.iter().map(|(median, _)| *median).collect::<Vec<_>>(),
            "error_y": {
                "type": "data", "symmetric": false, "thickness": 1, "width": 0, "color": color,
                "array": values.iter().map(|(median, p90)| p90 - median).collect::<Vec<_>>(),
                "arrayminus": vec![0; values.len()],
            },
            "marker": {"color": color, "symbol": symbol, "size": 7},
            "hovertemplate": "posture %{x}: median %{y:.3g} px<extra></extra>",
        })
    };
    let residuals = &data.residuals.postures;
    let pair = |quantiles: &skclam::report_data::ResidualQuantiles| (quantiles.median_px, quantiles.p90_px);
    Chart {
        id: "by-posture",
        caption: format!(
            "By posture: median distance to {} in its image, with the line up to the 90th percentile. One posture far above the \
             others hints at wrong joint values or a displaced camera.",
            aim(data.residuals.distances)
        ),
        description: "Median residual of every posture, nominal and calibrated".to_owned(),
        data: json!([
            trace("nominal", NOMINAL, "diamond-open", &|at| pair(&residuals[at].before)),
            trace("calibrated", CALIBRATED, "circle", &|at| pair(&residuals[at].after)),
        ]),
        layout: json!({
            "xaxis": {"title": {"text": "posture (index in the recording)"}},
            "yaxis": {"type": "log", "title": {"text": "distance (px)"}, "exponentformat": "none", "dtick": "D2"},
        }),
        height: 320,
        max_width: None,
    }
}

fn arrows(
    id: &'static str,
    name: &str,
    color: &str,
    data: &ReportData,
    cells: &[ImageCell],
    of: impl Fn(&ImageCell) -> [f64; 2],
) -> Chart {
    let [width, height] = data.image_size.map(f64::from);
    let cell = width / f64::from(data.residuals.grid[0].max(1));
    let mut lengths: Vec<f64> = cells.iter().map(|cell| of(cell)[0].hypot(of(cell)[1])).collect();
    lengths.sort_by(f64::total_cmp);
    let longest = lengths.last().copied().unwrap_or_default();
    // Nine of ten arrows stay within their cell.
    let usual = lengths.get(lengths.len() * 9 / 10).copied().unwrap_or_default();
    let scale = magnification(cell / usual.max(1e-9));
    let (mut x, mut y) = (Vec::<Value>::new(), Vec::<Value>::new());
    let (mut tip_x, mut tip_y, mut angles, mut labels) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for found in cells {
        let ([cx, cy], [dx, dy]) = (found.center_px, of(found));
        let (ex, ey) = (cx + scale * dx, cy + scale * dy);
        x.extend([json!(cx), json!(round(ex)), Value::Null]);
        y.extend([json!(cy), json!(round(ey)), Value::Null]);
        tip_x.push(round(ex));
        tip_y.push(round(ey));
        // Of a marker, clockwise from up; rows grow downwards.
        angles.push(round(dx.atan2(-dy).to_degrees()));
        labels.push(format!("{:.3} px right, {:.3} px down; {} residuals", dx, dy, found.count));
    }
    let factor = crate::charts::number(scale, Digits::Significant(1));
    Chart {
        id,
        caption: format!(
            "{}{}: median offset from {} to where it was observed, drawn {factor} times as long; the longest is {} px.",
            name[..1].to_uppercase(),
            &name[1..],
            match data.residuals.arrows {
                ResidualKind::Reprojection => "where a point should appear",
                ResidualKind::Epipolar => "its epipolar line",
            },
            crate::charts::number(longest, Digits::Significant(2))
        ),
        description: format!("Arrows of the median residual over the image, {name}"),
        data: json!([
            {"type": "scatter", "mode": "lines", "x": x, "y": y, "line": {"color": color, "width": 1.5}, "hoverinfo": "skip", "showlegend": false},
            {"type": "scatter", "mode": "markers", "x": tip_x, "y": tip_y, "text": labels, "showlegend": false,
             "marker": {"color": color, "symbol": "arrow", "size": 6, "angle": angles}, "hovertemplate": "%{text}<extra></extra>"},
        ]),
        layout: json!({
            "xaxis": {"range": [-0.5, width - 0.5], "title": {"text": "column (px)"}, "constrain": "domain", "zeroline": false},
            "yaxis": {"range": [height - 0.5, -0.5], "title": {"text": "row (px)"}, "scaleanchor": "x", "constrain": "domain", "zeroline": false},
            "showlegend": false,
        }),
        height: 330,
        max_width: None,
    }
}

/// 1, 2 or 5 times a power of ten, not above the wish.
fn magnification(wish: f64) -> f64 {
    let wish = wish.clamp(1e-3, 1e6);
    let power = 10f64.powf(wish.log10().floor());
    let factor = if wish >= 5.0 * power {
        5.0
    } else if wish >= 2.0 * power {
        2.0
    } else {
        1.0
    };
    factor * power
}

fn round(value: f64) -> f64 {
    (value * 100.0).round() / 100.0
}

fn by_joint(data: &ReportData) -> Option<Chart> {
    let joints = data.joints.len();
    let used: Vec<usize> = (0..data.postures.len())
        .filter(|&at| data.residuals.postures[at].endpoints > 0 && data.postures[at].joints.len() == joints)
        .collect();
    if joints == 0 || used.is_empty() {
        return None;
    }
    let columns = joints.min(3);
    let rows = joints.div_ceil(columns);
    let mut traces = Vec::new();
    let mut layout = json!({
        "grid": {"rows": rows, "columns": columns, "pattern": "independent", "ygap": 0.3, "xgap": 0.14},
    });
    for (joint, named) in data.joints.iter().enumerate() {
        let suffix = if joint == 0 { String::new() } else { (joint + 1).to_string() };
        let x: Vec<f64> = used.iter().map(|&at| data.postures[at].joints[joint]).collect();
        let mut trace = |name: &str, color: &str, symbol: &str, y: Vec<f64>| {
            traces.push(json!({
                "type": "scatter", "mode": "markers", "name": name, "legendgroup": name, "showlegend": joint == 0,
                "x": x, "y": y, "xaxis": format!("x{suffix}"), "yaxis": format!("y{suffix}"),
                "marker": {"color": color, "symbol": symbol, "size": 5, "opacity": 0.8},
                "hovertemplate": format!("%{{x:.1f}} {}: %{{y:.3g}} px<extra></extra>", escaped(&named.unit)),
            }));
        };
        let residuals = &data.residuals.postures;
        trace("nominal", NOMINAL, "diamond-open", used.iter().map(|&at| residuals[at].before.median_px).collect());
        trace("calibrated", CALIBRATED, "circle", used.iter().map(|&at| residuals[at].after.median_px).collect());
        // plotly.js reads a little markup in titles.
        let title = format!("joint {}: {} ({})", joint + 1, escaped(&named.name), escaped(&named.unit));
        layout[format!("xaxis{suffix}")] = json!({"title": {"text": title, "standoff": 4}});
        layout[format!("yaxis{suffix}")] = json!({
            "type": "log", "exponentformat": "none", "dtick": 1,
            "title": {"text": if joint % columns == 0 { "distance (px)" } else { "" }},
        });
    }
    Some(Chart {
        id: "by-joint",
        caption: format!(
            "Median distance to {} of each posture against its joint values. A wave over an angle hints at gears or an eccentric \
             encoder, a slope at something that gives way.",
            aim(data.residuals.distances)
        ),
        description: "Median residual of every posture against every joint value, nominal and calibrated".to_owned(),
        data: json!(traces),
        layout,
        height: 60 + 230 * rows as u32,
        max_width: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arrows_are_magnified_by_round_numbers() {
        assert_eq!(magnification(37.0), 20.0);
        assert_eq!(magnification(5.0), 5.0);
        assert!((magnification(0.09) - 0.05).abs() < 1e-12);
        assert!(magnification(f64::INFINITY).is_finite());
    }
}
