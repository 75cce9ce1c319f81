//! Rigs, tables and robot descriptions with damaged bytes and numbers: an answer or an error, no panic, in bounded time
//! and memory.
//!
//! `SKCLAM_FUZZ=1000000 cargo test -p skclam --release --test mutated_texts` tries as many of each kind;
//! `SKCLAM_FUZZ_SEED` begins elsewhere.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use skclam::compensation::{CompensationOptions, read_targets};
use skclam::dataset::read_postures;
use skclam::import::read_joint_log;
use skclam::kinematics::{SerialChain, chain_from_urdf, urdf_ends, write_urdf};
use skclam::rig::{Rig, builtin_names, builtin_rig};
use std::path::Path;
use std::time::{Duration, Instant};

fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).ok().and_then(|count| count.parse().ok()).unwrap_or(default)
}

const MOST_TIME: Duration = Duration::from_secs(5);
/// The largest resident set of the test process, MiB.
const MOST_MEMORY_MIB: f64 = 400.0;

const URDF: &str = r#"<?xml version="1.0"?>
<robot name="r"><!-- comment -->
  <link name="base"/><link name="a"><visual><origin xyz="0 0 1"/></visual></link><link name="b"/><link name="tip"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/>
    <origin xyz="0 0 0.3" rpy="0 0.1 0"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="a"/><child link="b"/>
    <origin xyz="0.2 0 0.1" rpy="1.57 0 0"/><axis xyz="0 1 0"/><limit lower="0" upper="0.5" effort="1" velocity="1"/></joint>
  <joint name="j3" type="continuous"><parent link="b"/><child link="tip"/><origin rpy="0 0 1e-3"/></joint>
</robot>
"#;

/// Damage: single bytes, cuts, repetitions, and pieces that mean something in these formats.
fn mutate(seed: &str, random: &mut ChaCha8Rng) -> Vec<u8> {
    const PIECES: [&str; 30] = [
        "nan",
        "inf",
        "-1e308",
        "1e400",
        "0",
        "-0",
        "99999999999999999999",
        "1e-320",
        "\"",
        "'",
        "<",
        ">",
        "/>",
        "<!--",
        "-->",
        "[",
        "]",
        "[[",
        "{",
        "=",
        ",",
        "\n",
        "\r\n",
        "\0",
        "#",
        "&lt;",
        "\u{feff}",
        "\u{e9}",
        "robot.joint",
        "q1_deg",
    ];
    let mut bytes = seed.as_bytes().to_vec();
    for _ in 0..random.random_range(1..5u32) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let end = (at + random.random_range(1..40usize)).min(bytes.len());
        match random.random_range(0..6u32) {
            0 => bytes[at] = random.random(),
            1 => bytes.truncate(at),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let copy = bytes[at..end].to_vec();
                for _ in 0..random.random_range(1..20u32) {
                    bytes.splice(at..at, copy.iter().copied());
                }
            }
            4 => {
                let piece = PIECES[random.random_range(0..PIECES.len())];
                bytes.splice(at..at, piece.bytes());
            }
            // A number gives way to another.
            _ => {
                if let Some(begin) = (at..bytes.len()).find(|&i| bytes[i].is_ascii_digit()) {
                    let length = bytes[begin..].iter().take_while(|b| b.is_ascii_digit() || **b == b'.').count();
                    let piece = PIECES[random.random_range(0..8usize)];
                    bytes.splice(begin..begin + length, piece.bytes());
                }
            }
        }
    }
    bytes
}

fn arm() -> SerialChain {
    builtin_rig("hp3j").unwrap().unwrap().robot.unwrap()
}

/// A rig that is read works: it moves, is written and read again.
fn rig(path: &Path) -> bool {
    let Ok(rig) = Rig::read(path) else { return false };
    if let Some(robot) = &rig.robot {
        let _ = robot.base_from_flange(&vec![0.3; robot.joint_count()]);
    }
    let text = rig.to_toml().unwrap();
    Rig::from_toml(&text, "again").unwrap();
    true
}

fn postures(path: &Path) -> bool {
    read_postures(path).is_ok()
}

fn targets(path: &Path) -> bool {
    let arm = arm();
    let Ok(table) = read_targets(path, &arm) else { return false };
    table.compensate(&arm, &arm, &CompensationOptions::default()).is_ok()
}

fn joint_log(path: &Path) -> bool {
    read_joint_log(path, &arm(), 0.25).is_ok()
}

