//! Damage to texts, by what they are made of: numbers give way to extreme ones, words to other words of the text (links
//! of a URDF then hang on others, keys of a TOML are duplicated), lines and blocks are lost, moved and repeated,
//! brackets nest.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Numbers at the edge of what a number is, and beyond.
const NUMBERS: [&str; 34] = [
    "nan",
    "NaN",
    "inf",
    "-inf",
    "infinity",
    "0",
    "-0",
    "-0.0",
    "1",
    "-1",
    "1e308",
    "-1e308",
    "1.7976931348623157e308",
    "1e400",
    "-1e400",
    "1e160",
    "1e-320",
    "5e-324",
    "1e-400",
    "1e-9",
    "2147483648",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "-9223372036854775809",
    "99999999999999999999999999999999",
    "3.14159265358979323846264338327950288419716939937510",
    "90",
    "180.0",
    "0x10",
    "1_000",
    "1e",
    "1,5",
    "\u{663}",
];

/// What means something in one text or another.
const PIECES: [&str; 26] = [
    "\"",
    "'",
    "<",
    ">",
    "/>",
    "</",
    "<!--",
    "-->",
    "<![CDATA[",
    "[",
    "]",
    "[[",
    "{",
    "}",
    "=",
    ",",
    ";",
    "\n",
    "\r\n",
    "\r",
    "\0",
    "#",
    "&lt;",
    "&#x41;",
    "\u{feff}",
    "\u{e9}\u{1f600}",
];

/// What may be opened again and again.
const NESTING: [&str; 6] = ["[", "{", "[[", "<a>", "{\"a\":", "("];

/// A damaged text is cut to this length, bytes.
const LONGEST: usize = 1 << 20;

/// A seed with one to four damages. `others` lend lines; `pieces` mean something in this format.
pub fn damaged_text(seed: &[u8], others: &[&[u8]], pieces: &[&str], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    // Half of all inputs have one damage: they get far into a reader.
    let count = [1, 1, 1, 1, 2, 2, 3, 4][random.random_range(0..8usize)];
    for _ in 0..count {
        if bytes.is_empty() {
            break;
        }
        match random.random_range(0..100u32) {
            0..22 => with_number(&mut bytes, random),
            22..34 => nudge_number(&mut bytes, random),
            34..48 => rename(&mut bytes, random),
            48..56 => insert(&mut bytes, pick(&PIECES, random), random),
            56..66 if !pieces.is_empty() => insert(&mut bytes, pick(pieces, random), random),
            56..80 => change_lines(&mut bytes, others, random),
            80..95 => change_bytes(&mut bytes, random),
            95..98 => repeat_token(&mut bytes, random),
            _ => grow(&mut bytes, random),
        }
        bytes.truncate(LONGEST);
    }
    bytes
}

fn pick<'a>(list: &[&'a str], random: &mut ChaCha8Rng) -> &'a str {
    list[random.random_range(0..list.len())]
}

fn insert(bytes: &mut Vec<u8>, piece: &str, random: &mut ChaCha8Rng) {
    let at = random.random_range(0..=bytes.len());
    bytes.splice(at..at, piece.bytes());
}

/// The next run of bytes of a kind at or after a place, else the first before it.
fn run(bytes: &[u8], begins: impl Fn(u8) -> bool, goes_on: impl Fn(u8) -> bool, at: usize) -> Option<Range<usize>> {
    // Not in the middle of a word: q1_deg and l20 are no numbers.
    let fresh =
        |&i: &usize| begins(bytes[i]) && (i == 0 || !(bytes[i - 1].is_ascii_alphanumeric() || bytes[i - 1] == b'_'));
    let begin = (at..bytes.len()).find(fresh).or_else(|| (0..at).find(fresh))?;
    let length = bytes[begin..].iter().take_while(|byte| goes_on(**byte)).count().max(1);
    Some(begin..begin + length)
}

fn number(bytes: &[u8], random: &mut ChaCha8Rng) -> Option<Range<usize>> {
    let in_number = |byte: u8| byte.is_ascii_digit() || matches!(byte, b'.' | b'-' | b'+' | b'e' | b'E');
    let at = random.random_range(0..bytes.len());
    run(bytes, |byte| byte.is_ascii_digit() || byte == b'-', in_number, at)
}

fn word(bytes: &[u8], random: &mut ChaCha8Rng) -> Option<Range<usize>> {
    let at = random.random_range(0..bytes.len());
    run(bytes, |byte| byte.is_ascii_alphabetic(), |byte| byte.is_ascii_alphanumeric() || byte == b'_', at)
}

