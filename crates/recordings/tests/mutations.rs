//! Recordings with flipped, cut, repeated and inflated bytes: whatever comes, an answer or an error, in bounded time and
//! memory.
//!
//! `SKCLAM_FUZZ=1000000 cargo test -p skclam-recordings --release --test mutations` tries as many of each kind;
//! `SKCLAM_FUZZ_SEED` begins elsewhere. What once failed is kept in `findings`.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use skclam_recordings::{
    CameraInfo, ColorPixels, CompressedImage, DepthPixels, Image, JointState, MessageKind, Recording, Wanted,
    parse_tf_message, survey,
};
use std::io::Write;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

fn count() -> u64 {
    std::env::var("SKCLAM_FUZZ").ok().and_then(|count| count.parse().ok()).unwrap_or(300)
}

/// No input of some kilobytes may take longer.
const MOST_TIME: Duration = Duration::from_secs(5);
/// After so long an input is taken to hang: the watchdog keeps it and ends the process.
const HANGS: Duration = Duration::from_secs(10);
/// The largest resident set of the test process, MiB: two messages, a decompressor's window, the harness.
const MOST_MEMORY_MIB: f64 = 400.0;

// ----- small recordings, written by hand

fn text(text: &str, terminated: bool) -> Vec<u8> {
    let end: &[u8] = if terminated { &[0] } else { &[] };
    let mut bytes = ((text.len() + end.len()) as u32).to_le_bytes().to_vec();
    bytes.extend(text.as_bytes());
    bytes.extend(end);
    bytes
}

/// Messages of every kind: topic, type, bytes. `cdr`: with its header and alignment.
fn messages(cdr: bool) -> Vec<(&'static str, &'static str, Vec<u8>)> {
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

fn bag(compression: &str) -> Vec<u8> {
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
    for (index, (topic, kind, data)) in messages(false).into_iter().enumerate() {
        let id = (index as u32).to_le_bytes();
        let kind = kind.replace("/msg/", "/");
        let description = record(&[("type", kind.as_bytes())], &[]);
        let description = &description[4..description.len() - 4];
        chunk.extend(record(&[("op", &[7]), ("conn", &id), ("topic", topic.as_bytes())], description));
        chunk.extend(record(&[("op", &[2]), ("conn", &id), ("time", &[1, 0, 0, 0, 2, 0, 0, 0])], &data));
    }
    let mut bytes = b"#ROSBAG V2.0\n".to_vec();
    bytes.extend(record(&[("op", &[3]), ("index_pos", &[0; 8])], &[b' '; 20]));
    let size = (chunk.len() as u32).to_le_bytes();
    let fields: [(&str, &[u8]); 3] = [("op", &[5]), ("compression", compression.as_bytes()), ("size", &size)];
    bytes.extend(record(&fields, &compress(compression, &chunk)));
    bytes
}

fn mcap(compression: &str, chunked: bool) -> Vec<u8> {
    const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, 0x0d, 0x0a];
    fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
        let mut bytes = vec![opcode];
        bytes.extend((body.len() as u64).to_le_bytes());
        bytes.extend(body);
        bytes
    }
    let mut records = Vec::new();
    for (index, (topic, kind, data)) in messages(true).into_iter().enumerate() {
        let id = (index as u16 + 1).to_le_bytes();
        let schema = [&id[..], &text(kind, false), &text("ros2msg", false), &text("", false)].concat();
        let channel = [&id[..], &id, &text(topic, false), &text("cdr", false), &[0; 4]].concat();
        let message = [&id[..], &[0; 4], &5u64.to_le_bytes(), &5u64.to_le_bytes(), &data].concat();
        records.extend([record(3, &schema), record(4, &channel), record(5, &message)].concat());
    }
    if chunked {
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

// ----- everything that is read of a recording

/// Messages that could be decoded.
fn read_all(path: &Path) -> Result<usize, String> {
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
            _ => false,
        };
        decoded += usize::from(fine);
        Ok(())
    });
    let surveyed = Recording::open(path).and_then(|mut recording| survey(&mut recording).map(drop));
    scanned.and(read).and(surveyed).map_err(wrong)?;
    Ok(decoded)
}

