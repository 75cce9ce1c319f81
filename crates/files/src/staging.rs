//! Folders under construction: their names, their locks, and how they vanish with the command that made them.
//!
//! Every one holds the [`MARKER`], which goes last. A folder with a marker that nobody has locked was left by a
//! command that was killed, and may be removed; a folder without one never is.

use crate::{OutputError, tree};
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A hidden file in every folder under construction, and in a published one until its clean-up is done.
pub(crate) const MARKER: &str = ".skclam-staging";

/// Folders of this process that are under construction, each with the folders above it that were made for it, deepest
/// first.
static OPEN: Mutex<Vec<(PathBuf, Vec<PathBuf>)>> = Mutex::new(Vec::new());
/// Held while results are put in their place, so that a signal waits for the end of that.
static PUBLISHING: Mutex<()> = Mutex::new(());
/// Set when everything under construction was given up.
static ABANDONED: AtomicBool = AtomicBool::new(false);
static COUNT: AtomicU32 = AtomicU32::new(0);

fn held<T>(mutex: &'static Mutex<T>) -> MutexGuard<'static, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Keeps [`abandon_everything`] away while names are changed; refused after it.
pub(crate) fn publishing(destination: &Path) -> Result<MutexGuard<'static, ()>, OutputError> {
    let guard = held(&PUBLISHING);
    still_wanted(destination)?;
    Ok(guard)
}

/// Refuses to go on after [`abandon_everything`].
pub(crate) fn still_wanted(destination: &Path) -> Result<(), OutputError> {
    match ABANDONED.load(Ordering::SeqCst) {
        true => Err(OutputError::new(destination, "interrupted")),
        false => Ok(()),
    }
}

pub(crate) fn unregister(path: &Path) {
    held(&OPEN).retain(|(open, _)| open != path);
}

fn is_registered(path: &Path) -> bool {
    held(&OPEN).iter().any(|(open, _)| open == path)
}

/// Removes folders that were made for results which did not come, as far as they are empty.
pub(crate) fn remove_made(folders: &[PathBuf]) {
    for folder in folders {
        // Others may have put something there by now.
        let _ = fs::remove_dir(folder);
    }
}

