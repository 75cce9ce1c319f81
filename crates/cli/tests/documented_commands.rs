//! The commands of README and book are run verbatim, and the reference of commands is what the program says of itself.

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use support::{cell, text};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// What is in the blocks that are marked `sh`, in their order.
fn commands(page: &str) -> String {
    let markdown = fs::read_to_string(root().join(page)).unwrap_or_else(|error| panic!("{page}: {error}"));
    let mut lines = markdown.lines();
    let mut script = String::new();
    while let Some(line) = lines.next() {
        if line.trim() == "```sh" {
            for command in lines.by_ref().take_while(|line| line.trim() != "```") {
                script.push_str(command.trim());
                script.push('\n');
            }
        }
        // A command that nobody runs goes stale unnoticed.
        assert!(!line.starts_with("    skclam "), "{page}: \"{line}\" is outside a block marked sh");
    }
    script
}

/// Runs a page's commands in an empty folder, where `prepare` may put what the page takes for given.
fn run_page(page: &str, prepare: impl Fn(&Path)) {
    let script = commands(page);
    assert!(script.contains("skclam "), "{page} has no commands");
    let folder = tempfile::tempdir().unwrap();
    prepare(folder.path());
    let binary = Path::new(env!("CARGO_BIN_EXE_skclam")).parent().unwrap();
    let path = format!("{}:{}", binary.display(), std::env::var("PATH").unwrap());
    let output = Command::new("bash")
        .args(["-euxo", "pipefail", "-c", &script])
        .current_dir(folder.path())
        .env("PATH", path)
        .output()
        .expect("bash");
    assert!(output.status.success(), "{page}\n{}\n{}", text(&output.stdout), text(&output.stderr));
}

fn with_a_capture(folder: &Path) {
    let capture = folder.join("capture.mcap");
    let practice = folder.join("practice");
    support::succeed(&[
        "simulate",
        "--scale",
        "0.2",
        "--postures",
        "diverse",
        "--count",
        "6",
        "--quiet",
        "--recording",
        support::utf8(&capture),
        "--out",
        support::utf8(&practice),
    ]);
}

fn with_a_cell(folder: &Path) {
    std::os::unix::fs::symlink(cell(), folder.join("cell")).unwrap();
}

#[test]
fn the_virtual_cell_in_five_minutes() {
    run_page("docs/tutorials/virtual-cell.md", |_| {});
}

#[test]
fn from_a_bag_to_a_urdf() {
    run_page("docs/tutorials/own-recording.md", |_| {});
}

#[test]
fn the_guide_to_recording() {
    run_page("docs/capture.md", with_a_capture);
}

#[test]
fn the_readme_on_ones_own_robot() {
    run_page("README.md", with_a_cell);
}

#[test]
fn the_reference_is_what_the_program_says() {
    let help = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_skclam")).args(arguments).output().unwrap();
        assert!(output.status.success());
        // Trailing blanks are nothing that an editor keeps.
        text(&output.stdout).lines().map(|line| format!("{}\n", line.trim_end())).collect::<String>()
    };
    let overview = help(&["--help"]);
    let names = overview
        .lines()
        .skip_while(|line| *line != "Commands:")
        .skip(1)
        .take_while(|line| !line.starts_with("Options:"))
        .filter(|line| line.starts_with("  ") && !line.starts_with("   "))
        .filter_map(|line| line.split_whitespace().next())
        .filter(|name| *name != "help");
    let mut page = format!(
        "# Commands\n\nWhat the program says of itself: `skclam --help`, and `skclam COMMAND --help` for each command.\n\n```text\n{overview}```\n"
    );
    for name in names {
        page.push_str(&format!("\n## skclam {name}\n\n```text\n{}```\n", help(&[name, "--help"])));
    }
    let file = root().join("docs/reference/commands.md");
    if std::env::var_os("SKCLAM_WRITE_DOCS").is_some() {
        fs::write(&file, &page).unwrap();
    }
    let kept = fs::read_to_string(&file).unwrap_or_default();
    assert!(kept == page, "docs/reference/commands.md is old; write it anew with SKCLAM_WRITE_DOCS=1");
}
