//! What the tests of the whole program share: running it, and a small data set of the virtual cell.

#![allow(dead_code, reason = "each test binary uses its own part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

/// Runs the program.
pub fn skclam(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_skclam")).args(arguments).output().expect("the program starts")
}

/// Runs the program and asks that it succeeds.
pub fn succeed(arguments: &[&str]) -> String {
    let output = skclam(arguments);
    assert!(output.status.success(), "skclam {arguments:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs the program and asks that it fails with exit code 1; what it said.
pub fn fail(arguments: &[&str]) -> String {
    let output = skclam(arguments);
    assert_eq!(output.status.code(), Some(1), "skclam {arguments:?}: {}", text(&output.stdout));
    text(&output.stderr)
}

pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The paper's 73 postures at a quarter of the resolution, rendered once for all tests of this binary.
pub fn cell() -> &'static Path {
    static CELL: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, path) = CELL.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("cell");
        succeed(&["simulate", "--scale", "0.3", "--quiet", "--out", utf8(&path)]);
        (folder, path)
    });
    path
}

/// A copy of the first `postures` postures of the cell, to be damaged.
pub fn small_copy(postures: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for sub in ["color", "depth"] {
        fs::create_dir(folder.path().join(sub)).expect("a folder");
    }
    fs::copy(cell().join("rig.toml"), folder.path().join("rig.toml")).expect("a copy");
    for index in 0..postures {
        for name in [format!("color/{index:03}.jpg"), format!("depth/{index:03}.png")] {
            fs::copy(cell().join(&name), folder.path().join(&name)).expect("a copy");
        }
    }
    let table = fs::read_to_string(cell().join("postures.csv")).expect("the table");
    let lines: Vec<&str> = table.lines().take(postures + 1).collect();
    fs::write(folder.path().join("postures.csv"), lines.join("\n") + "\n").expect("the table");
    folder
}

/// Replaces text in a file of a data set.
pub fn edit(folder: &Path, file: &str, from: &str, to: &str) {
    let path = folder.join(file);
    let before = fs::read_to_string(&path).expect("a text file");
    assert!(before.contains(from), "{file} lacks {from}:\n{before}");
    fs::write(&path, before.replacen(from, to, 1)).expect("a text file");
}

pub fn utf8(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}
