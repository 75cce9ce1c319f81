//! The rig's board in the images: found, its corners labelled alike in all of them, and how well they fit in the end.
//!
//! Where a pattern can be labelled in several ways (a part of it is out of view, or it looks the same when turned), the
//! nominal rig decides: the board stood still, so all postures must see it in one place. The right labelling puts it
//! there; the others are off by squares or by half a turn. What is not clear by far is left out, and named.

use super::{BoardUse, Config, ImageFeatures, RunError};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    BoardObservation, Calibration, Correspondences, Model, board_residuals, color_from_board, fit_mount_to_board,
};
use skclam_features::board::{BoardLayout, Dictionary, FoundBoard, Labelling, MarkerLayout, detect_board};
use skclam_geometry::{Isometry3, Pixel, Point3};
use skclam_rig::{Board, BoardPattern, Rig};

/// What became of the board, for the summary.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct BoardSummary {
    /// Postures in which it was found and labelled.
    pub postures: usize,
    /// Corners in them.
    pub corners: usize,
    /// The recording's indices of postures where no board was found.
    pub not_found: Vec<u64>,
    /// Of postures with several labellings that are about as likely; they were left out.
    pub ambiguous: Vec<u64>,
    /// RMS distance of all corners to where they should be under the nominal rig, px.
    pub nominal_rms_px: Option<f64>,
    /// The same under the nominal arm with the mount fitted to the board: what a calibration of the arm must beat.
    pub mount_fitted_rms_px: Option<f64>,
    /// The same under the calibrated rig, joint values taken as exact.
    pub calibrated_rms_px: Option<f64>,
}

/// No corner is known better than this, px: print and lens are not exact.
const MIN_CORNER_SIGMA_PX: f64 = 0.02;
/// The right labelling must put the board so many times nearer to where the others see it than the next best one.
const CLEARLY_NEARER: f64 = 2.0;
/// Postures whose labellings are tried as the right one.
const TRIED: usize = 40;

/// Part of the postures that must show the board for it to be used alone.
const NEARLY_ALL: f64 = 0.9;

/// Whether the board is used alone.
///
/// Corners are named beyond doubt and known to a few hundredths of a pixel. Natural features of a scene that was
/// arranged for a board are few and short-lived; on the one real recording at hand they made the fit worse
/// (benchmarks/estimator, 2026-11-23-board). They are wanted where the board is missing, and where they bring depth,
/// which a board's corners do not.
pub(crate) fn board_alone(chosen: BoardUse, seen: usize, postures: usize, has_depth: bool) -> bool {
    match chosen {
        BoardUse::Alone => seen > 0,
        BoardUse::Together => false,
        BoardUse::Auto => seen > 0 && !has_depth && seen as f64 >= NEARLY_ALL * postures as f64,
    }
}

/// The detector's layout for the rig's board.
pub fn board_layout(board: &Board) -> Result<BoardLayout, RunError> {
    let markers = match &board.pattern {
        BoardPattern::Checkerboard => None,
        BoardPattern::Charuco { dictionary, marker_um } => Some(MarkerLayout {
            dictionary: Dictionary::named(dictionary)?,
            marker_in_square: *marker_um as f64 * 1e-6 / board.square_m,
        }),
    };
    Ok(BoardLayout { columns: board.columns, rows: board.rows, markers })
}

/// One labelling of the corners of one posture, and where that puts the board by the nominal rig.
struct Candidate {
    labelling: Labelling,
    color_from_board: Isometry3,
}

/// Finds the board in every image; `None` where the rig has none. `images` may hold the grey images of the data set,
/// and may be empty.
pub fn find_boards(
    dataset: &Dataset,
    images: &[ImageFeatures],
    config: &Config,
    progress: &dyn Progress,
) -> Result<Option<(Vec<BoardObservation>, BoardSummary)>, RunError> {
    let Some(board) = &dataset.rig.board else { return Ok(None) };
    let layout = board_layout(board)?;
    progress.begin(Stage::FindBoards, dataset.len() as u64);
    let found: Vec<Option<FoundBoard>> = (0..dataset.len())
        .into_par_iter()
        .map(|index| {
            if progress.stop_requested() {
                return Err(RunError::Interrupted);
            }
            let one = match images.get(index).and_then(|image| image.gray.as_ref()) {
                Some(gray) => detect_board(gray, &layout, &config.board)?,
                None => detect_board(&dataset.gray(index)?, &layout, &config.board)?,
            };
            progress.step();
            Ok(one)
        })
        .collect::<Result<_, _>>()?;
    let chosen = label_alike(dataset, &layout, &found)?;
    let index = |posture: usize| dataset.records[posture].posture.index;
    let mut summary = BoardSummary::default();
    let mut boards = Vec::new();
    for (posture, (found, labelling)) in found.iter().zip(&chosen).enumerate() {
        match (found, labelling) {
            (None, _) => summary.not_found.push(index(posture)),
            (Some(_), None) => summary.ambiguous.push(index(posture)),
            (Some(found), Some(labelling)) => {
                let corners = corners(found, labelling, &layout);
                summary.postures += 1;
                summary.corners += corners.len();
                boards.push(BoardObservation { posture, corners, sigma_px: found.sigma_px.max(MIN_CORNER_SIGMA_PX) });
            }
        }
    }
    Ok(Some((boards, summary)))
}

