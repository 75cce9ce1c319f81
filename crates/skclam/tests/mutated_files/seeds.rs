//! Whole files of every kind, and what means something in them.

use skclam::dataset::write_depth_png;
use skclam::geometry::DepthImage;
use skclam::kinematics::bare_urdf;
use skclam::mapping::{Model, PointCloud, TriangleMesh, write_ply, write_stl};
use skclam::pipeline::Config;
use skclam::rig::{builtin_names, builtin_rig};
use skclam_damage::Seed;

pub const RIG_PIECES: [&str; 24] = [
    "[joint_corrections]\n",
    "transmission_cos_deg = [0, 1, 6]\n",
    "[robot]\n",
    "[[robot.joint]]\n",
    "[mount]\n",
    "[color]\n",
    "[board]\n",
    "[prior]\n",
    "[depth.color_from_depth]\n",
    "urdf = \"robot.urdf\"\n",
    "base_link = \"base\"\n",
    "tip_link = \"tip\"\n",
    "beta_deg = 0.1\n",
    "d_mm = 1\n",
    "type = \"prismatic\"\n",
    "limits_deg = [-1, 1]\n",
    "limits_mm = [1, -1]\n",
    "convention = \"standard_dh\"\n",
    "quaternion_xyzw = [0, 0, 0, 1]\n",
    "distortion = [0, 0, 0, 0, 0]\n",
    "mask = \"\"\n",
    "kind = \"charuco\"\n",
    "\"\"\"",
    "'''",
];

pub const URDF_PIECES: [&str; 24] = [
    "<link name=\"base\"/>",
    "<link name=\"x\"/>",
    "<joint name=\"j1\" type=\"fixed\"><parent link=\"tip\"/><child link=\"base\"/></joint>",
    "<joint name=\"k\" type=\"revolute\"><parent link=\"a\"/><child link=\"x\"/></joint>",
    "<origin xyz=\"0 0 1\" rpy=\"0 0 0\"/>",
    "<axis xyz=\"0 0 0\"/>",
    "<axis xyz=\"1e-12 0 1\"/>",
    "<limit lower=\"1\" upper=\"-1\"/>",
    "<mimic joint=\"j1\"/>",
    "type=\"floating\"",
    "type=\"continuous\"",
    "<!DOCTYPE robot [<!ENTITY a \"b\">]>",
    "<!DOCTYPE r [<!ENTITY a \"&b;\"><!ENTITY b \"&a;\">]>",
    "<!DOCTYPE r [<!ENTITY a \"xxxxxxxxxx\"><!ENTITY b \"&a;&a;&a;&a;&a;&a;&a;&a;\"><!ENTITY c \"&b;&b;&b;&b;&b;&b;\">]>",
    "&a;",
    "&c;",
    "<?xml version=\"1.0\"?>",
    "xmlns:xacro=\"http://www.ros.org/wiki/xacro\"",
    "${height}",
    "<robot name=\"r\">",
    "</robot>",
    "<collision><geometry><box size=\"1 1 1\"/></geometry></collision>",
    "<mesh filename=\"package://a/b.stl\" scale=\"0 0 0\"/>",
    "xml:space=\"preserve\"",
];

pub const TABLE_PIECES: [&str; 14] = [
    "q1_deg",
    "q7_deg",
    "q2_rad",
    "q3_mm",
    "index",
    "timestamp_s",
    "x_mm",
    "qw",
    "color",
    "depth",
    ",,",
    "\"\"",
    "# ",
    "\t",
];

pub const MAP_PIECES: [&str; 16] = [
    "element vertex 3\n",
    "element face 1\n",
    "element vertex 200000000\n",
    "element other 4000000000\n",
    "property list uchar int vertex_indices\n",
    "property list uint uint vertex_indices\n",
    "property float x\n",
    "property double x\n",
    "property list uchar float x\n",
    "property uchar red\n",
    "format ascii 1.0\n",
    "format binary_big_endian 1.0\n",
    "end_header\n",
    "comment\n",
    "vertex 0 0 0\n",
    "endsolid",
];

