//! Everything that is read of a recording.

use skclam_recordings::{
    CameraInfo, ColorPixels, CompressedImage, DepthPixels, Float32, Image, JointState, MessageKind, Recording,
    TransformMessage, Wanted, parse_tf_message, survey,
};
use std::path::Path;

/// Messages that could be decoded.
pub fn read_all(path: &Path) -> Result<usize, String> {
    let wrong = |error: skclam_recordings::RecordingError| error.to_string();
    let mut recording = Recording::open(path).map_err(wrong)?;
    let mut places = Vec::new();
    let scanned = recording.scan(false, &mut |_, _| Wanted::Beginning(64), &mut |topic, message| {
        let _ = message.stamp(topic);
        places.push(message.place);
        Ok(())
    });
    let mut decoded = 0;
    let read = recording.read(&places, &mut |topic, message| {
        let name = &topic.name;
        let Some(wire) = topic.wire else {
            decoded += usize::from(match topic.kind {
                MessageKind::PoseLine => std::str::from_utf8(message.data).is_ok(),
                _ => {
                    DepthPixels::from_file(name, message.data).is_ok()
                        || ColorPixels::from_file(name, message.data).is_ok()
                }
            });
            return Ok(());
        };
        let fine = match topic.kind {
            MessageKind::Image => match Image::parse(name, wire, message.data) {
                Ok(image) => {
                    ColorPixels::from_image(name, &image).is_ok() || DepthPixels::from_image(name, &image).is_ok()
                }
                Err(_) => false,
            },
            MessageKind::CompressedImage => match CompressedImage::parse(name, wire, message.data) {
                Ok(image) => {
                    DepthPixels::from_compressed(name, &image).is_ok()
                        || ColorPixels::from_compressed(name, &image).is_ok()
                }
                Err(_) => false,
            },
            MessageKind::JointState => JointState::parse(name, wire, message.data).is_ok(),
            MessageKind::CameraInfo => CameraInfo::parse(name, wire, message.data).is_ok(),
            MessageKind::Transforms => parse_tf_message(name, wire, message.data).is_ok(),
            MessageKind::Transform => TransformMessage::parse(name, wire, message.data).is_ok(),
            MessageKind::Float32 => Float32::parse(name, wire, message.data).is_ok(),
            _ => false,
        };
        decoded += usize::from(fine);
        Ok(())
    });
    let surveyed = Recording::open(path).and_then(|mut recording| survey(&mut recording).map(drop));
    scanned.and(read).and(surveyed).map_err(wrong)?;
    Ok(decoded)
}
