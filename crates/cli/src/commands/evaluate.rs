//! `skclam evaluate`.

use crate::args::{Cli, EvaluateArgs};
use crate::screen;
use anyhow::Result;
use skclam::dataset::Dataset;
use skclam::evaluation::{Evaluation, PoseErrors, evaluate as compare};
use skclam::rig::Rig;

/// Compares a rig with the true one.
pub fn evaluate(cli: &Cli, args: &EvaluateArgs) -> Result<()> {
    let path = if args.result.is_dir() { args.result.join("rig.toml") } else { args.result.clone() };
    let rig = Rig::read(path)?;
    let truth = Rig::read(&args.truth)?;
    let dataset = Dataset::open_with_rig(&args.dataset, truth.clone())?;
    let postures: Vec<_> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let evaluation = compare(&rig, &truth, &postures)?;
    if cli.json {
        println!("{}", serde_json::to_string_pretty(&evaluation)?);
    } else {
        show(&evaluation);
    }
    Ok(())
}

/// The tables of an evaluation.
pub fn show(evaluation: &Evaluation) {
    let mut table = screen::table(&["parameter", "true", "estimated", "error", "unit"]);
    for parameter in &evaluation.parameters {
        table.add_row([
            parameter.name.clone(),
            format!("{:.4}", parameter.truth),
            format!("{:.4}", parameter.estimated),
            format!("{:+.4}", parameter.error),
            parameter.unit.clone(),
        ]);
    }
    println!("{table}\n");
    let mut table = screen::table(&["pose errors", "mean", "sd", "max", "unit"]);
    let rows: [(&str, &PoseErrors); 4] = [
        ("flange", &evaluation.flange),
        ("flange, after the base's gauge", &evaluation.flange_after_base_gauge),
        ("camera", &evaluation.camera),
        ("camera, after the base's gauge", &evaluation.camera_after_base_gauge),
    ];
    for (name, errors) in rows {
        for (unit, values) in [("mm", &errors.position_mm), ("deg", &errors.orientation_deg)] {
            let number = |value: f64| format!("{value:.4}");
            table.add_row([
                name.to_owned(),
                number(values.mean),
                number(values.sd),
                number(values.max),
                unit.to_owned(),
            ]);
        }
    }
    println!("{table}");
    println!(
        "{} postures. The base's gauge: a turn about and a shift along axis 1, which no image can tell.",
        evaluation.postures
    );
}
