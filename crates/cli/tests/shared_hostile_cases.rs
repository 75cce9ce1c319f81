//! Damaged recordings and images that are too odd to be made in a test; they lie in `../shared/cases` beside the
//! repository. Without them the tests say so and pass.

#![cfg(target_os = "linux")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, Instant};
use support::{fail, succeed, text, utf8};

fn case(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/cases/hostile").join(name);
    if !path.exists() {
        eprintln!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

/// Runs the program with so much address space, KiB.
fn within(kib: u64, arguments: &[&str]) -> Output {
    Command::new("sh")
        .args(["-c", "ulimit -v \"$1\"; shift; exec \"$@\"", "sh", &kib.to_string()])
        .arg(env!("CARGO_BIN_EXE_skclam"))
        .args(["--threads", "2"])
        .args(arguments)
        .output()
        .expect("sh runs")
}

#[test]
fn a_gigabyte_of_colour_profile_is_not_unpacked() {
    let Some(folder) = case("files/png-icc-bomb") else { return };
    let output = within(900_000, &["inspect", utf8(&folder), "--quiet"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn eight_gigabytes_of_nothing_are_refused_in_a_second() {
    let Some(file) = case("files/mcap-chunk-of-8-GiB-zeros.mcap") else { return };
    let begin = Instant::now();
    let message = fail(&["inspect", utf8(&file)]);
    assert!(message.contains("far more than recordings hold"), "{message}");
    assert!(begin.elapsed() < Duration::from_secs(3), "{:?}", begin.elapsed());
}

#[test]
fn a_database_without_its_log_says_what_is_missing() {
    let Some(file) = case("files/wal-missing.db3") else { return };
    let message = fail(&["inspect", utf8(&file)]);
    assert!(message.contains("wal-missing.db3-wal, which is missing"), "{message}");
}

/// An import that is killed at any of its renames leaves the old data set or the new one, and the next command
/// nothing beside it.
#[test]
fn an_import_that_is_killed_leaves_one_of_two_data_sets() {
    let Some(first) = case("base.mcap") else { return };
    let Some(second) = case("files/another.mcap") else { return };
    if !Command::new("strace").args(["-e", "trace=none", "true"]).output().is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: strace is not installed, or may not trace here");
        return;
    }
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let import = |recording: &Path| {
        vec!["import".to_owned(), utf8(recording).to_owned(), "-q".to_owned(), "--robot".to_owned(), "hp3j".to_owned()]
            .into_iter()
            .chain(["--snapshots".to_owned(), "--out".to_owned(), utf8(&out).to_owned()])
            .collect::<Vec<_>>()
    };
    let as_text = |arguments: &[String]| succeed(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let tables = [&second, &first].map(|recording| {
        as_text(&import(recording));
        fs::read(out.join("postures.csv")).unwrap()
    });
    for call in ["rename", "renameat2", "unlink", "mkdir"] {
        for when in 1..6 {
            as_text(&import(&first));
            let status = Command::new("strace")
                .args(["-f", "-q", "-o", "/dev/null", "-e", &format!("trace={call}")])
                .args(["-e", &format!("inject={call}:signal=KILL:when={when}")])
                .arg(env!("CARGO_BIN_EXE_skclam"))
                .args(import(&second))
                .output()
                .unwrap();
            let table = fs::read(out.join("postures.csv")).unwrap();
            assert!(tables.contains(&table), "{call} {when}: {status:?}");
            succeed(&["inspect", utf8(&out), "--quiet"]);
        }
    }
    as_text(&import(&first));
    let hidden = |entry: fs::DirEntry| entry.file_name().to_string_lossy().starts_with('.');
    assert!(!fs::read_dir(place.path()).unwrap().flatten().any(hidden), "a hidden folder is left");
}
