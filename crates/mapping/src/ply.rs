//! PLY: clouds and meshes to and from files.
//!
//! Writing is binary little-endian: `x y z` float (base frame, metres), `nx ny nz` float and `red green blue` uchar
//! where there are any, then the faces of a mesh. Reading takes ASCII and both binary orders, numbers of any type, and
//! ignores properties and elements it does not know.

use crate::{Error, Model, PointCloud, TriangleMesh};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{ElementDef, Property, PropertyAccess, PropertyAccessResult};
use std::io::{BufRead, Write};

/// Most vertices or faces that are read: more than any map, and little enough for 32-bit indices.
const MAX_ELEMENTS: usize = 200_000_000;

/// Writes a cloud or a mesh as binary little-endian PLY. The writer should be buffered.
pub fn write_ply(model: &Model, out: impl Write) -> Result<(), Error> {
    model.check()?;
    let faces = matches!(model, Model::Mesh(_)).then(|| model.triangles());
    write_parts(model.points(), faces, out)
}

/// Writes a cloud as binary little-endian PLY. The writer should be buffered.
pub fn write_cloud_ply(cloud: &PointCloud, out: impl Write) -> Result<(), Error> {
    cloud.check()?;
    write_parts(cloud, None, out)
}

fn write_parts(cloud: &PointCloud, faces: Option<&[[u32; 3]]>, mut out: impl Write) -> Result<(), Error> {
    writeln!(out, "ply\nformat binary_little_endian 1.0\ncomment base frame, metres\nelement vertex {}", cloud.len())?;
    writeln!(out, "property float x\nproperty float y\nproperty float z")?;
    if !cloud.normals.is_empty() {
        writeln!(out, "property float nx\nproperty float ny\nproperty float nz")?;
    }
    if !cloud.colors.is_empty() {
        writeln!(out, "property uchar red\nproperty uchar green\nproperty uchar blue")?;
    }
    if let Some(triangles) = faces {
        writeln!(out, "element face {}\nproperty list uchar int vertex_indices", triangles.len())?;
    }
    writeln!(out, "end_header")?;
    for index in 0..cloud.len() {
        let mut record = [0u8; 27];
        let mut end = 0;
        let normal = cloud.normals.get(index).into_iter().flatten();
        for value in cloud.points[index].iter().chain(normal) {
            record[end..end + 4].copy_from_slice(&value.to_le_bytes());
            end += 4;
        }
        for &value in cloud.colors.get(index).into_iter().flatten() {
            record[end] = value;
            end += 1;
        }
        out.write_all(&record[..end])?;
    }
    for triangle in faces.into_iter().flatten() {
        let mut record = [3u8; 13];
        for (corner, index) in triangle.iter().enumerate() {
            record[1 + 4 * corner..5 + 4 * corner].copy_from_slice(&index.to_le_bytes());
        }
        out.write_all(&record)?;
    }
    Ok(out.flush()?)
}

/// Reads a cloud or a mesh. Polygons become fans of triangles; a file that says it has faces is a mesh.
pub fn read_ply(source: impl BufRead) -> Result<Model, Error> {
    let mut reader = Reader::new(source);
    let header = Parser::<Ignored>::new().read_header(&mut reader).map_err(|error| refuse(error.to_string()))?;
    for element in header.elements.values() {
        check_element(element)?;
    }
    let Some(vertex) = header.elements.get("vertex") else {
        return Err(refuse("it has no element `vertex`".into()));
    };
    for name in ["x", "y", "z"] {
        if !vertex.properties.contains_key(name) {
            return Err(refuse(format!("its vertices have no property `{name}`")));
        }
    }
    let has = |names: [&str; 3]| names.iter().all(|name| vertex.properties.contains_key(*name));
    let has_normals = has(["nx", "ny", "nz"]);
    let has_colors = has(["red", "green", "blue"]);
    let mut cloud = PointCloud::default();
    let mut faces: Option<Vec<Face>> = None;
    for element in header.elements.values() {
        match element.name.as_str() {
            "vertex" => {
                let vertices: Vec<Vertex> = payload(&mut reader, element, &header)?;
                cloud.points = vertices.iter().map(|vertex| vertex.point).collect();
                if has_normals {
                    cloud.normals = vertices.iter().map(|vertex| vertex.normal).collect();
                }
                if has_colors {
                    cloud.colors = vertices.iter().map(|vertex| vertex.color).collect();
                }
            }
            "face" => faces = Some(payload(&mut reader, element, &header)?),
            _ => drop(payload::<Ignored, _>(&mut reader, element, &header)?),
        }
    }
    let model = match faces {
        None => Model::Cloud(cloud),
        Some(faces) => Model::Mesh(TriangleMesh { triangles: triangles(&faces, cloud.len())?, vertices: cloud }),
    };
    model.check().map_err(|error| refuse(error.to_string()))?;
    Ok(model)
}