fn mutate(seed: &[u8], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..random.random_range(1..6u32) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        match random.random_range(0..7u32) {
            0 => bytes[at] ^= 1 << random.random_range(0..8u32),
            1 => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => {
                let end = (at + random.random_range(1..64usize)).min(bytes.len());
                bytes.drain(at..end);
            }
            4 => {
                let end = (at + random.random_range(1..64usize)).min(bytes.len());
                let copy = bytes[at..end].to_vec();
                bytes.splice(at..at, copy);
            }
            // Lengths: the numbers that a careless reader allocates.
            5 => {
                let value: u32 = [u32::MAX, i32::MAX as u32, 1 << 30, 0, 1, 1 << 24][random.random_range(0..6usize)];
                let end = (at + 4).min(bytes.len());
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            _ => {
                let end = (at + 8).min(bytes.len());
                let value = random.next_u64() >> random.random_range(0..64u32);
                bytes[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
        }
    }
    bytes
}

fn seeds() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("none.bag", bag("none")),
        ("lz4.bag", bag("lz4")),
        ("bz2.bag", bag("bz2")),
        ("plain.mcap", mcap("", false)),
        ("none.mcap", mcap("", true)),
        ("lz4.mcap", mcap("lz4", true)),
        ("zstd.mcap", mcap("zstd", true)),
        ("seed.db3", database()),
        ("folder.tum", tum()),
    ]
}

/// A folder in TUM's layout as one text: its lists, and an image by its bytes in hex, so that all of it can be damaged.
fn tum() -> Vec<u8> {
    let mut png = Vec::new();
    let gray = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(4, 2, vec![500u16; 8]).unwrap();
    gray.write_to(&mut std::io::Cursor::new(&mut png), image::ImageFormat::Png).unwrap();
    let list = |name: &str| format!("# time file\n1.000000 {name}.png\n1.500000 {name}.png\n");
    let poses = "# tx ty tz qx qy qz qw\n0.9 0 0 0.1 0 0 0 1\n1.6 0 0 0.2 0 0 0 1\n";
    let mut bytes = Vec::new();
    for part in [list("rgb").as_bytes(), list("depth").as_bytes(), poses.as_bytes(), &png] {
        bytes.extend(part);
        bytes.extend(TUM_CUT);
    }
    bytes
}

/// Stands between the files of a [`tum`] folder.
const TUM_CUT: &[u8] = b"\n--8<--\n";

/// Writes the files of a [`tum`] folder; what lost its cut is empty.
fn write_tum(folder: &Path, bytes: &[u8]) {
    let mut rest = bytes;
    let files = [&["rgb.txt"][..], &["depth.txt"], &["groundtruth.txt"], &["rgb.png", "depth.png"]];
    for names in files {
        let end = rest.windows(TUM_CUT.len()).position(|window| window == TUM_CUT).unwrap_or(rest.len());
        let (part, after) = rest.split_at(end);
        names.iter().for_each(|name| std::fs::write(folder.join(name), part).unwrap());
        rest = after.get(TUM_CUT.len()..).unwrap_or_default();
    }
}

/// Puts a (damaged) seed where it can be opened.
fn lay_down(path: &Path, bytes: &[u8]) {
    if path.extension().is_some_and(|ending| ending == "tum") {
        std::fs::create_dir_all(path).unwrap();
        write_tum(path, bytes);
    } else {
        std::fs::write(path, bytes).unwrap();
    }
}

/// What is being read, since when.
type Watched = Arc<Mutex<Option<(Instant, String, Vec<u8>)>>>;

/// A thread that ends the process when an input hangs: a test cannot stop one that does not return.
fn watch() -> Watched {
    let watched = Watched::default();
    let seen = Arc::downgrade(&watched);
    std::thread::spawn(move || {
        while let Some(watched) = seen.upgrade() {
            if let Some((since, name, bytes)) = &*watched.lock().unwrap_or_else(PoisonError::into_inner)
                && since.elapsed() > HANGS
            {
                let kept = std::env::temp_dir().join(format!("hang-{name}"));
                let _ = std::fs::write(&kept, bytes);
                eprintln!("{name}: no answer after {HANGS:?}; the input is kept as {}", kept.display());
                std::process::abort();
            }
            drop(watched);
            std::thread::sleep(Duration::from_millis(500));
        }
    });
    watched
}

