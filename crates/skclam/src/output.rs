//! Results appear whole or not at all.
//!
//! Files are written into a hidden folder beside the destination and reach their place by rename when all of them are
//! complete. A run that fails or is interrupted leaves the destination as it was.

use std::fs;
use std::path::{Path, PathBuf};

/// Why results could not be put in their place.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct OutputError {
    path: PathBuf,
    source: std::io::Error,
}

/// A folder under construction. Dropped without [`publish`](Self::publish), it vanishes.
#[derive(Debug)]
pub struct StagedFolder {
    staging: PathBuf,
    destination: PathBuf,
    published: bool,
}

impl StagedFolder {
    /// Begins a folder that will become `destination`. The parent folders are made; `destination` is not touched yet.
    pub fn new(destination: impl AsRef<Path>) -> Result<Self, OutputError> {
        let destination = destination.as_ref().to_owned();
        let error = |path: &Path| {
            let path = path.to_owned();
            move |source| OutputError { path, source }
        };
        if destination.exists() && !destination.is_dir() {
            let source =
                std::io::Error::new(std::io::ErrorKind::NotADirectory, "is a file; name a folder for the results");
            return Err(OutputError { path: destination, source });
        }
        let name = destination.file_name().map_or_else(|| "results".into(), |name| name.to_string_lossy().into_owned());
        let parent = match destination.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            // "." and "results" lie in the current folder; "/" has no parent and is its own.
            _ if destination.file_name().is_some() => PathBuf::from("."),
            _ => destination.clone(),
        };
        fs::create_dir_all(&parent).map_err(error(&parent))?;
        let staging = parent.join(format!(".{name}.partial-{}", std::process::id()));
        if staging.exists() {
            fs::remove_dir_all(&staging).map_err(error(&destination))?;
        }
        // Errors name what was asked for: nobody knows the hidden folder.
        fs::create_dir(&staging).map_err(error(&destination))?;
        Ok(StagedFolder { staging, destination, published: false })
    }

    /// The same for results that are made of a data set: refused where a data set lies, whose `rig.toml` they would replace.
    pub fn for_result(destination: impl AsRef<Path>) -> Result<Self, OutputError> {
        let destination = destination.as_ref();
        if destination.join("postures.csv").exists() {
            let reason = "holds a data set (postures.csv), whose rig.toml would be replaced; name another folder for the results";
            let source = std::io::Error::new(std::io::ErrorKind::AlreadyExists, reason);
            return Err(OutputError { path: destination.to_owned(), source });
        }
        Self::new(destination)
    }

    /// Where to write a file until the folder is published. Sub-folders of `name` are made.
    pub fn path(&self, name: impl AsRef<Path>) -> Result<PathBuf, OutputError> {
        let path = self.staging.join(&name);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(|source| OutputError { path: self.destination.join(&name), source })?;
        }
        Ok(path)
    }

    /// Writes a whole file.
    pub fn write(&self, name: impl AsRef<Path>, contents: impl AsRef<[u8]>) -> Result<(), OutputError> {
        let path = self.path(&name)?;
        fs::write(path, contents).map_err(|source| OutputError { path: self.destination.join(name), source })
    }

    /// Puts everything in its place: the folder by one rename where the destination is new, else file by file over
    /// files of the same names. Other files in the destination stay.
    pub fn publish(mut self) -> Result<PathBuf, OutputError> {
        if self.destination.is_dir() {
            move_into(&self.staging, &self.destination)?;
            fs::remove_dir_all(&self.staging).map_err(|source| OutputError { path: self.staging.clone(), source })?;
        } else {
            fs::rename(&self.staging, &self.destination)
                .map_err(|source| OutputError { path: self.destination.clone(), source })?;
        }
        self.published = true;
        Ok(self.destination.clone())
    }
}

fn move_into(from: &Path, to: &Path) -> Result<(), OutputError> {
    let error = |path: &Path, source| OutputError { path: path.to_owned(), source };
    for entry in fs::read_dir(from).map_err(|source| error(from, source))? {
        let entry = entry.map_err(|source| error(from, source))?;
        let target = to.join(entry.file_name());
        let both_folders = entry.path().is_dir() && target.is_dir();
        if both_folders {
            move_into(&entry.path(), &target)?;
        } else {
            fs::rename(entry.path(), &target).map_err(|source| error(&target, source))?;
        }
    }
    Ok(())
}

impl Drop for StagedFolder {
    fn drop(&mut self) {
        if !self.published {
            // Nothing can be done about a failure here, and the original error is the one that matters.
            let _ = fs::remove_dir_all(&self.staging);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_appears_before_publication_and_all_of_it_after() {
        let folder = tempfile::tempdir().unwrap();
        let destination = folder.path().join("deep/result");
        let staged = StagedFolder::new(&destination).unwrap();
        staged.write("a.txt", "a").unwrap();
        staged.write("sub/b.txt", "b").unwrap();
        assert!(!destination.exists());
        staged.publish().unwrap();
        assert_eq!(fs::read_to_string(destination.join("sub/b.txt")).unwrap(), "b");
        assert_eq!(fs::read_dir(folder.path().join("deep")).unwrap().count(), 1);
    }

    #[test]
    fn an_abandoned_folder_leaves_no_trace_and_what_was_there_stays() {
        let folder = tempfile::tempdir().unwrap();
        let destination = folder.path().join("result");
        fs::create_dir(&destination).unwrap();
        fs::write(destination.join("a.txt"), "old").unwrap();
        let staged = StagedFolder::new(&destination).unwrap();
        staged.write("a.txt", "new").unwrap();
        drop(staged);
        assert_eq!(fs::read_to_string(destination.join("a.txt")).unwrap(), "old");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        let staged = StagedFolder::new(&destination).unwrap();
        staged.write("a.txt", "new").unwrap();
        fs::write(destination.join("other.txt"), "kept").unwrap();
        staged.publish().unwrap();
        assert_eq!(fs::read_to_string(destination.join("a.txt")).unwrap(), "new");
        assert_eq!(fs::read_to_string(destination.join("other.txt")).unwrap(), "kept");
    }

    #[test]
    fn a_data_set_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("postures.csv"), "").unwrap();
        fs::write(folder.path().join("rig.toml"), "nominal").unwrap();
        let message = StagedFolder::for_result(folder.path()).unwrap_err().to_string();
        assert!(message.contains("holds a data set"), "{message}");
        assert!(StagedFolder::for_result(folder.path().join("result")).is_ok());
    }

    #[test]
    fn a_file_in_the_way_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("file");
        fs::write(&file, "").unwrap();
        assert!(StagedFolder::new(&file).unwrap_err().to_string().contains("is a file"));
    }
}
