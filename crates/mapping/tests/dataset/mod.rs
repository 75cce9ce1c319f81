//! Reads the reference datasets for tests, examples and benchmarks of this crate: cameras from `rig.toml`, poses from
//! `truth/trajectory.txt` or, where the flange's pose is that of the camera, from `postures.csv`.
//! (The program's own reader lives above this crate, which knows no files of datasets.)

use image::RgbImage;
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use skclam_geometry::{DepthCamera, DepthImage, PinholeCamera};
use skclam_mapping::View;
use std::path::{Path, PathBuf};

/// One image pair and where it was taken.
pub struct Shot {
    /// z-depth, metres.
    pub depth: DepthImage,
    /// The colour image.
    pub color: RgbImage,
    /// True or published pose of the colour camera.
    pub base_from_color: Isometry3<f64>,
}

/// A dataset in memory.
pub struct Dataset {
    /// The depth camera.
    pub depth_camera: DepthCamera,
    /// The colour camera.
    pub color_camera: PinholeCamera,
    /// All image pairs.
    pub shots: Vec<Shot>,
}

/// `$SKCLAM_DATA`, or `../shared/data` beside the repository; `None`, with the reason printed, when it is not there.
#[allow(dead_code)] // examples are given their folder
pub fn data_folder(name: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SKCLAM_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), PathBuf::from);
    let folder = root.join(name);
    if !folder.join("rig.toml").is_file() {
        eprintln!("skipped: {} is not there (set SKCLAM_DATA)", folder.display());
        return None;
    }
    Some(folder)
}

/// Loads up to `limit` shots.
pub fn load(folder: &Path, limit: usize) -> Dataset {
    let rig: toml::Table = std::fs::read_to_string(folder.join("rig.toml")).unwrap().parse().unwrap();
    let depth_table = rig["depth"].as_table().unwrap();
    let color_from_depth = depth_table.get("color_from_depth").map_or_else(Isometry3::identity, pose);
    let depth_camera = DepthCamera {
        camera: pinhole(depth_table),
        unit_m: number(&depth_table["unit_mm"]) / 1000.0,
        offset_m: 0.0,
        color_from_depth,
    };
    let color_camera = pinhole(rig["color"].as_table().unwrap());
    let flange_from_color = pose(&rig["mount"]);
    let csv = std::fs::read_to_string(folder.join("postures.csv")).unwrap();
    let mut lines = csv.lines();
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    let truth = std::fs::read_to_string(folder.join("truth/trajectory.txt")).ok();
    let mut true_poses = truth.as_deref().map(|text| text.lines().filter(|line| !line.starts_with('#')));
    let shots = lines
        .take(limit)
        .map(|line| {
            let fields: Vec<&str> = line.split(',').collect();
            let field = |name: &str| fields[header.iter().position(|column| *column == name).unwrap()];
            let base_from_color = match &mut true_poses {
                Some(poses) => {
                    let n: Vec<f64> =
                        poses.next().unwrap().split_whitespace().map(|word| word.parse().unwrap()).collect();
                    isometry([n[1], n[2], n[3]], [n[4], n[5], n[6], n[7]])
                }
                None => {
                    let [x, y, z] = ["x_mm", "y_mm", "z_mm"].map(|name| field(name).parse::<f64>().unwrap() / 1000.0);
                    let quaternion = ["qx", "qy", "qz", "qw"].map(|name| field(name).parse().unwrap());
                    isometry([x, y, z], quaternion) * flange_from_color
                }
            };
            let counts = image::open(folder.join(field("depth"))).unwrap().into_luma16();
            Shot {
                depth: DepthImage::from_counts(&depth_camera, counts.as_raw()).unwrap(),
                color: image::open(folder.join(field("color"))).unwrap().into_rgb8(),
                base_from_color,
            }
        })
        .collect();
    Dataset { depth_camera, color_camera, shots }
}

impl Dataset {
    /// A shot as this crate takes it.
    pub fn view(&self, index: usize) -> View<'_> {
        let shot = &self.shots[index];
        View {
            depth: &shot.depth,
            color: Some(&shot.color),
            depth_camera: &self.depth_camera,
            color_camera: &self.color_camera,
            base_from_color: shot.base_from_color,
            depth_mask: None,
            color_mask: None,
        }
    }
}

fn number(value: &toml::Value) -> f64 {
    value.as_float().or_else(|| value.as_integer().map(|n| n as f64)).unwrap()
}

fn pinhole(table: &toml::Table) -> PinholeCamera {
    let get = |name: &str| number(&table[name]);
    let mut distortion = [0.0; 5];
    if let Some(list) = table.get("distortion") {
        for (out, value) in distortion.iter_mut().zip(list.as_array().unwrap()) {
            *out = number(value);
        }
    }
    PinholeCamera {
        width: get("width") as u32,
        height: get("height") as u32,
        fx: get("fx"),
        fy: get("fy"),
        cx: get("cx"),
        cy: get("cy"),
        distortion,
    }
}

fn pose(table: &toml::Value) -> Isometry3<f64> {
    let list = |name: &str| table[name].as_array().unwrap().iter().map(number).collect::<Vec<f64>>();
    let (t, q) = (list("translation_mm"), list("quaternion_xyzw"));
    isometry([t[0] / 1000.0, t[1] / 1000.0, t[2] / 1000.0], [q[0], q[1], q[2], q[3]])
}

fn isometry(translation_m: [f64; 3], [x, y, z, w]: [f64; 4]) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    Isometry3::from_parts(Translation3::from(translation_m), rotation)
}
