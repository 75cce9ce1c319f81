//! Publishes a small result: `publish FOLDER WORD` writes files that all hold the word, or `publish --check FOLDER` prints the word
//! of a folder that is of one piece. The tests kill it and take the disk away from it at every system call.

use skclam_files::{Contents, StagedFolder, verify};
use std::process::ExitCode;

/// Files of every result, and one of a name of its own.
const FILES: [&str; 3] = ["a.txt", "sub/b.txt", "sub/c.txt"];

fn publish(folder: &str, word: &str) -> Result<(), Box<dyn std::error::Error>> {
    let staged = StagedFolder::new(folder, Contents::Result)?;
    for name in FILES {
        staged.write(name, word)?;
    }
    staged.write(format!("{word}.txt"), word)?;
    staged.publish()?;
    Ok(())
}

fn check(folder: &str) -> Result<String, Box<dyn std::error::Error>> {
    let manifest = verify(folder.as_ref())?.ok_or("there is no manifest")?;
    let word = std::fs::read_to_string(format!("{folder}/{}", FILES[0]))?;
    for name in FILES.map(str::to_owned).into_iter().chain([format!("{word}.txt")]) {
        let found = std::fs::read_to_string(format!("{folder}/{name}"))?;
        if found != word || !manifest.files.contains_key(&name) {
            return Err(format!("{name} holds {found:?} beside {word:?}").into());
        }
    }
    Ok(word)
}

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let done = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["--check", folder] => check(folder).map(|word| println!("{word}")),
        [folder, word] => publish(folder, word),
        _ => Err("publish FOLDER WORD, or publish --check FOLDER".into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
