//! The rows of `misspecification`: one recording of a virtual cell, and what is made wrong in it.
//!
//! Images stay as they were rendered; rig, postures and depth images around them are changed, so that one rendering
//! serves all rows. Where an arm or a camera behaves otherwise (sag, gears, a slip), the joint values are changed so
//! that such an arm would have taken these very images.

mod depths;
mod postures;
mod rigs;

use crate::causes::Cause;
use crate::cells::Cell;
use crate::true_poses::TruePoses;
use anyhow::{Context, Result};
use skclam::dataset::{Dataset, PostureRecord, write_depth_png, write_postures};
use skclam::geometry::DepthImage;
use skclam::output::{Contents, StagedFolder};
use skclam::rig::{Posture, PostureState, Rig};
use std::path::Path;

/// Postures of a row that does not say otherwise.
pub const POSTURES: usize = 48;
/// Postures that are rendered.
pub const RENDERED_POSTURES: usize = 60;

/// One row.
#[derive(Debug, Clone, Copy)]
pub struct Row {
    /// For the table and for `--only`.
    pub name: &'static str,
    /// Causes of which the program should name one first; empty where nothing needs a name.
    pub expected: &'static [Cause],
    /// Makes it of a cell with [`RENDERED_POSTURES`].
    pub make: fn(&Cell) -> Result<Variant>,
}

/// A recording with something wrong.
#[derive(Debug, Clone)]
pub struct Variant {
    /// The nominal rig that the run is given.
    pub rig: Rig,
    /// The table that it is given.
    pub records: Vec<PostureRecord>,
    /// What a right answer says at these postures.
    pub truth: TruePoses,
    /// Depths that were measured as a function of those that were rendered, metres.
    pub depth: Option<fn(f64) -> f64>,
}

impl Variant {
    /// The recording of a cell as it is, or its beginning.
    ///
    /// # Errors
    /// Postures that do not belong to the rig.
    pub fn unchanged(cell: &Cell, postures: usize) -> Result<Self> {
        let records = cell.dataset.records.iter().take(postures).cloned().collect();
        Variant::of_records(cell, records)
    }

    fn of_records(cell: &Cell, records: Vec<PostureRecord>) -> Result<Self> {
        let postures: Vec<Posture> = records.iter().map(|record| record.posture.clone()).collect();
        let truth = TruePoses::of_rig(&cell.truth, &postures)?;
        Ok(Variant { rig: cell.dataset.rig.clone(), records, truth, depth: None })
    }

    /// Writes the data set and opens it. Images are the cell's own; depth images that change are written anew.
    ///
    /// # Errors
    /// Files that cannot be read or written, and what the program refuses of the data set.
    pub fn write(&self, cell: &Cell, folder: &Path) -> Result<Dataset> {
        let staged = StagedFolder::new(folder, Contents::DataSet)?;
        for record in &self.records {
            same_image(cell, &record.color, &staged)?;
            match (&record.depth, self.depth) {
                (Some(depth), None) => same_image(cell, depth, &staged)?,
                (Some(depth), Some(change)) => change_depth(cell, depth, change, &staged)?,
                (None, _) => {}
            }
        }
        let robot = cell.dataset.rig.robot.as_ref().context("a cell has an arm")?;
        let kinds: Vec<_> = robot.joints().iter().map(|joint| joint.kind).collect();
        staged.write("rig.toml", self.rig.to_toml()?)?;
        staged.write("postures.csv", write_postures(&self.records, &kinds)?)?;
        Ok(Dataset::open(staged.publish()?)?)
    }
}

/// An image of the cell under its name in the new folder, without a copy where the file system can: a data set names no
/// files outside of it.
fn same_image(cell: &Cell, file: &Path, staged: &StagedFolder) -> Result<()> {
    let (from, to) = (cell.dataset.path_of(file), staged.path(file)?);
    if !to.exists() && std::fs::hard_link(&from, &to).is_err() {
        std::fs::copy(&from, &to)?;
    }
    Ok(())
}

