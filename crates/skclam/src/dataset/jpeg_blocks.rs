//! Whether a baseline JPEG has the data of all its blocks: a file that was cut and closed with an end marker looks
//! whole by its markers, and decoders fill in grey.
//!
//! The Huffman codes are followed without making pixels of them (ITU-T T.81, annexes C and F).

/// Whether a block is missing. Progressive files are not looked into: false.
pub(super) fn are_missing(jpeg: &[u8]) -> bool {
    // Damage other than missing data is the decoder's to report.
    matches!(Walk::default().walk(jpeg), Some(Missing))
}

/// The data ended before the last block.
#[derive(Debug, Clone, Copy)]
struct Missing;

/// A component of the frame.
#[derive(Debug, Clone, Copy)]
struct Component {
    id: u8,
    horizontal: usize,
    vertical: usize,
}

#[derive(Default)]
struct Walk {
    tables: [[Option<Codes>; 4]; 2],
    size: [usize; 2],
    components: Vec<Component>,
    restart_interval: usize,
}

/// Length and value for each beginning of 16 bits; length 0 where there is no code.
struct Codes(Vec<(u8, u8)>);

impl Codes {
    fn new(counts: &[u8], values: &[u8]) -> Option<Self> {
        let mut codes = vec![(0, 0); 1 << 16];
        let (mut code, mut values) = (0usize, values.iter());
        for (length, &count) in (1..=16u8).zip(counts) {
            for _ in 0..count {
                let span = 1 << (16 - length);
                codes.get_mut(code..code + span)?.fill((length, *values.next()?));
                code += span;
            }
        }
        Some(Codes(codes))
    }
}

impl Walk {
    /// `None`: all there, or not known.
    fn walk(&mut self, jpeg: &[u8]) -> Option<Missing> {
        let mut rest = jpeg.get(2..)?;
        loop {
            let [0xFF, code, after @ ..] = rest else { return None };
            if *code == 0xFF {
                rest = &rest[1..];
                continue;
            }
            let length = usize::from(u16::from_be_bytes([*after.first()?, *after.get(1)?]));
            let (segment, next) = (after.get(2..length)?, after.get(length..)?);
            match code {
                // Sequential frames with Huffman codes.
                0xC0 | 0xC1 => self.frame(segment)?,
                0xC4 => self.codes(segment)?,
                0xDD => self.restart_interval = usize::from(u16::from_be_bytes([*segment.first()?, *segment.get(1)?])),
                0xDA => match self.scan(segment, next) {
                    Some(Ok(used)) => {
                        rest = next.get(used..)?;
                        continue;
                    }
                    Some(Err(missing)) => return Some(missing),
                    None => return None,
                },
                0xC2..=0xCF | 0xD9 => return None,
                _ => {}
            }
            rest = next;
        }
    }

    fn frame(&mut self, segment: &[u8]) -> Option<()> {
        let side = |at: usize| Some(usize::from(u16::from_be_bytes([*segment.get(at)?, *segment.get(at + 1)?])));
        self.size = [side(3)?, side(1)?];
        self.components = segment
            .get(6..)?
            .chunks_exact(3)
            .map(|part| Component {
                id: part[0],
                horizontal: usize::from(part[1] >> 4),
                vertical: usize::from(part[1] & 15),
            })
            .collect();
        let fair = |factor: usize| (1..=4).contains(&factor);
        let all_fair = self.components.iter().all(|part| fair(part.horizontal) && fair(part.vertical));
        (all_fair && self.size.iter().all(|&side| side > 0)).then_some(())
    }

    fn codes(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&kind, rest)) = segment.split_first() {
            let counts = rest.get(..16)?;
            let values = 16 + counts.iter().map(|&count| usize::from(count)).sum::<usize>();
            let table = self.tables.get_mut(usize::from(kind >> 4))?.get_mut(usize::from(kind & 15))?;
            *table = Some(Codes::new(counts, rest.get(16..values)?)?);
            segment = &rest[values..];
        }
        Some(())
    }

    /// Goes through a scan; the bytes of its data.
    fn scan(&self, segment: &[u8], data: &[u8]) -> Option<Result<usize, Missing>> {
        let parts = segment.get(1..1 + 2 * usize::from(*segment.first()?))?;
        let of_most = |of: fn(&Component) -> usize| self.components.iter().map(of).max();
        let (max_h, max_v) = (of_most(|part| part.horizontal)?, of_most(|part| part.vertical)?);
        let mut blocks = Vec::new();
        let mut units = self.size[0].div_ceil(8 * max_h) * self.size[1].div_ceil(8 * max_v);
        for part in parts.chunks_exact(2) {
            let component = self.components.iter().find(|component| component.id == part[0])?;
            let codes = (
                self.tables[0].get(usize::from(part[1] >> 4))?.as_ref()?,
                self.tables[1].get(usize::from(part[1] & 15))?.as_ref()?,
            );
            let mut count = component.horizontal * component.vertical;
            if parts.len() == 2 {
                // Alone in its scan, a component has no blocks beyond its own edges.
                let side = |size: usize, own: usize, most: usize| (size * own).div_ceil(most).div_ceil(8);
                units = side(self.size[0], component.horizontal, max_h) * side(self.size[1], component.vertical, max_v);
                count = 1;
            }
            blocks.extend(std::iter::repeat_n(codes, count));
        }
        let mut bits = Bits { data, at: 0, held: 0, count: 0 };
        for unit in 0..units {
            if self.restart_interval > 0 && unit > 0 && unit % self.restart_interval == 0 {
                bits.restart()?;
            }
            for (dc, ac) in &blocks {
                if let Err(missing) = bits.block(dc, ac)? {
                    return Some(Err(missing));
                }
            }
        }
        Some(Ok(bits.end()))
    }
}

