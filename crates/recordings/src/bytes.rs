//! Bytes of a file or of a compressed chunk, read forwards; what nobody wants is passed over.

use crate::budget::Budget;
use crate::{MAX_MESSAGE_BYTES, RecordingError};
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// What went wrong, before it is known where.
#[derive(Debug)]
pub(crate) enum Problem {
    Io(std::io::Error),
    Damaged(String),
    Known(RecordingError),
    /// The file ends before the record does: whoever wrote it did not come to close it.
    CutOff,
}

impl From<std::io::Error> for Problem {
    fn from(error: std::io::Error) -> Self {
        match error.kind() {
            ErrorKind::UnexpectedEof => Problem::Damaged("the data end in the middle of a record".to_owned()),
            // What decompressors say of bytes that they cannot read.
            ErrorKind::InvalidData | ErrorKind::InvalidInput | ErrorKind::Other => Problem::Damaged(error.to_string()),
            _ => Problem::Io(error),
        }
    }
}

impl From<String> for Problem {
    fn from(problem: String) -> Self {
        Problem::Damaged(problem)
    }
}

impl From<RecordingError> for Problem {
    fn from(error: RecordingError) -> Self {
        Problem::Known(error)
    }
}

impl Problem {
    /// With file and place.
    pub fn at(self, path: &Path, offset: u64) -> RecordingError {
        match self {
            Problem::Io(source) => RecordingError::Io { path: path.to_owned(), source },
            Problem::Damaged(problem) => RecordingError::Damaged { path: path.to_owned(), offset, problem },
            Problem::Known(error) => error,
            Problem::CutOff => {
                let problem = "the data end in the middle of a record".to_owned();
                RecordingError::Damaged { path: path.to_owned(), offset, problem }
            }
        }
    }
}

/// How the reading of a record ended: in one that the file cuts off, damage is its missing end.
pub(crate) fn end_of(read: Result<(), Problem>, is_cut: bool) -> Result<(), Problem> {
    match read {
        Err(Problem::Known(error)) => Err(Problem::Known(error)),
        Ok(()) | Err(Problem::Damaged(_)) if is_cut => Err(Problem::CutOff),
        other => other,
    }
}

/// A stream of bytes with a known end.
pub(crate) trait Bytes {
    /// Fills `target`.
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem>;
    /// Passes over `count` bytes.
    fn skip(&mut self, count: u64) -> Result<(), Problem>;
    /// Bytes to the end, as far as is known.
    fn left(&self) -> u64;
}

impl dyn Bytes + '_ {
    pub fn u8(&mut self) -> Result<u8, Problem> {
        let mut value = [0];
        self.fill(&mut value)?;
        Ok(value[0])
    }

    pub fn u16(&mut self) -> Result<u16, Problem> {
        let mut value = [0; 2];
        self.fill(&mut value)?;
        Ok(u16::from_le_bytes(value))
    }

    pub fn u32(&mut self) -> Result<u32, Problem> {
        let mut value = [0; 4];
        self.fill(&mut value)?;
        Ok(u32::from_le_bytes(value))
    }

    pub fn u64(&mut self) -> Result<u64, Problem> {
        let mut value = [0; 8];
        self.fill(&mut value)?;
        Ok(u64::from_le_bytes(value))
    }

    /// Reads `count` bytes into `buffer`, which grows only as fast as bytes arrive. More than `most` are refused.
    pub fn read_into(&mut self, buffer: &mut Vec<u8>, count: u64, most: u64, what: &str) -> Result<(), Problem> {
        const STEP: usize = 4 << 20;
        if count > most {
            return Err(Problem::Damaged(format!("{what} has {count} bytes; at most {most} are read")));
        }
        check_left(self, count)?;
        buffer.clear();
        while (buffer.len() as u64) < count {
            let begin = buffer.len();
            let end = (count as usize).min(begin + STEP);
            if buffer.capacity() < end {
                // Without the slack of amortised growth, so that the bound on memory is one.
                buffer.reserve_exact(end - begin);
            }
            buffer.resize(end, 0);
            self.fill(&mut buffer[begin..])?;
        }
        Ok(())
    }

    /// A text after its length of four bytes.
    pub fn text(&mut self, what: &str) -> Result<String, Problem> {
        const MOST: u64 = 1 << 16;
        let length = u64::from(self.u32()?);
        let mut bytes = Vec::new();
        self.read_into(&mut bytes, length, MOST, what)?;
        String::from_utf8(bytes).map_err(|_| Problem::Damaged(format!("{what} is not UTF-8")))
    }
}

fn check_left(bytes: &(impl Bytes + ?Sized), count: u64) -> Result<(), Problem> {
    if count <= bytes.left() {
        return Ok(());
    }
    Err(Problem::Damaged(format!(
        "{count} bytes are announced, but only {} are left; the recording was not closed, or is damaged",
        bytes.left()
    )))
}

/// A file, read through a buffer; passing over is a seek.
#[derive(Debug)]
pub(crate) struct FileBytes {
    reader: BufReader<File>,
    pub path: PathBuf,
    pub position: u64,
    pub length: u64,
}

impl FileBytes {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let io = |source| RecordingError::Io { path: path.to_owned(), source };
        let file = skclam_files::open(path, skclam_files::Kind::Recording).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        Ok(FileBytes { reader: BufReader::with_capacity(1 << 16, file), path: path.to_owned(), position: 0, length })
    }

    pub fn seek(&mut self, position: u64) -> Result<(), Problem> {
        if position > self.length {
            return Err(Problem::Damaged(format!("the file has {} bytes", self.length)));
        }
        // Within the buffer, if it can be: a plain seek would throw the buffer away.
        match i64::try_from(position).ok().zip(i64::try_from(self.position).ok()) {
            Some((to, from)) => self.reader.seek_relative(to - from)?,
            None => drop(self.reader.seek(SeekFrom::Start(position))?),
        }
        self.position = position;
        Ok(())
    }
}

