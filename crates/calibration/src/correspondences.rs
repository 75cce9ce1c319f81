//! What the images said, as plain pixel coordinates: pair matches, tracks and board corners.

use crate::CalibrationError;
use nalgebra::Matrix2;
use skclam_geometry::Pixel;
use skclam_rig::Posture;

/// One match between two images. Pixels as measured, distortion included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairMatch {
    /// Where image A shows the point, px.
    pub in_a: Pixel,
    /// Where image B shows it, px.
    pub in_b: Pixel,
    /// Standard deviation of each coordinate relative to the other matches, px; 1 where nothing is known (the common
    /// scale is estimated).
    pub sigma_px: f64,
    /// Distance of the descriptors: smaller is better.
    pub distance: u32,
}

/// The matches of one pair of postures.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PairMatches {
    /// Position of the first posture in [`Correspondences::postures`].
    pub a: usize,
    /// Position of the second posture.
    pub b: usize,
    /// The matches.
    pub matches: Vec<PairMatch>,
}

/// A point of the scene as one image shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackObservation {
    /// Position of the posture in [`Correspondences::postures`].
    pub posture: usize,
    /// Where the image shows the point, px, distortion included.
    pub pixel: Pixel,
    /// Covariance of `pixel`, px^2, relative to the other observations (the common scale is estimated).
    pub covariance: Matrix2<f64>,
    /// Measured z-depth of the point in the *colour* camera's frame, metres.
    pub depth_m: Option<f64>,
    /// How the surface's z-depth changes with the normalised image coordinates x/z and y/z there, metres; zeros where
    /// that is not known.
    pub depth_slope: [f64; 2],
}

/// A point of the scene that several images show.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Track {
    /// At most one a posture.
    pub observations: Vec<TrackObservation>,
}

/// The corners of the rig's board in one image.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardObservation {
    /// Position of the posture in [`Correspondences::postures`].
    pub posture: usize,
    /// Column and row of the inner corner, counted from 0, and where the image shows it, px, distortion included.
    pub corners: Vec<(u32, u32, Pixel)>,
    /// Standard deviation of each coordinate relative to the other observations, px; 1 where nothing is known or
    /// nothing else is there (the common scale is estimated).
    pub sigma_px: f64,
}

/// All that the estimators see of a recording.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Correspondences {
    /// The postures, in the order of the images.
    pub postures: Vec<Posture>,
    /// Matches between pairs of images; the paper's pairs are neighbours.
    pub pairs: Vec<PairMatches>,
    /// Points followed over several images.
    pub tracks: Vec<Track>,
    /// Board corners.
    pub boards: Vec<BoardObservation>,
}

/// The covariance of a pixel whose coordinates have the same `sigma_px` each.
pub fn isotropic_covariance(sigma_px: f64) -> Matrix2<f64> {
    Matrix2::from_diagonal_element(sigma_px * sigma_px)
}

impl Correspondences {
    /// Number of matches over all pairs.
    pub fn match_count(&self) -> usize {
        self.pairs.iter().map(|pair| pair.matches.len()).sum()
    }

    /// Number of observations over all tracks.
    pub fn observation_count(&self) -> usize {
        self.tracks.iter().map(|track| track.observations.len()).sum()
    }

    /// Refuses indices without a posture, non-finite pixels and covariances that are none.
    pub fn check(&self) -> Result<(), CalibrationError> {
        let posture = |what: &str, index: usize| {
            if index < self.postures.len() {
                Ok(())
            } else {
                Err(CalibrationError::NoSuchPosture { what: what.to_owned(), got: index, count: self.postures.len() })
            }
        };
        let finite = |what: &dyn Fn() -> String, values: &[f64]| match values.iter().find(|value| !value.is_finite()) {
            Some(value) => Err(CalibrationError::NotFinite { what: what(), value: value.to_string() }),
            None => Ok(()),
        };
        for (index, pair) in self.pairs.iter().enumerate() {
            let name = format!("pair {index}");
            posture(&name, pair.a)?;
            posture(&name, pair.b)?;
            if pair.a == pair.b {
                return Err(CalibrationError::SamePosture { pair: index, posture: pair.a });
            }
            for (at, m) in pair.matches.iter().enumerate() {
                let what = || format!("match {at} of pair {index}");
                finite(&what, &[m.in_a.x, m.in_a.y, m.in_b.x, m.in_b.y, m.sigma_px])?;
                if m.sigma_px <= 0.0 {
                    return Err(CalibrationError::NotPositive { what: what(), value: m.sigma_px });
                }
            }
        }
        for (index, track) in self.tracks.iter().enumerate() {
            for observation in &track.observations {
                let what = || format!("an observation of track {index}");
                posture(&what(), observation.posture)?;
                let c = &observation.covariance;
                let depth = observation.depth_m.unwrap_or(1.0);
                let [slope_x, slope_y] = observation.depth_slope;
                finite(
                    &what,
                    &[observation.pixel.x, observation.pixel.y, c[0], c[1], c[2], c[3], depth, slope_x, slope_y],
                )?;
                let smallest = c[(0, 0)].min(c[(1, 1)]).min(c.determinant());
                if smallest <= 0.0 {
                    return Err(CalibrationError::NotPositive { what: what(), value: smallest });
                }
                if depth <= 0.0 {
                    return Err(CalibrationError::NotPositive { what: what(), value: depth });
                }
            }
        }
        for (index, board) in self.boards.iter().enumerate() {
            let name = format!("board observation {index}");
            posture(&name, board.posture)?;
            finite(&|| name.clone(), &[board.sigma_px])?;
            if board.sigma_px <= 0.0 {
                return Err(CalibrationError::NotPositive { what: name, value: board.sigma_px });
            }
            for (_, _, pixel) in &board.corners {
                finite(&|| name.clone(), &[pixel.x, pixel.y])?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam_rig::PostureState;

    fn two_postures() -> Correspondences {
        let posture = |index| Posture::new(index, PostureState::Joints(vec![0.0]));
        Correspondences { postures: vec![posture(0), posture(1)], ..Default::default() }
    }

    #[test]
    fn bad_input_is_named() {
        let good = PairMatch { in_a: Pixel::new(1.0, 2.0), in_b: Pixel::new(3.0, 4.0), sigma_px: 1.0, distance: 0 };
        let with = |a, b, m| Correspondences { pairs: vec![PairMatches { a, b, matches: vec![m] }], ..two_postures() };
        assert!(with(0, 1, good).check().is_ok());
        let message = |data: Correspondences| data.check().unwrap_err().to_string();
        assert!(message(with(0, 2, good)).contains("posture 2"));
        assert!(message(with(1, 1, good)).contains("itself"));
        let bad = PairMatch { in_a: Pixel::new(f64::NAN, 0.0), ..good };
        assert!(message(with(0, 1, bad)).contains("match 0 of pair 0"));
        assert!(message(with(0, 1, PairMatch { sigma_px: 0.0, ..good })).contains("above zero"));
        let observation = TrackObservation {
            posture: 1,
            pixel: Pixel::origin(),
            covariance: isotropic_covariance(1.0),
            depth_m: Some(-1.0),
            depth_slope: [0.0; 2],
        };
        let track = Track { observations: vec![observation] };
        assert!(message(Correspondences { tracks: vec![track], ..two_postures() }).contains("track 0"));
    }
}
