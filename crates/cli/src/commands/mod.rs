//! One file a command.

pub mod compensate;
pub mod evaluate;
pub mod export;
pub mod import;
pub mod inspect;
pub mod map;
pub mod render;
pub mod report;
pub mod reproduce;
pub mod run;
pub mod simulate;
pub mod validate;
mod validate_points;

use anyhow::Result;
use skclam::rig::Rig;
use std::path::Path;

/// The rig of a result folder that is of one piece, or a rig file by itself.
pub fn rig_of(path: &Path) -> Result<Rig> {
    if !path.is_dir() {
        return Ok(Rig::read(path)?);
    }
    skclam_files::verify(path)?;
    Ok(Rig::read(path.join("rig.toml"))?)
}
