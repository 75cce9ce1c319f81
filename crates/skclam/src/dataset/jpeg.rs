//! Whether a JPEG is whole: decoders show grey for what is missing without an error.
//!
//! The markers are followed (ITU-T T.81, annex B): segments by their length, entropy-coded data up to the next
//! marker. A search for the bytes of the end marker alone would find that of a thumbnail in the metadata.

use super::jpeg_blocks;
use image::{DynamicImage, GenericImageView};
use std::io::{self, BufRead};

/// Marker codes without a length: TEM and the restart markers.
fn has_no_length(code: u8) -> bool {
    matches!(code, 0x01 | 0xD0..=0xD7)
}

/// Why a decoded JPEG is not whole; `None` where it is.
pub(super) fn breaks_off(bytes: &[u8], decoded: &DynamicImage) -> Option<&'static str> {
    if !ends(bytes).unwrap_or(false) {
        return Some("it has no end marker");
    }
    // To look at every code takes as long as decoding. Where data are missing, the last corner is filled in.
    let is_cut = ends_flat(decoded) && jpeg_blocks::are_missing(bytes);
    is_cut.then_some("its data end before the last block, though an end marker follows")
}

/// Whether the last 8 x 8 pixels have one value, or are the ones before them again.
fn ends_flat(image: &DynamicImage) -> bool {
    let (width, height) = (image.width(), image.height());
    if width < 16 || height < 16 {
        return true;
    }
    // Where a block begins in the last row and column of them.
    let (x, y) = ((width - 1) / 8 * 8, (height - 1) / 8 * 8);
    let all = |same: &dyn Fn(u32, u32) -> bool| (y..height).all(|y| (x..width).all(|x| same(x, y)));
    let first = image.get_pixel(x, y);
    all(&|x, y| image.get_pixel(x, y) == first) || all(&|x, y| image.get_pixel(x, y) == image.get_pixel(x - 8, y))
}

/// Whether the stream comes to the end marker of its image. What follows that is ignored.
fn ends(mut stream: impl BufRead) -> io::Result<bool> {
    let mut in_scan = false;
    loop {
        let Some(code) = next_marker(&mut stream, in_scan)? else { return Ok(false) };
        match code {
            // End of image.
            0xD9 => return Ok(true),
            // Start of image.
            0xD8 => {}
            code if has_no_length(code) => {}
            code => {
                let mut length = [0; 2];
                if !filled(&mut stream, &mut length)? {
                    return Ok(false);
                }
                let Some(rest) = u16::from_be_bytes(length).checked_sub(2) else { return Ok(false) };
                if io::copy(&mut io::Read::take(&mut stream, u64::from(rest)), &mut io::sink())? < u64::from(rest) {
                    return Ok(false);
                }
                in_scan = code == 0xDA;
            }
        }
    }
}

/// The code of the next marker; `None` at the end of the stream. In entropy-coded data a stuffed zero after 0xFF and
/// restart markers are none.
fn next_marker(stream: &mut impl BufRead, in_scan: bool) -> io::Result<Option<u8>> {
    let mut byte = [0];
    loop {
        if !skipped_to_ff(stream)? {
            return Ok(None);
        }
        loop {
            if !filled(stream, &mut byte)? {
                return Ok(None);
            }
            if byte[0] != 0xFF {
                break;
            }
        }
        let data = byte[0] == 0 || (in_scan && has_no_length(byte[0]));
        if !data {
            return Ok(Some(byte[0]));
        }
    }
}

/// Goes behind the next 0xFF; whether there was one.
fn skipped_to_ff(stream: &mut impl BufRead) -> io::Result<bool> {
    loop {
        let buffer = stream.fill_buf()?;
        if buffer.is_empty() {
            return Ok(false);
        }
        match buffer.iter().position(|&byte| byte == 0xFF) {
            Some(at) => {
                stream.consume(at + 1);
                return Ok(true);
            }
            None => {
                let all = buffer.len();
                stream.consume(all);
            }
        }
    }
}

fn filled(stream: &mut impl BufRead, bytes: &mut [u8]) -> io::Result<bool> {
    match stream.read_exact(bytes) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn jpeg() -> Vec<u8> {
        let image = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * 4) as u8, (x * y) as u8, (y * 5) as u8]));
        let mut bytes = io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn a_jpeg_is_whole_only_to_its_last_byte() {
        let whole = jpeg();
        assert!(ends(&whole[..]).unwrap());
        for length in 0..whole.len() {
            assert!(!ends(&whole[..length]).unwrap(), "{length} of {}", whole.len());
        }
        // Cameras append padding.
        assert!(ends(&[&whole[..], &[0; 100]].concat()[..]).unwrap());
    }

    #[test]
    fn the_end_of_a_thumbnail_is_not_that_of_the_image() {
        let whole = jpeg();
        let thumbnail = jpeg();
        let mut with = whole[..2].to_vec();
        with.extend([0xFF, 0xE1]);
        with.extend((thumbnail.len() as u16 + 2).to_be_bytes());
        with.extend(&thumbnail);
        with.extend(&whole[2..]);
        assert!(ends(&with[..]).unwrap());
        assert!(!ends(&with[..with.len() - 50]).unwrap());
    }
}
