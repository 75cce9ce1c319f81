//! A publication that is killed, or loses its disk, at every system call that changes names or bytes: the folder is
//! the old result or the new one, whole, and the next command leaves nothing behind. Needs strace, which injects the
//! faults; without it the tests say so and pass.

use skclam_files::{Contents, StagedFolder, verify};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Output};

/// The system calls that change names or bytes; `?` lets strace pass over those that the machine lacks.
const CALLS: [&str; 11] = [
    "rename",
    "renameat",
    "renameat2",
    "mkdir",
    "unlink",
    "unlinkat",
    "rmdir",
    "write",
    "openat",
    "fsync",
    "fdatasync",
];

/// Files of every result; one more has a name of its own.
const FILES: [&str; 3] = ["a.txt", "sub/b.txt", "sub/c.txt"];

/// What the program does that is killed: it publishes a result whose files all hold the word.
fn publish_here(folder: &str, word: &str) -> Result<(), Box<dyn std::error::Error>> {
    let staged = StagedFolder::new(folder, Contents::Result)?;
    for name in FILES {
        staged.write(name, word)?;
    }
    staged.write(format!("{word}.txt"), word)?;
    staged.publish()?;
    Ok(())
}

/// The word of a folder that is of one piece.
fn word_of(folder: &Path) -> Result<String, Box<dyn std::error::Error>> {
    let manifest = verify(folder)?.ok_or("there is no manifest")?;
    let word = fs::read_to_string(folder.join(FILES[0]))?;
    for name in FILES.map(str::to_owned).into_iter().chain([format!("{word}.txt")]) {
        let found = fs::read_to_string(folder.join(&name))?;
        if found != word || !manifest.files.contains_key(&name) {
            return Err(format!("{name} holds {found:?} beside {word:?}").into());
        }
    }
    Ok(word)
}

/// This very program.
fn program() -> PathBuf {
    std::env::current_exe().expect("the test's path")
}

fn strace_is_there() -> bool {
    let trial = Command::new("strace").args(["-e", "trace=none", "true"]).output();
    let works = trial.is_ok_and(|output| output.status.success());
    if !works {
        eprintln!("skipped: strace is not installed, or may not trace here");
    }
    works
}

fn publish(out: &Path, word: &str) -> Output {
    Command::new(program()).arg("--publish").arg(out).arg(word).output().expect("the program runs")
}

/// Publishes under strace with a fault at the `when`-th call; `None` where there were fewer.
fn faulty(out: &Path, call: &str, fault: &str, when: usize, log: &Path) -> Option<Output> {
    let output = Command::new("strace")
        .args(["-f", "-q", "-o"])
        .arg(log)
        .arg("-e")
        .arg(format!("trace=?{call}"))
        .arg("-e")
        .arg(format!("inject=?{call}:{fault}:when={when}"))
        .arg(program())
        .arg("--publish")
        .arg(out)
        .arg("two")
        // Cargo's folders would be searched for libraries, each with a call.
        .env_remove("LD_LIBRARY_PATH")
        .output()
        .expect("strace runs");
    let traced = fs::read_to_string(log).expect("strace's log");
    let hit = traced.contains("(INJECTED)") || traced.contains("killed by SIGKILL");
    hit.then_some(output)
}

fn check(out: &Path) -> Result<String, String> {
    word_of(out).map_err(|error| error.to_string())
}

/// What the destination is before.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Before {
    Nothing,
    EarlierResult,
    EarlierResultTwice,
    FoldersOfTheUser,
}

impl Before {
    fn make(self, out: &Path) {
        let words: &[&str] = match self {
            Before::Nothing => &[],
            Before::EarlierResult | Before::FoldersOfTheUser => &["one"],
            Before::EarlierResultTwice => &["zero", "one"],
        };
        if self == Before::FoldersOfTheUser {
            fs::create_dir_all(out.join("mine")).expect("a folder");
            fs::write(out.join("mine/notes"), "mine").expect("a file");
        }
        for word in words {
            let output = publish(out, word);
            assert!(output.status.success(), "{output:?}");
        }
        if self != Before::Nothing {
            fs::write(out.join("notes"), "mine").expect("a file");
        }
    }
}

/// Injects a fault at every call, each time the next of the faults; `expected` judges what is left.
fn sweep(faults: &[&str], expected: impl Fn(&Output, &Path, &str)) {
    for before in [Before::Nothing, Before::EarlierResult, Before::EarlierResultTwice, Before::FoldersOfTheUser] {
        let mut injected = 0;
        for call in CALLS {
            for when in 1.. {
                let place = tempfile::tempdir().expect("a folder");
                let out = place.path().join("out");
                before.make(&out);
                let log = tempfile::NamedTempFile::new().expect("a file");
                let fault = faults[injected % faults.len()];
                let Some(output) = faulty(&out, call, fault, when, log.path()) else { break };
                injected += 1;
                let at = format!("{before:?}, {call} {when}, {fault}: {}", String::from_utf8_lossy(&output.stderr));
                match check(&out) {
                    Ok(word) => assert!(word == "two" || word == "one", "{at}: {word}"),
                    // Nothing was there, and nothing is.
                    Err(_) if before == Before::Nothing && !out.exists() => {}
                    Err(problem) => panic!("{at}: {problem}"),
                }
                expected(&output, &out, &at);
                let again = publish(&out, "three");
                assert!(again.status.success(), "{at}: {again:?}");
                assert_eq!(check(&out).as_deref(), Ok("three"), "{at}");
                if before != Before::Nothing {
                    assert_eq!(fs::read_to_string(out.join("notes")).expect("the user's file"), "mine", "{at}");
                }
                nothing_is_left(place.path(), &at);
            }
        }
        assert!(injected > 10, "{before:?}: only {injected} faults were injected");
    }
}

/// No hidden folder, no trace of a publication.
fn nothing_is_left(place: &Path, at: &str) {
    for folder in [place.to_owned(), place.join("out"), place.join("out.previous")] {
        let Ok(entries) = fs::read_dir(&folder) else { continue };
        for entry in entries {
            let name = entry.expect("an entry").file_name();
            assert!(!name.to_string_lossy().starts_with('.'), "{at}: {} holds {name:?}", folder.display());
        }
    }
}

fn killed_at_every_call() {
    sweep(&["signal=KILL"], |_, _, _| {});
}

fn the_disk_fails_at_every_call() {
    let errors = ["ENOSPC", "EIO", "EROFS", "EACCES", "EXDEV", "EDQUOT"].map(|error| format!("error={error}"));
    sweep(&errors.each_ref().map(String::as_str), |output, out, at| {
        let message = String::from_utf8_lossy(&output.stderr);
        // Without a shared library there is no program, and no message of it.
        let began = !message.contains("shared librar");
        if !output.status.success() && began {
            assert!(message.contains(&out.display().to_string()), "{at}");
            assert!(!message.contains("panicked"), "{at}");
        }
    });
}

/// Not the usual harness: the program that is killed is this one.
fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let ["--publish", folder, word] = arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        return match publish_here(folder, word) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("{error}");
                ExitCode::FAILURE
            }
        };
    }
    if strace_is_there() {
        killed_at_every_call();
        the_disk_fails_at_every_call();
        println!("interrupted: every fault left the old result or the new one");
    }
    ExitCode::SUCCESS
}
