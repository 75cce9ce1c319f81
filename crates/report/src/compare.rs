//! Several runs side by side: two days, two presets, two robots. Rows go by name; where a run has no such row, its place is empty.

use crate::RunResult;
use crate::figures::{CALIBRATED, Chart, Digits, NOMINAL, number};
use crate::html::{escaped, table};
use crate::judgement::judge;
use crate::page::{Section, assemble};
use serde::Serialize;
use serde_json::json;

/// Runs side by side, as a table of tables.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// The runs, in the order in which they were named.
    pub runs: Vec<ComparedRun>,
    /// What is compared.
    pub groups: Vec<Group>,
}

/// One run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComparedRun {
    /// Its folder's name.
    pub name: String,
    /// Its rig.
    pub rig: String,
    /// What its traffic light says.
    pub light: String,
    /// Its verdict.
    pub verdict: String,
}

/// Rows that belong together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Group {
    /// What they are.
    pub title: String,
    /// The rows.
    pub rows: Vec<Row>,
}

/// One figure of all runs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// What it is.
    pub name: String,
    /// Its unit; empty for none.
    pub unit: String,
    /// One a run; `None` where the run has no such figure.
    pub cells: Vec<Option<Cell>>,
}

/// A figure of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cell {
    /// As it stands in the run's summary.
    pub value: f64,
    /// Its standard deviation, for parameters that have one.
    pub sigma: Option<f64>,
    /// As it is shown.
    pub text: String,
    /// For parameters: how many sigmas of both it is away from the first run's; `None` for the first, and where a sigma is missing.
    pub apart_sigmas: Option<f64>,
}

const FIGURES: [(&str, &str, &str, Digits); 18] = [
    ("postures", "/counts/postures", "", Digits::Whole),
    ("matches", "/counts/matches", "", Digits::Whole),
    ("observations of tracks", "/counts/observations", "", Digits::Whole),
    ("free parameters", "/calibration/free", "", Digits::Whole),
    ("seen by the data", "/calibration/rank", "", Digits::Whole),
    ("line distance, median, nominal", "/calibration/epipolar_before/median_px", "px", Digits::Significant(3)),
    ("line distance, median", "/calibration/epipolar_after/median_px", "px", Digits::Significant(3)),
    ("line distance, RMS", "/calibration/epipolar_after/rms_px", "px", Digits::Significant(3)),
    ("reprojection, RMS", "/calibration/reprojection_after/rms_px", "px", Digits::Significant(3)),
    ("held out, nominal", "/held_out/figure_px/nominal", "px", Digits::Significant(3)),
    ("held out", "/held_out/figure_px/calibrated", "px", Digits::Significant(3)),
    ("held out, mount alone fitted", "/held_out/figure_px/mount_only", "px", Digits::Significant(3)),
    ("camera, expected error, mean", "/recorded_poses/camera_sigma_mm/mean", "mm", Digits::Significant(2)),
    ("the same over the workspace", "/workspace_poses/camera_sigma_mm/mean", "mm", Digits::Significant(2)),
    ("surfaces apart, median, nominal", "/map/agreement_nominal/median_mm", "mm", Digits::Significant(3)),
    ("surfaces apart, median", "/map/agreement_calibrated/median_mm", "mm", Digits::Significant(3)),
    ("surfaces apart, 90 %", "/map/agreement_calibrated/p90_mm", "mm", Digits::Significant(3)),
    ("peak memory", "/peak_memory_mib", "MiB", Digits::Whole),
];

impl Comparison {
    /// Compares; the first run is the one that the others are held against.
    pub fn of(runs: &[RunResult]) -> Self {
        let compared = runs.iter().map(|run| ComparedRun {
            name: run.name.clone(),
            rig: run.text("/rig").to_owned(),
            light: judge(run).light.word().to_owned(),
            verdict: run.text("/verdict").to_owned(),
        });
        let figures = FIGURES.iter().map(|(name, pointer, unit, digits)| Row {
            name: (*name).to_owned(),
            unit: (*unit).to_owned(),
            cells: runs
                .iter()
                .map(|run| {
                    let value = run.number(pointer)?;
                    Some(Cell { value, sigma: None, text: number(value, *digits), apart_sigmas: None })
                })
                .collect(),
        });
        let figures = figures.filter(|row| row.cells.iter().any(Option::is_some)).collect();
        let parameters = parameters(runs);
        let mut groups = vec![Group { title: "figure".to_owned(), rows: figures }];
        if !parameters.is_empty() {
            groups.push(Group { title: "parameter".to_owned(), rows: parameters });
        }
        Comparison { runs: compared.collect(), groups }
    }
}

