//! The images of the postures as files.

use super::cameras::Cameras;
use super::passed_over::PassedOver;
use super::{Chosen, ImportError, decode_color};
use crate::camera_frames::{CAMERA_FRAMES, CameraFrames, FrameLink};
use crate::dataset::PostureRecord;
use crate::output::StagedFolder;
use crate::progress::Progress;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use skclam_geometry::Isometry3;
use skclam_kinematics::SerialChain;
use skclam_recordings::{
    Candidate, CompressedImage, DepthPixels, Image, MessageKind, Place, PlannedPosture, Recording, RecordingError,
    Topic,
};
use skclam_rig::{Posture, PostureState};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The files that were written.
#[derive(Debug, Default)]
pub(super) struct Written {
    pub color_size: (u32, u32),
    pub depth_size: Option<(u32, u32)>,
    /// Metres a count, where the messages say so.
    pub depth_unit_m: Option<f64>,
    /// By the place of the colour image.
    color: BTreeMap<Place, PathBuf>,
    /// By the place of the depth image.
    depth: BTreeMap<Place, PathBuf>,
}

/// Writes the images of the candidates that were taken. One that cannot be read is passed over and counted.
pub(super) fn images(
    recording: &mut Recording,
    chosen: &Chosen,
    postures: &[PlannedPosture],
    taken: &[usize],
    staged: &StagedFolder,
    passed_over: &mut PassedOver,
    progress: &dyn Progress,
) -> Result<Written, ImportError> {
    let mut names: BTreeMap<Place, usize> = BTreeMap::new();
    let mut places = Vec::new();
    for (index, (posture, &candidate)) in postures.iter().zip(taken).enumerate() {
        let candidate = &posture.candidates[candidate];
        for image in [Some(candidate.color), candidate.depth].into_iter().flatten() {
            // Two colour images may share a depth image; it bears the number of the first.
            names.entry(image.place).or_insert(index);
            places.push(image.place);
        }
    }
    let digits = postures.len().saturating_sub(1).to_string().len().max(3);
    let mut written = Written::default();
    let (mut failed, mut bad) = (None, Vec::new());
    let outcome = recording.read(&places, &mut |topic, message| {
        if progress.stop_requested() {
            return Err(RecordingError::Stopped);
        }
        let Some(index) = names.get(&message.place) else { return Ok(()) };
        let name = format!("{index:0digits$}");
        let result = match topic.id == chosen.color {
            true => written.color(topic, message.data, message.place, &name, staged),
            false => written.depth(topic, message.data, message.place, &name, staged),
        };
        progress.step();
        result.or_else(|error| match error {
            ImportError::Recording(RecordingError::Message { problem, .. }) => {
                bad.push((message.place, topic.name.clone(), problem));
                Ok(())
            }
            ImportError::Recording(error) => Err(error),
            other => {
                failed = Some(other);
                Err(RecordingError::Stopped)
            }
        })
    });
    for (place, topic, problem) in bad {
        // In a folder an image is a file, and that is what a person looks for.
        let file = recording.file_of(place).map_or(String::new(), |file| format!("{file}: "));
        passed_over.add(&topic, format!("{file}{problem}"));
    }
    match (failed, outcome) {
        (Some(error), _) => Err(error),
        (None, outcome) => Ok(outcome.map(|()| written)?),
    }
}

impl Written {
    /// Whether the colour image of a candidate was written.
    pub fn has(&self, candidate: &Candidate) -> bool {
        self.color.contains_key(&candidate.color.place)
    }

    fn color(
        &mut self,
        topic: &Topic,
        data: &[u8],
        place: Place,
        name: &str,
        staged: &StagedFolder,
    ) -> Result<(), ImportError> {
        let pixels = decode_color(topic, data)?;
        let size = (pixels.image.width(), pixels.image.height());
        if self.color.is_empty() {
            self.color_size = size;
        } else {
            same_size(topic, self.color_size, size)?;
        }
        let file = format!("color/{name}.{}", pixels.file_ending.unwrap_or("png"));
        match (pixels.file_ending, topic.kind, topic.wire) {
            // What came as a file stays as it is: not a bit of it changes.
            (Some(_), MessageKind::CompressedImage, Some(wire)) => {
                staged.write(&file, CompressedImage::parse(&topic.name, wire, data)?.data)?;
            }
            (Some(_), MessageKind::ImageFile, _) => staged.write(&file, data)?,
            _ => {
                let color =
                    if pixels.image.color().has_color() { ExtendedColorType::Rgb8 } else { ExtendedColorType::L8 };
                write_png(&staged.path(&file)?, pixels.image.as_bytes(), size, color)?;
            }
        }
        self.color.insert(place, PathBuf::from(file));
        Ok(())
    }

