//! Pixels out of image messages.

use crate::camera::MAX_SIDE;
use crate::{CompressedImage, Image, MAX_MESSAGE_BYTES, RecordingError};
use image::{DynamicImage, GrayImage, ImageFormat, ImageReader, RgbImage};
use std::io::Cursor;

/// Metres a count for depth that comes in floating-point metres: 0.25 mm, so that 16 bits reach 16.4 m.
pub const FLOAT_DEPTH_UNIT_M: f64 = 0.25e-3;

/// A colour image, grey or RGB with 8 bits.
#[derive(Debug, Clone)]
pub struct ColorPixels {
    /// `ImageLuma8` or `ImageRgb8`.
    pub image: DynamicImage,
    /// For an image that came as a file: the ending of its name. The file itself may be kept as it is.
    pub file_ending: Option<&'static str>,
}

/// A depth image in counts, 0 where nothing was measured.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthPixels {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Row by row.
    pub counts: Vec<u16>,
    /// Metres a count, where the message says so; `None`: by convention (REP 118: millimetres).
    pub unit_m: Option<f64>,
}

/// The rows of a raw image, without padding.
fn rows<'a>(
    topic: &str,
    image: &Image<'a>,
    bytes_per_pixel: u64,
) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, RecordingError> {
    let (width, height) = (u64::from(image.head.width), u64::from(image.head.height));
    if !(1..=u64::from(MAX_SIDE)).contains(&width) || !(1..=u64::from(MAX_SIDE)).contains(&height) {
        return Err(RecordingError::message(topic, format!("an image of {width} x {height} pixels")));
    }
    let (step, row) = (u64::from(image.step), width * bytes_per_pixel);
    let need = step * (height - 1) + row;
    if step < row || need > image.data.len() as u64 {
        let got = image.data.len();
        let problem = format!(
            "an image of {width} x {height} in {} with {step} bytes a row needs {need} bytes in rows of at least {row}; it has {got}",
            image.head.encoding
        );
        return Err(RecordingError::message(topic, problem));
    }
    let data = image.data;
    Ok((0..height).map(move |y| &data[(y * step) as usize..(y * step + row) as usize]))
}

/// An image file, within limits of size and memory.
fn decoded_file(topic: &str, data: &[u8]) -> Result<(DynamicImage, &'static str), RecordingError> {
    let wrong = |problem: String| RecordingError::message(topic, problem);
    let format = image::guess_format(data).map_err(|_| wrong("the image is neither JPEG nor PNG".to_owned()))?;
    let ending = match format {
        ImageFormat::Jpeg => "jpg",
        ImageFormat::Png => "png",
        ImageFormat::Pnm => "pgm",
        other => return Err(wrong(format!("the image is {other:?}; JPEG and PNG are read"))),
    };
    let mut reader = ImageReader::with_format(Cursor::new(data), format);
    let mut limits = image::Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(MAX_SIDE), Some(MAX_SIDE));
    limits.max_alloc = Some(2 * MAX_MESSAGE_BYTES);
    reader.limits(limits);
    let image = reader.decode().map_err(|error| wrong(error.to_string()))?;
    Ok((image, ending))
}

impl ColorPixels {
    /// From `Image`: `mono8`, `rgb8`, `bgr8`, `rgba8`, `bgra8`, and OpenCV's names for them.
    pub fn from_image(topic: &str, image: &Image<'_>) -> Result<Self, RecordingError> {
        let (bytes, order): (usize, Option<[usize; 3]>) = match image.head.encoding {
            "mono8" | "8UC1" => (1, None),
            "rgb8" => (3, Some([0, 1, 2])),
            "bgr8" | "8UC3" => (3, Some([2, 1, 0])),
            "rgba8" => (4, Some([0, 1, 2])),
            "bgra8" | "8UC4" => (4, Some([2, 1, 0])),
            other => {
                let problem = format!(
                    "the encoding {other:?} is not read for colour; mono8, rgb8, bgr8, rgba8 and bgra8 are (image_proc converts raw Bayer images)"
                );
                return Err(RecordingError::message(topic, problem));
            }
        };
        let rows = rows(topic, image, bytes as u64)?;
        let (width, height) = (image.head.width, image.head.height);
        let channels = if order.is_some() { 3 } else { 1 };
        let mut pixels = Vec::with_capacity(width as usize * height as usize * channels);
        for row in rows {
            match order {
                None | Some([0, 1, 2]) if bytes == channels => pixels.extend_from_slice(row),
                Some([r, g, b]) => {
                    pixels.extend(row.chunks_exact(bytes).flat_map(|pixel| [pixel[r], pixel[g], pixel[b]]))
                }
                None => {}
            }
        }
        let image = match channels {
            1 => GrayImage::from_raw(width, height, pixels).map(DynamicImage::ImageLuma8),
            _ => RgbImage::from_raw(width, height, pixels).map(DynamicImage::ImageRgb8),
        };
        let image = image.ok_or_else(|| RecordingError::message(topic, "the image's buffer does not fit its size"))?;
        Ok(ColorPixels { image, file_ending: None })
    }

