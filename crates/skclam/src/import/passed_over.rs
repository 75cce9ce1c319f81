//! Messages that could not be read: they are counted, and the first problem of each topic is kept.

use skclam_recordings::RecordingError;
use std::collections::BTreeMap;

/// Counts by topic.
#[derive(Debug, Default)]
pub(super) struct PassedOver {
    topics: BTreeMap<String, (u64, String)>,
}

impl PassedOver {
    /// What was read; `None`, and counted, where the message is bad. Whoever asked to stop is obeyed.
    pub fn check<T>(&mut self, topic: &str, read: Result<T, RecordingError>) -> Result<Option<T>, RecordingError> {
        match read {
            Ok(value) => Ok(Some(value)),
            Err(RecordingError::Message { problem, .. }) => {
                self.add(topic, problem);
                Ok(None)
            }
            Err(other) => Err(other),
        }
    }

    /// Counts a bad message.
    pub fn add(&mut self, topic: &str, problem: String) {
        self.add_many(topic, 1, problem);
    }

    /// Counts bad messages with one problem.
    pub fn add_many(&mut self, topic: &str, count: u64, problem: String) {
        self.topics.entry(topic.to_owned()).or_insert((0, problem)).0 += count;
    }

    /// For a person, one line a topic.
    pub fn warnings(&self) -> Vec<String> {
        let line = |(topic, (count, problem)): (&String, &(u64, String))| match count {
            1 => format!("1 message on {topic} was passed over: {problem}"),
            count => format!("{count} messages on {topic} were passed over, the first because: {problem}"),
        };
        self.topics.iter().map(line).collect()
    }
}