fn with_number(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    if let Some(range) = number(bytes, random) {
        let other = pick(&NUMBERS, random);
        bytes.splice(range, other.bytes());
    }
}

/// A number that is another, and still one: the reader goes on.
fn nudge_number(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let Some(range) = number(bytes, random) else { return };
    let Some(value) = std::str::from_utf8(&bytes[range.clone()]).ok().and_then(|text| text.parse::<f64>().ok()) else {
        return;
    };
    let whole = !bytes[range.clone()].contains(&b'.');
    let changed = match random.random_range(0..6u32) {
        0 => -value,
        1 => value * 1000.0,
        2 if !whole => value * 1e-3,
        3 => value + 1.0,
        4 => value - 1.0,
        _ if whole => (value * random.random_range(0.0..3.0f64)).round(),
        _ => value * random.random_range(-2.0..2.0f64),
    };
    bytes.splice(range, changed.to_string().into_bytes());
}

/// A word gives way to another word of the text.
fn rename(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    if let (Some(from), Some(to)) = (word(bytes, random), word(bytes, random)) {
        let other = bytes[to].to_vec();
        bytes.splice(from, other);
    }
}

fn lines(bytes: &[u8]) -> Vec<&[u8]> {
    bytes.split_inclusive(|byte| *byte == b'\n').collect()
}

fn change_lines(bytes: &mut Vec<u8>, others: &[&[u8]], random: &mut ChaCha8Rng) {
    let mut changed: Vec<&[u8]> = lines(bytes);
    let at = random.random_range(0..changed.len());
    let end = (at + random.random_range(1..6usize)).min(changed.len());
    match random.random_range(0..6u32) {
        0 => drop(changed.drain(at..end)),
        1 => {
            let block = changed[at..end].to_vec();
            changed.splice(at..at, block);
        }
        2 => {
            let other = random.random_range(0..changed.len());
            changed.swap(at, other);
        }
        3 => {
            let block: Vec<&[u8]> = changed.drain(at..end).collect();
            let to = random.random_range(0..=changed.len());
            changed.splice(to..to, block);
        }
        4 if !others.is_empty() => {
            let lent = lines(others[random.random_range(0..others.len())]);
            if !lent.is_empty() {
                let from = random.random_range(0..lent.len());
                let until = (from + random.random_range(1..8usize)).min(lent.len());
                changed.splice(at..at, lent[from..until].iter().copied());
            }
        }
        _ => {
            let block = changed[at..end].repeat(random.random_range(1..12usize));
            changed.splice(at..at, block);
        }
    }
    *bytes = changed.concat();
}

fn change_bytes(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let at = random.random_range(0..bytes.len());
    let end = (at + random.random_range(1..40usize)).min(bytes.len());
    match random.random_range(0..5u32) {
        0 => bytes[at] = random.random(),
        1 => bytes[at] ^= 1 << random.random_range(0..8u32),
        2 => bytes.truncate(at),
        3 => drop(bytes.drain(at..end)),
        _ => {
            let copy = bytes[at..end].to_vec();
            bytes.splice(at..at, copy);
        }
    }
}

fn repeat_token(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let found = if random.random() { word(bytes, random) } else { number(bytes, random) };
    if let Some(range) = found {
        let copy = bytes[range.clone()].repeat(random.random_range(2..60usize));
        bytes.splice(range, copy);
    }
}

/// Rarely: much of something. A long line, thousands of lines, deep nesting.
fn grow(bytes: &mut Vec<u8>, random: &mut ChaCha8Rng) {
    let much = 1usize << random.random_range(4..13u32);
    let at = random.random_range(0..bytes.len());
    match random.random_range(0..4u32) {
        0 => {
            let opened = pick(&NESTING, random).repeat(much);
            bytes.splice(at..at, opened.bytes());
        }
        1 => {
            let byte = bytes[at];
            bytes.splice(at..at, std::iter::repeat_n(byte, much));
        }
        2 => {
            let line = lines(bytes).into_iter().find(|line| line.len() > at % 40).unwrap_or_default().to_vec();
            let repeated = line.repeat(much.min(LONGEST / line.len().max(1)));
            bytes.splice(at..at, repeated);
        }
        _ => {
            let number = "7".repeat(much);
            bytes.splice(at..at, number.bytes());
        }
    }
}
