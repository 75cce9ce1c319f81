//! An MCAP file of messages in Foxglove's schemas (protobuf), one topic a schema, written as a stream.

use super::ResultRecordingError;
use foxglove::Encode;
use foxglove::messages::Timestamp;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, WriteOptions};
use std::collections::BTreeMap;
use std::io::{Seek, Write};

/// A time of the recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Time {
    sec: u32,
    nsec: u32,
}

impl Time {
    /// From seconds; `None` where MCAP and Foxglove have no such time.
    pub(super) fn from_seconds(seconds: f64) -> Option<Time> {
        if !(0.0..f64::from(u32::MAX)).contains(&seconds) {
            return None;
        }
        let (sec, nsec) = (seconds.floor(), (seconds.fract() * 1e9).round());
        // 999,999,999.6 ns are the next second.
        let carry = nsec >= 1e9;
        Some(Time { sec: sec as u32 + u32::from(carry), nsec: if carry { 0 } else { nsec as u32 } })
    }

    pub(super) fn stamp(self) -> Option<Timestamp> {
        Some(Timestamp::new(self.sec, self.nsec))
    }

    fn nanoseconds(self) -> u64 {
        u64::from(self.sec) * 1_000_000_000 + u64::from(self.nsec)
    }
}

/// Writes messages; a topic begins with its first message.
pub(super) struct RecordingWriter<W: Write + Seek> {
    mcap: mcap::Writer<W>,
    /// By topic: the channel and the number of messages so far.
    channels: BTreeMap<String, (u16, u32)>,
    buffer: Vec<u8>,
}

impl<W: Write + Seek> RecordingWriter<W> {
    pub(super) fn new(out: W) -> Result<Self, ResultRecordingError> {
        // Most of a file is JPEG and floats: compression would take time and gain nothing.
        let options = WriteOptions::new().compression(None).library(concat!("skclam ", env!("CARGO_PKG_VERSION")));
        Ok(RecordingWriter { mcap: options.create(out)?, channels: BTreeMap::new(), buffer: Vec::new() })
    }

    pub(super) fn message<M: Encode>(
        &mut self,
        topic: &str,
        time: Time,
        message: &M,
    ) -> Result<(), ResultRecordingError> {
        let (channel_id, sequence) = match self.channels.get_mut(topic) {
            Some((channel, count)) => {
                *count += 1;
                (*channel, *count)
            }
            None => {
                let schema = M::get_schema().ok_or(ResultRecordingError::NoSchema { topic: topic.to_owned() })?;
                let schema = self.mcap.add_schema(&schema.name, &schema.encoding, &schema.data)?;
                let channel = self.mcap.add_channel(schema, topic, &M::get_message_encoding(), &BTreeMap::new())?;
                self.channels.insert(topic.to_owned(), (channel, 0));
                (channel, 0)
            }
        };
        self.buffer.clear();
        let encoded = message.encode(&mut self.buffer);
        encoded
            .map_err(|error| ResultRecordingError::Encode { topic: topic.to_owned(), problem: error.to_string() })?;
        let log_time = time.nanoseconds();
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.mcap.write_to_known_channel(&header, &self.buffer)?;
        Ok(())
    }

    /// A file that travels with the recording.
    pub(super) fn attachment(
        &mut self,
        name: &str,
        media_type: &str,
        time: Time,
        text: &str,
    ) -> Result<(), ResultRecordingError> {
        let time = time.nanoseconds();
        self.mcap.attach(&Attachment {
            log_time: time,
            create_time: time,
            name: name.to_owned(),
            media_type: media_type.to_owned(),
            data: text.as_bytes().into(),
        })?;
        Ok(())
    }

    pub(super) fn metadata(
        &mut self,
        name: &str,
        entries: BTreeMap<String, String>,
    ) -> Result<(), ResultRecordingError> {
        self.mcap.write_metadata(&Metadata { name: name.to_owned(), metadata: entries })?;
        Ok(())
    }

    /// Writes what finds things in the file; messages by topic.
    pub(super) fn finish(mut self) -> Result<BTreeMap<String, u32>, ResultRecordingError> {
        self.mcap.finish()?;
        self.mcap.into_inner().flush().map_err(|source| ResultRecordingError::Write(mcap::McapError::Io(source)))?;
        Ok(self.channels.into_iter().map(|(topic, (_, last))| (topic, last + 1)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_whole_nanoseconds() {
        assert_eq!(Time::from_seconds(1.5).unwrap().nanoseconds(), 1_500_000_000);
        assert_eq!(Time::from_seconds(2.999_999_999_9).unwrap(), Time { sec: 3, nsec: 0 });
        for bad in [-1e-9, f64::NAN, f64::INFINITY, 4.3e9] {
            assert_eq!(Time::from_seconds(bad), None);
        }
    }
}
