//! A recording of any kind as one stream of messages.

use crate::bag::Bag;
use crate::budget::Budget;
use crate::bytes::{Bytes, Problem, decompressed_message};
use crate::database::Database;
use crate::mcap::Mcap;
use crate::opening::{open_file, open_folder};
use crate::tum::TumFolder;
use crate::unpacked::Unpacked;
use crate::{Header, MAX_MESSAGE_BYTES, MessageKind, RecordingError, Stamp, WireFormat};
use serde::Serialize;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

/// The kinds of recordings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum RecordingFormat {
    /// ROS 1 bag, version 2.0.
    Bag,
    /// MCAP.
    Mcap,
    /// SQLite database of rosbag2.
    Database,
    /// Folder in the layout of the TUM RGB-D benchmark.
    Tum,
}

/// A topic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Its position among the topics of the recording.
    pub id: usize,
    /// Its name.
    pub name: String,
    /// Type of its messages, as the recording says.
    pub type_name: String,
    /// The same as far as it matters here.
    pub kind: MessageKind,
    /// How its messages are laid out; `None`: in a way that is not read.
    pub wire: Option<WireFormat>,
}

/// Where a message lies, to come back to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Place {
    /// Which file of the recording.
    pub file: u32,
    /// Byte of the record that holds it, or its number in a database, or its line.
    pub offset: u64,
    /// Which message of that record.
    pub ordinal: u32,
}

/// How much of a message is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// The message is passed over and not visited.
    Nothing,
    /// So many bytes of its beginning, or all where it has fewer.
    Beginning(usize),
    /// All.
    Whole,
}

/// A message, as far as it was wanted.
#[derive(Debug, Clone, Copy)]
pub struct Message<'a> {
    /// When it was recorded, nanoseconds.
    pub log_time: Stamp,
    /// Bytes of the whole message.
    pub length: u64,
    /// What was wanted of it.
    pub data: &'a [u8],
    /// Where it lies.
    pub place: Place,
}

impl Message<'_> {
    /// The stamp of its header, or the time of recording where it has none.
    pub fn stamp(&self, topic: &Topic) -> Result<Stamp, RecordingError> {
        match topic.wire {
            Some(wire) if topic.kind.has_header() => Ok(Header::parse(&topic.name, wire, self.data)?.stamp),
            _ => Ok(self.log_time),
        }
    }
}

/// A recording of one or more files.
#[derive(Debug)]
pub struct Recording {
    path: PathBuf,
    format: RecordingFormat,
    files: Vec<RecordingFile>,
    /// Vanish with the recording, after its files are closed.
    _unpacked: Vec<Unpacked>,
    topics: Vec<Topic>,
    buffer: Vec<u8>,
    cuts: Vec<String>,
}

#[derive(Debug)]
pub(crate) enum RecordingFile {
    Bag(Bag),
    Mcap(Mcap),
    Database(Database),
    Tum(TumFolder),
}

/// What a reader is asked for, and to whom it reports.
pub(crate) struct Visitor<'a> {
    pub topics: &'a mut Vec<Topic>,
    pub file: u32,
    /// Whether checksums are verified where that means to read what nobody wants.
    pub verify: bool,
    pub want: &'a mut dyn FnMut(&Topic, Place) -> Wanted,
    pub visit: &'a mut dyn FnMut(&Topic, &Message<'_>) -> Result<(), RecordingError>,
    pub buffer: &'a mut Vec<u8>,
    /// What may still be unpacked in this pass.
    pub budget: &'a mut Budget,
    /// Files that end early, for a person.
    pub cuts: &'a mut Vec<String>,
}

/// Topics of a file by the number that the file gives them.
pub(crate) type TopicIds = HashMap<u64, usize>;

/// The most topics of a recording; they are looked up one by one.
const MAX_TOPICS: usize = 1 << 13;
/// How a zstd frame begins. No CDR message begins so.
pub(crate) const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

