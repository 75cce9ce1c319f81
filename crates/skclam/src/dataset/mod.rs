//! A dataset is a rig, postures, and the colour and depth images taken there.
//!
//! Most are folders (`rig.toml`, `postures.csv`, images). Opening one reads the rig and the table and looks at the
//! header of every image, so that what is wrong with a folder is reported before any work is done. Pixels are decoded
//! when they are asked for. [`Dataset::from_frames`] makes one of images in memory, [`Dataset::from_source`] of whatever
//! is a [`FrameSource`].

mod error;
mod frames;
mod images;
mod jpeg;
mod jpeg_blocks;
mod png;
mod postures;
mod self_filter;
mod source;

pub use error::DatasetError;
pub use frames::{DepthCounts, Frame, Frames};
pub use images::write_depth_png;
pub use postures::{PostureRecord, read_postures, write_postures};
pub(crate) use postures::{csv_problem, joint_column};
pub use self_filter::{SelfFilter, SelfFilterOptions};
pub use source::{Folder, FrameSource};

use image::{DynamicImage, GrayImage, ImageFormat, RgbImage};
use skclam_geometry::{DepthImage, PinholeCamera};
use skclam_kinematics::JointKind;
use skclam_rig::{PostureState, Rig};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A recording: nominal rig, postures, images.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Gives the images that records and rig name.
    pub source: Arc<dyn FrameSource>,
    /// The nominal rig.
    pub rig: Rig,
    /// One record a posture, in the order of their indices.
    pub records: Vec<PostureRecord>,
    /// Takes the robot's own body out of the depth images; `None`: they are as they were recorded.
    pub self_filter: Option<SelfFilter>,
}

impl Dataset {
    /// Opens a folder with the rig that lies in it.
    pub fn open(folder: impl AsRef<Path>) -> Result<Dataset, DatasetError> {
        let folder = folder.as_ref();
        let rig_path = folder.join("rig.toml");
        skclam_files::recover(folder)?;
        if !folder.is_dir() {
            return Err(DatasetError::NoFolder { path: folder.to_owned() });
        }
        if !rig_path.exists() {
            return Err(DatasetError::Missing { path: folder.to_owned(), file: "rig.toml" });
        }
        Self::open_with_rig(folder, Rig::read(rig_path)?)
    }

    /// Opens a folder with another rig in place of the one that lies in it.
    pub fn open_with_rig(folder: impl AsRef<Path>, rig: Rig) -> Result<Dataset, DatasetError> {
        let folder = folder.as_ref();
        skclam_files::recover(folder)?;
        let table = folder.join("postures.csv");
        if folder.is_dir() && !table.exists() {
            return Err(DatasetError::Missing { path: folder.to_owned(), file: "postures.csv" });
        }
        let records = read_postures(&table)?;
        let source = Arc::new(Folder(folder.to_owned()));
        let dataset = Dataset { source, rig, records, self_filter: None };
        dataset.check_folder(folder)?;
        Ok(dataset)
    }

    /// A dataset of images in memory. Joint rates are taken from neighbouring postures, as of a table, where no posture
    /// has any. Nothing is written.
    ///
    /// # Errors
    /// Fewer than two postures, indices that do not rise, postures that do not fit the rig, numbers that are not finite,
    /// images of another size than the rig's cameras, depth images without a depth camera, a mask that the rig names and
    /// that is not given.
    pub fn from_frames(rig: Rig, frames: impl Into<Frames>) -> Result<Dataset, DatasetError> {
        frames.into().into_dataset(rig)
    }

    /// A dataset whose images come from elsewhere; `records` name them. The images are looked at when they are asked
    /// for.
    ///
    /// # Errors
    /// As of [`Dataset::from_frames`], of the postures alone.
    pub fn from_source(
        rig: Rig,
        records: Vec<PostureRecord>,
        source: Arc<dyn FrameSource>,
    ) -> Result<Dataset, DatasetError> {
        if records.len() < 2 {
            return Err(DatasetError::TooFewPostures { path: source.place().to_owned(), got: records.len() });
        }
        frames::check_postures(&records, &rig)?;
        Ok(Dataset { source, rig, records, self_filter: None })
    }

    /// Where an image is, for messages.
    pub fn path_of(&self, name: &Path) -> PathBuf {
        self.source.place().join(name)
    }

    /// Number of postures.
    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Whether there is no posture; an opened dataset has at least two.
    pub fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// Whether the joints are known at every posture, so that the arm can be calibrated.
    pub fn has_joints(&self) -> bool {
        self.records.iter().all(|record| matches!(record.posture.state, PostureState::Joints(_)))
    }

    /// Decodes the colour image of a posture.
    pub fn color(&self, index: usize) -> Result<RgbImage, DatasetError> {
        Ok(self.image(&self.records[index].color, &self.rig.color, "color")?.into_rgb8())
    }

    /// Decodes the colour image of a posture as grey values.
    pub fn gray(&self, index: usize) -> Result<GrayImage, DatasetError> {
        Ok(self.image(&self.records[index].color, &self.rig.color, "color")?.into_luma8())
    }

