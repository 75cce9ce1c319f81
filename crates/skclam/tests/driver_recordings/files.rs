//! Files that were compressed, cut off by a crash, or never fetched; and the shared cases themselves.

use crate::world::*;
use skclam::import::{ClockChoice, ImportOptions};
use skclam::recordings::{Recording, Selection};
use skclam::rig::Rig;
use std::path::{Path, PathBuf};
use std::process::Command;

fn case(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let data = std::env::var_os("SKCLAM_DATA").map_or(beside, PathBuf::from);
    let path = data.join("../cases/drivers").join(name);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

/// What a case gives with options: the number of postures and the warnings, or the error.
fn outcome(name: &str, options: &ImportOptions) -> Option<Result<(usize, String), String>> {
    let path = case(name)?.join("recording");
    let imported = import_file(&path, &hp3j(), options);
    Some(imported.map(|(summary, dataset)| (dataset.len(), summary.warnings.join("\n"))))
}

#[test]
fn the_shared_cases_are_right() {
    let names: Vec<String> = ARM.iter().map(|&name| name.to_owned()).collect();
    let named = ImportOptions { joint_names: Some(names), ..builtin() };
    // Case, options, words of its warnings; six postures in each.
    for (name, options, words) in [
        ("compressed-folder", builtin(), ""),
        ("joint-name-twice", named.clone(), "S twice"),
        ("joint-names-empty", named, ""),
        ("joints-in-two-messages", builtin(), ""),
        ("nan-at-start", builtin(), "3 joint states"),
        ("nan-in-other-joint", builtin(), ""),
        ("p-zero-k-valid", builtin(), "P of CameraInfo is not filled in"),
        ("stamps-zero", builtin(), "times of recording"),
        ("image-clock-differs", ImportOptions { clock: ClockChoice::Log, ..builtin() }, ""),
    ] {
        let Some(outcome) = outcome(name, &options) else { return };
        let (postures, warnings) = outcome.unwrap_or_else(|error| panic!("{name}: {error}"));
        assert!(postures == 6 && warnings.contains(words), "{name}: {postures} postures, {warnings}");
    }
    let mut moving = builtin();
    moving.selection.selection = Selection::Moving { every: 1 };
    for (name, options, words) in [
        ("image-clock-differs", builtin(), "700.0"),
        ("two-joint-publishers", builtin(), "two sources"),
        ("two-joint-publishers", moving, "two sources"),
        ("no-tf-static", builtin(), "color_from_depth"),
        ("camera-info-refused-rig-ignored", builtin(), "--rig"),
    ] {
        let error = outcome(name, &options).unwrap().unwrap_err();
        assert!(error.contains(words), "{name}: {error}");
    }
    let folder = case("camera-info-refused-rig-ignored").unwrap();
    let rig = Rig::read(folder.join("rig.toml")).unwrap();
    let (summary, dataset) = import_file(&folder.join("recording"), &rig, &ImportOptions::default()).unwrap();
    assert_eq!((dataset.len(), dataset.rig.color.fx), (6, 342.755));
    assert!(summary.warnings.iter().any(|warning| warning.contains("8 coefficients")), "{:?}", summary.warnings);
}

/// The bytes of a recording, zstd-compressed by the tool that people use.
fn compressed(bytes: &[u8], to: &Path) -> bool {
    let plain = to.with_extension("");
    std::fs::write(&plain, bytes).unwrap();
    let done = Command::new("zstd").args(["-q", "--rm", "-f"]).arg(&plain).arg("-o").arg(to).status();
    let done = done.is_ok_and(|status| status.success());
    if !done {
        println!("skipped: the tool zstd is not there");
    }
    done
}

#[test]
fn compressed_folders_and_files_are_read() {
    let bytes = mcap_of(&good(50.0));
    for name in ["a.mcap.zstd", "a.mcap.zst", "rec_0.mcap.zstd"] {
        let folder = tempfile::tempdir().unwrap();
        if !compressed(&bytes, &folder.path().join(name)) {
            return;
        }
        for path in [folder.path().to_owned(), folder.path().join(name)] {
            let (_, dataset) = import_file(&path, &hp3j(), &builtin()).unwrap();
            assert!(dataset.len() == INTERVALS && error_of(&dataset) < 1e-3);
        }
        // Beside its unpacked copy, one of the two is read.
        std::fs::write(folder.path().join(name).with_extension(""), &bytes).unwrap();
        let (_, dataset) = import_file(folder.path(), &hp3j(), &builtin()).unwrap();
        assert_eq!(dataset.len(), INTERVALS);
    }
    // Parts in the order of their numbers.
    let (first, second): (Vec<Message>, Vec<Message>) =
        good(50.0).into_iter().partition(|message| message.log < ns(7.0));
    let folder = tempfile::tempdir().unwrap();
    for (part, messages) in [(2, &first), (10, &second)] {
        assert!(compressed(&mcap_of(messages), &folder.path().join(format!("rec_{part}.mcap.zstd"))));
    }
    let (_, dataset) = import_file(folder.path(), &hp3j(), &builtin()).unwrap();
    assert_eq!(dataset.len(), INTERVALS);
}

#[test]
fn files_cut_off_by_a_crash_are_read_up_to_the_cut() {
    let bytes = mcap_of(&good(50.0));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.mcap");
    let (mut before, mut read) = (0, 0);
    for percent in [1, 5, 20, 35, 50, 60, 70, 80, 85, 90, 95, 99] {
        for odd in [0, 1, 17] {
            std::fs::write(&path, &bytes[..bytes.len() * percent / 100 + odd]).unwrap();
            match import_file(&path, &hp3j(), &builtin()) {
                Ok((summary, dataset)) => {
                    assert!(error_of(&dataset) < 1e-3 && dataset.len() >= before, "{percent} %");
                    let reported = summary.warnings.iter().any(|warning| warning.contains("was not closed"));
                    // At the very end the index alone is missing, of which nothing is read.
                    assert!(reported || percent >= 95, "{percent} %: {:?}", summary.warnings);
                    (before, read) = (dataset.len(), read + 1);
                }
                Err(error) => assert!(percent < 50 && error.contains("was not closed"), "{percent} %: {error}"),
            }
        }
    }
    assert!(before == INTERVALS && read > 20, "{before}, {read}");
}

#[test]
fn databases_cut_off_are_read_up_to_the_cut() {
    let Some(folder) = case("compressed-folder") else { return };
    let place = tempfile::tempdir().unwrap();
    let plain = place.path().join("whole.db3");
    let unpacked = Command::new("zstd")
        .args(["-q", "-d"])
        .arg(folder.join("recording/zstd_file.db3.zstd"))
        .arg("-o")
        .arg(&plain)
        .status();
    if !unpacked.is_ok_and(|status| status.success()) {
        println!("skipped: the tool zstd is not there");
        return;
    }
    let bytes = std::fs::read(&plain).unwrap();
    let path = place.path().join("cut.db3");
    let mut read = 0;
    for percent in [2, 10, 30, 50, 60, 70, 80, 90, 95, 99] {
        std::fs::write(&path, &bytes[..bytes.len() * percent / 100]).unwrap();
        match import_file(&path, &hp3j(), &builtin()) {
            Ok((summary, dataset)) => {
                assert!(dataset.len() <= 6, "{percent} %");
                let warned = summary.warnings.iter().any(|warning| warning.contains("its end is missing"));
                assert!(warned, "{percent} %: {:?}", summary.warnings);
                read += 1;
            }
            Err(error) => assert!(error.contains("its end is missing") || percent < 10, "{percent} %: {error}"),
        }
    }
    assert!(read >= 4, "{read} of 10 were read");
}

#[test]
fn what_is_no_recording_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 99999\n";
    for (name, content, words) in [
        ("a.mcap", pointer.as_bytes(), "git lfs pull"),
        ("a.bag", pointer.as_bytes(), "git lfs pull"),
        ("a.db3", pointer.as_bytes(), "git lfs pull"),
        ("b.mcap", b"", "empty"),
        ("a.bag.gz", b"\x1f\x8b\x08\x00rest", "gunzip"),
        ("a.zip", b"PK\x03\x04rest", "unzip"),
        ("c.mcap", b"something", "no recording"),
    ] {
        let path = folder.path().join(name);
        std::fs::write(&path, content).unwrap();
        let error = Recording::open(&path).map(drop).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains(words), "{name}: {error}");
    }
    let inside = tempfile::tempdir().unwrap();
    std::fs::write(inside.path().join("rec_0.mcap"), pointer).unwrap();
    let error = Recording::open(inside.path()).map(drop).unwrap_err().to_string();
    assert!(error.contains("git lfs pull"), "{error}");
}
