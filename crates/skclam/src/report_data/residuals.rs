//! How far matches are from their epipolar lines, summed up so as to show systematic patterns: as a histogram, by
//! posture and by pair; and by place in the image, where observations are beside the projections of their points. Where
//! no pair was used (a board alone), histogram and postures are of the observations too. Every metric is over all of
//! them, none is drawn at random.

use super::rounded;
use crate::dataset::Dataset;
use crate::pipeline::RunError;
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    Calibration, Correspondences, EpipolarResidual, Model, epipolar_residuals, reprojection_residuals,
};
use skclam_geometry::Pixel;

/// Bins of the histogram in each factor of ten.
const BINS_A_DECADE: usize = 10;
/// The histogram's range, powers of ten of px; what is outside counts in the outer bins.
const DECADES: (i32, i32) = (-3, 3);
/// Cells of the image along its longer edge.
const CELLS_ACROSS: u32 = 16;
/// A cell with fewer residuals says nothing.
const MIN_RESIDUALS: usize = 8;

/// Residuals before and after. An endpoint of a match is one of its two pixels; each has a distance to its line. Where
/// there are no matches, an endpoint is an observation of a board's corner or of a scene point, and its distance is to
/// where that should appear.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ResidualData {
    /// What the distances of `histogram` and `postures` are.
    #[serde(default)]
    pub distances: ResidualKind,
    /// Distances of all endpoints.
    pub histogram: Histogram,
    /// One a posture, in their order.
    pub postures: Vec<PostureResiduals>,
    /// One a pair that has a baseline and matches.
    pub pairs: Vec<PairResiduals>,
    /// Columns and rows into which the image was divided.
    pub grid: [u32; 2],
    /// What the arrows of the cells are.
    pub arrows: ResidualKind,
    /// The cells that hold enough residuals.
    pub cells: Vec<ImageCell>,
}

/// From where to where a residual goes in the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResidualKind {
    /// From where a scene point should appear to where it was seen: where there are tracks or a board.
    Reprojection,
    /// From the epipolar line to the pixel: where there are pairs alone. Errors along the line do not show.
    #[default]
    Epipolar,
}

/// Numbers of endpoints by distance.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Histogram {
    /// Limits between bins, px; one more than bins.
    pub edges_px: Vec<f64>,
    /// Under the nominal rig.
    pub before: Vec<u64>,
    /// Under the calibrated rig.
    pub after: Vec<u64>,
}

/// Distances of the endpoints in some part of the data under one rig.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ResidualQuantiles {
    /// Median distance to the line, px.
    pub median_px: f64,
    /// 90th percentile, px.
    pub p90_px: f64,
}

/// One posture.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct PostureResiduals {
    /// ResidualQuantiles in its image.
    pub endpoints: usize,
    /// Under the nominal rig.
    pub before: ResidualQuantiles,
    /// Under the calibrated rig.
    pub after: ResidualQuantiles,
}

/// One pair.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairResiduals {
    /// Position of the first posture.
    pub a: usize,
    /// Position of the second posture.
    pub b: usize,
    /// Matches that the estimator was given.
    pub matches: usize,
    /// Median distance under the nominal rig, px.
    pub median_before_px: f64,
    /// The same under the calibrated rig.
    pub median_after_px: f64,
}

/// A part of the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ImageCell {
    /// Its centre, px.
    pub center_px: [f64; 2],
    /// Residuals within.
    pub count: usize,
    /// Median residual (each coordinate for itself) under the nominal rig, px.
    pub before_px: [f64; 2],
    /// The same under the calibrated rig.
    pub after_px: [f64; 2],
}

/// Residuals of one pair's matches, before and after.
pub(super) type PairResidualVectors = Option<[Vec<EpipolarResidual>; 2]>;

/// One endpoint: where it is, and its residuals before and after.
struct Endpoint {
    posture: usize,
    pixel: Pixel,
    residuals_px: [Vector2<f64>; 2],
}

/// A pixel and its residuals before and after.
type Place = (Pixel, [Vector2<f64>; 2]);

