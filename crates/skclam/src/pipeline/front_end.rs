//! From images to correspondences: all that happens before an estimator runs.

use super::{
    BoardSummary, BoardUse, Config, EgoMaskSummary, Estimator, ImageFeatures, MatchedPair, RunError, TrackSummary,
    board_alone, correspondences, drop_ego_masked, extract_features, find_boards, match_pairs, pairs_to_match,
};
use crate::dataset::Dataset;
use crate::progress::Progress;
use crate::summary::total_counts;
use skclam_calibration::Correspondences;
use skclam_features::EgoMask;

/// What the images said.
pub(super) struct FrontEnd {
    pub images: Vec<ImageFeatures>,
    pub pairs: Vec<MatchedPair>,
    pub data: Correspondences,
    pub tracks: Option<TrackSummary>,
    pub board: Option<BoardSummary>,
    pub warnings: Vec<String>,
    pub ego_mask: Option<(EgoMask, EgoMaskSummary)>,
}

/// Features, board, matches and tracks: section 3.2 and the rig's board. Fails where nothing is left.
pub(super) fn front_end(dataset: &Dataset, config: &Config, progress: &dyn Progress) -> Result<FrontEnd, RunError> {
    config.check()?;
    let mut images = extract_features(dataset, config, progress)?;
    // The other estimators use pairs alone.
    let boards = match config.estimator {
        Estimator::Bundle => find_boards(dataset, &images, config, progress)?,
        Estimator::NelderMead | Estimator::Sampson => None,
    };
    let chosen = pairs_to_match(&images, &dataset.rig.color, config);
    let ego_mask = match dataset.rig.color_mask {
        // The user's word comes before what can be found.
        Some(_) => None,
        None => drop_ego_masked(&mut images, &chosen, &dataset.rig.color, config)?,
    };
    let pairs = match_pairs(dataset, &images, chosen, config, progress)?;
    let (mut data, tracks) = correspondences(dataset, &images, &pairs, config, progress)?;
    let mut warnings = Vec::new();
    let mut board = None;
    if let (Some((seen, summary)), Some(of_rig)) = (boards, &dataset.rig.board) {
        warnings.extend(summary.warnings(of_rig));
        data.boards = seen;
        let has_depth = dataset.records.iter().any(|record| record.depth.is_some());
        if board_alone(config.board_use, summary.postures, dataset.len(), has_depth) && data.match_count() > 0 {
            data.tracks.clear();
            data.pairs.clear();
            if config.board_use == BoardUse::Auto {
                warnings.push(format!(
                    "the board is in {} of {} postures and leads: natural features were not used (the setting \"board_use\": \"together\" uses them)",
                    summary.postures,
                    dataset.len()
                ));
            }
        }
        board = Some(summary);
    }
    if data.match_count() == 0 {
        // Nothing else is there: the estimated noise is that of the corners, in pixels.
        data.boards.iter_mut().for_each(|seen| seen.sigma_px = 1.0);
    }
    if data.match_count() == 0 && data.boards.is_empty() {
        let total = total_counts(&pairs);
        return Err(RunError::NoMatches {
            images: images.len(),
            keypoints: images.iter().map(|image| image.features.keypoints.len()).sum(),
            candidates: total.candidates,
            after_ratio: total.after_ratio.unwrap_or(total.candidates),
            matches: 0,
        });
    }
    Ok(FrontEnd { images, pairs, data, tracks, board, warnings, ego_mask })
}