fn refuse(reason: String) -> Error {
    Error::Format { format: "PLY", reason }
}

fn check_element(element: &ElementDef) -> Result<(), Error> {
    if element.count > MAX_ELEMENTS {
        let (name, count) = (&element.name, element.count);
        return Err(refuse(format!("it announces {count} elements `{name}`, more than {MAX_ELEMENTS}")));
    }
    // Elements without properties take no bytes, so a few letters could announce any number of them.
    if element.properties.is_empty() && element.count > 0 {
        return Err(refuse(format!("element `{}` has no properties", element.name)));
    }
    Ok(())
}

fn payload<E: PropertyAccess, T: BufRead>(
    reader: &mut Reader<T>,
    element: &ElementDef,
    header: &ply_rs_bw::ply::Header,
) -> Result<Vec<E>, Error> {
    Parser::<E>::new().read_payload_for_element(reader, element, header).map_err(|error| {
        let (name, count) = (&element.name, element.count);
        if error.kind() == std::io::ErrorKind::UnexpectedEof {
            refuse(format!("it ends before the {count} elements `{name}` that its header announces"))
        } else {
            refuse(format!("element `{name}`: {error}"))
        }
    })
}

fn triangles(faces: &[Face], vertices: usize) -> Result<Vec<[u32; 3]>, Error> {
    let mut triangles = Vec::with_capacity(faces.len());
    for (number, Face(corners)) in faces.iter().enumerate() {
        if let Some(bad) = corners.iter().find(|&&index| index < 0 || index as usize >= vertices) {
            return Err(refuse(format!("face {number} names vertex {bad} of {vertices}")));
        }
        for pair in corners.get(1..).unwrap_or_default().windows(2) {
            triangles.push([corners[0] as u32, pair[0] as u32, pair[1] as u32]);
        }
    }
    Ok(triangles)
}

/// An element that nobody asked for.
struct Ignored;

impl PropertyAccess for Ignored {
    fn new() -> Self {
        Ignored
    }
}

struct Vertex {
    point: [f32; 3],
    normal: [f32; 3],
    color: [u8; 3],
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Vertex { point: [0.0; 3], normal: [0.0; 3], color: [0; 3] }
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        let number = match name {
            "x" => &mut self.point[0],
            "y" => &mut self.point[1],
            "z" => &mut self.point[2],
            "nx" => &mut self.normal[0],
            "ny" => &mut self.normal[1],
            "nz" => &mut self.normal[2],
            "red" | "green" | "blue" => {
                let channel = match name {
                    "red" => 0,
                    "green" => 1,
                    _ => 2,
                };
                return match property.to_u8_color_lossy() {
                    Some(value) => {
                        self.color[channel] = value;
                        PropertyAccessResult::Set
                    }
                    None => PropertyAccessResult::UnsupportedType,
                };
            }
            _ => return PropertyAccessResult::Ignored,
        };
        match property.to_f32_lossy() {
            Some(value) => {
                *number = value;
                PropertyAccessResult::Set
            }
            None => PropertyAccessResult::UnsupportedType,
        }
    }
}

/// Indices as written in the file; -1 and beyond are refused later, with the face's number.
struct Face(Vec<i64>);

