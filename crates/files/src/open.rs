//! Opening files: regular ones only, none larger than its kind may be, none read past that.
//!
//! A name can be a pipe that nobody writes to, a device that never ends, or a file of terabytes without a byte
//! in it.

use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::Path;

/// What a file is opened as; each kind has its largest size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Kind {
    /// `rig.toml`.
    Rig,
    /// A URDF; meshes lie in files of their own.
    RobotDescription,
    /// A run's configuration, or the summary that holds one.
    Configuration,
    /// `postures.csv`.
    Postures,
    /// Targets to compensate.
    Targets,
    /// Joints that were recorded apart.
    JointLog,
    /// `trajectory.txt`.
    Trajectory,
    /// `rgb.txt`, `depth.txt` and `groundtruth.txt` of a TUM folder.
    List,
    /// `summary.json`.
    Summary,
    /// `report_data.json`.
    ReportData,
    /// The manifest of a result folder.
    Manifest,
    /// A colour or depth image, or a mask.
    Image,
    /// A mesh of a robot's link.
    Mesh,
    /// A map: a cloud or a surface.
    Map,
    /// A recording; it is streamed, so its size has no bound.
    Recording,
}

impl Kind {
    /// What a file of the kind is called in messages.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Rig => "rig",
            Kind::RobotDescription => "robot description",
            Kind::Configuration => "configuration",
            Kind::Postures => "table of postures",
            Kind::Targets => "table of targets",
            Kind::JointLog => "table of joints",
            Kind::Trajectory => "trajectory",
            Kind::List => "list of images",
            Kind::Summary => "summary",
            Kind::ReportData => "report data file",
            Kind::Manifest => "manifest",
            Kind::Image => "image",
            Kind::Mesh => "mesh",
            Kind::Map => "map",
            Kind::Recording => "recording",
        }
    }

    /// The largest size that is read, bytes.
    pub fn max_bytes(self) -> u64 {
        match self {
            // Real ones have a few thousand bytes.
            Kind::Rig => 4 << 20,
            Kind::RobotDescription => 16 << 20,
            Kind::Configuration | Kind::Summary => 64 << 20,
            Kind::Postures | Kind::Targets | Kind::ReportData | Kind::Trajectory => 256 << 20,
            Kind::List | Kind::Manifest => 64 << 20,
            Kind::JointLog => 2 << 30,
            Kind::Image | Kind::Mesh => 256 << 20,
            Kind::Map => 8 << 30,
            Kind::Recording => u64::MAX,
        }
    }
}

/// What is at a path that is no regular file.
pub(crate) fn what_it_is(kind: std::fs::FileType) -> &'static str {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        if kind.is_fifo() {
            return "a pipe";
        }
        if kind.is_socket() {
            return "a socket";
        }
        if kind.is_char_device() || kind.is_block_device() {
            return "a device";
        }
    }
    if kind.is_dir() {
        "a folder"
    } else if kind.is_symlink() {
        "a link"
    } else if kind.is_file() {
        "a file"
    } else {
        "no regular file"
    }
}

/// A pipe that the shell opened for this program, as in `<(...)`: a writer is there, so reading it is no wait for
/// nobody.
fn is_handed_over(path: &Path, kind: std::fs::FileType) -> bool {
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        let handed_over = ["/dev/fd", "/proc/self/fd"].iter().any(|folder| path.starts_with(folder));
        (handed_over || path == Path::new("/dev/stdin")) && kind.is_fifo()
    }
    #[cfg(not(unix))]
    {
        let _ = (path, kind);
        false
    }
}

fn open_without_waiting(path: &Path) -> io::Result<File> {
    let mut options = std::fs::OpenOptions::new();
    options.read(true);
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt;
        let flags = rustix::fs::OFlags::NONBLOCK | rustix::fs::OFlags::NOCTTY;
        options.custom_flags(flags.bits() as i32);
    }
    options.open(path)
}

