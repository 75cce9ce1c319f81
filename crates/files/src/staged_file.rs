//! A single file of results under construction.

use crate::manifest::{Contents, MANIFEST, Manifest};
use crate::open::what_it_is;
use crate::place::parents;
use crate::{OutputError, staging, tree};
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// A file under construction, in a hidden folder beside its place. Dropped without [`publish`](Self::publish), it
/// vanishes.
#[derive(Debug)]
pub struct StagedFile {
    shown: PathBuf,
    real: PathBuf,
    folder: PathBuf,
    made_parents: Vec<PathBuf>,
    /// Shows other commands that this one lives.
    _lock: File,
    is_finished: bool,
}

impl StagedFile {
    /// Begins a file that will become `destination`; a link there is followed, and stays.
    ///
    /// # Errors
    /// Where something else than a regular file is there, a file of a result, or nothing can be written.
    pub fn new(destination: impl AsRef<Path>) -> Result<Self, OutputError> {
        let shown = destination.as_ref().to_owned();
        let (real, made_parents) = resolved(&shown)?;
        let begun = Self::begin(&shown, &real, &made_parents);
        match begun {
            Ok((folder, lock)) => Ok(StagedFile { shown, real, folder, made_parents, _lock: lock, is_finished: false }),
            Err(error) => {
                staging::remove_made(&made_parents);
                Err(error)
            }
        }
    }

    fn begin(shown: &Path, real: &Path, made: &[PathBuf]) -> Result<(PathBuf, File), OutputError> {
        staging::still_wanted(shown)?;
        let parent = real.parent().unwrap_or(real);
        let name = crate::place::name_of(real);
        refuse_parts_of_a_result(shown, parent, &name)?;
        staging::clean(parent, &name);
        let folder = parent.join(staging::new_name(&name));
        let lock = staging::make(&folder, made).map_err(|error| OutputError::io(shown, error))?;
        Ok((folder, lock))
    }

    /// Where to write it.
    pub fn path(&self) -> PathBuf {
        // With the ending of the destination, by which writers of images go.
        let mut name = std::ffi::OsString::from("file");
        if let Some(ending) = self.real.extension() {
            name.push(".");
            name.push(ending);
        }
        self.folder.join(name)
    }

    /// Writes it whole.
    ///
    /// # Errors
    /// Where it cannot be written; the message names the destination.
    pub fn write(&self, contents: impl AsRef<[u8]>) -> Result<(), OutputError> {
        fs::write(self.path(), contents).map_err(|error| OutputError::io(&self.shown, error))
    }

    /// Puts it in its place by one rename.
    ///
    /// # Errors
    /// What was there is as it was.
    pub fn publish(mut self) -> Result<(), OutputError> {
        let _guard = staging::publishing(&self.shown)?;
        let path = self.path();
        File::open(&path)
            .and_then(|file| file.sync_all())
            .and_then(|()| fs::rename(&path, &self.real))
            .map_err(|error| OutputError::io(&self.shown, error))?;
        self.is_finished = true;
        // The file is in place; an empty folder that stays is removed by the next command.
        let _ = tree::remove(&self.folder, None);
        staging::unregister(&self.folder);
        Ok(())
    }
}

impl Drop for StagedFile {
    fn drop(&mut self) {
        if !self.is_finished {
            // The original error is the one that matters.
            let _ = tree::remove(&self.folder, None);
            staging::unregister(&self.folder);
            staging::remove_made(&self.made_parents);
        }
    }
}

fn resolved(shown: &Path) -> Result<(PathBuf, Vec<PathBuf>), OutputError> {
    let io = |error| OutputError::io(shown, error);
    match shown.symlink_metadata() {
        Ok(metadata) => {
            let real = match shown.canonicalize() {
                Err(error) if metadata.is_symlink() && error.kind() == io::ErrorKind::NotFound => {
                    return Err(OutputError::new(shown, "is a link to what does not exist; name a file"));
                }
                other => other.map_err(io)?,
            };
            let file_type = real.metadata().map_err(io)?.file_type();
            match file_type.is_file() {
                true => Ok((real, Vec::new())),
                false => {
                    let problem = format!("is {}, which is not replaced; name a file", what_it_is(file_type));
                    Err(OutputError::new(shown, problem))
                }
            }
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let name = shown.file_name().ok_or_else(|| OutputError::new(shown, "name a file"))?;
            let (parent, made) = parents(shown)?;
            Ok((parent.join(name), made))
        }
        Err(error) => Err(io(error)),
    }
}

/// A page may be made again; the rig, the summary or an image of a result is not what a single file should replace.
fn refuse_parts_of_a_result(shown: &Path, parent: &Path, name: &str) -> Result<(), OutputError> {
    let Some(manifest) = Manifest::read(parent)? else { return Ok(()) };
    let is_part = match manifest.files.get(name) {
        Some(entry) => entry.crc32.is_some() && manifest.contents != Contents::Reproduction,
        None => name == MANIFEST,
    };
    match is_part {
        false => Ok(()),
        true => {
            Err(OutputError::new(shown, "belongs to the result in its folder, and is not replaced; name another file"))
        }
    }
}
