//! NumPy's `.npz`: a ZIP archive, nothing compressed, of arrays in format 1.0 of `.npy`.

use crate::Error;
use std::io::Write;

/// An archive being written.
pub(super) struct Npz<W> {
    out: W,
    offset: u64,
    directory: Vec<u8>,
    entries: u16,
}

impl<W: Write> Npz<W> {
    pub(super) fn new(out: W) -> Self {
        Npz { out, offset: 0, directory: Vec::new(), entries: 0 }
    }

    /// Adds an array in C order; `descr` is NumPy's name of its type.
    pub(super) fn add(&mut self, name: &str, descr: &str, shape: &[usize], bytes: &[u8]) -> Result<(), Error> {
        let lengths: String = shape.iter().map(|length| format!("{length},")).collect();
        let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({lengths}), }}");
        // The data begin at a multiple of 64 bytes, after a line end.
        let unpadded = 10 + header.len() + 1;
        header.push_str(&" ".repeat(unpadded.next_multiple_of(64) - unpadded));
        header.push('\n');
        let mut array = b"\x93NUMPY\x01\x00".to_vec();
        array.extend_from_slice(&(header.len() as u16).to_le_bytes());
        array.extend_from_slice(header.as_bytes());
        let length = (array.len() + bytes.len()) as u64;
        let file = format!("{name}.npy");
        let too_large = || Error::Format {
            format: "NPZ",
            reason: format!("{file} of {length} bytes does not fit into an archive of 4 GiB; use larger cells"),
        };
        let length = u32::try_from(length).map_err(|_| too_large())?;
        let offset = u32::try_from(self.offset).map_err(|_| too_large())?;
        let checksum = crc32(crc32(0, &array), bytes);
        // Version 2.0, no flags, stored; 1980-01-01 so that the same map gives the same bytes.
        let mut shared = Vec::new();
        for word in [20u16, 0, 0, 0, 0x21] {
            shared.extend_from_slice(&word.to_le_bytes());
        }
        for word in [checksum, length, length] {
            shared.extend_from_slice(&word.to_le_bytes());
        }
        shared.extend_from_slice(&(file.len() as u16).to_le_bytes());
        shared.extend_from_slice(&0u16.to_le_bytes());
        let local = [b"PK\x03\x04".as_slice(), &shared, file.as_bytes()].concat();
        for part in [&local, &array, bytes] {
            self.out.write_all(part)?;
            self.offset += part.len() as u64;
        }
        // Comment length, disk, internal and external attributes: all 0.
        let central =
            [b"PK\x01\x02\x14\x00".as_slice(), &shared, &[0; 10], &offset.to_le_bytes(), file.as_bytes()].concat();
        self.directory.extend_from_slice(&central);
        self.entries += 1;
        Ok(())
    }

    pub(super) fn finish(mut self) -> Result<(), Error> {
        let offset = u32::try_from(self.offset).map_err(|_| Error::Format {
            format: "NPZ",
            reason: "the archive exceeds 4 GiB; use larger cells".into(),
        })?;
        self.out.write_all(&self.directory)?;
        self.out.write_all(b"PK\x05\x06\0\0\0\0")?;
        self.out.write_all(&self.entries.to_le_bytes())?;
        self.out.write_all(&self.entries.to_le_bytes())?;
        self.out.write_all(&(self.directory.len() as u32).to_le_bytes())?;
        self.out.write_all(&offset.to_le_bytes())?;
        self.out.write_all(&[0, 0])?;
        Ok(self.out.flush()?)
    }
}

/// CRC-32 of ISO-HDLC, continued from the checksum of what came before.
fn crc32(before: u32, bytes: &[u8]) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0u32; 256];
        let mut index = 0;
        while index < 256 {
            let mut value = index as u32;
            let mut bit = 0;
            while bit < 8 {
                value = if value & 1 == 1 { value >> 1 ^ 0xedb8_8320 } else { value >> 1 };
                bit += 1;
            }
            table[index] = value;
            index += 1;
        }
        table
    };
    !bytes.iter().fold(!before, |value, byte| TABLE[((value ^ u32::from(*byte)) & 255) as usize] ^ value >> 8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_the_usual_one() {
        assert_eq!(crc32(0, b"123456789"), 0xcbf4_3926);
        assert_eq!(crc32(crc32(0, b"1234"), b"56789"), 0xcbf4_3926);
    }

    #[test]
    fn data_begin_at_a_multiple_of_64_in_their_array() {
        let mut bytes = Vec::new();
        let mut archive = Npz::new(&mut bytes);
        archive.add("a", "|u1", &[2, 3], &[1, 2, 3, 4, 5, 6]).unwrap();
        archive.finish().unwrap();
        let start = bytes.windows(6).position(|window| window == b"\x93NUMPY").unwrap();
        let length = usize::from(u16::from_le_bytes([bytes[start + 8], bytes[start + 9]]));
        assert_eq!((10 + length) % 64, 0);
        assert_eq!(bytes[start + 10 + length..][..6], [1, 2, 3, 4, 5, 6]);
        assert!(String::from_utf8_lossy(&bytes).contains("'shape': (2,3,)"));
    }
}