    /// The colour image of a posture as a JPEG or PNG file, and which of them: the file that it came from, or a PNG.
    pub fn color_file(&self, index: usize) -> Result<(ImageFormat, Vec<u8>), DatasetError> {
        let name = &self.records[index].color;
        if let Some(bytes) = self.source.file(name)?
            && let Ok(format @ (ImageFormat::Jpeg | ImageFormat::Png)) = image::guess_format(&bytes)
        {
            return Ok((format, bytes));
        }
        let mut png = std::io::Cursor::new(Vec::new());
        let wrong =
            |error: image::ImageError| DatasetError::Image { path: self.path_of(name), problem: error.to_string() };
        self.color(index)?.write_to(&mut png, ImageFormat::Png).map_err(wrong)?;
        Ok((ImageFormat::Png, png.into_inner()))
    }

    /// Decodes the depth image of a posture, without the robot's body where a filter is set; `None` where the posture
    /// has none.
    pub fn depth(&self, index: usize) -> Result<Option<DepthImage>, DatasetError> {
        let record = &self.records[index];
        let (Some(name), Some(camera)) = (&record.depth, &self.rig.depth) else { return Ok(None) };
        let depth = images::depth(&self.path_of(name), self.image(name, &camera.camera, "depth")?, camera)?;
        match &self.self_filter {
            None => Ok(Some(depth)),
            Some(filter) => filter.apply(&depth, camera, &self.rig, &record.posture).map(Some),
        }
    }

    /// The mask of the colour camera that the rig names: 0 where it sees what moves with it.
    pub fn color_mask(&self) -> Result<Option<GrayImage>, DatasetError> {
        let Some(name) = &self.rig.color_mask else { return Ok(None) };
        Ok(Some(self.image(Path::new(name), &self.rig.color, "color")?.into_luma8()))
    }

    /// The mask of the depth camera that the rig names.
    pub fn depth_mask(&self) -> Result<Option<GrayImage>, DatasetError> {
        let (Some(name), Some(depth)) = (&self.rig.depth_mask, &self.rig.depth) else { return Ok(None) };
        Ok(Some(self.image(Path::new(name), &depth.camera, "depth")?.into_luma8()))
    }

    /// An image of the source, which has the camera's size, whoever made the source.
    fn image(&self, name: &Path, camera: &PinholeCamera, table: &'static str) -> Result<DynamicImage, DatasetError> {
        let image = self.source.image(name, camera, table)?;
        images::fits(&self.path_of(name), (image.width(), image.height()), camera, table)?;
        Ok(image)
    }

    fn check_folder(&self, folder: &Path) -> Result<(), DatasetError> {
        let table = folder.join("postures.csv");
        if self.records.len() < 2 {
            return Err(DatasetError::TooFewPostures { path: table, got: self.records.len() });
        }
        self.check_joint_columns(&table)?;
        for (row, record) in self.records.iter().enumerate() {
            for image in [Some(&record.color), record.depth.as_ref()].into_iter().flatten() {
                // Whether it can be read is found out when its header is.
                let Err(error) = skclam_files::inside(folder, image) else { continue };
                let index = record.posture.index;
                let problem = match error.kind() {
                    std::io::ErrorKind::NotFound => {
                        let (image, folder) = (image.display(), folder.display());
                        format!("posture {index}: {image} is not there; paths are relative to {folder}")
                    }
                    _ => format!("posture {index}: {error}"),
                };
                return Err(DatasetError::Table { path: table, line: row + 2, problem });
            }
            self.rig.base_from_color(&record.posture).map_err(|source| DatasetError::Posture {
                path: table.clone(),
                line: row + 2,
                source,
            })?;
            images::check_header(folder, &record.color, &self.rig.color, "color")?;
            if let Some(depth) = &record.depth {
                let Some(camera) = &self.rig.depth else {
                    return Err(DatasetError::DepthWithoutCamera { path: table, line: row + 2 });
                };
                images::check_header(folder, depth, &camera.camera, "depth")?;
            }
        }
        Ok(())
    }

    /// The table has a column for each of the arm's joints.
    fn check_joint_columns(&self, table: &Path) -> Result<(), DatasetError> {
        let (Some(robot), PostureState::Joints(values)) = (&self.rig.robot, &self.records[0].posture.state) else {
            return Ok(());
        };
        let (need, got) = (robot.joint_count(), values.len());
        if need == got {
            return Ok(());
        }
        let column = |at: usize| match robot.joints().get(at).map(|joint| joint.kind) {
            Some(JointKind::Prismatic) => format!("q{}_mm", at + 1),
            _ => format!("q{}_deg", at + 1),
        };
        let names: Vec<String> = (need.min(got)..need.max(got)).map(column).collect();
        let names = names.join(", ");
        let problem = if got < need {
            format!("the rig's arm has {need} joints, and there is no column {names}")
        } else {
            format!("the rig's arm has {need} joints; {names} belongs to none")
        };
        Err(DatasetError::Table { path: table.to_owned(), line: 1, problem })
    }
}