/// Everything that a rig may have.
const RIG: &str = r#"
name = "two joints and a rail"
[robot]
convention = "modified_dh"
[[robot.joint]]
name = "S"
alpha_deg = 0
a_mm = 0.0
d_mm = 290.0
theta_offset_deg = 0.0
limits_deg = [-170.0, 170.0]
[[robot.joint]]
name = "U"
alpha_deg = 181.0
a_mm = 260.0
beta_deg = 0.3
theta_offset_deg = -90.0
[[robot.joint]]
name = "rail"
type = "prismatic"
convention = "standard_dh"
alpha_deg = 12.5
a_mm = 1.0
d_mm = 2.0
theta_offset_deg = 3.0
limits_mm = [0.0, 500.0]
[mount]
translation_mm = [-60.0, 0.0, 40.0]
quaternion_xyzw = [0.0, 0.0, -0.70710678, 0.70710678]
[color]
width = 1920
height = 1080
fx = 1371.02
fy = 1371.02
cx = 959.5
cy = 539.5
distortion = [0.1, -0.2, 0.001, 0.0, 0.05]
mask = "mask.png"
[depth]
width = 480
height = 360
fx = 424.2
fy = 424.2
cx = 239.5
cy = 179.5
unit_mm = 1.0
offset_mm = -2.5
[depth.color_from_depth]
translation_mm = [15.0, 0.0, 0.0]
quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]
[board]
kind = "charuco"
columns = 11
rows = 8
square_mm = 15
dictionary = "DICT_4X4_50"
marker_mm = 11
[joint_corrections]
transmission_sin_deg = [0.01, 0.0, 0.0]
compliance_deg_per_m = [-0.05, 0.0, 0.0]
time_offset_s = -0.004
[prior]
angle_deg = 0.5
"#;

/// Three joints, of every kind.
pub const URDF: &str = r#"<?xml version="1.0"?>
<robot name="r"><!-- comment -->
  <link name="base"/><link name="a"><visual><origin xyz="0 0 1"/></visual></link><link name="b"/><link name="tip"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0 0.1 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0.2 0 0.1" rpy="1.57 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="j3" type="continuous"><parent link="b"/><child link="tip"/><origin rpy="0 0 1e-3"/></joint>
</robot>
"#;

/// Bodies, a gripper that mimics, transmissions, parallel axes, a fixed joint at the end.
const BODIES: &str = r#"<robot name="two">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="upper"><collision><origin xyz="0.2 0 0" rpy="0 1.5707963267948966 0"/>
    <geometry><cylinder radius="0.05" length="0.4"/></geometry></collision></link>
  <link name="fore"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
  <link name="finger"><collision><geometry><box size="0.1 0.02 0.02"/></geometry></collision>
    <collision><geometry><mesh filename="package://two/finger.stl" scale="0.001 0.001 0.001"/></geometry></collision></link>
  <link name="tip"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.3 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3"/></joint>
  <joint name="slide" type="prismatic"><parent link="fore"/><child link="finger"/><origin xyz="0.4 0 0"/>
    <axis xyz="1 0 0"/><mimic joint="turn" multiplier="2"/></joint>
  <joint name="end" type="fixed"><parent link="fore"/><child link="tip"/><origin xyz="0.1 0 0" rpy="0 0 0.5"/></joint>
  <transmission name="t"><joint name="turn"><hardwareInterface>x</hardwareInterface></joint></transmission>
</robot>
"#;

const JOINTS: &str = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg";

fn table(name: &str, head: &str, rows: &[&str]) -> Seed {
    Seed::new(name, format!("{head}\n{}\n", rows.join("\n")))
}

/// A rig with all that a rig may have.
pub fn rig_with_everything() -> &'static str {
    RIG
}

pub fn rigs() -> Vec<Seed> {
    let from_urdf =
        format!("[robot]\nurdf = \"robot.urdf\"\nbase_link = \"base\"\n{}", &RIG[RIG.find("[mount]").unwrap()..]);
    let mut seeds = vec![Seed::new("rig.toml", RIG), Seed::new("urdf.toml", from_urdf)];
    seeds.extend(
        builtin_names()
            .step_by(4)
            .map(|name| Seed::new(format!("{name}.toml"), builtin_rig(name).unwrap().unwrap().to_toml().unwrap())),
    );
    seeds
}

pub fn robots() -> Vec<Seed> {
    let seven = builtin_rig("franka-fr3").unwrap().unwrap().robot.unwrap();
    vec![
        Seed::new("three.urdf", URDF),
        Seed::new("bodies.urdf", BODIES),
        Seed::new("seven.urdf", bare_urdf(&seven, "seven", "base", "tip")),
    ]
}

pub fn postures() -> Vec<Seed> {
    vec![
        table(
            "joints.csv",
            &format!("index,timestamp_s,{JOINTS},color,depth"),
            &["0,1.5,1,2,3,4,5,6,a.png,b.png", "7,2,1,2,3,4,5,6,c.png,", "8,,1e-3,-2,3,4,5,6,\"d,e.png\",f.png"],
        ),
        table(
            "poses.csv",
            "index,x_mm,y_mm,z_mm,qx,qy,qz,qw,color",
            &["0,1,2,3,0,0,0.6,0.8,a.png", "# a remark", "1,1,2,3,0,0,0,1,b.png"],
        ),
        table("rail.csv", "color,q2_mm,index,q1_rad", &["a.png,100,3,0.5", "b.png,200,4,-0.5"]),
    ]
}

