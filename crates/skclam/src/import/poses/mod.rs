//! A folder of images and a table of the controller's poses become a dataset.

mod notation;
mod table;

pub use notation::PoseNotation;
pub use table::PoseTableOptions;

use super::{ImportError, ImportSummary};
use crate::dataset::PostureRecord;
use crate::output::StagedFolder;
use skclam_recordings::Selection;
use skclam_rig::{Posture, PostureState, Rig};
use std::path::{Path, PathBuf};
use table::{PoseLine, read_poses};

/// Endings of the names of images.
const IMAGES: [&str; 10] = ["png", "jpg", "jpeg", "pgm", "ppm", "pnm", "bmp", "tif", "tiff", "webp"];

/// Imports a folder with images and a table of poses (the only `.csv` in it, or `table`) into a folder that the caller
/// publishes. Images are named in the column `color` (or `image`, `file`) and `depth`, or are taken in the order of their
/// names from `color/` and `depth/`, or from the folder itself. The cameras are those of `rig`.
///
/// # Errors
/// [`ImportError`]: no table or more than one, a table that is not well formed, another number of images than of lines.
pub fn import_poses(
    folder: &Path,
    table: Option<&Path>,
    rig: &Rig,
    options: PoseTableOptions,
    staged: &StagedFolder,
) -> Result<ImportSummary, ImportError> {
    let table = match table {
        Some(path) => path.to_owned(),
        None => only_table(folder)?,
    };
    let lines = read_poses(&table, options)?;
    if lines.len() < 2 {
        let reason = format!("{} has one line of values", table.display());
        return Err(ImportError::TooFewPostures { got: lines.len(), reason });
    }
    let colors = images_of(folder, "color", &table, &lines, |line| line.color.as_deref())?.ok_or_else(|| {
        ImportError::Poses {
            path: table.clone(),
            line: 1,
            problem: format!("there is no column color, and {} has no images", folder.display()),
        }
    })?;
    let depths = match &rig.depth {
        Some(_) => images_of(folder, "depth", &table, &lines, |line| line.depth.as_deref())?,
        None => None,
    };
    let rig = Rig { depth: rig.depth.filter(|_| depths.is_some()), ..rig.clone() };
    let mut records = Vec::with_capacity(lines.len());
    for (index, line) in lines.iter().enumerate() {
        let color = copy(folder, &colors[index], "color", index, staged)?;
        let depth = depths.as_ref().map(|depths| copy(folder, &depths[index], "depth", index, staged)).transpose()?;
        let state = PostureState::FlangePose(line.base_from_flange);
        records.push(PostureRecord { posture: Posture::new(index as u64, state).at(line.timestamp_s), color, depth });
    }
    staged.write("postures.csv", crate::dataset::write_postures(&records, &[])?)?;
    staged.write("rig.toml", rig.to_toml()?)?;
    let mut warnings = Vec::new();
    if depths.is_none() {
        warnings.push("there are no depth images: no map can be made, and scale comes from the poses alone".to_owned());
    }
    Ok(ImportSummary {
        postures: records.len(),
        selection: Selection::Snapshots,
        color_topic: folder.display().to_string(),
        depth_topic: depths.as_ref().map(|_| folder.join("depth").display().to_string()),
        joint_topic: table.display().to_string(),
        color_images: records.len(),
        moving: 0,
        without_depth: 0,
        warnings,
    })
}

fn names_in(folder: &Path, is_wanted: impl Fn(&str) -> bool) -> Result<Vec<String>, ImportError> {
    const MAX_FILES: usize = 1 << 20;
    let io = |source| ImportError::Io { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)?.take(MAX_FILES) {
        let entry = entry.map_err(io)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        let ending = name.rsplit_once('.').map(|(_, ending)| ending.to_ascii_lowercase()).unwrap_or_default();
        if is_wanted(&ending) && entry.path().is_file() {
            names.push(name);
        }
    }
    // 2.png comes before 10.png.
    names.sort_by_key(|name| (number_in(name), name.clone()));
    Ok(names)
}

fn number_in(name: &str) -> Option<u64> {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let digits: String = stem.chars().rev().take_while(char::is_ascii_digit).collect();
    digits.chars().rev().collect::<String>().parse().ok()
}

fn only_table(folder: &Path) -> Result<PathBuf, ImportError> {
    let names = names_in(folder, |ending| ending == "csv")?;
    match names.as_slice() {
        [only] => Ok(folder.join(only)),
        [] => Err(ImportError::NoJoints {
            problem: format!("{} has no .csv with the poses; name it with --pose-table", folder.display()),
        }),
        several => Err(ImportError::NoJoints {
            problem: format!(
                "{} has {}; name the one with the poses with --pose-table",
                folder.display(),
                several.join(", ")
            ),
        }),
    }
}

/// The images of all lines, relative to the folder: those that the table names, or all there are, in order.
fn images_of(
    folder: &Path,
    kind: &str,
    table: &Path,
    lines: &[PoseLine],
    named: impl Fn(&PoseLine) -> Option<&str>,
) -> Result<Option<Vec<PathBuf>>, ImportError> {
    let wrong = |line: u64, problem: String| ImportError::Poses { path: table.to_owned(), line, problem };
    if lines.iter().any(|line| named(line).is_some()) {
        let names = lines.iter().enumerate().map(|(index, line)| {
            let name = named(line).ok_or_else(|| wrong(index as u64 + 2, format!("there is no {kind} image")))?;
            let beside = [PathBuf::from(name), Path::new(kind).join(name)];
            beside.into_iter().find(|path| folder.join(path).is_file()).ok_or_else(|| {
                wrong(index as u64 + 2, format!("the {kind} image {name} is not in {}", folder.display()))
            })
        });
        return names.collect::<Result<Vec<_>, _>>().map(Some);
    }
    let inside = folder.join(kind);
    let (place, under) = match (inside.is_dir(), kind) {
        (true, _) => (inside, PathBuf::from(kind)),
        (false, "color") => (folder.to_owned(), PathBuf::new()),
        (false, _) => return Ok(None),
    };
    let names = names_in(&place, |ending| IMAGES.contains(&ending))?;
    if names.is_empty() {
        return Ok(None);
    }
    if names.len() != lines.len() {
        let problem = format!(
            "there are {} poses, but {} images in {}; name the image of each line in a column {kind}",
            lines.len(),
            names.len(),
            place.display()
        );
        return Err(wrong(1, problem));
    }
    Ok(Some(names.into_iter().map(|name| under.join(name)).collect()))
}

/// Copies an image under the number of its posture.
fn copy(folder: &Path, name: &Path, kind: &str, index: usize, staged: &StagedFolder) -> Result<PathBuf, ImportError> {
    let io = |source| ImportError::Io { path: folder.join(name), source };
    let bytes = skclam_files::inside(folder, name)
        .and_then(|path| skclam_files::read(path, skclam_files::Kind::Image))
        .map_err(io)?;
    let ending = name.extension().map(|ending| ending.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let file = format!("{kind}/{index:03}.{ending}");
    staged.write(&file, bytes)?;
    Ok(PathBuf::from(file))
}

#[cfg(test)]
mod tests;
