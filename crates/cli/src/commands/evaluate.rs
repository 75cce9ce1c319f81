//! `skclam evaluate`.

use crate::args::{Cli, EvaluateArgs};
use crate::commands::render::read as read_map;
use crate::commands::rig_of;
use crate::screen::{self, say};
use anyhow::{Result, bail};
use skclam::dataset::Dataset;
use skclam::evaluation::{Evaluation, PoseErrors, evaluate as compare};
use skclam::mapping::SurfaceScore;
use skclam::rig::Rig;
use skclam::surface_evaluation::evaluate_surface;

/// Compares a rig with the true one.
pub fn evaluate(cli: &Cli, args: &EvaluateArgs) -> Result<()> {
    let rig = rig_of(&args.result)?;
    let truth = Rig::read(&args.truth)?;
    let dataset = Dataset::open_with_rig(&args.dataset, truth.clone())?;
    let postures: Vec<_> = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let evaluation = compare(&rig, &truth, &postures)?;
    let surface = match &args.surface {
        None => None,
        Some(reference) => {
            let map = ["mesh.ply", "map.ply"].map(|name| args.result.join(name)).into_iter().find(|path| path.exists());
            let Some(map) = map else {
                bail!("{}: neither mesh.ply nor map.ply is there to compare", args.result.display())
            };
            Some(evaluate_surface(read_map(&map)?, &read_map(reference)?, &rig, &dataset)?)
        }
    };
    if cli.json {
        let mut value = serde_json::to_value(&evaluation)?;
        if let (Some(score), Some(object)) = (&surface, value.as_object_mut()) {
            object.insert("surface".to_owned(), serde_json::to_value(score)?);
        }
        screen::json(&value)?;
    } else {
        show(&evaluation);
        if let Some(score) = &surface {
            show_surface(score);
        }
    }
    Ok(())
}

fn show_surface(score: &SurfaceScore) {
    let mut table = screen::table(&["surface", "median mm", "90 % mm", "5 mm", "10 mm", "20 mm"]);
    for (name, distances) in [("accuracy", &score.accuracy), ("completeness", &score.completeness)] {
        let mut cells = vec![name.to_owned()];
        cells.extend([distances.median_m, distances.p90_m].map(|metres| format!("{:.2}", metres * 1e3)));
        cells.extend(distances.within.map(|fraction| format!("{fraction:.3}")));
        table.add_row(cells);
    }
    let mut cells = vec!["F-score".to_owned(), String::new(), String::new()];
    cells.extend(score.f_score.map(|fraction| format!("{fraction:.3}")));
    table.add_row(cells);
    say!("{table}\nOver the observed part of the true surface ({:.0} %).", score.observed * 100.0);
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
    say!("{table}\n");
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
    say!("{table}");
    say!(
        "{} postures. The base's gauge: a rotation about and a shift along axis 1, not identifiable from images.",
        evaluation.postures
    );
}
