//! Cameras that are described by half, by two, or not at all.

use crate::world::*;
use skclam::geometry::PinholeCamera;
use skclam::import::{CameraSource, DepthChoice, ImportOptions};
use skclam::rig::Rig;

fn with_infos(change: impl Fn(&str, usize, &mut Info)) -> Vec<Message> {
    let mut messages = good(50.0);
    for (index, message) in messages.iter_mut().filter(|message| message.kind == INFO).enumerate() {
        if let Content::Info(info) = &mut message.content {
            // Two cameras in turn.
            change(&message.topic, index / 2, info);
        }
    }
    messages
}

/// A rig whose cameras somebody has measured.
fn measured() -> Rig {
    let mut rig = hp3j();
    let of = |info: Info| PinholeCamera {
        width: info.size.0,
        height: info.size.1,
        fx: info.k[0],
        fy: info.k[4],
        cx: info.k[2],
        cy: info.k[5],
        distortion: [0.0; 5],
    };
    rig.color = of(info(COLOR_FRAME, (16, 12)));
    rig.depth.as_mut().unwrap().camera = of(info(DEPTH_FRAME, (8, 6)));
    rig
}

fn import_measured(messages: &[Message], rig: &Rig, options: &ImportOptions) -> Result<Vec<String>, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    std::fs::write(&path, mcap_of(messages)).unwrap();
    let (summary, dataset) = import_file(&path, rig, options)?;
    assert_eq!((dataset.len(), dataset.rig.color.fx), (INTERVALS, 19.2));
    Ok(summary.warnings)
}

fn is_right(name: &str, messages: &[Message]) {
    let (_, dataset) = import_with(messages, &builtin()).unwrap_or_else(|error| panic!("{name}: {error}"));
    let (color, depth) = (dataset.rig.color, dataset.rig.depth.unwrap());
    assert_eq!((color.fx, color.cx, color.cy, color.width), (19.2, 7.5, 5.5, 16), "{name}");
    assert!((depth.camera.fx - 9.6).abs() < 1e-12 && depth.camera.height == 6, "{name}: {depth:?}");
    assert_eq!(dataset.len(), INTERVALS, "{name}");
}

#[test]
fn half_filled_messages_are_read_as_far_as_they_are_right() {
    type Change = fn(&mut Info);
    let changes: [(&str, Change); 12] = [
        ("P is zero", |info| info.p = [0.0; 12]),
        ("P is NaN", |info| info.p = [f64::NAN; 12]),
        ("K is zero", |info| info.k = [0.0; 9]),
        ("K is NaN", |info| info.k = [f64::NAN; 9]),
        ("R is zero", |info| info.r = [0.0; 9]),
        ("R is NaN", |info| info.r = [f64::NAN; 9]),
        ("R and P are zero", |info| (info.r, info.p) = ([0.0; 9], [0.0; 12])),
        ("no D", |info| info.d.clear()),
        ("no model", |info| (info.model, info.d) = ("", vec![])),
        ("no centre in K", |info| (info.k[2], info.k[5]) = (0.0, 0.0)),
        ("no size", |info| info.size = (0, 0)),
        ("no frame", |info| info.frame.clear()),
    ];
    for (name, change) in changes {
        for camera in ["/camera/color", "/camera/depth", "/camera"] {
            is_right(
                name,
                &with_infos(|topic, _, info| {
                    if topic.starts_with(camera) {
                        change(info)
                    }
                }),
            );
        }
        // The first messages alone, or all but some.
        is_right(
            name,
            &with_infos(|_, index, info| {
                if index < 3 {
                    change(info)
                }
            }),
        );
        is_right(
            name,
            &with_infos(|_, index, info| {
                if index > 3 {
                    change(info)
                }
            }),
        );
    }
}

#[test]
fn empty_messages_decide_nothing() {
    type Change = fn(&mut Info);
    let empty: Change = |info| (info.size, info.k, info.p, info.d) = ((0, 0), [0.0; 9], [0.0; 12], vec![]);
    let sized: Change = |info| (info.k, info.p) = ([0.0; 9], [0.0; 12]);
    for change in [empty, sized] {
        for (first, last) in [(0, 1), (0, 5), (3, 4), (0, 130), (138, 140)] {
            for camera in ["/camera/color", "/camera/depth", "/camera"] {
                let messages = with_infos(|topic, index, info| {
                    if topic.starts_with(camera) && (first..last).contains(&index) {
                        change(info);
                    }
                });
                is_right("empty", &messages);
            }
        }
        let messages = with_infos(|topic, _, info| {
            if topic.starts_with("/camera/color") {
                change(info)
            }
        });
        refused("all empty", &messages, &builtin(), &["/camera/color/camera_info", "not calibrated", "--rig"]);
        // The advice is followed.
        let warnings = import_measured(&messages, &measured(), &ImportOptions::default()).unwrap();
        assert!(warnings.iter().any(|warning| warning.contains("[color] in the given rig")), "{warnings:?}");
    }
}