fn change_depth(cell: &Cell, file: &Path, change: fn(f64) -> f64, staged: &StagedFolder) -> Result<()> {
    let at = cell.dataset.records.iter().position(|record| record.depth.as_deref() == Some(file));
    let image = cell.dataset.depth(at.context("a depth image of the cell")?)?.context("a depth image")?;
    let changed = image.as_slice().iter().map(|&z| if z > 0.0 { change(f64::from(z)) as f32 } else { 0.0 });
    let changed = DepthImage::new(image.width(), image.height(), changed.collect())?;
    let camera = cell.dataset.rig.depth.as_ref().context("a depth camera")?;
    write_depth_png(&staged.path(file)?, &changed, camera.unit_m)?;
    Ok(())
}

/// Joint values of a posture; empty for a flange pose.
fn joints(posture: &Posture) -> &[f64] {
    match &posture.state {
        PostureState::Joints(values) => values,
        PostureState::FlangePose(_) => &[],
    }
}

/// All rows in the order of the table.
pub fn all() -> Vec<Row> {
    let few = &[Cause::FewPostures];
    let mut rows = vec![Row { name: "clean", expected: &[], make: |cell| Variant::unchanged(cell, POSTURES) }];
    rows.extend(postures::rows());
    rows.extend(rigs::rows());
    rows.extend(depths::rows());
    rows.extend([
        Row { name: "6 postures", expected: few, make: |cell| Variant::unchanged(cell, 6) },
        Row { name: "10 postures", expected: few, make: |cell| Variant::unchanged(cell, 10) },
        Row { name: "15 postures", expected: few, make: |cell| Variant::unchanged(cell, 15) },
        Row { name: "30 postures", expected: &[], make: |cell| Variant::unchanged(cell, 30) },
        Row { name: "60 postures", expected: &[], make: |cell| Variant::unchanged(cell, RENDERED_POSTURES) },
    ]);
    rows
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam::dataset::Folder;
    use skclam::rig::builtin_rig;
    use skclam::simulation::{PerturbationSigmas, perturb_random};
    use std::sync::Arc;

    /// A cell without images: a walk of 60 postures.
    fn cell() -> Cell {
        let nominal = builtin_rig("hp3j").unwrap().unwrap();
        let truth = perturb_random(&nominal, 3, &PerturbationSigmas::default()).unwrap();
        let records = (0..RENDERED_POSTURES).map(|at| {
            let phase = at as f64;
            let values = [0.3, 0.4, 0.5, 0.7, 0.9, 1.1].map(|rate| (rate * phase).sin() - 0.2).to_vec();
            let posture = Posture::new(at as u64, PostureState::Joints(values)).at(Some(phase));
            PostureRecord { posture, color: format!("{at}.jpg").into(), depth: Some(format!("{at}.png").into()) }
        });
        let mut records: Vec<PostureRecord> = records.collect();
        skclam::rig::fill_joint_rates(records.iter_mut().map(|record| &mut record.posture));
        let dataset = Dataset::from_source(nominal, records, Arc::new(Folder(".".into()))).unwrap();
        Cell { dataset, truth }
    }

    #[test]
    fn every_row_but_clean_and_the_counts_changes_something_and_names_are_unique() {
        let cell = cell();
        let clean = Variant::unchanged(&cell, POSTURES).unwrap();
        let rows = all();
        for (at, row) in rows.iter().enumerate() {
            assert!(rows[..at].iter().all(|other| other.name != row.name), "{}", row.name);
            let made = (row.make)(&cell).unwrap_or_else(|error| panic!("{}: {error:#}", row.name));
            assert_eq!(made.truth.postures.len(), made.truth.cameras.len(), "{}", row.name);
            let same = made.rig == clean.rig && made.records == clean.records && made.depth.is_none();
            assert_eq!(same, row.name == "clean", "{}", row.name);
        }
    }

    #[test]
    fn an_arm_that_behaves_otherwise_would_have_taken_these_images() {
        let cell = cell();
        for name in ["sag 0.1 deg", "gears sin 2q 0.1 deg", "slip 0.2 deg half way"] {
            let row = all().into_iter().find(|row| row.name == name).unwrap();
            let made = (row.make)(&cell).unwrap();
            // The true rig without that behaviour is not quite right any more, and not far off.
            let error = made.truth.error_of(&cell.truth).unwrap();
            assert!(error.deg > 0.01 && error.deg < 0.6, "{name}: {error:?}");
        }
    }
}