impl Visitor<'_> {
    /// A file ends before it should: what is before `offset` was read.
    pub fn cut(&mut self, path: &Path, offset: u64, length: u64, what: &str) {
        self.cuts.push(format!(
            "{}: {what}: the recording was not closed, or copied in part; {offset} of {length} bytes were read whole, and what is in them is used",
            path.display()
        ));
    }

    /// The position of a topic, which is new or known.
    pub fn topic(&mut self, name: String, type_name: String, wire: Option<WireFormat>) -> Result<usize, Problem> {
        if let Some(known) = self.topics.iter().find(|topic| topic.name == name && topic.type_name == type_name) {
            return Ok(known.id);
        }
        if self.topics.len() == MAX_TOPICS {
            return Err(Problem::Damaged(format!("there are more than {MAX_TOPICS} topics")));
        }
        let (id, kind) = (self.topics.len(), MessageKind::of(&type_name));
        self.topics.push(Topic { id, name, type_name, kind, wire });
        Ok(id)
    }

    /// The next `length` bytes are a message.
    pub fn message(
        &mut self,
        topic: usize,
        log_time: Stamp,
        place: Place,
        bytes: &mut dyn Bytes,
        length: u64,
    ) -> Result<(), Problem> {
        let wanted = self.wanted(topic, place);
        self.message_as_wanted(wanted, topic, log_time, place, bytes, length)
    }

    /// How much is wanted of a message. To be asked once a message: whoever answers may count.
    pub fn wanted(&mut self, topic: usize, place: Place) -> Wanted {
        (self.want)(&self.topics[topic], place)
    }

    /// The next `length` bytes are a message, of which it is known how much is wanted.
    pub fn message_as_wanted(
        &mut self,
        wanted: Wanted,
        topic: usize,
        log_time: Stamp,
        place: Place,
        bytes: &mut dyn Bytes,
        length: u64,
    ) -> Result<(), Problem> {
        let count = match wanted {
            Wanted::Nothing => return bytes.skip(length),
            Wanted::Beginning(count) => length.min(count as u64),
            Wanted::Whole => length,
        };
        bytes.read_into(self.buffer, count, MAX_MESSAGE_BYTES, "a message")?;
        let mut left = length - count;
        let mut decompressed = None;
        if self.buffer.starts_with(&ZSTD_MAGIC) && self.topics[topic].wire == Some(WireFormat::Cdr) {
            if length > MAX_MESSAGE_BYTES {
                return Err(Problem::Damaged(format!("a message has {length} bytes; {MAX_MESSAGE_BYTES} are read")));
            }
            let mut rest = Vec::new();
            bytes.read_into(&mut rest, left, MAX_MESSAGE_BYTES, "a message")?;
            left = 0;
            self.buffer.append(&mut rest);
            decompressed = Some(decompressed_message(self.buffer, self.budget)?);
        }
        let data = decompressed.as_ref().unwrap_or(self.buffer);
        let length = decompressed.as_ref().map_or(length, |message| message.len() as u64);
        (self.visit)(&self.topics[topic], &Message { log_time, length, data, place })?;
        bytes.skip(left)
    }
}

impl Recording {
    /// Opens a file (`.bag`, `.mcap`, `.db3`, recognised by their content), a folder of rosbag2 or a TUM folder. Files that are
    /// compressed as a whole with zstd, as rosbag2's mode FILE does, are unpacked into the folder for temporary files.
    ///
    /// # Errors
    /// [`RecordingError::Format`] for anything else, with what was found.
    pub fn open(path: impl AsRef<Path>) -> Result<Recording, RecordingError> {
        let path = path.as_ref();
        let metadata =
            std::fs::metadata(path).map_err(|source| RecordingError::Io { path: path.to_owned(), source })?;
        let (format, files, unpacked) = if metadata.is_dir() { open_folder(path)? } else { open_file(path)? };
        Ok(Recording {
            path: path.to_owned(),
            format,
            files,
            _unpacked: unpacked,
            topics: Vec::new(),
            buffer: Vec::new(),
            cuts: Vec::new(),
        })
    }

