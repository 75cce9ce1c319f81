//! Stamps that say nothing, or belong to another clock.

use crate::world::*;
use skclam::import::{ClockChoice, ImportOptions};

type Wanted = fn(&Message) -> bool;
const SOME: [(&str, Wanted); 4] = [
    ("all", |_| true),
    ("joints", |message| message.kind == JOINTS),
    ("images", |message| message.kind == IMAGE || message.kind == INFO),
    ("colour", |message| message.topic.starts_with("/camera/color")),
];

fn clock(clock: ClockChoice) -> ImportOptions {
    ImportOptions { clock, ..builtin() }
}

#[test]
fn stamps_that_do_not_change_give_way_to_the_times_of_recording() {
    for (name, some) in SOME {
        for stamp in [0, 1, 5_000_000_000, ns(3.0)] {
            for first_is_other in [false, true] {
                let mut messages = good(50.0);
                for (index, message) in messages.iter_mut().filter(|message| some(message)).enumerate() {
                    message.stamp = if first_is_other && index == 2 { ns(9.0) } else { stamp };
                }
                right(&format!("{name} at {stamp}"), &messages, &builtin(), &["times of recording"]);
            }
        }
    }
    // The arm's stamps are frozen and the recorder's too: nothing is left.
    let mut messages = good(50.0);
    messages.iter_mut().for_each(|message| (message.stamp, message.log) = (0, ns(0.0)));
    refused("no times at all", &messages, &builtin(), &["nothing shows which joints belong to which image"]);
}

#[test]
fn clocks_that_differ_are_named_by_their_gap() {
    for (name, some) in &SOME[1..3] {
        for offset_s in [-700.0, -14.0, -3.0, -1.5, 1.5, 5.0, 60.0, 1e6] {
            let mut messages = good(50.0);
            for message in messages.iter_mut().filter(|message| some(message)) {
                message.stamp += (offset_s * 1e9) as i64;
            }
            let gap = format!("{:.1}", f64::abs(offset_s));
            let name = format!("{name} by {offset_s} s");
            let error = refused(&name, &messages, &builtin(), &["--clock log", "different clocks"]);
            assert!(error.contains(&gap), "{name}: {error}");
            // The advice is followed.
            right(&name, &messages, &clock(ClockChoice::Log), &[]);
        }
    }
}

#[test]
fn all_on_another_clock_is_right() {
    for offset_s in [-900.0, -20.0, 35.0, 1e8] {
        let mut messages = good(50.0);
        messages.iter_mut().for_each(|message| message.log += (offset_s * 1e9) as i64);
        right(&format!("recorder off by {offset_s}"), &messages, &builtin(), &[]);
    }
}

#[test]
fn a_few_stamps_of_zero_are_put_right() {
    for (name, some) in SOME {
        for (first, count) in [(0, 1), (0, 3), (20, 4)] {
            let mut messages = good(50.0);
            for message in messages.iter_mut().filter(|message| some(message)).skip(first).take(count) {
                message.stamp = 0;
            }
            let (summary, dataset) = import_with(&messages, &builtin()).unwrap();
            assert_eq!(dataset.len(), INTERVALS, "{name}: {:?}", summary.warnings);
            assert!(error_of(&dataset) < 1e-3, "{name}");
        }
    }
}

#[test]
fn recordings_that_were_not_made_together_are_refused() {
    for gap_s in [3.0, 100.0, 1e5] {
        let mut messages = good(50.0);
        for message in messages.iter_mut().filter(|message| message.kind == JOINTS) {
            message.stamp += ((14.0 + gap_s) * 1e9) as i64;
            message.log += ((14.0 + gap_s) * 1e9) as i64;
        }
        refused(&format!("{gap_s}"), &messages, &builtin(), &["no time in common"]);
        refused(&format!("{gap_s}"), &messages, &clock(ClockChoice::Log), &["not recorded together"]);
    }
}
