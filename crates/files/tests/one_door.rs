//! No other crate opens files by itself: one function decides which names are followed, and every read has its bound.

use std::path::{Path, PathBuf};

/// Calls that go round this crate.
const DOORS: [&str; 7] = [
    "File::open(",
    "fs::read(",
    "fs::read_to_string(",
    "fs::rename(",
    "ImageReader::open(",
    "image::open(",
    "fs::copy(",
];
/// What the system says of itself.
const OF_THE_SYSTEM: &str = "\"/proc/self/";

fn sources(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            sources(&path, found);
        } else if name.ends_with(".rs") && name != "tests.rs" {
            found.push(path);
        }
    }
}

#[test]
fn files_are_opened_through_this_crate() {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let mut files = Vec::new();
    for entry in std::fs::read_dir(crates).unwrap() {
        let path = entry.unwrap().path();
        // `damage` makes damaged files for tests; `experiments` is no part of the program.
        let is_of_the_program = !["files", "damage", "experiments"].iter().any(|name| path.ends_with(name));
        if is_of_the_program && path.join("src").is_dir() {
            sources(&path.join("src"), &mut files);
        }
    }
    assert!(files.len() > 100, "only {} sources were found", files.len());
    let mut around = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let program = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
        for (line, content) in program.lines().enumerate() {
            let opens = DOORS.iter().any(|door| content.contains(door)) && !content.contains("skclam_files");
            if opens && !content.trim_start().starts_with("//") && !content.contains(OF_THE_SYSTEM) {
                around.push(format!("{}:{}: {}", file.display(), line + 1, content.trim()));
            }
        }
    }
    assert!(around.is_empty(), "open files through skclam_files:\n{}", around.join("\n"));
}
