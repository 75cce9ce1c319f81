//! The command line of SKCLAM.

mod args;
mod commands;
mod progress;
mod screen;

use args::{Cli, Command};
use clap::{CommandFactory, Parser};
use std::process::ExitCode;

fn main() -> ExitCode {
    progress::watch_for_interrupt();
    let cli = Cli::parse();
    let done = dispatch(&cli);
    // What fails because the program is about to end is no error of its own.
    progress::wait_if_interrupted();
    match done.and_then(|()| screen::end()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            screen::error(error.chain());
            ExitCode::FAILURE
        }
    }
}

fn dispatch(cli: &Cli) -> anyhow::Result<()> {
    if let Some(threads) = cli.threads {
        rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads)).build_global()?;
    }
    match &cli.command {
        Command::Run(args) => commands::run::run(cli, args, commands::run::Extent::Everything),
        Command::Calibrate(args) => commands::run::run(cli, args, commands::run::Extent::CalibrationOnly),
        Command::Map(args) => commands::map::map(cli, args),
        Command::Evaluate(args) => commands::evaluate::evaluate(cli, args),
        Command::Validate(args) => commands::validate::validate(cli, args),
        Command::Simulate(args) => commands::simulate::simulate(cli, args),
        Command::Render(args) => commands::render::render(cli, args),
        Command::Reproduce(args) => commands::reproduce::reproduce(cli, args),
        Command::Compensate(args) => commands::compensate::compensate(cli, args),
        Command::Export(args) => commands::export::export(cli, args),
        Command::Import(args) => commands::import::import(cli, args),
        Command::Inspect(args) => commands::inspect::inspect(cli, args),
        Command::Report(args) => commands::report::report(cli, args),
        Command::Compare(args) => commands::report::compare(cli, args),
        Command::Completions { shell } => {
            // Its own way of writing panics where it cannot.
            let mut script = Vec::new();
            clap_complete::generate(*shell, &mut Cli::command(), "skclam", &mut script);
            screen::say_on!("{}", String::from_utf8_lossy(&script));
            Ok(())
        }
    }
}
