//! Where the images of a dataset come from: a folder, memory, or whatever else a caller has.

use super::{DatasetError, images};
use image::DynamicImage;
use skclam_geometry::PinholeCamera;
use std::fmt;
use std::path::{Path, PathBuf};

/// Gives the images of a dataset by their names, which are those in its records and, for masks, in its rig.
///
/// [`Folder`] reads files and [`Frames`](super::Frames) holds images in memory. Implement it for what is neither: a
/// database, a recording that is decoded while it is read. Images are asked for from several threads, in no particular
/// order and more than once, and must be the same each time.
pub trait FrameSource: fmt::Debug + Send + Sync {
    /// Where the images are, for messages and reports.
    fn place(&self) -> &Path;

    /// The decoded image of this name. Colour images and masks may be grey or RGB, depth images are 16-bit grey in
    /// counts of the depth camera's unit. An image without `camera`'s size may be refused before it is decoded; `table`
    /// (color or depth) names the camera in messages.
    ///
    /// # Errors
    /// No such image, or one that cannot be decoded.
    fn image(&self, name: &Path, camera: &PinholeCamera, table: &'static str) -> Result<DynamicImage, DatasetError>;

    /// The image as the file that it is stored in; `None` where there is no file.
    ///
    /// # Errors
    /// A file that cannot be read.
    fn file(&self, name: &Path) -> Result<Option<Vec<u8>>, DatasetError> {
        let _ = name;
        Ok(None)
    }
}

/// Images in a folder, in any format that is read; names are paths relative to it and never lead out of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Folder(pub PathBuf);

impl FrameSource for Folder {
    fn place(&self) -> &Path {
        &self.0
    }

    fn image(&self, name: &Path, camera: &PinholeCamera, table: &'static str) -> Result<DynamicImage, DatasetError> {
        images::decode(&self.0, name, camera, table)
    }

    fn file(&self, name: &Path) -> Result<Option<Vec<u8>>, DatasetError> {
        skclam_files::inside(&self.0, name)
            .and_then(|path| skclam_files::read(path, skclam_files::Kind::Image))
            .map(Some)
            .map_err(|source| DatasetError::Io { path: self.0.join(name), source })
    }
}
