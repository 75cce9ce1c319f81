//! `rig.toml`: the rig as a file that people write and every run reads and writes.
//!
//! The file speaks degrees and millimetres, and every key carries its unit; the rig speaks radians and metres.
//! Unknown keys are refused by name. What is written can be read again and is the same rig to 1e-10 of a unit.

mod read;
mod tables;
mod write;

use crate::Rig;
use read::Reader;
use std::path::{Path, PathBuf};
use tables::RigFile;
use write::file_of;

/// Why a rig file could not be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RigFileError {
    /// The file could not be opened or read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The text is not TOML, or a key is missing, unknown or of another type. The message names line and key.
    #[error("{path}: {message}", path = path.display())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// Line, key and what was expected.
        message: String,
    },
    /// A value makes no sense.
    #[error("{path}: {key}: {problem}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The key in question, with its table.
        key: String,
        /// What is wrong, and what to do.
        problem: String,
    },
}

/// The URDF of an arm, and where in it the chain begins and ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RobotDescription {
    /// The file's name, as the rig has it.
    pub file: String,
    /// Its text.
    pub text: String,
    /// The link that is the chain's base.
    pub base_link: String,
    /// The link that is the chain's flange.
    pub tip_link: String,
}

impl RobotDescription {
    /// The URDF that the rig at `path` names; `None` where it describes the arm by a table, or has none.
    pub fn of_rig(path: impl AsRef<Path>) -> Result<Option<Self>, RigFileError> {
        let path = path.as_ref();
        let io = |source| RigFileError::Io { path: path.to_owned(), source };
        let text = skclam_files::read_text(path, skclam_files::Kind::Rig).map_err(io)?;
        let (reader, file) = parsed(&text, path)?;
        let table = file.robot.filter(|table| table.urdf.is_some());
        table.map(|table| reader.description(table)).transpose()
    }
}

fn parsed<'a>(text: &str, path: &'a Path) -> Result<(Reader<'a>, RigFile), RigFileError> {
    let file = toml::from_str(text).map_err(|error| RigFileError::Syntax {
        path: path.to_owned(),
        message: error.to_string().trim_end().to_owned(),
    })?;
    Ok((Reader { path }, file))
}

impl Rig {
    /// Reads `rig.toml`.
    pub fn read(path: impl AsRef<Path>) -> Result<Rig, RigFileError> {
        let path = path.as_ref();
        let io = |source| RigFileError::Io { path: path.to_owned(), source };
        let text = skclam_files::read_text(path, skclam_files::Kind::Rig).map_err(io)?;
        Rig::from_toml(&text, path)
    }

    /// Reads a rig from text. `path` names the file in errors, and its folder is where a URDF is looked for.
    pub fn from_toml(text: &str, path: impl AsRef<Path>) -> Result<Rig, RigFileError> {
        let (reader, file) = parsed(text, path.as_ref())?;
        reader.rig(file)
    }

    /// The rig as the text of `rig.toml`.
    pub fn to_toml(&self) -> Result<String, RigFileError> {
        let file = file_of(self);
        toml::to_string(&file)
            .map_err(|error| RigFileError::Syntax { path: PathBuf::from("rig.toml"), message: error.to_string() })
    }
}

#[cfg(test)]
mod tests;
