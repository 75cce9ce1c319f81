//! Sampson distances of all matches and their normal equations by the free parameters.

use crate::camera_kinematics::CameraKinematics;
use crate::sampson::{Bearing, RelativePose, adjoint};
use crate::{CalibrationError, Loss, Model, PairMatches, Parameter};
use nalgebra::{DMatrix, DVector, SMatrix, SVector, Vector6};
use rayon::prelude::*;
use skclam_geometry::INTRINSICS;

/// Matches a task; small enough to share, large enough to pay.
const CHUNK: usize = 512;
/// Pair, first match, one past the last.
type Chunk = (usize, usize, usize);
/// Both ends of every match of a chunk.
type Bearings = Vec<(Bearing, Bearing)>;

const WITH_INTRINSICS: usize = 6 + INTRINSICS;

/// Weighted normal matrix and right-hand side (the negative gradient) by the parameters, and the sum of the losses.
pub(crate) struct Linearized {
    pub normal: DMatrix<f64>,
    pub rhs: DVector<f64>,
    pub cost: f64,
}

pub(crate) struct PairwiseSystem<'a> {
    pairs: &'a [PairMatches],
    motion: &'a CameraKinematics,
    parameters: &'a [Parameter],
    /// Pair and range of its matches, in order.
    chunks: Vec<Chunk>,
    intrinsics_free: bool,
    /// Directions under the camera that was there first; they hold for all models while intrinsics are not free.
    bearings: std::sync::OnceLock<Vec<Bearings>>,
}

impl<'a> PairwiseSystem<'a> {
    pub(crate) fn new(pairs: &'a [PairMatches], motion: &'a CameraKinematics, parameters: &'a [Parameter]) -> Self {
        let chunks = pairs.iter().enumerate().flat_map(|(pair, matches)| {
            let count = matches.matches.len();
            (0..count).step_by(CHUNK).map(move |from| (pair, from, (from + CHUNK).min(count)))
        });
        PairwiseSystem {
            pairs,
            motion,
            parameters,
            chunks: chunks.collect(),
            intrinsics_free: parameters.iter().any(|parameter| matches!(parameter, Parameter::Intrinsic(_))),
            bearings: std::sync::OnceLock::new(),
        }
    }

    fn look(&self, model: &Model) -> Vec<Bearings> {
        let camera = &model.rig.color;
        let look = |&(pair, from, to): &Chunk| -> Bearings {
            self.pairs[pair].matches[from..to]
                .iter()
                .map(|m| {
                    // A pixel that no direction reaches (beyond the fold of the distortion) has no gradient: distance
                    // 0.
                    let blind = Bearing::blind();
                    let bearing = |pixel| Bearing::new(camera, pixel, m.sigma_px).unwrap_or(blind);
                    (bearing(&m.in_a), bearing(&m.in_b))
                })
                .collect()
        };
        self.chunks.par_iter().map(look).collect()
    }

    fn with_bearings<T>(&self, model: &Model, use_them: impl FnOnce(&[Bearings]) -> T) -> T {
        if self.intrinsics_free {
            use_them(&self.look(model))
        } else {
            use_them(self.bearings.get_or_init(|| self.look(model)))
        }
    }

    fn relative_poses(&self, model: &Model) -> Result<Vec<RelativePose>, CalibrationError> {
        let poses = self.motion.poses(model, &[])?;
        Ok(self.pairs.iter().map(|pair| RelativePose::new(&(poses[pair.a].inverse() * poses[pair.b]))).collect())
    }

    /// Signed distances in px (in units of each match's own sigma), match by match in order.
    pub(crate) fn residuals(&self, model: &Model) -> Result<Vec<f64>, CalibrationError> {
        let relative = self.relative_poses(model)?;
        Ok(self.with_bearings(model, |bearings| {
            let of_chunk = |(&(pair, ..), bearings): (&Chunk, &Bearings)| -> Vec<f64> {
                bearings.iter().map(|(a, b)| relative[pair].distance(a, b)).collect()
            };
            self.chunks.par_iter().zip(bearings).map(of_chunk).collect::<Vec<_>>().concat()
        }))
    }