    /// What was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its kind.
    pub fn format(&self) -> RecordingFormat {
        self.format
    }

    /// The topics seen so far; all of them after a [`scan`](Self::scan).
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// The file that a message is, in a folder of image files.
    pub fn file_of(&self, place: Place) -> Option<&str> {
        match self.files.get(place.file as usize)? {
            RecordingFile::Tum(folder) => folder.file_of(place.offset),
            _ => None,
        }
    }

    /// Files that end early, as those of a recorder that crashed do: found by the last [`scan`](Self::scan), which read
    /// them up to that point.
    pub fn cuts(&self) -> &[String] {
        &self.cuts
    }

    /// Goes through the recording once, in the order of the file. Each message is offered to `want`, and visited as far
    /// as it is wanted; an error of `visit` ends the scan.
    ///
    /// Memory: one message, and one block of a decompressor (at most 64 MiB). With `verify`, every byte is read and
    /// compared with the file's checksums where it has some; without, what nobody wants is passed over by seeks.
    pub fn scan(
        &mut self,
        verify: bool,
        want: &mut dyn FnMut(&Topic, Place) -> Wanted,
        visit: &mut dyn FnMut(&Topic, &Message<'_>) -> Result<(), RecordingError>,
    ) -> Result<(), RecordingError> {
        let mut budget = Budget::default();
        self.cuts.clear();
        for (index, file) in self.files.iter_mut().enumerate() {
            let mut visitor = Visitor {
                topics: &mut self.topics,
                file: index as u32,
                verify,
                want: &mut *want,
                visit: &mut *visit,
                buffer: &mut self.buffer,
                budget: &mut budget,
                cuts: &mut self.cuts,
            };
            match file {
                RecordingFile::Bag(bag) => bag.scan(&mut visitor)?,
                RecordingFile::Mcap(mcap) => mcap.scan(&mut visitor)?,
                RecordingFile::Database(database) => database.scan(&mut visitor)?,
                RecordingFile::Tum(folder) => folder.scan(&mut visitor)?,
            }
        }
        Ok(())
    }

    /// Visits whole messages at places that a scan has given, in the order of the file. Only the records that hold
    /// them are read. What a file that was cut off lacks is not visited.
    pub fn read(
        &mut self,
        places: &[Place],
        visit: &mut dyn FnMut(&Topic, &Message<'_>) -> Result<(), RecordingError>,
    ) -> Result<(), RecordingError> {
        let mut budget = Budget::default();
        let mut no_cuts = Vec::new();
        let mut places = places.to_vec();
        places.sort_unstable();
        places.dedup();
        for record in places.chunk_by(|a, b| (a.file, a.offset) == (b.file, b.offset)) {
            let Place { file: index, offset, .. } = record[0];
            let mut want = |_: &Topic, place: Place| match record.binary_search(&place) {
                Ok(_) => Wanted::Whole,
                Err(_) => Wanted::Nothing,
            };
            let Some(file) = self.files.get_mut(index as usize) else { continue };
            let mut visitor = Visitor {
                topics: &mut self.topics,
                file: index,
                verify: false,
                want: &mut want,
                visit: &mut *visit,
                buffer: &mut self.buffer,
                budget: &mut budget,
                cuts: &mut no_cuts,
            };
            match file {
                RecordingFile::Bag(bag) => bag.read_record(offset, &mut visitor)?,
                RecordingFile::Mcap(mcap) => mcap.read_record(offset, &mut visitor)?,
                RecordingFile::Database(database) => database.read_row(offset, &mut visitor)?,
                RecordingFile::Tum(folder) => folder.read_entry(offset, &mut visitor)?,
            }
        }
        Ok(())
    }
}
