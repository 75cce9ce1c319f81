//! Finishing what a command that was killed has begun.

use crate::publish::{JOURNAL, Journal, after_exchange};
use crate::{Kind, OutputError, open, staging, tree};
use std::fs;
use std::io::Read;
use std::path::Path;

/// Finishes a publication into a folder that was interrupted. Without one, which is the rule, nothing is done; while
/// the command that publishes lives, its end is waited for.
///
/// # Errors
/// Where the folder holds files of two results and cannot be put in order.
pub fn recover(folder: &Path) -> Result<(), OutputError> {
    // Links were named by the user, and the names beside the folder are those beside the real one.
    let Ok(real) = folder.canonicalize() else { return Ok(()) };
    let (journal, marker) = (real.join(JOURNAL), real.join(staging::MARKER));
    if tree::exists(&journal) {
        let lock = staging::lock(&real, folder)?;
        // The other command may have come to its end while this one waited.
        if tree::exists(&journal) {
            finish(&real, &journal).map_err(|problem| {
                let half = format!("holds files of two results, as a command was interrupted: {problem}");
                OutputError::new(folder, half)
            })?;
        }
        drop(lock);
    }
    if tree::exists(&marker) && !staging::is_locked(&real) {
        // The result is whole; only tidying up is left, and can wait.
        let _ = after_exchange(&real);
    }
    Ok(())
}

fn finish(real: &Path, path: &Path) -> Result<(), String> {
    let mut text = String::new();
    open(path, Kind::Manifest)
        .and_then(|file| file.take(Kind::Manifest.max_bytes()).read_to_string(&mut text))
        .map_err(|error| error.to_string())?;
    let journal: Journal = serde_json::from_str(&text).map_err(|_| format!("{JOURNAL} is damaged"))?;
    if !journal.is_sound(real) {
        return Err(format!("{JOURNAL} names what is not of the folder"));
    }
    journal.forward(real).map_err(|error| error.to_string())?;
    journal.finish(real).map_err(|error| error.to_string())?;
    let _ = fs::remove_file(real.join(format!("{JOURNAL}.new")));
    Ok(())
}