/// A description that is read gives a chain that can be written back into it.
fn urdf(path: &Path) -> bool {
    let Ok(text) = std::fs::read_to_string(path) else { return false };
    let _ = urdf_ends(&text);
    let Ok(chain) = chain_from_urdf(&text, "base", "tip") else { return false };
    write_urdf(&text, "base", "tip", &chain, &chain).is_ok()
}

type Reader = fn(&Path) -> bool;

fn seeds() -> Vec<(String, String, Reader)> {
    const JOINTS: &str = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg";
    let mut seeds: Vec<(String, String, Reader)> = builtin_names()
        .take(4)
        .map(|name| (format!("{name}.toml"), builtin_rig(name).unwrap().unwrap().to_toml().unwrap(), rig as Reader))
        .collect();
    let table = |head: &str, rows: &[&str]| format!("{head}\n{}\n", rows.join("\n"));
    let tables: [(&str, String, Reader); 5] = [
        (
            "postures.csv",
            table(
                &format!("index,timestamp_s,{JOINTS},color,depth"),
                &["0,1.5,1,2,3,4,5,6,a.png,b.png", "7,2,1,2,3,4,5,6,c.png,"],
            ),
            postures,
        ),
        (
            "poses.csv",
            table("index,x_mm,y_mm,z_mm,qx,qy,qz,qw,color", &["0,1,2,3,0,0,0.6,0.8,a.png", "1,1,2,3,0,0,0,1,b.png"]),
            postures,
        ),
        ("targets.csv", table(&format!("name,{JOINTS}"), &["a,10,20,-30,5,40,0", "b,1,2,-30,4,50,6"]), targets),
        (
            "target_poses.csv",
            table("x_mm,y_mm,z_mm,qx,qy,qz,qw", &["300,10,300,0,1,0,0", "310,0,300,0,1,0,0"]),
            targets,
        ),
        ("joints.csv", table(&format!("timestamp_s,{JOINTS}"), &["1.5,1,2,3,4,5,6", "1.6,1,2,3,4,5,6"]), joint_log),
    ];
    seeds.extend(tables.map(|(name, text, reader)| (name.to_owned(), text, reader)));
    seeds.push(("robot.urdf".to_owned(), URDF.to_owned(), urdf));
    seeds
}

#[test]
fn mutated_texts_are_answered() {
    let folder = tempfile::tempdir().unwrap();
    let (count, begin) = (number("SKCLAM_FUZZ", 300), number("SKCLAM_FUZZ_SEED", 1));
    for (name, seed, reader) in seeds() {
        let path = folder.path().join(&name);
        std::fs::write(&path, &seed).unwrap();
        assert!(reader(&path), "{name}: the seed itself is refused");
        let (mut fine, mut refused) = (0u64, 0u64);
        for case in 0..count {
            let mut random = ChaCha8Rng::seed_from_u64(begin.wrapping_mul(1 << 40).wrapping_add(case));
            let bytes = mutate(&seed, &mut random);
            std::fs::write(&path, &bytes).unwrap();
            let start = Instant::now();
            let answer = std::panic::catch_unwind(|| reader(&path));
            let took = start.elapsed();
            let keep = || {
                let kept = std::env::temp_dir().join(format!("finding-{begin}-{case}-{name}"));
                std::fs::write(&kept, &bytes).unwrap();
                kept
            };
            match answer {
                Ok(true) => fine += 1,
                Ok(false) => refused += 1,
                Err(_) => panic!("{name}, case {case}: a panic; the input is kept as {}", keep().display()),
            }
            assert!(took < MOST_TIME, "{name}, case {case}: {took:?}; the input is kept as {}", keep().display());
        }
        println!("{name}: {count} inputs, {fine} read, {refused} refused");
        assert!(count < 100 || refused > 0, "{name}: {fine} read, {refused} refused");
    }
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak =
        status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.split_whitespace().next()?.parse::<f64>().ok());
    if let Some(peak) = peak.map(|kib| kib / 1024.0) {
        println!("peak memory {peak:.0} MiB");
        assert!(peak < MOST_MEMORY_MIB, "peak memory {peak} MiB");
    }
}

/// What the mutations have found.
#[test]
fn findings() {
    let text = builtin_rig("franka-fr3").unwrap().unwrap().to_toml().unwrap();
    let begin = text.find("unit_mm = ").unwrap();
    let end = begin + text[begin..].find('\n').unwrap();
    // 1e-320 mm is 0 m: it was read, and what was written of it was refused.
    let tiny = format!("{}unit_mm = 1e-320{}", &text[..begin], &text[end..]);
    assert!(Rig::from_toml(&tiny, "tiny").unwrap_err().to_string().contains("a number above 0 is needed"));
}
