//! ArUco's dictionaries: which bits make which marker.
//!
//! What a marker shows is a fact that printed boards fix: the patterns are those of OpenCV's predefined dictionaries
//! (`cv::aruco::PredefinedDictionaryType`), all but the rare and long AprilTag 36h10 (Garrido-Jurado et al., "Automatic
//! generation and detection of highly reliable fiducial markers under occlusion", 2014; the AprilTags are Olson's and
//! Wang's). The names are OpenCV's too. The tables in `dictionaries/` hold a marker a line: its inner bits row by row
//! as a hexadecimal number, the first bit foremost, white = 1.

use crate::FeaturesError;

/// A set of square markers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Dictionary {
    name: &'static str,
    side: usize,
    codes: Vec<u64>,
    /// All distances of two markers, turned in any way, are at least this.
    distance: u32,
}

/// Name, inner bits along a side, markers, least distance, table.
type Entry = (&'static str, usize, usize, u32, &'static str);

const D4: &str = include_str!("dictionaries/4x4.txt");
const D5: &str = include_str!("dictionaries/5x5.txt");
const D6: &str = include_str!("dictionaries/6x6.txt");
const D7: &str = include_str!("dictionaries/7x7.txt");

const ENTRIES: [Entry; 21] = [
    ("DICT_4X4_50", 4, 50, 4, D4),
    ("DICT_4X4_100", 4, 100, 3, D4),
    ("DICT_4X4_250", 4, 250, 3, D4),
    ("DICT_4X4_1000", 4, 1000, 2, D4),
    ("DICT_5X5_50", 5, 50, 8, D5),
    ("DICT_5X5_100", 5, 100, 7, D5),
    ("DICT_5X5_250", 5, 250, 6, D5),
    ("DICT_5X5_1000", 5, 1000, 5, D5),
    ("DICT_6X6_50", 6, 50, 13, D6),
    ("DICT_6X6_100", 6, 100, 12, D6),
    ("DICT_6X6_250", 6, 250, 11, D6),
    ("DICT_6X6_1000", 6, 1000, 9, D6),
    ("DICT_7X7_50", 7, 50, 19, D7),
    ("DICT_7X7_100", 7, 100, 18, D7),
    ("DICT_7X7_250", 7, 250, 17, D7),
    ("DICT_7X7_1000", 7, 1000, 14, D7),
    ("DICT_ARUCO_ORIGINAL", 5, 1024, 1, include_str!("dictionaries/aruco_original.txt")),
    ("DICT_APRILTAG_16h5", 4, 30, 5, include_str!("dictionaries/apriltag_16h5.txt")),
    ("DICT_APRILTAG_25h9", 5, 35, 9, include_str!("dictionaries/apriltag_25h9.txt")),
    ("DICT_APRILTAG_36h11", 6, 587, 11, include_str!("dictionaries/apriltag_36h11.txt")),
    ("DICT_ARUCO_MIP_36h12", 6, 250, 12, include_str!("dictionaries/aruco_mip_36h12.txt")),
];

/// Wrong bits that are forgiven at most: the board's grid supports its markers, but not any.
const FORGIVEN: u32 = 3;