    /// From `CompressedImage`: JPEG or PNG.
    pub fn from_compressed(topic: &str, image: &CompressedImage<'_>) -> Result<Self, RecordingError> {
        Self::from_file(topic, image.data)
    }

    /// From the bytes of an image file. An alpha channel is dropped, 16 bits become 8.
    pub fn from_file(topic: &str, data: &[u8]) -> Result<Self, RecordingError> {
        let (image, ending) = decoded_file(topic, data)?;
        let plain = matches!(image, DynamicImage::ImageLuma8(_) | DynamicImage::ImageRgb8(_));
        let image = match image {
            plain @ (DynamicImage::ImageLuma8(_) | DynamicImage::ImageRgb8(_)) => plain,
            other if other.color().has_color() => DynamicImage::ImageRgb8(other.into_rgb8()),
            other => DynamicImage::ImageLuma8(other.into_luma8()),
        };
        Ok(ColorPixels { image, file_ending: plain.then_some(ending) })
    }
}

impl DepthPixels {
    /// From `Image`: `mono16`, `16UC1`, `32FC1` (metres).
    pub fn from_image(topic: &str, image: &Image<'_>) -> Result<Self, RecordingError> {
        let (width, height) = (image.head.width, image.head.height);
        let count = || width as usize * height as usize;
        match image.head.encoding {
            "mono16" | "16UC1" => {
                let rows = rows(topic, image, 2)?;
                let mut counts = Vec::with_capacity(count());
                for row in rows {
                    counts.extend(row.chunks_exact(2).map(|pair| match image.big_endian {
                        true => u16::from_be_bytes([pair[0], pair[1]]),
                        false => u16::from_le_bytes([pair[0], pair[1]]),
                    }));
                }
                let unit_m = image.depth_unit_m.filter(|unit| unit.is_finite() && *unit > 0.0).map(f64::from);
                Ok(DepthPixels { width, height, counts, unit_m })
            }
            "32FC1" => {
                let rows = rows(topic, image, 4)?;
                let mut counts = Vec::with_capacity(count());
                for row in rows {
                    counts.extend(row.chunks_exact(4).map(|four| {
                        let four = [four[0], four[1], four[2], four[3]];
                        count_of(if image.big_endian { f32::from_be_bytes(four) } else { f32::from_le_bytes(four) })
                    }));
                }
                Ok(DepthPixels { width, height, counts, unit_m: Some(FLOAT_DEPTH_UNIT_M) })
            }
            other => {
                let problem = format!("the encoding {other:?} is not read for depth; 16UC1, mono16 and 32FC1 are");
                Err(RecordingError::message(topic, problem))
            }
        }
    }

    /// From `CompressedImage`: a PNG of 16 bits, or `compressedDepth` of 16 bits or of 32-bit floats (12 bytes of
    /// parameters, then a PNG; floats as an inverse depth in 16 bits).
    pub fn from_compressed(topic: &str, image: &CompressedImage<'_>) -> Result<Self, RecordingError> {
        if !image.head.encoding.contains("compressedDepth") {
            return Self::from_file(topic, image.data);
        }
        let wrong = |problem: &str| RecordingError::message(topic, problem);
        let Some((parameters, png)) = image.data.split_first_chunk::<12>() else {
            return Err(wrong("a compressedDepth image has fewer than 12 bytes"));
        };
        if image.head.encoding.contains("rvl") {
            return Err(wrong("compressedDepth in RVL is not read; record it as PNG, or the raw topic"));
        }
        let decoded = Self::from_file(topic, png)?;
        if !image.head.encoding.contains("32FC1") {
            return Ok(decoded);
        }
        let number = |at: usize| {
            let bytes = &parameters[at..at + 4];
            f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
        };
        let (scale, offset) = (number(4), number(8));
        if !(scale.is_finite() && offset.is_finite()) {
            return Err(wrong("the parameters of a compressedDepth image are not finite"));
        }
        let metres = |inverse: u16| if inverse == 0 { 0.0 } else { scale / (f32::from(inverse) - offset) };
        let counts = decoded.counts.iter().map(|&inverse| count_of(metres(inverse))).collect();
        Ok(DepthPixels { counts, unit_m: Some(FLOAT_DEPTH_UNIT_M), ..decoded })
    }