fn peak_memory_mib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<f64>().ok().map(|kib| kib / 1024.0)
}

#[test]
fn the_seeds_are_read_whole() {
    let folder = tempfile::tempdir().unwrap();
    for (name, seed) in seeds() {
        let path = folder.path().join(name);
        lay_down(&path, &seed);
        // Two images of each kind and two poses.
        let count = if name.ends_with("tum") { 6 } else { messages(true).len() };
        assert_eq!(read_all(&path), Ok(count), "{name}");
    }
}

#[test]
fn mutated_recordings_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    let begin = std::env::var("SKCLAM_FUZZ_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1u64);
    let watched = watch();
    // `SKCLAM_FUZZ_ONLY=db3` tries the seeds with that ending alone.
    let only = std::env::var("SKCLAM_FUZZ_ONLY").unwrap_or_default();
    for (name, seed) in seeds().into_iter().filter(|(name, _)| name.ends_with(&only)) {
        let path = folder.path().join(name);
        let (mut fine, mut refused) = (0u64, 0u64);
        for case in 0..count() {
            let mut random = ChaCha8Rng::seed_from_u64(begin.wrapping_mul(1 << 40).wrapping_add(case));
            let bytes = mutate(&seed, &mut random);
            lay_down(&path, &bytes);
            let start = Instant::now();
            let now = Some((start, format!("{begin}-{case}-{name}"), bytes.clone()));
            *watched.lock().unwrap_or_else(PoisonError::into_inner) = now;
            let answer = std::panic::catch_unwind(|| read_all(&path));
            *watched.lock().unwrap_or_else(PoisonError::into_inner) = None;
            let took = start.elapsed();
            let keep = || {
                let kept = std::env::temp_dir().join(format!("finding-{begin}-{case}-{name}"));
                std::fs::write(&kept, &bytes).unwrap();
                kept
            };
            match answer {
                Ok(Ok(_)) => fine += 1,
                Ok(Err(_)) => refused += 1,
                Err(_) => panic!("{name}, case {case}: a panic; the input is kept as {}", keep().display()),
            }
            assert!(took < MOST_TIME, "{name}, case {case}: {took:?}; the input is kept as {}", keep().display());
        }
        let peak = peak_memory_mib().map_or(String::new(), |peak| format!("; peak memory {peak:.0} MiB so far"));
        println!("{name}: {} inputs, {fine} read, {refused} refused{peak}", count());
        assert!(count() < 100 || (fine > 0 && refused > 0), "{name}: {fine} read, {refused} refused");
    }
    if let Some(peak) = peak_memory_mib() {
        println!("peak memory {peak:.0} MiB");
        assert!(peak < MOST_MEMORY_MIB, "peak memory {peak} MiB");
    }
}

/// Small files that claim to be large.
#[test]
fn lengths_that_lie_cost_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let message = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        read_all(&path).unwrap_err()
    };
    // A chunk that decompresses to more than it says, and one that says more than there is.
    let honest = mcap("zstd", true);
    let mut huge = honest.clone();
    let chunk = 8 + 9 + 8 + 9;
    huge[chunk + 16..chunk + 24].copy_from_slice(&(1u64 << 50).to_le_bytes());
    assert!(message("huge.mcap", &huge).contains("in the middle of a record"), "{}", message("huge.mcap", &huge));
    let mut long = honest.clone();
    long[8 + 1..8 + 9].copy_from_slice(&u64::MAX.to_le_bytes());
    assert!(message("long.mcap", &long).contains("18446744073709551615 bytes are announced"));
    let mut cut = honest;
    cut.truncate(cut.len() / 2);
    assert!(message("cut.mcap", &cut).contains("only"));
    let mut bag = bag("none");
    let at = b"#ROSBAG V2.0\n".len();
    bag[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(message("lie.bag", &bag).contains("4294967295 bytes; at most"));
    assert!(message("text.bag", b"hello").contains("no recording"));
}
