//! Binary glTF 2.0: what browsers and most viewers open.
//!
//! glTF's y axis points up and its vertex colours are linear light; the base's z axis points up and cameras' colours
//! are sRGB. A rotated node and a conversion of the colours see to both.

use crate::{Error, TriangleMesh};
use std::io::Write;

const FLOAT: u32 = 5126;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Buffer views and accessors as JSON, one each per attribute, and the bytes they describe.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<String>,
    accessors: Vec<String>,
}

impl Buffer {
    /// Adds an attribute and returns its accessor's number.
    fn add(&mut self, bytes: &[u8], target: u32, accessor: &str) -> usize {
        let (offset, length) = (self.bytes.len(), bytes.len());
        self.bytes.extend_from_slice(bytes);
        let number = self.views.len();
        self.views.push(format!(r#"{{"buffer":0,"byteOffset":{offset},"byteLength":{length},"target":{target}}}"#));
        self.accessors.push(format!(r#"{{"bufferView":{number},{accessor}}}"#));
        number
    }
}

/// Writes a mesh with its normals and colours. An empty mesh is an error, since the format cannot hold one.
pub fn write_glb(mesh: &TriangleMesh, mut out: impl Write) -> Result<(), Error> {
    mesh.check()?;
    let count = mesh.vertices.len();
    let Some((low, high)) = mesh.vertices.bounds().filter(|_| !mesh.triangles.is_empty()) else {
        return Err(Error::Empty { what: "a mesh for GLB", advice: "the format cannot hold a mesh without triangles" });
    };
    let flat = |list: &[[f32; 3]]| list.iter().flatten().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let mut buffer = Buffer::default();
    let position = format!(
        r#""componentType":{FLOAT},"count":{count},"type":"VEC3","min":[{},{},{}],"max":[{},{},{}]"#,
        low[0], low[1], low[2], high[0], high[1], high[2]
    );
    let mut attributes =
        vec![format!(r#""POSITION":{}"#, buffer.add(&flat(&mesh.vertices.points), ARRAY_BUFFER, &position))];
    if !mesh.vertices.normals.is_empty() {
        let accessor = format!(r#""componentType":{FLOAT},"count":{count},"type":"VEC3""#);
        let number = buffer.add(&flat(&mesh.vertices.normals), ARRAY_BUFFER, &accessor);
        attributes.push(format!(r#""NORMAL":{number}"#));
    }
    if !mesh.vertices.colors.is_empty() {
        let linear: [u16; 256] = std::array::from_fn(linear_light);
        let colors = mesh.vertices.colors.iter().flat_map(|color| {
            let [r, g, b] = color.map(|value| linear[usize::from(value)]);
            [r, g, b, u16::MAX].into_iter().flat_map(u16::to_le_bytes)
        });
        let accessor = format!(r#""componentType":{UNSIGNED_SHORT},"normalized":true,"count":{count},"type":"VEC4""#);
        let number = buffer.add(&colors.collect::<Vec<u8>>(), ARRAY_BUFFER, &accessor);
        attributes.push(format!(r#""COLOR_0":{number}"#));
    }
    let indices: Vec<u8> = mesh.triangles.iter().flatten().flat_map(|index| index.to_le_bytes()).collect();
    let accessor = format!(r#""componentType":{UNSIGNED_INT},"count":{},"type":"SCALAR""#, 3 * mesh.triangles.len());
    let indices = buffer.add(&indices, ELEMENT_ARRAY_BUFFER, &accessor);
    let mut json = format!(
        concat!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"#,
            r#""nodes":[{{"mesh":0,"rotation":[-0.7071067811865476,0,0,0.7071067811865476]}}],"#,
            r#""materials":[{{"pbrMetallicRoughness":{{"metallicFactor":0,"roughnessFactor":1}},"doubleSided":true}}],"#,
            r#""meshes":[{{"primitives":[{{"attributes":{{{attributes}}},"indices":{indices},"material":0}}]}}],"#,
            r#""buffers":[{{"byteLength":{length}}}],"bufferViews":[{views}],"accessors":[{accessors}]}}"#
        ),
        attributes = attributes.join(","),
        indices = indices,
        length = buffer.bytes.len(),
        views = buffer.views.join(","),
        accessors = buffer.accessors.join(","),
    );
    while json.len() % 4 != 0 {
        json.push(' ');
    }
    let total = 12 + 8 + json.len() + 8 + buffer.bytes.len();
    let total = u32::try_from(total).map_err(|_| Error::Format {
        format: "GLB",
        reason: format!("{total} bytes are more than the format can count; decimate the mesh"),
    })?;
    out.write_all(b"glTF")?;
    for word in [2, total, json.len() as u32] {
        out.write_all(&word.to_le_bytes())?;
    }
    out.write_all(b"JSON")?;
    out.write_all(json.as_bytes())?;
    out.write_all(&(buffer.bytes.len() as u32).to_le_bytes())?;
    out.write_all(b"BIN\0")?;
    out.write_all(&buffer.bytes)?;
    Ok(out.flush()?)
}

/// sRGB (IEC 61966-2-1) to linear light on a scale of 65535.
fn linear_light(value: usize) -> u16 {
    let encoded = value as f64 / 255.0;
    let linear = if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
    (linear * 65535.0).round() as u16
}

#[cfg(test)]
mod tests {
    use super::super::tests::square;
    use super::*;

    #[test]
    fn chunks_are_whole_and_the_json_describes_them() {
        let mut bytes = Vec::new();
        write_glb(&square(), &mut bytes).unwrap();
        let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(&bytes[..4], b"glTF");
        assert_eq!((word(4), word(8)), (2, bytes.len()));
        let json: serde_json::Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
        let binary = 20 + word(12);
        assert_eq!(binary % 4, 0);
        assert_eq!(binary + 8 + word(binary), bytes.len());
        assert_eq!(json["buffers"][0]["byteLength"], word(binary));
        assert_eq!(json["accessors"][0]["max"][2], 0.5);
        assert_eq!(json["meshes"][0]["primitives"][0]["indices"], 3);
        assert_eq!(json["accessors"][3]["count"], 6);
        let view = &json["bufferViews"][3];
        assert_eq!(view["byteOffset"].as_u64().unwrap() + view["byteLength"].as_u64().unwrap(), word(binary) as u64);
        assert!(matches!(write_glb(&TriangleMesh::default(), Vec::new()), Err(Error::Empty { .. })));
    }

    #[test]
    fn linear_light_keeps_the_ends_and_darkens_the_middle() {
        assert_eq!((linear_light(0), linear_light(255)), (0, 65535));
        assert_eq!(linear_light(128), 14146);
    }
}
