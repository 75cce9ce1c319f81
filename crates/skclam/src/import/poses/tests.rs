use super::*;
use crate::dataset::Dataset;
use crate::output::Contents;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use skclam_geometry::Isometry3;
use skclam_rig::builtin_rig;

const NOTATIONS: [PoseNotation; 7] = [
    PoseNotation::Kuka,
    PoseNotation::Fanuc,
    PoseNotation::Abb,
    PoseNotation::Ur,
    PoseNotation::Staubli,
    PoseNotation::Yaskawa,
    PoseNotation::Matrix,
];

fn poses() -> Vec<Isometry3> {
    (0..12)
        .map(|step| {
            let k = f64::from(step);
            let axis = Vector3::new((1.1 * k).sin(), (0.6 * k).cos(), (1.9 * k).sin()) * 1.4;
            Isometry3::from_parts(
                Translation3::new(0.4 + 0.01 * k, -0.2 + 0.02 * k, 0.5),
                UnitQuaternion::from_scaled_axis(axis),
            )
        })
        .collect()
}

fn rig() -> Rig {
    let mut rig = builtin_rig("hp3j").unwrap().unwrap();
    (rig.color.width, rig.color.height, rig.robot, rig.depth) = (16, 12, None, None);
    (rig.color.fx, rig.color.fy, rig.color.cx, rig.color.cy) = (20.0, 20.0, 7.5, 5.5);
    rig
}

/// A folder with images and a table whose columns bear units, or do not.
fn folder(notation: PoseNotation, (length, metres): (&str, f64), (angle, radians): (&str, f64)) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let names: Vec<String> = match notation {
        PoseNotation::Kuka => ["A", "B", "C"].map(|name| format!("{name}{angle}")).into(),
        PoseNotation::Fanuc => ["W", "P", "R"].map(|name| format!("{name}{angle}")).into(),
        PoseNotation::Abb => ["q1", "q2", "q3", "q4"].map(str::to_owned).into(),
        PoseNotation::Matrix => (0..9).map(|k| format!("m{}{}", k / 3 + 1, k % 3 + 1)).collect(),
        _ => ["Rx", "Ry", "Rz"].map(|name| format!("{name}{angle}")).into(),
    };
    let is_angle = !matches!(notation, PoseNotation::Abb | PoseNotation::Matrix);
    let mut table = format!("X{length},Y{length},Z{length},{}\n", names.join(","));
    for (index, pose) in poses().iter().enumerate() {
        let (place, rotation) = notation.numbers(pose);
        let place = place.map(|value| format!("{:.12}", value / metres)).join(",");
        let scale = if is_angle { radians } else { 1.0 };
        let rotation: Vec<String> = rotation.iter().map(|value| format!("{:.14}", value / scale)).collect();
        table += &format!("{place},{}\n", rotation.join(","));
        image::GrayImage::from_pixel(16, 12, image::Luma([index as u8]))
            .save(folder.path().join(format!("{index}.png")))
            .unwrap();
    }
    std::fs::write(folder.path().join("poses.csv"), table).unwrap();
    folder
}

fn options(notation: PoseNotation) -> PoseTableOptions {
    PoseTableOptions { notation, length_m: None, angle: None }
}

fn imported(folder: &Path, options: PoseTableOptions) -> Result<(tempfile::TempDir, Dataset), String> {
    let out = tempfile::tempdir().unwrap();
    let staged = StagedFolder::new(out.path().join("cell"), Contents::DataSet).unwrap();
    import_poses(folder, None, &rig(), options, &staged).map_err(|error| error.to_string())?;
    staged.publish().unwrap();
    let dataset = Dataset::open(out.path().join("cell")).unwrap();
    Ok((out, dataset))
}

#[test]
fn seven_notations_in_three_units_give_the_same_poses() {
    let deg = 1f64.to_radians();
    for notation in NOTATIONS {
        let units = [
            (("_mm", 1e-3), ("_deg", deg)),
            (("_m", 1.0), ("_rad", 1.0)),
            (("", notation.usual_length_m().unwrap_or(1.0)), ("", notation.usual_angle())),
        ];
        for (length, angle) in units {
            let folder = folder(notation, length, angle);
            let mut options = options(notation);
            if length.0.is_empty() && notation == PoseNotation::Matrix {
                options.length_m = Some(1.0);
            }
            let (_out, dataset) = imported(folder.path(), options).unwrap();
            assert_eq!(dataset.len(), 12);
            for (index, (record, wanted)) in dataset.records.iter().zip(poses()).enumerate() {
                let PostureState::FlangePose(pose) = &record.posture.state else { panic!("poses expected") };
                let off = pose.inverse() * wanted;
                assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-7, "{notation:?}: {off}");
                // 2.png comes before 10.png.
                assert_eq!(dataset.gray(index).unwrap().as_raw()[0], index as u8);
            }
        }
    }
}

#[test]
fn units_that_no_arm_has_and_columns_that_are_missing_are_named() {
    let deg = 1f64.to_radians();
    let metres = folder(PoseNotation::Kuka, ("", 1.0), ("", deg));
    let error = imported(metres.path(), options(PoseNotation::Kuka)).map(drop).unwrap_err();
    assert!(error.contains("--poses-length m"), "{error}");
    // The advice is followed.
    imported(metres.path(), PoseTableOptions { length_m: Some(1.0), ..options(PoseNotation::Kuka) }).unwrap();
    let millimetres = folder(PoseNotation::Ur, ("", 1e-3), ("", 1.0));
    let error = imported(millimetres.path(), options(PoseNotation::Ur)).map(drop).unwrap_err();
    assert!(error.contains("--poses-length mm"), "{error}");
    let error = imported(metres.path(), options(PoseNotation::Fanuc)).map(drop).unwrap_err();
    assert!(error.contains("no column w") && error.contains("x, y, z, a, b, c"), "{error}");
    let no_unit = folder(PoseNotation::Matrix, ("", 1.0), ("", 1.0));
    let error = imported(no_unit.path(), options(PoseNotation::Matrix)).map(drop).unwrap_err();
    assert!(error.contains("no unit"), "{error}");
    std::fs::remove_file(metres.path().join("3.png")).unwrap();
    let options = PoseTableOptions { length_m: Some(1.0), ..options(PoseNotation::Kuka) };
    let error = imported(metres.path(), options).map(drop).unwrap_err();
    assert!(error.contains("12 poses, but 11 images"), "{error}");
}
