//! Rigs, robot descriptions, tables, settings, maps, images and whole imports with damaged bytes, numbers and
//! structure: an answer or an error, no panic, in bounded time and memory. How many are tried, and where they begin:
//! see the crate `skclam-damage`, and `just fuzz`.

mod findings;
mod importing;
mod reading;
mod seeds;

use rand::RngExt;
use reading as read;
use skclam_damage::{Seed, Trial, damaged_bytes, damaged_text};
use std::path::Path;

/// A reader of texts may allocate so many bytes for each byte of its input (a short element of XML is a node of a
/// tree), and so many once, into which the seeds of the tests beside it fit.
const ALLOCATED_A_BYTE: usize = 300;
const ALLOCATED_ONCE: usize = 16 << 20;
/// The largest resident set of the test process, MiB.
const MAX_RESIDENT_MIB: f64 = 400.0;

fn lay_down(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).unwrap();
}

/// Texts: damaged by what they are made of, and a few by their bytes alone.
fn on_trial(reader: &str, seeds: &[Seed], pieces: &[&str], read: fn(&Path) -> bool) {
    let all: Vec<&[u8]> = seeds.iter().map(|seed| seed.bytes.as_slice()).collect();
    Trial {
        reader,
        seeds,
        damage: &|seed, random| damaged_text(all[seed], &all, pieces, random),
        lay_down: &lay_down,
        read: &read,
        max_allocated: &|length| ALLOCATED_ONCE + ALLOCATED_A_BYTE * length,
        max_resident_mib: MAX_RESIDENT_MIB,
    }
    .run();
}

#[test]
fn damaged_rigs_are_answered() {
    on_trial("rig.toml", &seeds::rigs(), &seeds::RIG_PIECES, read::rig);
}

#[test]
fn damaged_robot_descriptions_are_answered() {
    on_trial("URDF", &seeds::robots(), &seeds::URDF_PIECES, read::urdf);
}

#[test]
fn damaged_tables_of_postures_are_answered() {
    on_trial("postures.csv", &seeds::postures(), &seeds::TABLE_PIECES, read::postures);
}

#[test]
fn damaged_tables_of_targets_are_answered() {
    on_trial("targets.csv", &seeds::targets(), &seeds::TABLE_PIECES, read::targets);
}

#[test]
fn damaged_joint_logs_are_answered() {
    on_trial("joint log", &seeds::joint_logs(), &seeds::TABLE_PIECES, read::joint_log);
}

#[test]
fn damaged_trajectories_are_answered() {
    on_trial("trajectory.txt", &seeds::trajectories(), &["#", "1 2 3", "\t"], read::trajectory);
}

#[test]
fn damaged_settings_are_answered() {
    on_trial(
        "config.json",
        &seeds::settings(),
        &["null", "true", "[]", "{}", "\"configuration\":", "-"],
        read::settings,
    );
}

#[test]
fn damaged_maps_are_answered() {
    let seeds = seeds::maps();
    let all: Vec<&[u8]> = seeds.iter().map(|seed| seed.bytes.as_slice()).collect();
    Trial {
        reader: "PLY and STL",
        seeds: &seeds,
        damage: &|seed, random| {
            if seeds[seed].name.contains("binary") && random.random() {
                damaged_bytes(all[seed], random)
            } else {
                damaged_text(all[seed], &all, &seeds::MAP_PIECES, random)
            }
        },
        lay_down: &lay_down,
        read: &read::map,
        max_allocated: &|length| ALLOCATED_ONCE + ALLOCATED_A_BYTE * length,
        max_resident_mib: MAX_RESIDENT_MIB,
    }
    .run();
}

#[test]
fn damaged_images_are_answered() {
    let seeds = seeds::images();
    Trial {
        reader: "images",
        seeds: &seeds,
        damage: &|seed, random| damaged_bytes(&seeds[seed].bytes, random),
        lay_down: &lay_down,
        read: &read::image,
        // The camera's size bounds the pixels; a decoder has its own tables.
        max_allocated: &|_| 64 << 20,
        max_resident_mib: MAX_RESIDENT_MIB,
    }
    .run();
}

#[test]
fn damaged_recordings_are_imported_or_refused() {
    let seeds = importing::recordings();
    Trial {
        reader: "import",
        seeds: &seeds,
        damage: &|seed, random| damaged_bytes(&seeds[seed].bytes, random),
        lay_down: &lay_down,
        read: &importing::import,
        max_allocated: &|_| 300 << 20,
        max_resident_mib: MAX_RESIDENT_MIB,
    }
    .run();
}
