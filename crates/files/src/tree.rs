//! Folders as trees: what is in them, removing them, writing them through to the disk.

use std::fs::{self, File};
use std::io;
use std::path::Path;
use std::time::Instant;

/// The deepest folder that is walked; results have three levels.
const MAX_DEPTH: usize = 32;

/// The regular files below `folder`, by their paths in it with `/` between parts, sorted.
pub(crate) fn files(folder: &Path) -> io::Result<Vec<String>> {
    let mut found = Vec::new();
    walk(folder, "", 0, &mut found)?;
    found.sort();
    Ok(found)
}

fn walk(folder: &Path, prefix: &str, depth: usize, found: &mut Vec<String>) -> io::Result<()> {
    if depth > MAX_DEPTH {
        return Err(io::Error::other(format!("folders lie more than {MAX_DEPTH} deep")));
    }
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = name.to_str().ok_or_else(|| io::Error::other("the name of a file is not UTF-8"))?;
        let path = if prefix.is_empty() { name.to_owned() } else { format!("{prefix}/{name}") };
        if entry.file_type()?.is_dir() {
            walk(&entry.path(), &path, depth + 1, found)?;
        } else if path != crate::staging::MARKER {
            found.push(path);
        }
    }
    Ok(())
}

/// Writes files and folders through to the disk, so that a rename does not overtake what it names.
pub(crate) fn sync(folder: &Path, files: &[String]) -> io::Result<()> {
    let mut folders = std::collections::BTreeSet::from([folder.to_owned()]);
    for name in files {
        let path = folder.join(name);
        File::open(&path)?.sync_data()?;
        folders.extend(path.parent().map(Path::to_owned));
    }
    folders.iter().try_for_each(|folder| sync_folder(folder))
}

/// Writes the names in a folder through to the disk, where the system can do that.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    match File::open(folder)?.sync_all() {
        // Some network file systems sync no folders.
        Err(error) if matches!(error.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
        other => other,
    }
}

/// Removes a folder that this program made, with its read-only children; what is gone already is no error. Ends early
/// at the deadline. The marker goes last, so that what is left can be distinguished from a result.
pub(crate) fn remove(folder: &Path, deadline: Option<Instant>) -> io::Result<()> {
    for entry in gone_is_empty(fs::read_dir(folder))?.into_iter().flatten() {
        let entry = entry?;
        if deadline.is_some_and(|deadline| Instant::now() > deadline) {
            return Err(io::ErrorKind::TimedOut.into());
        }
        let path = entry.path();
        if entry.file_name() == crate::staging::MARKER {
            continue;
        }
        if entry.file_type()?.is_dir() {
            remove(&path, deadline)?;
        } else if let Err(error) = fs::remove_file(&path) {
            writable_again(folder, error)?;
            gone_is_fine(fs::remove_file(&path))?;
        }
    }
    gone_is_fine(fs::remove_file(folder.join(crate::staging::MARKER)))?;
    gone_is_fine(fs::remove_dir(folder))
}

fn writable_again(folder: &Path, error: io::Error) -> io::Result<()> {
    match error.kind() {
        io::ErrorKind::NotFound => Ok(()),
        #[cfg(unix)]
        io::ErrorKind::PermissionDenied => {
            use std::os::unix::fs::PermissionsExt;
            fs::set_permissions(folder, fs::Permissions::from_mode(0o700))
        }
        _ => Err(error),
    }
}

fn gone_is_empty(read: io::Result<fs::ReadDir>) -> io::Result<Option<fs::ReadDir>> {
    match read {
        Ok(entries) => Ok(Some(entries)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

pub(crate) fn gone_is_fine(done: io::Result<()>) -> io::Result<()> {
    match done {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// Renames a file or folder; the folders above the target are made.
pub(crate) fn move_to(from: &Path, to: &Path) -> io::Result<()> {
    if let Some(parent) = to.parent() {
        fs::create_dir_all(parent)?;
    }
    fs::rename(from, to)
}

/// Whether something is at the path, a dangling link too.
pub(crate) fn exists(path: &Path) -> bool {
    path.symlink_metadata().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_listed_without_the_marker_and_trees_removed_whole() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("tree");
        for name in ["b/c/d", "a", crate::staging::MARKER] {
            move_to(tempfile::NamedTempFile::new_in(place.path()).unwrap().path(), &folder.join(name)).unwrap();
        }
        assert_eq!(files(&folder).unwrap(), ["a", "b/c/d"]);
        sync(&folder, &files(&folder).unwrap()).unwrap();
        remove(&folder, None).unwrap();
        assert!(!exists(&folder));
        remove(&folder, None).unwrap();
    }
}
