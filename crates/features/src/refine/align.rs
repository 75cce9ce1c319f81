//! Aligning one patch: Lucas and Kanade's method in its inverse compositional form, blind to gain and bias.
//!
//! The template `T(x)` is cut from image A, `x` counted in samples from its centre. Sought is the warp
//! `W(x) = p + M x` into image B for which `B(W(x))` is a gain times `T(x)` plus a bias. In each step
//! `T(x + d + D x) ~ gain B(W(x)) + bias` is solved for `d` and `D`, and the inverse of that change is put in front of
//! `W` (Baker and Matthews 2004). The derivatives of `T` are made orthogonal to a constant and to `T` itself, once:
//! then neither gain nor bias can enter the solution, and the normal matrix never changes.
//!
//! `W` may have a part of second order, `W(x) = p + M x + q(x)`, which is given and stays as it is: at rest `d` and `D`
//! vanish, and what `q` is then decides where that is.

use super::pyramid::{Cubic, Level};
use multiversion::multiversion;
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Parameters: a shift and four of the linear part.
const PARAMETERS: usize = 6;
/// Values that are summed side by side; lists are padded to a multiple.
const WIDTH: usize = 8;
/// Damping of the linear part against the shift, as a fraction of its own curvature.
const LINEAR_DAMPING: f64 = 0.02;

/// A patch of image A and all that is computed of it once.
#[derive(Debug, Clone)]
pub(super) struct Template {
    count: usize,
    /// Grey values less their weighted mean.
    centred: Vec<f32>,
    mean: f32,
    /// Weighted sum of squares of the centred values, and of the weights.
    energy: f64,
    weights_sum: f64,
    /// The mean of the weights with themselves as weights. Weights that are not inverse variances make the inverse of
    /// the normal matrix too large a covariance, by this factor where derivatives are spread evenly.
    weights_mean: f64,
    weights: Vec<f32>,
    /// Weighted derivatives, orthogonal to a constant and to the patch.
    derivatives: [Vec<f32>; PARAMETERS],
    /// Sums of products of the derivatives.
    normal: SMatrix<f64, PARAMETERS, PARAMETERS>,
    /// Zero-mean normalised correlation at the last step.
    correlation: f64,
    /// Patches being compared, and one with a margin for differences.
    other: Vec<f32>,
    margin: Vec<f32>,
}

/// Where the patch is in image B, in pixels of its level.
#[derive(Debug, Clone, Copy)]
pub(super) struct Warp {
    pub(super) centre: Vector2<f64>,
    /// Pixels of the level in B for one sample of the template.
    pub(super) linear: Matrix2<f64>,
    /// The part of second order: for each axis the factors of uu, uv and vv, pixels of the level for squared samples.
    pub(super) bend: [[f32; 3]; 2],
    /// How image B is interpolated.
    pub(super) cubic: Cubic,
}

/// How well a warp fits.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    /// Zero-mean normalised correlation.
    pub(super) correlation: f64,
    /// Covariance of the centre, in squared pixels of the level, if the noise of the samples were white.
    pub(super) covariance: Matrix2<f64>,
}

/// Which parameters a step may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum WarpDof {
    /// The centre.
    Shift,
    /// The centre and the linear part.
    Affine,
}

impl Template {
    /// Buffers for patches of `count` samples a side, an odd number.
    pub(super) fn new(count: usize) -> Self {
        let half = (count / 2) as f32;
        // A Gaussian that falls to a tenth at the corners: what is far from the centre moves the centre less.
        let sigma = half.max(1.0) * 0.93;
        // Padded with weights of zero to full vectors.
        let length = (count * count).next_multiple_of(WIDTH);
        let weights: Vec<f32> = (0..length)
            .map(|at| {
                if at >= count * count {
                    return 0.0;
                }
                let (u, v) = ((at % count) as f32 - half, (at / count) as f32 - half);
                (-(u * u + v * v) / (2.0 * sigma * sigma)).exp()
            })
            .collect();
        let weights_sum: f64 = weights.iter().map(|&weight| f64::from(weight)).sum();
        Template {
            count,
            centred: vec![0.0; length],
            mean: 0.0,
            energy: 0.0,
            weights_sum,
            weights_mean: weights.iter().map(|&weight| f64::from(weight).powi(2)).sum::<f64>() / weights_sum,
            weights,
            derivatives: std::array::from_fn(|_| vec![0.0; length]),
            normal: SMatrix::zeros(),
            correlation: 0.0,
            other: vec![0.0; length],
            margin: vec![0.0; (count + 2) * (count + 2)],
        }
    }