    /// Sum of the losses.
    pub(crate) fn cost(&self, model: &Model, loss: Loss, sigma: f64) -> Result<f64, CalibrationError> {
        let relative = self.relative_poses(model)?;
        Ok(self.with_bearings(model, |bearings| {
            let of_chunk = |(&(pair, ..), bearings): (&Chunk, &Bearings)| -> f64 {
                bearings.iter().map(|(a, b)| loss.rho(relative[pair].distance(a, b) / sigma)).sum()
            };
            // Collected before it is summed: the order does not depend on the threads.
            self.chunks.par_iter().zip(bearings).map(of_chunk).collect::<Vec<_>>().iter().sum()
        }))
    }

    /// Normal equations by the parameters, and the cost.
    pub(crate) fn linearize(&self, model: &Model, loss: Loss, sigma: f64) -> Result<Linearized, CalibrationError> {
        let cameras = (0..self.motion.len())
            .map(|posture| self.motion.linearize(model, self.parameters, posture, &[]))
            .collect::<Result<Vec<_>, _>>()?;
        let a_from_b: Vec<_> = self
            .pairs
            .iter()
            .map(|pair| cameras[pair.a].base_from_camera.inverse() * cameras[pair.b].base_from_camera)
            .collect();
        let relative: Vec<_> = a_from_b.iter().map(RelativePose::new).collect();
        let count = self.parameters.len();
        let mut normal = DMatrix::zeros(count, count);
        let mut rhs = DVector::zeros(count);
        // Columns of the relative twist, and below them those of the intrinsics.
        let columns = |pair: usize| {
            let (a, b) = (self.pairs[pair].a, self.pairs[pair].b);
            let mut columns = DMatrix::<f64>::zeros(WITH_INTRINSICS, count);
            for (k, parameter) in self.parameters.iter().enumerate() {
                let twist = adjoint(&a_from_b[pair], &cameras[b].by_parameter[k]) - cameras[a].by_parameter[k];
                columns.fixed_view_mut::<6, 1>(0, k).copy_from(&twist);
                if let Parameter::Intrinsic(intrinsic) = parameter {
                    columns[(6 + *intrinsic as usize, k)] = 1.0;
                }
            }
            columns
        };
        let partial = self.with_bearings(model, |bearings| {
            let of_chunk = |(&(pair, ..), bearings): (&Chunk, &Bearings)| {
                if self.intrinsics_free {
                    self.chunk_with_intrinsics(model, &relative[pair], bearings, loss, sigma)
                } else {
                    let (h, g, cost) = chunk(&relative[pair], bearings, loss, sigma);
                    let mut wide = SMatrix::<f64, WITH_INTRINSICS, WITH_INTRINSICS>::zeros();
                    wide.fixed_view_mut::<6, 6>(0, 0).copy_from(&h);
                    let mut tall = SVector::<f64, WITH_INTRINSICS>::zeros();
                    tall.fixed_rows_mut::<6>(0).copy_from(&g);
                    (wide, tall, cost)
                }
            };
            self.chunks.par_iter().zip(bearings).map(of_chunk).collect::<Vec<_>>()
        });
        let mut of_pair =
            vec![
                (SMatrix::<f64, WITH_INTRINSICS, WITH_INTRINSICS>::zeros(), SVector::<f64, WITH_INTRINSICS>::zeros());
                self.pairs.len()
            ];
        let mut cost = 0.0;
        for (&(pair, ..), (h, g, part)) in self.chunks.iter().zip(&partial) {
            of_pair[pair].0 += h;
            of_pair[pair].1 += g;
            cost += part;
        }
        for (pair, (h, g)) in of_pair.iter().enumerate() {
            let columns = columns(pair);
            normal += columns.transpose() * (h * &columns);
            rhs += columns.transpose() * g;
        }
        Ok(Linearized { normal, rhs, cost })
    }

