//! MCAP (mcap.dev/spec): magic, then records of an opcode, a length and a body; chunks hold records, compressed or not.
//!
//! Only schemas, channels, messages and chunks are read; the indices at the end are not needed for one pass.

use crate::bytes::{Bytes, Checked, Compression, Decoded, FileBytes, Problem, Window, end_of};
use crate::recording::{Place, TopicIds, Visitor};
use crate::{RecordingError, Stamp, WireFormat};
use std::collections::HashMap;
use std::path::Path;

pub(crate) const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, 0x0d, 0x0a];

const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
const MESSAGE: u8 = 0x05;
const CHUNK: u8 = 0x06;
const DATA_END: u8 = 0x0f;

#[derive(Debug)]
pub(crate) struct Mcap {
    file: FileBytes,
    schemas: HashMap<u16, String>,
    channels: TopicIds,
}

impl Mcap {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        Ok(Mcap { file: FileBytes::open(path)?, schemas: HashMap::new(), channels: HashMap::new() })
    }

    pub fn scan(&mut self, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        let mut offset = MAGIC.len() as u64;
        while offset < self.file.length {
            match self.record(offset, visitor) {
                Ok(Some(next)) => offset = next,
                Ok(None) => return Ok(()),
                Err(Problem::CutOff) => {
                    visitor.cut(&self.file.path, offset, self.file.length, "it ends in the middle of a record");
                    return Ok(());
                }
                Err(problem) => return Err(problem.at(&self.file.path, offset)),
            }
        }
        visitor.cut(&self.file.path, offset, self.file.length, "it has no footer");
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
    fn record(&mut self, offset: u64, visitor: &mut Visitor<'_>) -> Result<Option<u64>, Problem> {
        let Mcap { file, schemas, channels } = self;
        file.seek(offset)?;
        const HEAD: u64 = 9;
        if file.left() < HEAD {
            return Err(Problem::CutOff);
        }
        let head: &mut dyn Bytes = file;
        let (opcode, length) = (head.u8()?, head.u64()?);
        if matches!(opcode, FOOTER | DATA_END) {
            return Ok(None);
        }
        let mut body = Window::next(file, length);
        let is_cut = body.is_cut;
        let place = Place { file: visitor.file, offset, ordinal: 0 };
        let read = match opcode {
            CHUNK => chunk(body, place, schemas, channels, visitor),
            // A message whose end is missing is none.
            _ if is_cut => Err(Problem::CutOff),
            _ => plain_record(opcode, &mut body, length, place, schemas, channels, visitor),
        };
        end_of(read, is_cut)?;
        Ok(Some(offset + HEAD + length))
    }
}

fn chunk(
    mut body: Window<'_>,
    place: Place,
    schemas: &mut HashMap<u16, String>,
    channels: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    let head: &mut dyn Bytes = &mut body;
    head.skip(16)?;
    let (length, announced) = (head.u64()?, head.u32()?);
    let compression = head.text("the name of a compression")?;
    let stored = head.u64()?;
    let is_cut = body.is_cut;
    if (stored > body.left() && !is_cut) || (compression.is_empty() && stored != length) {
        return Err(format!("a chunk announces {stored} bytes for {length}, and {} are left", body.left()).into());
    }
    let mut found = None;
    match compression.as_str() {
        "" if visitor.verify && announced != 0 && !is_cut => {
            let mut bytes = Checked::new(body);
            records(&mut bytes, length, place, schemas, channels, visitor)?;
            found = Some(bytes.checksum());
        }
        "" => records(&mut body, length, place, schemas, channels, visitor)?,
        name => {
            let compression = match name {
                "lz4" => Compression::Lz4,
                "zstd" => Compression::Zstd,
                _ => return Err(format!("a chunk is compressed with {name:?}; lz4 and zstd are read").into()),
            };
            visitor.budget.earn(stored);
            visitor.budget.spend(length)?;
            let mut bytes = Decoded::new(body, compression, length)?;
            records(&mut bytes, length, place, schemas, channels, visitor)?;
            found = Some(bytes.checksum());
        }
    }
    match found {
        Some(found) if announced != 0 && found != announced => {
            Err(format!("the checksum of a chunk is {found:08x}, and it says {announced:08x}").into())
        }
        _ => Ok(()),
    }
}

/// The records of a chunk.
fn records(
    bytes: &mut dyn Bytes,
    length: u64,
    mut place: Place,
    schemas: &mut HashMap<u16, String>,
    channels: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    let mut left = length;
    while left > 0 {
        let (opcode, length) = (bytes.u8()?, bytes.u64()?);
        left = left
            .checked_sub(length.saturating_add(9))
            .ok_or_else(|| format!("a record of {length} bytes in a chunk where {left} are left"))?;
        if matches!(opcode, 0 | CHUNK) {
            return Err(format!("a record of the kind {opcode} in a chunk, where it cannot be").into());
        }
        plain_record(opcode, bytes, length, place, schemas, channels, visitor)?;
        place.ordinal = place.ordinal.saturating_add(u32::from(opcode == MESSAGE));
    }
    Ok(())
}

fn plain_record(
    opcode: u8,
    bytes: &mut dyn Bytes,
    length: u64,
    place: Place,
    schemas: &mut HashMap<u16, String>,
    channels: &mut TopicIds,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    let begin = bytes.left();
    match opcode {
        MESSAGE => {
            const HEAD: u64 = 22;
            if length < HEAD {
                return Err(format!("a message record of {length} bytes; at least {HEAD} are needed").into());
            }
            let channel = bytes.u16()?;
            bytes.u32()?;
            let log_time = bytes.u64()?;
            bytes.u64()?;
            let topic = *channels
                .get(&u64::from(channel))
                .ok_or_else(|| format!("a message of channel {channel}, which was not announced"))?;
            return visitor.message(topic, stamp(log_time)?, place, bytes, length - HEAD);
        }
        SCHEMA => {
            let id = bytes.u16()?;
            let name = bytes.text("the name of a schema")?;
            schemas.insert(id, name);
        }
        CHANNEL => {
            let id = bytes.u16()?;
            let schema = bytes.u16()?;
            let topic = bytes.text("the name of a topic")?;
            let wire = match bytes.text("a message encoding")?.as_str() {
                "cdr" => Some(WireFormat::Cdr),
                "ros1" => Some(WireFormat::Ros1),
                _ => None,
            };
            let type_name = schemas.get(&schema).cloned().unwrap_or_default();
            channels.insert(u64::from(id), visitor.topic(topic, type_name, wire)?);
        }
        _ => {}
    }
    // What else is in the record: the text of a schema, metadata of a channel, records of no interest.
    let used = begin - bytes.left();
    let rest = length.checked_sub(used).ok_or_else(|| format!("a record of {length} bytes that needs {used}"))?;
    bytes.skip(rest)
}

pub(crate) fn stamp(nanoseconds: u64) -> Result<Stamp, Problem> {
    Stamp::try_from(nanoseconds).map_err(|_| Problem::Damaged(format!("a time of {nanoseconds} ns")))
}
