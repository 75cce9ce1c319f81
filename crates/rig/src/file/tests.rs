use super::*;
use skclam_kinematics::LinkForm;

const EXAMPLE: &str = r#"
name = "two joints"
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
mask = "mask.png"
[depth]
width = 480
height = 360
fx = 424.2
fy = 424.2
cx = 239.5
cy = 179.5
unit_mm = 1.0
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
[prior]
angle_deg = 0.5
"#;

#[test]
fn what_is_written_is_read_back_the_same() {
    let biased = EXAMPLE.replace("unit_mm = 1.0", "unit_mm = 1.0\noffset_mm = -2.5");
    let rig = Rig::from_toml(&biased, "rig.toml").unwrap();
    assert_eq!(rig.depth.unwrap().offset_m, -2.5e-3);
    let robot = rig.robot.as_ref().unwrap();
    assert_eq!(robot.joints()[1].link.form, LinkForm::Hayati);
    assert_eq!(robot.joints()[2].limits, Some([0.0, 0.5]));
    let text = rig.to_toml().unwrap();
    assert!(text.contains("alpha_deg = 181.0\n"), "{text}");
    let again = Rig::from_toml(&text, "rig.toml").unwrap();
    assert_eq!(again.to_toml().unwrap(), text);
    assert_eq!(again, rig);
}

#[test]
fn errors_name_the_file_the_key_and_the_cure() {
    let with =
        |from: &str, to: &str| Rig::from_toml(&EXAMPLE.replace(from, to), "cell/rig.toml").unwrap_err().to_string();
    let message = with("fx = 1371.02", "fx = nan");
    assert!(message.contains("cell/rig.toml") && message.contains("color.fx"), "{message}");
    assert!(with("unit_mm = 1.0", "unit_mm = 1.0\noffset_mm = nan").contains("depth.offset_mm"));
    let message = with("unit_mm = 1.0", "unit_mm = 1.0\nunits = 3");
    assert!(message.contains("units") && message.contains("line"), "{message}");
    let message = with("quaternion_xyzw = [0.0, 0.0, -0.70710678, 0.70710678]", "quaternion_xyzw = [0, 0, 0, 0]");
    assert!(message.contains("mount.quaternion_xyzw") && message.contains("unit quaternion"), "{message}");
    let message = with("beta_deg = 0.3\n", "");
    assert!(message.contains("robot.joint 2 (\"U\"): d_mm"), "{message}");
    let message = with("beta_deg = 0.3", "beta_deg = 0.3\nd_mm = 1");
    assert!(message.contains("one or the other"), "{message}");
    let message = with("beta_deg = 0.3", "d_mm = 1e30");
    assert!(message.contains("no arm is that long"), "{message}");
    let message = with("name = \"U\"", "name = \"S\"");
    assert!(message.contains("\"S\" is the name of two joints"), "{message}");
    let message = with("unit_mm = 1.0", "unit_mm = 1000.0");
    assert!(message.contains("depth.unit_mm") && message.contains("0.1 to 5"), "{message}");
    let message = with("fx = 1371.02", "fx = 1e-300");
    assert!(message.contains("color.fx") && message.contains("field of view"), "{message}");
    let message = with("mask = \"mask.png\"", "mask = \"../mask.png\"");
    assert!(message.contains("color.mask") && message.contains("leaves the folder"), "{message}");
    let message = with("width = 1920", "width = 0");
    assert!(message.contains("color.width"), "{message}");
    let message = with("limits_deg = [-170.0, 170.0]", "limits_deg = [170.0, -170.0]");
    assert!(message.contains("above the upper limit"), "{message}");
    let message = with("angle_deg = 0.5", "angle_deg = -0.5");
    assert!(message.contains("prior.angle_deg"), "{message}");
    let message = with("convention = \"modified_dh\"", "convention = \"craig\"");
    assert!(message.contains("modified_dh"), "{message}");
}

/// A rig may come from anybody: a device that never ends is not read.
#[test]
fn what_is_no_regular_file_is_no_urdf() {
    let at = EXAMPLE.find("[mount]").unwrap();
    for name in ["/dev/zero", "."] {
        let text = format!("[robot]\nurdf = \"{name}\"\n{}", &EXAMPLE[at..]);
        let message = Rig::from_toml(&text, "./rig.toml").unwrap_err().to_string();
        assert!(message.contains("robot.urdf") && message.contains("leaves the folder"), "{message}");
    }
    if Path::new("/dev/zero").exists() {
        assert!(Rig::read("/dev/zero").unwrap_err().to_string().contains("is a device"));
    }
}
