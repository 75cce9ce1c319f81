//! Small recordings of every kind, written by hand.

use rand::RngExt;
use skclam_damage::{ChaCha8Rng, Seed, damaged_bytes};
use std::io::Write;

fn text(text: &str, terminated: bool) -> Vec<u8> {
    let end: &[u8] = if terminated { &[0] } else { &[] };
    let mut bytes = ((text.len() + end.len()) as u32).to_le_bytes().to_vec();
    bytes.extend(text.as_bytes());
    bytes.extend(end);
    bytes
}

/// Topic, type, bytes.
pub type Message = (&'static str, &'static str, Vec<u8>);

/// Messages of every kind. `cdr`: with its header and alignment.
pub fn messages(cdr: bool) -> Vec<Message> {
    let begin = || if cdr { vec![0u8, 1, 0, 0] } else { vec![] };
    let align = |bytes: &mut Vec<u8>, to: usize| {
        while cdr && !(bytes.len() - 4).is_multiple_of(to) {
            bytes.push(0);
        }
    };
    let header = |frame: &str| {
        let mut bytes = begin();
        if !cdr {
            bytes.extend([0; 4]);
        }
        bytes.extend(7u32.to_le_bytes());
        bytes.extend(9u32.to_le_bytes());
        bytes.extend(text(frame, cdr));
        bytes
    };
    let number = |bytes: &mut Vec<u8>, value: u32| {
        align(bytes, 4);
        bytes.extend(value.to_le_bytes());
    };
    let string = |bytes: &mut Vec<u8>, value: &str| {
        align(bytes, 4);
        bytes.extend(text(value, cdr));
    };
    let floats = |bytes: &mut Vec<u8>, values: &[f64]| {
        align(bytes, 8);
        values.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    };
    let image = |encoding: &str, step: u32, data: &[u8]| {
        let mut bytes = header("cam");
        number(&mut bytes, 2);
        number(&mut bytes, 4);
        string(&mut bytes, encoding);
        bytes.push(0);
        number(&mut bytes, step);
        number(&mut bytes, data.len() as u32);
        bytes.extend(data);
        bytes
    };
    let mut png = Vec::new();
    let gray = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(4, 2, vec![500u16; 8]).unwrap();
    gray.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).unwrap();
    let mut depth_png = vec![0; 12];
    depth_png.extend(&png);
    let mut jpeg = Vec::new();
    let rgb = image::RgbImage::from_pixel(8, 8, image::Rgb([9, 8, 7]));
    rgb.write_to(&mut std::io::Cursor::new(&mut jpeg), image::ImageFormat::Jpeg).unwrap();
    let compressed = |format: &str, data: &[u8]| {
        let mut bytes = header("cam");
        string(&mut bytes, format);
        number(&mut bytes, data.len() as u32);
        bytes.extend(data);
        bytes
    };
    let mut joints = header("");
    number(&mut joints, 2);
    string(&mut joints, "joint_1");
    string(&mut joints, "joint_2");
    number(&mut joints, 2);
    floats(&mut joints, &[0.5, -0.25]);
    number(&mut joints, 0);
    number(&mut joints, 0);
    let mut info = header("cam");
    number(&mut info, 2);
    number(&mut info, 4);
    string(&mut info, "plumb_bob");
    number(&mut info, 5);
    floats(&mut info, &[0.1; 26 + 9]);
    let mut transforms = begin();
    number(&mut transforms, 1);
    transforms.extend(&header("a")[begin().len()..]);
    string(&mut transforms, "b");
    floats(&mut transforms, &[0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]);
    let mut extrinsics = begin();
    floats(&mut extrinsics, &[0.015, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    let mut unit = begin();
    unit.extend(0.001f32.to_le_bytes());
    vec![
        ("/joints", "sensor_msgs/msg/JointState", joints),
        ("/color", "sensor_msgs/msg/Image", image("rgb8", 12, &[3; 24])),
        ("/depth", "sensor_msgs/msg/Image", image("16UC1", 8, &[3; 16])),
        ("/float", "sensor_msgs/msg/Image", image("32FC1", 16, &[3; 32])),
        ("/jpeg", "sensor_msgs/msg/CompressedImage", compressed("rgb8; jpeg compressed bgr8", &jpeg)),
        ("/zdepth", "sensor_msgs/msg/CompressedImage", compressed("16UC1; compressedDepth png", &depth_png)),
        ("/zfloat", "sensor_msgs/msg/CompressedImage", compressed("32FC1; compressedDepth png", &depth_png)),
        ("/info", "sensor_msgs/msg/CameraInfo", info),
        ("/tf_static", "tf2_msgs/msg/TFMessage", transforms),
        ("/device_0/sensor_1/Color_0/tf/0", "geometry_msgs/msg/Transform", extrinsics),
        ("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", unit),
    ]
}

fn compress(kind: &str, data: &[u8]) -> Vec<u8> {
    match kind {
        "lz4" => {
            let mut encoder = lz4_flex::frame::FrameEncoder::new(Vec::new());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        "zstd" => zstd::stream::encode_all(data, 1).unwrap(),
        "bz2" => {
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        _ => data.to_vec(),
    }
}

/// A bag of one chunk; `damage` is done to the chunk before it is compressed.
pub fn bag(compression: &str, messages: &[Message], damage: impl FnOnce(Vec<u8>) -> Vec<u8>) -> Vec<u8> {
    fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
        let mut header = Vec::new();
        for (name, value) in fields {
            header.extend(((name.len() + 1 + value.len()) as u32).to_le_bytes());
            header.extend(name.as_bytes());
            header.push(b'=');
            header.extend(*value);
        }
        let mut bytes = (header.len() as u32).to_le_bytes().to_vec();
        bytes.extend(header);
        bytes.extend((data.len() as u32).to_le_bytes());
        bytes.extend(data);
        bytes
    }
    let mut chunk = Vec::new();
    for (index, (topic, kind, data)) in messages.iter().enumerate() {
        let id = (index as u32).to_le_bytes();
        let kind = kind.replace("/msg/", "/");
        let description = record(&[("type", kind.as_bytes())], &[]);
        let description = &description[4..description.len() - 4];
        chunk.extend(record(&[("op", &[7]), ("conn", &id), ("topic", topic.as_bytes())], description));
        chunk.extend(record(&[("op", &[2]), ("conn", &id), ("time", &[1, 0, 0, 0, 2, 0, 0, 0])], data));
    }
    let chunk = damage(chunk);
    let mut bytes = b"#ROSBAG V2.0\n".to_vec();
    bytes.extend(record(&[("op", &[3]), ("index_pos", &[0; 8])], &[b' '; 20]));
    let size = (chunk.len() as u32).to_le_bytes();
    let fields: [(&str, &[u8]); 3] = [("op", &[5]), ("compression", compression.as_bytes()), ("size", &size)];
    bytes.extend(record(&fields, &compress(compression, &chunk)));
    bytes
}

/// An MCAP file, of one chunk if there is a compression (which may be ""); `damage` is done to the records before they
/// are compressed, and the checksum is right.
pub fn mcap(compression: Option<&str>, messages: &[Message], damage: impl FnOnce(Vec<u8>) -> Vec<u8>) -> Vec<u8> {
    const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, 0x0d, 0x0a];
    fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
        let mut bytes = vec![opcode];
        bytes.extend((body.len() as u64).to_le_bytes());
        bytes.extend(body);
        bytes
    }
    let mut records = Vec::new();
    for (index, (topic, kind, data)) in messages.iter().enumerate() {
        let id = (index as u16 + 1).to_le_bytes();
        let schema = [&id[..], &text(kind, false), &text("ros2msg", false), &text("", false)].concat();
        let channel = [&id[..], &id, &text(topic, false), &text("cdr", false), &[0; 4]].concat();
        let message = [&id[..], &[0; 4], &5u64.to_le_bytes(), &5u64.to_le_bytes(), data].concat();
        records.extend([record(3, &schema), record(4, &channel), record(5, &message)].concat());
    }
    records = damage(records);
    if let Some(compression) = compression {
        let stored = compress(compression, &records);
        let body = [
            &[0; 16][..],
            &(records.len() as u64).to_le_bytes(),
            &crc32fast::hash(&records).to_le_bytes(),
            &text(compression, false),
            &(stored.len() as u64).to_le_bytes(),
            &stored,
        ]
        .concat();
        records = record(6, &body);
    }
    [&MAGIC[..], &record(1, &[0; 8]), &records, &record(15, &[0; 4]), &record(2, &[0; 20]), &MAGIC].concat()
}

