//! Exports and images as the reader's software has them: the cases of `../shared/cases/drivers` that are no recordings.
//! Without them the tests say so and pass.

mod support;

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use support::{fail, skclam, succeed, text, utf8};

fn case(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let data = std::env::var_os("SKCLAM_DATA").map_or(beside, PathBuf::from);
    let path = data.join("../cases/drivers").join(name);
    if !path.exists() {
        eprintln!("skipped: {} is not there", path.display());
        return None;
    }
    Some(path)
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap()
}

/// A number of a `kinematics.yaml`.
fn number(yaml: &str, link: &str, key: &str) -> f64 {
    let block = &yaml[yaml.find(&format!("  {link}:\n")).unwrap()..];
    let line = block.lines().skip(1).find(|line| line.trim_start().starts_with(&format!("{key}:"))).unwrap();
    line.split(": ").nth(1).unwrap().parse().unwrap()
}

#[test]
fn kinematics_yaml_is_in_the_makers_frames() {
    for (name, rig) in [("kinematics-yaml-frames", "rig.toml"), ("kinematics-yaml-base-link", "ur5e.toml")] {
        let Some(folder) = case(name) else { return };
        let place = tempfile::tempdir().unwrap();
        let (rig, out) = (folder.join(rig), place.path().join("out"));
        succeed(&["export", utf8(&rig), "--nominal", utf8(&rig), "--out", utf8(&out)]);
        let yaml = fs::read_to_string(out.join("kinematics.yaml")).unwrap();
        // The numbers of the URDF.
        for (link, key, wanted) in [
            ("shoulder", "z", 0.1625),
            ("upper_arm", "y", 0.0),
            ("upper_arm", "roll", std::f64::consts::FRAC_PI_2),
            ("forearm", "x", -0.425),
            ("forearm", "yaw", 0.0),
            ("wrist_1", "x", -0.3922),
            ("wrist_1", "z", 0.1333),
            ("wrist_2", "y", -0.0997),
            ("wrist_3", "y", 0.0996),
            ("wrist_3", "pitch", std::f64::consts::PI),
        ] {
            let got = number(&yaml, link, key);
            assert!((got - wanted).abs() < 1e-8, "{name}: {link}.{key} is {got}, not {wanted}");
        }
    }
}

#[test]
fn another_arm_has_no_kinematics_yaml_but_all_other_files() {
    let place = tempfile::tempdir().unwrap();
    for name in ["hp3j", "kuka-kr6-r900", "franka-fr3"] {
        let (rig, out) = (place.path().join(format!("{name}.toml")), place.path().join(name));
        fs::write(&rig, skclam::rig::builtin_rig(name).unwrap().unwrap().to_toml().unwrap()).unwrap();
        let said = skclam(&["export", utf8(&rig), "--nominal", utf8(&rig), "--out", utf8(&out)]);
        assert!(said.status.success(), "{}", text(&said.stderr));
        let said = text(&said.stderr).replace(['\n', ' '], "");
        assert!(said.contains("thefileisforUniversalRobots'arms"), "{said}");
        for file in ["robot.urdf", "corrections.csv", "parameters.json", "static_transform.sh", "mount.json"] {
            assert!(out.join(file).is_file(), "{name}: {file}");
        }
        assert!(!out.join("kinematics.yaml").exists());
    }
}

#[test]
fn a_hand_eye_result_is_exported_without_an_arm() {
    let Some(folder) = case("mount-without-arm") else { return };
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let (calibrated, nominal) = (folder.join("calibrated.toml"), folder.join("nominal.toml"));
    let said = skclam(&["export", utf8(&calibrated), "--nominal", utf8(&nominal), "--out", utf8(&out)]);
    assert!(said.status.success() && text(&said.stderr).contains("left out: "), "{}", text(&said.stderr));
    assert!(fs::read_to_string(out.join("static_transform.sh")).unwrap().contains("--x -0.0600612375072"));
    let mount = json(&out.join("mount.json"));
    assert!((mount["flange_from_color"]["translation_mm"][2].as_f64().unwrap() - 41.2209267024).abs() < 1e-9);
}

