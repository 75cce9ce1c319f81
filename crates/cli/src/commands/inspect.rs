//! `skclam inspect`.

use crate::args::Cli;
use crate::progress::Screen;
use crate::screen::{self, say};
use anyhow::Result;
use clap::{Args, ValueHint};
use comfy_table::Table;
use skclam::calibration::Free;
use skclam::dataset::Dataset;
use skclam::inspection::{ExpectedSigmas, Inspection, InspectionOptions, inspect as judge};
use skclam::recordings::{Recording, Survey, TopicSurvey, survey};
use skclam_files::shown;
use std::path::PathBuf;

/// Arguments of `inspect`.
#[derive(Debug, Args)]
pub struct InspectArgs {
    /// A recording (.bag, .mcap, .db3, a folder of them, a TUM folder), or a data set folder.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// What is to be calibrated, as `--free` of `run`: auto, angles, all, or a list.
    #[arg(long, value_name = "PARAMETERS", default_value = "auto")]
    pub free: String,
}

/// Summarises a recording, or judges a data set.
pub fn inspect(cli: &Cli, args: &InspectArgs) -> Result<()> {
    if args.path.join("postures.csv").is_file() {
        let dataset = Dataset::open(&args.path)?;
        let screen = Screen::new(cli.quiet);
        let mut options = InspectionOptions::default();
        options.expected.expectation.free = Free::parse(&args.free, &dataset.rig)?;
        let inspection = judge(&dataset, &options, &screen)?;
        screen.finish();
        if cli.json {
            screen::json(&inspection)?;
        } else {
            show_dataset(cli, &inspection);
        }
        return Ok(());
    }
    let mut survey = survey(&mut Recording::open(&args.path)?)?;
    if cli.json {
        screen::json(&survey)?;
    } else {
        for topic in &mut survey.topics {
            for text in [&mut topic.topic, &mut topic.type_name, &mut topic.detail] {
                *text = shown(text).into_owned();
            }
        }
        show_recording(cli, &survey);
    }
    Ok(())
}

fn show_recording(cli: &Cli, survey: &Survey) {
    say!("{}", topics(survey));
    for topic in &survey.topics {
        say!("{}", described(topic));
    }
    say!("{} messages in {:.3} s", survey.messages, survey.duration_s);
    let mut warnings = survey.cuts.clone();
    for topic in survey.topics.iter().filter(|topic| topic.read) {
        if let Some(problem) = &topic.first_problem {
            warnings.push(format!("{} messages cannot be read, the first because: {problem}", topic.bad_messages));
        }
        for jump in topic.first_jumps.iter().take(3) {
            warnings.push(format!("{}: the clock jumps by {:+.3} s at {:.3} s", topic.topic, jump.jump_s, jump.at_s));
        }
        if topic.messages > 10 && topic.largest_gap_s > 10.0 / topic.rate_hz.max(1e-9) {
            warnings.push(format!(
                "{}: nothing for {:.3} s at {:.3} s",
                topic.topic, topic.largest_gap_s, topic.largest_gap_at_s
            ));
        }
        if topic.messages > 0 && topic.stamp_minus_log_s.abs() > 1.0 {
            warnings.push(format!(
                "{}: stamps differ by {:+.3} s from the time of recording; do all devices have one clock?",
                topic.topic, topic.stamp_minus_log_s
            ));
        }
    }
    screen::warn(cli.quiet, &warnings);
}

/// The width that every terminal has.
const COLUMNS: usize = 80;

/// A row a topic, at most [`COLUMNS`] wide: long names are broken behind a slash.
fn topics(survey: &Survey) -> Table {
    let rows: Vec<[String; 5]> = survey.topics.iter().map(metrics).collect();
    let header = ["messages", "MB", "Hz", "gap s", "jumps"];
    let numbers: usize = (0..header.len())
        .map(|column| rows.iter().map(|row| row[column].len()).max().unwrap_or(0).max(header[column].len()))
        .sum();
    // Two borders with a blank each, and three blanks between two columns.
    let left = COLUMNS.saturating_sub(4 + 3 * header.len() + numbers).max("topic".len());
    let mut table = screen::table(&["topic", header[0], header[1], header[2], header[3], header[4]]);
    // Characters of double width are broken by the table.
    table.set_width(COLUMNS as u16);
    for (topic, row) in survey.topics.iter().zip(rows) {
        table.add_row([vec![broken(&topic.topic, left)], row.to_vec()].concat());
    }
    table
}