/// Entropy-coded data, bit by bit.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    held: u64,
    count: u32,
}

impl Bits<'_> {
    /// Holds at least 32 bits where there are so many.
    fn fill(&mut self) {
        while self.count <= 48 {
            let byte = match self.data.get(self.at..) {
                Some([0xFF, 0, ..]) => {
                    self.at += 2;
                    0xFF
                }
                // A marker, or the end.
                Some([0xFF, ..] | []) | None => return,
                Some([byte, ..]) => {
                    self.at += 1;
                    *byte
                }
            };
            self.held = self.held << 8 | u64::from(byte);
            self.count += 8;
        }
    }

    /// The value of the next code; `None` where no code begins so.
    fn value(&mut self, codes: &Codes) -> Option<Result<u8, Missing>> {
        self.fill();
        let next = if self.count >= 16 { self.held >> (self.count - 16) } else { self.held << (16 - self.count) };
        let (length, value) = codes.0[(next & 0xFFFF) as usize];
        match u32::from(length) {
            _ if self.count == 0 => Some(Err(Missing)),
            0 if self.count >= 16 => None,
            0 => Some(Err(Missing)),
            length if length > self.count => Some(Err(Missing)),
            length => {
                self.count -= length;
                Some(Ok(value))
            }
        }
    }

    fn skip(&mut self, bits: u32) -> Result<(), Missing> {
        self.fill();
        self.count = self.count.checked_sub(bits).ok_or(Missing)?;
        Ok(())
    }

    fn block(&mut self, dc: &Codes, ac: &Codes) -> Option<Result<(), Missing>> {
        let code = |bits: &mut Self, codes: &Codes| -> Option<Result<u8, Missing>> {
            let value = match bits.value(codes)? {
                Ok(value) => value,
                Err(missing) => return Some(Err(missing)),
            };
            Some(bits.skip(u32::from(value & 15)).map(|()| value))
        };
        if let Err(missing) = code(self, dc)? {
            return Some(Err(missing));
        }
        let mut at = 1;
        while at < 64 {
            match code(self, ac)? {
                Err(missing) => return Some(Err(missing)),
                // The rest of the block is 0.
                Ok(0) => break,
                Ok(value) => at += usize::from(value >> 4) + 1,
            }
        }
        Some(Ok(()))
    }

    /// Goes behind a restart marker; `None` where there is none, which is damage of another kind.
    fn restart(&mut self) -> Option<()> {
        self.at = self.end();
        (self.held, self.count) = (0, 0);
        match self.data.get(self.at..)? {
            [0xFF, 0xD0..=0xD7, ..] => {
                self.at += 2;
                Some(())
            }
            _ => None,
        }
    }

    /// Where the next marker is.
    fn end(&self) -> usize {
        let mut at = self.at;
        while let Some([byte, next, ..]) = self.data.get(at..) {
            if *byte == 0xFF && *next != 0 {
                break;
            }
            at += 1;
        }
        at
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;

    fn jpeg(gray: bool) -> Vec<u8> {
        let image = image::RgbImage::from_fn(83, 61, |x, y| {
            image::Rgb([(x * 7 + y * y) as u8, (x * y) as u8, (x * x + 5 * y) as u8])
        });
        let mut bytes = Vec::new();
        let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 85);
        match gray {
            true => encoder.encode_image(&image::DynamicImage::ImageRgb8(image).into_luma8()),
            false => encoder.encode_image(&image),
        }
        .unwrap();
        bytes
    }

    #[test]
    fn a_file_that_was_cut_and_closed_is_found_and_a_whole_one_is_whole() {
        for whole in [jpeg(true), jpeg(false)] {
            assert!(!are_missing(&whole));
            let scan = whole.windows(2).position(|two| two == [0xFF, 0xDA]).unwrap() + 14;
            for length in scan..whole.len() - 3 {
                let closed = [&whole[..length], &[0xFF, 0xD9]].concat();
                assert!(are_missing(&closed), "{length} of {}", whole.len());
            }
        }
    }

    #[test]
    fn no_bytes_make_it_panic() {
        let whole = jpeg(false);
        for at in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[at] = damaged[at].wrapping_mul(37).wrapping_add(91);
            are_missing(&damaged);
            are_missing(&whole[..at]);
        }
    }
}