    /// Standard deviation of the grey values, weighted.
    pub(super) fn contrast(&self) -> f64 {
        (self.energy / self.weights_sum).sqrt()
    }

    /// Cuts the template; false if it does not lie in the image.
    pub(super) fn cut(&mut self, level: &Level, centre: [f64; 2], cubic: &Cubic) -> bool {
        let step = [[1.0, 0.0], [0.0, 1.0]];
        let straight = [[0.0; 3]; 2];
        if !level.holds(centre, step, straight, self.count + 2) {
            return false;
        }
        level.sample(centre, step, straight, cubic, self.count + 2, &mut self.margin);
        differentiate(self);
        true
    }

    /// Improves the warp by one step; `None` if the patch has left the image or has no structure.
    ///
    /// Returns by how much the centre moved, px of the level.
    pub(super) fn step(&mut self, level: &Level, warp: &mut Warp, dof: WarpDof) -> Option<f64> {
        let Look { gain, correlation } = self.look(level, warp)?;
        self.correlation = correlation;
        let right = right_side(&self.derivatives, &self.other, self.mean);
        let right = SVector::<f64, PARAMETERS>::from(right.map(|sum| gain * f64::from(sum)));
        let (shift, linear) = match dof {
            WarpDof::Shift => {
                let shift = self.normal.fixed_view::<2, 2>(0, 0).try_inverse()? * right.fixed_rows::<2>(0);
                (shift, Matrix2::zeros())
            }
            WarpDof::Affine => {
                let mut normal = self.normal;
                for diagonal in 2..PARAMETERS {
                    normal[(diagonal, diagonal)] *= 1.0 + LINEAR_DAMPING;
                }
                let change = normal.cholesky()?.solve(&right);
                (Vector2::new(change[0], change[1]), Matrix2::new(change[2], change[3], change[4], change[5]))
            }
        };
        let linear = warp.linear * (Matrix2::identity() + linear).try_inverse()?;
        let moved = linear * shift;
        if !(moved.x.is_finite() && moved.y.is_finite() && linear.iter().all(|value| value.is_finite())) {
            return None;
        }
        warp.linear = linear;
        warp.centre -= moved;
        Some(moved.norm())
    }

    /// How well the warp fits, by the patch that the last step saw: where that moved little, it is as good as the one
    /// where it went to.
    pub(super) fn fit(&self, warp: &Warp, dof: WarpDof) -> Option<Fit> {
        let correlation = self.correlation;
        // What gain and bias leave: both patches have noise, hence the factor two of a small disagreement.
        let noise = 2.0 * (1.0 - correlation).max(1e-6) * self.energy / self.weights_sum * self.weights_mean;
        let shift = match dof {
            WarpDof::Shift => self.normal.fixed_view::<2, 2>(0, 0).try_inverse()?,
            WarpDof::Affine => self.normal.cholesky()?.inverse().fixed_view::<2, 2>(0, 0).into_owned(),
        };
        let covariance = warp.linear * (shift * noise) * warp.linear.transpose();
        covariance.iter().all(|value| value.is_finite()).then_some(Fit { correlation, covariance })
    }

    /// Samples image B at the warp.
    fn look(&mut self, level: &Level, warp: &Warp) -> Option<Look> {
        let step = [[warp.linear.m11 as f32, warp.linear.m12 as f32], [warp.linear.m21 as f32, warp.linear.m22 as f32]];
        let centre = [warp.centre.x, warp.centre.y];
        if !level.holds(centre, step, warp.bend, self.count) {
            return None;
        }
        level.sample(centre, step, warp.bend, &warp.cubic, self.count, &mut self.other);
        let [sum, squares, products] = moments(&self.other, &self.centred, &self.weights, self.mean);
        let energy = squares - sum * sum / self.weights_sum;
        if !(energy > 0.0 && self.energy > 0.0) {
            return None;
        }
        // The centred template has no part in a constant, so the other's mean does not enter the products.
        Some(Look { gain: (self.energy / energy).sqrt(), correlation: products / (self.energy * energy).sqrt() })
    }
}

/// The other patch beside the template.
struct Look {
    gain: f64,
    correlation: f64,
}

