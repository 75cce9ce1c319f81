//! `manifest.json`: which files a command wrote into a folder, with their sizes and checksums.
//!
//! It distinguishes the files of the result from those that the user put beside them, and notices a folder that is not
//! of one piece: copied in part, or mixed from two runs.

use crate::open::{Kind, open, read_text};
use crate::{OutputError, recover};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{self, Read};
use std::path::Path;

/// The manifest's name.
pub const MANIFEST: &str = "manifest.json";
/// The version of the form.
const FORMAT: u32 = 1;
/// Checksums of larger files are not compared when a folder is read: their size has to do, or every reader would wait.
const MAX_CHECKED_BYTES: u64 = 64 << 20;

/// What `export` may write.
const EXPORTED: &[&str] = &[
    "corrections.csv",
    "parameters.json",
    "static_transform.sh",
    "kinematics.yaml",
    "robot.urdf",
    "robot.urdf.diff",
    "result.mcap",
];

/// What a folder holds; one kind never replaces another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Contents {
    /// A recording as rig, postures and images.
    DataSet,
    /// What `run` and `calibrate` make.
    Result,
    /// What `map` makes.
    Map,
    /// What `export` makes.
    Export,
    /// The report of `reproduce`.
    Reproduction,
}

impl Contents {
    /// Names that the command may write into the folder itself: what else exists under one of them is reported before
    /// the work.
    pub(crate) fn names(self) -> &'static [&'static str] {
        match self {
            Contents::DataSet => &["rig.toml", "postures.csv", "color", "depth", "truth"],
            Contents::Result => &[
                "rig.toml",
                "trajectory.txt",
                "pose_sigmas.csv",
                "covariance.csv",
                "mask.png",
                "map.ply",
                "map_nominal.ply",
                "summary.json",
                "report_data.json",
                "report.html",
            ],
            Contents::Map => &[
                "map.ply",
                "trajectory.txt",
                "mesh.ply",
                "mesh.obj",
                "mesh.glb",
                "cloud.pcd",
                "collision.stl",
                "map.bt",
                "map.ot",
                "esdf.npz",
            ],
            Contents::Export => EXPORTED,
            Contents::Reproduction => &["report.md", "report.json"],
        }
    }

    /// What the folder is called in messages.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Contents::DataSet => "a data set",
            Contents::Result => "the result of a calibration",
            Contents::Map => "a map",
            Contents::Export => "an export",
            Contents::Reproduction => "a reproduction",
        }
    }
}

/// A file of a manifest.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Entry {
    /// Bytes.
    pub bytes: u64,
    /// CRC-32 (ISO 3309) in hexadecimal digits; `None` for a page that can be made again of the other files.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crc32: Option<String>,
}

/// What a command wrote.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of the form.
    pub skclam_manifest: u32,
    /// What the folder holds.
    pub contents: Contents,
    /// Every file but the manifest itself, by its path in the folder with `/` between parts.
    pub files: BTreeMap<String, Entry>,
}

/// CRC-32 and length of a file.
fn checksum(path: &Path) -> io::Result<(u64, String)> {
    let mut file = open(path, Kind::Recording)?;
    let mut hasher = crc32fast::Hasher::new();
    let mut buffer = vec![0; 1 << 16];
    let mut bytes = 0;
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok((bytes, format!("{:08x}", hasher.finalize()))),
            count => {
                hasher.update(&buffer[..count]);
                bytes += count as u64;
            }
        }
    }
}

impl Manifest {
    /// Of files that lie in `folder`; `derived` names those that can be made again and have no checksum.
    pub(crate) fn of(folder: &Path, contents: Contents, files: &[String], derived: &[&str]) -> io::Result<Self> {
        let mut entries = BTreeMap::new();
        for name in files {
            let (bytes, crc32) = checksum(&folder.join(name))?;
            let crc32 = (!derived.contains(&name.as_str())).then_some(crc32);
            entries.insert(name.clone(), Entry { bytes, crc32 });
        }
        Ok(Manifest { skclam_manifest: FORMAT, contents, files: entries })
    }

