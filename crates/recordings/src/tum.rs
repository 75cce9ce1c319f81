//! A folder in the layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012): `rgb.txt` and `depth.txt` with a time
//! and a file a line, `groundtruth.txt` with a time and a camera pose `tx ty tz qx qy qz qw`; times in seconds.

use crate::bytes::{Bytes, FileBytes, Problem};
use crate::recording::{Place, Topic, Visitor};
use crate::{MessageKind, RecordingError, Stamp, Wanted};
use std::io::{BufRead, Read};
use std::path::{Path, PathBuf};

#[derive(Debug)]
pub(crate) struct TumFolder {
    folder: PathBuf,
    entries: Vec<Entry>,
}

#[derive(Debug)]
struct Entry {
    list: usize,
    stamp: Stamp,
    /// A file's name or a pose.
    text: String,
}

const LISTS: [(&str, MessageKind); 3] =
    [("rgb", MessageKind::ImageFile), ("depth", MessageKind::ImageFile), ("groundtruth", MessageKind::PoseLine)];

impl TumFolder {
    pub fn open(folder: &Path) -> Result<Self, RecordingError> {
        let mut entries = Vec::new();
        for (list, (name, kind)) in LISTS.into_iter().enumerate() {
            let path = folder.join(format!("{name}.txt"));
            if list > 0 && !path.exists() {
                continue;
            }
            read_list(&path, list, kind, &mut entries)?;
        }
        entries.sort_by_key(|entry| (entry.stamp, entry.list));
        Ok(TumFolder { folder: folder.to_owned(), entries })
    }

    /// The file of an image.
    pub fn file_of(&self, offset: u64) -> Option<&str> {
        let entry = self.entries.get(usize::try_from(offset).ok()?)?;
        (LISTS[entry.list].1 == MessageKind::ImageFile).then_some(entry.text.as_str())
    }

    pub fn scan(&mut self, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        (0..self.entries.len() as u64).try_for_each(|entry| self.read_entry(entry, visitor))
    }

    pub fn read_entry(&mut self, offset: u64, visitor: &mut Visitor<'_>) -> Result<(), RecordingError> {
        let Some(entry) = usize::try_from(offset).ok().and_then(|index| self.entries.get(index)) else {
            return Ok(());
        };
        let path = match LISTS[entry.list].1 {
            MessageKind::ImageFile => self.folder.join(&entry.text),
            _ => self.folder.join("groundtruth.txt"),
        };
        visit(entry, offset, &self.folder, &path, visitor).map_err(|problem| match problem.at(&path, 0) {
            // Here a message is a file, and that is what a person looks for.
            RecordingError::Message { problem, .. } => RecordingError::Format { path, problem },
            other => other,
        })
    }
}

fn visit(entry: &Entry, offset: u64, folder: &Path, path: &Path, visitor: &mut Visitor<'_>) -> Result<(), Problem> {
    let (name, kind) = LISTS[entry.list];
    let topic = topic(name, kind, visitor);
    let place = Place { file: visitor.file, offset, ordinal: 0 };
    if kind == MessageKind::PoseLine {
        let mut bytes = TextBytes(entry.text.as_bytes());
        return visitor.message(topic, entry.stamp, place, &mut bytes, entry.text.len() as u64);
    }
    let wanted = visitor.wanted(topic, place);
    if wanted == Wanted::Nothing {
        return Ok(());
    }
    let io = |source| RecordingError::Io { path: path.to_owned(), source };
    skclam_files::inside(folder, &entry.text).map_err(io)?;
    let mut file = FileBytes::open(path)?;
    if file.length > skclam_files::Kind::Image.max_bytes() {
        return Err(format!("an image of {} bytes", file.length).into());
    }
    let length = file.length;
    visitor.message_as_wanted(wanted, topic, entry.stamp, place, &mut file, length)
}