impl Bytes for FileBytes {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        check_left(self, target.len() as u64)?;
        self.reader.read_exact(target)?;
        self.position += target.len() as u64;
        Ok(())
    }

    fn skip(&mut self, count: u64) -> Result<(), Problem> {
        check_left(self, count)?;
        self.seek(self.position + count)
    }

    fn left(&self) -> u64 {
        self.length.saturating_sub(self.position)
    }
}

/// The next bytes of a file; compressed ones are what a decompressor reads.
pub(crate) struct Window<'a> {
    file: &'a mut FileBytes,
    end: u64,
    /// Whether the file ends before the window does.
    pub is_cut: bool,
}

impl<'a> Window<'a> {
    /// The next `count` bytes, or those that are left of them in a file that was cut off.
    pub fn next(file: &'a mut FileBytes, count: u64) -> Self {
        let left = file.left();
        let end = file.position + count.min(left);
        Window { file, end, is_cut: count > left }
    }
}

impl Bytes for Window<'_> {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        check_left(self, target.len() as u64)?;
        self.file.fill(target)
    }

    fn skip(&mut self, count: u64) -> Result<(), Problem> {
        check_left(self, count)?;
        self.file.skip(count)
    }

    fn left(&self) -> u64 {
        self.end.saturating_sub(self.file.position)
    }
}

impl Read for Window<'_> {
    fn read(&mut self, target: &mut [u8]) -> std::io::Result<usize> {
        let most = usize::try_from(self.left()).unwrap_or(usize::MAX).min(target.len());
        let got = self.file.reader.read(&mut target[..most])?;
        self.file.position += got as u64;
        Ok(got)
    }
}

/// A compression of chunks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Compression {
    Lz4,
    Zstd,
    Bz2,
}

/// Largest window of a zstd stream, as a power of two: 64 MiB.
pub(crate) const ZSTD_WINDOW_LOG: u32 = 26;

/// Bytes out of a decompressor, with their checksum.
pub(crate) struct Decoded<'a> {
    reader: Box<dyn Read + 'a>,
    left: u64,
    checksum: crc32fast::Hasher,
}

impl<'a> Decoded<'a> {
    /// `length`: of the decompressed bytes, as announced.
    pub fn new(compressed: impl Read + 'a, compression: Compression, length: u64) -> Result<Self, Problem> {
        let reader: Box<dyn Read + 'a> = match compression {
            Compression::Lz4 => Box::new(lz4_flex::frame::FrameDecoder::new(compressed)),
            Compression::Zstd => {
                let mut decoder = zstd::stream::read::Decoder::new(compressed)?;
                decoder.window_log_max(ZSTD_WINDOW_LOG)?;
                Box::new(decoder)
            }
            Compression::Bz2 => Box::new(bzip2::read::BzDecoder::new(compressed)),
        };
        Ok(Decoded { reader, left: length, checksum: crc32fast::Hasher::new() })
    }

    /// CRC-32 of what was read or passed over.
    pub fn checksum(self) -> u32 {
        self.checksum.finalize()
    }
}

impl Bytes for Decoded<'_> {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        check_left(self, target.len() as u64)?;
        self.reader.read_exact(target)?;
        self.checksum.update(target);
        self.left -= target.len() as u64;
        Ok(())
    }

    fn skip(&mut self, mut count: u64) -> Result<(), Problem> {
        let mut scratch = [0; 1 << 14];
        while count > 0 {
            let part = count.min(scratch.len() as u64);
            self.fill(&mut scratch[..part as usize])?;
            count -= part;
        }
        Ok(())
    }

    fn left(&self) -> u64 {
        self.left
    }
}

/// Bytes that are all read even where they are passed over, for their checksum.
pub(crate) struct Checked<'a> {
    inner: Window<'a>,
    checksum: crc32fast::Hasher,
}

impl<'a> Checked<'a> {
    pub fn new(inner: Window<'a>) -> Self {
        Checked { inner, checksum: crc32fast::Hasher::new() }
    }

    /// CRC-32 of what was read or passed over.
    pub fn checksum(self) -> u32 {
        self.checksum.finalize()
    }
}

impl Bytes for Checked<'_> {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        self.inner.fill(target)?;
        self.checksum.update(target);
        Ok(())
    }

    fn skip(&mut self, mut count: u64) -> Result<(), Problem> {
        let mut scratch = [0; 1 << 14];
        while count > 0 {
            let part = count.min(scratch.len() as u64);
            self.fill(&mut scratch[..part as usize])?;
            count -= part;
        }
        Ok(())
    }

    fn left(&self) -> u64 {
        self.inner.left()
    }
}

/// A message that was compressed by itself, as rosbag2 can.
pub(crate) fn decompressed_message(compressed: &[u8], budget: &mut Budget) -> Result<Vec<u8>, Problem> {
    let allowed = budget.earn(compressed.len() as u64);
    let mut decoder = zstd::stream::read::Decoder::new(compressed)?;
    decoder.window_log_max(ZSTD_WINDOW_LOG)?;
    let mut message = Vec::new();
    decoder.take(MAX_MESSAGE_BYTES.min(allowed) + 1).read_to_end(&mut message)?;
    budget.spend(message.len() as u64)?;
    if message.len() as u64 > MAX_MESSAGE_BYTES {
        let problem = format!("a message has more than {MAX_MESSAGE_BYTES} bytes when decompressed");
        return Err(Problem::Damaged(problem));
    }
    Ok(message)
}
