//! ROS 1 bags, version 2.0 (wiki.ros.org/Bags/Format/2.0): records of a header with named fields and of data; chunks
//! hold connections and messages. The index at the end is not needed, so that a bag without one is read as well.

use crate::bytes::{Bytes, Compression, Decoded, FileBytes, Problem, Window, end_of};
use crate::recording::{Place, TopicIds, Visitor};
use crate::{RecordingError, WireFormat};
use std::collections::HashMap;
use std::path::Path;

const FIRST_LINE: &[u8] = b"#ROSBAG V2.0\n";
const MESSAGE: u8 = 0x02;
const BAG_HEADER: u8 = 0x03;
const CHUNK: u8 = 0x05;
const CONNECTION: u8 = 0x07;
/// Bytes of a record's header at most: some fields, of which a topic's name is the longest.
const MAX_HEADER: u64 = 1 << 16;
/// Bytes of a connection's data at most: a message definition.
const MAX_CONNECTION: u64 = 4 << 20;

#[derive(Debug)]
pub(crate) struct Bag {
    file: FileBytes,
    connections: TopicIds,
    header: Vec<u8>,
    /// Where the bag says that its index begins; 0 in one that was not closed.
    index_at: Option<u64>,
}

impl Bag {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let mut file = FileBytes::open(path)?;
        let mut line = [0; FIRST_LINE.len()];
        file.fill(&mut line).map_err(|problem| problem.at(path, 0))?;
        if line != FIRST_LINE {
            let found = String::from_utf8_lossy(&line).trim().to_owned();
            let problem = format!("the bag begins with {found:?}; version 2.0 is read (`rosbag migrate` converts)");
            return Err(RecordingError::Format { path: path.to_owned(), problem });
        }
        Ok(Bag { file, connections: HashMap::new(), header: Vec::new(), index_at: None })
    }

    pub fn scan(&mut self, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        let mut offset = FIRST_LINE.len() as u64;
        while offset < self.file.length {
            match self.record(offset, visitor) {
                Ok(next) => offset = next,
                Err(Problem::CutOff) => {
                    visitor.cut(&self.file.path, offset, self.file.length, "it ends in the middle of a record");
                    return Ok(());
                }
                Err(problem) => return Err(problem.at(&self.file.path, offset)),
            }
        }
        if self.index_at.is_some_and(|at| at == 0 || at > self.file.length) {
            visitor.cut(&self.file.path, offset, self.file.length, "it has no index");
        }
        Ok(())
    }

    pub fn read_record(&mut self, offset: u64, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        match self.record(offset, visitor) {
            // What could be read of it was visited.
            Ok(_) | Err(Problem::CutOff) => Ok(()),
            Err(problem) => Err(problem.at(&self.file.path, offset)),
        }
    }

    /// One record of the file; where the next one begins.
    fn record(&mut self, offset: u64, visitor: &mut Visitor<'_>) -> Result<u64, Problem> {
        let Bag { file, connections, header, index_at } = self;
        file.seek(offset)?;
        let place = Place { file: visitor.file, offset, ordinal: 0 };
        let head = record_header_in_file(file, header)?;
        if head == BAG_HEADER {
            *index_at = u64_field(header, "index_pos").ok();
        }
        let length = u64::from((file as &mut dyn Bytes).u32()?);
        let mut body = Window::next(file, length);
        let is_cut = body.is_cut;
        let end = offset + 8 + header.len() as u64 + length;
        let read = match head {
            CHUNK => chunk(body, header, length, place, connections, visitor),
            // A message whose end is missing is none.
            _ if is_cut => Err(Problem::CutOff),
            _ => plain_record(head, header, &mut body, length, place, connections, visitor),
        };
        end_of(read, is_cut)?;
        Ok(end)
    }
}

fn chunk(
    mut body: Window<'_>,
    header: &[u8],
    length: u64,
    place: Place,
    connections: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    let size = u64::from(u32_field(header, "size")?);
    let compression = field(header, "compression")?;
    let compression = match compression {
        b"none" => None,
        b"lz4" => Some(Compression::Lz4),
        b"bz2" => Some(Compression::Bz2),
        other => {
            let name = String::from_utf8_lossy(other).into_owned();
            return Err(format!("a chunk is compressed with {name:?}; none, lz4 and bz2 are read").into());
        }
    };
    match compression {
        None if size != length => Err(format!("a chunk of {length} bytes says it has {size}").into()),
        None => records(&mut body, size, place, connections, visitor),
        Some(compression) => {
            visitor.budget.earn(length);
            visitor.budget.spend(size)?;
            let mut bytes = Decoded::new(body, compression, size)?;
            records(&mut bytes, size, place, connections, visitor)
        }
    }
}

