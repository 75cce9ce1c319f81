//! Files that were compressed as a whole, as rosbag2 does with `--compression-mode file`: both readers go to and fro, so
//! that they are unpacked into a temporary file, which vanishes with the recording.

use crate::RecordingError;
use crate::budget::Budget;
use crate::bytes::{Problem, ZSTD_WINDOW_LOG};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// A temporary file with what was compressed.
#[derive(Debug)]
pub(crate) struct Unpacked {
    file: tempfile::NamedTempFile,
}

impl Unpacked {
    /// Unpacks a file.
    pub fn new(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.to_owned(), source };
        let compressed = skclam_files::open(path, skclam_files::Kind::Recording).map_err(io)?;
        let folder = std::env::temp_dir();
        let in_folder = |source: std::io::Error| {
            let problem = format!(
                "cannot be unpacked into {}: {source}; unpack it yourself with `zstd -d`, or name another folder with TMPDIR",
                folder.display()
            );
            RecordingError::Format { path: path.to_owned(), problem }
        };
        let mut file = tempfile::Builder::new().prefix("skclam-").tempfile().map_err(in_folder)?;
        let mut budget = Budget::default();
        budget.earn(compressed.metadata().map_err(io)?.len());
        let mut reader = zstd::stream::read::Decoder::new(compressed).map_err(io)?;
        reader.window_log_max(ZSTD_WINDOW_LOG).map_err(io)?;
        let mut buffer = vec![0; 1 << 18];
        loop {
            let count = match reader.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => count,
                // Cut off: the reader of what was unpacked says so.
                Err(error) if error.kind() == std::io::ErrorKind::UnexpectedEof => break,
                Err(error) => return Err(Problem::from(error).at(path, 0)),
            };
            budget.spend(count as u64).map_err(|problem| problem.at(path, 0))?;
            file.write_all(&buffer[..count]).map_err(in_folder)?;
        }
        file.flush().map_err(in_folder)?;
        Ok(Unpacked { file })
    }

    /// Where it lies.
    pub fn path(&self) -> PathBuf {
        self.file.path().to_owned()
    }
}
