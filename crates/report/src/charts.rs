//! Numbers with their origin, and charts as plotly.js takes them.

use crate::RunResult;
use crate::html::{escaped, script_json};
use serde_json::{Value, json};

/// The colour of what is nominal: vermillion of Okabe and Ito's palette.
pub const NOMINAL: &str = "#D55E00";
/// The colour of what is calibrated: blue of the same palette.
pub const CALIBRATED: &str = "#0072B2";

/// How many digits a number is shown with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Digits {
    /// After the point.
    Decimals(usize),
    /// That mean something; never in exponent form between 1e-4 and 1e7.
    Significant(usize),
    /// A whole number in groups of three.
    Whole,
}

/// A number as text.
pub fn number(value: f64, digits: Digits) -> String {
    match digits {
        Digits::Decimals(decimals) => no_minus_zero(format!("{value:.decimals$}")),
        Digits::Whole => grouped(value),
        Digits::Significant(significant) => {
            let significant = significant.max(1);
            if value == 0.0 {
                return "0".to_owned();
            }
            let size = value.abs();
            if !(1e-4..1e7).contains(&size) {
                return format!("{value:.*e}", significant - 1);
            }
            let before = size.log10().floor() as i32 + 1;
            let decimals = (significant as i32 - before).max(0) as usize;
            format!("{value:.decimals$}")
        }
    }
}

fn no_minus_zero(text: String) -> String {
    match text.strip_prefix('-') {
        Some(rest) if rest.chars().all(|c| c == '0' || c == '.') => rest.to_owned(),
        _ => text,
    }
}

fn grouped(value: f64) -> String {
    let digits = format!("{:.0}", value.abs());
    let mut out = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            // A narrow space that does not break.
            out.push('\u{202f}');
        }
        out.push(digit);
    }
    if value < 0.0 { format!("-{out}") } else { out }
}

/// Shows metrics of `summary.json` and says where each is from: `<data value="..."
/// data-from="/json/pointer">text</data>`, the value as written in the file, the text with fewer digits.
#[derive(Debug, Clone, Copy)]
pub struct Numbers<'a> {
    run: &'a RunResult,
}

impl<'a> Numbers<'a> {
    /// Numbers of this run.
    pub fn of(run: &'a RunResult) -> Self {
        Numbers { run }
    }

    /// The metric as HTML; "not measured" where there is none.
    pub fn show(&self, pointer: &str, digits: Digits) -> String {
        let found = self.run.metric(pointer);
        match (found, found.and_then(Value::as_f64)) {
            (Some(found), Some(value)) => {
                format!("<data value=\"{found}\" data-from=\"{}\">{}</data>", escaped(pointer), number(value, digits))
            }
            _ => "<span class=\"none\">not measured</span>".to_owned(),
        }
    }

    /// With a unit behind it.
    pub fn with_unit(&self, pointer: &str, digits: Digits, unit: &str) -> String {
        match self.run.number(pointer) {
            Some(_) if !unit.is_empty() => format!("{}&nbsp;{}", self.show(pointer, digits), escaped(unit)),
            _ => self.show(pointer, digits),
        }
    }

    /// "31.5 to 0.022 px": before and after.
    pub fn change(&self, before: &str, after: &str, unit: &str) -> String {
        let digits = Digits::Significant(3);
        format!("{} <span class=\"to\">to</span> {}", self.show(before, digits), self.with_unit(after, digits, unit))
    }
}

/// A chart: data and layout of plotly.js, and its description for a person who cannot see it.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Unique in the page.
    pub id: &'static str,
    /// What it shows, in a sentence; becomes the caption. Plain text.
    pub caption: String,
    /// What can be read off it, for those who cannot see it. Plain text.
    pub description: String,
    /// Traces.
    pub data: Value,
    /// Layout; fonts and colours come from the page.
    pub layout: Value,
    /// Height in CSS pixels.
    pub height: u32,
    /// Greatest width in CSS pixels; `None` for the page's. For plots with one scale on both axes, which would leave
    /// the rest empty.
    pub max_width: Option<u32>,
}

/// Greatest width of a plot with one scale on both axes and a colour bar beside it, for the extents of what it shows.
pub(crate) fn width_for(height: u32, x: impl Iterator<Item = f64>, y: impl Iterator<Item = f64>) -> u32 {
    let extent = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if high > low { high - low } else { 0.0 }
    };
    let (mut x, mut y) = (x, y);
    let (x, y) = (extent(&mut x), extent(&mut y));
    // Around the plot: legend and axis title above and below; axis title and colour bar beside.
    let plot = f64::from(height.saturating_sub(80));
    let aspect = if y > 0.0 { x / y } else { f64::INFINITY };
    (plot * aspect.clamp(0.8, 2.5)) as u32 + 160
}

impl Chart {
    /// The place of the chart in the page.
    pub(crate) fn html(&self) -> String {
        format!(
            "<figure class=\"chart\"><div id=\"{}\" class=\"plot\" role=\"img\" aria-label=\"{}\" style=\"height:{}px{}\"></div>\
             <figcaption>{}</figcaption></figure>\n",
            self.id,
            escaped(&self.description),
            self.height,
            self.max_width.map_or(String::new(), |width| format!(";max-width:{width}px")),
            escaped(&self.caption)
        )
    }
}

/// All charts of a page for its script.
pub(crate) fn charts_json(charts: &[Chart]) -> String {
    let list: Vec<Value> =
        charts.iter().map(|chart| json!({"id": chart.id, "data": chart.data, "layout": chart.layout})).collect();
    script_json(&list)
}

/// plotly.js itself, without the element around it.
pub(crate) fn plotly_js() -> String {
    // The crate hands out plotly.js and MathJax as two script elements; there are no formulas in our charts.
    let sources = plotly::Plot::offline_js_sources();
    let begin = sources.find('>').map_or(0, |at| at + 1);
    let end = sources.find("</script>").unwrap_or(sources.len());
    sources[begin..end].to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        let shown = |value, digits| number(value, digits);
        assert_eq!(shown(31.52397, Digits::Significant(3)), "31.5");
        assert_eq!(shown(0.0215438, Digits::Significant(3)), "0.0215");
        assert_eq!(shown(1234.5, Digits::Significant(3)), "1234");
        assert_eq!(shown(4.2e-5, Digits::Significant(3)), "4.20e-5");
        assert_eq!(shown(0.0, Digits::Significant(3)), "0");
        assert_eq!(shown(-0.00001, Digits::Decimals(3)), "0.000");
        assert_eq!(shown(6555941.0, Digits::Whole), "6\u{202f}555\u{202f}941");
        assert_eq!(shown(-12.0, Digits::Whole), "-12");
    }

    #[test]
    fn plots_of_one_scale_are_as_wide_as_they_are_high() {
        let width = |x: [f64; 2], y: [f64; 2]| width_for(480, x.into_iter(), y.into_iter());
        assert_eq!(width([0.0, 1.0], [2.0, 3.0]), 560);
        assert!(width([0.0, 2.0], [0.0, 1.0]) > 900 && width([0.0, 0.1], [0.0, 1.0]) < 500);
        assert_eq!(width([0.0, 1.0], [0.0, 0.0]), width_for(480, [0.0, 9.0].into_iter(), [0.0, 1.0].into_iter()));
    }

    #[test]
    fn plotly_is_there_without_the_other_scripts() {
        let script = plotly_js();
        assert!(script.len() > 3_000_000 && script.contains("plotly.js v"), "{}", script.len());
        assert!(!script.contains("MathJax_Main"), "no fonts of MathJax");
    }
}
