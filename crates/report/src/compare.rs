//! Several runs side by side: two days, two presets, two robots. Rows go by name. What a run did not free is shown as
//! it was held; where it has no such row at all, its place is empty. Parameters of one arm are compared in sigmas,
//! those of two arms are not.

use crate::RunResult;
use crate::charts::{CALIBRATED, Chart, Digits, NOMINAL, number};
use crate::html::{escaped, table};
use crate::judgement::judge;
use crate::page::{Section, assemble};
use serde::Serialize;
use serde_json::json;
use skclam::calibration::{Model, Parameter};
use skclam::rig::Rig;
use skclam::summary::file_unit;

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
    /// The data set's folder as the run named it; `None` where the result does not name it.
    pub dataset: Option<String>,
    /// Why its arm is another than the first run's; `None` for the first, and for the same arm.
    pub another_arm: Option<String>,
    /// What its status says.
    pub status: String,
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

/// One metric of all runs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// What it is.
    pub name: String,
    /// Its unit; empty for none.
    pub unit: String,
    /// One a run; `None` where the run has no such metric.
    pub cells: Vec<Option<Cell>>,
}

/// A metric of one run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cell {
    /// As written in the run's summary.
    pub value: f64,
    /// Its standard deviation, for parameters that have one.
    pub sigma: Option<f64>,
    /// Whether it is a parameter that the run did not free.
    pub held: bool,
    /// As it is shown.
    pub text: String,
    /// For parameters: how many sigmas of both it is away from the first run's; `None` for the first, where a sigma is
    /// missing, and where the arm is another.
    pub apart_sigmas: Option<f64>,
}

const METRICS: [(&str, &str, &str, Digits); 18] = [
    ("postures", "/counts/postures", "", Digits::Whole),
    ("matches", "/counts/matches", "", Digits::Whole),
    ("observations of tracks", "/counts/observations", "", Digits::Whole),
    ("free parameters", "/calibration/free", "", Digits::Whole),
    ("identifiable", "/calibration/rank", "", Digits::Whole),
    ("epipolar distance, median, nominal", "/calibration/epipolar_before/median_px", "px", Digits::Significant(3)),
    ("epipolar distance, median", "/calibration/epipolar_after/median_px", "px", Digits::Significant(3)),
    ("epipolar distance, RMS", "/calibration/epipolar_after/rms_px", "px", Digits::Significant(3)),
    ("reprojection, RMS", "/calibration/reprojection_after/rms_px", "px", Digits::Significant(3)),
    ("held out, nominal", "/held_out/metric_px/nominal", "px", Digits::Significant(3)),
    ("held out", "/held_out/metric_px/calibrated", "px", Digits::Significant(3)),
    ("held out, mount alone fitted", "/held_out/metric_px/mount_only", "px", Digits::Significant(3)),
    ("camera, expected error, mean", "/recorded_poses/camera_sigma_mm/mean", "mm", Digits::Significant(2)),
    ("the same over the workspace", "/workspace_poses/camera_sigma_mm/mean", "mm", Digits::Significant(2)),
    ("depth consistency, median, nominal", "/map/depth_consistency_nominal/median_mm", "mm", Digits::Significant(3)),
    ("depth consistency, median", "/map/depth_consistency_calibrated/median_mm", "mm", Digits::Significant(3)),
    ("depth consistency, 90 %", "/map/depth_consistency_calibrated/p90_mm", "mm", Digits::Significant(3)),
    ("peak memory", "/peak_memory_mib", "MiB", Digits::Whole),
];

impl Comparison {
    /// Compares; the first run is the one that the others are compared with. `rigs`: the calibrated rigs of the runs
    /// (`rig.toml`), which say what was held; `None`, or nothing at all, where there is none.
    pub fn of(runs: &[RunResult], rigs: &[Option<Rig>]) -> Self {
        let mut parameters = parameters(runs);
        add_held(&mut parameters, rigs);
        let arms: Vec<Option<String>> = (0..runs.len()).map(|at| another_arm(&parameters, rigs, at)).collect();
        hold_against_first(&mut parameters, &arms);
        let compared = runs.iter().zip(&arms).map(|(run, another_arm)| ComparedRun {
            name: run.name.clone(),
            rig: run.text("/rig").to_owned(),
            dataset: run.data.as_ref().map(|data| data.dataset.clone()),
            another_arm: another_arm.clone(),
            status: judge(run).status.word().to_owned(),
            verdict: run.text("/verdict").to_owned(),
        });
        let metrics = METRICS.iter().map(|(name, pointer, unit, digits)| Row {
            name: (*name).to_owned(),
            unit: (*unit).to_owned(),
            cells: runs
                .iter()
                .map(|run| {
                    let value = run.number(pointer)?;
                    Some(Cell { value, sigma: None, held: false, text: number(value, *digits), apart_sigmas: None })
                })
                .collect(),
        });
        let metrics = metrics.filter(|row| row.cells.iter().any(Option::is_some)).collect();
        let mut groups = vec![Group { title: "metric".to_owned(), rows: metrics }];
        if !parameters.is_empty() {
            groups.push(Group { title: "parameter".to_owned(), rows: parameters });
        }
        Comparison { runs: compared.collect(), groups }
    }
}

