//! Results appear whole or not at all: [`StagedFolder`] and [`StagedFile`] of the crate that has the file system.

pub use skclam_files::{Contents, OutputError, StagedFile, StagedFolder};
