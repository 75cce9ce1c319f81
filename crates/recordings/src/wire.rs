//! The two wire formats of ROS messages: little-endian and packed (ROS 1), and CDR (ROS 2; OMG DDS-XTypes 7.4.1, the
//! plain encoding), in which every number is aligned to its size, counted from behind a header of four bytes.
//!
//! A length is trusted only as far as bytes are there, so that a damaged one is an error and no allocation.

use serde::Serialize;

/// How messages are laid out in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum WireFormat {
    /// ROS 1.
    Ros1,
    /// ROS 2.
    Cdr,
}

/// What is wrong with a message's bytes.
pub(crate) type WireProblem = String;

/// A cursor over one message. `complete: false` where only the beginning of the message was read.
#[derive(Debug, Clone)]
pub(crate) struct Wire<'a> {
    bytes: &'a [u8],
    at: usize,
    aligned: bool,
    big_endian: bool,
    terminated_strings: bool,
}

impl<'a> Wire<'a> {
    pub fn new(format: WireFormat, bytes: &'a [u8]) -> Result<Self, WireProblem> {
        match format {
            WireFormat::Ros1 => Ok(Wire { bytes, at: 0, aligned: false, big_endian: false, terminated_strings: false }),
            WireFormat::Cdr => {
                let [0, kind @ (0 | 1), _, _, body @ ..] = bytes else {
                    return Err(format!(
                        "the CDR header is {:02x?}; 00 00 or 00 01 is read (plain CDR)",
                        &bytes[..bytes.len().min(4)]
                    ));
                };
                Ok(Wire { bytes: body, at: 0, aligned: true, big_endian: *kind == 0, terminated_strings: true })
            }
        }
    }

    pub fn is_ros1(&self) -> bool {
        !self.aligned
    }

    pub fn bytes(&mut self, count: usize) -> Result<&'a [u8], WireProblem> {
        match self.at.checked_add(count).and_then(|end| self.bytes.get(self.at..end)) {
            Some(found) => {
                self.at += count;
                Ok(found)
            }
            None => Err(format!(
                "{count} bytes are announced at byte {}, but the message has {}",
                self.at,
                self.bytes.len()
            )),
        }
    }

    /// What is left, where the message may be cut short.
    pub fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    fn number<const N: usize>(&mut self) -> Result<[u8; N], WireProblem> {
        if self.aligned {
            self.at = self.at.next_multiple_of(N);
        }
        let mut value = [0; N];
        value.copy_from_slice(self.bytes(N)?);
        if self.big_endian {
            value.reverse();
        }
        Ok(value)
    }

    pub fn u8(&mut self) -> Result<u8, WireProblem> {
        Ok(self.number::<1>()?[0])
    }

    pub fn u32(&mut self) -> Result<u32, WireProblem> {
        self.number().map(u32::from_le_bytes)
    }

    pub fn f32(&mut self) -> Result<f32, WireProblem> {
        self.number().map(f32::from_le_bytes)
    }

    pub fn f64(&mut self) -> Result<f64, WireProblem> {
        self.number().map(f64::from_le_bytes)
    }

    pub fn string(&mut self) -> Result<&'a str, WireProblem> {
        let length = self.u32()? as usize;
        let mut bytes = self.bytes(length)?;
        if self.terminated_strings
            && let [text @ .., 0] = bytes
        {
            bytes = text;
        }
        std::str::from_utf8(bytes).map_err(|_| format!("a text of {length} bytes is not UTF-8"))
    }

    /// A sequence of `f64`.
    pub fn f64s(&mut self) -> Result<Vec<f64>, WireProblem> {
        let count = self.count(8)?;
        (0..count).map(|_| self.f64()).collect()
    }

    pub fn f64_array<const N: usize>(&mut self) -> Result<[f64; N], WireProblem> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    pub fn strings(&mut self) -> Result<Vec<&'a str>, WireProblem> {
        let count = self.count(4)?;
        (0..count).map(|_| self.string()).collect()
    }

    pub fn byte_sequence(&mut self) -> Result<&'a [u8], WireProblem> {
        let count = self.u32()? as usize;
        self.bytes(count)
    }

    /// The length of a sequence whose elements take at least `least` bytes each.
    pub fn count(&mut self, least: usize) -> Result<usize, WireProblem> {
        let count = self.u32()? as usize;
        let left = self.rest().len();
        if count.saturating_mul(least) > left + 8 {
            return Err(format!("a sequence of {count} elements is announced, but only {left} bytes are left"));
        }
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cdr_aligns_and_ros1_does_not() {
        let cdr = [0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f];
        let mut wire = Wire::new(WireFormat::Cdr, &cdr).unwrap();
        assert_eq!((wire.u8().unwrap(), wire.f64().unwrap()), (7, 1.0));
        let ros1 = [7, 0, 0, 0, 0, 0, 0, 0xf0, 0x3f];
        let mut wire = Wire::new(WireFormat::Ros1, &ros1).unwrap();
        assert_eq!((wire.u8().unwrap(), wire.f64().unwrap()), (7, 1.0));
        let big = [0, 0, 0, 0, 0, 0, 0, 3, b'a', b'b', 0];
        assert_eq!(Wire::new(WireFormat::Cdr, &big).unwrap().string().unwrap(), "ab");
    }

    #[test]
    fn lengths_are_not_trusted() {
        let lies = [0xff, 0xff, 0xff, 0xff, 1, 2, 3];
        let wire = || Wire::new(WireFormat::Ros1, &lies).unwrap();
        assert!(wire().string().unwrap_err().contains("4294967295 bytes"));
        assert!(wire().f64s().unwrap_err().contains("4294967295 elements"));
        assert!(wire().strings().is_err() && wire().byte_sequence().is_err());
        assert!(Wire::new(WireFormat::Cdr, &[0, 3, 0, 0]).unwrap_err().contains("CDR header"));
        assert!(Wire::new(WireFormat::Cdr, &[]).is_err());
    }
}
