//! The first screen: verdict, status, the metrics that matter, the map in 3D.

use crate::RunResult;
use crate::charts::{Digits, Numbers};
use crate::html::{escaped, script_json};
use crate::judgement::{Status, judge};
use crate::page::Section;
use serde_json::json;
use skclam::report_data::ReportData;

pub(crate) fn section(run: &RunResult) -> Section {
    let judgement = judge(run);
    let checks: String = judgement
        .checks
        .iter()
        .map(|(status, text)| {
            format!(
                "<li class=\"{}\">{}<span><span class=\"sr\">{}: </span>{}</span></li>\n",
                status.class(),
                shape(*status),
                status.word(),
                escaped(text)
            )
        })
        .collect();
    let html = format!(
        "<div class=\"first\">\n<div class=\"verdict\">\n\
         <p class=\"status {class}\">{shape}<strong>{word}</strong></p>\n\
         <p class=\"sentence\">{sentence}</p>\n\
         <ul class=\"checks\">\n{checks}</ul>\n{tiles}</div>\n{scene}</div>\n",
        class = judgement.status.class(),
        shape = shape(judgement.status),
        word = judgement.status.word(),
        sentence = escaped(run.text("/verdict")),
        tiles = tiles(run),
        scene = scene(run),
    );
    Section { id: "verdict", title: "Verdict", html, charts: Vec::new() }
}

/// An icon beside the word: a tick in a circle, a sign with an exclamation mark, a cross in an octagon.
fn shape(status: Status) -> &'static str {
    match status {
        Status::Green => {
            "<svg viewBox=\"0 0 24 24\" aria-hidden=\"true\"><circle cx=\"12\" cy=\"12\" r=\"11\"/><path d=\"M6.5 12.5l3.8 3.8 7.2-8\"/></svg>"
        }
        Status::Amber => {
            "<svg viewBox=\"0 0 24 24\" aria-hidden=\"true\"><path class=\"body\" d=\"M12 1.5L23.5 22H.5z\"/><path d=\"M12 8.5v6.5M12 18.2v.6\"/></svg>"
        }
        Status::Red => {
            "<svg viewBox=\"0 0 24 24\" aria-hidden=\"true\"><path class=\"body\" d=\"M7.4 1h9.2L23 7.4v9.2L16.6 23H7.4L1 16.6V7.4z\"/><path d=\"M8 8l8 8M16 8l-8 8\"/></svg>"
        }
    }
}

fn tiles(run: &RunResult) -> String {
    let numbers = Numbers::of(run);
    let tile = |label: &str, value: String, note: &str| {
        format!("<div><dt>{label}</dt><dd>{value}<small>{note}</small></dd></div>\n")
    };
    let mut out = String::from("<dl class=\"tiles\">\n");
    // Without pairs (a board alone) there are no lines to be far from.
    let fits = [
        ("Epipolar distance", "epipolar", "median_px", "median distance, nominal to calibrated"),
        ("Reprojection error", "reprojection", "rms_px", "RMS, nominal to calibrated"),
    ];
    let pointer = |kind: &str, which: &str, field: &str| format!("/calibration/{kind}_{which}/{field}");
    let fit = fits.iter().find(|(_, kind, field, _)| run.number(&pointer(kind, "after", field)).is_some());
    if let Some((label, kind, field, note)) = fit {
        let change = numbers.change(&pointer(kind, "before", field), &pointer(kind, "after", field), "px");
        out += &tile(label, change, note);
    }
    let held_out = "/held_out/metric_px/calibrated";
    out += &tile(
        "Held-out postures",
        match run.number(held_out) {
            Some(_) => numbers.change("/held_out/metric_px/nominal", held_out, "px"),
            None => numbers.show(held_out, Digits::Whole),
        },
        &escaped(match run.text("/held_out/metric") {
            "" => "residual where it was not fitted",
            metric => metric,
        }),
    );
    out += &tile(
        "Depth consistency",
        match run.number("/map/depth_consistency_calibrated/median_mm") {
            Some(_) => numbers.change(
                "/map/depth_consistency_nominal/median_mm",
                "/map/depth_consistency_calibrated/median_mm",
                "mm",
            ),
            None => numbers.show("/map/depth_consistency_calibrated/median_mm", Digits::Whole),
        },
        "median distance, nominal to calibrated",
    );
    let camera = "/recorded_poses/camera_sigma_mm/mean";
    out += &tile(
        "Expected error of the camera",
        numbers.with_unit(camera, Digits::Significant(2), "mm"),
        "position, one sigma, mean over your postures",
    );
    out + "</dl>\n"
}

fn scene(run: &RunResult) -> String {
    let Some(data) = &run.data else { return super::NO_DATA.to_owned() };
    let map = data.map.is_some();
    let choice = |name: &str, value: &str, label: &str, checked: bool| {
        let checked = if checked { " checked" } else { "" };
        format!("<label><input type=\"radio\" name=\"{name}\" value=\"{value}\"{checked}><span>{label}</span></label>")
    };
    let rig = format!(
        "<fieldset><legend>Poses</legend>{}{}</fieldset>",
        choice("poses", "nominal", "Nominal", false),
        choice("poses", "calibrated", "Calibrated", true)
    );
    let color = format!(
        "<fieldset><legend>Colour</legend>{}{}{}</fieldset>",
        choice("color", "photo", "Photograph", true),
        choice("color", "image", "Image", false),
        choice("color", "distance", "Depth consistency", false)
    );
    let (title, what) = if map {
        (
            "The map",
            "Points of all depth images, put together by the poses of the nominal or of the calibrated rig. Where surfaces are double or \
             blurred, the poses are wrong. Depth consistency: median distance of a point to the surfaces of the other images that show it.",
        )
    } else {
        (
            "Where the camera was",
            "Camera positions in the base frame. There is no map: the data set has no depth images, or none was asked for.",
        )
    };
    format!(
        "<div class=\"scene\">\n<h3>{title}</h3>\n<form class=\"switches\" aria-label=\"What the 3D view shows\">{rig}{color}</form>\n\
         <div id=\"view3d\" class=\"plot\" role=\"application\" tabindex=\"0\" aria-label=\"3D view. Arrow keys turn it, plus and minus move nearer and away, 0 puts it back.\"></div>\n\
         <p class=\"hint\"><span id=\"scene-said\" role=\"status\"></span> Turn: drag, or arrow keys. Nearer: wheel, or + and \u{2212}. Back: 0.</p>\n\
         <p class=\"caption\">{what}</p>\n</div>\n",
        color = if map { &color } else { "" },
    )
}

/// The 3D view's data for the script.
pub(crate) fn scene_json(data: &ReportData) -> String {
    let positions = |of: fn(&skclam::report_data::PosturePlace) -> [f64; 3]| -> Vec<[f64; 3]> {
        data.postures.iter().map(of).collect()
    };
    script_json(&json!({
        "nominal": positions(|posture| posture.nominal_m),
        "calibrated": positions(|posture| posture.calibrated_m),
        "indices": data.postures.iter().map(|posture| posture.index).collect::<Vec<_>>(),
        "map": data.map,
    }))
}
