//! Tracks and board corners, laid out flat for the loops that run over a million of them.

use crate::{CalibrationError, Correspondences, Warning};
use nalgebra::{Matrix2, Vector2};
use skclam_geometry::{Pixel, Point3};
use skclam_rig::Rig;

/// One observation of a scene point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observation {
    pub posture: u32,
    /// z-depth in the camera, metres; 0 where nothing was measured.
    pub depth_m: f64,
    /// How the surface's depth changes with the normalised image coordinates x/z and y/z, metres.
    pub depth_slope: [f64; 2],
    pub pixel: Pixel,
    /// Inverse of the pixel's covariance (relative units): xx, xy, yy.
    pub information: [f64; 3],
    /// How much the pixel counts beside one whose error is its own: see the module `correlation`.
    pub pixel_weight: f64,
    /// The same of the depth.
    pub depth_weight: f64,
}

impl Observation {
    /// Norm of a pixel difference in its own sigmas (relative units).
    #[inline]
    pub(crate) fn size(&self, v: &Vector2<f64>) -> f64 {
        let [xx, xy, yy] = self.information;
        (v.x * (xx * v.x + 2.0 * xy * v.y) + yy * v.y * v.y).max(0.0).sqrt()
    }
}

/// One observation of a board corner.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CornerObservation {
    pub observation: Observation,
    pub point_in_board: Point3,
}

/// All observations: those of track `t` are `observations[offsets[t]..offsets[t + 1]]`.
#[derive(Debug, Clone, Default)]
pub(crate) struct Observations {
    pub offsets: Vec<usize>,
    pub observations: Vec<Observation>,
    pub corners: Vec<CornerObservation>,
    /// Each board corner as a track of its own (for the start), and where it lies on the board.
    pub corner_tracks: Vec<(Point3, Vec<Observation>)>,
    pub postures: usize,
}

fn information(covariance: &Matrix2<f64>) -> [f64; 3] {
    let determinant = covariance.determinant();
    [covariance[(1, 1)] / determinant, -covariance[(0, 1)] / determinant, covariance[(0, 0)] / determinant]
}

impl Observations {
    /// Keeps tracks with at least two postures, those of `keep` alone. `data` has been checked.
    pub(crate) fn new(
        rig: &Rig,
        data: &Correspondences,
        keep: &dyn Fn(usize) -> bool,
        warnings: &mut Vec<Warning>,
    ) -> Result<Self, CalibrationError> {
        let mut flat = Observations { offsets: vec![0], postures: data.postures.len(), ..Default::default() };
        let mut repeated = 0;
        let mut last_track = vec![usize::MAX; data.postures.len()];
        for (index, track) in data.tracks.iter().enumerate() {
            let from = flat.observations.len();
            for observation in track.observations.iter().filter(|observation| keep(observation.posture)) {
                if std::mem::replace(&mut last_track[observation.posture], index) == index {
                    repeated += 1;
                    continue;
                }
                flat.observations.push(Observation {
                    posture: observation.posture as u32,
                    depth_m: observation.depth_m.unwrap_or(0.0),
                    depth_slope: observation.depth_slope,
                    pixel: observation.pixel,
                    information: information(&observation.covariance),
                    pixel_weight: 1.0,
                    depth_weight: 1.0,
                });
            }
            if flat.observations.len() - from < 2 {
                flat.observations.truncate(from);
            } else {
                flat.offsets.push(flat.observations.len());
            }
        }
        if repeated > 0 {
            warnings.push(Warning::RepeatedPosture { observations: repeated });
        }
        let mut corner_tracks: Vec<((u32, u32), Vec<Observation>)> = Vec::new();
        for board_seen in data.boards.iter().filter(|board| keep(board.posture)) {
            let posture = board_seen.posture;
            let error = |reason: String| CalibrationError::Board { posture, reason };
            let board = rig.board.as_ref().ok_or_else(|| error("the rig has no [board]".to_owned()))?;
            for &(column, row, pixel) in &board_seen.corners {
                if column >= board.columns || row >= board.rows {
                    let (columns, rows) = (board.columns, board.rows);
                    return Err(error(format!("corner ({column}, {row}) is not on a board of {columns} x {rows}")));
                }
                let point_in_board = Point3::new(f64::from(column), f64::from(row), 0.0) * board.square_m;
                let weight = board_seen.sigma_px.powi(-2);
                let observation = Observation {
                    posture: posture as u32,
                    depth_m: 0.0,
                    depth_slope: [0.0; 2],
                    pixel,
                    information: [weight, 0.0, weight],
                    pixel_weight: 1.0,
                    depth_weight: 1.0,
                };
                flat.corners.push(CornerObservation { observation, point_in_board });
                match corner_tracks.binary_search_by_key(&(row, column), |(key, _)| *key) {
                    Ok(at) => corner_tracks[at].1.push(observation),
                    Err(at) => corner_tracks.insert(at, ((row, column), vec![observation])),
                }
            }
        }
        let square = rig.board.as_ref().map_or(0.0, |board| board.square_m);
        flat.corner_tracks = corner_tracks
            .into_iter()
            .filter(|(_, observations)| observations.len() >= 2)
            .map(|((row, column), s)| (Point3::new(f64::from(column), f64::from(row), 0.0) * square, s))
            .collect();
        Ok(flat)
    }

    pub(crate) fn track_count(&self) -> usize {
        self.offsets.len() - 1
    }

    pub(crate) fn track(&self, index: usize) -> &[Observation] {
        &self.observations[self.offsets[index]..self.offsets[index + 1]]
    }

    /// Observations with a depth.
    pub(crate) fn depth_count(&self) -> usize {
        self.observations.iter().filter(|observation| observation.depth_m > 0.0).count()
    }

    /// Every `stride`-th track, and all board corners.
    pub(crate) fn sampled(&self, stride: usize) -> Self {
        let mut sample = self.clone();
        sample.retain_tracks(&(0..self.track_count()).map(|track| track % stride == 0).collect::<Vec<_>>());
        sample
    }

    /// Makes every corner's sigma larger by a factor.
    pub(crate) fn scale_corner_sigma(&mut self, factor: f64) {
        self.corners.iter_mut().for_each(|corner| {
            corner.observation.information = corner.observation.information.map(|w| w / (factor * factor))
        });
    }

    /// The same without the tracks that `keep` refuses.
    pub(crate) fn retain_tracks(&mut self, keep: &[bool]) {
        let mut offsets = vec![0];
        let mut observations = Vec::with_capacity(self.observations.len());
        for (index, _) in keep.iter().enumerate().filter(|(_, keep)| **keep) {
            observations.extend_from_slice(self.track(index));
            offsets.push(observations.len());
        }
        self.offsets = offsets;
        self.observations = observations;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_in_sigmas() {
        let covariance = Matrix2::new(4.0, 0.6, 0.6, 0.5);
        let v = Vector2::new(1.3, -0.7);
        let squared: f64 = v.dot(&(covariance.try_inverse().unwrap() * v));
        let expected = squared.sqrt();
        let observation = Observation {
            posture: 0,
            depth_m: 0.0,
            depth_slope: [0.0; 2],
            pixel: Pixel::origin(),
            information: information(&covariance),
            pixel_weight: 1.0,
            depth_weight: 1.0,
        };
        assert!((observation.size(&v) - expected).abs() < 1e-12);
    }
}
