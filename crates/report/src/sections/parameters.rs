//! Each free parameter: nominal, calibrated, change, sigma, significance.

use crate::RunResult;
use crate::charts::{Digits, Numbers, number};
use crate::html::{bar, escaped, table};
use crate::page::Section;
use serde_json::Value;

pub(crate) fn section(run: &RunResult) -> Section {
    let parameters = run.list("/calibration/parameters");
    let changes: Vec<Option<f64>> = parameters.iter().map(significance).collect();
    let greatest = changes.iter().flatten().fold(0f64, |greatest, value| greatest.max(*value));
    let numbers = Numbers::of(run);
    let row = |(at, parameter): (usize, &Value)| {
        let unit = parameter["unit"].as_str().unwrap_or_default();
        let decimals = decimals(parameter);
        let metric =
            |field: &str| numbers.show(&format!("/calibration/parameters/{at}/{field}"), Digits::Decimals(decimals));
        let change = match (parameter["nominal"].as_f64(), parameter["calibrated"].as_f64()) {
            (Some(nominal), Some(calibrated)) => format!("{:+.decimals$}", calibrated - nominal),
            _ => String::new(),
        };
        let (sigma, significance) = match (parameter["sigma"].as_f64(), changes[at]) {
            (Some(_), Some(value)) => (
                numbers.show(&format!("/calibration/parameters/{at}/sigma"), Digits::Significant(2)),
                format!(
                    "{}<span class=\"right\">{}</span>",
                    // Logarithmic: changes of ten and of ten thousand sigmas both occur.
                    bar(
                        (1.0 + value).ln() / (1.0 + greatest.max(1.0)).ln(),
                        if value < 2.0 { "weak" } else { "strong" }
                    ),
                    if value < 99.5 { number(value, Digits::Decimals(1)) } else { number(value, Digits::Whole) }
                ),
            ),
            _ => (
                format!("<span class=\"none\">{}</span>", escaped(parameter["note"].as_str().unwrap_or("none"))),
                String::new(),
            ),
        };
        vec![
            escaped(parameter["name"].as_str().unwrap_or_default()),
            metric("nominal"),
            metric("calibrated"),
            change,
            sigma,
            escaped(if unit.is_empty() { "1" } else { unit }),
            significance,
        ]
    };
    let rows: Vec<Vec<String>> = parameters.iter().enumerate().map(row).collect();
    let html = if rows.is_empty() {
        "<p>No parameter was free.</p>\n".to_owned()
    } else {
        table(
            "parameters",
            "Free parameters. Significance is |change| / sigma: below 2 the change may be chance. The bar is logarithmic.",
            &["Parameter", "Nominal", "Calibrated", "Change", "Sigma", "Unit", "Significance"],
            &rows,
        )
    };
    let html = format!(
        "{html}<p class=\"note\">Units: deg degrees, mm millimetres, px pixels, 1 no unit. Names are those of the Denavit-Hartenberg table; \
         rotations of the mount are relative to the nominal mount, in the flange's axes. All other parameters kept their nominal values.</p>\n"
    );
    Section { id: "parameters", title: "Parameters", html, charts: Vec::new() }
}

/// |change| in sigmas.
fn significance(parameter: &Value) -> Option<f64> {
    let change = parameter["calibrated"].as_f64()? - parameter["nominal"].as_f64()?;
    let sigma = parameter["sigma"].as_f64().filter(|&sigma| sigma > 0.0)?;
    Some(change.abs() / sigma)
}

/// So many decimals that sigma has two digits, between 2 and 6.
fn decimals(parameter: &Value) -> usize {
    match parameter["sigma"].as_f64().filter(|&sigma| sigma > 0.0) {
        Some(sigma) => (1.0 - sigma.log10().floor()).clamp(2.0, 6.0) as usize,
        None => 4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn decimals_follow_sigma() {
        assert_eq!(decimals(&json!({"sigma": 0.012})), 3);
        assert_eq!(decimals(&json!({"sigma": 4.2e-5})), 6);
        assert_eq!(decimals(&json!({"sigma": 300.0})), 2);
        assert_eq!(decimals(&json!({"sigma": null})), 4);
        assert_eq!(significance(&json!({"nominal": 1.0, "calibrated": 0.0, "sigma": 0.5})), Some(2.0));
        assert_eq!(significance(&json!({"nominal": 1.0, "calibrated": 0.0, "sigma": null})), None);
    }
}