fn corners(found: &FoundBoard, labelling: &Labelling, layout: &BoardLayout) -> Vec<(u32, u32, Pixel)> {
    let corners = found.labelled(labelling, layout).into_iter();
    corners.map(|corner| (corner.column, corner.row, Pixel::new(corner.x, corner.y))).collect()
}

/// For each posture the labelling of its corners that agrees with the others; `None` without a board, or where it is
/// not clear.
fn label_alike(
    dataset: &Dataset,
    layout: &BoardLayout,
    found: &[Option<FoundBoard>],
) -> Result<Vec<Option<Labelling>>, RunError> {
    let Some(board) = &dataset.rig.board else { return Ok(vec![None; found.len()]) };
    let candidates: Vec<Vec<Candidate>> = found
        .par_iter()
        .map(|found| {
            let Some(found) = found else { return Vec::new() };
            let candidate = |labelling: &Labelling| {
                let corners = corners(found, labelling, layout);
                let color_from_board = color_from_board(&dataset.rig.color, board, &corners)?;
                Some(Candidate { labelling: *labelling, color_from_board })
            };
            found.labellings.iter().filter_map(candidate).collect()
        })
        .collect();
    let first = agreeing(dataset, &dataset.rig, board, &candidates)?;
    let clear: Vec<usize> = (0..candidates.len()).filter(|&posture| first[posture].is_some()).collect();
    let with_board = candidates.iter().filter(|candidates| !candidates.is_empty()).count();
    if clear.len() == with_board || clear.len() < 3 {
        return Ok(first);
    }
    // A rough mount blurs the place. Those that are clear give the mount, and that the place of the others.
    let boards = clear
        .iter()
        .filter_map(|&posture| {
            let corners = corners(found[posture].as_ref()?, first[posture].as_ref()?, layout);
            Some(BoardObservation { posture, corners, sigma_px: 1.0 })
        })
        .collect();
    let postures = dataset.records.iter().map(|record| record.posture.clone()).collect();
    let data = Correspondences { postures, boards, ..Correspondences::default() };
    match fit_mount_to_board(&dataset.rig, &data) {
        Ok(model) => agreeing(dataset, &model.rig, board, &candidates),
        Err(_) => Ok(first),
    }
}