/// All free parameters of all runs, in the order in which they are first met.
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
                Some(Cell { value, sigma, held: false, text: number(value, Digits::Decimals(4)), apart_sigmas: None });
        }
    }
    rows
}

/// What a run did not free, as its rig has it.
fn add_held(rows: &mut [Row], rigs: &[Option<Rig>]) {
    for row in rows {
        let Ok(parameter) = row.name.parse::<Parameter>() else { continue };
        let (factor, unit) = file_unit(parameter.unit());
        for (cell, rig) in row.cells.iter_mut().zip(rigs) {
            let (None, Some(rig)) = (&cell, rig) else { continue };
            let value = Model::new(rig.clone()).value(rig, parameter).filter(|_| unit == row.unit);
            *cell = value.map(|value| {
                let value = factor * value;
                Cell { value, sigma: None, held: true, text: number(value, Digits::Decimals(4)), apart_sigmas: None }
            });
        }
    }
}

/// Parameters of one arm after two calibrations are not farther apart, deg and mm.
const SAME_ARM: [(&str, f64); 2] = [("deg", 5.0), ("mm", 30.0)];

/// What shows that a run's arm is not that of the first.
fn another_arm(rows: &[Row], rigs: &[Option<Rig>], at: usize) -> Option<String> {
    let joints = |at: usize| Some(rigs.get(at)?.as_ref()?.robot.as_ref()?.joint_count());
    if let (Some(first), Some(other)) = (joints(0), joints(at))
        && first != other
    {
        return Some(format!("it has {other} joints, and that of the first has {first}"));
    }
    rows.iter().filter(|row| matches!(row.name.parse(), Ok(Parameter::Chain(_)))).find_map(|row| {
        let limit = SAME_ARM.iter().find(|(unit, _)| *unit == row.unit)?.1;
        let apart = (row.cells[at].as_ref()?.value - row.cells[0].as_ref()?.value).abs();
        // 360 deg are no difference.
        let apart = if row.unit == "deg" { (apart + 180.0).rem_euclid(360.0) - 180.0 } else { apart }.abs();
        (apart > limit)
            .then(|| format!("{} differs by {} {}", row.name, number(apart, Digits::Significant(3)), row.unit))
    })
}

fn hold_against_first(rows: &mut [Row], another_arm: &[Option<String>]) {
    for row in rows {
        let Some((first, first_sigma)) = row.cells[0].as_ref().and_then(|cell| Some((cell.value, cell.sigma?))) else {
            continue;
        };
        let others = row.cells.iter_mut().zip(another_arm).skip(1).filter(|(_, another)| another.is_none());
        for cell in others.filter_map(|(cell, _)| cell.as_mut()) {
            let together = cell.sigma.map(|sigma| sigma.hypot(first_sigma)).filter(|&sigma| sigma > 0.0);
            cell.apart_sigmas = together.map(|sigma| (cell.value - first).abs() / sigma);
        }
    }
}

