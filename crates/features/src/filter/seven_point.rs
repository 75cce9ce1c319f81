//! The fundamental matrix from seven points exactly, and from eight and more by weighted least squares.
//!
//! Hartley and Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., 11.1 and 11.2; coordinates are
//! normalised (Hartley 1997) by the caller through [`Normalisation`].

use nalgebra::{Matrix3, Point2, SMatrix, SVD, SVector, SymmetricEigen};

/// Moves the centroid of points to the origin and their mean distance from it to the root of two.
#[derive(Debug, Clone, Copy)]
pub(super) struct Normalisation {
    centre: Point2<f64>,
    scale: f64,
}

impl Normalisation {
    pub(super) fn of(points: &[Point2<f64>]) -> Self {
        let count = points.len().max(1) as f64;
        let centre = Point2::from(points.iter().fold(nalgebra::Vector2::zeros(), |sum, p| sum + p.coords) / count);
        let mean_distance = points.iter().map(|p| (p - centre).norm()).sum::<f64>() / count;
        // Points that all coincide need no scale.
        let scale = if mean_distance > 1e-9 { std::f64::consts::SQRT_2 / mean_distance } else { 1.0 };
        Normalisation { centre, scale }
    }

    pub(super) fn apply(&self, point: &Point2<f64>) -> Point2<f64> {
        Point2::from((point - self.centre) * self.scale)
    }

    pub(super) fn matrix(&self) -> Matrix3<f64> {
        let (s, c) = (self.scale, self.centre);
        Matrix3::new(s, 0.0, -s * c.x, 0.0, s, -s * c.y, 0.0, 0.0, 1.0)
    }
}

/// The coefficients of the nine entries of F, by rows, in `in_a^T F in_b`.
fn equation(in_a: &Point2<f64>, in_b: &Point2<f64>) -> [f64; 9] {
    [in_a.x * in_b.x, in_a.x * in_b.y, in_a.x, in_a.y * in_b.x, in_a.y * in_b.y, in_a.y, in_b.x, in_b.y, 1.0]
}

/// Up to three singular matrices that satisfy seven correspondences.
///
/// Where the seven do not determine F up to a line (a plane, a pure rotation, points that coincide), some matrices of
/// the larger family come back: they fit the seven all the same.
pub(super) fn from_seven(in_a: &[Point2<f64>; 7], in_b: &[Point2<f64>; 7]) -> Vec<Matrix3<f64>> {
    let mut rows: [[f64; 9]; 7] = std::array::from_fn(|point| equation(&in_a[point], &in_b[point]));
    let [first, second] = null_vectors(&mut rows);
    let (first, second) = (Matrix3::from_row_slice(&first), Matrix3::from_row_slice(&second));
    // det(first + x second) = c0 + c1 x + c2 x^2 + c3 x^3, from its values at 1 and -1.
    let (c0, c3) = (first.determinant(), second.determinant());
    let (plus, minus) = ((first + second).determinant(), (first - second).determinant());
    let c2 = (plus + minus) / 2.0 - c0;
    let c1 = (plus - minus) / 2.0 - c3;
    let mut found: Vec<Matrix3<f64>> = real_roots(c0, c1, c2, c3).into_iter().map(|x| first + second * x).collect();
    if c3 == 0.0 {
        found.push(second);
    }
    found.retain(|matrix| matrix.iter().all(|value| value.is_finite()) && matrix.amax() > 0.0);
    found
}

/// Two independent vectors that all seven rows send to zero, by elimination with full pivoting.
fn null_vectors(rows: &mut [[f64; 9]; 7]) -> [[f64; 9]; 2] {
    let mut columns: [usize; 9] = std::array::from_fn(|column| column);
    let mut rank = 0;
    let largest = rows.iter().flatten().fold(0.0f64, |most, value| most.max(value.abs()));
    while rank < 7 {
        let (mut pivot, mut at) = (0.0f64, (rank, rank));
        for (row, values) in rows.iter().enumerate().skip(rank) {
            for (position, &column) in columns.iter().enumerate().skip(rank) {
                if values[column].abs() > pivot {
                    (pivot, at) = (values[column].abs(), (row, position));
                }
            }
        }
        if pivot <= 1e-12 * largest {
            break;
        }
        rows.swap(rank, at.0);
        columns.swap(rank, at.1);
        let column = columns[rank];
        let inverse = 1.0 / rows[rank][column];
        rows[rank].iter_mut().for_each(|value| *value *= inverse);
        let pivot_row = rows[rank];
        for (row, values) in rows.iter_mut().enumerate() {
            if row != rank {
                let factor = values[column];
                values.iter_mut().zip(&pivot_row).for_each(|(value, pivot)| *value -= factor * pivot);
            }
        }
        rank += 1;
    }
    // The last two columns are free in any case.
    [columns[7], columns[8]].map(|free| {
        let mut vector = [0.0; 9];
        vector[free] = 1.0;
        for (row, &column) in rows.iter().zip(&columns[..rank]) {
            vector[column] = -row[free];
        }
        let norm = vector.iter().map(|value| value * value).sum::<f64>().sqrt();
        vector.map(|value| value / norm)
    })
}

