//! TUM folders as one text, so that all of a folder can be damaged at once.

use std::path::Path;

/// A folder in TUM's layout as one text: its lists, and an image by its bytes in hex, so that all of it can be damaged.
pub fn folder() -> Vec<u8> {
    let mut png = Vec::new();
    let gray = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(4, 2, vec![500u16; 8]).unwrap();
    gray.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).unwrap();
    let list = |name: &str| format!("# time file\n1.000000 {name}.png\n1.500000 {name}.png\n");
    let poses = "# tx ty tz qx qy qz qw\n0.9 0 0 0.1 0 0 0 1\n1.6 0 0 0.2 0 0 0 1\n";
    let mut bytes = Vec::new();
    for part in [list("rgb").as_bytes(), list("depth").as_bytes(), poses.as_bytes(), &png] {
        bytes.extend(part);
        bytes.extend(TUM_CUT);
    }
    bytes
}

/// Separates the files of a [`folder`] folder.
const TUM_CUT: &[u8] = b"\n--8<--\n";

/// Writes the files of a [`folder`] folder; what lost its cut is empty.
pub fn write(folder: &Path, bytes: &[u8]) {
    let mut rest = bytes;
    let files = [&["rgb.txt"][..], &["depth.txt"], &["groundtruth.txt"], &["rgb.png", "depth.png"]];
    for names in files {
        let end = rest.windows(TUM_CUT.len()).position(|window| window == TUM_CUT).unwrap_or(rest.len());
        let (part, after) = rest.split_at(end);
        names.iter().for_each(|name| std::fs::write(folder.join(name), part).unwrap());
        rest = after.get(TUM_CUT.len()..).unwrap_or_default();
    }
}