/// Sums up, and hands out the residuals match by match (pair by pair; `None` without a baseline).
pub fn residual_data(
    dataset: &Dataset,
    data: &Correspondences,
    calibration: &Calibration,
) -> Result<(ResidualData, Vec<PairResidualVectors>), RunError> {
    let before = epipolar_residuals(&Model::new(dataset.rig.clone()), data)?;
    let after = epipolar_residuals(&calibration.model, data)?;
    let per_match: Vec<PairResidualVectors> =
        before.into_iter().zip(after).map(|(before, after)| Some([before?, after?])).collect();
    let mut endpoints = Vec::new();
    let mut pairs = Vec::new();
    for (pair, residuals) in data.pairs.iter().zip(&per_match) {
        let Some([before, after]) = residuals else { continue };
        if pair.matches.is_empty() {
            continue;
        }
        for ((m, before), after) in pair.matches.iter().zip(before).zip(after) {
            endpoints.push(Endpoint { posture: pair.a, pixel: m.in_a, residuals_px: [before.in_a, after.in_a] });
            endpoints.push(Endpoint { posture: pair.b, pixel: m.in_b, residuals_px: [before.in_b, after.in_b] });
        }
        let median = |residuals: &[EpipolarResidual]| {
            let mut distances: Vec<f64> =
                residuals.iter().flat_map(|residual| [residual.in_a.norm(), residual.in_b.norm()]).collect();
            rounded(quantile(&mut distances, 0.5), 4)
        };
        let (median_before_px, median_after_px) = (median(before), median(after));
        let matches = pair.matches.len();
        pairs.push(PairResiduals { a: pair.a, b: pair.b, matches, median_before_px, median_after_px });
    }
    let camera = &dataset.rig.color;
    let reprojection =
        reprojection_residuals(&Model::new(dataset.rig.clone()), &calibration.model, data, calibration.noise.pixel)?;
    let (arrows, places): (_, Vec<Place>) = if reprojection.is_empty() {
        // A residual is what was seen less what should be: opposite to the vector to the line.
        (
            ResidualKind::Epipolar,
            endpoints
                .iter()
                .map(|endpoint| (endpoint.pixel, endpoint.residuals_px.map(|residual| -residual)))
                .collect(),
        )
    } else {
        (
            ResidualKind::Reprojection,
            reprojection
                .iter()
                .map(|observation| (observation.pixel, [observation.nominal, observation.calibrated]))
                .collect(),
        )
    };
    let (grid, cells) = cells(&places, camera.width, camera.height);
    let distances = if endpoints.is_empty() { arrows } else { ResidualKind::Epipolar };
    if endpoints.is_empty() {
        endpoints.extend(reprojection.iter().map(|observation| Endpoint {
            posture: observation.posture,
            pixel: observation.pixel,
            residuals_px: [observation.nominal, observation.calibrated],
        }));
    }
    let postures = postures(&endpoints, data.postures.len());
    Ok((ResidualData { distances, histogram: histogram(&endpoints), postures, pairs, grid, arrows, cells }, per_match))
}

fn histogram(endpoints: &[Endpoint]) -> Histogram {
    let bins = (DECADES.1 - DECADES.0) as usize * BINS_A_DECADE;
    let edge = |k: usize| 10f64.powf(f64::from(DECADES.0) + k as f64 / BINS_A_DECADE as f64);
    let bin = |distance: f64| {
        let place = (distance.max(1e-12).log10() - f64::from(DECADES.0)) * BINS_A_DECADE as f64;
        (place.max(0.0) as usize).min(bins - 1)
    };
    let mut counts = [vec![0; bins], vec![0; bins]];
    for endpoint in endpoints {
        for (counts, residual) in counts.iter_mut().zip(&endpoint.residuals_px) {
            counts[bin(residual.norm())] += 1;
        }
    }
    let [before, after] = counts;
    Histogram { edges_px: (0..=bins).map(|k| rounded(edge(k), 6)).collect(), before, after }
}

fn postures(endpoints: &[Endpoint], count: usize) -> Vec<PostureResiduals> {
    let mut distances = vec![[Vec::new(), Vec::new()]; count];
    for endpoint in endpoints {
        for (list, residual) in distances[endpoint.posture].iter_mut().zip(&endpoint.residuals_px) {
            list.push(residual.norm());
        }
    }
    let summed = |list: &mut Vec<f64>| ResidualQuantiles {
        median_px: rounded(quantile(list, 0.5), 4),
        p90_px: rounded(quantile(list, 0.9), 4),
    };
    distances
        .iter_mut()
        .map(|[before, after]| PostureResiduals {
            endpoints: before.len(),
            before: summed(before),
            after: summed(after),
        })
        .collect()
}

