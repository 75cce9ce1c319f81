//! The paper's experiments repeated: its Tables 1, 2 and 3 and the metrics of Fig. 8, the paper's values beside ours.

use crate::evaluation::{Evaluation, Statistics};
use crate::summary::{StageSeconds, Summary};
use serde::{Deserialize, Serialize};
use skclam_simulation::LaserExperiment;
use std::fmt::Write as _;

/// What the paper prints; facts, with the table that they are from.
pub mod paper {
    /// Table 1: parameter, calibrated value without and with noise, degrees.
    pub const TABLE_1: [(&str, f64, f64); 10] = [
        ("alpha_2", 91.00, 91.00),
        ("theta_offset_2", 90.96, 91.04),
        ("alpha_3", 180.98, 181.00),
        ("theta_offset_3", -89.06, -88.98),
        ("alpha_4", -89.00, -89.02),
        ("theta_offset_4", 1.00, 1.02),
        ("alpha_5", 91.00, 91.03),
        ("theta_offset_5", 0.98, 0.98),
        ("alpha_6", -89.03, -89.06),
        ("theta_offset_6", -88.86, -89.00),
    ];
    /// Table 1: CPU time without and with noise, seconds.
    pub const CPU_S: [f64; 2] = [164.7, 185.1];
    /// Table 2: position error of the end effector, nominal, millimetres.
    pub const NOMINAL_ERROR_MM: f64 = 6.94;
    /// Table 2: mean and standard deviation after calibration, without and with noise, millimetres.
    pub const ERROR_MM: [(f64, f64); 2] = [(0.25, 0.05), (0.27, 0.05)];
    /// Table 3: error function before and after, without and with noise, px.
    pub const ERROR_FUNCTION: [(f64, f64); 2] = [(55.35, 0.68), (53.12, 0.80)];
}

/// One calibration of the experiment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Trial {
    /// "paper" or "default".
    pub preset: String,
    /// Whether the images carry the paper's noise.
    pub noise: bool,
    /// The run's own metrics.
    pub summary: Summary,
    /// Errors against the truth.
    pub evaluation: Evaluation,
    /// Errors of the nominal rig.
    pub nominal: Evaluation,
    /// Times from features to calibration: what the paper's CPU time covers.
    pub stages: Vec<StageSeconds>,
    /// The laser experiment with this calibration.
    pub laser: LaserExperiment,
}

/// All trials and what was simulated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reproduction {
    /// Version of the program.
    pub version: String,
    /// Width and height of the colour images.
    pub image: [u32; 2],
    /// Postures.
    pub postures: usize,
    /// Seed.
    pub seed: u64,
    /// Wall-clock seconds that rendering one data set took.
    pub simulation_s: Vec<f64>,
    /// The trials: preset paper without and with noise, preset default without and with noise.
    pub trials: Vec<Trial>,
}

impl Trial {
    fn label(&self) -> String {
        format!("{}{}", self.preset, if self.noise { ", noise" } else { "" })
    }

    fn cpu_s(&self) -> f64 {
        self.stages.iter().map(|stage| stage.cpu_s).sum()
    }

    fn wall_s(&self) -> f64 {
        self.stages.iter().map(|stage| stage.wall_s).sum()
    }

    /// The ten angles' largest error, degrees.
    pub fn largest_angle_error_deg(&self) -> f64 {
        let of_table = |name: &str| paper::TABLE_1.iter().any(|(parameter, ..)| *parameter == name);
        let errors = self.evaluation.parameters.iter().filter(|parameter| of_table(&parameter.name));
        errors.map(|parameter| parameter.error.abs()).fold(0.0, f64::max)
    }
}

fn with_sd(statistics: &Statistics) -> String {
    format!("{:.4} ± {:.4}", statistics.mean, statistics.sd)
}

fn row(text: &mut String, cells: &[String]) {
    // Writing to a String cannot fail.
    let _ = writeln!(text, "| {} |", cells.join(" | "));
}

fn header(text: &mut String, first: &[&str], trials: &[Trial]) {
    let names: Vec<String> =
        first.iter().map(|name| (*name).to_owned()).chain(trials.iter().map(Trial::label)).collect();
    row(text, &names);
    row(text, &names.iter().map(|_| "---".to_owned()).collect::<Vec<_>>());
}