/// The records of a chunk.
fn records(
    bytes: &mut dyn Bytes,
    mut left: u64,
    mut place: Place,
    connections: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    let mut header = Vec::new();
    while left > 0 {
        let op = record_header(bytes, &mut header)?;
        let length = u64::from(bytes.u32()?);
        left = left
            .checked_sub(8 + header.len() as u64 + length)
            .ok_or_else(|| format!("a record of {length} bytes in a chunk where {left} are left"))?;
        if op == CHUNK {
            return Err("a chunk in a chunk".to_owned().into());
        }
        plain_record(op, &header, bytes, length, place, connections, visitor)?;
        place.ordinal = place.ordinal.saturating_add(u32::from(op == MESSAGE));
    }
    Ok(())
}

fn plain_record(
    op: u8,
    header: &[u8],
    bytes: &mut dyn Bytes,
    length: u64,
    place: Place,
    connections: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    match op {
        MESSAGE => {
            let connection = u32_field(header, "conn")?;
            let time = field(header, "time")?;
            let [s0, s1, s2, s3, n0, n1, n2, n3] = *time else {
                return Err(format!("the time of a message has {} bytes instead of 8", time.len()).into());
            };
            let (seconds, nanoseconds) = (u32::from_le_bytes([s0, s1, s2, s3]), u32::from_le_bytes([n0, n1, n2, n3]));
            let log_time = i64::from(seconds) * 1_000_000_000 + i64::from(nanoseconds);
            let topic = *connections
                .get(&u64::from(connection))
                .ok_or_else(|| format!("a message of connection {connection}, which was not announced"))?;
            visitor.message(topic, log_time, place, bytes, length)
        }
        CONNECTION => {
            let id = u32_field(header, "conn")?;
            let name = text(field(header, "topic")?, "a topic's name")?;
            let mut data = Vec::new();
            bytes.read_into(&mut data, length, MAX_CONNECTION, "the description of a connection")?;
            let type_name = text(field(&data, "type")?, "a type's name")?;
            let topic = visitor.topic(name, type_name, Some(WireFormat::Ros1))?;
            connections.insert(u64::from(id), topic);
            Ok(())
        }
        // Bag header, indices, chunk infos.
        _ => bytes.skip(length),
    }
}

/// The same where the file may have been cut off.
fn record_header_in_file(file: &mut FileBytes, header: &mut Vec<u8>) -> Result<u8, Problem> {
    const LENGTH: u64 = 4;
    let begin = file.position;
    if file.left() < 2 * LENGTH {
        return Err(Problem::CutOff);
    }
    let length = u64::from((file as &mut dyn Bytes).u32()?);
    if length <= MAX_HEADER && file.left() < length + LENGTH {
        return Err(Problem::CutOff);
    }
    file.seek(begin)?;
    record_header(file, header)
}

/// Reads a record's header; its `op`.
fn record_header(bytes: &mut dyn Bytes, header: &mut Vec<u8>) -> Result<u8, Problem> {
    let length = u64::from(bytes.u32()?);
    bytes.read_into(header, length, MAX_HEADER, "the header of a record")?;
    match field(header, "op")? {
        [op] => Ok(*op),
        other => Err(format!("the op of a record has {} bytes instead of 1", other.len()).into()),
    }
}

/// The value of a field: each is a length, a name, '=' and a value.
fn field<'a>(header: &'a [u8], name: &str) -> Result<&'a [u8], Problem> {
    let mut rest = header;
    while let [l0, l1, l2, l3, after @ ..] = rest {
        let length = u32::from_le_bytes([*l0, *l1, *l2, *l3]) as usize;
        let entry = after
            .get(..length)
            .ok_or_else(|| format!("a header field of {length} bytes where {} are left", after.len()))?;
        if let Some(value) = entry.strip_prefix(name.as_bytes()).and_then(|entry| entry.strip_prefix(b"=")) {
            return Ok(value);
        }
        rest = &after[length..];
    }
    Err(Problem::Damaged(format!("the header of a record has no field {name:?}")))
}

fn u32_field(header: &[u8], name: &str) -> Result<u32, Problem> {
    match field(header, name)? {
        [a, b, c, d] => Ok(u32::from_le_bytes([*a, *b, *c, *d])),
        other => Err(format!("the field {name:?} has {} bytes instead of 4", other.len()).into()),
    }
}

fn u64_field(header: &[u8], name: &str) -> Result<u64, Problem> {
    match <[u8; 8]>::try_from(field(header, name)?) {
        Ok(bytes) => Ok(u64::from_le_bytes(bytes)),
        Err(_) => Err(format!("the field {name:?} has not 8 bytes").into()),
    }
}

fn text(bytes: &[u8], what: &str) -> Result<String, Problem> {
    String::from_utf8(bytes.to_vec()).map_err(|_| Problem::Damaged(format!("{what} is not UTF-8")))
}
