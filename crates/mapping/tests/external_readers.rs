//! The files as the programs read them for which they are meant. Each test skips, with the reason, where its program is
//! missing: OctoMap wants Debian's `liboctomap-dev` and `g++`, the meshes and clouds a Python with `open3d` (its
//! interpreter in `SKCLAM_PYTHON`, else `python3`) and the Point Cloud Library's programs (Debian's `pcl-tools`).

use image::{Rgb, RgbImage};
use skclam_geometry::{DepthCamera, DepthImage, Isometry3, PinholeCamera};
use skclam_mapping::{
    Model, Occupancy, OccupancyGrid, OccupancyOptions, SurfaceOptions, Tsdf, TsdfOptions, View, read_ply, write_glb,
    write_obj, write_pcd, write_ply, write_stl,
};
use std::fmt::Write as _;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::Command;

struct Scene {
    camera: DepthCamera,
    depth: DepthImage,
    color: RgbImage,
}

/// A wall at 1 m with a box in front of it.
fn scene() -> Scene {
    let (width, height) = (160, 120);
    let camera = DepthCamera {
        camera: PinholeCamera::from_hfov(width, height, 1.0),
        unit_m: 0.001,
        offset_m: 0.0,
        color_from_depth: Isometry3::identity(),
    };
    let depth = (0..width * height).map(|i| {
        let (x, y) = (i % width, i / width);
        if (50..110).contains(&x) && (40..80).contains(&y) { 0.7 } else { 1.01 }
    });
    Scene {
        camera,
        depth: DepthImage::new(width, height, depth.collect()).unwrap(),
        color: RgbImage::from_pixel(width, height, Rgb([200, 120, 40])),
    }
}

impl Scene {
    fn view(&self) -> View<'_> {
        View {
            depth: &self.depth,
            color: Some(&self.color),
            depth_camera: &self.camera,
            color_camera: &self.camera.camera,
            base_from_color: Isometry3::identity(),
            depth_mask: None,
            color_mask: None,
        }
    }
}

/// A folder of this test's own, removed when it ends.
struct Scratch(PathBuf);

impl Scratch {
    fn new(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
        std::fs::create_dir_all(&folder).unwrap();
        Scratch(folder)
    }

