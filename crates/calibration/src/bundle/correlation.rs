//! Observations of one image whose errors are alike count for less than their number.
//!
//! Neighbouring depths of a stereo camera come from overlapping windows, features of several scales lie on one corner, corners of one board share
//! its print: `n` observations with pairwise correlation `r` determine a smooth error no better than `n / (1 + (n - 1) r)` independent ones do (the design effect
//! of a cluster sample: Kish, "Survey Sampling", 1965, section 5.4). The correlation is measured as a function of the distance in the image, from what a fit
//! left; each observation is then weighted by the inverse of the sum of its correlations with all others of its image and kind, itself included. For
//! unknowns that change slowly over an image the inverse of the weighted normal matrix is their covariance. Sizes of single residuals, and with them
//! the loss and the noise, stay as they are.

use crate::bundle::noise::OUTLIER_SIGMAS;
use crate::bundle::observations::{Observation, Observations};
use crate::bundle::residuals::ResidualSize;
use nalgebra::Vector2;
use rayon::prelude::*;

/// Upper ends of the distances that share one correlation, in parts of the image's width.
const DISTANCES: [f64; 7] = [0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064];
const BINS: usize = DISTANCES.len();
/// Correlations of fewer pairs are not distinguished from chance.
const MIN_PAIRS: f64 = 200.0;
/// A correlation counts from so many of its standard errors on.
const SIGNIFICANT: f64 = 4.0;
/// Residuals that keep less of a degree of freedom show their point, and not their error.
const MIN_DOF: f64 = 0.3;

/// What is left of an observation, by its position in its list.
struct Rest {
    index: usize,
    place: Vector2<f64>,
    /// In sigmas; of depths the first component alone.
    size: Vector2<f64>,
    dof: f64,
}

/// Sums over the pairs of one distance.
#[derive(Clone, Copy, Default)]
struct Sums {
    product: f64,
    dof: f64,
    pairs: f64,
}

/// Weighs all observations by what their images have of them; `sizes`: of tracks, then of board corners.
pub(crate) fn weigh_by_correlation(observations: &mut Observations, sizes: &[ResidualSize], width_px: f64) {
    let postures = observations.postures;
    let (of_tracks, of_corners) = sizes.split_at(observations.observations.len());
    let list = &mut observations.observations;
    let pixels = weights(&grouped(list.iter(), of_tracks, postures, pixel_rest), list.len(), width_px);
    let depths = weights(&grouped(list.iter(), of_tracks, postures, depth_rest), list.len(), width_px);
    for (observation, (pixel, depth)) in list.iter_mut().zip(pixels.into_iter().zip(depths)) {
        (observation.pixel_weight, observation.depth_weight) = (pixel, depth);
    }
    if of_corners.len() == observations.corners.len() {
        let corners = observations.corners.iter().map(|corner| &corner.observation);
        let of_corners = grouped(corners, of_corners, postures, pixel_rest);
        let weights = weights(&of_corners, observations.corners.len(), width_px);
        observations.corners.iter_mut().zip(weights).for_each(|(c, weight)| c.observation.pixel_weight = weight);
    }
}

fn pixel_rest(observation: &Observation, size: &ResidualSize) -> Option<(Vector2<f64>, f64)> {
    let distance = size.residual_px.norm();
    let whole = size.pixel < OUTLIER_SIGMAS && distance > 0.0 && size.pixel_dof > 2.0 * MIN_DOF;
    (whole && observation.pixel.coords.iter().all(|x| x.is_finite()))
        .then(|| (size.residual_px * (size.pixel / distance), size.pixel_dof))
}

fn depth_rest(observation: &Observation, size: &ResidualSize) -> Option<(Vector2<f64>, f64)> {
    let (depth, dof) = size.depth.filter(|_| observation.depth_m > 0.0)?;
    (depth.abs() < OUTLIER_SIGMAS && dof > MIN_DOF).then(|| (Vector2::new(depth, 0.0), dof))
}

/// What is left, image by image.
fn grouped<'a>(
    observations: impl Iterator<Item = &'a Observation>,
    sizes: &[ResidualSize],
    postures: usize,
    rest: impl Fn(&Observation, &ResidualSize) -> Option<(Vector2<f64>, f64)>,
) -> Vec<Vec<Rest>> {
    let mut of_posture: Vec<Vec<Rest>> = (0..postures).map(|_| Vec::new()).collect();
    for (index, (observation, size)) in observations.zip(sizes).enumerate() {
        if let Some((size, dof)) = rest(observation, size) {
            of_posture[observation.posture as usize].push(Rest { index, place: observation.pixel.coords, size, dof });
        }
    }
    // By column, so that those near each other are found in a window of the list.
    of_posture.iter_mut().for_each(|list| list.sort_by(|a, b| a.place.x.total_cmp(&b.place.x)));
    of_posture
}

