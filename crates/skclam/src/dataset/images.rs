//! Decoding of colour and depth images, checked against the rig's cameras before any pixel is decoded.

use super::{DatasetError, jpeg, png};
use image::{DynamicImage, ImageFormat, ImageReader};
use skclam_files::{Kind, inside, open, read};
use skclam_geometry::{DepthCamera, DepthImage, PinholeCamera};
use std::fs::File;
use std::io::{BufReader, BufWriter, Cursor, Read, Seek, Write};
use std::path::Path;

fn problem(path: &Path, error: impl std::fmt::Display) -> DatasetError {
    DatasetError::Image { path: path.to_owned(), problem: error.to_string() }
}

/// What is read as an image.
const READ: &str = "read are PNG, JPEG, PGM/PPM, BMP, TIFF and WebP";

/// The format of an image by its content, whatever its file's ending says.
fn format_of(path: &Path, beginning: &[u8]) -> Result<ImageFormat, DatasetError> {
    let found = match image::guess_format(beginning) {
        Ok(format) if format.reading_enabled() => return Ok(format),
        Ok(format) => format!("an image in the format {format:?}"),
        Err(_) if beginning.starts_with(b"\x93NUMPY") => {
            "a NumPy array (.npy); write it as a 16-bit grey PNG".to_owned()
        }
        Err(_) if beginning.is_empty() => "an empty file".to_owned(),
        Err(_) => "no image of a known format".to_owned(),
    };
    Err(problem(path, format!("this is {found}; {READ}")))
}

/// Compares the size in the image's header with the camera's.
pub(super) fn check_header(
    folder: &Path,
    name: &Path,
    camera: &PinholeCamera,
    table: &'static str,
) -> Result<(), DatasetError> {
    let path = folder.join(name);
    let io = |source| DatasetError::Io { path: path.clone(), source };
    let file = inside(folder, name).and_then(|path| open(path, Kind::Image)).map_err(io)?;
    // The size of a PNG is at its beginning; its reader would unpack a colour profile first.
    let mut beginning = Vec::new();
    (&file).take(png::HEADER_BYTES as u64).read_to_end(&mut beginning).map_err(io)?;
    let size = match png::size(&beginning) {
        Some(size) => size,
        None => {
            let mut whole = BufReader::new(file);
            whole.rewind().map_err(io)?;
            let reader = ImageReader::with_format(whole, format_of(&path, &beginning)?);
            reader.into_dimensions().map_err(|error| problem(&path, error))?
        }
    };
    fits(&path, size, camera, table)
}

pub(super) fn fits(
    path: &Path,
    size: (u32, u32),
    camera: &PinholeCamera,
    table: &'static str,
) -> Result<(), DatasetError> {
    let (got_width, got_height) = size;
    if size == (camera.width, camera.height) {
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

pub(super) fn decode(
    folder: &Path,
    name: &Path,
    camera: &PinholeCamera,
    table: &'static str,
) -> Result<DynamicImage, DatasetError> {
    let path = folder.join(name);
    let io = |source| DatasetError::Io { path: path.clone(), source };
    let mut bytes = inside(folder, name).and_then(|path| read(path, Kind::Image)).map_err(io)?;
    png::strip(&mut bytes);
    let format = format_of(&path, &bytes)?;
    let reader = || ImageReader::with_format(Cursor::new(&bytes), format);
    let size = reader().into_dimensions().map_err(|error| problem(&path, error))?;
    fits(&path, size, camera, table)?;
    let is_jpeg = format == ImageFormat::Jpeg;
    let decoded = reader().decode().map_err(|error| problem(&path, error))?;
    // The decoder fills in grey where a JPEG breaks off; a PNG it refuses by itself.
    match is_jpeg.then(|| jpeg::breaks_off(&bytes, &decoded)).flatten() {
        Some(why) => Err(problem(&path, format!("the JPEG breaks off: {why}; copy or record the image again"))),
        None => Ok(decoded),
    }
}

/// Metres of a depth image's counts.
pub(super) fn depth(path: &Path, decoded: DynamicImage, camera: &DepthCamera) -> Result<DepthImage, DatasetError> {
    let DynamicImage::ImageLuma16(counts) = decoded else {
        let found = format!("{:?}", decoded.color());
        return Err(problem(
            path,
            format!(
                "the pixels are {found}; a depth image is a 16-bit grey PNG, TIFF or PGM, z-depth in counts of depth.unit_mm"
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
