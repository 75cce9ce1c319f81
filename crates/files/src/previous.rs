//! The earlier result, kept once.

use crate::{staging, tree};
use std::fs;
use std::io;
use std::path::Path;

/// Keeps `earlier` as `previous` of the destination `name`; the one that was kept before is removed. Can be repeated
/// at any point.
///
/// The one before gets a marker and a hidden name first, so that no half of it is ever taken for a result.
pub(crate) fn keep(earlier: &Path, previous: &Path, name: &str) -> io::Result<()> {
    if tree::exists(previous) {
        let doomed = previous.with_file_name(staging::new_name(name));
        let _ = fs::write(previous.join(staging::MARKER), "");
        fs::rename(previous, &doomed)?;
        fs::rename(earlier, previous)?;
        return tree::remove(&doomed, None);
    }
    fs::rename(earlier, previous)
}
