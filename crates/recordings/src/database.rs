//! The SQLite database of rosbag2 (`.db3`): a table of topics and one of messages.

use crate::bytes::{Bytes, Problem};
use crate::recording::{Place, TopicIds, Visitor};
use crate::{MAX_MESSAGE_BYTES, RecordingError, Wanted, WireFormat};
use rusqlite::limits::Limit;
use rusqlite::{Connection, MAIN_DB, OpenFlags};
use std::collections::HashMap;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub(crate) struct Database {
    path: PathBuf,
    connection: Connection,
    topics: TopicIds,
    /// Bytes of the file and bytes that its header announces, where these are more.
    cut: Option<(u64, u64)>,
}

fn problem(error: rusqlite::Error) -> Problem {
    Problem::Damaged(error.to_string())
}

impl Database {
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        (|| {
            let cut = missing_end(path)?;
            let connection = connect(path, cut.is_some())?;
            Ok(Database { path: path.to_owned(), connection, topics: HashMap::new(), cut })
        })()
        .map_err(|problem: Problem| problem.at(path, 0))
    }

    pub fn scan(&mut self, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        let Database { path, connection, topics, cut } = self;
        let is_cut = cut.is_some();
        let mut row_id = 0;
        let scanned: Result<(), Problem> = (|| {
            *topics = read_topics(connection, visitor)?;
            // By number and not by time: this needs no sorting, and a time that jumped back is reported as such.
            let mut statement =
                connection.prepare("SELECT id, topic_id, timestamp FROM messages ORDER BY id").map_err(problem)?;
            let mut rows = statement.query([]).map_err(problem)?;
            let mut last = None;
            while let Some(row) = rows.next().map_err(problem)? {
                let id: i64 = row.get(0).map_err(problem)?;
                // Rising numbers also mean that a damaged tree is not walked in a circle.
                if last.is_some_and(|last| id <= last) || id < 0 {
                    return Err(Problem::Damaged(format!("message {id} follows message {last:?}")));
                }
                last = Some(id);
                row_id = id as u64;
                let (topic, time) = (row.get(1).map_err(problem)?, row.get(2).map_err(problem)?);
                match message(connection, topics, id, topic, time, visitor) {
                    // Its pages are not there; those of later messages may be.
                    Err(Problem::Damaged(_)) if is_cut => {}
                    read => read?,
                }
            }
            Ok(())
        })();
        match (scanned, &*cut) {
            (Ok(()) | Err(Problem::Damaged(_)), Some((length, announced))) => {
                visitor.cut(path, *length, *announced, "its end is missing");
                Ok(())
            }
            (scanned, _) => scanned.map_err(|problem| problem.at(path, row_id)),
        }
    }

    pub fn read_row(&mut self, id: u64, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        let Database { path, connection, topics, cut } = self;
        let read = (|| {
            let row_id = i64::try_from(id).map_err(|_| Problem::Damaged(format!("there is no message {id}")))?;
            let mut statement =
                connection.prepare("SELECT topic_id, timestamp FROM messages WHERE id = ?1").map_err(problem)?;
            let (topic, time) = statement.query_row([row_id], |row| Ok((row.get(0)?, row.get(1)?))).map_err(problem)?;
            message(connection, topics, row_id, topic, time, visitor)
        })();
        match read {
            Err(Problem::Damaged(_)) if cut.is_some() => Ok(()),
            read => read.map_err(|problem: Problem| problem.at(path, id)),
        }
    }
}

/// Where the header says how the database is written (sqlite.org/fileformat): 2 is a write-ahead log.
const WRITE_VERSION_AT: u64 = 18;

