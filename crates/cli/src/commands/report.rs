//! `skclam report` and `skclam compare`.

use crate::args::Cli;
use crate::screen;
use anyhow::{Context, Result};
use clap::{Args, ValueHint};
use skclam::output::StagedFolder;
use skclam::rig::Rig;
use skclam_report::{Comparison, RunResult, compare_html, report_html};
use std::path::{Path, PathBuf};

/// Arguments of `report`.
#[derive(Debug, Args)]
pub struct ReportArgs {
    /// A result folder, with summary.json and report_data.json.
    #[arg(value_hint = ValueHint::DirPath)]
    pub result: PathBuf,
    /// Write the page here instead of into the result folder.
    #[arg(long, short, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub out: Option<PathBuf>,
}

/// Arguments of `compare`.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// Two or more result folders.
    #[arg(required = true, num_args = 2.., value_name = "DIR", value_hint = ValueHint::DirPath)]
    pub results: Vec<PathBuf>,
    /// Write the comparison as a page too.
    #[arg(long, short, value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub out: Option<PathBuf>,
}

/// The page of a folder under construction: made of the files in it, so that `skclam report` gives the same bytes.
pub fn write_report(staged: &StagedFolder) -> Result<()> {
    let folder = staged.path("")?;
    staged.write("report.html", report_html(&RunResult::read(folder)?))?;
    Ok(())
}

/// Builds the page again.
pub fn report(cli: &Cli, args: &ReportArgs) -> Result<()> {
    let page = report_html(&RunResult::read(&args.result)?);
    let path = args.out.clone().unwrap_or_else(|| args.result.join("report.html"));
    write_whole(&path, &page)?;
    if !cli.quiet {
        println!("{} ({:.1} MB)", path.display(), page.len() as f64 / 1e6);
    }
    Ok(())
}

/// Puts results side by side.
pub fn compare(cli: &Cli, args: &CompareArgs) -> Result<()> {
    let runs = args.results.iter().map(RunResult::read).collect::<Result<Vec<_>, _>>()?;
    // What a run held stands in its rig; a result without one is compared all the same.
    let rig = |folder: &PathBuf| {
        let path = folder.join("rig.toml");
        path.exists().then(|| Rig::read(path)).transpose()
    };
    let rigs = args.results.iter().map(rig).collect::<Result<Vec<_>, _>>()?;
    let comparison = Comparison::of(&runs, &rigs);
    if cli.json {
        println!("{}", serde_json::to_string_pretty(&comparison)?);
    } else {
        show(&comparison);
    }
    if let Some(path) = &args.out {
        write_whole(path, &compare_html(&runs, &comparison))?;
        if !cli.quiet && !cli.json {
            println!("Page: {}", path.display());
        }
    }
    Ok(())
}

/// A file that appears whole or not at all.
fn write_whole(path: &Path, text: &str) -> Result<()> {
    let mut name = path.file_name().with_context(|| format!("{}: name a file", path.display()))?.to_owned();
    name.push(format!(".partial-{}", std::process::id()));
    let partial = path.with_file_name(name);
    let written = std::fs::write(&partial, text).and_then(|()| std::fs::rename(&partial, path));
    if written.is_err() {
        // It may not be there; then nothing is left behind either.
        let _ = std::fs::remove_file(&partial);
    }
    written.with_context(|| path.display().to_string())
}

fn show(comparison: &Comparison) {
    for (at, run) in comparison.runs.iter().enumerate() {
        println!("[{}] {}: {} ({})", at + 1, run.name, run.rig, run.light);
        if let Some(dataset) = &run.dataset {
            println!("    {dataset}");
        }
    }
    for note in comparison.runs.iter().enumerate().filter_map(|(at, run)| run.note(at)) {
        println!("{note}");
    }
    println!();
    let header: Vec<String> = (1..=comparison.runs.len()).map(|at| format!("[{at}]")).collect();
    for group in &comparison.groups {
        let head: Vec<&str> = std::iter::once(group.title.as_str())
            .chain(header.iter().map(String::as_str))
            .chain(std::iter::once("unit"))
            .collect();
        let mut table = screen::table(&head);
        for row in &group.rows {
            let mut cells = vec![row.name.clone()];
            cells.extend(row.cells.iter().map(|cell| match cell {
                None => "-".to_owned(),
                Some(cell) if cell.held => format!("{} held", cell.text),
                Some(cell) => cell.text.clone(),
            }));
            cells.push(row.unit.clone());
            table.add_row(cells);
        }
        println!("{table}\n");
    }
}
