//! Numbers by the thousand and images as text inside JSON.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};

/// A list of numbers: base64 of their little-endian bytes. The type follows from the field that holds it.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Packed(pub String);

impl Packed {
    /// 32-bit floating-point numbers.
    pub fn of_f32(values: impl IntoIterator<Item = f32>) -> Self {
        let bytes: Vec<u8> = values.into_iter().flat_map(f32::to_le_bytes).collect();
        Packed(STANDARD.encode(bytes))
    }

    /// Unsigned 16-bit numbers.
    pub fn of_u16(values: impl IntoIterator<Item = u16>) -> Self {
        let bytes: Vec<u8> = values.into_iter().flat_map(u16::to_le_bytes).collect();
        Packed(STANDARD.encode(bytes))
    }

    /// Bytes.
    pub fn of_u8(values: &[u8]) -> Self {
        Packed(STANDARD.encode(values))
    }

    /// The bytes again; `None` where the text is no base64.
    pub fn bytes(&self) -> Option<Vec<u8>> {
        STANDARD.decode(&self.0).ok()
    }
}

/// A JPEG image.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EmbeddedImage {
    /// Pixels across.
    pub width: u32,
    /// Pixels down.
    pub height: u32,
    /// The file.
    pub jpeg: Packed,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_come_back() {
        let bytes = Packed::of_f32([1.5, -2.0]).bytes().unwrap();
        assert_eq!(bytes, [0, 0, 0xc0, 0x3f, 0, 0, 0, 0xc0]);
        assert_eq!(Packed::of_u16([258]).bytes().unwrap(), [2, 1]);
        assert_eq!(Packed("!".to_owned()).bytes(), None);
    }
}