impl Reproduction {
    /// The report as Markdown.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        let [width, height] = self.image;
        let _ = writeln!(
            text,
            "# The paper's virtual experiment, repeated\n\n\
             {} postures, images of {width} x {height}, seed {}, skclam {}. \"paper\": the method to the letter; \"default\": all good matches of \
             overlapping images and least squares. True arm: nominal + 1 deg on the ten angles.\n",
            self.postures, self.seed, self.version
        );
        self.table_1(&mut text);
        self.table_2_and_3(&mut text);
        self.figure_8(&mut text);
        text
    }

    fn table_1(&self, text: &mut String) {
        let _ = writeln!(text, "## Table 1: kinematic parameters, deg\n");
        header(text, &["parameter", "nominal", "true", "the paper", "the paper, noise"], &self.trials);
        for (name, clean, noisy) in paper::TABLE_1 {
            let of = |evaluation: &Evaluation| {
                evaluation.parameters.iter().find(|parameter| parameter.name == name).cloned()
            };
            let first = self.trials.first().and_then(|trial| Some((of(&trial.nominal)?, of(&trial.evaluation)?)));
            let Some((nominal, calibrated)) = first else { continue };
            let mut cells = vec![
                name.to_owned(),
                format!("{:.2}", nominal.estimated),
                format!("{:.2}", calibrated.truth),
                format!("{clean:.2}"),
                format!("{noisy:.2}"),
            ];
            cells.extend(
                self.trials
                    .iter()
                    .map(|trial| of(&trial.evaluation).map_or("-".to_owned(), |p| format!("{:.4}", p.estimated))),
            );
            row(text, &cells);
        }
        let largest = |column: fn(&(&str, f64, f64)) -> f64| {
            let error = |entry: &(&str, f64, f64)| {
                let truth = self
                    .trials
                    .first()
                    .and_then(|trial| trial.evaluation.parameters.iter().find(|p| p.name == entry.0));
                truth.map_or(0.0, |parameter| (column(entry) - parameter.truth).abs())
            };
            paper::TABLE_1.iter().map(error).fold(0.0, f64::max)
        };
        let mut cells = vec!["largest error".to_owned(), String::new(), String::new()];
        cells.extend([format!("{:.2}", largest(|entry| entry.1)), format!("{:.2}", largest(|entry| entry.2))]);
        cells.extend(self.trials.iter().map(|trial| format!("{:.4}", trial.largest_angle_error_deg())));
        row(text, &cells);
        let mut cells = vec!["CPU time, s".to_owned(), String::new(), String::new()];
        cells.extend(paper::CPU_S.map(|seconds| format!("{seconds:.1}")));
        cells.extend(self.trials.iter().map(|trial| format!("{:.1}", trial.cpu_s())));
        row(text, &cells);
        let mut cells =
            vec!["wall-clock time, s".to_owned(), String::new(), String::new(), String::new(), String::new()];
        cells.extend(self.trials.iter().map(|trial| format!("{:.1}", trial.wall_s())));
        row(text, &cells);
    }

    fn table_2_and_3(&self, text: &mut String) {
        let _ = writeln!(text, "\n## Table 2: position error of the flange, mm (mean ± sd over the postures)\n");
        header(text, &["", "the paper", "the paper, noise"], &self.trials);
        let mut cells = vec![
            "nominal".to_owned(),
            format!("{:.2}", paper::NOMINAL_ERROR_MM),
            format!("{:.2}", paper::NOMINAL_ERROR_MM),
        ];
        cells.extend(self.trials.iter().map(|trial| format!("{:.2}", trial.nominal.flange.position_mm.mean)));
        row(text, &cells);
        let mut cells = vec!["calibrated".to_owned()];
        cells.extend(paper::ERROR_MM.map(|(mean, sd)| format!("{mean:.2} ± {sd:.2}")));
        cells.extend(self.trials.iter().map(|trial| with_sd(&trial.evaluation.flange.position_mm)));
        row(text, &cells);

        let _ = writeln!(text, "\n## Table 3: error function, Eq. (7), px, and honest distances\n");
        header(text, &["", "the paper", "the paper, noise"], &self.trials);
        let mut line = |name: &str, paper: [String; 2], value: &dyn Fn(&Trial) -> f64| {
            let mut cells = vec![name.to_owned()];
            cells.extend(paper);
            cells.extend(self.trials.iter().map(|trial| format!("{:.3}", value(trial))));
            row(text, &cells);
        };
        let none = || [String::new(), String::new()];
        line("F before", paper::ERROR_FUNCTION.map(|(before, _)| format!("{before:.2}")), &|t| {
            t.summary.calibration.epipolar_before.error_function
        });
        line("F after", paper::ERROR_FUNCTION.map(|(_, after)| format!("{after:.2}")), &|t| {
            t.summary.calibration.epipolar_after.error_function
        });
        line("RMS distance before", none(), &|t| t.summary.calibration.epipolar_before.rms_px);
        line("RMS distance after", none(), &|t| t.summary.calibration.epipolar_after.rms_px);
        line("median distance after", none(), &|t| t.summary.calibration.epipolar_after.median_px);
        line("matches", none(), &|t| t.summary.counts.matches as f64);
    }

    fn figure_8(&self, text: &mut String) {
        let _ = writeln!(
            text,
            "\n## Fig. 8: laser experiment, sd of the end effector's position in mm over the eight solutions of a pose\n\n\
             The true arm is sent to each pose by the inverse kinematics of the nominal and of the calibrated chain; the sensor resolves 10 um.\n"
        );
        header(text, &["pose, axis", "nominal"], &self.trials);
        let Some(first) = self.trials.first() else { return };
        for pose in 0..first.laser.poses.len() {
            for (axis, name) in ["X", "Y", "Z"].into_iter().enumerate() {
                let mut cells =
                    vec![format!("{} {name}", pose + 1), format!("{:.3}", first.laser.poses[pose].nominal_sd_mm[axis])];
                cells.extend(
                    self.trials.iter().map(|trial| format!("{:.3}", trial.laser.poses[pose].calibrated_sd_mm[axis])),
                );
                row(text, &cells);
            }
        }
        let mut cells = vec!["mean".to_owned(), format!("{:.3}", first.laser.mean_sd_mm()[0])];
        cells.extend(self.trials.iter().map(|trial| format!("{:.3}", trial.laser.mean_sd_mm()[1])));
        row(text, &cells);
    }
}
