//! A result as a recording: one MCAP file with the images, the frames, both trajectories, the maps and the residuals,
//! in the Foxglove schemas (protobuf) that Foxglove and Rerun open.
//!
//! | topic | schema | when |
//! | --- | --- | --- |
//! | `/tf` | `foxglove.FrameTransforms` | every posture: base, links, flange, camera, depth camera; the nominal ones below `nominal/` |
//! | `/camera/image` | `foxglove.CompressedImage` | every posture, the file's own bytes if it is JPEG or PNG |
//! | `/camera/depth` | `foxglove.RawImage` | every posture with depth, 16UC1 millimetres |
//! | `/camera/calibration`, `/nominal/camera/calibration` | `foxglove.CameraCalibration` | every posture |
//! | `/camera/depth_calibration` | `foxglove.CameraCalibration` | every posture with depth |
//! | `/camera/pose`, `/nominal/camera/pose` | `foxglove.PoseInFrame` | every posture |
//! | `/camera/residuals`, `/nominal/camera/residuals` | `foxglove.ImageAnnotations` | every posture with matches |
//! | `/trajectory`, `/nominal/trajectory` | `foxglove.PosesInFrame` | at the start, whole |
//! | `/trajectory_lines` | `foxglove.SceneUpdate` | at the start: nominal red, calibrated green |
//! | `/map`, `/nominal/map` | `foxglove.PointCloud` | at the start |
//!
//! A posture without a time gets its index in seconds. Postures are written one by one: memory holds one image, one
//! map, and the matches of the residuals.

mod messages;
mod residuals;
mod writer;

use crate::dataset::{Dataset, DatasetError};
use crate::pipeline::{RunError, localize};
use crate::progress::{Progress, Stage};
use crate::summary::Summary;
use messages::Edge;
use residuals::{matches_again, posture_residuals};
use serde::Serialize;
use skclam_geometry::Isometry3;
use skclam_rig::{Posture, PostureState, Rig, RigFileError};
use std::collections::BTreeMap;
use std::io::{BufReader, Seek, Write};
use std::path::{Path, PathBuf};
use writer::{RecordingWriter, Time};

/// Options of a result's recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResultRecordingOptions {
    /// Frame of the arm's base.
    pub base_frame: String,
    /// Frame of the flange.
    pub flange_frame: String,
    /// Optical frame of the colour camera.
    pub camera_frame: String,
    /// Optical frame of the depth camera.
    pub depth_frame: String,
    /// Lines to draw into one image, at most about; `None`: no residuals, and the images are not matched again.
    pub residual_lines: Option<usize>,
}

impl Default for ResultRecordingOptions {
    fn default() -> Self {
        ResultRecordingOptions {
            base_frame: "base".to_owned(),
            flange_frame: "tool0".to_owned(),
            camera_frame: "camera_color_optical_frame".to_owned(),
            depth_frame: "camera_depth_optical_frame".to_owned(),
            residual_lines: Some(600),
        }
    }
}

/// Why a recording could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ResultRecordingError {
    /// The dataset, its images, or finding the matches again.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A rig file.
    #[error(transparent)]
    RigFile(#[from] RigFileError),
    /// A file of the result.
    #[error("{}: {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Why it cannot be used.
        problem: String,
    },
    /// A time that MCAP has not.
    #[error("posture {index}: the time {seconds} s is not between 0 and 4294967295 s, as a recording's must be")]
    Time {
        /// The posture's index.
        index: u64,
        /// Its time.
        seconds: f64,
    },
    /// A message that could not be encoded.
    #[error("{topic}: {problem}")]
    Encode {
        /// The topic.
        topic: String,
        /// Why.
        problem: String,
    },
    /// A message type without a schema.
    #[error("{topic}: the message has no schema")]
    NoSchema {
        /// The topic.
        topic: String,
    },
    /// The file could not be written.
    #[error("writing MCAP: {0}")]
    Write(#[from] mcap::McapError),
}