fn database() -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("seed.db3");
    let connection = rusqlite::Connection::open(&path).unwrap();
    connection
        .execute_batch(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
             CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);
             CREATE INDEX timestamp_idx ON messages (timestamp ASC);",
        )
        .unwrap();
    for (index, (topic, kind, data)) in messages(true).into_iter().enumerate() {
        let id = index as i64 + 1;
        connection.execute("INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')", (id, topic, kind)).unwrap();
        let data = if index == 1 { compress("zstd", &data) } else { data };
        connection.execute("INSERT INTO messages VALUES (?1, ?1, ?1, ?2)", (id, data)).unwrap();
    }
    connection.close().unwrap();
    std::fs::read(path).unwrap()
}

/// How the chunks of bags are compressed.
const BAGS: [&str; 3] = ["none", "lz4", "bz2"];

/// The same of MCAP files; `None`: without chunks.
const MCAP_FILES: [Option<&str>; 4] = [None, Some(""), Some("lz4"), Some("zstd")];

/// Bags, a chunk each.
pub fn bags() -> Vec<Seed> {
    let messages = messages(false);
    BAGS.map(|kind| Seed::new(format!("{kind}.bag"), bag(kind, &messages, |chunk| chunk))).to_vec()
}

/// MCAP files with and without chunks.
pub fn mcap_files() -> Vec<Seed> {
    let messages = messages(true);
    let name = |kind: Option<&str>| kind.map_or("plain.mcap".to_owned(), |kind| format!("chunk_{kind}.mcap"));
    MCAP_FILES.map(|kind| Seed::new(name(kind), mcap(kind, &messages, |records| records))).to_vec()
}

