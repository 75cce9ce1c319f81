//! What can go wrong in an import.

use crate::dataset::DatasetError;
use crate::output::OutputError;
use skclam_recordings::RecordingError;
use skclam_rig::RigFileError;
use std::path::PathBuf;

/// Why a recording did not become a dataset.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportError {
    /// The recording.
    #[error(transparent)]
    Recording(#[from] RecordingError),
    /// The results could not be put in their place.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// The table of postures.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The rig.
    #[error(transparent)]
    Rig(#[from] RigFileError),
    /// A file could not be written or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A log of joint values is not well formed.
    #[error("{}, line {line}: {problem}", path.display())]
    JointLog {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: u64,
        /// What is wrong.
        problem: String,
    },
    /// A table of poses is not well formed.
    #[error("{}, line {line}: {problem}", path.display())]
    Poses {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1 (the header).
        line: u64,
        /// What is wrong.
        problem: String,
    },
    /// No joints and no poses.
    #[error("{problem}")]
    NoJoints {
        /// What was found and what can be done.
        problem: String,
    },
    /// Images and joints are not timed by one clock.
    #[error("{problem}")]
    Clocks {
        /// The gap, and what can be done.
        problem: String,
    },
    /// Something was wrong with the recording beside what ended the import.
    #[error("{source}\n{notes}")]
    Noted {
        /// What ended the import.
        source: Box<ImportError>,
        /// What was passed over, one line each.
        notes: String,
    },
    /// A camera is not known, or not as large as its images.
    #[error("{camera} camera: {problem}")]
    Camera {
        /// "colour" or "depth".
        camera: &'static str,
        /// What was found and what can be done.
        problem: String,
    },
    /// Fewer than two postures.
    #[error("{got} posture(s) found, at least 2 are needed: {reason}")]
    TooFewPostures {
        /// Postures found.
        got: usize,
        /// Why there are no more.
        reason: String,
    },
}
