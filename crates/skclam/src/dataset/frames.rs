//! Images in memory, as a program has them that drives arm and camera itself.

use super::{Dataset, DatasetError, FrameSource, PostureRecord, images};
use image::{DynamicImage, GrayImage, ImageBuffer, Luma};
use skclam_geometry::{DepthCamera, PinholeCamera};
use skclam_rig::{Posture, PostureState, Rig, fill_joint_rates};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A depth image as cameras deliver it: z-depth in counts of the rig's `depth.unit_m`, 0 where nothing was measured.
pub type DepthCounts = ImageBuffer<Luma<u16>, Vec<u16>>;

/// What one posture brings.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Where the arm was.
    pub posture: Posture,
    /// What the colour camera saw, grey or RGB (`rgb_image.into()`).
    pub color: DynamicImage,
    /// What the depth camera measured at the same moment.
    pub depth: Option<DepthCounts>,
}

/// A recording in memory: frames in the order of their postures' indices, and masks that hold for all of them.
#[derive(Debug, Clone, Default)]
pub struct Frames {
    /// The postures with their images.
    pub frames: Vec<Frame>,
    /// 0 where the colour camera sees what moves with it.
    pub color_mask: Option<GrayImage>,
    /// The same for the depth camera.
    pub depth_mask: Option<GrayImage>,
}

impl From<Vec<Frame>> for Frames {
    fn from(frames: Vec<Frame>) -> Self {
        Frames { frames, ..Frames::default() }
    }
}

/// In the place of a folder in messages and reports.
const PLACE: &str = "images in memory";

/// The images by the names that records and rig have for them.
#[derive(Debug)]
struct Memory(HashMap<PathBuf, DynamicImage>);

impl FrameSource for Memory {
    fn place(&self) -> &Path {
        Path::new(PLACE)
    }

    fn image(&self, name: &Path, _: &PinholeCamera, _: &'static str) -> Result<DynamicImage, DatasetError> {
        let missing = || problem(format!("there is none of the name {}", name.display()));
        self.0.get(name).cloned().ok_or_else(missing)
    }
}

fn problem(problem: String) -> DatasetError {
    DatasetError::Frames { problem }
}

impl Frames {
    /// Names every image, checks its size against the rig's cameras, and enters the masks into the rig.
    pub(super) fn into_dataset(self, mut rig: Rig) -> Result<Dataset, DatasetError> {
        let mut stored = HashMap::new();
        let mut records: Vec<PostureRecord> = Vec::with_capacity(self.frames.len());
        for Frame { posture, color, depth } in self.frames {
            let index = posture.index;
            let name = PathBuf::from(format!("color/{index:03}"));
            check_size(&name, &color, &rig.color, "color")?;
            stored.insert(name.clone(), color);
            let depth = match (depth, &rig.depth) {
                (None, _) => None,
                (Some(_), None) => {
                    let why = "it has a depth image, but the rig has no depth camera; describe it in rig.depth";
                    return Err(problem(format!("posture {index}: {why}")));
                }
                (Some(counts), Some(DepthCamera { camera, .. })) => {
                    let name = PathBuf::from(format!("depth/{index:03}"));
                    let counts = DynamicImage::ImageLuma16(counts);
                    check_size(&name, &counts, camera, "depth")?;
                    stored.insert(name.clone(), counts);
                    Some(name)
                }
            };
            records.push(PostureRecord { posture, color: name, depth });
        }
        let depth_camera = rig.depth.map(|depth| depth.camera);
        let masks = [
            (self.color_mask, &mut rig.color_mask, Some(rig.color), "color"),
            (self.depth_mask, &mut rig.depth_mask, depth_camera, "depth"),
        ];
        for (mask, name, camera, table) in masks {
            enter_mask(&mut stored, mask, name, camera, table)?;
        }
        // As of a table of postures; whoever knows the rates has given them.
        if records.iter().all(|record| record.posture.joint_rates.is_empty()) {
            fill_joint_rates(records.iter_mut().map(|record| &mut record.posture));
        }
        Dataset::from_source(rig, records, Arc::new(Memory(stored)))
    }
}

fn check_size(
    name: &Path,
    image: &DynamicImage,
    camera: &PinholeCamera,
    table: &'static str,
) -> Result<(), DatasetError> {
    images::fits(&Path::new(PLACE).join(name), (image.width(), image.height()), camera, table)
}

/// A mask gets the name that the rig has for it, or one that says what it is.
fn enter_mask(
    stored: &mut HashMap<PathBuf, DynamicImage>,
    mask: Option<GrayImage>,
    name: &mut Option<String>,
    camera: Option<PinholeCamera>,
    table: &'static str,
) -> Result<(), DatasetError> {
    let Some(mask) = mask else {
        let Some(name) = name else { return Ok(()) };
        let remedy = format!("give it as Frames::{table}_mask or take its name out of the rig");
        return Err(problem(format!("the rig names the mask {name}, which is not among them; {remedy}")));
    };
    let Some(camera) = camera else {
        return Err(problem(format!("there is a {table}_mask, but the rig has no {table} camera")));
    };
    let name = name.get_or_insert_with(|| format!("{table}_mask.png"));
    let mask = DynamicImage::ImageLuma8(mask);
    check_size(Path::new(name), &mask, &camera, table)?;
    stored.insert(PathBuf::from(name.as_str()), mask);
    Ok(())
}

/// Indices rise and every number is finite, as in a table of postures.
pub(super) fn check_postures(records: &[PostureRecord], rig: &Rig) -> Result<(), DatasetError> {
    let mut before = None;
    for PostureRecord { posture, .. } in records {
        let index = posture.index;
        if before.is_some_and(|before| index <= before) {
            return Err(problem(format!("posture {index} follows {}; the index must rise", before.unwrap_or(0))));
        }
        before = Some(index);
        let values = match &posture.state {
            PostureState::Joints(values) => values.clone(),
            PostureState::FlangePose(pose) => pose.to_homogeneous().iter().copied().collect(),
        };
        // Rates that follow from neighbours are wrong where these are: they are looked at last.
        if let Some(value) = values.iter().chain(&posture.timestamp_s).find(|value| !value.is_finite()) {
            return Err(problem(format!("posture {index} has the number {value}; finite numbers are needed")));
        }
        rig.base_from_color(posture).map_err(|error| problem(error.to_string()))?;
    }
    let rate = |record: &PostureRecord| record.posture.joint_rates.iter().copied().find(|rate| !rate.is_finite());
    match records.iter().find_map(|record| Some((record.posture.index, rate(record)?))) {
        Some((index, rate)) => {
            Err(problem(format!("posture {index} has the joint rate {rate}; finite numbers are needed")))
        }
        None => Ok(()),
    }
}