/// All parameters of all runs, in the order in which they are first met.
fn parameters(runs: &[RunResult]) -> Vec<Row> {
    let mut rows: Vec<Row> = Vec::new();
    for (at, run) in runs.iter().enumerate() {
        for parameter in run.list("/calibration/parameters") {
            let (Some(name), Some(value)) = (parameter["name"].as_str(), parameter["calibrated"].as_f64()) else {
                continue;
            };
            let unit = parameter["unit"].as_str().unwrap_or_default();
            let place = rows.iter().position(|row| row.name == name && row.unit == unit).unwrap_or_else(|| {
                rows.push(Row { name: name.to_owned(), unit: unit.to_owned(), cells: vec![None; runs.len()] });
                rows.len() - 1
            });
            let sigma = parameter["sigma"].as_f64();
            rows[place].cells[at] =
                Some(Cell { value, sigma, text: number(value, Digits::Decimals(4)), apart_sigmas: None });
        }
    }
    for row in &mut rows {
        let Some((first, first_sigma)) = row.cells[0].as_ref().and_then(|cell| Some((cell.value, cell.sigma?))) else {
            continue;
        };
        for cell in row.cells.iter_mut().skip(1).flatten() {
            let together = cell.sigma.map(|sigma| sigma.hypot(first_sigma)).filter(|&sigma| sigma > 0.0);
            cell.apart_sigmas = together.map(|sigma| (cell.value - first).abs() / sigma);
        }
    }
    rows
}

/// The comparison as a page.
pub fn compare_html(runs: &[RunResult], comparison: &Comparison) -> String {
    let names: Vec<String> =
        comparison.runs.iter().enumerate().map(|(at, run)| format!("[{}] {}", at + 1, escaped(&run.name))).collect();
    let verdicts: Vec<Vec<String>> = comparison
        .runs
        .iter()
        .zip(&names)
        .map(|(run, name)| {
            vec![
                name.clone(),
                escaped(&run.rig),
                format!("<strong>{}</strong>", escaped(&run.light)),
                escaped(&run.verdict),
            ]
        })
        .collect();
    let mut parts = vec![Section {
        id: "runs",
        title: "Runs",
        html: table("words", "What each run says of itself", &["Run", "Rig", "Light", "Verdict"], &verdicts),
        charts: Vec::new(),
    }];
    let titles = [("figures", "Figures"), ("parameters", "Parameters")];
    for (group, (id, title)) in comparison.groups.iter().zip(titles) {
        let head: Vec<&str> =
            std::iter::once(title).chain(names.iter().map(String::as_str)).chain(std::iter::once("Unit")).collect();
        let rows: Vec<Vec<String>> = group.rows.iter().map(row_html).collect();
        let caption = match id {
            "parameters" => {
                "Calibrated values, \u{b1} sigma. In brackets: how many sigmas of both it is away from the first run."
            }
            _ => "Residuals are those of the calibrated rigs unless \u{201c}nominal\u{201d} is said.",
        };
        let mut html = table("numbers", caption, &head, &rows);
        let charts: Vec<Chart> = if id == "figures" {
            residual_chart(runs, comparison).into_iter().collect()
        } else {
            changes_chart(comparison).into_iter().collect()
        };
        html += &charts.iter().map(Chart::html).collect::<String>();
        parts.push(Section { id, title, html, charts });
    }
    let header = format!(
        "<p class=\"kicker\">Comparison</p>\n<h1>{}</h1>",
        escaped(&comparison.runs.iter().map(|run| run.name.as_str()).collect::<Vec<_>>().join(" \u{b7} "))
    );
    assemble("Comparison of calibrations", &header, &parts, "null")
}

fn row_html(row: &Row) -> Vec<String> {
    let cell = |cell: &Option<Cell>| match cell {
        None => "<span class=\"none\">\u{2013}</span>".to_owned(),
        Some(cell) => {
            let sigma =
                cell.sigma.map_or(String::new(), |sigma| format!(" \u{b1} {}", number(sigma, Digits::Significant(2))));
            let apart =
                cell.apart_sigmas.map_or(String::new(), |sigmas| format!(" ({})", number(sigmas, Digits::Decimals(1))));
            format!("{}{sigma}{apart}", escaped(&cell.text))
        }
    };
    std::iter::once(escaped(&row.name))
        .chain(row.cells.iter().map(cell))
        .chain(std::iter::once(escaped(&row.unit)))
        .collect()
}

fn labels(comparison: &Comparison) -> Vec<String> {
    // plotly.js reads a little markup in tick labels.
    comparison.runs.iter().enumerate().map(|(at, run)| format!("[{}] {}", at + 1, escaped(&run.name))).collect()
}

