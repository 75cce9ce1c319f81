//! Where results will go, asked before any work is done: what cannot be replaced in the end is refused in the
//! beginning.

use crate::manifest::{Contents, MANIFEST, Manifest};
use crate::open::what_it_is;
use crate::{OutputError, recover, staging, tree};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// Disk space that is asked for before the work begins; how much will be needed nobody knows yet.
#[cfg(unix)]
const MIN_FREE_BYTES: u64 = 1 << 20;

/// How a staged folder becomes the destination.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Way {
    /// By one rename: nothing is there, or an empty folder.
    Rename,
    /// By the exchange of two folders: an earlier result is there.
    Exchange,
    /// File by file with a journal: the folder itself has to stay, or is more than a result.
    InPlace,
}

/// A destination.
#[derive(Debug)]
pub(crate) struct Place {
    /// As the user named it.
    pub shown: PathBuf,
    /// Without links.
    pub real: PathBuf,
    pub way: Way,
    /// Staging and the earlier result lie inside the destination, not beside it.
    pub is_inside: bool,
    /// What an earlier command wrote there.
    pub old: Option<Manifest>,
    /// Folders above that were made, deepest first.
    pub made_parents: Vec<PathBuf>,
}

impl Place {
    /// Looks at a destination for results of the kind; finishes what an interrupted command left there.
    pub fn of(shown: &Path, contents: Contents) -> Result<Place, OutputError> {
        let (real, made_parents) = resolved(shown)?;
        let mut place =
            Place { shown: shown.to_owned(), real, way: Way::Rename, is_inside: false, old: None, made_parents };
        if let Err(error) = place.look(contents) {
            staging::remove_made(&place.made_parents);
            return Err(error);
        }
        Ok(place)
    }

    fn look(&mut self, contents: Contents) -> Result<(), OutputError> {
        if tree::exists(&self.real) {
            recover(&self.real)?;
            self.look_at_folder(contents)?;
        }
        let folder = self.workshop().to_owned();
        enough_room(&folder, &self.shown)
    }

    fn look_at_folder(&mut self, contents: Contents) -> Result<(), OutputError> {
        let io = |error| OutputError::io(&self.shown, error);
        let old = Manifest::read(&self.real)?;
        let mut strangers = Vec::new();
        let mut strange_folder = false;
        for entry in fs::read_dir(&self.real).map_err(io)? {
            let entry = entry.map_err(io)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if staging::is_ours(&name) || old.as_ref().is_some_and(|old| old.owns(&name)) {
                continue;
            }
            strange_folder |= entry.file_type().map_err(io)?.is_dir();
            strangers.push(name);
        }
        self.refuse_what_is_no_result(contents, old.as_ref(), &strangers)?;
        self.is_inside = has_to_stay(&self.real);
        let is_empty = old.is_none() && strangers.is_empty();
        self.way = match (self.is_inside, is_empty, &old) {
            (false, true, _) => Way::Rename,
            (false, false, Some(_)) if !strange_folder => Way::Exchange,
            _ => Way::InPlace,
        };
        self.old = old;
        self.previous_can_be_kept()
    }

    fn refuse_what_is_no_result(
        &self,
        contents: Contents,
        old: Option<&Manifest>,
        strangers: &[String],
    ) -> Result<(), OutputError> {
        let refuse = |problem: String| Err(OutputError::new(&self.shown, problem));
        if let Some(old) = old {
            if old.contents != contents {
                let (holds, new) = (old.contents.name(), contents.name());
                return refuse(format!("holds {holds}, which {new} would replace; name another folder"));
            }
            for name in old.files.keys() {
                let Ok(metadata) = self.real.join(name).symlink_metadata() else { continue };
                if !metadata.is_file() {
                    let what = what_it_is(metadata.file_type());
                    return refuse(format!("{name} in it is {what} now, which is not replaced; move it away"));
                }
            }
        }
        let in_the_way = |name: &&str| strangers.iter().any(|stranger| stranger == name);
        match contents.names().iter().copied().chain([MANIFEST]).find(in_the_way) {
            None => Ok(()),
            Some("postures.csv" | "rig.toml") if self.real.join("postures.csv").exists() => refuse(
                "holds a data set (postures.csv), whose rig.toml would be replaced; name another folder".to_owned(),
            ),
            Some(name) => refuse(format!(
                "{name} in it is not known to be of an earlier command ({MANIFEST}), and is not replaced; name another folder, or move it away"
            )),
        }
    }

    /// The folder in which staging and earlier result lie.
    pub fn workshop(&self) -> &Path {
        match self.is_inside {
            true => &self.real,
            false => self.real.parent().unwrap_or(&self.real),
        }
    }

    /// The destination's name, or one for it.
    pub fn name(&self) -> String {
        name_of(&self.real)
    }

    fn previous_can_be_kept(&self) -> Result<(), OutputError> {
        let previous = self.workshop().join(previous_name(&self.real, self.is_inside));
        if self.old.is_none() || !tree::exists(&previous) {
            return Ok(());
        }
        let refuse = |holds: String| {
            let problem = format!("is where the earlier result is kept, and {holds}; move it away");
            Err(OutputError::new(&previous, problem))
        };
        match previous.symlink_metadata() {
            Ok(metadata) if metadata.is_dir() => {}
            _ => return refuse("no folder is there".to_owned()),
        }
        let Some(manifest) = Manifest::read(&previous)? else {
            return refuse("holds no result".to_owned());
        };
        let files = tree::files(&previous).map_err(|error| OutputError::io(&previous, error))?;
        match files.iter().find(|file| !manifest.owns(file)) {
            None => Ok(()),
            Some(file) => refuse(format!("holds a file of another origin ({file})")),
        }
    }
}

