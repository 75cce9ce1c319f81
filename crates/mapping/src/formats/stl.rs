//! STL, binary: bare triangles in metres, as motion planners take collision geometry.

use crate::{Error, TriangleMesh};
use nalgebra::Vector3;
use std::io::Write;

/// Writes the triangles with their normals; colours and vertex normals have no place in the format.
pub fn write_stl(mesh: &TriangleMesh, mut out: impl Write) -> Result<(), Error> {
    mesh.check()?;
    let count = u32::try_from(mesh.triangles.len()).map_err(|_| Error::Format {
        format: "STL",
        reason: format!("{} triangles are more than the format can count", mesh.triangles.len()),
    })?;
    // A header that began with "solid" would make readers expect text.
    let mut header = [b' '; 80];
    header[..24].copy_from_slice(b"binary, metres, base fra");
    out.write_all(&header)?;
    out.write_all(&count.to_le_bytes())?;
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|corner| Vector3::from(mesh.vertices.points[corner as usize]));
        let normal = (b - a).cross(&(c - a)).try_normalize(1e-20).unwrap_or_default();
        let mut record = [0u8; 50];
        for (index, value) in [normal, a, b, c].iter().flat_map(|vector| vector.iter()).enumerate() {
            record[4 * index..4 * index + 4].copy_from_slice(&value.to_le_bytes());
        }
        out.write_all(&record)?;
    }
    Ok(out.flush()?)
}

#[cfg(test)]
mod tests {
    use super::super::tests::square;
    use super::*;

    #[test]
    fn a_record_is_fifty_bytes_and_starts_with_the_normal() {
        let mut bytes = Vec::new();
        write_stl(&square(), &mut bytes).unwrap();
        assert_eq!(bytes.len(), 84 + 2 * 50);
        assert!(!bytes.starts_with(b"solid"));
        assert_eq!(u32::from_le_bytes(bytes[80..84].try_into().unwrap()), 2);
        let number = |at: usize| f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        assert_eq!([number(84), number(88), number(92)], [0.0, 0.0, 1.0]);
        assert_eq!([number(108), number(112), number(116)], [1.0, 0.0, 0.5], "the second corner");
    }
}
