//! What people read: tables on standard output, warnings on standard error. Nothing that a terminal would obey gets
//! through, wherever a text came from; and a stream that cannot be written to is an error of the command and no panic.

use anyhow::{Context, Result};
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use skclam::output::{Contents, StagedFolder};
use skclam_files::{json_text, on_screen, shortened, shown};
use std::fmt::Arguments;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::sync::{Mutex, PoisonError};

/// Prints a line.
macro_rules! say {
    () => { $crate::screen::print(format_args!("\n")) };
    ($($part:tt)*) => { $crate::screen::print(format_args!("{}\n", format_args!($($part)*))) };
}

/// Prints without an end of line.
macro_rules! say_on {
    ($($part:tt)*) => { $crate::screen::print(format_args!($($part)*)) };
}

/// A line on standard error.
macro_rules! note {
    ($($part:tt)*) => { $crate::screen::remark(format_args!($($part)*)) };
}

pub(crate) use {note, say, say_on};

/// Why standard output could not be written to; nothing is printed after that.
static FAILURE: Mutex<Option<std::io::Error>> = Mutex::new(None);

/// Prints text in which a terminal finds nothing to obey.
pub fn print(text: Arguments<'_>) {
    write(&on_screen(&text.to_string()));
}

/// Prints a value as JSON.
pub fn json(value: &impl serde::Serialize) -> Result<()> {
    write(&(json_text(&serde_json::to_string_pretty(value)?) + "\n"));
    Ok(())
}

fn write(text: &str) {
    let mut failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner);
    if failure.is_none() {
        *failure = std::io::stdout().write_all(text.as_bytes()).err();
    }
}

/// Whether all that was printed arrived. A reader that has seen enough (head, less) is no failure.
pub fn end() -> Result<()> {
    let failure = FAILURE.lock().unwrap_or_else(PoisonError::into_inner).take();
    match failure.map_or_else(|| std::io::stdout().flush(), Err) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(error).context("standard output"),
        _ => Ok(()),
    }
}

/// A line on standard error. Where that is closed, nobody reads it.
pub fn remark(text: Arguments<'_>) {
    let _ = writeln!(std::io::stderr(), "{}", on_screen(&text.to_string()));
}

/// The most characters of a line of an error, and the most lines: some quote the file that they are about.
const ERROR_CHARS: usize = 1000;
const ERROR_LINES: usize = 30;

/// The error that ends the program.
pub fn error<E: std::fmt::Display>(chain: impl IntoIterator<Item = E>) {
    let joined = joined(chain);
    let lines: Vec<_> = joined.lines().take(ERROR_LINES).map(|line| shortened(line, ERROR_CHARS)).collect();
    remark(format_args!("error: {}", lines.join("\n")));
}

/// Begins a folder of results, and reports what commands that were killed had left beside it.
pub fn staged(quiet: bool, out: &Path, contents: Contents) -> Result<StagedFolder> {
    let staged = StagedFolder::new(out, contents)?;
    let joined: Vec<String> = staged
        .cleaned()
        .iter()
        .map(|folder| format!("{} was left by a command that was killed, and is removed", folder.display()))
        .collect();
    warn(quiet, &joined);
    Ok(staged)
}

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
pub fn joined<E: std::fmt::Display>(chain: impl IntoIterator<Item = E>) -> String {
    chain.into_iter().fold(String::new(), |mut joined, error| {
        let error = error.to_string();
        if !joined.contains(error.trim()) {
            if !joined.is_empty() {
                joined += ": ";
            }
            joined += error.trim_end();
        }
        joined
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
pub fn warn_of(quiet: bool, warnings: &[String], listed_in: &str) {
    const SHOWN: usize = 12;
    if quiet {
        return;
    }
    for warning in warnings.iter().take(SHOWN) {
        note!("warning: {}", shortened(&shown(warning), ERROR_CHARS));
    }
    if warnings.len() > SHOWN {
        note!("warning: ... and {} more; all of them are in {listed_in}", warnings.len() - SHOWN);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_cause_is_said_once() {
        let file = "cell/a.jpg: not found";
        assert_eq!(joined(["calibration: too few", "too few"]), "calibration: too few");
        assert_eq!(joined(["out.json", file, "not found\n", "os error 2"]), format!("out.json: {file}: os error 2"));
    }

    #[test]
    fn no_number_bursts_its_column() {
        assert_eq!(fixed(-12.34, 1), "-12.3");
        assert_eq!(fixed(1e300, 1), "1.0e300");
        assert!(fixed(-f64::MAX, 4).len() <= 10);
    }
}