fn metrics(topic: &TopicSurvey) -> [String; 5] {
    // A damaged clock has gaps of years, and rates of nothing or of a billion.
    let short = |value: f64, digits: usize| {
        let plain = format!("{value:.digits$}");
        if plain.len() > 9 { format!("{value:.1e}") } else { plain }
    };
    [
        topic.messages.to_string(),
        short(topic.bytes as f64 * 1e-6, 1),
        short(topic.rate_hz, 1),
        short(topic.largest_gap_s, 3),
        topic.clock_jumps.to_string(),
    ]
}

/// A name in lines of at most so many characters, broken behind slashes where there are any.
fn broken(name: &str, most: usize) -> String {
    let mut lines = vec![String::new()];
    for part in name.split_inclusive('/') {
        for at in chunks(part, most) {
            let long = lines.last().is_some_and(|line| line.chars().count() + at.chars().count() > most);
            match lines.last_mut() {
                Some(line) if !long => line.push_str(&at),
                _ => lines.push(at),
            }
        }
    }
    lines.join("\n")
}

fn chunks(text: &str, most: usize) -> Vec<String> {
    text.chars().collect::<Vec<_>>().chunks(most.max(1)).map(|chunk| chunk.iter().collect()).collect()
}

/// Type and content of a topic; on two lines where one is too long.
fn described(topic: &TopicSurvey) -> String {
    let TopicSurvey { topic, type_name, detail, .. } = topic;
    let whole = format!("{topic}: {type_name}; {detail}");
    match (detail.is_empty(), whole.chars().count() <= COLUMNS) {
        (true, _) => format!("{topic}: {type_name}"),
        (false, true) => whole,
        (false, false) => format!("{topic}: {type_name}\n    {detail}"),
    }
}

fn show_dataset(cli: &Cli, inspection: &Inspection) {
    if !inspection.joints.is_empty() {
        let mut table = screen::table(&["joint", "from", "to", "limits", "unit", "distinct values"]);
        for joint in &inspection.joints {
            table.add_row([
                joint.joint.clone(),
                screen::fixed(joint.min, 1),
                screen::fixed(joint.max, 1),
                joint.limits.map_or_else(String::new, |[lower, upper]| {
                    format!("{} to {}", screen::fixed(lower, 0), screen::fixed(upper, 0))
                }),
                joint.unit.to_owned(),
                joint.distinct.to_string(),
            ]);
        }
        say!("{table}\n");
    }
    let neighbors =
        |position: usize| inspection.pairs.iter().filter(|pair| pair.a == position || pair.b == position).count();
    let mut table =
        screen::table(&["posture", "sharp", "grey", "dark %", "bright %", "depth m", "depth %", "neighbors"]);
    for (position, image) in inspection.images.iter().enumerate() {
        let optional = |value: Option<f64>, scale: f64| value.map_or_else(String::new, |v| format!("{:.2}", scale * v));
        // Depths of a few counts, where the unit is wrong, are no zeros.
        let depth = image.median_depth_m.map_or_else(String::new, |depth| match depth {
            0.01.. => screen::fixed(depth, 2),
            small => format!("{small:.1e}"),
        });
        table.add_row([
            image.index.to_string(),
            format!("{:.3}", image.sharpness),
            format!("{:.0}", image.exposure.mean),
            format!("{:.1}", 100.0 * image.exposure.dark),
            format!("{:.1}", 100.0 * image.exposure.bright),
            depth,
            optional(image.depth_fraction, 100.0),
            neighbors(position).to_string(),
        ]);
    }
    say!("{table}");
    say!(
        "{} postures, {} pairs with predicted overlap, {} connected group(s)",
        inspection.postures,
        inspection.pairs.len(),
        inspection.groups.len()
    );
    if let Some(board) = &inspection.board {
        say!("Board: {} corners in {} postures", board.corners, board.postures);
    }
    if let Some(expected) = &inspection.expected {
        show_expected(expected);
    }
    screen::warn(cli.quiet, &inspection.warnings);
}

