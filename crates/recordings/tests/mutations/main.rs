//! Recordings with flipped, cut, repeated and inflated bytes: whatever comes, an answer or an error, in bounded time
//! and memory. How many are tried, and where they begin: see the crate `skclam-damage`, and `just fuzz`.

mod reading;
mod seeds;
mod tum;

use reading::read_all;
use skclam_damage::{ChaCha8Rng, Seed, Trial, damaged_bytes, damaged_text};
use std::path::Path;

/// An input may make so much be allocated, bytes: a message and what it decompresses to, twice.
const MAX_ALLOCATED: usize = 300 << 20;
/// The same with SQLite, which the allocator does not count, and the harness, MiB resident.
const MAX_RESIDENT_MIB: f64 = 400.0;

fn on_trial(reader: &str, seeds: &[Seed], damage: &dyn Fn(usize, &mut ChaCha8Rng) -> Vec<u8>) {
    Trial {
        reader,
        seeds,
        damage,
        lay_down: &lay_down,
        read: &|path| read_all(path).is_ok(),
        max_allocated: &|_| MAX_ALLOCATED,
        max_resident_mib: MAX_RESIDENT_MIB,
    }
    .run();
}

/// Puts a (damaged) seed where it can be opened.
fn lay_down(path: &Path, bytes: &[u8]) {
    if path.extension().is_some_and(|ending| ending == "tum") {
        std::fs::create_dir_all(path).unwrap();
        tum::write(path, bytes);
    } else {
        std::fs::write(path, bytes).unwrap();
    }
}

#[test]
fn damaged_bags_are_answered() {
    let seeds = seeds::bags();
    let messages = seeds::messages(false);
    on_trial("ROS 1 bag", &seeds, &|seed, random| seeds::damaged_bag(&seeds, seed, &messages, random));
}

#[test]
fn damaged_mcap_files_are_answered() {
    let seeds = seeds::mcap_files();
    let messages = seeds::messages(true);
    on_trial("MCAP", &seeds, &|seed, random| seeds::damaged_mcap(&seeds, seed, &messages, random));
}

#[test]
fn damaged_databases_are_answered() {
    let seeds = seeds::databases();
    on_trial("db3", &seeds, &|seed, random| damaged_bytes(&seeds[seed].bytes, random));
}

#[test]
fn damaged_tum_folders_are_answered() {
    let seeds = [Seed::new("folder.tum", tum::folder())];
    on_trial("TUM folder", &seeds, &|seed, random| {
        damaged_text(&seeds[seed].bytes, &[], &["#", "rgb.png", " "], random)
    });
}

#[test]
fn the_seeds_are_read_whole() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = [seeds::bags(), seeds::mcap_files(), seeds::databases()].concat();
    for Seed { name, bytes } in &recordings {
        let path = folder.path().join(name);
        lay_down(&path, bytes);
        assert_eq!(read_all(&path), Ok(seeds::messages(true).len()), "{name}");
    }
    let path = folder.path().join("folder.tum");
    lay_down(&path, &tum::folder());
    // Two images of each kind and two poses.
    assert_eq!(read_all(&path), Ok(6));
}

/// Small files that claim to be large.
#[test]
fn lengths_that_lie_cost_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let message = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        read_all(&path).unwrap_err()
    };
    // A chunk that decompresses to more than it says, and one that says more than there is.
    let honest = seeds::mcap(Some("zstd"), &seeds::messages(true), |records| records);
    let mut huge = honest.clone();
    let chunk = 8 + 9 + 8 + 9;
    huge[chunk + 16..chunk + 24].copy_from_slice(&(1u64 << 50).to_le_bytes());
    assert!(message("huge.mcap", &huge).contains("far more than recordings hold"), "{}", message("huge.mcap", &huge));
    // One byte more is unpacked to see that it is not there.
    huge[chunk + 16..chunk + 24].copy_from_slice(&(1u64 << 20).to_le_bytes());
    assert!(message("huge.mcap", &huge).contains("in the middle of a record"), "{}", message("huge.mcap", &huge));
    let mut long = honest.clone();
    long[8 + 1..8 + 9].copy_from_slice(&u64::MAX.to_le_bytes());
    // What looks like the end of a file that was cut off is read up to there, and said.
    let mut cut = honest;
    cut.truncate(cut.len() / 2);
    for (name, bytes) in [("long.mcap", &long), ("cut.mcap", &cut)] {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        assert!(read_all(&path).unwrap() < seeds::messages(true).len(), "{name}");
        let mut recording = skclam_recordings::Recording::open(&path).unwrap();
        recording.scan(false, &mut |_, _| skclam_recordings::Wanted::Whole, &mut |_, _| Ok(())).unwrap();
        assert!(matches!(recording.cuts(), [cut] if cut.contains("was not closed")), "{:?}", recording.cuts());
    }
    let mut bag = seeds::bag("none", &seeds::messages(false), |chunk| chunk);
    let at = b"#ROSBAG V2.0\n".len();
    bag[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(message("lie.bag", &bag).contains("4294967295 bytes; at most"));
    assert!(message("text.bag", b"hello").contains("no recording"));
}
