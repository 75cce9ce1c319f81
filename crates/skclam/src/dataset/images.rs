//! Decoding of colour and depth images, checked against the rig's cameras before any pixel is decoded.

use super::DatasetError;
use super::jpeg::ends;
use image::{DynamicImage, GrayImage, ImageFormat, ImageReader, RgbImage};
use skclam_geometry::{DepthCamera, DepthImage, PinholeCamera};
use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

type Reader = ImageReader<BufReader<File>>;

fn problem(path: &Path, error: impl std::fmt::Display) -> DatasetError {
    DatasetError::Image { path: path.to_owned(), problem: error.to_string() }
}

fn open(path: &Path) -> Result<Reader, DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    // The content decides the format, not the file's ending.
    ImageReader::open(path).map_err(io)?.with_guessed_format().map_err(io)
}

/// Compares the size in the image's header with the camera's.
pub(super) fn check_header(path: &Path, camera: &PinholeCamera, table: &'static str) -> Result<(), DatasetError> {
    let (got_width, got_height) = open(path)?.into_dimensions().map_err(|error| problem(path, error))?;
    if (got_width, got_height) == (camera.width, camera.height) {
        return Ok(());
    }
    Err(DatasetError::ImageSize {
        path: path.to_owned(),
        table,
        width: camera.width,
        height: camera.height,
        got_width,
        got_height,
    })
}

fn decode(path: &Path, camera: &PinholeCamera, table: &'static str) -> Result<DynamicImage, DatasetError> {
    check_header(path, camera, table)?;
    let reader = open(path)?;
    // The decoder fills in grey where a JPEG breaks off; a PNG it refuses by itself.
    if reader.format() == Some(ImageFormat::Jpeg) {
        let file = File::open(path).map_err(|source| DatasetError::Io { path: path.to_owned(), source })?;
        if !ends(BufReader::new(file)).map_err(|source| DatasetError::Io { path: path.to_owned(), source })? {
            return Err(problem(path, "the JPEG breaks off: it has no end marker; copy or record the image again"));
        }
    }
    reader.decode().map_err(|error| problem(path, error))
}

pub(super) fn read_color(path: &Path, camera: &PinholeCamera) -> Result<RgbImage, DatasetError> {
    Ok(decode(path, camera, "color")?.into_rgb8())
}

pub(super) fn read_gray(path: &Path, camera: &PinholeCamera) -> Result<GrayImage, DatasetError> {
    Ok(decode(path, camera, "color")?.into_luma8())
}

pub(super) fn read_depth(path: &Path, camera: &DepthCamera) -> Result<DepthImage, DatasetError> {
    let decoded = decode(path, &camera.camera, "depth")?;
    let DynamicImage::ImageLuma16(counts) = decoded else {
        let found = format!("{:?}", decoded.color());
        return Err(problem(
            path,
            format!(
                "the pixels are {found}; a depth image is a 16-bit grey PNG or PGM, z-depth in counts of depth.unit_mm"
            ),
        ));
    };
    DepthImage::from_counts(camera, counts.as_raw())
        .map_err(|source| DatasetError::Depth { path: path.to_owned(), source })
}

/// Writes depths as a 16-bit PNG with `unit_m` metres a count; what the counts cannot hold becomes 0, "no value".
pub fn write_depth_png(path: &Path, depth: &DepthImage, unit_m: f64) -> Result<(), DatasetError> {
    let io = |source| DatasetError::Io { path: path.to_owned(), source };
    let counts: Vec<u16> = depth
        .as_slice()
        .iter()
        .map(|&z| {
            let count = (f64::from(z) / unit_m).round();
            if count <= f64::from(u16::MAX) { count as u16 } else { 0 }
        })
        .collect();
    let buffer = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(depth.width(), depth.height(), counts)
        .ok_or_else(|| problem(path, "the depth image's buffer does not fit its size"))?;
    let mut writer = BufWriter::new(File::create(path).map_err(io)?);
    buffer.write_to(&mut writer, image::ImageFormat::Png).map_err(|error| problem(path, error))?;
    writer.flush().map_err(io)
}
