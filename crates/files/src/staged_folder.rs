//! A folder of results under construction.

use crate::manifest::{Contents, MANIFEST, Manifest};
use crate::place::Place;
use crate::{OutputError, publish, staging, tree};
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// A folder under construction. Dropped without [`publish`](Self::publish), it vanishes, and the destination is as it
/// was.
#[derive(Debug)]
pub struct StagedFolder {
    place: Place,
    contents: Contents,
    staged: PathBuf,
    /// Shows other commands that this one lives.
    _lock: File,
    derived: Vec<&'static str>,
    cleaned: Vec<PathBuf>,
    is_finished: bool,
}

impl StagedFolder {
    /// Begins a folder that will become `destination`. Folders above it are made; `destination` is not touched yet.
    ///
    /// # Errors
    /// Where the results could not be put there in the end: something else is there, or nothing can be written.
    pub fn new(destination: impl AsRef<Path>, contents: Contents) -> Result<Self, OutputError> {
        let place = Place::of(destination.as_ref(), contents)?;
        staging::still_wanted(&place.shown)?;
        let cleaned = staging::clean(place.workshop(), &place.name());
        let staged = place.workshop().join(staging::new_name(&place.name()));
        match staging::make(&staged, &place.made_parents) {
            Ok(lock) => Ok(StagedFolder {
                place,
                contents,
                staged,
                _lock: lock,
                derived: Vec::new(),
                cleaned,
                is_finished: false,
            }),
            Err(error) => {
                staging::remove_made(&place.made_parents);
                // Errors name what was asked for: nobody knows the hidden folder.
                Err(OutputError::io(&place.shown, error))
            }
        }
    }

    /// Folders of commands that were killed, which were found beside the destination and removed.
    pub fn cleaned(&self) -> &[PathBuf] {
        &self.cleaned
    }

    /// Where to write a file until the folder is published. Sub-folders of `name` are made.
    ///
    /// # Errors
    /// Where the name leads out of the folder, or a sub-folder cannot be made.
    pub fn path(&self, name: impl AsRef<Path>) -> Result<PathBuf, OutputError> {
        let name = name.as_ref();
        let shown = self.place.shown.join(name);
        staging::still_wanted(&self.place.shown)?;
        if name.as_os_str().is_empty() {
            return Ok(self.staged.clone());
        }
        if !crate::is_inside(name) {
            return Err(OutputError::new(shown, "leads out of the folder of the results"));
        }
        let path = self.staged.join(name);
        if let Some(parent) = path.parent() {
            fs::create_dir_all(parent).map_err(|source| OutputError::io(shown, source))?;
        }
        Ok(path)
    }

    /// Writes a whole file.
    ///
    /// # Errors
    /// As [`path`](Self::path), and where it cannot be written.
    pub fn write(&self, name: impl AsRef<Path>, contents: impl AsRef<[u8]>) -> Result<(), OutputError> {
        let path = self.path(&name)?;
        fs::write(path, contents).map_err(|source| OutputError::io(self.place.shown.join(name), source))
    }

    /// Writes a page that can be made again of the other files: its checksum is not kept, so that it may be.
    ///
    /// # Errors
    /// As [`write`](Self::write).
    pub fn write_derived(&mut self, name: &'static str, contents: impl AsRef<[u8]>) -> Result<(), OutputError> {
        self.derived.push(name);
        self.write(name, contents)
    }

    /// Puts everything in its place in one step, with a manifest. An earlier result is kept as `NAME.previous`.
    ///
    /// # Errors
    /// The destination is as it was; where the new results are kept, the message says.
    pub fn publish(mut self) -> Result<PathBuf, OutputError> {
        let files = self.complete().map_err(|source| OutputError::io(&self.place.shown, source))?;
        let guard = staging::publishing(&self.place.shown)?;
        let done = publish::publish(&self.place, &self.staged, &files);
        staging::unregister(&self.staged);
        self.is_finished = true;
        drop(guard);
        match done {
            Ok(()) => Ok(self.place.shown.clone()),
            Err(error) => Err(self.rescue(error)),
        }
    }

    /// Adds the manifest; all files, it last.
    fn complete(&self) -> io::Result<Vec<String>> {
        let mut files = tree::files(&self.staged)?;
        let manifest = Manifest::of(&self.staged, self.contents, &files, &self.derived)?;
        let json = manifest.to_json().map_err(|error| io::Error::other(error.to_string()))?;
        fs::write(self.staged.join(MANIFEST), json + "\n")?;
        files.push(MANIFEST.to_owned());
        tree::sync(&self.staged, &files)?;
        Ok(files)
    }

    /// Results that cannot be put in their place are not thrown away.
    fn rescue(&self, error: OutputError) -> OutputError {
        if tree::exists(&self.place.real.join(publish::JOURNAL)) {
            return error;
        }
        let mut name = self.place.name();
        name.push_str(".unpublished");
        let kept = self.place.workshop().join(name);
        if tree::exists(&kept) || fs::rename(&self.staged, &kept).is_err() {
            let at = format!("; the new results are kept in {}", self.staged.display());
            let _ = fs::remove_file(self.staged.join(staging::MARKER));
            return error.and(&at);
        }
        let _ = fs::remove_file(kept.join(staging::MARKER));
        error.and(&format!("; the new results are kept in {}", kept.display()))
    }
}

impl Drop for StagedFolder {
    fn drop(&mut self) {
        if !self.is_finished {
            // Nothing can be done about a failure here, and the original error is the one that matters.
            let _ = tree::remove(&self.staged, None);
            staging::unregister(&self.staged);
            staging::remove_made(&self.place.made_parents);
        }
    }
}