pub(crate) fn name_of(real: &Path) -> String {
    real.file_name().map_or_else(|| "results".into(), |name| name.to_string_lossy().into_owned())
}

/// The name under which the earlier result is kept.
pub(crate) fn previous_name(real: &Path, is_inside: bool) -> String {
    if is_inside { "previous".to_owned() } else { format!("{}.previous", name_of(real)) }
}

/// Follows links and makes the folders above; those that were made, deepest first.
fn resolved(shown: &Path) -> Result<(PathBuf, Vec<PathBuf>), OutputError> {
    let io = |error| OutputError::io(shown, error);
    match shown.symlink_metadata() {
        Ok(metadata) => {
            let real = match shown.canonicalize() {
                Err(error) if metadata.is_symlink() && error.kind() == io::ErrorKind::NotFound => {
                    return Err(OutputError::new(
                        shown,
                        "is a link to what does not exist; name a folder for the results",
                    ));
                }
                other => other.map_err(io)?,
            };
            let file_type = real.metadata().map_err(io)?.file_type();
            if !file_type.is_dir() {
                let problem = format!("is {}; name a folder for the results", what_it_is(file_type));
                return Err(OutputError::new(shown, problem));
            }
            Ok((real, Vec::new()))
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let name = shown.file_name().ok_or_else(|| OutputError::new(shown, "name a folder for the results"))?;
            let (parent, made) = parents(shown)?;
            Ok((parent.join(name), made))
        }
        Err(error) => Err(io(error)),
    }
}

/// The folder above a path, made where it is not there, without links; and what was made, deepest first.
pub(crate) fn parents(shown: &Path) -> Result<(PathBuf, Vec<PathBuf>), OutputError> {
    let parent = shown.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let missing: Vec<PathBuf> = parent
        .ancestors()
        .take_while(|above| !above.as_os_str().is_empty() && !tree::exists(above))
        .map(Path::to_owned)
        .collect();
    let made = if missing.is_empty() { Ok(()) } else { fs::create_dir_all(parent) };
    match made.and_then(|()| parent.canonicalize()) {
        Ok(real) if real.is_dir() => Ok((real, missing)),
        Ok(_) => Err(OutputError::io(shown, io::ErrorKind::NotADirectory.into())),
        Err(error) => {
            staging::remove_made(&missing);
            Err(OutputError::io(shown, error))
        }
    }
}

/// Whether a folder cannot be renamed, or should not be: a mount point, the folder that somebody works in, another's,
/// or one in a folder that cannot be written to.
#[cfg(unix)]
fn has_to_stay(real: &Path) -> bool {
    use rustix::fs::Access;
    use std::os::unix::fs::MetadataExt;
    let Some(parent) = real.parent() else { return true };
    let (Ok(folder), Ok(above)) = (real.metadata(), parent.metadata()) else { return true };
    let someone = rustix::process::geteuid().as_raw();
    // In a sticky folder only the owner may rename.
    let sticky = above.mode() & 0o1000 != 0 && someone != 0 && ![folder.uid(), above.uid()].contains(&someone);
    // A new folder in its place would be ours.
    let of_another = folder.uid() != someone;
    let is_here = std::env::current_dir().is_ok_and(|here| here.starts_with(real));
    sticky
        || of_another
        || is_here
        || is_mount_point(real)
        || folder.dev() != above.dev()
        || rustix::fs::access(parent, Access::WRITE_OK | Access::EXEC_OK).is_err()
}

#[cfg(not(unix))]
fn has_to_stay(real: &Path) -> bool {
    real.parent().is_none() || std::env::current_dir().is_ok_and(|here| here.starts_with(real))
}

/// Also where the same file system is mounted a second time.
#[cfg(target_os = "linux")]
pub(crate) fn is_mount_point(path: &Path) -> bool {
    use rustix::fs::{AtFlags, CWD, StatxAttributes, StatxFlags};
    rustix::fs::statx(CWD, path, AtFlags::SYMLINK_NOFOLLOW, StatxFlags::BASIC_STATS)
        .is_ok_and(|stat| stat.stx_attributes.contains(StatxAttributes::MOUNT_ROOT))
}

#[cfg(all(unix, not(target_os = "linux")))]
pub(crate) fn is_mount_point(_: &Path) -> bool {
    false
}

#[cfg(unix)]
fn enough_room(folder: &Path, shown: &Path) -> Result<(), OutputError> {
    use rustix::fs::Access;
    rustix::fs::access(folder, Access::WRITE_OK | Access::EXEC_OK)
        .map_err(|error| OutputError::io(shown, error.into()))?;
    // A file system that does not say is asked by writing.
    let Ok(stat) = rustix::fs::statvfs(folder) else { return Ok(()) };
    let free = stat.f_bavail.saturating_mul(stat.f_frsize);
    if free < MIN_FREE_BYTES {
        let problem = format!("only {free} bytes are free there; free some space, or name another folder");
        return Err(OutputError::new(shown, problem));
    }
    Ok(())
}

#[cfg(not(unix))]
fn enough_room(_: &Path, _: &Path) -> Result<(), OutputError> {
    Ok(())
}