/// The length of a file and what its header announces, where pages are missing at its end (sqlite.org/fileformat).
fn missing_end(path: &Path) -> std::io::Result<Option<(u64, u64)>> {
    let mut file = skclam_files::open(path, skclam_files::Kind::Recording)?;
    let length = file.metadata()?.len();
    let mut header = [0; 100];
    if file.read_exact(&mut header).is_err() {
        return Ok(None);
    }
    let number =
        |at: usize| u64::from(u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]));
    let page = match u64::from(u16::from_be_bytes([header[16], header[17]])) {
        1 => 65_536,
        page => page,
    };
    // The count of pages holds if it was written with the last change.
    let announced = if number(24) == number(92) { page * number(28) } else { 0 };
    Ok((announced > length).then_some((length, announced)))
}

/// The file of the write-ahead log of a database that has one; its messages may lie there alone.
fn write_ahead_log(path: &Path) -> std::io::Result<Option<PathBuf>> {
    let mut file = skclam_files::open(path, skclam_files::Kind::Recording)?;
    let mut version = [0];
    file.seek(SeekFrom::Start(WRITE_VERSION_AT))?;
    file.read_exact(&mut version)?;
    let mut name = path.as_os_str().to_owned();
    name.push("-wal");
    Ok((version == [2]).then(|| PathBuf::from(name)))
}

/// The name of a database beside which nothing is written (sqlite.org/uri).
fn unchanging(path: &Path) -> String {
    let mut name = String::from("file:");
    for &byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'/' | b'.' | b'-' | b'_' => name.push(char::from(byte)),
            byte if byte.is_ascii_alphanumeric() => name.push(char::from(byte)),
            byte => name.push_str(&format!("%{byte:02x}")),
        }
    }
    name + "?immutable=1"
}

fn connect(path: &Path, is_cut: bool) -> Result<Connection, Problem> {
    // Asked first: SQLite makes the log anew, and empty, where it is missing.
    let is_empty = |log: &PathBuf| log.metadata().map_or(true, |metadata| metadata.is_file() && metadata.len() == 0);
    let missing_log = write_ahead_log(path)?.filter(is_empty);
    // SQLite opens what is beside the database under its name, whatever it is.
    for ending in ["-wal", "-shm", "-journal"] {
        let mut beside = path.as_os_str().to_owned();
        beside.push(ending);
        if Path::new(&beside).symlink_metadata().is_ok_and(|metadata| !metadata.is_file()) {
            let beside = Path::new(&beside).display();
            return Err(Problem::Damaged(format!("beside it lies {beside}, which is no regular file; move it away")));
        }
    }
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let connection = match &missing_log {
        None => Connection::open_with_flags(path, flags),
        Some(_) => Connection::open_with_flags(unchanging(path), flags | OpenFlags::SQLITE_OPEN_URI),
    };
    let connection = connection.map_err(problem)?;
    if is_cut {
        // SQLite refuses a file whose end is missing, but with this; nothing is written all the same.
        connection.pragma_update(None, "writable_schema", "ON").map_err(problem)?;
    }
    let most = i32::try_from(MAX_MESSAGE_BYTES).unwrap_or(i32::MAX);
    connection.set_limit(Limit::SQLITE_LIMIT_LENGTH, most).map_err(problem)?;
    // A recording is data: nothing in its schema is run, and damaged pages are noticed when they are read.
    connection.pragma_update(None, "trusted_schema", "OFF").map_err(problem)?;
    connection.pragma_update(None, "cell_size_check", "ON").map_err(problem)?;
    for table in ["topics", "messages"] {
        let count: i64 = connection
            .query_row("SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name = ?1", [table], |row| {
                row.get(0)
            })
            .map_err(problem)?;
        if count != 1 {
            let hint = match &missing_log {
                Some(log) => {
                    format!(
                        "it was written with a log, {}, which is missing: copy that file beside it too",
                        log.display()
                    )
                }
                None => "is it a recording of rosbag2?".to_owned(),
            };
            return Err(Problem::Damaged(format!("the database has no table \"{table}\"; {hint}")));
        }
    }
    Ok(connection)
}