fn topic(name: &str, kind: MessageKind, visitor: &mut Visitor<'_>) -> usize {
    if let Some(known) = visitor.topics.iter().find(|topic| topic.name == name) {
        return known.id;
    }
    let id = visitor.topics.len();
    let type_name = if kind == MessageKind::ImageFile { "image file" } else { "pose" }.to_owned();
    visitor.topics.push(Topic { id, name: name.to_owned(), type_name, kind, wire: None });
    id
}

fn read_list(path: &Path, list: usize, kind: MessageKind, entries: &mut Vec<Entry>) -> Result<(), RecordingError> {
    let io = |source| RecordingError::Io { path: path.to_owned(), source };
    let file = skclam_files::open(path, skclam_files::Kind::List).map_err(io)?;
    let wrong = |line: usize, problem: String| RecordingError::Format {
        path: path.to_owned(),
        problem: format!("line {line}: {problem}"),
    };
    for (index, line) in std::io::BufReader::new(file.take(skclam_files::Kind::List.max_bytes())).lines().enumerate() {
        let line = line.map_err(|error| wrong(index + 1, error.to_string()))?;
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (time, text) = line
            .split_once(char::is_whitespace)
            .ok_or_else(|| wrong(index + 1, "a time and what was taken then are expected".to_owned()))?;
        let stamp = nanoseconds(time).ok_or_else(|| wrong(index + 1, format!("{time:?} is no time in seconds")))?;
        let text = text.trim().to_owned();
        if kind == MessageKind::ImageFile && !skclam_files::is_inside(Path::new(&text)) {
            return Err(wrong(index + 1, format!("{text:?} leaves the folder")));
        }
        entries.push(Entry { list, stamp, text });
    }
    Ok(())
}

/// Decimal seconds, without the rounding of a double.
fn nanoseconds(text: &str) -> Option<Stamp> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    if !fraction.bytes().all(|digit| digit.is_ascii_digit()) || !whole.bytes().all(|digit| digit.is_ascii_digit()) {
        return None;
    }
    let nine: String = fraction.chars().chain(std::iter::repeat('0')).take(9).collect();
    whole.parse::<Stamp>().ok()?.checked_mul(1_000_000_000)?.checked_add(nine.parse().ok()?)
}

struct TextBytes<'a>(&'a [u8]);

impl Bytes for TextBytes<'_> {
    fn fill(&mut self, target: &mut [u8]) -> Result<(), Problem> {
        Ok(self.0.read_exact(target)?)
    }

    fn skip(&mut self, count: u64) -> Result<(), Problem> {
        self.0 = self.0.get(count as usize..).unwrap_or_default();
        Ok(())
    }

    fn left(&self) -> u64 {
        self.0.len() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_keep_their_digits() {
        assert_eq!(nanoseconds("1305031102.175304"), Some(1_305_031_102_175_304_000));
        assert_eq!(nanoseconds("12"), Some(12_000_000_000));
        for bad in ["", "-1.0", "1e3", "a", "1.2.3", "99999999999999"] {
            assert_eq!(nanoseconds(bad), None, "{bad}");
        }
    }

    #[test]
    fn a_damaged_image_is_named() {
        use crate::{ColorPixels, Recording};
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("rgb.txt"), "1.0 first.png\n").unwrap();
        std::fs::write(folder.path().join("first.png"), "no image").unwrap();
        let mut recording = Recording::open(folder.path()).unwrap();
        let read = recording.scan(false, &mut |_, _| Wanted::Whole, &mut |topic, message| {
            ColorPixels::from_file(&topic.name, message.data).map(drop)
        });
        let error = read.unwrap_err().to_string();
        assert!(error.contains("first.png: ") && error.contains("neither JPEG nor PNG"), "{error}");
    }

    #[test]
    fn files_outside_the_folder_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("rgb.txt"), "# list\n1.0 ../secret.png\n").unwrap();
        let error = TumFolder::open(folder.path()).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("leaves the folder"), "{error}");
    }
}
