//! Why a report could not be made.

use std::path::PathBuf;

/// Why a report could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReportError {
    /// A file of the result folder could not be read.
    #[error("{}: {source}; name a folder that `skclam run` or `skclam calibrate` wrote", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The folder is not of one piece.
    #[error(transparent)]
    Folder(#[from] skclam_files::OutputError),
    /// A file does not hold what a run writes.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
}