#[test]
fn models_that_cannot_be_read_are_taken_from_a_rig() {
    for (model, d) in [
        ("rational_polynomial", vec![0.1; 8]),
        ("rational_polynomial", vec![0.1; 12]),
        ("rational_polynomial", vec![0.1; 14]),
        ("equidistant", vec![0.1; 4]),
        ("fisheye", vec![0.1; 4]),
        ("plumb_bob", vec![0.1; 8]),
        ("double_sphere", vec![0.2; 2]),
        ("plumb_bob", vec![f64::NAN; 5]),
        ("thin_prism", vec![0.1; 12]),
        ("kannala_brandt4", vec![0.1; 4]),
    ] {
        let messages = with_infos(|topic, _, info| {
            if topic.starts_with("/camera/color") {
                (info.model, info.d) = (model, d.clone());
            }
        });
        refused(model, &messages, &builtin(), &["/camera/color/camera_info", "--rig"]);
        let warnings = import_measured(&messages, &measured(), &ImportOptions::default()).unwrap();
        assert!(warnings.iter().any(|warning| warning.contains("[color] in the given rig")), "{warnings:?}");
        let options = ImportOptions { cameras: CameraSource::Rig, ..ImportOptions::default() };
        import_measured(&messages, &measured(), &options).unwrap();
        // A rig for another size does not replace it.
        let mut other = measured();
        (other.color.width, other.color.height) = (32, 24);
        let error = import_measured(&messages, &other, &ImportOptions::default()).unwrap_err();
        assert!(error.contains("16 x 12") && error.contains("32 x 24"), "{error}");
    }
}

#[test]
fn no_camera_of_the_virtual_cell_replaces_a_real_one() {
    // No transform between the cameras, one that leads elsewhere, one that nobody can read.
    let mut without = good(50.0);
    without.retain(|message| message.kind != TF);
    let elsewhere = |parent: &str, child: &str, pose| {
        let mut messages = without.clone();
        let content = Content::Tf { parent: parent.into(), child: child.into(), pose };
        messages.push(Message { topic: "/tf_static".into(), kind: TF, stamp: ns(0.0), log: ns(0.0), content });
        messages
    };
    let unit = [0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    for messages in [
        without.clone(),
        elsewhere("camera_link", COLOR_FRAME, unit),
        elsewhere("camera_link", DEPTH_FRAME, unit),
        elsewhere("base", "tool0", unit),
        elsewhere(COLOR_FRAME, "other_depth", unit),
        elsewhere(COLOR_FRAME, DEPTH_FRAME, [f64::NAN; 7]),
        elsewhere(COLOR_FRAME, DEPTH_FRAME, [0.0; 7]),
    ] {
        refused(
            "no transform",
            &messages,
            &builtin(),
            &["color_from_depth", "[depth.color_from_depth]", "--depth-topic none"],
        );
        let warnings = import_measured(&messages, &measured(), &ImportOptions::default()).unwrap();
        assert!(
            warnings.iter().any(|warning| warning.contains("color_from_depth is that of the given rig")),
            "{warnings:?}"
        );
        let (_, dataset) = import_with(&messages, &ImportOptions { depth: DepthChoice::None, ..builtin() }).unwrap();
        assert!(dataset.rig.depth.is_none());
    }
    // On /tf, as long as it does not move; two that differ are none.
    for (topic, count, step, is_known) in
        [("/tf", 50, 0.0, true), ("/tf", 50, 0.01, false), ("/tf_static", 2, 0.05, false)]
    {
        let mut messages = without.clone();
        for index in 0..count {
            let mut pose = unit;
            pose[1] = step * f64::from(index);
            let content = Content::Tf { parent: COLOR_FRAME.into(), child: DEPTH_FRAME.into(), pose };
            let time = ns(0.1 * f64::from(index));
            messages.push(Message { topic: topic.into(), kind: TF, stamp: time, log: time, content });
        }
        let imported = import_with(&messages, &builtin());
        assert_eq!(imported.is_ok(), is_known, "{topic}, {step}");
    }
    for camera in ["/camera/color", "/camera/depth"] {
        let mut messages = good(50.0);
        messages.retain(|message| message.kind != INFO || !message.topic.starts_with(camera));
        refused("no CameraInfo", &messages, &builtin(), &["no CameraInfo", camera, "--rig"]);
        import_measured(&messages, &measured(), &ImportOptions::default()).unwrap();
    }
}

#[test]
fn two_cameras_on_a_topic_are_noticed() {
    for every in [2, 3, 5, 10] {
        for camera in ["/camera/color", "/camera/depth"] {
            let mut messages = good(50.0);
            let images =
                messages.iter_mut().filter(|message| message.kind == IMAGE && message.topic.starts_with(camera));
            for message in images.step_by(every) {
                if let Content::Image { frame, .. } = &mut message.content {
                    *frame = "another_camera".to_owned();
                }
            }
            refused("frames", &messages, &builtin(), &["two cameras", "another_camera"]);
            let changed = with_infos(|topic, index, info| {
                if topic.starts_with(camera) && index % every == 0 {
                    (info.k[0], info.p[0]) = (31.0, 31.0);
                }
            });
            refused("infos", &changed, &builtin(), &["CameraInfo changes", camera]);
        }
    }
    // A camera that starts with another size.
    let mut messages = good(50.0);
    for message in messages.iter_mut().filter(|message| message.kind == IMAGE).take(4) {
        if let Content::Image { size, .. } = &mut message.content {
            *size = (4, 4);
        }
    }
    right("another size at first", &messages, &builtin(), &["passed over"]);
}
