//! PCD, binary: the Point Cloud Library's own format.

use crate::{Error, PointCloud};
use std::io::Write;

/// Writes `x y z`, `normal_x normal_y normal_z` and packed `rgb` where there are any. The writer should be buffered.
pub fn write_pcd(cloud: &PointCloud, mut out: impl Write) -> Result<(), Error> {
    cloud.check()?;
    let mut fields = vec!["x", "y", "z"];
    if !cloud.normals.is_empty() {
        fields.extend(["normal_x", "normal_y", "normal_z"]);
    }
    if !cloud.colors.is_empty() {
        fields.push("rgb");
    }
    let repeated = |word: &str| vec![word; fields.len()].join(" ");
    writeln!(out, "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}", fields.join(" "))?;
    // By the library's custom the three bytes of a colour travel in the bits of a float.
    writeln!(out, "SIZE {}\nTYPE {}\nCOUNT {}", repeated("4"), repeated("F"), repeated("1"))?;
    let count = cloud.len();
    writeln!(out, "WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary")?;
    for (index, point) in cloud.points.iter().enumerate() {
        for value in point.iter().chain(cloud.normals.get(index).into_iter().flatten()) {
            out.write_all(&value.to_le_bytes())?;
        }
        if let Some([r, g, b]) = cloud.colors.get(index) {
            out.write_all(&[*b, *g, *r, 0])?;
        }
    }
    Ok(out.flush()?)
}

#[cfg(test)]
mod tests {
    use super::super::tests::square;
    use super::*;

    #[test]
    fn the_header_counts_what_follows() {
        let mut bytes = Vec::new();
        write_pcd(&square().vertices, &mut bytes).unwrap();
        let end = bytes.windows(12).position(|window| window == b"DATA binary\n").unwrap() + 12;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        assert!(header.contains("FIELDS x y z normal_x normal_y normal_z rgb\n"));
        assert!(header.contains("POINTS 4\n"));
        assert_eq!(bytes.len() - end, 4 * 28);
        assert_eq!(bytes[end + 24..end + 28], [0, 0, 255, 0], "red");
    }
}