#[test]
fn the_mount_hangs_on_the_root_of_the_drivers_tree() {
    let Some(folder) = case("optical-frame-two-parents") else { return };
    let place = tempfile::tempdir().unwrap();
    let (cell, out) = (place.path().join("cell"), place.path().join("out"));
    succeed(&["import", utf8(&folder.join("recording")), "--robot", "hp3j", "--quiet", "--out", utf8(&cell)]);
    let rig = cell.join("rig.toml");
    let export = ["export", utf8(&rig), "--dataset", utf8(&cell), "--out", utf8(&out)];
    let said = skclam(&export);
    assert!(said.status.success() && text(&said.stderr).contains("camera_link"), "{}", text(&said.stderr));
    let line = fs::read_to_string(out.join("static_transform.sh")).unwrap();
    assert!(line.contains("--frame-id tool0 --child-frame-id camera_link"), "{line}");
    let mount = json(&out.join("mount.json"));
    assert_eq!((&mount["child_frame"], &mount["flange_frame"]), (&"camera_link".into(), &"tool0".into()));
    // Whoever asks for the optical frame gets it, and a note names its parent.
    let said = skclam(&[&export[..], &["--camera-frame", "camera_color_optical_frame"]].concat());
    assert!(said.status.success() && text(&said.stderr).contains("one parent"), "{}", text(&said.stderr));
}

#[test]
fn images_are_read_by_their_content_and_others_named() {
    let place = tempfile::tempdir().unwrap();
    let image = image::DynamicImage::ImageRgb8(image::RgbImage::from_fn(64, 48, |x, y| {
        image::Rgb([(x * 3) as u8, (y * 5) as u8, ((x * y) % 251) as u8])
    }));
    let depth =
        image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_fn(64, 48, |x, y| image::Luma([(500 + x + y) as u16]));
    let camera = "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\n";
    let rig = format!(
        "name = \"x\"\n[mount]\ntranslation_mm = [0.0, 0.0, 0.0]\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n[color]\n{camera}[depth]\n{camera}unit_mm = 1.0\n"
    );
    for (color, depth_kind, words) in [
        ("bmp", "png", ""),
        ("webp", "png", ""),
        ("tif", "png", ""),
        ("png", "tif", ""),
        ("png", "npy", "NumPy array"),
        ("gif", "png", "PNG, JPEG, PGM/PPM, BMP, TIFF and WebP"),
        ("txt", "png", "PNG, JPEG, PGM/PPM, BMP, TIFF and WebP"),
    ] {
        let folder = place.path().join(format!("{color}-{depth_kind}"));
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("rig.toml"), &rig).unwrap();
        let mut table = "index,x_mm,y_mm,z_mm,qx,qy,qz,qw,color,depth\n".to_owned();
        for index in 0..2 {
            let (c, d) = (format!("{index}.{color}"), format!("{index}d.{depth_kind}"));
            match color {
                "gif" => fs::write(folder.join(&c), b"GIF89a\x40\x00\x30\x00\x00\x00\x00and the rest of it").unwrap(),
                "txt" => fs::write(folder.join(&c), "not an image, and long enough to be looked at").unwrap(),
                _ => image.save(folder.join(&c)).unwrap(),
            }
            match depth_kind {
                "npy" => fs::write(folder.join(&d), b"\x93NUMPY\x01\x00v\x00{'descr': '<u2', }").unwrap(),
                _ => depth.save(folder.join(&d)).unwrap(),
            }
            table += &format!("{index},{},0,500,1,0,0,0,{c},{d}\n", 100 * index);
        }
        fs::write(folder.join("postures.csv"), table).unwrap();
        if words.is_empty() {
            succeed(&["inspect", utf8(&folder), "--quiet"]);
            let dataset = skclam::dataset::Dataset::open(&folder).unwrap();
            assert_eq!(dataset.color(0).unwrap().as_raw(), image.as_bytes(), "{color}");
            assert!((dataset.depth(1).unwrap().unwrap().as_slice()[0] - 0.5).abs() < 1e-6, "{depth_kind}");
        } else {
            let message = fail(&["inspect", utf8(&folder)]);
            assert!(message.contains(words) && message.contains(&folder.display().to_string()), "{message}");
        }
    }
}

