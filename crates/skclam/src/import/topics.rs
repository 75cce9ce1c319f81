//! Which topics are the colour images and the depth images.

use super::images::{ImageKind, Images};
use super::{DepthChoice, ImportError, ImportOptions};
use skclam_recordings::{MessageKind, Recording, RecordingError, Topic};
use std::collections::BTreeMap;

/// Topics by their positions in the recording.
#[derive(Debug, Clone, Copy)]
pub(super) struct Chosen {
    pub color: usize,
    pub depth: Option<usize>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Content {
    Color,
    Grey,
    Depth,
    Unread,
}

fn content(topic: &Topic, kind: &ImageKind) -> Content {
    let encoding = kind.encoding.as_str();
    match topic.kind {
        MessageKind::ImageFile if topic.name == "depth" => Content::Depth,
        MessageKind::ImageFile => Content::Color,
        MessageKind::CompressedImage if encoding.contains("compressedDepth") => Content::Depth,
        MessageKind::CompressedImage => match encoding.split(';').next().unwrap_or_default().trim() {
            "16UC1" | "mono16" | "32FC1" => Content::Depth,
            "mono8" | "8UC1" => Content::Grey,
            _ => Content::Color,
        },
        _ => match encoding {
            "16UC1" | "mono16" | "32FC1" => Content::Depth,
            "mono8" | "8UC1" => Content::Grey,
            "rgb8" | "bgr8" | "rgba8" | "bgra8" | "8UC3" | "8UC4" => Content::Color,
            _ => Content::Unread,
        },
    }
}

/// Frames of a RealSense camera without size, encoding or stamp: they are text on other topics.
const REALSENSE_RAW: &str = "librealsense/raw_frame";

/// Chooses the image topics: named ones, else the only ones of their content. A raw topic comes before its compressed
/// copy, colour before grey.
pub(super) fn choose(
    recording: &Recording,
    images: &Images,
    options: &ImportOptions,
    warnings: &mut Vec<String>,
) -> Result<Chosen, ImportError> {
    let kinds: &BTreeMap<usize, &ImageKind> = &images.topics.iter().map(|(id, topic)| (*id, topic.kind())).collect();
    let topics = recording.topics();
    let named = |wanted: &'static str, name: &str| {
        let found = kinds.keys().find(|&&topic| topics[topic].name == name).copied();
        found.ok_or_else(|| RecordingError::Topic {
            wanted,
            problem: format!(
                "there is no image on {name}; images are on {}",
                list(kinds.keys().map(|&id| &topics[id]))
            ),
        })
    };
    let of_content = |content_wanted: Content| -> Vec<usize> {
        let all: Vec<usize> = kinds
            .iter()
            .filter(|(id, kind)| content(&topics[**id], kind) == content_wanted)
            .map(|(id, _)| *id)
            .collect();
        let is_copy = |id: &usize| {
            let name = &topics[*id].name;
            let base = name.strip_suffix("/compressed").or_else(|| name.strip_suffix("/compressedDepth"));
            base.is_some_and(|base| all.iter().any(|&other| topics[other].name == base))
        };
        all.iter().filter(|id| !is_copy(id)).copied().collect()
    };
    let color = match &options.color_topic {
        Some(name) => named("colour images", name)?,
        None => {
            let colors = of_content(Content::Color);
            let candidates = if colors.is_empty() { of_content(Content::Grey) } else { colors };
            only("colour images", "--color-topic", &candidates, kinds, topics)?.ok_or_else(|| {
                let unread: Vec<String> = kinds
                    .iter()
                    .filter(|(id, kind)| content(&topics[**id], kind) == Content::Unread)
                    .map(|(id, kind)| format!("{} ({})", topics[*id].name, kind.encoding))
                    .collect();
                let raw = topics.iter().find(|topic| topic.type_name == REALSENSE_RAW);
                let problem = match unread.is_empty() {
                    true if raw.is_some() => format!(
                        "the frames on {} are bare bytes ({REALSENSE_RAW}), as librealsense wrote into its first .db3 files; \
                         record as .bag with the RealSense Viewer, or the camera's ROS topics with `ros2 bag record`",
                        raw.map_or("", |topic| topic.name.as_str())
                    ),
                    true => format!("there are none; the topics are {}", list(topics)),
                    false => format!("there are none that can be read, but {}", unread.join(", ")),
                };
                RecordingError::Topic { wanted: "colour images", problem }
            })?
        }
    };
    let depth = match &options.depth {
        DepthChoice::None => None,
        DepthChoice::Topic(name) => Some(named("depth images", name)?),
        DepthChoice::Automatic => only("depth images", "--depth-topic", &of_content(Content::Depth), kinds, topics)?,
    };
    if depth.is_none() && options.depth == DepthChoice::Automatic {
        warnings.push("there are no depth images: no map can be made, and scale comes from the arm alone".to_owned());
    }
    Ok(Chosen { color, depth })
}

fn only(
    wanted: &'static str,
    option: &str,
    candidates: &[usize],
    kinds: &BTreeMap<usize, &ImageKind>,
    topics: &[Topic],
) -> Result<Option<usize>, RecordingError> {
    match candidates {
        [] => Ok(None),
        [one] => Ok(Some(*one)),
        several => {
            let named: Vec<String> =
                several.iter().map(|id| format!("{} ({})", topics[*id].name, kinds[id].encoding)).collect();
            let problem = format!("{} topics have them: {}; choose one with {option}", several.len(), named.join(", "));
            Err(RecordingError::Topic { wanted, problem })
        }
    }
}

pub(super) fn list<'a>(topics: impl IntoIterator<Item = &'a Topic>) -> String {
    const SHOWN: usize = 40;
    let mut names: Vec<&str> = topics.into_iter().map(|topic| topic.name.as_str()).collect();
    let more = names.len().saturating_sub(SHOWN);
    names.truncate(SHOWN);
    let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    if more > 0 { format!("{names} and {more} more") } else { names }
}
