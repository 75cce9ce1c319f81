//! A recording of a robot, message by message, to be spoilt as drivers spoil theirs; and what must come of it.

use skclam::dataset::Dataset;
use skclam::import::{ImportOptions, ImportSummary, import_recording};
use skclam::output::{Contents, StagedFolder};
use skclam::progress::Silent;
use skclam::recordings::Recording;
use skclam::rig::{PostureState, Rig, builtin_rig};
use std::collections::BTreeMap;
use std::path::Path;

pub const ARM: [&str; 6] = ["S", "L", "U", "R", "B", "T"];
pub const JOINTS: &str = "sensor_msgs/msg/JointState";
pub const IMAGE: &str = "sensor_msgs/msg/Image";
pub const INFO: &str = "sensor_msgs/msg/CameraInfo";
pub const TF: &str = "tf2_msgs/msg/TFMessage";
pub const INTERVALS: usize = 5;

/// What a message says.
#[derive(Debug, Clone)]
pub enum Content {
    Joints { names: Vec<String>, positions: Vec<f64> },
    Image { frame: String, encoding: &'static str, size: (u32, u32) },
    Info(Box<Info>),
    Tf { parent: String, child: String, pose: [f64; 7] },
    Bytes(Vec<u8>),
}

#[derive(Debug, Clone)]
pub struct Info {
    pub frame: String,
    pub size: (u32, u32),
    pub model: &'static str,
    pub d: Vec<f64>,
    pub k: [f64; 9],
    pub r: [f64; 9],
    pub p: [f64; 12],
}

#[derive(Debug, Clone)]
pub struct Message {
    pub topic: String,
    pub kind: &'static str,
    /// Header and recorder, nanoseconds.
    pub stamp: i64,
    pub log: i64,
    pub content: Content,
}

/// The values of the arm at a time: rests of 2 s, drives of 1 s.
pub fn arm_at(seconds: f64) -> Vec<f64> {
    let rest = (seconds / 3.0).floor().clamp(0.0, (INTERVALS - 1) as f64);
    let fraction = (seconds - 3.0 * rest - 2.0).clamp(0.0, 1.0);
    let fraction = if rest as usize == INTERVALS - 1 { 0.0 } else { fraction };
    (0..6).map(|joint| 0.2 + 0.1 * joint as f64 + 0.15 * (rest + fraction) * (1.0 + 0.1 * joint as f64)).collect()
}

pub const COLOR_FRAME: &str = "camera_color_optical_frame";
pub const DEPTH_FRAME: &str = "camera_depth_optical_frame";
const START: i64 = 1_000_000_000_000;

pub fn ns(seconds: f64) -> i64 {
    START + (seconds * 1e9).round() as i64
}

pub fn info(frame: &str, (width, height): (u32, u32)) -> Info {
    let (fx, cx, cy) = (1.2 * f64::from(width), 0.5 * f64::from(width) - 0.5, 0.5 * f64::from(height) - 0.5);
    Info {
        frame: frame.to_owned(),
        size: (width, height),
        model: "plumb_bob",
        d: vec![0.0; 5],
        k: [fx, 0.0, cx, 0.0, fx, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fx, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

pub fn joints(seconds: f64, names: &[&str], positions: Vec<f64>) -> Message {
    Message {
        topic: "/joint_states".to_owned(),
        kind: JOINTS,
        stamp: ns(seconds),
        log: ns(seconds) + 3_000_000,
        content: Content::Joints { names: names.iter().map(|&name| name.to_owned()).collect(), positions },
    }
}

/// A good recording: joints at `rate` Hz, ten images of each camera a second, their CameraInfo, the transform between.
pub fn good(rate: f64) -> Vec<Message> {
    let end = 3.0 * INTERVALS as f64 - 1.0;
    let message = |topic: &str, kind, seconds: f64, lag: i64, content| Message {
        topic: topic.to_owned(),
        kind,
        stamp: ns(seconds),
        log: ns(seconds) + lag,
        content,
    };
    let pose = [0.015, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let tf = Content::Tf { parent: COLOR_FRAME.to_owned(), child: DEPTH_FRAME.to_owned(), pose };
    let mut all = vec![message("/tf_static", TF, 0.0, 0, tf)];
    for step in 0..(end * rate) as usize {
        let seconds = step as f64 / rate;
        all.push(joints(seconds, &ARM, arm_at(seconds)));
    }
    for step in 0..(end * 10.0) as usize {
        let seconds = 0.1 * step as f64 + 0.013;
        let cameras = [
            ("color", "image_raw", COLOR_FRAME, "rgb8", (16, 12)),
            ("depth", "image_rect_raw", DEPTH_FRAME, "16UC1", (8, 6)),
        ];
        for (camera, image, frame, encoding, size) in cameras {
            let content = Content::Image { frame: frame.to_owned(), encoding, size };
            all.push(message(&format!("/camera/{camera}/{image}"), IMAGE, seconds, 3_000_000, content));
            let content = Content::Info(Box::new(info(frame, size)));
            all.push(message(&format!("/camera/{camera}/camera_info"), INFO, seconds, 3_000_000, content));
        }
    }
    all
}

struct Cdr(Vec<u8>);

impl Cdr {
    fn align(&mut self, size: usize) {
        while !(self.0.len() - 4).is_multiple_of(size) {
            self.0.push(0);
        }
    }
    fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }
    fn f64(&mut self, value: f64) {
        self.align(8);
        self.0.extend(value.to_le_bytes());
    }
    fn f64s(&mut self, values: &[f64]) {
        self.u32(values.len() as u32);
        values.iter().for_each(|&value| self.f64(value));
    }
    fn string(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.0.extend(text.as_bytes());
        self.0.push(0);
    }
    fn header(&mut self, stamp: i64, frame: &str) {
        self.u32((stamp.div_euclid(1_000_000_000)) as u32);
        self.u32((stamp.rem_euclid(1_000_000_000)) as u32);
        self.string(frame);
    }
}

pub fn bytes_of(message: &Message) -> Vec<u8> {
    let mut cdr = Cdr(vec![0, 1, 0, 0]);
    match &message.content {
        Content::Bytes(bytes) => return bytes.clone(),
        Content::Joints { names, positions } => {
            cdr.header(message.stamp, "base");
            cdr.u32(names.len() as u32);
            names.iter().for_each(|name| cdr.string(name));
            cdr.f64s(positions);
            cdr.f64s(&[]);
            cdr.f64s(&[]);
        }
        Content::Image { frame, encoding, size: (width, height) } => {
            cdr.header(message.stamp, frame);
            cdr.u32(*height);
            cdr.u32(*width);
            cdr.string(encoding);
            cdr.0.push(0);
            let step = width * if *encoding == "rgb8" { 3 } else { 2 };
            cdr.u32(step);
            cdr.u32(step * height);
            // Every image is another; all depths are possible.
            let seed = (message.stamp / 1_000_000) as u32;
            cdr.0.extend((0..step * height).map(|at| (at.wrapping_mul(seed | 1) >> 3) as u8 | 1));
        }
        Content::Info(info) => {
            cdr.header(message.stamp, &info.frame);
            cdr.u32(info.size.1);
            cdr.u32(info.size.0);
            cdr.string(info.model);
            cdr.f64s(&info.d);
            info.k.iter().chain(&info.r).chain(&info.p).for_each(|&value| cdr.f64(value));
            (0..6).for_each(|_| cdr.u32(0));
            cdr.0.push(0);
        }
        Content::Tf { parent, child, pose } => {
            cdr.u32(1);
            cdr.header(message.stamp, parent);
            cdr.string(child);
            pose.iter().for_each(|&value| cdr.f64(value));
        }
    }
    cdr.0
}

/// The messages as an MCAP, in the order of their times of recording, in small chunks.
pub fn mcap_of(messages: &[Message]) -> Vec<u8> {
    let mut file = std::io::Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().compression(None).chunk_size(Some(20_000));
    let mut writer = options.create(&mut file).unwrap();
    let mut channels: BTreeMap<&str, u16> = BTreeMap::new();
    let mut order: Vec<&Message> = messages.iter().collect();
    order.sort_by_key(|message| message.log);
    for (sequence, message) in order.into_iter().enumerate() {
        let channel_id = *channels.entry(&message.topic).or_insert_with(|| {
            let schema = writer.add_schema(message.kind, "ros2msg", b"").unwrap();
            writer.add_channel(schema, &message.topic, "cdr", &BTreeMap::new()).unwrap()
        });
        let time = message.log as u64;
        let header =
            mcap::records::MessageHeader { channel_id, sequence: sequence as u32, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, &bytes_of(message)).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    file.into_inner()
}

/// An arm whose cameras nobody described.
pub fn builtin() -> ImportOptions {
    ImportOptions { builtin_rig: true, ..ImportOptions::default() }
}

pub fn hp3j() -> Rig {
    builtin_rig("hp3j").unwrap().unwrap()
}

/// Imports what lies at `path`; an error as it is printed.
pub fn import_file(path: &Path, rig: &Rig, options: &ImportOptions) -> Result<(ImportSummary, Dataset), String> {
    let out = tempfile::tempdir().unwrap();
    let staged = StagedFolder::new(out.path().join("cell"), Contents::DataSet).unwrap();
    let mut recording = Recording::open(path).map_err(|error| error.to_string())?;
    let summary =
        import_recording(&mut recording, rig, None, options, &staged, &Silent).map_err(|error| error.to_string())?;
    staged.publish().unwrap();
    let dataset = Dataset::open(out.path().join("cell")).unwrap();
    // Images are read while the folder is there.
    (0..dataset.len()).for_each(|index| drop(dataset.gray(index).unwrap()));
    Ok((summary, dataset))
}

pub fn import_with(messages: &[Message], options: &ImportOptions) -> Result<(ImportSummary, Dataset), String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    std::fs::write(&path, mcap_of(messages)).unwrap();
    import_file(&path, &hp3j(), options)
}

/// The largest distance of the imported joints from where the arm truly was, radians.
pub fn error_of(dataset: &Dataset) -> f64 {
    let mut most: f64 = 0.0;
    for record in &dataset.records {
        let PostureState::Joints(values) = &record.posture.state else { panic!("joints expected") };
        let seconds = record.posture.timestamp_s.unwrap() - START as f64 * 1e-9;
        most = arm_at(seconds).iter().zip(values).map(|(a, b)| (a - b).abs()).fold(most, f64::max);
    }
    most
}

/// Asks that an import gives every stationary interval, at the right joints, and warns with these words.
pub fn right(name: &str, messages: &[Message], options: &ImportOptions, words: &[&str]) -> Dataset {
    let (summary, dataset) = import_with(messages, options).unwrap_or_else(|error| panic!("{name}: {error}"));
    assert_eq!(dataset.len(), INTERVALS, "{name}: {:?}", summary.warnings);
    let off = error_of(&dataset);
    assert!(off < 1e-3, "{name}: joints are off by {off}");
    let warnings = summary.warnings.join("\n");
    for word in words {
        assert!(warnings.contains(word), "{name}: \"{word}\" is not in the warnings:\n{warnings}");
    }
    if words.is_empty() {
        assert!(warnings.is_empty(), "{name}: {warnings}");
    }
    dataset
}

/// Asks that an import fails and says why.
pub fn refused(name: &str, messages: &[Message], options: &ImportOptions, words: &[&str]) -> String {
    let error = match import_with(messages, options) {
        Ok((summary, dataset)) => panic!("{name}: {} postures, {:?}", dataset.len(), summary.warnings),
        Err(error) => error,
    };
    for word in words {
        assert!(error.contains(word), "{name}: \"{word}\" is not in: {error}");
    }
    error
}
