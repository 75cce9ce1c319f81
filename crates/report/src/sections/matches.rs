//! Matches on the images: the worst, the median and the best pair with epipolar lines before and after.

use crate::RunResult;
use crate::charts::{Digits, number};
use crate::html::escaped;
use crate::page::Section;
use skclam::report_data::{DrawnMatch, PairImages, ReportData};
use std::fmt::Write as _;

pub(crate) fn section(run: &RunResult) -> Section {
    let html = match &run.data {
        None => super::NO_DATA.to_owned(),
        Some(data) if data.images.is_empty() => "<p>No pair has enough matches to be drawn.</p>\n".to_owned(),
        Some(data) => {
            let mut html = "<p class=\"key\"><span class=\"line nominal\"></span> epipolar line by the nominal rig (dashed) \
                            <span class=\"line calibrated\"></span> by the calibrated rig (solid) <span class=\"ring\"></span> \
                            where the image shows the point</p>\n"
                .to_owned();
            for image in &data.images {
                html += &pair(image, data);
            }
            html
        }
    };
    Section { id: "matches", title: "Matches on the images", html, charts: Vec::new() }
}

fn pair(image: &PairImages, data: &ReportData) -> String {
    let [a, b] = [image.a, image.b].map(|at| data.postures[at].index);
    let residual = data.residuals.pairs.iter().find(|pair| (pair.a, pair.b) == (image.a, image.b));
    let metrics = residual.map_or(String::new(), |found| {
        let px = |value: f64| number(value, Digits::Significant(3));
        format!(
            "{} matches; median distance to the line {} px nominal, {} px calibrated.",
            found.matches,
            px(found.median_before_px),
            px(found.median_after_px)
        )
    });
    let title = match image.rank.as_str() {
        "worst" => "Worst pair",
        "best" => "Best pair",
        _ => "Median pair",
    };
    let sides: String = (0..2).map(|side| one(image, side, [a, b][side])).collect();
    format!(
        "<figure class=\"matched\"><figcaption><strong>{title}: postures {a} and {b}.</strong> {metrics}</figcaption>\n<div class=\"pair\">{sides}</div></figure>\n"
    )
}

fn one(pair: &PairImages, side: usize, index: u64) -> String {
    let image = &pair.images[side];
    let (width, height) = (image.width, image.height);
    let mut drawn = String::new();
    for (which, class) in [(0, "nominal"), (1, "calibrated")] {
        for found in &pair.matches {
            let lines = if which == 0 { &found.lines_before } else { &found.lines_after };
            let points: Vec<String> = lines[side].iter().map(|[x, y]| format!("{x},{y}")).collect();
            // Writing to a String cannot fail.
            let _ = write!(drawn, "<polyline class=\"{class}\" points=\"{}\"/>", points.join(" "));
        }
    }
    for found in &pair.matches {
        let [x, y] = found.points[side];
        let _ = write!(drawn, "<circle cx=\"{x}\" cy=\"{y}\" r=\"4\"><title>{}</title></circle>", tooltip(found));
    }
    format!(
        "<svg class=\"image\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"Image of posture {index} with {} matches and their epipolar lines\">\
         <image href=\"data:image/jpeg;base64,{}\" width=\"{width}\" height=\"{height}\"/>{drawn}</svg>",
        pair.matches.len(),
        escaped(&image.jpeg.0),
    )
}

fn tooltip(found: &DrawnMatch) -> String {
    let px = |value: f64| number(value, Digits::Significant(3));
    format!("{} px from its line nominal, {} px calibrated", px(found.before_px), px(found.after_px))
}