impl PropertyAccess for Face {
    fn new() -> Self {
        Face(Vec::new())
    }

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        self.0 = match property {
            Property::ListChar(list) => list.into_iter().map(i64::from).collect(),
            Property::ListUChar(list) => list.into_iter().map(i64::from).collect(),
            Property::ListShort(list) => list.into_iter().map(i64::from).collect(),
            Property::ListUShort(list) => list.into_iter().map(i64::from).collect(),
            Property::ListInt(list) => list.into_iter().map(i64::from).collect(),
            Property::ListUInt(list) => list.into_iter().map(i64::from).collect(),
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sample(with_normals: bool, with_colors: bool) -> PointCloud {
        let normals = if with_normals { vec![[0.0, 0.0, 1.0]; 4] } else { vec![] };
        let colors = if with_colors { vec![[1, 2, 3], [4, 5, 6], [7, 8, 9], [255, 0, 128]] } else { vec![] };
        PointCloud {
            points: vec![[0.0, 0.5, -1.0], [1.0, 0.0, 0.25], [0.0, 1.0, 3.5], [1.0, 1.0, 0.0]],
            colors,
            normals,
        }
    }

    fn written(model: &Model) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_ply(model, &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn clouds_and_meshes_come_back_as_they_were() {
        for (with_normals, with_colors) in [(false, false), (true, false), (false, true), (true, true)] {
            let cloud = Model::Cloud(sample(with_normals, with_colors));
            assert_eq!(read_ply(written(&cloud).as_slice()).unwrap(), cloud);
            let vertices = sample(with_normals, with_colors);
            let mesh = Model::Mesh(TriangleMesh { vertices, triangles: vec![[0, 1, 2], [2, 1, 3]] });
            assert_eq!(read_ply(written(&mesh).as_slice()).unwrap(), mesh);
        }
    }

    #[test]
    fn every_truncation_is_an_error() {
        let mesh = TriangleMesh { vertices: sample(true, true), triangles: vec![[0, 1, 2], [2, 1, 3]] };
        let bytes = written(&mesh.into());
        for end in 0..bytes.len() {
            assert!(matches!(read_ply(&bytes[..end]), Err(Error::Format { format: "PLY", .. })), "cut at {end}");
        }
    }

    #[test]
    fn ascii_with_doubles_quads_and_foreign_properties_is_understood() {
        let text = "ply\nformat ascii 1.0\nelement camera 1\nproperty float f\nelement vertex 4\nproperty double x\n\
            property double y\nproperty uchar quality\nproperty double z\nelement face 1\n\
            property list uchar uint vertex_index\nend_header\n7\n0 0 9 0\n1 0 9 0\n1 1 9 0\n0 1 9 0.5\n4 0 1 2 3\n";
        let model = read_ply(text.as_bytes()).unwrap();
        assert_eq!(model.triangles(), [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(model.points().points[3], [0.0, 1.0, 0.5]);
    }

    #[test]
    fn what_is_wrong_is_said() {
        let refused = |text: &str| read_ply(text.as_bytes()).unwrap_err().to_string();
        let head = "ply\nformat ascii 1.0\n";
        assert!(refused("solid stl").contains("PLY"));
        assert!(
            refused(&format!("{head}element face 0\nproperty list uchar int vertex_indices\nend_header\n"))
                .contains("`vertex`")
        );
        assert!(refused(&format!("{head}element vertex 0\nproperty float x\nend_header\n")).contains("`y`"));
        let vertex = "property float x\nproperty float y\nproperty float z\n";
        assert!(refused(&format!("{head}element vertex 99999999999\n{vertex}end_header\n")).contains("99999999999"));
        let mut not_a_number = written(&Model::Cloud(sample(false, false)));
        let end = not_a_number.len();
        not_a_number[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(read_ply(not_a_number.as_slice()).unwrap_err().to_string().contains("NaN"));
        assert!(
            refused(&format!("{head}element nothing 100000000\nelement vertex 0\n{vertex}end_header\n"))
                .contains("`nothing`")
        );
        let face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 5\n";
        assert!(refused(&format!("{head}element vertex 1\n{vertex}{face}")).contains("vertex 5 of 1"));
    }

    proptest! {
        #[test]
        fn random_damage_never_panics(position in 0usize..400, value: u8) {
            let mesh = TriangleMesh { vertices: sample(true, true), triangles: vec![[0, 1, 2], [2, 1, 3]] };
            let mut bytes = written(&mesh.into());
            let position = position % bytes.len();
            bytes[position] = value;
            let _ = read_ply(bytes.as_slice());
        }
    }
}
