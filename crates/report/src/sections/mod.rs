//! One file a section of the page; each gives HTML and charts.

pub(crate) mod graph;
pub(crate) mod identifiability;
pub(crate) mod matches;
pub(crate) mod overview;
pub(crate) mod parameters;
pub(crate) mod process;
pub(crate) mod reproduce;
pub(crate) mod residuals;
pub(crate) mod uncertainty;

/// Said where an older run left only its summary.
pub(crate) const NO_DATA: &str =
    "<p class=\"none\">The result folder has no report_data.json; run the calibration again to see this.</p>\n";