/// What an error advises is done word by word.
#[test]
fn advice_of_errors_works() {
    let Some(folder) = case("image-clock-differs") else { return };
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let import = |name: &str, more: &[&str]| -> Vec<String> {
        let recording = folder.join("..").join(name).join("recording");
        let arguments = [&["import", utf8(&recording), "--quiet", "--out", utf8(&out)], more].concat();
        arguments.into_iter().map(str::to_owned).collect()
    };
    let run = |arguments: &[String]| skclam(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
    let robot = ["--robot", "hp3j"];
    let rig = folder.join("../camera-info-refused-rig-ignored/rig.toml");
    let names = ["--joint-names", "S,L,U,R,B,T"];
    for (name, first, words, advised) in [
        ("image-clock-differs", &robot[..], "--clock log", [&robot[..], &["--clock", "log"]].concat()),
        ("joint-names-empty", &robot[..], "--joint-names S,L,U,R,B,T", [&robot[..], &names[..]].concat()),
        ("no-tf-static", &robot[..], "--depth-topic none", [&robot[..], &["--depth-topic", "none"]].concat()),
        ("no-tf-static", &robot[..], "[depth.color_from_depth] in a rig (--rig)", vec!["--rig", utf8(&rig)]),
        (
            "camera-info-refused-rig-ignored",
            &robot[..],
            "--rig RIG --rig-cameras",
            vec!["--rig", utf8(&rig), "--rig-cameras"],
        ),
    ] {
        let refused = run(&import(name, first));
        let message = text(&refused.stderr).replace('\n', " ");
        assert!(refused.status.code() == Some(1) && message.contains(words), "{name}: {message}");
        let done = run(&import(name, &advised));
        assert!(done.status.success(), "{name}: {}", text(&done.stderr));
        assert_eq!(fs::read_to_string(out.join("postures.csv")).unwrap().lines().count(), 7, "{name}");
    }
}

#[test]
fn poses_of_a_controller_beside_images_become_a_data_set() {
    let place = tempfile::tempdir().unwrap();
    let (folder, out, rig) = (place.path().join("shots"), place.path().join("out"), place.path().join("rig.toml"));
    fs::create_dir(&folder).unwrap();
    let camera = "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\n";
    let mount = "[mount]\ntranslation_mm = [0.0, 0.0, 0.0]\nquaternion_xyzw = [0.0, 0.0, 0.0, 1.0]\n";
    fs::write(&rig, format!("name = \"x\"\n{mount}[color]\n{camera}")).unwrap();
    for index in 0..3 {
        image::GrayImage::from_pixel(64, 48, image::Luma([40 * index]))
            .save(folder.join(format!("{index}.png")))
            .unwrap();
    }
    // One pose, as four makers write it: a quarter of a turn about z, then about the new y.
    for (maker, header, numbers) in [
        ("kuka", "X,Y,Z,A,B,C", "400,0,500,90,90,0"),
        ("fanuc", "X,Y,Z,W,P,R", "400,0,500,0,90,90"),
        ("abb", "x,y,z,q1,q2,q3,q4", "400,0,500,0.5,-0.5,0.5,0.5"),
        ("ur", "X,Y,Z,Rx,Ry,Rz", "0.4,0,0.5,-1.2091995761561452,1.2091995761561452,1.2091995761561452"),
    ] {
        let table = format!("{header}\n{numbers}\n{numbers}\n{numbers}\n");
        fs::write(folder.join("poses.csv"), table).unwrap();
        succeed(&["import", utf8(&folder), "--poses", maker, "--rig", utf8(&rig), "--quiet", "--out", utf8(&out)]);
        let line = fs::read_to_string(out.join("postures.csv")).unwrap().lines().nth(2).unwrap().to_owned();
        let numbers: Vec<f64> = line.split(',').skip(1).take(7).map(|cell| cell.parse().unwrap()).collect();
        let sign = numbers[6].signum();
        let wanted = [400.0, 0.0, 500.0, -0.5 * sign, 0.5 * sign, 0.5 * sign, 0.5 * sign];
        assert!(numbers.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6), "{maker}: {line}");
    }
    assert_eq!(
        skclam(&["import", utf8(&folder), "--poses", "kuka", "--robot", "ur5e", "--out", utf8(&out)]).status.code(),
        Some(2)
    );
    let message = fail(&["import", utf8(&folder), "--poses", "kuka", "--out", utf8(&out)]);
    assert!(message.contains("--rig"), "{message}");
}
