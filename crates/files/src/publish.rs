//! From the staged folder to the destination.
//!
//! Where the destination is new that is one rename. Where there is an earlier result, the two folders change places in
//! one step, and what follows only tidies up: files that were never this program's go over to the new folder, the
//! earlier result becomes `NAME.previous`. Where the folder itself has to stay (a mount point, somebody's working
//! folder) or the system cannot exchange, files are moved one by one under a journal, which
//! [`recover`](crate::recover) carries to its end.
//!
//! Names in journals, markers and manifests may come with a folder from anywhere: each is checked to stay within the
//! folder, also by its links, before anything moves.

use crate::manifest::{MANIFEST, Manifest};
use crate::place::{Place, Way, name_of, previous_name};
use crate::{OutputError, previous, staging, tree};
use serde::{Deserialize, Serialize};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

/// The journal of a replacement file by file.
pub(crate) const JOURNAL: &str = ".skclam-journal";

/// What the marker in an exchanged folder says: the clean-up that is left to do.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct AfterExchange {
    /// The folder beside it that holds the earlier result now.
    pub earlier: String,
}

/// A replacement file by file.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Journal {
    /// The folder of the new files; `staging` with `.old` behind it takes the old ones.
    pub staging: String,
    /// Whether it lies in the destination or beside it.
    pub is_inside: bool,
    /// Files of the earlier result.
    pub old: Vec<String>,
    /// Files of the new one, the manifest last.
    pub new: Vec<String>,
}

/// Puts a complete staged folder in its place. After an error everything is as it was, unless the error says that a
/// journal is left.
pub(crate) fn publish(place: &Place, staged: &Path, files: &[String]) -> Result<(), OutputError> {
    let io = |error| OutputError::io(&place.shown, error);
    // Somebody else may have made it in the meantime: a rename would replace an empty folder alone.
    if place.way == Way::Rename {
        fs::rename(staged, &place.real).map_err(io)?;
        // The result is in place; what is left is for recover().
        let _ = tidy(&place.real);
        return Ok(());
    }
    let _lock = staging::lock(&place.real, &place.shown)?;
    if place.way == Way::Exchange && exchange(place, staged)? {
        return Ok(());
    }
    in_place(place, staged, files)
}

fn tidy(real: &Path) -> io::Result<()> {
    tree::gone_is_fine(fs::remove_file(real.join(staging::MARKER)))?;
    real.parent().map_or(Ok(()), tree::sync_folder)
}

/// Whether the two folders have changed places; not where the system cannot do that.
fn exchange(place: &Place, staged: &Path) -> Result<bool, OutputError> {
    let io = |error| OutputError::io(&place.shown, error);
    let earlier = staged.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let marker = serde_json::to_string(&AfterExchange { earlier }).map_err(io::Error::from).map_err(io)?;
    fs::write(staged.join(staging::MARKER), marker).map_err(io)?;
    let permissions = place.real.metadata().map_err(io)?.permissions();
    fs::set_permissions(staged, permissions).map_err(io)?;
    if !exchanged(staged, &place.real).map_err(io)? {
        return Ok(false);
    }
    // From here on the new result is in place, whole; a failure below leaves work to the next command and no damage.
    let _ = after_exchange(&place.real);
    Ok(true)
}