    fn chunk_with_intrinsics(
        &self,
        model: &Model,
        relative: &RelativePose,
        bearings: &[(Bearing, Bearing)],
        loss: Loss,
        sigma: f64,
    ) -> (SMatrix<f64, WITH_INTRINSICS, WITH_INTRINSICS>, SVector<f64, WITH_INTRINSICS>, f64) {
        let mut cost = 0.0;
        let mut normal = SMatrix::<f64, WITH_INTRINSICS, WITH_INTRINSICS>::zeros();
        let mut rhs = SVector::<f64, WITH_INTRINSICS>::zeros();
        for (a, b) in bearings {
            let distance = relative.differentiate(a, b);
            let by_intrinsics = relative.by_intrinsics(&model.rig.color, a, b);
            let weight = loss.weight(distance.value / sigma) / (sigma * sigma);
            cost += loss.rho(distance.value / sigma);
            let mut row = SVector::<f64, WITH_INTRINSICS>::zeros();
            row.fixed_rows_mut::<6>(0).copy_from(&distance.by_twist);
            row.fixed_rows_mut::<INTRINSICS>(6).copy_from(&by_intrinsics);
            normal.syger(weight, &row, &row, 1.0);
            rhs.axpy(-weight * distance.value, &row, 1.0);
        }
        normal.fill_upper_triangle_with_lower_triangle();
        (normal, rhs, cost)
    }
}

/// Normal equations and cost of one pair's matches by its relative twist.
fn chunk(
    relative: &RelativePose,
    bearings: &[(Bearing, Bearing)],
    loss: Loss,
    sigma: f64,
) -> (SMatrix<f64, 6, 6>, Vector6<f64>, f64) {
    let mut cost = 0.0;
    let mut normal = SMatrix::<f64, 6, 6>::zeros();
    let mut rhs = Vector6::zeros();
    let inverse_variance = 1.0 / (sigma * sigma);
    for (a, b) in bearings {
        let distance = relative.differentiate(a, b);
        let weight = loss.weight(distance.value / sigma) * inverse_variance;
        cost += loss.rho(distance.value / sigma);
        let weighted = distance.by_twist * weight;
        // The lower triangle says it all.
        for (column, sums) in normal.data.0.iter_mut().enumerate() {
            for row in column..6 {
                sums[row] += weighted[row] * distance.by_twist[column];
            }
        }
        rhs -= weighted * distance.value;
    }
    normal.fill_upper_triangle_with_lower_triangle();
    (normal, rhs, cost)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{
        diverse_postures, fresh_pairs, half_pixel, hp3j, manufacture, neighbours, perturbed, seeded,
    };
    use crate::{Correspondences, Free};

    #[test]
    fn the_gradient_agrees_with_differences() {
        let nominal = hp3j();
        let mut rng = seeded(9);
        let truth = perturbed(&nominal, &Free::Auto, manufacture(), &mut rng);
        let postures = diverse_postures(&nominal, 8, &mut rng);
        let pairs = fresh_pairs(&truth, &postures, &neighbours(8), 12, half_pixel(), &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let motion = CameraKinematics::new(&nominal, &data.postures).unwrap();
        let parameters = Free::parse("arm,mount,gears,compliance", &nominal).unwrap();
        let parameters = parameters.candidates(&nominal, true, false).unwrap();
        let system = PairwiseSystem::new(&data.pairs, &motion, &parameters);
        let model = Model::new(nominal);
        for loss in [Loss::Squared, Loss::Cauchy(1.5)] {
            let sigma = 5.0;
            let Linearized { rhs, cost, .. } = system.linearize(&model, loss, sigma).unwrap();
            assert!((cost / system.cost(&model, loss, sigma).unwrap() - 1.0).abs() < 1e-12);
            for (k, &parameter) in parameters.iter().enumerate() {
                let step = 1e-6;
                let at = |s: f64| system.cost(&model.stepped(&[parameter], &[s]).unwrap(), loss, sigma).unwrap();
                let slope = (at(step) - at(-step)) / (2.0 * step);
                assert!((slope + rhs[k]).abs() < 1e-4 * (1.0 + rhs.amax()), "{parameter}: {slope} {}", rhs[k]);
            }
        }
    }
}
