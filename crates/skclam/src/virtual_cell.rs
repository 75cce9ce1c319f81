//! The virtual cell as a data set, on disk with the truth beside it or in memory.

use crate::dataset::{DepthCounts, Frame, PostureRecord, write_depth_png, write_postures};
use crate::output::StagedFolder;
use crate::pipeline::RunError;
use crate::progress::{Progress, Stage};
use crate::trajectory::{StampedPose, trajectory_text};
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use skclam_mapping::{PointCloud, TriangleMesh, write_ply};
use skclam_rig::{PostureState, Rig};
use skclam_simulation::{Capture, Simulation, depth_counts};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// Quality of the JPEG images: what cameras deliver at their best setting.
const JPEG_QUALITY: u8 = 95;

/// A camera and a depth camera with fewer pixels and the same view; for quick runs and tests.
pub fn scaled_rig(rig: &Rig, factor: f64) -> Rig {
    let mut scaled = rig.clone();
    scaled.color = rig.color.scaled(factor);
    if let Some(depth) = &mut scaled.depth {
        depth.camera = depth.camera.scaled(factor);
    }
    scaled
}

/// Renders every posture and writes the data set: `rig.toml` (nominal), `postures.csv`, `color/`, `depth/`, and in
/// `truth/` the true rig, the true camera poses and the scene's surface.
pub fn write_virtual_cell(
    simulation: &Simulation,
    staged: &StagedFolder,
    progress: &dyn Progress,
) -> Result<(), RunError> {
    let count = simulation.postures().len();
    progress.begin(Stage::Simulate, count as u64);
    let captures: Vec<(PostureRecord, StampedPose)> = (0..count)
        .into_par_iter()
        .map(|number| {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            let capture = simulation.capture(number)?;
            let record = write_images(&capture, simulation.nominal_rig(), staged)?;
            progress.step();
            let pose = StampedPose { timestamp_s: number as f64, base_from_camera: capture.true_base_from_color };
            Ok((record, pose))
        })
        .collect::<Result<_, RunError>>()?;
    let (records, poses): (Vec<PostureRecord>, Vec<StampedPose>) = captures.into_iter().unzip();
    let kinds: Vec<_> =
        simulation.nominal_rig().robot.iter().flat_map(|robot| robot.joints().iter().map(|joint| joint.kind)).collect();
    staged.write("rig.toml", simulation.nominal_rig().to_toml()?)?;
    staged.write("postures.csv", write_postures(&records, &kinds)?)?;
    staged.write("truth/rig.toml", simulation.true_rig().to_toml()?)?;
    staged.write("truth/trajectory.txt", trajectory_text(&poses))?;
    write_scene(simulation, &staged.path("truth/scene.ply")?)
}

/// Renders every posture into memory, as a program has it that drives arm and camera itself; the times are those of
/// [`write_virtual_cell`].
///
/// # Errors
/// What the simulation refuses, and the wish to stop.
pub fn render_frames(simulation: &Simulation, progress: &dyn Progress) -> Result<Vec<Frame>, RunError> {
    let count = simulation.postures().len();
    progress.begin(Stage::Simulate, count as u64);
    let frame = |number: usize| {
        if progress.stop_requested() {
            return Err(RunError::Interrupted);
        }
        let capture = simulation.capture(number)?;
        let depth = capture.depth.as_ref().zip(simulation.nominal_rig().depth.as_ref()).and_then(|(depth, camera)| {
            DepthCounts::from_raw(depth.width(), depth.height(), depth_counts(depth, camera.unit_m))
        });
        progress.step();
        Ok(Frame { posture: capture.posture.at(Some(number as f64)), color: capture.color.into(), depth })
    };
    (0..count).into_par_iter().map(frame).collect()
}

fn write_images(capture: &Capture, rig: &Rig, staged: &StagedFolder) -> Result<PostureRecord, RunError> {
    let index = capture.posture.index;
    let color = PathBuf::from(format!("color/{index:03}.jpg"));
    write_jpeg(&staged.path(&color)?, &capture.color)?;
    let depth = match (&capture.depth, &rig.depth) {
        (Some(depth), Some(camera)) => {
            let name = PathBuf::from(format!("depth/{index:03}.png"));
            write_depth_png(&staged.path(&name)?, depth, camera.unit_m)?;
            Some(name)
        }
        _ => None,
    };
    let mut posture = capture.posture.clone();
    posture.timestamp_s = Some(index as f64);
    debug_assert!(matches!(posture.state, PostureState::Joints(_)));
    Ok(PostureRecord { posture, color, depth })
}

fn write_jpeg(path: &Path, image: &RgbImage) -> Result<(), RunError> {
    let io = |source| crate::dataset::DatasetError::Io { path: path.to_owned(), source };
    let mut writer = BufWriter::new(File::create(path).map_err(io)?);
    JpegEncoder::new_with_quality(&mut writer, JPEG_QUALITY)
        .encode_image(image)
        .map_err(|error| crate::dataset::DatasetError::Image { path: path.to_owned(), problem: error.to_string() })?;
    writer.flush().map_err(io)?;
    Ok(())
}

fn write_scene(simulation: &Simulation, path: &Path) -> Result<(), RunError> {
    let io = |source| crate::dataset::DatasetError::Io { path: path.to_owned(), source };
    let model = &simulation.scene().model;
    let mesh = TriangleMesh {
        vertices: PointCloud {
            points: model.vertices.iter().map(|point| [point.x as f32, point.y as f32, point.z as f32]).collect(),
            ..PointCloud::default()
        },
        triangles: model.triangles.iter().map(|triangle| triangle.vertices).collect(),
    };
    let mut writer = BufWriter::new(File::create(path).map_err(io)?);
    write_ply(&skclam_mapping::Model::Mesh(mesh), &mut writer)?;
    writer.flush().map_err(io)?;
    Ok(())
}