impl Dictionary {
    /// Names that [`Dictionary::named`] knows.
    pub fn names() -> impl Iterator<Item = &'static str> {
        ENTRIES.iter().map(|entry| entry.0)
    }

    /// A dictionary by OpenCV's name, upper or lower case: "DICT_4X4_50".
    ///
    /// # Errors
    /// Unknown names, with those that are known.
    pub fn named(name: &str) -> Result<Self, FeaturesError> {
        let entry = ENTRIES.iter().find(|entry| entry.0.eq_ignore_ascii_case(name.trim()));
        let &(name, side, count, distance, table) = entry.ok_or_else(|| FeaturesError::UnknownDictionary {
            got: name.to_owned(),
            known: Self::names().collect::<Vec<_>>().join(", "),
        })?;
        let codes = table.lines().take(count).filter_map(|line| u64::from_str_radix(line, 16).ok()).collect();
        Ok(Dictionary { name, side, codes, distance })
    }

    /// OpenCV's name.
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// Inner bits along a side of a marker.
    pub fn side(&self) -> usize {
        self.side
    }

    /// Number of markers.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.codes.len()
    }

    /// Bit of a marker at row and column, true = white; `None` where there is none.
    pub fn bit(&self, id: usize, row: usize, column: usize) -> Option<bool> {
        let inside = row < self.side && column < self.side;
        let shift = self.side * self.side - 1 - (row * self.side + column).min(self.side * self.side - 1);
        self.codes.get(id).filter(|_| inside).map(|code| code >> shift & 1 == 1)
    }

    /// The marker among the first `count` that fits `bits` (row by row, first foremost, white = 1), and by how many
    /// quarter turns clockwise the marker must be turned to look like `bits`. `None` where none fits, or two fit as
    /// well.
    pub(crate) fn find(&self, bits: u64, count: usize) -> Option<(usize, usize)> {
        let forgiven = ((self.distance - 1) / 2).min(FORGIVEN);
        // Turning the reading back instead of every marker forth.
        let mut readings = [bits; 4];
        for turns in 1..4 {
            readings[turns] = turned_back(readings[turns - 1], self.side);
        }
        let mut best: Option<(u32, usize, usize)> = None;
        let mut tied = false;
        for (id, code) in self.codes.iter().take(count).enumerate() {
            for (turns, reading) in readings.iter().enumerate() {
                let wrong = (code ^ reading).count_ones();
                match best {
                    Some((least, ..)) if wrong > least => {}
                    Some((least, ..)) if wrong == least => tied = true,
                    _ => (best, tied) = (Some((wrong, id, turns)), false),
                }
            }
        }
        best.filter(|(wrong, ..)| *wrong <= forgiven && !tied).map(|(_, id, turns)| (id, turns))
    }
}

/// A square of bits turned by a quarter counter-clockwise.
fn turned_back(bits: u64, side: usize) -> u64 {
    let last = side * side - 1;
    let bit = |row: usize, column: usize| bits >> (last - (row * side + column)) & 1;
    (0..side).flat_map(|row| (0..side).map(move |column| (row, column))).fold(0, |turned, (row, column)| {
        // What is at (row, column) after the turn was in column `side - 1 - row`, row `column` before.
        turned << 1 | bit(column, side - 1 - row)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_are_whole_and_known_markers_are_theirs() {
        for &(name, side, count, ..) in &ENTRIES {
            let dictionary = Dictionary::named(name).unwrap();
            assert_eq!((dictionary.len(), dictionary.side()), (count, side), "{name}");
            assert!(dictionary.codes.iter().all(|code| code >> (side * side) == 0), "{name}");
        }
        // The first marker of 4x4, as printed by anyone: rows 1011, 0101, 0011, 0010.
        let first = Dictionary::named("dict_4x4_50").unwrap();
        let row = |r| (0..4).map(|c| u8::from(first.bit(0, r, c).unwrap())).collect::<Vec<_>>();
        assert_eq!([row(0), row(1), row(2), row(3)].concat(), [1, 0, 1, 1, 0, 1, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]);
        assert_eq!(first.bit(50, 0, 0), None);
        assert_eq!(first.bit(0, 4, 0), None);
    }

    #[test]
    fn the_stated_distances_hold() {
        for name in ["DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_50", "DICT_APRILTAG_36h11", "DICT_ARUCO_MIP_36h12"] {
            let dictionary = Dictionary::named(name).unwrap();
            let mut least = u32::MAX;
            for (a, code) in dictionary.codes.iter().enumerate() {
                let mut other = *code;
                for turns in 0..4 {
                    for (b, second) in dictionary.codes.iter().enumerate().skip(a) {
                        if b > a || turns > 0 {
                            least = least.min((other ^ second).count_ones());
                        }
                    }
                    other = turned_back(other, dictionary.side);
                }
            }
            assert!(least >= dictionary.distance, "{name}: {least}");
        }
    }

    #[test]
    fn markers_are_found_in_every_turn_and_with_wrong_bits() {
        let dictionary = Dictionary::named("DICT_6X6_250").unwrap();
        for (id, &code) in dictionary.codes.iter().enumerate() {
            // Three turns back are one forth.
            let forth = turned_back(turned_back(turned_back(code, 6), 6), 6);
            assert_eq!(dictionary.find(forth, 250), Some((id, 1)));
            assert_eq!(dictionary.find(code ^ 0b1000_0010_0001, 250), Some((id, 0)));
        }
        assert_eq!(dictionary.find(dictionary.codes[17], 17), None);
    }

    #[test]
    fn unknown_names_are_reported_with_the_known_ones() {
        let message = Dictionary::named("DICT_3X3_9").unwrap_err().to_string();
        assert!(message.contains("DICT_3X3_9") && message.contains("DICT_4X4_50"), "{message}");
    }
}
