//! What can be wrong with a recording.

use std::path::PathBuf;

/// Why a recording could not be read or used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// A file could not be opened or read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is of no kind that is read.
    #[error("{}: {problem}", path.display())]
    Format {
        /// The file or folder.
        path: PathBuf,
        /// What was found, what is read.
        problem: String,
    },
    /// The file is damaged or was not closed.
    #[error("{}, byte {offset}: {problem}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where the record begins, or the message's number in a database.
        offset: u64,
        /// What was found, what was expected.
        problem: String,
    },
    /// A message is not what its type says, or of a kind that is not read.
    #[error("topic {topic}: {problem}")]
    Message {
        /// The topic.
        topic: String,
        /// What was found, what was expected.
        problem: String,
    },
    /// No topic, or more than one, will do.
    #[error("{wanted}: {problem}")]
    Topic {
        /// What was looked for: "colour images", ...
        wanted: &'static str,
        /// What was found, and how to choose.
        problem: String,
    },
    /// The joints of the recording are not those of the arm.
    #[error("joints: {problem}")]
    Joints {
        /// The names on both sides.
        problem: String,
    },
    /// Whoever visits the messages wants no more of them.
    #[error("stopped")]
    Stopped,
    /// An option that makes no sense.
    #[error("option {option} is {value}; {need}")]
    Option {
        /// Its name.
        option: &'static str,
        /// Its value.
        value: String,
        /// What is possible.
        need: &'static str,
    },
}

impl RecordingError {
    pub(crate) fn message(topic: &str, problem: impl Into<String>) -> Self {
        RecordingError::Message { topic: topic.to_owned(), problem: problem.into() }
    }
}