/// Databases of rosbag2.
pub fn databases() -> Vec<Seed> {
    vec![Seed::new("seed.db3", database())]
}

/// A seed damaged as it lies on the disk, inside its compression, or in one of its messages.
fn damaged(
    seed: &Seed,
    messages: &[Message],
    random: &mut ChaCha8Rng,
    write: impl FnOnce(&[Message], &mut dyn FnMut(Vec<u8>) -> Vec<u8>) -> Vec<u8>,
) -> Vec<u8> {
    match random.random_range(0..4u32) {
        0 | 1 => damaged_bytes(&seed.bytes, random),
        2 => write(messages, &mut |inside| damaged_bytes(&inside, random)),
        _ => {
            let mut messages = messages.to_vec();
            let one = random.random_range(0..messages.len());
            messages[one].2 = damaged_bytes(&messages[one].2, random);
            write(&messages, &mut |inside| inside)
        }
    }
}

/// The bag `seeds[at]` with damage.
pub fn damaged_bag(seeds: &[Seed], at: usize, messages: &[Message], random: &mut ChaCha8Rng) -> Vec<u8> {
    damaged(&seeds[at], messages, random, |messages, damage| bag(BAGS[at], messages, damage))
}

/// The MCAP file `seeds[at]` with damage.
pub fn damaged_mcap(seeds: &[Seed], at: usize, messages: &[Message], random: &mut ChaCha8Rng) -> Vec<u8> {
    damaged(&seeds[at], messages, random, |messages, damage| mcap(MCAP_FILES[at], messages, damage))
}