/// Opens a regular file of at most the kind's size. A length of the system may grow after this; whoever reads to the
/// end bounds that too, as [`read`] does.
///
/// # Errors
/// The system's; a message without the path where the file is none, or too large.
pub fn open(path: impl AsRef<Path>, kind: Kind) -> io::Result<File> {
    let path = path.as_ref();
    let refused = |file_type| {
        let problem = format!("is {}; a regular file is expected", what_it_is(file_type));
        io::Error::new(io::ErrorKind::InvalidInput, problem)
    };
    // Asked before it is opened, as the opening of a device alone can do things, and after, as names can change.
    let before = std::fs::metadata(path)?.file_type();
    if is_handed_over(path, before) {
        return File::open(path);
    }
    if !before.is_file() {
        return Err(refused(before));
    }
    let file = open_without_waiting(path)?;
    let metadata = file.metadata()?;
    if !metadata.is_file() {
        return Err(refused(metadata.file_type()));
    }
    if metadata.len() > kind.max_bytes() {
        return Err(too_large(metadata.len(), kind));
    }
    refuse_pointer(file, metadata.len())
}

/// A repository that was cloned without Git LFS has small texts in the places of its large files.
fn refuse_pointer(mut file: File, length: u64) -> io::Result<File> {
    const BEGINNING: &[u8] = b"version https://git-lfs.github.com/spec/";
    const MAX_POINTER: u64 = 1024;
    if !(BEGINNING.len() as u64..=MAX_POINTER).contains(&length) {
        return Ok(file);
    }
    let mut found = [0; BEGINNING.len()];
    let read = file.read_exact(&mut found);
    file.rewind()?;
    match read {
        Ok(()) if found == BEGINNING => {
            let problem = "is a Git LFS pointer and not the file itself; fetch the file with `git lfs pull`";
            Err(io::Error::new(io::ErrorKind::InvalidData, problem))
        }
        _ => Ok(file),
    }
}

fn too_large(bytes: u64, kind: Kind) -> io::Error {
    let problem = format!(
        "has {bytes} bytes; at most {} are read as a {}. Is this the right file?",
        kind.max_bytes(),
        kind.name()
    );
    io::Error::new(io::ErrorKind::FileTooLarge, problem)
}

/// Reads a whole file of the kind.
///
/// # Errors
/// As [`open`], and where the file has more bytes than it said.
pub fn read(path: impl AsRef<Path>, kind: Kind) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let most = kind.max_bytes();
    open(path, kind)?.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(too_large(bytes.len() as u64, kind));
    }
    Ok(bytes)
}

/// Reads a whole text file of the kind.
///
/// # Errors
/// As [`read`], and where the text is not UTF-8.
pub fn read_text(path: impl AsRef<Path>, kind: Kind) -> io::Result<String> {
    String::from_utf8(read(path, kind)?)
        .map_err(|_| io::Error::new(io::ErrorKind::InvalidData, "the text is not UTF-8"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_of_a_fair_size_are_opened() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |path: &Path| read(path, Kind::Rig).unwrap_err().to_string();
        assert!(refused(folder.path()).contains("is a folder"));
        let large = folder.path().join("large");
        File::create(&large).unwrap().set_len(1 << 40).unwrap();
        assert!(refused(&large).contains("1099511627776 bytes") && refused(&large).contains("rig"));
        std::fs::write(&large, b"\xff").unwrap();
        assert_eq!(read(&large, Kind::Rig).unwrap(), b"\xff");
        assert!(read_text(&large, Kind::Rig).unwrap_err().to_string().contains("UTF-8"));
        assert_eq!(read(folder.path().join("gone"), Kind::Rig).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn pointers_of_git_lfs_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bag");
        let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 123456\n";
        std::fs::write(&path, pointer).unwrap();
        for kind in [Kind::Recording, Kind::Image, Kind::Rig] {
            assert!(read(&path, kind).unwrap_err().to_string().contains("git lfs pull"));
        }
        std::fs::write(&path, "version 1 of a text that is no pointer at all, and longer").unwrap();
        assert!(read_text(&path, Kind::Rig).unwrap().starts_with("version 1"));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn pipes_and_devices_neither_block_nor_fill_memory() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
        assert!(read(&pipe, Kind::Rig).unwrap_err().to_string().contains("is a pipe"));
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
        assert!(read(&link, Kind::Rig).unwrap_err().to_string().contains("is a device"));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn what_grows_while_it_is_read_is_bounded() {
        // The files of /proc say that they have no bytes.
        assert!(!read("/proc/self/status", Kind::Rig).unwrap().is_empty());
    }
}