/// Calls `each` with the two positions of every pair that is near enough, and which of the distances it has.
fn for_each_pair(list: &[Rest], width_px: f64, mut each: impl FnMut(usize, usize, usize)) {
    let limits = DISTANCES.map(|part| (part * width_px).powi(2));
    let reach = DISTANCES[BINS - 1] * width_px;
    for (a, first) in list.iter().enumerate() {
        for (b, second) in list.iter().enumerate().skip(a + 1) {
            if second.place.x - first.place.x > reach {
                break;
            }
            let squared = (second.place - first.place).norm_squared();
            if let Some(bin) = limits.iter().position(|limit| squared <= *limit) {
                each(a, b, bin);
            }
        }
    }
}

/// The correlation at each distance, never growing with it; zero where chance explains it.
fn correlations(of_posture: &[Vec<Rest>], width_px: f64) -> [f64; BINS] {
    let of_image = |list: &Vec<Rest>| {
        let mut sums = [Sums::default(); BINS];
        for_each_pair(list, width_px, |a, b, bin| {
            let sum = &mut sums[bin];
            sum.product += list[a].size.dot(&list[b].size);
            sum.dof += (list[a].dof * list[b].dof).sqrt();
            sum.pairs += 1.0;
        });
        sums
    };
    let mut sums = [Sums::default(); BINS];
    for image in of_posture.par_iter().map(of_image).collect::<Vec<_>>() {
        for (sum, own) in sums.iter_mut().zip(image) {
            sum.product += own.product;
            sum.dof += own.dof;
            sum.pairs += own.pairs;
        }
    }
    let all = || of_posture.iter().flatten();
    let variance = all().map(|rest| rest.size.norm_squared()).sum::<f64>() / all().map(|rest| rest.dof).sum::<f64>();
    let mut found = [0.0; BINS];
    let mut nearer: Option<f64> = None;
    for (value, sum) in found.iter_mut().zip(&sums).filter(|(_, sum)| sum.pairs >= MIN_PAIRS) {
        let measured = sum.product / (sum.dof * variance);
        let known = measured > SIGNIFICANT / sum.pairs.sqrt();
        *value = if known { measured.min(nearer.unwrap_or(1.0)) } else { 0.0 };
        nearer = Some(*value);
    }
    // Pairs too near to be many are at least as much alike as the next ones.
    for bin in (0..BINS - 1).rev().filter(|&bin| sums[bin].pairs < MIN_PAIRS) {
        found[bin] = found[bin + 1];
    }
    found
}

/// One weight an observation; 1 for those that are judged by nothing.
fn weights(of_posture: &[Vec<Rest>], count: usize, width_px: f64) -> Vec<f64> {
    let correlation = correlations(of_posture, width_px);
    let mut weights = vec![1.0; count];
    if correlation == [0.0; BINS] {
        return weights;
    }
    let of_image = |list: &Vec<Rest>| {
        let mut effect = vec![1.0; list.len()];
        for_each_pair(list, width_px, |a, b, bin| {
            effect[a] += correlation[bin];
            effect[b] += correlation[bin];
        });
        effect
    };
    for (list, effect) in of_posture.iter().zip(of_posture.par_iter().map(of_image).collect::<Vec<_>>()) {
        list.iter().zip(effect).for_each(|(rest, effect)| weights[rest.index] = 1.0 / effect);
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{normal, seeded};

    /// Images whose observations come in groups of `together` at one place with errors of which `alike` of the variance is the group's.
    fn images(together: usize, alike: f64) -> Vec<Vec<Rest>> {
        let mut rng = seeded(5);
        (0..40)
            .map(|_| {
                let mut list = Vec::new();
                for place in 0..60 {
                    let (x, y) = (f64::from(place % 10) * 60.0, f64::from(place / 10) * 60.0);
                    let own = Vector2::new(normal(&mut rng), normal(&mut rng));
                    for k in 0..together {
                        let rest = Vector2::new(normal(&mut rng), normal(&mut rng));
                        let size = own * alike.sqrt() + rest * (1.0 - alike).sqrt();
                        let place = Vector2::new(x + 0.3 * k as f64, y);
                        list.push(Rest { index: list.len(), place, size, dof: 2.0 });
                    }
                }
                list
            })
            .collect()
    }

    #[test]
    fn errors_that_neighbours_share_weigh_less() {
        let images = images(5, 0.6);
        let weights = weights(&images, 300, 600.0);
        let mean = weights.iter().sum::<f64>() / 300.0;
        assert!((mean * (1.0 + 4.0 * 0.6) - 1.0).abs() < 0.1, "{mean}");
        // The variance of the mean of a group, as the weights have it, is the true one.
        let squares: f64 = images
            .iter()
            .flat_map(|list| list.chunks(5))
            .map(|group| (group.iter().map(|rest| rest.size.x).sum::<f64>() / 5.0).powi(2))
            .sum::<f64>()
            / (40.0 * 60.0);
        assert!((squares * 5.0 * mean - 1.0).abs() < 0.1, "{squares} {mean}");
    }

    #[test]
    fn independent_errors_keep_their_weight() {
        assert!(weights(&images(5, 0.0), 300, 600.0).iter().all(|weight| *weight > 0.97));
        assert!(weights(&[], 3, 600.0).iter().all(|weight| *weight == 1.0));
    }
}
