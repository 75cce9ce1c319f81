//! A PNG without what is no pixel (ISO/IEC 15948): colour profiles and texts are compressed by themselves, and a
//! megabyte of them unpacks to a gigabyte before the first pixel is seen. Nothing here uses them.

const SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
/// Signature, length and type of the first chunk, width and height.
pub(super) const HEADER_BYTES: usize = 24;
/// The chunks that pixels are made of.
const KEPT: [&[u8; 4]; 5] = [b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS"];

/// Width and height, of the beginning of a file; `None` where it is no PNG.
pub(super) fn size(beginning: &[u8]) -> Option<(u32, u32)> {
    let rest = beginning.get(..HEADER_BYTES)?.strip_prefix(&SIGNATURE)?;
    let number = |at: usize| rest[at..at + 4].try_into().ok().map(u32::from_be_bytes);
    (&rest[4..8] == b"IHDR").then_some((number(8)?, number(12)?))
}

/// Takes all chunks out of a PNG that are not needed for its pixels; other files stay as they are. What follows a
/// chunk that is cut short is kept, so that the decoder finds the same damage.
pub(super) fn strip(bytes: &mut Vec<u8>) {
    if !bytes.starts_with(&SIGNATURE) {
        return;
    }
    let (mut from, mut to) = (SIGNATURE.len(), SIGNATURE.len());
    while let Some(head) = bytes.get(from..from + 8) {
        let length = head[..4].try_into().map_or(0, u32::from_be_bytes) as usize;
        let end = from + 12 + length;
        if end > bytes.len() {
            break;
        }
        if KEPT.iter().any(|kept| head[4..] == kept[..]) {
            bytes.copy_within(from..end, to);
            to += end - from;
        }
        from = end;
    }
    let rest = bytes.len() - from;
    bytes.copy_within(from.., to);
    bytes.truncate(to + rest);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn png() -> Vec<u8> {
        let image = image::GrayImage::from_fn(31, 17, |x, y| image::Luma([(x * y) as u8]));
        let mut bytes = std::io::Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    fn with_chunk(png: &[u8], kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
        // Behind the header, whose 13 bytes lie between 8 and 4 others.
        let (before, after) = png.split_at(SIGNATURE.len() + 25);
        let length = (data.len() as u32).to_be_bytes();
        let checksum = crc([kind, data].concat());
        [before, &length, kind, data, &checksum, after].concat()
    }

    fn crc(bytes: Vec<u8>) -> [u8; 4] {
        let mut crc = u32::MAX;
        for byte in bytes {
            crc ^= u32::from(byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { 0xEDB8_8320 ^ (crc >> 1) } else { crc >> 1 };
            }
        }
        (!crc).to_be_bytes()
    }

    #[test]
    fn pixels_stay_and_the_rest_goes() {
        let plain = png();
        let mut with = with_chunk(&with_chunk(&plain, b"iCCP", b"p\0\0bomb"), b"tEXt", b"a\0b");
        assert_eq!(size(&with), Some((31, 17)));
        strip(&mut with);
        assert_eq!(with, plain);
        assert_eq!(size(&plain[..20]), None);
        assert_eq!(size(b"\xff\xd8 no png, and long enough"), None);
    }

    #[test]
    fn damage_is_left_for_the_decoder() {
        let plain = png();
        for length in [9, 40, plain.len() - 5] {
            let mut cut = plain[..length].to_vec();
            strip(&mut cut);
            assert_eq!(cut, plain[..length], "{length}");
        }
        let mut other = b"no png".to_vec();
        strip(&mut other);
        assert_eq!(other, b"no png");
    }
}
