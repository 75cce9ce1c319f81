//! Wavefront OBJ: text, with the widespread extension of a colour behind each vertex.

use crate::{Error, TriangleMesh};
use std::io::Write;

/// Writes vertices (metres, base frame), colours from 0 to 1, normals and triangles. The writer should be buffered.
pub fn write_obj(mesh: &TriangleMesh, mut out: impl Write) -> Result<(), Error> {
    mesh.check()?;
    writeln!(out, "# base frame, metres")?;
    for (index, [x, y, z]) in mesh.vertices.points.iter().enumerate() {
        match mesh.vertices.colors.get(index) {
            Some(color) => {
                let [r, g, b] = color.map(|value| f32::from(value) / 255.0);
                writeln!(out, "v {x} {y} {z} {r:.4} {g:.4} {b:.4}")?;
            }
            None => writeln!(out, "v {x} {y} {z}")?,
        }
    }
    for [x, y, z] in &mesh.vertices.normals {
        writeln!(out, "vn {x:.4} {y:.4} {z:.4}")?;
    }
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|corner| u64::from(corner) + 1);
        if mesh.vertices.normals.is_empty() {
            writeln!(out, "f {a} {b} {c}")?;
        } else {
            writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
        }
    }
    Ok(out.flush()?)
}

#[cfg(test)]
mod tests {
    use super::super::tests::square;
    use super::*;

    #[test]
    fn lines_are_as_the_format_wants_them() {
        let mut bytes = Vec::new();
        write_obj(&square(), &mut bytes).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[1], "v 0 0 0.5 1.0000 0.0000 0.0000");
        assert_eq!(lines[5], "vn 0.0000 0.0000 1.0000");
        assert_eq!(lines[10], "f 1//1 3//3 4//4");
    }
}
