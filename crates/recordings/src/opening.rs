//! What kind of recording a path is: a file by its content, a folder by its files.

use crate::bag::Bag;
use crate::database::Database;
use crate::mcap::Mcap;
use crate::recording::{RecordingFile, ZSTD_MAGIC};
use crate::tum::TumFolder;
use crate::unpacked::Unpacked;
use crate::{RecordingError, RecordingFormat};
use std::io::Read;
use std::path::{Path, PathBuf};

/// The most files of a recording.
const MAX_FILES: usize = 1 << 16;

pub(crate) type Opened = (RecordingFormat, Vec<RecordingFile>, Vec<Unpacked>);

pub(crate) fn open_file(path: &Path) -> Result<Opened, RecordingError> {
    let beginning = beginning(path)?;
    if beginning.starts_with(&ZSTD_MAGIC) {
        let unpacked = Unpacked::new(path)?;
        let (format, file) = open_plain(path, &unpacked.path())?;
        return Ok((format, vec![file], vec![unpacked]));
    }
    let (format, file) = open_plain(path, path)?;
    Ok((format, vec![file], vec![]))
}

fn beginning(path: &Path) -> Result<Vec<u8>, RecordingError> {
    let mut beginning = Vec::new();
    skclam_files::open(path, skclam_files::Kind::Recording)
        .and_then(|file| file.take(16).read_to_end(&mut beginning))
        .map_err(|source| RecordingError::Io { path: path.to_owned(), source })?;
    Ok(beginning)
}

/// Opens what lies at `path`; `named` is what the user knows.
fn open_plain(named: &Path, path: &Path) -> Result<(RecordingFormat, RecordingFile), RecordingError> {
    let beginning = beginning(path)?;
    if beginning.starts_with(b"#ROSBAG V") {
        return Ok((RecordingFormat::Bag, RecordingFile::Bag(Bag::open(path)?)));
    }
    if beginning.starts_with(&crate::mcap::MAGIC) {
        return Ok((RecordingFormat::Mcap, RecordingFile::Mcap(Mcap::open(path)?)));
    }
    if beginning.starts_with(b"SQLite format 3\0") {
        return Ok((RecordingFormat::Database, RecordingFile::Database(Database::open(path)?)));
    }
    let hint = match beginning.as_slice() {
        [] => "the file is empty: nothing was recorded, or the recorder did not come to write",
        [0x1f, 0x8b, ..] => "it is compressed as a whole; unpack it first with `gunzip`",
        [b'P', b'K', 3, 4, ..] => "it is a ZIP archive; unpack it first with `unzip`",
        _ => {
            "read are ROS 1 .bag (version 2.0), .mcap, .db3, the same compressed with zstd, and folders of rosbag2 and of TUM RGB-D"
        }
    };
    let problem = format!("this is no recording that is read: {hint}");
    Err(RecordingError::Format { path: named.to_owned(), problem })
}

pub(crate) fn open_folder(path: &Path) -> Result<Opened, RecordingError> {
    if path.join("rgb.txt").is_file() {
        return Ok((RecordingFormat::Tum, vec![RecordingFile::Tum(TumFolder::open(path)?)], vec![]));
    }
    let io = |source| RecordingError::Io { path: path.to_owned(), source };
    let mut parts = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io)? {
        let file = entry.map_err(io)?.path();
        if is_part(&file) {
            parts.push(file);
        }
        if parts.len() > MAX_FILES {
            break;
        }
    }
    // recording_2.mcap comes before recording_10.mcap.
    parts.sort_by_key(|part| (part_number(part), part.clone()));
    let mut opened: Option<Opened> = None;
    for part in parts {
        // Where a file lies beside its compressed copy, one of them is enough.
        if plain_name(&part).is_some_and(|plain| plain.is_file()) {
            continue;
        }
        let (format, mut files, mut unpacked) = open_file(&part)?;
        match &mut opened {
            None => opened = Some((format, files, unpacked)),
            Some((first, all, all_unpacked)) if *first == format => {
                all.append(&mut files);
                all_unpacked.append(&mut unpacked);
            }
            Some(_) => {
                let problem = "holds .mcap and .db3 files; name the one that is meant".to_owned();
                return Err(RecordingError::Format { path: path.to_owned(), problem });
            }
        }
    }
    opened.ok_or_else(|| {
        let problem = "the folder holds no .mcap, no .db3 (nor one of them compressed, .zstd) and no rgb.txt; name a recording or its folder".to_owned();
        RecordingError::Format { path: path.to_owned(), problem }
    })
}

/// Whether a folder's file is part of a recording of rosbag2, compressed or not.
fn is_part(path: &Path) -> bool {
    let plain = plain_name(path).unwrap_or_else(|| path.to_owned());
    plain.extension().is_some_and(|ending| ending == "mcap" || ending == "db3")
}

/// The name of a compressed file before it was compressed.
fn plain_name(path: &Path) -> Option<PathBuf> {
    let ending = path.extension()?;
    (ending == "zstd" || ending == "zst").then(|| path.with_extension(""))
}

/// The number after the last underscore, which rosbag2 gives to the files of a split recording.
fn part_number(path: &Path) -> u64 {
    let plain = plain_name(path).unwrap_or_else(|| path.to_owned());
    let stem = plain.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    stem.rsplit('_').next().and_then(|number| number.parse().ok()).unwrap_or(0)
}
