//! Corners of a board in images as CSV, for `benchmarks/features/boards.py` and for a look at one's own images.
//!
//! `cargo run --release -p skclam-features --example detect_boards COLUMNS ROWS [DICTIONARY MARKER_IN_SQUARE] --
//! IMAGE...`
//!
//! COLUMNS and ROWS are inner corners; MARKER_IN_SQUARE is the side of a marker over that of a square. A line a corner:
//! the image, which labelling it is (several where the pattern allows them), column and row, position and sigma in
//! px. An image without a board has no line.

use skclam_features::{BoardLayout, BoardOptions, Dictionary, MarkerLayout, detect_board};
use std::error::Error;

const USAGE: &str = "detect_boards COLUMNS ROWS [DICTIONARY MARKER_IN_SQUARE] -- IMAGE...";

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let end = arguments.iter().position(|argument| argument == "--").ok_or(USAGE)?;
    let (board, images) = (&arguments[..end], &arguments[end + 1..]);
    let markers = match board {
        [_, _] => None,
        [_, _, dictionary, marker] => {
            Some(MarkerLayout { dictionary: Dictionary::named(dictionary)?, marker_in_square: marker.parse()? })
        }
        _ => return Err(USAGE.into()),
    };
    let layout = BoardLayout { columns: board[0].parse()?, rows: board[1].parse()?, markers };
    println!("image,labelling,column,row,x_px,y_px,sigma_px");
    for path in images {
        let image = image::open(path)?.into_luma8();
        let Some(found) = detect_board(&image, &layout, &BoardOptions::default())? else { continue };
        for (way, labelling) in found.labellings.iter().enumerate() {
            for corner in found.labelled(labelling, &layout) {
                let (column, row) = (corner.column, corner.row);
                println!("{path},{way},{column},{row},{:.5},{:.5},{:.5}", corner.x, corner.y, corner.sigma_px);
            }
        }
    }
    Ok(())
}
