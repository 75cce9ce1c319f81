//! Where a rig that was fitted to some postures expects the observations of others.

use crate::board::{base_from_board_with, point_in_board};
use crate::bundle::observations::{Observation, Observations};
use crate::bundle::start::triangulate_all;
use crate::bundle::state::{NoiseScales, PostureErrorSigmas, State};
use crate::camera_kinematics::CameraKinematics;
use crate::{CalibrationError, Correspondences, Loss, Model};
use skclam_geometry::{Isometry3, Pixel, Point3};

/// How far an observation is from where a rig expects it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Predicted {
    pub posture: usize,
    /// Infinite where nothing is expected.
    pub distance_px: f64,
}

/// Distances, px, of the observations of held-out postures to where the model expects them: first those of tracks, then
/// of board corners, in the order of the data. Points and board lie where the other postures saw them. Infinite where a
/// track has fewer than two other observations, or cannot be triangulated from them.
pub(crate) fn predicted_distances(
    model: &Model,
    posture_errors: &[f64],
    data: &Correspondences,
    held_out: &[usize],
) -> Result<Vec<Predicted>, CalibrationError> {
    let motion = CameraKinematics::new(&model.rig, &data.postures)?;
    let is_held = |posture: usize| held_out.contains(&posture);
    let touching = Correspondences {
        postures: data.postures.clone(),
        tracks: data.tracks.iter().filter(|t| t.observations.iter().any(|o| is_held(o.posture))).cloned().collect(),
        ..Default::default()
    };
    let observations = Observations::new(&model.rig, &touching, &|_| true, &mut Vec::new())?;
    let trained = training_part(&observations, &is_held);
    let mut state = State {
        model: model.clone(),
        posture_errors: posture_errors.to_vec(),
        points: Vec::new(),
        base_from_board: None,
        frames: Vec::new(),
    };
    state.refresh_frames(&motion)?;
    let noise = NoiseScales { pixel: 1.0, depth: 0.01, posture: PostureErrorSigmas { angular: 1.0, linear: 1.0 } };
    let points = triangulate_all(&trained, &state.view(&noise, Loss::Cauchy(5.0)), None);
    // Held-out postures are where their joints say.
    let plain = State { posture_errors: Vec::new(), ..state.clone() };
    let mut plain = plain;
    plain.refresh_frames(&motion)?;
    let distance = |observation: &Observation, point: &Point3| {
        let in_camera = plain.frames[observation.posture as usize].in_camera(point);
        model.rig.color.project(&in_camera).map_or(f64::INFINITY, |pixel| (observation.pixel - pixel).norm())
    };
    let mut distances = Vec::new();
    for (track, point) in points.iter().enumerate() {
        for observation in observations.track(track).iter().filter(|s| is_held(s.posture as usize)) {
            let distance_px = point.map_or(f64::INFINITY, |point| distance(observation, &point));
            distances.push(Predicted { posture: observation.posture as usize, distance_px });
        }
    }
    distances.extend(board_distances(model, posture_errors, data, held_out)?);
    Ok(distances)
}

/// The same tracks without the observations of held-out postures; a track with fewer than two others is empty.
fn training_part(observations: &Observations, is_held: &dyn Fn(usize) -> bool) -> Observations {
    let mut rest = Observations { offsets: vec![0], postures: observations.postures, ..Default::default() };
    for track in 0..observations.track_count() {
        let own = observations.track(track).iter().filter(|s| !is_held(s.posture as usize));
        let own: Vec<Observation> = own.copied().collect();
        if own.len() >= 2 {
            rest.observations.extend(own);
        }
        rest.offsets.push(rest.observations.len());
    }
    rest
}

fn board_distances(
    model: &Model,
    posture_errors: &[f64],
    data: &Correspondences,
    held_out: &[usize],
) -> Result<Vec<Predicted>, CalibrationError> {
    let seen: Vec<_> = data.boards.iter().filter(|seen| held_out.contains(&seen.posture)).collect();
    let (Some(board), false) = (&model.rig.board, seen.is_empty()) else { return Ok(Vec::new()) };
    let others: Vec<usize> = (0..data.postures.len()).filter(|posture| !held_out.contains(posture)).collect();
    let base_from_board: Option<Isometry3> = base_from_board_with(model, posture_errors, data, &others)?;
    let motion = CameraKinematics::new(&model.rig, &data.postures)?;
    let mut distances = Vec::new();
    for seen in seen {
        let camera_from_base = motion.pose(model, seen.posture, &[])?.inverse();
        let expected = |column: u32, row: u32| -> Option<Pixel> {
            let point = base_from_board? * (point_in_board(board, column, row) * model.board_scale);
            model.rig.color.project(&(camera_from_base * point))
        };
        distances.extend(seen.corners.iter().map(|&(column, row, pixel)| {
            let distance_px = expected(column, row).map_or(f64::INFINITY, |expected| (pixel - expected).norm());
            Predicted { posture: seen.posture, distance_px }
        }));
    }
    Ok(distances)
}
