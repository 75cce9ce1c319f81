//! The one door to the file system: how files that strangers made are opened, and how results reach their place.
//!
//! - [`open`], [`read`] and [`read_text`] open regular files only and never read more than the [`Kind`] allows.
//! - [`inside`] decides for the whole program whether a name that came from a file may be followed.
//! - [`shown`], [`on_screen`] and [`csv_cell`] make text of a file harmless for terminals, pages and spreadsheets.
//! - [`StagedFolder`] and [`StagedFile`] put results in their place in one step, and [`verify`] notices folders that
//!   are not of one piece.
//!
//! It knows no robots, images or formats.
//!
#![doc = include_str!("../README.md")]

mod manifest;
mod names;
mod open;
mod place;
mod previous;
mod publish;
mod recover;
mod staged_file;
mod staged_folder;
mod staging;
mod text;
mod tree;

pub use manifest::{Contents, Entry, MANIFEST, Manifest, verify};
pub use names::{inside, is_inside};
pub use open::{Kind, open, read, read_text};
pub use recover::recover;
pub use staged_file::StagedFile;
pub use staged_folder::StagedFolder;
pub use staging::abandon_everything;
pub use text::{csv_cell, is_harmful, json_text, on_screen, shortened, shown};

use std::path::{Path, PathBuf};

/// Why results could not be put in their place, or why a folder of results is not whole. Names what the user named.
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct OutputError {
    path: PathBuf,
    problem: String,
    #[source]
    source: Option<std::io::Error>,
}

impl OutputError {
    pub(crate) fn new(path: impl AsRef<Path>, problem: impl Into<String>) -> Self {
        OutputError { path: path.as_ref().to_owned(), problem: problem.into(), source: None }
    }

    pub(crate) fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        OutputError { path: path.as_ref().to_owned(), problem: source.to_string(), source: Some(source) }
    }

    /// The same with more to say.
    pub(crate) fn and(mut self, more: &str) -> Self {
        self.problem += more;
        self
    }
}