/// Takes the mean off the other patch's values (that of the template) and sums, weighted: it, its square, its product
/// with the template.
#[multiversion(targets("x86_64+avx2+fma"))]
fn moments(other: &[f32], template: &[f32], weights: &[f32], mean: f32) -> [f64; 3] {
    let mut sums = [[0.0f32; WIDTH]; 3];
    let (template, weights) = (template.as_chunks::<WIDTH>().0, weights.as_chunks::<WIDTH>().0);
    let chunks = other.as_chunks::<WIDTH>().0.iter().zip(template).zip(weights);
    for ((other, template), weights) in chunks {
        for lane in 0..WIDTH {
            let value = other[lane] - mean;
            let weighted = weights[lane] * value;
            sums[0][lane] += weighted;
            sums[1][lane] += weighted * value;
            sums[2][lane] += weighted * template[lane];
        }
    }
    sums.map(|lanes| lanes.iter().map(|&lane| f64::from(lane)).sum())
}

/// Products of the derivatives with the other patch.
#[multiversion(targets("x86_64+avx2+fma"))]
fn right_side(derivatives: &[Vec<f32>; PARAMETERS], other: &[f32], offset: f32) -> [f32; PARAMETERS] {
    let mut all = [0.0; PARAMETERS];
    for (sum, derivative) in all.iter_mut().zip(derivatives) {
        let mut lanes = [0.0f32; WIDTH];
        for (derivative, other) in derivative.as_chunks::<WIDTH>().0.iter().zip(other.as_chunks::<WIDTH>().0) {
            for lane in 0..WIDTH {
                lanes[lane] += derivative[lane] * (other[lane] - offset);
            }
        }
        *sum = lanes.iter().sum();
    }
    all
}

/// Everything that follows from the patch with a margin.
#[multiversion(targets("x86_64+avx2+fma"))]
fn differentiate(template: &mut Template) {
    let count = template.count;
    let wide = count + 2;
    let half = (count / 2) as f32;
    let mut mean = 0.0;
    template.centred[count * count..].fill(0.0);
    for v in 0..count {
        for u in 0..count {
            let at = v * count + u;
            let centre = (v + 1) * wide + u + 1;
            template.centred[at] = template.margin[centre];
            mean += template.weights[at] * template.margin[centre];
            let dx = 0.5 * (template.margin[centre + 1] - template.margin[centre - 1]);
            let dy = 0.5 * (template.margin[centre + wide] - template.margin[centre - wide]);
            let (x, y) = (u as f32 - half, v as f32 - half);
            // d/dd and d/dD of T(x + d + D x).
            let all = [dx, dy, dx * x, dx * y, dy * x, dy * y];
            for (derivative, value) in template.derivatives.iter_mut().zip(all) {
                derivative[at] = value;
            }
        }
    }
    let weights_sum = template.weights_sum as f32;
    template.mean = mean / weights_sum;
    let weights = &template.weights;
    let mut energy = 0.0;
    for (value, weight) in template.centred.iter_mut().zip(weights) {
        *value -= template.mean;
        energy += weight * *value * *value;
    }
    template.energy = f64::from(energy);
    let inverse_energy = if energy > 0.0 { 1.0 / energy } else { 0.0 };
    for derivative in &mut template.derivatives {
        let (mut constant, mut along) = (0.0, 0.0);
        for ((d, w), t) in derivative.iter().zip(weights).zip(&template.centred) {
            constant += w * d;
            along += w * d * t;
        }
        let (constant, along) = (constant / weights_sum, along * inverse_energy);
        for (d, t) in derivative.iter_mut().zip(&template.centred) {
            *d -= constant + along * t;
        }
    }
    for row in 0..PARAMETERS {
        for column in row..PARAMETERS {
            let mut lanes = [0.0f32; WIDTH];
            let first = template.derivatives[row].as_chunks::<WIDTH>().0;
            let second = template.derivatives[column].as_chunks::<WIDTH>().0;
            for ((first, second), weights) in first.iter().zip(second).zip(weights.as_chunks::<WIDTH>().0) {
                for lane in 0..WIDTH {
                    lanes[lane] += weights[lane] * first[lane] * second[lane];
                }
            }
            let sum = f64::from(lanes.iter().sum::<f32>());
            template.normal[(row, column)] = sum;
            template.normal[(column, row)] = sum;
        }
    }
    for derivative in &mut template.derivatives {
        for (d, w) in derivative.iter_mut().zip(weights) {
            *d *= w;
        }
    }
}
