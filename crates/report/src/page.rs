//! The page: its order, its style and its script.

use crate::RunResult;
use crate::charts::{Chart, charts_json, plotly_js};
use crate::html::{escaped, script_json};
use crate::sections;

const STYLE: &str = include_str!("../assets/report.css");
const SCRIPT: &str = include_str!("../assets/report.js");
/// Nothing may be loaded from anywhere: everything is in the page.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'";

/// One part of the page: a heading and what is below it.
pub(crate) struct Section {
    pub id: &'static str,
    pub title: &'static str,
    pub html: String,
    pub charts: Vec<Chart>,
}

/// The report of one run. The same result gives the same bytes.
pub fn report_html(run: &RunResult) -> String {
    let parts = [
        sections::overview::section(run),
        sections::parameters::section(run),
        sections::identifiability::section(run),
        sections::residuals::section(run),
        sections::matches::section(run),
        sections::graph::section(run),
        sections::uncertainty::section(run),
        sections::process::section(run),
        sections::reproduce::section(run),
    ];
    let rig = run.text("/rig");
    let title = if rig.is_empty() { "Calibration report".to_owned() } else { format!("Calibration report: {rig}") };
    let map = run.data.as_ref().map_or_else(|| "null".to_owned(), sections::overview::scene_json);
    let header = format!(
        "<p class=\"kicker\">Calibration report</p>\n<h1>{}</h1>\n<p class=\"origin\">{}{} {}</p>",
        escaped(if rig.is_empty() { "Unnamed rig" } else { rig }),
        run.data.as_ref().map_or_else(String::new, |data| format!("data set {} \u{b7} ", escaped(&data.dataset))),
        escaped(run.text("/program")),
        escaped(run.text("/version"))
    );
    assemble(&title, &header, &parts, &map)
}

/// A whole page.
pub(crate) fn assemble(title: &str, header: &str, parts: &[Section], scene: &str) -> String {
    let links: String =
        parts.iter().map(|part| format!("<li><a href=\"#{}\">{}</a></li>\n", part.id, escaped(part.title))).collect();
    let body: String = parts
        .iter()
        .map(|part| {
            format!(
                "<section id=\"{0}\" aria-labelledby=\"{0}-title\">\n<h2 id=\"{0}-title\">{1}</h2>\n{2}</section>\n",
                part.id,
                escaped(part.title),
                part.html
            )
        })
        .collect();
    let charts: Vec<Chart> = parts.iter().flat_map(|part| part.charts.iter().cloned()).collect();
    let theme = script_json(&serde_json::json!({
        "nominal": crate::charts::NOMINAL,
        "calibrated": crate::charts::CALIBRATED,
    }));
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"{POLICY}\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n\
         <link rel=\"icon\" href=\"data:,\">\n\
         <title>{title}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n\
         <a class=\"skip\" href=\"#content\">Skip to the report</a>\n\
         <header>\n{header}\n</header>\n\
         <div class=\"columns\">\n<nav aria-label=\"Contents\"><ul>\n{links}</ul></nav>\n\
         <main id=\"content\" tabindex=\"-1\">\n\
         <noscript><p class=\"notice\">The charts and the 3D view need JavaScript; the tables and the verdict do not.</p></noscript>\n\
         {body}</main>\n</div>\n\
         <script type=\"application/json\" id=\"charts-data\">{charts}</script>\n\
         <script type=\"application/json\" id=\"scene-data\">{scene}</script>\n\
         <script type=\"application/json\" id=\"theme-data\">{theme}</script>\n\
         <script>{plotly}</script>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        title = escaped(title),
        charts = charts_json(&charts),
        plotly = plotly_js(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn our_script_and_style_end_no_element() {
        assert!(!SCRIPT.contains("</script") && !STYLE.contains("</style"));
    }
}