fn cells(places: &[Place], width: u32, height: u32) -> ([u32; 2], Vec<ImageCell>) {
    let edge = f64::from(width.max(height)) / f64::from(CELLS_ACROSS);
    let along = |pixels: u32| ((f64::from(pixels) / edge).round() as u32).max(1);
    let grid = [along(width), along(height)];
    let [columns, rows] = grid.map(|cells| cells as usize);
    let cell_size = [f64::from(width) / columns as f64, f64::from(height) / rows as f64];
    let mut members: Vec<Vec<&Place>> = vec![Vec::new(); columns * rows];
    for place in places {
        let cell =
            |position: f64, size: f64, cells: usize| (((position + 0.5) / size).max(0.0) as usize).min(cells - 1);
        let (column, row) = (cell(place.0.x, cell_size[0], columns), cell(place.0.y, cell_size[1], rows));
        members[row * columns + column].push(place);
    }
    let summed = |(at, members): (usize, &Vec<&Place>)| {
        let middle = |which: usize| {
            [0, 1].map(|axis| {
                let mut list: Vec<f64> = members.iter().map(|place| place.1[which][axis]).collect();
                rounded(quantile(&mut list, 0.5), 4)
            })
        };
        let center = |at: usize, size: f64| rounded((at as f64 + 0.5) * size - 0.5, 2);
        (members.len() >= MIN_RESIDUALS).then(|| ImageCell {
            center_px: [center(at % columns, cell_size[0]), center(at / columns, cell_size[1])],
            count: members.len(),
            before_px: middle(0),
            after_px: middle(1),
        })
    };
    (grid, members.iter().enumerate().filter_map(summed).collect())
}

/// The value below which a fraction of a list lies; 0 for an empty one.
fn quantile(values: &mut [f64], fraction: f64) -> f64 {
    let Some(last) = values.len().checked_sub(1) else { return 0.0 };
    let (_, value, _) = values.select_nth_unstable_by((fraction * last as f64).round() as usize, f64::total_cmp);
    *value
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint(posture: usize, pixel: (f64, f64), before: f64, after: f64) -> Endpoint {
        Endpoint {
            posture,
            pixel: Pixel::new(pixel.0, pixel.1),
            residuals_px: [Vector2::new(before, 0.0), Vector2::new(0.0, -after)],
        }
    }

    #[test]
    fn every_endpoint_is_counted_once() {
        let endpoints = [endpoint(0, (0.0, 0.0), 0.0, 1e9), endpoint(1, (0.0, 0.0), 1.05, 0.1005)];
        let found = histogram(&endpoints);
        assert_eq!(found.edges_px.len(), found.before.len() + 1);
        assert_eq!((found.before.iter().sum::<u64>(), found.after.iter().sum::<u64>()), (2, 2));
        assert_eq!((found.before[0], found.before[30], found.after[59], found.after[20]), (1, 1, 1, 1));
    }

    #[test]
    fn arrows_are_medians_over_their_cell() {
        let place = |x, y, before, after| (Pixel::new(x, y), [Vector2::new(before, 0.0), Vector2::new(0.0, after)]);
        let mut places: Vec<Place> = (0..9).map(|k| place(3.0, 2.0, f64::from(k), -0.5)).collect();
        places.push(place(1599.4, 899.4, 1.0, 1.0));
        let (grid, found) = cells(&places, 1600, 900);
        assert_eq!(grid, [16, 9]);
        let [cell] = found[..] else { panic!("{found:?}") };
        assert_eq!((cell.center_px, cell.count), ([49.5, 49.5], 9));
        assert_eq!((cell.before_px, cell.after_px), ([4.0, 0.0], [0.0, -0.5]));
    }

    #[test]
    fn postures_without_matches_are_there_with_none() {
        let found = postures(&[endpoint(1, (0.0, 0.0), 2.0, 1.0)], 3);
        assert_eq!((found[0].endpoints, found[1].endpoints, found[2].endpoints), (0, 1, 0));
        assert_eq!((found[1].before.median_px, found[1].after.p90_px), (2.0, 1.0));
    }
}
