//! STL: bare triangles in metres, as motion planners take collision geometry.

use crate::{Error, PointCloud, TriangleMesh};
use nalgebra::Vector3;
use std::io::{Read, Write};

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

/// Most triangles that are read: more than any robot's collision geometry has.
const MAX_TRIANGLES: usize = 20_000_000;

/// Reads an STL, binary or text, in the unit of the file; corners are not shared between triangles.
///
/// # Errors
/// A file that ends early, that has more than 20 million triangles, or that holds numbers that are none.
pub fn read_stl(mut source: impl Read) -> Result<TriangleMesh, Error> {
    let refuse = |reason: String| Error::Format { format: "STL", reason };
    let mut bytes = Vec::new();
    let limit = 84 + 50 * MAX_TRIANGLES as u64;
    source.by_ref().take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(refuse(format!("it has more than {MAX_TRIANGLES} triangles")));
    }
    let count =
        bytes.get(80..84).map_or(0, |count| u32::from_le_bytes([count[0], count[1], count[2], count[3]]) as usize);
    let mut points = Vec::new();
    // Binary files may begin with "solid" too; the length decides.
    if bytes.len() >= 84 && bytes.len() == 84 + 50 * count {
        for record in bytes[84..].chunks_exact(50) {
            let number = |at: usize| f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]);
            points.extend((0..3).map(|corner| std::array::from_fn(|axis| number(12 + 12 * corner + 4 * axis))));
        }
    } else if bytes.starts_with(b"solid") {
        let text = String::from_utf8_lossy(&bytes);
        let mut words = text.split_ascii_whitespace();
        while words.by_ref().any(|word| word == "vertex") {
            let mut number = || words.next().and_then(|word| word.parse::<f32>().ok());
            match (number(), number(), number()) {
                (Some(x), Some(y), Some(z)) => points.push([x, y, z]),
                _ => return Err(refuse(format!("corner {} has no three numbers", points.len() + 1))),
            }
        }
        if !points.len().is_multiple_of(3) || !text.contains("endsolid") {
            return Err(refuse(format!("it ends after {} corners", points.len())));
        }
    } else {
        let length = bytes.len();
        return Err(refuse(format!("it announces {count} triangles, which do not fit its {length} bytes")));
    }
    if let Some(index) = points.iter().flatten().position(|value| !value.is_finite()) {
        return Err(refuse(format!("corner {} is not finite", index / 3 + 1)));
    }
    let triangles = (0..points.len() as u32 / 3).map(|index| [3 * index, 3 * index + 1, 3 * index + 2]).collect();
    Ok(TriangleMesh { vertices: PointCloud { points, ..PointCloud::default() }, triangles })
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

    #[test]
    fn what_was_written_is_read_and_text_too() {
        let mut bytes = Vec::new();
        write_stl(&square(), &mut bytes).unwrap();
        let read = read_stl(bytes.as_slice()).unwrap();
        let corners = |mesh: &TriangleMesh| {
            mesh.triangles.iter().flatten().map(|&at| mesh.vertices.points[at as usize]).collect::<Vec<_>>()
        };
        assert_eq!(corners(&read), corners(&square()));
        let text = "solid one\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1e0 0 0\nvertex 0 2 0\nendloop\nendfacet\nendsolid";
        let read = read_stl(text.as_bytes()).unwrap();
        assert_eq!(read.vertices.points, [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]);
        let refusal = |bytes: &[u8]| read_stl(bytes).unwrap_err().to_string();
        assert!(refusal(&bytes[..bytes.len() - 7]).contains("announces 2 triangles"));
        assert!(refusal(b"").contains("announces 0"));
        assert!(refusal(text.replace("1e0", "one").as_bytes()).contains("corner 2"));
        assert!(refusal(&text.as_bytes()[..53]).contains("ends after"));
        assert!(refusal(text.replace("1e0", "NaN").as_bytes()).contains("not finite"));
        let mut greedy = bytes[..84].to_vec();
        greedy[80..84].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(refusal(&greedy).contains("4294967295"));
    }
}