impl From<DatasetError> for ResultRecordingError {
    fn from(error: DatasetError) -> Self {
        ResultRecordingError::Run(error.into())
    }
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordedResult {
    /// Messages by topic.
    pub messages: BTreeMap<String, u32>,
    /// Points of the calibrated map; `None` where the result has none.
    pub map_points: Option<usize>,
    /// Points of the nominal map.
    pub nominal_map_points: Option<usize>,
    /// What the recording lacks, and why.
    pub left_out: Vec<String>,
}

/// Writes the result of a run as MCAP. `dataset`: with the nominal rig, as the run had it. `result`: the run's folder,
/// or a rig file.
///
/// The residuals need the matches, which a result does not keep: they are found again by the configuration in
/// `summary.json`, which takes as long as these stages took in the run.
///
/// # Errors
/// [`ResultRecordingError`].
pub fn record_result<W: Write + Seek>(
    dataset: &Dataset,
    result: &Path,
    options: &ResultRecordingOptions,
    out: W,
    progress: &dyn Progress,
) -> Result<RecordedResult, ResultRecordingError> {
    let rig_path = if result.is_dir() { result.join("rig.toml") } else { result.to_owned() };
    let calibrated = Rig::read(&rig_path)?;
    let mut left_out = Vec::new();
    let summary = read_summary(result, &mut left_out)?;
    let matches = match (&summary, options.residual_lines) {
        (Some((summary, _)), Some(_)) => Some(matches_again(dataset, &summary.configuration, progress)?),
        (None, Some(_)) => {
            left_out.push("residuals: without summary.json the run's configuration is not known".to_owned());
            None
        }
        (_, None) => None,
    };
    let poses = |rig: &Rig| -> Result<Vec<Isometry3>, ResultRecordingError> {
        Ok(localize(dataset, rig)?.iter().map(|stamped| stamped.base_from_camera).collect())
    };
    let (nominal_poses, calibrated_poses) = (poses(&dataset.rig)?, poses(&calibrated)?);
    let times: Vec<Time> = dataset.records.iter().map(|record| time(&record.posture)).collect::<Result<_, _>>()?;

    let mut writer = RecordingWriter::new(out)?;
    let begin = times[0];
    let base = options.base_frame.as_str();
    let mut about = BTreeMap::from([
        ("program".to_owned(), concat!("skclam ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("rig".to_owned(), skclam_files::shown(&calibrated.name).into_owned()),
    ]);
    if let Some((summary, text)) = &summary {
        about.insert("verdict".to_owned(), skclam_files::on_screen(&summary.verdict).into_owned());
        writer.attachment("summary.json", "application/json", begin, text)?;
    }
    writer.metadata("skclam", about)?;
    writer.attachment("rig.toml", "application/toml", begin, &calibrated.to_toml()?)?;
    writer.attachment("rig_nominal.toml", "application/toml", begin, &dataset.rig.to_toml()?)?;
    writer.message("/trajectory", begin, &messages::poses_in_frame(begin, base, &calibrated_poses))?;
    writer.message("/nominal/trajectory", begin, &messages::poses_in_frame(begin, base, &nominal_poses))?;
    let lines = [
        ("nominal", messages::NOMINAL, nominal_poses.as_slice()),
        ("calibrated", messages::CALIBRATED, calibrated_poses.as_slice()),
    ];
    writer.message("/trajectory_lines", begin, &messages::lines(begin, base, lines))?;
    let mut map = |file: &str, topic: &str| -> Result<Option<usize>, ResultRecordingError> {
        let path = result.join(file);
        if !path.is_file() {
            left_out.push(format!("{topic}: the result has no {file}"));
            return Ok(None);
        }
        let wrong = |problem: String| ResultRecordingError::File { path: path.clone(), problem };
        let file = skclam_files::open(&path, skclam_files::Kind::Map).map_err(|error| wrong(error.to_string()))?;
        let model = skclam_mapping::read_ply(BufReader::new(file)).map_err(|error| wrong(error.to_string()))?;
        writer.message(topic, begin, &messages::point_cloud(begin, base, model.points()))?;
        Ok(Some(model.points().len()))
    };
    let map_points = map("map.ply", "/map")?;
    let nominal_map_points = map("map_nominal.ply", "/nominal/map")?;

    progress.begin(Stage::Export, dataset.len() as u64);
    for (position, &time) in times.iter().enumerate() {
        if progress.stop_requested() {
            return Err(RunError::Interrupted.into());
        }
        let posture = &dataset.records[position].posture;
        let mut edges = frames(&calibrated, posture, "", options)?;
        edges.extend(frames(&dataset.rig, posture, NOMINAL_PREFIX, options)?);
        writer.message("/tf", time, &messages::transforms(time, &edges))?;
        let nominal_frame = format!("{NOMINAL_PREFIX}{}", options.camera_frame);
        let cameras = [
            ("", &options.camera_frame, &calibrated, &calibrated_poses, messages::CALIBRATED),
            ("/nominal", &nominal_frame, &dataset.rig, &nominal_poses, messages::NOMINAL),
        ];
        for (prefix, frame, rig, poses, color) in cameras {
            let calibration = messages::camera_calibration(time, frame, &rig.color);
            writer.message(&format!("{prefix}/camera/calibration"), time, &calibration)?;
            let pose = messages::pose_in_frame(time, base, &poses[position]);
            writer.message(&format!("{prefix}/camera/pose"), time, &pose)?;
            if let (Some(data), Some(most)) = (&matches, options.residual_lines)
                && let Some(residuals) = posture_residuals(rig, poses, data, position, most)
            {
                let annotations = messages::annotations(time, &residuals, color);
                writer.message(&format!("{prefix}/camera/residuals"), time, &annotations)?;
            }
        }
        let (format, data) = dataset.color_file(position)?;
        let format = if format == image::ImageFormat::Jpeg { "jpeg" } else { "png" };
        let image = messages::compressed_image(time, &options.camera_frame, format, data);
        writer.message("/camera/image", time, &image)?;
        if let (Some(depth), Some(camera)) = (dataset.depth(position)?, &calibrated.depth) {
            let image = messages::depth_image(time, &options.depth_frame, &depth);
            writer.message("/camera/depth", time, &image)?;
            let calibration = messages::camera_calibration(time, &options.depth_frame, &camera.camera);
            writer.message("/camera/depth_calibration", time, &calibration)?;
        }
        progress.step();
    }
    Ok(RecordedResult { messages: writer.finish()?, map_points, nominal_map_points, left_out })
}

/// Before the names of the nominal arm's frames.
const NOMINAL_PREFIX: &str = "nominal/";

fn time(posture: &Posture) -> Result<Time, ResultRecordingError> {
    let seconds = posture.timestamp_s.unwrap_or(posture.index as f64);
    Time::from_seconds(seconds).ok_or(ResultRecordingError::Time { index: posture.index, seconds })
}

/// The frames of a rig at a posture, each below the one before: base, links (where the joints are known), flange,
/// camera, depth camera.
fn frames(
    rig: &Rig,
    posture: &Posture,
    prefix: &str,
    options: &ResultRecordingOptions,
) -> Result<Vec<Edge>, ResultRecordingError> {
    let base_from_flange = rig.base_from_flange(posture).map_err(RunError::from)?;
    let mut edges: Vec<Edge> = Vec::new();
    let mut base_from_last = Isometry3::identity();
    let mut last = options.base_frame.clone();
    if let (Some(robot), PostureState::Joints(joints)) = (&rig.robot, &posture.state) {
        let links = robot
            .base_from_links(joints)
            .map_err(|source| RunError::from(skclam_rig::RigError::Kinematics { index: posture.index, source }))?;
        for (index, base_from_link) in links.into_iter().enumerate() {
            let child = format!("{prefix}link_{}", index + 1);
            let parent = std::mem::replace(&mut last, child.clone());
            edges.push(Edge { parent, child, parent_from_child: base_from_last.inverse() * base_from_link });
            base_from_last = base_from_link;
        }
    }
    let flange = format!("{prefix}{}", options.flange_frame);
    let camera = format!("{prefix}{}", options.camera_frame);
    let last_from_flange = base_from_last.inverse() * base_from_flange;
    edges.push(Edge { parent: last, child: flange.clone(), parent_from_child: last_from_flange });
    edges.push(Edge { parent: flange, child: camera.clone(), parent_from_child: rig.flange_from_color });
    if let Some(depth) = &rig.depth {
        let child = format!("{prefix}{}", options.depth_frame);
        edges.push(Edge { parent: camera, child, parent_from_child: depth.color_from_depth });
    }
    Ok(edges)
}

/// The summary and its text; `None`, with a reason, where there is none.
fn read_summary(result: &Path, left_out: &mut Vec<String>) -> Result<Option<(Summary, String)>, ResultRecordingError> {
    let path = result.join("summary.json");
    if !path.is_file() {
        left_out.push("summary.json: the result has none".to_owned());
        return Ok(None);
    }
    let wrong = |problem: String| ResultRecordingError::File { path: path.clone(), problem };
    let text = skclam_files::read_text(&path, skclam_files::Kind::Summary).map_err(|error| wrong(error.to_string()))?;
    let summary = serde_json::from_str(&text).map_err(|error| wrong(format!("no summary of a run: {error}")))?;
    Ok(Some((summary, text)))
}