impl ComparedRun {
    /// "\[2\] is of another arm than \[1\] ..."; `None` for the same arm. `at`: its position.
    pub fn note(&self, at: usize) -> Option<String> {
        let why = self.another_arm.as_ref()?;
        Some(format!(
            "[{}] is of another arm than [1] ({why}): its parameters are not compared with those of [1].",
            at + 1
        ))
    }
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
                escaped(run.dataset.as_deref().unwrap_or("not given")),
                format!("<strong>{}</strong>", escaped(&run.status)),
                escaped(&run.verdict),
            ]
        })
        .collect();
    let notes = comparison.runs.iter().enumerate().filter_map(|(at, run)| run.note(at));
    let notes: String = notes.map(|note| format!("<p class=\"notice\">{}</p>\n", escaped(&note))).collect();
    let mut parts = vec![Section {
        id: "runs",
        title: "Runs",
        html: table("words", "Verdict of each run", &["Run", "Rig", "Data set", "Status", "Verdict"], &verdicts)
            + &notes,
        charts: Vec::new(),
    }];
    let titles = [("metrics", "Metrics"), ("parameters", "Parameters")];
    for (group, (id, title)) in comparison.groups.iter().zip(titles) {
        let head: Vec<&str> =
            std::iter::once(title).chain(names.iter().map(String::as_str)).chain(std::iter::once("Unit")).collect();
        let rows: Vec<Vec<String>> = group.rows.iter().map(row_html).collect();
        let caption = match id {
            "parameters" => {
                "Calibrated values, \u{b1} sigma; held: not free in this run. In brackets: how many sigmas of both it is away from the first run."
            }
            _ => "Residuals are those of the calibrated rigs unless \u{201c}nominal\u{201d} is given.",
        };
        let mut html = table("numbers", caption, &head, &rows);
        let charts: Vec<Chart> = if id == "metrics" {
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
            let held = if cell.held { " <span class=\"none\">held</span>" } else { "" };
            format!("{}{sigma}{apart}{held}", escaped(&cell.text))
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
    // Points and no bars: a logarithmic axis has no zero for a bar to start from.
    let points = |name: &str, which: &str, color: &str, symbol: &str| {
        let y: Vec<Option<f64>> =
            runs.iter().map(|run| run.number(&format!("/calibration/epipolar_{which}/median_px"))).collect();
        json!({"type": "scatter", "mode": "markers", "name": name, "x": labels(comparison), "y": y,
               "marker": {"color": color, "symbol": symbol, "size": 11},
               "hovertemplate": "%{y:.3g} px<extra></extra>"})
    };
    Some(Chart {
        id: "compared-residuals",
        caption: "Median distance of the matches to their epipolar lines.".to_owned(),
        description: "Median residual of each run, nominal and calibrated".to_owned(),
        data: json!([
            points("nominal", "before", NOMINAL, "diamond-open"),
            points("calibrated", "after", CALIBRATED, "circle")
        ]),
        layout: json!({
            "xaxis": {"type": "category", "automargin": true, "range": [-0.5, comparison.runs.len() as f64 - 0.5]},
            "yaxis": {"type": "log", "title": {"text": "distance (px)"}, "exponentformat": "none", "dtick": "D2"},
        }),
        height: 340,
        max_width: None,
    })
}

/// How far each parameter of the other runs is from the first, in sigmas.
fn changes_chart(comparison: &Comparison) -> Option<Chart> {
    let rows = &comparison.groups.get(1)?.rows;
    let symbols = ["circle", "diamond", "square", "triangle-up", "x"];
    let colors = [CALIBRATED, NOMINAL, "#009E73", "#CC79A7", "#56B4E9"];
    let traces: Vec<_> = (1..comparison.runs.len())
        .filter_map(|at| {
            let with_sigmas: Vec<(&str, f64)> = rows
                .iter()
                .filter_map(|row| Some((row.name.as_str(), row.cells[at].as_ref()?.apart_sigmas?)))
                .collect();
            (!with_sigmas.is_empty()).then(|| {
                json!({"type": "scatter", "mode": "markers", "name": labels(comparison)[at],
                       "x": with_sigmas.iter().map(|(name, _)| escaped(name)).collect::<Vec<_>>(),
                       "y": with_sigmas.iter().map(|(_, sigmas)| *sigmas).collect::<Vec<_>>(),
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
        max_width: None,
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
        let comparison = Comparison::of(&runs, &[]);
        let rows = &comparison.groups[1].rows;
        let names: Vec<&str> = rows.iter().map(|row| row.name.as_str()).collect();
        assert_eq!(names, ["a_2", "alpha_2", "d_7"]);
        assert_eq!(rows[0].cells[1].as_ref().unwrap().apart_sigmas, Some(2.0));
        assert!(rows[1].cells[1].is_none() && rows[2].cells[0].is_none());
        let page = compare_html(&runs, &comparison);
        assert!(page.contains("&lt;b&gt;arm") && !page.contains("<b>arm"));
    }

    fn rig(name: &str) -> Option<Rig> {
        Some(skclam::rig::builtin_rig(name).unwrap().unwrap())
    }

    #[test]
    fn what_a_run_held_is_shown_as_held() {
        let runs = [
            run("one", json!([{"name": "a_3", "unit": "mm", "calibrated": 260.5, "sigma": 0.1}])),
            run("two", json!([{"name": "alpha_2", "unit": "deg", "calibrated": -90.1, "sigma": 0.01}])),
        ];
        let comparison = Comparison::of(&runs, &[rig("hp3j"), rig("hp3j")]);
        let cells = &comparison.groups[1].rows[0].cells;
        let held = cells[1].as_ref().unwrap();
        let rig_of = rig("hp3j").unwrap();
        let nominal = Model::new(rig_of.clone()).value(&rig_of, "a_3".parse().unwrap()).unwrap();
        assert!(
            held.held && !cells[0].as_ref().unwrap().held && (held.value - 1e3 * nominal).abs() < 1e-9,
            "{cells:?}"
        );
        assert!(held.apart_sigmas.is_none());
        assert!(compare_html(&runs, &comparison).contains(">held</span>"));
    }

    #[test]
    fn two_arms_are_not_compared() {
        let parameters = |value: f64| json!([{"name": "a_3", "unit": "mm", "calibrated": value, "sigma": 0.1}]);
        let compared = |value: f64, rigs: &[Option<Rig>]| {
            let comparison = Comparison::of(&[run("one", parameters(260.0)), run("two", parameters(value))], rigs);
            let apart = comparison.groups[1].rows[0].cells[1].as_ref().unwrap().apart_sigmas;
            (apart.is_some(), comparison.runs[1].note(1))
        };
        assert_eq!(compared(260.2, &[]), (true, None));
        let (in_sigmas, note) = compared(425.0, &[]);
        assert!(!in_sigmas && note.unwrap().contains("a_3 differs by 165 mm"));
        let (in_sigmas, note) = compared(260.2, &[rig("hp3j"), rig("franka-fr3")]);
        assert!(!in_sigmas && note.unwrap().contains("7 joints"));
    }
}