pub fn targets() -> Vec<Seed> {
    vec![
        table("joints.csv", &format!("name,{JOINTS}"), &["a,10,20,-30,5,40,0", "b,1,2,-30,4,50,6"]),
        table("poses.csv", "x_mm,y_mm,z_mm,qx,qy,qz,qw", &["300,10,300,0,1,0,0", "310,0,300,0,1,0,0"]),
        table(
            "both.csv",
            &format!("x_mm,y_mm,z_mm,qx,qy,qz,qw,{}", JOINTS.replace("deg", "rad")),
            &["300,10,300,0,1,0,0,0,0.3,-0.5,0,0.7,0"],
        ),
    ]
}

pub fn joint_logs() -> Vec<Seed> {
    let rows: Vec<String> =
        (0..40).map(|step| format!("{:.2},1,2,3,4,5,{}", 1.5 + 0.1 * f64::from(step), step / 10)).collect();
    let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
    vec![
        table("log.csv", &format!("timestamp_s,{JOINTS}"), &rows),
        table(
            "few.csv",
            &format!("{},timestamp_s,gripper", JOINTS.replace("deg", "rad")),
            &["0,0,0,0,0,0,1.5,x", "0,0,0,0,0,1,1.6,y"],
        ),
    ]
}

pub fn trajectories() -> Vec<Seed> {
    let lines = "# timestamp tx ty tz qx qy qz qw\n0.5 0.1 0.2 0.3 0 0 0 1\n1.5 0.1 -0.2 0.3 0.6 0 0 0.8\n\n2.5 1e-3 0 0 0 1 0 0\n";
    vec![Seed::new("trajectory.txt", lines)]
}

pub fn settings() -> Vec<Seed> {
    let whole = serde_json::to_string_pretty(&Config::default()).unwrap();
    let paper = serde_json::to_string(&Config::paper()).unwrap();
    vec![
        Seed::new("part.json", r#"{"filter": {"best": 50}, "seed": 9, "voxel_m": 0.002}"#),
        Seed::new("default.json", whole),
        Seed::new("summary.json", format!("{{\"program\": \"skclam\", \"configuration\": {paper}}}")),
    ]
}

fn mesh() -> TriangleMesh {
    let vertices = PointCloud {
        points: vec![[0.0, 0.1, -0.1], [0.0, 0.2, -0.1], [0.5, 0.2, 0.1], [0.0, 0.1, 0.1]],
        normals: vec![[0.0, 0.0, 1.0]; 4],
        colors: vec![[10, 20, 30]; 4],
    };
    TriangleMesh { vertices, triangles: vec![[0, 1, 2], [0, 2, 3]] }
}

pub fn maps() -> Vec<Seed> {
    let mut binary = Vec::new();
    write_ply(&Model::Mesh(mesh()), &mut binary).unwrap();
    let mut cloud = Vec::new();
    write_ply(&Model::Cloud(mesh().vertices), &mut cloud).unwrap();
    let mut stl = Vec::new();
    write_stl(&mesh(), &mut stl).unwrap();
    let ascii = "ply\nformat ascii 1.0\ncomment x\nelement camera 1\nproperty float f\nelement vertex 4\nproperty double x\n\
        property double y\nproperty uchar quality\nproperty double z\nelement face 1\n\
        property list uchar uint vertex_index\nend_header\n7\n0 0 9 0\n1 0 9 0\n1 1 9 0\n0 1 9 0.5\n4 0 1 2 3\n";
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0.5\nvertex 0 1e-1 0\nendloop\nendfacet\n";
    vec![
        Seed::new("binary.ply", binary),
        Seed::new("binary_cloud.ply", cloud),
        Seed::new("ascii.ply", ascii),
        Seed::new("binary.stl", stl),
        Seed::new("ascii.stl", format!("solid s\n{facet}{facet}endsolid s\n")),
    ]
}

/// Size of the images of [`images`].
pub const IMAGE_SIZE: (u32, u32) = (16, 12);

pub fn images() -> Vec<Seed> {
    let (width, height) = IMAGE_SIZE;
    let color = image::RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * 9) as u8, (y * 11) as u8, 7]));
    let written = |format| {
        let mut bytes = Vec::new();
        color.write_to(&mut std::io::Cursor::new(&mut bytes), format).unwrap();
        bytes
    };
    let folder = tempfile::tempdir().unwrap();
    let depth = folder.path().join("depth.png");
    let metres = (0..width * height).map(|i| 0.3 + 0.001 * i as f32).collect();
    write_depth_png(&depth, &DepthImage::new(width, height, metres).unwrap(), 1e-3).unwrap();
    let counts: Vec<u8> = (0..width * height).flat_map(|i| (300 + i as u16).to_be_bytes()).collect();
    let pgm = [format!("P5\n{width} {height}\n65535\n").into_bytes(), counts].concat();
    vec![
        Seed::new("color.png", written(image::ImageFormat::Png)),
        Seed::new("color.jpg", written(image::ImageFormat::Jpeg)),
        Seed::new("depth.png", std::fs::read(depth).unwrap()),
        Seed::new("depth.pgm", pgm),
    ]
}