    /// From the bytes of a PNG of 16 bits.
    pub fn from_file(topic: &str, data: &[u8]) -> Result<Self, RecordingError> {
        let (image, _) = decoded_file(topic, data)?;
        let DynamicImage::ImageLuma16(counts) = image else {
            let problem = format!("the depth image has pixels of {:?}; 16-bit grey is expected", image.color());
            return Err(RecordingError::message(topic, problem));
        };
        Ok(DepthPixels { width: counts.width(), height: counts.height(), counts: counts.into_raw(), unit_m: None })
    }
}

/// Metres as counts; what is not finite, not positive or beyond 16 bits is "no value".
fn count_of(metres: f32) -> u16 {
    let count = (f64::from(metres) / FLOAT_DEPTH_UNIT_M).round();
    if count >= 1.0 && count <= f64::from(u16::MAX) { count as u16 } else { 0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Header, ImageHead};

    fn image<'a>(encoding: &'a str, width: u32, height: u32, step: u32, data: &'a [u8]) -> Image<'a> {
        let header = Header { stamp: 0, frame_id: "c" };
        let head = ImageHead { header, width, height, encoding };
        Image { head, big_endian: false, step, data, depth_unit_m: None }
    }

    #[test]
    fn channels_are_put_in_order_and_padding_is_dropped() {
        let bgra = [1, 2, 3, 9, 4, 5, 6, 9, 0, 0, 7, 8, 9, 9, 10, 11, 12, 9, 0, 0];
        let pixels = ColorPixels::from_image("/c", &image("bgra8", 2, 2, 10, &bgra)).unwrap();
        assert_eq!(pixels.image.as_bytes(), [3, 2, 1, 6, 5, 4, 9, 8, 7, 12, 11, 10]);
        let mono = ColorPixels::from_image("/c", &image("mono8", 2, 2, 3, &[1, 2, 0, 3, 4])).unwrap();
        assert_eq!(mono.image.as_bytes(), [1, 2, 3, 4]);
        let rgb = ColorPixels::from_image("/c", &image("rgb8", 1, 1, 3, &[1, 2, 3])).unwrap();
        assert_eq!(rgb.image.as_bytes(), [1, 2, 3]);
    }

    #[test]
    fn depth_in_either_unit_and_byte_order() {
        let mut counts = image("16UC1", 2, 1, 4, &[1, 2, 3, 4]);
        assert_eq!(DepthPixels::from_image("/d", &counts).unwrap().counts, [0x0201, 0x0403]);
        counts.big_endian = true;
        assert_eq!(DepthPixels::from_image("/d", &counts).unwrap().counts, [0x0102, 0x0304]);
        let floats: Vec<u8> =
            [1.0f32, f32::NAN, -1.0, f32::INFINITY, 100.0].iter().flat_map(|value| value.to_le_bytes()).collect();
        let depth = DepthPixels::from_image("/d", &image("32FC1", 5, 1, 20, &floats)).unwrap();
        assert_eq!((depth.counts, depth.unit_m), (vec![4000, 0, 0, 0, 0], Some(FLOAT_DEPTH_UNIT_M)));
    }

    #[test]
    fn sizes_that_do_not_fit_are_reported() {
        for bad in [
            image("mono8", 4, 4, 4, &[0; 15]),
            image("mono8", 4, 4, 3, &[0; 16]),
            image("rgb8", u32::MAX, u32::MAX, u32::MAX, &[0; 16]),
            image("mono8", 0, 4, 0, &[]),
            image("bayer_rggb8", 4, 4, 4, &[0; 16]),
        ] {
            assert!(ColorPixels::from_image("/c", &bad).is_err(), "{bad:?}");
            assert!(DepthPixels::from_image("/c", &bad).is_err(), "{bad:?}");
        }
        assert!(
            ColorPixels::from_file("/c", b"not an image").unwrap_err().to_string().contains("neither JPEG nor PNG")
        );
    }
}
