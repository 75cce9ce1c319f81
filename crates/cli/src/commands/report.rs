//! `skclam report` and `skclam compare`.

use crate::args::Cli;
use crate::screen::{self, say};
use anyhow::Result;
use clap::{Args, ValueHint};
use skclam::output::{StagedFile, StagedFolder};
use skclam::rig::Rig;
use skclam_report::{Comparison, RunResult, compare_html, report_html};
use std::path::PathBuf;

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
pub fn write_report(staged: &mut StagedFolder) -> Result<()> {
    let folder = staged.path("")?;
    staged.write_derived("report.html", report_html(&RunResult::read(folder)?))?;
    Ok(())
}

/// Builds the page again.
pub fn report(cli: &Cli, args: &ReportArgs) -> Result<()> {
    let run = RunResult::read(&args.result)?;
    let path = args.out.clone().unwrap_or_else(|| args.result.join("report.html"));
    let staged = StagedFile::new(&path)?;
    let page = report_html(&run);
    staged.write(&page)?;
    staged.publish()?;
    if !cli.quiet {
        say!("{} ({:.1} MB)", path.display(), page.len() as f64 / 1e6);
    }
    Ok(())
}

/// Puts results side by side.
pub fn compare(cli: &Cli, args: &CompareArgs) -> Result<()> {
    let runs = args.results.iter().map(RunResult::read).collect::<Result<Vec<_>, _>>()?;
    // What a run held fixed is in its rig; a result without one is compared all the same.
    let rig = |folder: &PathBuf| {
        let path = folder.join("rig.toml");
        path.exists().then(|| Rig::read(path)).transpose()
    };
    let rigs = args.results.iter().map(rig).collect::<Result<Vec<_>, _>>()?;
    let staged = args.out.as_ref().map(StagedFile::new).transpose()?;
    let comparison = Comparison::of(&runs, &rigs);
    if cli.json {
        screen::json(&comparison)?;
    } else {
        show(&comparison);
    }
    if let (Some(path), Some(staged)) = (&args.out, staged) {
        staged.write(compare_html(&runs, &comparison))?;
        staged.publish()?;
        if !cli.quiet && !cli.json {
            say!("Page: {}", path.display());
        }
    }
    Ok(())
}

fn show(comparison: &Comparison) {
    for (at, run) in comparison.runs.iter().enumerate() {
        say!("[{}] {}: {} ({})", at + 1, run.name, run.rig, run.status);
        if let Some(dataset) = &run.dataset {
            say!("    {dataset}");
        }
    }
    for note in comparison.runs.iter().enumerate().filter_map(|(at, run)| run.note(at)) {
        say!("{note}");
    }
    say!();
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
        say!("{table}\n");
    }
}