    fn file(&self, name: &str) -> BufWriter<File> {
        BufWriter::new(File::create(self.0.join(name)).unwrap())
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

const OCTOMAP_READER: &str = r#"
#include <octomap/octomap.h>
#include <fstream>
#include <iostream>
#include <memory>
int main(int argc, char** argv) {
  octomap::OcTree binary(0.1);
  if (!binary.readBinary(argv[1])) return 1;
  std::unique_ptr<octomap::AbstractOcTree> read(octomap::AbstractOcTree::read(argv[2]));
  auto* full = dynamic_cast<octomap::OcTree*>(read.get());
  if (!full) return 2;
  std::cerr << binary.size() << " " << full->size() << " " << binary.getResolution() << "\n";
  double x, y, z;
  while (std::cin >> x >> y >> z) {
    for (octomap::OcTree* tree : {&binary, full}) {
      auto* node = tree->search(x, y, z);
      std::cout << (!node ? 'u' : tree->isNodeOccupied(node) ? 'o' : 'f');
    }
    std::cout << "\n";
  }
}
"#;

#[test]
fn octomap_reads_both_trees_and_agrees_on_every_cell() {
    let scratch = Scratch::new("octomap");
    let (source, program) = (scratch.0.join("reader.cpp"), scratch.0.join("reader"));
    std::fs::write(&source, OCTOMAP_READER).unwrap();
    let compiled = Command::new("g++")
        .args(["-std=c++14", "-O1", "-o"])
        .args([&program, &source])
        .args(["-loctomap", "-loctomath"])
        .output();
    match compiled {
        Ok(output) if output.status.success() => {}
        other => return eprintln!("skipped: liboctomap-dev and g++ are needed ({:?})", other.map(|o| o.status)),
    }
    let scene = scene();
    let mut grid = OccupancyGrid::new(OccupancyOptions { resolution_m: 0.025, ..Default::default() }).unwrap();
    for step in 0..3 {
        let base_from_color = Isometry3::translation(0.05 * f64::from(step), 0.02, 0.3);
        grid.add(&View { base_from_color, ..scene.view() }).unwrap();
    }
    grid.write_bt(scratch.file("map.bt")).unwrap();
    grid.write_ot(scratch.file("map.ot")).unwrap();
    let mut points = String::new();
    let mut expected = String::new();
    let mut kinds = [0; 3];
    for x in -24..24 {
        for y in -20..20 {
            for z in -4..60 {
                let point = [x, y, z].map(|index| (f64::from(index) + 0.5) * 0.025);
                writeln!(points, "{} {} {}", point[0], point[1], point[2]).unwrap();
                let (kind, letter) = match grid.at(point) {
                    Occupancy::Unknown => (0, "uu\n"),
                    Occupancy::Free => (1, "ff\n"),
                    Occupancy::Occupied => (2, "oo\n"),
                };
                kinds[kind] += 1;
                expected.push_str(letter);
            }
        }
    }
    assert!(kinds.iter().all(|&count| count > 100), "all three kinds are there: {kinds:?}");
    let list = scratch.0.join("points.txt");
    std::fs::write(&list, points).unwrap();
    let output = Command::new(&program)
        .args([scratch.0.join("map.bt"), scratch.0.join("map.ot")])
        .stdin(File::open(list).unwrap())
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    assert!(stderr.trim().ends_with("0.025"), "{stderr}");
    assert!(String::from_utf8_lossy(&output.stdout) == expected, "a cell differs");
}

const OPEN3D_READER: &str = r#"
import sys, json
import numpy as np
import open3d as o3d
folder = sys.argv[1]
out = {}
for name in ("cloud.ply", "cloud.pcd"):
    cloud = o3d.io.read_point_cloud(folder + "/" + name)
    points, colors = np.asarray(cloud.points), np.asarray(cloud.colors)
    out[name] = [len(points), len(colors), len(cloud.normals), float(points[:, 2].mean()), *(float(c) for c in colors.mean(axis=0))]
for name in ("mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb"):
    mesh = o3d.io.read_triangle_mesh(folder + "/" + name)
    mesh.remove_duplicated_vertices()
    out[name] = [len(mesh.triangles), float(mesh.get_surface_area())]
with np.load(folder + "/esdf.npz") as esdf:
    out["esdf"] = [list(esdf["distance_m"].shape), list(esdf["state"].shape), float(esdf["resolution_m"]),
                   float(esdf["distance_m"].max()), int((esdf["state"] == 2).sum()), str(esdf["distance_m"].dtype)]
print(json.dumps(out))
"#;

#[test]
fn open3d_and_numpy_read_clouds_meshes_and_the_distance_field() {
    let python = std::env::var("SKCLAM_PYTHON").unwrap_or_else(|_| "python3".into());
    match Command::new(&python).args(["-c", "import open3d, numpy"]).output() {
        Ok(output) if output.status.success() => {}
        _ => return eprintln!("skipped: {python} has no open3d and numpy (set SKCLAM_PYTHON)"),
    }
    let scratch = Scratch::new("open3d");
    let scene = scene();
    let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
    tsdf.integrate(&scene.view()).unwrap();
    let mesh = tsdf.surface(&SurfaceOptions::default()).unwrap();
    let mut grid = OccupancyGrid::new(OccupancyOptions::default()).unwrap();
    grid.add(&scene.view()).unwrap();
    let esdf = grid.esdf(256).unwrap();
    write_ply(&Model::Cloud(mesh.vertices.clone()), scratch.file("cloud.ply")).unwrap();
    write_pcd(&mesh.vertices, scratch.file("cloud.pcd")).unwrap();
    write_ply(&Model::Mesh(mesh.clone()), scratch.file("mesh.ply")).unwrap();
    write_obj(&mesh, scratch.file("mesh.obj")).unwrap();
    write_stl(&mesh, scratch.file("mesh.stl")).unwrap();
    write_glb(&mesh, scratch.file("mesh.glb")).unwrap();
    esdf.write_npz(scratch.file("esdf.npz")).unwrap();
    let output = Command::new(&python).args(["-c", OPEN3D_READER]).arg(&scratch.0).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let read: serde_json::Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
    let near = |value: &serde_json::Value, wanted: f64, slack: f64| {
        let value = value.as_f64().unwrap();
        assert!((value - wanted).abs() <= slack, "{value} instead of {wanted}");
    };
    let count = mesh.vertices.len() as f64;
    let mean_z = mesh.vertices.points.iter().map(|point| f64::from(point[2])).sum::<f64>() / count;
    for name in ["cloud.ply", "cloud.pcd"] {
        let cloud = &read[name];
        for field in 0..3 {
            near(&cloud[field], count, 0.0);
        }
        near(&cloud[3], mean_z, 1e-4);
        for (channel, wanted) in [200.0, 120.0, 40.0].into_iter().enumerate() {
            near(&cloud[4 + channel], wanted / 255.0, 0.01);
        }
    }
    for name in ["mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb"] {
        near(&read[name][0], mesh.triangles.len() as f64, 0.0);
        near(&read[name][1], read["mesh.ply"][1].as_f64().unwrap(), 1e-4);
    }
    assert_eq!(read["esdf"][0], serde_json::json!(esdf.shape));
    assert_eq!(read["esdf"][1], serde_json::json!(esdf.shape));
    near(&read["esdf"][2], 0.02, 1e-12);
    near(&read["esdf"][3], esdf.distance_m.iter().copied().fold(0.0, f32::max).into(), 1e-6);
    near(&read["esdf"][4], esdf.state.iter().filter(|state| **state == 2).count() as f64, 0.0);
    assert_eq!(read["esdf"][5], "float32");
}

/// Points, normals and colours by the writers' own names, from an ASCII PCD.
fn ascii_pcd(text: &str) -> (Vec<String>, Vec<Vec<f64>>) {
    let fields = text.lines().find_map(|line| line.strip_prefix("FIELDS ")).expect("a PCD has fields");
    let body = text.split_once("DATA ascii\n").expect("it is text").1;
    let rows = body.lines().map(|line| line.split_whitespace().map(|word| word.parse().unwrap()).collect());
    (fields.split_whitespace().map(str::to_owned).collect(), rows.collect())
}

#[test]
fn the_point_cloud_library_reads_clouds_and_meshes() {
    let missing = ["pcl_convert_pcd_ascii_binary", "pcl_ply2pcd", "pcl_pcd2ply"]
        .into_iter()
        .find(|program| Command::new(program).arg("--help").output().is_err());
    if let Some(program) = missing {
        return eprintln!("skipped: {program} is not there (Debian's pcl-tools)");
    }
    let scratch = Scratch::new("pcl");
    let scene = scene();
    let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
    tsdf.integrate(&scene.view()).unwrap();
    let mesh = tsdf.surface(&SurfaceOptions::default()).unwrap();
    let points = mesh.vertices.points.clone();
    write_pcd(&mesh.vertices, scratch.file("cloud.pcd")).unwrap();
    write_ply(&Model::Cloud(mesh.vertices.clone()), scratch.file("cloud.ply")).unwrap();
    write_ply(&Model::Mesh(mesh), scratch.file("mesh.ply")).unwrap();
    let run = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).current_dir(&scratch.0).output().unwrap();
        let output_text =
            String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{program} {arguments:?}: {output_text}");
        output_text
    };
    run("pcl_ply2pcd", &["cloud.ply", "from_ply.pcd"]);
    run("pcl_ply2pcd", &["mesh.ply", "from_mesh.pcd"]);
    run("pcl_pcd2ply", &["cloud.pcd", "from_pcd.ply"]);
    for name in ["cloud.pcd", "from_ply.pcd", "from_mesh.pcd"] {
        run("pcl_convert_pcd_ascii_binary", &[name, "text.pcd", "0"]);
        let (fields, rows) = ascii_pcd(&std::fs::read_to_string(scratch.0.join("text.pcd")).unwrap());
        assert_eq!(rows.len(), points.len(), "{name}");
        for wanted in ["x", "y", "z", "normal_x", "normal_y", "normal_z", "rgb"] {
            let known = fields.iter().any(|field| field == wanted || (wanted == "rgb" && field == "rgba"));
            assert!(known, "{name} has {fields:?}, not {wanted}");
        }
        let place = |wanted: &str| fields.iter().position(|field| field == wanted).unwrap();
        let axes = ["x", "y", "z"].map(place);
        for (row, point) in rows.iter().zip(&points) {
            let same = axes.iter().zip(point).all(|(&axis, value)| (row[axis] - f64::from(*value)).abs() < 1e-5);
            assert!(same, "{name}: {row:?} {point:?}");
        }
    }
    // What PCL made of our PCD is read by us again.
    let file = File::open(scratch.0.join("from_pcd.ply")).unwrap();
    let back = read_ply(std::io::BufReader::new(file)).unwrap();
    assert_eq!(back.points().len(), points.len());
}