fn show_expected(expected: &ExpectedSigmas) {
    say!();
    let mut table = screen::table(&["parameter", "expected sigma", "unit"]);
    for parameter in &expected.parameters {
        table.add_row([
            parameter.name.clone(),
            parameter.sigma.map_or("-".to_owned(), |sigma| format!("{sigma:.4}")),
            parameter.unit.to_owned(),
        ]);
    }
    say!("{table}");
    if expected.parameters.iter().any(|parameter| parameter.sigma.is_none()) {
        say!("-: hardly determined by these postures; it keeps its tolerance");
    }
    say!(
        "camera over the postures: expected sigma {:.3} mm and {:.4} deg in the mean, {:.3} mm and {:.4} deg at most",
        expected.camera_sigma_mm.mean,
        expected.camera_sigma_deg.mean,
        expected.camera_sigma_mm.max,
        expected.camera_sigma_deg.max
    );
    let depth = expected.depth_sigma_per_m2.map_or(String::new(), |s| format!(" and {s} z^2 m of depth"));
    let observations = match (expected.observations, expected.corners) {
        (observations, 0) => format!("{observations} observations"),
        (0, corners) => format!("{corners} corners of the board"),
        (observations, corners) => format!("{observations} observations and {corners} corners of the board"),
    };
    say!("predicted for {observations} with {} px{depth} of noise", expected.pixel_sigma);
    say!(
        "{} of {} combinations of parameters can be determined to half of their tolerance or better",
        expected.identifiable,
        expected.free
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam::recordings::RecordingFormat;

    fn topic(name: &str, messages: u64, gap_s: f64) -> TopicSurvey {
        TopicSurvey {
            topic: name.to_owned(),
            type_name: "sensor_msgs/msg/CompressedImage".to_owned(),
            read: true,
            messages,
            bytes: 1_000_000 * messages,
            rate_hz: 30.0,
            largest_gap_s: gap_s,
            largest_gap_at_s: 0.0,
            clock_jumps: messages / 2,
            first_jumps: vec![],
            stamp_minus_log_s: 0.0,
            detail: "rgb8 1920 x 1080".to_owned(),
            bad_messages: 0,
            first_problem: None,
        }
    }

    fn survey_of(topics: Vec<TopicSurvey>) -> Survey {
        Survey { format: RecordingFormat::Mcap, messages: 0, duration_s: 0.0, topics, cuts: vec![] }
    }

    fn widest(table: &Table) -> usize {
        table.to_string().lines().map(|line| line.chars().count()).max().unwrap()
    }

    #[test]
    fn tables_fit_eighty_columns_and_names_stay_whole_where_they_can() {
        let long = "/device_0/sensor_1/Color_0/option/Auto_Exposure_Priority/description/very/long";
        let usual = survey_of(vec![topic("/camera/color/image_raw/compressed", 900, 0.033), topic("/tf", 3, 2.0)]);
        assert!(topics(&usual).to_string().contains("/camera/color/image_raw/compressed"));
        let worst = survey_of(vec![
            topic(long, u64::MAX / 1_000_000, 1e300),
            topic(&"x".repeat(300), 1_000_000_000, f64::MAX),
            topic("/\u{e9}\u{e9}/\u{e9}", 0, 0.0),
            topic("", 0, 0.0),
        ]);
        for survey in [usual, worst, survey_of(vec![])] {
            assert!(widest(&topics(&survey)) <= COLUMNS, "{}", topics(&survey));
        }
        assert_eq!(broken(long, 30).lines().next().unwrap(), "/device_0/sensor_1/Color_0/");
        assert_eq!(broken(long, 30).replace('\n', ""), long);
    }

    #[test]
    fn types_are_listed_beside_what_is_known_of_a_topic() {
        let described = described(&topic("/camera/color/image_raw/compressed", 1, 0.0));
        assert_eq!(
            described,
            "/camera/color/image_raw/compressed: sensor_msgs/msg/CompressedImage\n    rgb8 1920 x 1080"
        );
    }
}