/// Of the runs that have matches.
fn residual_chart(runs: &[RunResult], comparison: &Comparison) -> Option<Chart> {
    let after = |run: &RunResult| run.number("/calibration/epipolar_after/median_px");
    runs.iter().find_map(after)?;
    let bars = |name: &str, which: &str, color: &str, pattern: &str| {
        let y: Vec<Option<f64>> =
            runs.iter().map(|run| run.number(&format!("/calibration/epipolar_{which}/median_px"))).collect();
        json!({"type": "bar", "name": name, "x": labels(comparison), "y": y,
               "marker": {"color": color, "pattern": {"shape": pattern, "fillmode": "overlay", "size": 6}},
               "hovertemplate": "%{y:.3g} px<extra></extra>"})
    };
    Some(Chart {
        id: "compared-residuals",
        caption: "Median distance of the matches to their epipolar lines.".to_owned(),
        description: "Bars of the median residual of each run, nominal and calibrated".to_owned(),
        data: json!([bars("nominal", "before", NOMINAL, "/"), bars("calibrated", "after", CALIBRATED, "")]),
        layout: json!({
            "barmode": "group", "xaxis": {"automargin": true},
            "yaxis": {"type": "log", "title": {"text": "distance (px)"}, "exponentformat": "none", "dtick": 1},
        }),
        height: 340,
    })
}

/// How far each parameter of the other runs is from the first, in sigmas.
fn changes_chart(comparison: &Comparison) -> Option<Chart> {
    let rows = &comparison.groups.get(1)?.rows;
    let symbols = ["circle", "diamond", "square", "triangle-up", "x"];
    let colors = [CALIBRATED, NOMINAL, "#009E73", "#CC79A7", "#56B4E9"];
    let traces: Vec<_> = (1..comparison.runs.len())
        .filter_map(|at| {
            let told: Vec<(&str, f64)> = rows
                .iter()
                .filter_map(|row| Some((row.name.as_str(), row.cells[at].as_ref()?.apart_sigmas?)))
                .collect();
            (!told.is_empty()).then(|| {
                json!({"type": "scatter", "mode": "markers", "name": labels(comparison)[at],
                       "x": told.iter().map(|(name, _)| escaped(name)).collect::<Vec<_>>(),
                       "y": told.iter().map(|(_, sigmas)| *sigmas).collect::<Vec<_>>(),
                       "marker": {"size": 8, "color": colors[(at - 1) % colors.len()], "symbol": symbols[(at - 1) % symbols.len()]},
                       "hovertemplate": "%{x}: %{y:.1f} sigma<extra></extra>"})
            })
        })
        .collect();
    (!traces.is_empty()).then(|| Chart {
        id: "compared-parameters",
        caption: "Distance of each parameter from the first run, in sigmas of both: below 3 the runs agree.".to_owned(),
        description: "Distance of each parameter from that of the first run, in sigmas".to_owned(),
        data: json!(traces),
        layout: json!({
            "xaxis": {"tickangle": -60, "automargin": true},
            "yaxis": {"title": {"text": "apart (sigma)"}, "rangemode": "tozero"},
            "shapes": [{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 3, "y1": 3, "line": {"dash": "dot", "width": 1, "color": "#888888"}}],
        }),
        height: 380,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(name: &str, parameters: serde_json::Value) -> RunResult {
        let summary = json!({
            "rig": "<b>arm</b>", "verdict": "fine",
            "calibration": {"parameters": parameters, "epipolar_before": {"median_px": 9.0}, "epipolar_after": {"median_px": 0.5}},
        });
        RunResult { name: name.to_owned(), summary, data: None }
    }

    #[test]
    fn rows_go_by_name_and_robots_may_differ() {
        let runs = [
            run(
                "one",
                json!([{"name": "a_2", "unit": "mm", "calibrated": 10.0, "sigma": 0.3},
                              {"name": "alpha_2", "unit": "deg", "calibrated": 90.0, "sigma": null}]),
            ),
            run(
                "two",
                json!([{"name": "d_7", "unit": "mm", "calibrated": 1.0, "sigma": 0.1},
                              {"name": "a_2", "unit": "mm", "calibrated": 11.0, "sigma": 0.4}]),
            ),
        ];
        let comparison = Comparison::of(&runs);
        let rows = &comparison.groups[1].rows;
        let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
        assert_eq!(names, ["a_2", "alpha_2", "d_7"]);
        assert_eq!(rows[0].cells[1].as_ref().unwrap().apart_sigmas, Some(2.0));
        assert!(rows[1].cells[1].is_none() && rows[2].cells[0].is_none());
        let page = compare_html(&runs, &comparison);
        assert!(page.contains("&lt;b&gt;arm") && !page.contains("<b>arm"));
    }
}