    fn depth(
        &mut self,
        topic: &Topic,
        data: &[u8],
        place: Place,
        name: &str,
        staged: &StagedFolder,
    ) -> Result<(), ImportError> {
        let pixels = match (topic.kind, topic.wire) {
            (MessageKind::Image, Some(wire)) => {
                DepthPixels::from_image(&topic.name, &Image::parse(&topic.name, wire, data)?)?
            }
            (MessageKind::CompressedImage, Some(wire)) => {
                DepthPixels::from_compressed(&topic.name, &CompressedImage::parse(&topic.name, wire, data)?)?
            }
            _ => DepthPixels::from_file(&topic.name, data)?,
        };
        let size = (pixels.width, pixels.height);
        match self.depth_size {
            Some(first) => same_size(topic, first, size)?,
            None => (self.depth_size, self.depth_unit_m) = (Some(size), pixels.unit_m),
        }
        if pixels.unit_m != self.depth_unit_m {
            let problem = format!("metres a count change from {:?} to {:?}", self.depth_unit_m, pixels.unit_m);
            return Err(RecordingError::Message { topic: topic.name.clone(), problem }.into());
        }
        let file = format!("depth/{name}.png");
        // The encoder takes 16-bit samples in the machine's order.
        let bytes: Vec<u8> = pixels.counts.iter().flat_map(|count| count.to_ne_bytes()).collect();
        write_png(&staged.path(&file)?, &bytes, size, ExtendedColorType::L16)?;
        self.depth.insert(place, PathBuf::from(file));
        Ok(())
    }
}

/// Writes how the camera's driver names its frames, for the export: the optical frame has a parent already.
pub(super) fn frames(cameras: &Cameras, chosen: &Chosen, staged: &StagedFolder) -> Result<(), ImportError> {
    let Some(optical_frame) = cameras.color_frame(chosen) else { return Ok(()) };
    let links = cameras.frames.chain(optical_frame);
    let link = |(frame, parent, parent_from_frame): &(String, String, Isometry3)| {
        FrameLink::new(frame, parent, parent_from_frame)
    };
    let frames = CameraFrames { optical_frame: optical_frame.to_owned(), links: links.iter().map(link).collect() };
    staged.write(CAMERA_FRAMES, frames.to_json())?;
    Ok(())
}

fn same_size(topic: &Topic, first: (u32, u32), now: (u32, u32)) -> Result<(), RecordingError> {
    if first == now {
        return Ok(());
    }
    let problem = format!("the images change their size from {} x {} to {} x {}", first.0, first.1, now.0, now.1);
    Err(RecordingError::Message { topic: topic.name.clone(), problem })
}

fn write_png(
    path: &Path,
    bytes: &[u8],
    (width, height): (u32, u32),
    color: ExtendedColorType,
) -> Result<(), ImportError> {
    let io = |source| ImportError::Io { path: path.to_owned(), source };
    let file = std::io::BufWriter::new(std::fs::File::create(path).map_err(io)?);
    let encoder = PngEncoder::new_with_quality(file, CompressionType::Fast, FilterType::Adaptive);
    encoder.write_image(bytes, width, height, color).map_err(|error| io(std::io::Error::other(error)))
}

/// The line of a posture.
pub(super) fn record(
    index: usize,
    candidate: &Candidate,
    written: &Written,
    robot: Option<&SerialChain>,
) -> PostureRecord {
    let values = &candidate.joints;
    let state = match (robot, values.as_slice()) {
        (None, &[x, y, z, qx, qy, qz, qw]) => PostureState::FlangePose(Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz)),
        )),
        _ => PostureState::Joints(values.clone()),
    };
    PostureRecord {
        posture: Posture::new(index as u64, state).at(Some(candidate.color.stamp as f64 * 1e-9)),
        color: written.color.get(&candidate.color.place).cloned().unwrap_or_default(),
        depth: candidate.depth.and_then(|image| written.depth.get(&image.place).cloned()),
    }
}
