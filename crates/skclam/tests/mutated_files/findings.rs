//! What the mutations have found.

use skclam::dataset::read_postures;
use skclam::pipeline::Config;
use skclam::rig::{Rig, builtin_rig};

#[test]
fn a_unit_that_vanishes_in_metres_is_refused() {
    let text = builtin_rig("franka-fr3").unwrap().unwrap().to_toml().unwrap();
    let begin = text.find("unit_mm = ").unwrap();
    let end = begin + text[begin..].find('\n').unwrap();
    // 1e-320 mm is 0 m: it was read, and what was written of it was refused.
    let tiny = format!("{}unit_mm = 1e-320{}", &text[..begin], &text[end..]);
    assert!(Rig::from_toml(&tiny, "tiny").unwrap_err().to_string().contains("a number above 0 is needed"));
}

/// Half a micrometre was read and written as none.
#[test]
fn lengths_that_vanish_in_the_rigs_file_are_refused() {
    let text = super::seeds::rig_with_everything();
    for (from, to, key) in [
        ("marker_mm = 11", "marker_mm = 1e-9", "board.marker_mm"),
        ("marker_mm = 11", "marker_mm = 0.0004", "board.marker_mm"),
        ("square_mm = 15", "square_mm = 1e-300", "board.square_mm"),
        ("unit_mm = 1.0", "unit_mm = 1e-160", "depth.unit_mm"),
    ] {
        let message = Rig::from_toml(&text.replace(from, to), "rig.toml").unwrap_err().to_string();
        assert!(message.contains(key) && message.contains("is needed"), "{to}: {message}");
    }
}

/// 1e308 rad are finite, and infinite in the degrees that are written.
#[test]
fn angles_that_overflow_in_degrees_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("postures.csv");
    for angle in ["1e308", "-214748364800"] {
        std::fs::write(&path, format!("index,q1_rad,color\n0,0.1,a.png\n1,{angle},b.png\n")).unwrap();
        let message = read_postures(&path).unwrap_err().to_string();
        assert!(message.contains("line 3") && message.contains(&format!("q1_rad is {angle}")), "{message}");
    }
    // Nanoseconds in the place of seconds are no posture's affair.
    std::fs::write(&path, "index,timestamp_s,q1_rad,color\n0,1.7e18,0.1,a.png\n").unwrap();
    assert_eq!(read_postures(&path).unwrap().len(), 1);
}

/// 1e308 is finite, and infinite in a setting of single precision: what was written of it was refused.
#[test]
fn settings_that_overflow_are_refused_by_name() {
    let message = Config::default().overlaid(r#"{"akaze": {"threshold": 1e308}}"#).unwrap_err().to_string();
    assert!(message.contains("akaze.threshold") && message.contains("too large"), "{message}");
}