    /// The manifest of a folder; `None` where there is none of this program.
    ///
    /// # Errors
    /// Where a file of that name cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Manifest>, OutputError> {
        let path = folder.join(MANIFEST);
        let text = match read_text(&path, Kind::Manifest) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(OutputError::io(path, error)),
        };
        // Another program's manifest.json is a file like any other.
        let manifest: Option<Manifest> = serde_json::from_str(&text).ok();
        // Names that lead elsewhere would be moved and removed there.
        Ok(manifest.filter(|manifest| {
            manifest.skclam_manifest == FORMAT
                && manifest.files.keys().all(|name| crate::is_inside(Path::new(name)) && name != MANIFEST)
        }))
    }

    pub(crate) fn to_json(&self) -> Result<String, OutputError> {
        serde_json::to_string_pretty(self).map_err(|error| OutputError::new(MANIFEST, error.to_string()))
    }

    /// Whether a path in the folder is the manifest's: one of its files, the manifest, or a folder on the way to one.
    pub(crate) fn owns(&self, name: &str) -> bool {
        let below = format!("{name}/");
        name == MANIFEST
            || self.files.contains_key(name)
            || self.files.range(below.clone()..).next().is_some_and(|(file, _)| file.starts_with(&below))
    }
}

/// Finishes what an interrupted command left in a folder, and asks whether its files are those of one run. `None`
/// where there is no manifest: the folder of another version or another program.
///
/// Files that are gone are no mixture; whoever needs one will miss it.
///
/// # Errors
/// Where a file is not the one that the manifest names, or an interrupted replacement cannot be finished.
pub fn verify(folder: &Path) -> Result<Option<Manifest>, OutputError> {
    recover(folder)?;
    let Some(manifest) = Manifest::read(folder)? else { return Ok(None) };
    for (name, entry) in &manifest.files {
        let path = folder.join(name);
        let length = match std::fs::symlink_metadata(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => return Err(OutputError::io(path, error)),
            Ok(metadata) if !metadata.is_file() => return Err(mixed(folder, name, "is no regular file any more")),
            Ok(metadata) => metadata.len(),
        };
        let Some(expected) = &entry.crc32 else { continue };
        let differs = length != entry.bytes
            || (length <= MAX_CHECKED_BYTES
                && checksum(&path).map_err(|error| OutputError::io(&path, error))?.1 != *expected);
        if differs {
            return Err(mixed(folder, name, "is not the file that was written with the others (manifest.json)"));
        }
    }
    Ok(Some(manifest))
}

fn mixed(folder: &Path, name: &str, why: &str) -> OutputError {
    let problem = format!(
        "the folder is not of one piece: {name} {why}; run the command again, or name the single file if it was changed on purpose"
    );
    OutputError::new(folder, problem)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("sub")).unwrap();
        for name in ["a.txt", "sub/b.txt", "page.html"] {
            std::fs::write(folder.path().join(name), name).unwrap();
        }
        let names = ["a.txt", "sub/b.txt", "page.html"].map(str::to_owned);
        let manifest = Manifest::of(folder.path(), Contents::Result, &names, &["page.html"]).unwrap();
        std::fs::write(folder.path().join(MANIFEST), manifest.to_json().unwrap()).unwrap();
        folder
    }

    #[test]
    fn a_mixed_folder_is_noticed_and_a_changed_page_or_a_missing_file_is_none() {
        let folder = folder();
        let manifest = verify(folder.path()).unwrap().unwrap();
        assert!(manifest.owns("sub") && manifest.owns("sub/b.txt") && !manifest.owns("su") && !manifest.owns("sub/c"));
        std::fs::write(folder.path().join("page.html"), "another").unwrap();
        std::fs::remove_file(folder.path().join("a.txt")).unwrap();
        verify(folder.path()).unwrap();
        std::fs::write(folder.path().join("sub/b.txt"), "sub/c.txt").unwrap();
        let message = verify(folder.path()).unwrap_err().to_string();
        assert!(message.contains("not of one piece") && message.contains("sub/b.txt"), "{message}");
    }

    #[test]
    fn a_manifest_that_leads_elsewhere_or_is_none_is_rejected() {
        let folder = folder();
        let path = folder.path().join(MANIFEST);
        let text = std::fs::read_to_string(&path).unwrap();
        for other in
            ["{}".to_owned(), "no json".to_owned(), text.replace("a.txt", "../a.txt"), text.replace("1,", "2,")]
        {
            std::fs::write(&path, &other).unwrap();
            assert_eq!(Manifest::read(folder.path()).unwrap(), None, "{other}");
        }
    }
}