/// Gives up everything that this process has under construction: for a program that is about to end. A publication that
/// has begun is waited for; both within `timeout`. Nothing can be staged or published afterwards.
///
/// Whether everything is gone; what is not is removed by the next command.
pub fn abandon_everything(timeout: Duration) -> bool {
    let deadline = Instant::now() + timeout;
    let guard = loop {
        match PUBLISHING.try_lock() {
            Ok(guard) => break Some(guard),
            Err(std::sync::TryLockError::Poisoned(poisoned)) => break Some(poisoned.into_inner()),
            Err(std::sync::TryLockError::WouldBlock) if Instant::now() > deadline => break None,
            Err(std::sync::TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    ABANDONED.store(true, Ordering::SeqCst);
    if guard.is_none() {
        // Half published: from the journal the next command knows how to go on.
        return false;
    }
    // Held until the program ends.
    std::mem::forget(guard);
    let paths = std::mem::take(&mut *held(&OPEN));
    let mut all = true;
    for (path, made) in paths {
        // Other threads still write; what they make anew is removed in the next round.
        while let Err(error) = tree::remove(&path, Some(deadline)) {
            if error.kind() == io::ErrorKind::TimedOut || Instant::now() > deadline {
                all = false;
                break;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        remove_made(&made);
    }
    all
}

/// What begins the names of folders under construction for `name`.
pub(crate) fn prefix(name: &str) -> String {
    // Names have at most 255 bytes, and some is needed for the rest.
    let mut most = name.len().min(150);
    while !name.is_char_boundary(most) {
        most -= 1;
    }
    // Long names that begin alike are distinguished.
    let rest = if most < name.len() { format!("~{:08x}", crc32fast::hash(name.as_bytes())) } else { String::new() };
    format!(".{}{rest}.partial-", &name[..most])
}

/// Whether an entry of a result folder is one of those that come and go with a publication.
pub(crate) fn is_ours(name: &str) -> bool {
    name == MARKER || name.starts_with(crate::publish::JOURNAL) || (name.starts_with('.') && name.contains(".partial-"))
}

/// A new name; no other command has it.
pub(crate) fn new_name(name: &str) -> String {
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    format!("{}{}-{count}", prefix(name), std::process::id())
}

/// Makes a folder under construction, marked, registered and locked. The lock lives as long as the file.
pub(crate) fn make(path: &Path, made_parents: &[PathBuf]) -> io::Result<File> {
    held(&OPEN).push((path.to_owned(), made_parents.to_owned()));
    if let Err(error) = fs::create_dir(path) {
        unregister(path);
        return Err(error);
    }
    let made = fs::write(path.join(MARKER), "").and_then(|()| File::open(path));
    match made {
        Ok(folder) => {
            // Where nothing can be locked, the name's process number has to do.
            let _ = folder.try_lock();
            Ok(folder)
        }
        Err(error) => {
            // The first error is the one that matters.
            let _ = tree::remove(path, None);
            unregister(path);
            Err(error)
        }
    }
}

/// Locks an existing folder, so that two commands do not change it at once; waits a little for the other.
pub(crate) fn lock(folder: &Path, shown: &Path) -> Result<Option<File>, OutputError> {
    let Ok(file) = File::open(folder) else { return Ok(None) };
    let deadline = Instant::now() + Duration::from_secs(5);
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(Some(file)),
            Err(TryLockError::WouldBlock) if Instant::now() > deadline => {
                return Err(OutputError::new(shown, "another command is writing to this folder; wait for its end"));
            }
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(20)),
            // A file system without locks.
            Err(TryLockError::Error(_)) => return Ok(None),
        }
    }
}

/// Whether a command that lives has the folder.
pub(crate) fn is_locked(folder: &Path) -> bool {
    is_registered(folder)
        || File::open(folder).is_ok_and(|file| matches!(file.try_lock(), Err(TryLockError::WouldBlock)))
}

/// Removes what killed commands left beside or in a folder; the paths that are gone.
pub(crate) fn clean(parent: &Path, name: &str) -> Vec<PathBuf> {
    let prefix = prefix(name);
    let Ok(entries) = fs::read_dir(parent) else { return Vec::new() };
    let mut cleaned = Vec::new();
    for entry in entries.flatten() {
        let path = entry.path();
        let of_ours = entry.file_name().to_str().is_some_and(|found| found.starts_with(&prefix));
        if !of_ours || is_locked(&path) {
            continue;
        }
        // A command that was killed before it wrote the marker left an empty folder; no other is removed by this call.
        let removed = match path.join(MARKER).is_file() {
            true => tree::remove(&path, None),
            false => fs::remove_dir(&path),
        };
        // One that cannot be removed is no reason not to work.
        if removed.is_ok() {
            cleaned.push(path);
        }
    }
    cleaned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nobody_holds_is_removed_and_what_has_no_marker_never() {
        let place = tempfile::tempdir().unwrap();
        let path = |name: &str| place.path().join(name);
        let alive = path(&new_name("out"));
        let lock = make(&alive, &[]).unwrap();
        // As left by a process that was killed.
        for name in [".out.partial-1-0", ".other.partial-1-0"] {
            fs::create_dir(path(name)).unwrap();
            fs::write(path(name).join(MARKER), "").unwrap();
        }
        fs::create_dir_all(path(".out.partial-2-0/sub")).unwrap();
        assert_eq!(clean(place.path(), "out"), [path(".out.partial-1-0")]);
        assert!(alive.exists() && path(".out.partial-2-0").exists() && path(".other.partial-1-0").exists());
        unregister(&alive);
        assert!(clean(place.path(), "out").is_empty(), "the lock alone keeps it");
        drop(lock);
        assert_eq!(clean(place.path(), "out"), [alive]);
    }

    #[test]
    fn names_fit_a_file_system() {
        let long = "\u{e9}".repeat(125);
        assert!(new_name(&long).len() < 200 && new_name(&long).starts_with(".\u{e9}"));
    }
}