/// Lets two folders change places; false where system or file system cannot.
#[cfg(target_os = "linux")]
fn exchanged(a: &Path, b: &Path) -> io::Result<bool> {
    use rustix::fs::{CWD, RenameFlags};
    use rustix::io::Errno;
    match rustix::fs::renameat_with(CWD, a, CWD, b, RenameFlags::EXCHANGE) {
        Ok(()) => Ok(true),
        Err(Errno::INVAL | Errno::NOSYS | Errno::XDEV | Errno::OPNOTSUPP | Errno::BUSY) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

#[cfg(not(target_os = "linux"))]
fn exchanged(_: &Path, _: &Path) -> io::Result<bool> {
    Ok(false)
}

/// Tidies up after an exchange: what was never this program's goes over, the earlier result is kept.
pub(crate) fn after_exchange(real: &Path) -> io::Result<()> {
    let text = match fs::read_to_string(real.join(staging::MARKER)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        other => other?,
    };
    // An empty marker is that of a folder that was renamed.
    let after: AfterExchange = serde_json::from_str(&text).unwrap_or_default();
    if let (Some(parent), true) = (real.parent(), is_staging_of(&after.earlier, real)) {
        let earlier = parent.join(&after.earlier);
        if earlier.symlink_metadata().is_ok_and(|metadata| metadata.is_dir()) {
            carry_over(&earlier, real)?;
            previous::keep(&earlier, &parent.join(previous_name(real, false)), &name_of(real))?;
        }
    }
    tidy(real)
}

/// Whether a name is that of a folder under construction for the destination, and nothing else.
pub(crate) fn is_staging_of(name: &str, real: &Path) -> bool {
    name.starts_with(&staging::prefix(&name_of(real))) && !name.contains(['/', '\\'])
}

/// Moves what the earlier manifest does not know into the new folder. What has a namesake there stays with the
/// earlier result.
fn carry_over(earlier: &Path, real: &Path) -> io::Result<()> {
    let old = Manifest::read(earlier).map_err(|error| io::Error::other(error.to_string()))?;
    let old = old.ok_or_else(|| io::Error::other("the earlier result has no manifest"))?;
    for entry in fs::read_dir(earlier)? {
        let entry = entry?;
        let name = entry.file_name();
        let known = name.to_str().is_some_and(|name| old.owns(name) || staging::is_ours(name));
        let target = real.join(&name);
        if !known && !tree::exists(&target) {
            fs::rename(entry.path(), target)?;
        }
    }
    Ok(())
}

fn in_place(place: &Place, staged: &Path, files: &[String]) -> Result<(), OutputError> {
    let io = |error| OutputError::io(&place.shown, error);
    let mut old: Vec<String> = place.old.iter().flat_map(|old| old.files.keys().cloned()).collect();
    old.extend(place.old.is_some().then(|| MANIFEST.to_owned()));
    let staging = staged.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let journal = Journal { staging, is_inside: place.is_inside, old, new: files.to_vec() };
    journal.is_possible(&place.real).map_err(|problem| OutputError::new(&place.shown, problem))?;
    let path = place.real.join(JOURNAL);
    let beginning = place.real.join(format!("{JOURNAL}.new"));
    let written = serde_json::to_string(&journal)
        .map_err(io::Error::from)
        .and_then(|text| fs::write(&beginning, text))
        .and_then(|()| fs::File::open(&beginning)?.sync_all())
        .and_then(|()| fs::rename(&beginning, &path));
    if let Err(error) = written {
        // It may not be there.
        let _ = fs::remove_file(&beginning);
        return Err(io(error));
    }
    if let Err(error) = journal.forward(&place.real) {
        let failed = io(error);
        return Err(match journal.backward(&place.real).and_then(|()| fs::remove_file(&path)) {
            Ok(()) => failed,
            Err(_) => failed.and("; the folder is half replaced, and the next command that uses it finishes that"),
        });
    }
    // The new result is in place; what is left is for recover().
    let _ = journal.finish(&place.real);
    Ok(())
}

impl Journal {
    /// The folders of the new and of the old files.
    fn staging_folders(&self, real: &Path) -> [PathBuf; 2] {
        let workshop = if self.is_inside { real } else { real.parent().unwrap_or(real) };
        [workshop.join(&self.staging), workshop.join(format!("{}.old", self.staging))]
    }

    /// Whether every name stays where it should: nothing is moved by a journal that came with a strange folder.
    pub fn is_sound(&self, real: &Path) -> bool {
        let [new, old] = self.staging_folders(real);
        is_staging_of(&self.staging, real)
            && self.new.iter().chain(&self.old).all(|name| crate::is_inside(Path::new(name)))
            && self.new.iter().all(|name| no_link_above(&new, name) && no_link_above(real, name))
            && self.old.iter().all(|name| no_link_above(&old, name) && no_link_above(real, name))
    }

    /// Whether each new file has a place: nothing that is not of the earlier result is there.
    fn is_possible(&self, real: &Path) -> Result<(), String> {
        for name in &self.new {
            let known = self.old.contains(name);
            if !no_link_above(real, name) {
                return Err(format!("{name} would be written through a link; name another folder"));
            }
            let is_file = real.join(name).symlink_metadata().map(|metadata| metadata.is_file()).ok();
            if is_file.is_some_and(|is_file| !(known && is_file)) {
                return Err(format!("{name} is there, and is not of an earlier command; name another folder"));
            }
        }
        Ok(())
    }

    /// Moves every old file away, then every new one in. Can be repeated at any point.
    pub fn forward(&self, real: &Path) -> io::Result<()> {
        let [new, old] = self.staging_folders(real);
        // The manifests go first and come last, so that no folder in between has one.
        for name in self.old.iter().rev() {
            let is_placed = self.new.contains(name) && !tree::exists(&new.join(name));
            if !is_placed && tree::exists(&real.join(name)) && !tree::exists(&old.join(name)) {
                tree::move_to(&real.join(name), &old.join(name))?;
            }
        }
        for name in &self.new {
            if tree::exists(&new.join(name)) {
                tree::move_to(&new.join(name), &real.join(name))?;
            }
        }
        tree::sync_folder(real)
    }

    /// Undoes what [`forward`](Self::forward) has done so far.
    fn backward(&self, real: &Path) -> io::Result<()> {
        let [new, old] = self.staging_folders(real);
        for name in self.new.iter().rev() {
            if !tree::exists(&new.join(name)) && tree::exists(&real.join(name)) {
                tree::move_to(&real.join(name), &new.join(name))?;
            }
        }
        for name in &self.old {
            if tree::exists(&old.join(name)) {
                tree::move_to(&old.join(name), &real.join(name))?;
            }
        }
        // Only folders are left in it.
        match tree::exists(&old) && tree::files(&old)?.is_empty() {
            true => tree::remove(&old, None),
            false => Ok(()),
        }
    }

    /// Keeps the earlier result and removes what is no longer needed, the journal last.
    pub fn finish(&self, real: &Path) -> io::Result<()> {
        let [new, old] = self.staging_folders(real);
        // Folders of the earlier result that are empty now.
        for name in &self.old {
            for above in Path::new(name).ancestors().skip(1).filter(|above| !above.as_os_str().is_empty()) {
                let _ = fs::remove_dir(real.join(above));
            }
        }
        if tree::exists(&old) {
            let workshop = if self.is_inside { real } else { real.parent().unwrap_or(real) };
            previous::keep(&old, &workshop.join(previous_name(real, self.is_inside)), &name_of(real))?;
        }
        tree::remove(&new, None)?;
        tree::gone_is_fine(fs::remove_file(real.join(JOURNAL)))
    }
}

/// Whether none of the folders between `root` and the file is a link.
fn no_link_above(root: &Path, name: &str) -> bool {
    Path::new(name)
        .ancestors()
        .skip(1)
        .filter(|above| !above.as_os_str().is_empty())
        .all(|above| !root.join(above).symlink_metadata().is_ok_and(|metadata| metadata.is_symlink()))
}