/// The labellings that put the board in one place by the rig's poses.
fn agreeing(
    dataset: &Dataset,
    rig: &Rig,
    board: &Board,
    candidates: &[Vec<Candidate>],
) -> Result<Vec<Option<Labelling>>, RunError> {
    let (width, height) = (f64::from(board.columns - 1), f64::from(board.rows - 1));
    let ends = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)];
    // A board is where its four outermost corners are.
    let mut places: Vec<Vec<[Point3; 4]>> = Vec::new();
    for (record, candidates) in dataset.records.iter().zip(candidates) {
        let base_from_color = rig.base_from_color(&record.posture)?;
        let place = |candidate: &Candidate| {
            ends.map(|(x, y)| base_from_color * candidate.color_from_board * (Point3::new(x, y, 0.0) * board.square_m))
        };
        places.push(candidates.iter().map(place).collect());
    }
    let apart = |a: &[Point3; 4], b: &[Point3; 4]| a.iter().zip(b).map(|(a, b)| (a - b).norm()).sum::<f64>() / 4.0;
    // The place that most agree with is one of those of the postures that leave the fewest labellings.
    let mut order: Vec<usize> = (0..candidates.len()).filter(|&posture| !candidates[posture].is_empty()).collect();
    order.sort_by_key(|&posture| (candidates[posture].len(), posture));
    let size = board.square_m * width.hypot(height).max(1.0);
    let cost = |place: &[Point3; 4]| -> f64 {
        let nearest =
            |places: &Vec<[Point3; 4]>| places.iter().map(|other| apart(place, other)).fold(f64::MAX, f64::min);
        places.iter().filter(|places| !places.is_empty()).map(|places| nearest(places).min(size)).sum()
    };
    let tried = order.iter().flat_map(|&posture| &places[posture]).take(TRIED);
    let best = tried.map(|place| (cost(place), place)).min_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, place)) = best else { return Ok(vec![None; candidates.len()]) };
    // The middle of all nearest ones is a better place than that of any single posture.
    let nearest = |places: &[[Point3; 4]]| -> Option<[Point3; 4]> {
        places.iter().copied().min_by(|a, b| apart(place, a).total_cmp(&apart(place, b)))
    };
    let agreed: Vec<[Point3; 4]> = places.iter().filter_map(|places| nearest(places)).collect();
    let middle: [Point3; 4] = std::array::from_fn(|end| {
        let mean = |axis: usize| {
            let mut values: Vec<f64> = agreed.iter().map(|place| place[end][axis]).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        Point3::new(mean(0), mean(1), mean(2))
    });
    let choose = |(candidates, places): (&Vec<Candidate>, &Vec<[Point3; 4]>)| {
        let mut distances: Vec<(f64, usize)> =
            places.iter().enumerate().map(|(candidate, place)| (apart(place, &middle), candidate)).collect();
        distances.sort_by(|a, b| a.0.total_cmp(&b.0));
        let clear = match distances[..] {
            [_] => true,
            [first, second, ..] => second.0 > CLEARLY_NEARER * first.0,
            [] => false,
        };
        clear.then(|| candidates[distances[0].1].labelling)
    };
    Ok(candidates.iter().zip(&places).map(choose).collect())
}

impl BoardSummary {
    /// Fills in how well the corners fit before and after.
    pub(super) fn compare(
        &mut self,
        dataset: &Dataset,
        data: &Correspondences,
        calibration: &Calibration,
    ) -> Result<(), RunError> {
        if data.boards.is_empty() {
            return Ok(());
        }
        let all: Vec<usize> = (0..dataset.len()).collect();
        let rms = |model: &Model| -> Result<Option<f64>, RunError> {
            Ok(board_residuals(model, data, &all, &all)?.map(|statistics| statistics.rms_px))
        };
        self.nominal_rms_px = rms(&Model::new(dataset.rig.clone()))?;
        // Too few corners for a mount are no reason to end a run.
        self.mount_fitted_rms_px = match fit_mount_to_board(&dataset.rig, data) {
            Ok(model) => rms(&model)?,
            Err(_) => None,
        };
        self.calibrated_rms_px = rms(&calibration.model)?;
        Ok(())
    }

    /// What a user should know.
    pub(crate) fn warnings(&self, board: &Board) -> Vec<String> {
        let list = |indices: &[u64]| indices.iter().map(u64::to_string).collect::<Vec<_>>().join(", ");
        let size = format!("{} x {} inner corners", board.columns, board.rows);
        let mut warnings = Vec::new();
        if self.postures == 0 && self.ambiguous.is_empty() {
            warnings.push(format!(
                "the board of the rig ({size}) was found in no image: are columns and rows its inner corners (one less than its squares), \
                 is its kind right, does the whole of it show, sharp and without glare? Without it its lengths are not used"
            ));
            return warnings;
        }
        if !self.not_found.is_empty() {
            warnings.push(format!("no board of {size} was found in postures {}", list(&self.not_found)));
        }
        if !self.ambiguous.is_empty() {
            warnings.push(format!(
                "postures {}: which corner of the board is which is not clear (a part is out of view, or it looks the same when turned); \
                 its corners were left out there. A ChArUco board has no such doubt",
                list(&self.ambiguous)
            ));
        }
        warnings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_board_in_nearly_every_posture_is_used_alone_unless_there_is_depth() {
        assert!(board_alone(BoardUse::Auto, 22, 24, false));
        assert!(!board_alone(BoardUse::Auto, 21, 24, false));
        assert!(!board_alone(BoardUse::Auto, 24, 24, true));
        assert!(!board_alone(BoardUse::Together, 24, 24, false));
        assert!(board_alone(BoardUse::Alone, 3, 24, true));
        assert!(!board_alone(BoardUse::Alone, 0, 24, false));
    }
}