/// Real roots of `c0 + c1 x + c2 x^2 + c3 x^3`; of the zero polynomial, 0.
fn real_roots(c0: f64, c1: f64, c2: f64, c3: f64) -> Vec<f64> {
    let largest = [c0, c1, c2, c3].iter().fold(0.0f64, |most, c| most.max(c.abs()));
    if largest < 1e-300 {
        return vec![0.0];
    }
    if c3.abs() < 1e-14 * largest {
        if c2.abs() < 1e-14 * largest {
            return if c1.abs() < 1e-14 * largest { Vec::new() } else { vec![-c0 / c1] };
        }
        let discriminant = c1 * c1 - 4.0 * c2 * c0;
        if discriminant < 0.0 {
            return Vec::new();
        }
        // The larger root first, the other from the product: no cancellation.
        let q = -0.5 * (c1 + c1.signum() * discriminant.sqrt());
        return if q == 0.0 { vec![0.0] } else { vec![q / c2, c0 / q] };
    }
    let (a, b, c) = (c2 / c3, c1 / c3, c0 / c3);
    let q = (a * a - 3.0 * b) / 9.0;
    let r = (2.0 * a * a * a - 9.0 * a * b + 27.0 * c) / 54.0;
    let mut roots = if r * r < q * q * q {
        let theta = (r / (q * q * q).sqrt()).clamp(-1.0, 1.0).acos();
        let turn = std::f64::consts::TAU;
        [0.0, turn, -turn].map(|shift| -2.0 * q.sqrt() * ((theta + shift) / 3.0).cos() - a / 3.0).to_vec()
    } else {
        let s = -r.signum() * (r.abs() + (r * r - q * q * q).sqrt()).cbrt();
        vec![s + if s == 0.0 { 0.0 } else { q / s } - a / 3.0]
    };
    for root in &mut roots {
        for _ in 0..2 {
            let value = ((*root + a) * *root + b) * *root + c;
            let slope = (3.0 * *root + 2.0 * a) * *root + b;
            if slope != 0.0 && (value / slope).is_finite() {
                *root -= value / slope;
            }
        }
    }
    roots
}

/// The singular matrix nearest to the weighted least-squares solution, for eight correspondences and more.
///
/// `None` if the decompositions do not converge.
pub(super) fn from_many(pairs: impl Iterator<Item = (Point2<f64>, Point2<f64>, f64)>) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (in_a, in_b, weight) in pairs {
        let row = SVector::<f64, 9>::from(equation(&in_a, &in_b));
        normal.syger(weight, &row, &row, 1.0);
    }
    normal.fill_upper_triangle_with_lower_triangle();
    if !normal.iter().all(|value| value.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::try_new(normal, f64::EPSILON, 1000)?;
    let smallest = eigen.eigenvalues.imin();
    let full = Matrix3::from_row_slice(eigen.eigenvectors.column(smallest).as_slice());
    let mut svd = SVD::try_new(full, true, true, f64::EPSILON, 1000)?;
    let weakest = svd.singular_values.imin();
    svd.singular_values[weakest] = 0.0;
    svd.recompose().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn roots_are_roots(mut at in prop::array::uniform3(-5.0..5.0f64), lead in 0.1..3.0f64) {
            let [x, y, z] = at;
            let roots = real_roots(-lead * x * y * z, lead * (x * y + y * z + z * x), -lead * (x + y + z), lead);
            prop_assert!(!roots.is_empty());
            at.sort_by(f64::total_cmp);
            for root in roots {
                // A double root loses half of the digits.
                prop_assert!(at.iter().any(|x| (x - root).abs() < 1e-3), "{root} is not in {at:?}");
            }
        }
    }

    #[test]
    fn lower_degrees_and_nothing() {
        assert_eq!(real_roots(0.0, 0.0, 0.0, 0.0), [0.0]);
        assert_eq!(real_roots(1.0, 0.0, 0.0, 0.0), [0.0f64; 0]);
        assert_eq!(real_roots(-6.0, 2.0, 0.0, 0.0), [3.0]);
        assert_eq!(real_roots(2.0, -3.0, 1.0, 0.0), [2.0, 1.0]);
        assert_eq!(real_roots(1.0, 0.0, 1.0, 0.0), [0.0f64; 0]);
    }

    #[test]
    fn coincident_points_do_no_harm() {
        let same = [Point2::new(0.3, -0.2); 7];
        for matrix in from_seven(&same, &same) {
            let p = same[0].to_homogeneous();
            assert!(p.dot(&(matrix * p)).abs() < 1e-9);
        }
        assert!(from_many((0..8).map(|_| (same[0], same[0], 1.0))).is_some());
    }
}
