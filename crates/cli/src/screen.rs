//! What people read: tables on standard output, warnings on standard error.

use comfy_table::{CellAlignment, ContentArrangement, Table, presets};

/// A table whose first column is text and whose others are numbers.
pub fn table(header: &[&str]) -> Table {
    let mut table = Table::new();
    table
        .load_style(presets::UTF8_BORDERS_ONLY)
        .set_content_arrangement(ContentArrangement::Dynamic)
        .set_header(header);
    for column in table.column_iter_mut().skip(1) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}

/// An error and its causes in one line, each said once: many messages hold that of their cause already.
pub fn told<E: std::fmt::Display>(chain: impl IntoIterator<Item = E>) -> String {
    chain.into_iter().fold(String::new(), |mut told, error| {
        let error = error.to_string();
        if !told.contains(error.trim()) {
            if !told.is_empty() {
                told += ": ";
            }
            told += error.trim_end();
        }
        told
    })
}

/// A number of a table; in powers of ten where it would burst its column.
pub fn fixed(value: f64, decimals: usize) -> String {
    if value.abs() < 1e7 { format!("{value:.decimals$}") } else { format!("{value:.1e}") }
}

/// Warnings of a run go to standard error, so that a script that reads the results is not disturbed.
pub fn warn(quiet: bool, warnings: &[String]) {
    warn_of(quiet, warnings, "summary.json");
}

/// Warnings, of which the last ones are left to the file that holds all of them.
pub fn warn_of(quiet: bool, warnings: &[String], stand_in: &str) {
    const SHOWN: usize = 12;
    if quiet {
        return;
    }
    for warning in warnings.iter().take(SHOWN) {
        eprintln!("warning: {warning}");
    }
    if warnings.len() > SHOWN {
        eprintln!("warning: ... and {} more; all of them stand in {stand_in}", warnings.len() - SHOWN);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_cause_is_said_once() {
        let file = "cell/a.jpg: not found";
        assert_eq!(told(["calibration: too few", "too few"]), "calibration: too few");
        assert_eq!(told(["out.json", file, "not found\n", "os error 2"]), format!("out.json: {file}: os error 2"));
    }

    #[test]
    fn no_number_bursts_its_column() {
        assert_eq!(fixed(-12.34, 1), "-12.3");
        assert_eq!(fixed(1e300, 1), "1.0e300");
        assert!(fixed(-f64::MAX, 4).len() <= 10);
    }
}