fn read_topics(connection: &Connection, visitor: &mut Visitor<'_>) -> Result<TopicIds, Problem> {
    let mut topics = TopicIds::new();
    let mut statement =
        connection.prepare("SELECT id, name, type, serialization_format FROM topics ORDER BY id").map_err(problem)?;
    let mut rows = statement.query([]).map_err(problem)?;
    while let Some(row) = rows.next().map_err(problem)? {
        let id: i64 = row.get(0).map_err(problem)?;
        let text = |column: usize| row.get::<_, String>(column).map_err(problem);
        let (name, type_name, format) = (text(1)?, text(2)?, text(3)?);
        let wire = (format == "cdr").then_some(WireFormat::Cdr);
        topics.insert(id as u64, visitor.topic(name, type_name, wire)?);
    }
    Ok(topics)
}

fn message(
    connection: &Connection,
    topics: &TopicIds,
    id: i64,
    topic: i64,
    log_time: i64,
    visitor: &mut Visitor<'_>,
) -> Result<(), Problem> {
    if log_time < 0 {
        return Err(Problem::Damaged(format!("a time of {log_time} ns")));
    }
    let topic = *topics
        .get(&(topic as u64))
        .ok_or_else(|| format!("a message of topic {topic}, which is not in the table of topics"))?;
    let place = Place { file: visitor.file, offset: id as u64, ordinal: 0 };
    let mut bytes = BlobBytes { connection, id, blob: None, position: 0, length: 0 };
    // The size is only looked up where somebody wants the message.
    let wanted = visitor.wanted(topic, place);
    if wanted == Wanted::Nothing {
        return Ok(());
    }
    bytes.open()?;
    let length = bytes.length;
    visitor.message_as_wanted(wanted, topic, log_time, place, &mut bytes, length)
}

/// The bytes of a message, read as far as they are wanted.
struct BlobBytes<'a> {
    connection: &'a Connection,
    id: i64,
    blob: Option<rusqlite::blob::Blob<'a>>,
    position: u64,
    length: u64,
}

impl BlobBytes<'_> {
    fn open(&mut self) -> Result<(), Problem> {
        let blob = self.connection.blob_open(MAIN_DB, "messages", "data", self.id, true).map_err(problem)?;
        self.length = blob.len() as u64;
        self.blob = Some(blob);
        Ok(())
    }
}

impl Bytes for BlobBytes<'_> {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        if let Some(blob) = &mut self.blob {
            blob.seek(SeekFrom::Start(self.position))?;
            blob.read_exact(target)?;
        }
        self.position += target.len() as u64;
        Ok(())
    }

    fn skip(&mut self, count: u64) -> Result<(), Problem> {
        self.position += count;
        Ok(())
    }

    fn left(&self) -> u64 {
        self.length.saturating_sub(self.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_log_is_named_and_not_made_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a b%?.db3");
        let writer = Connection::open(&path).unwrap();
        writer.pragma_update(None, "journal_mode", "WAL").unwrap();
        writer.execute_batch("CREATE TABLE topics (id INTEGER); CREATE TABLE messages (id INTEGER);").unwrap();
        let copied = folder.path().join("copy of a?.db3");
        std::fs::copy(&path, &copied).unwrap();
        let message = Database::open(&copied).map(drop).unwrap_err().to_string();
        assert!(message.contains("copy of a?.db3-wal, which is missing"), "{message}");
        let beside = std::fs::read_dir(folder.path()).unwrap().flatten();
        let copies = beside.filter(|entry| entry.file_name().to_string_lossy().starts_with("copy")).count();
        assert_eq!(copies, 1, "a file was made beside the recording");
        drop(writer);
        // Closed in order, the database holds all, and has no log.
        Database::open(&path).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn what_lies_beside_under_the_names_of_sqlite_is_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.db3");
        Connection::open(&path).unwrap().execute_batch("CREATE TABLE topics (id INTEGER)").unwrap();
        std::os::unix::fs::symlink("/dev/zero", folder.path().join("a.db3-journal")).unwrap();
        let message = Database::open(&path).map(drop).unwrap_err().to_string();
        assert!(message.contains("a.db3-journal, which is no regular file"), "{message}");
    }
}
