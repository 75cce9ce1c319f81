//! Match by match, how far a pixel is from its epipolar line, as a vector: what a plot of systematic
//! patterns needs and what the metrics of [`epipolar_statistics`](crate::epipolar_statistics) are made of.

use crate::camera_kinematics::CameraKinematics;
use crate::error_function::SMALLEST_BASELINE_M;
use crate::{CalibrationError, Correspondences, Model};
use nalgebra::Vector2;
use skclam_geometry::{EpipolarLine, FundamentalMatrix, Isometry3, Pixel};
use skclam_rig::Posture;

/// The residual of one match: from each pixel (free of distortion) the shortest vector to its epipolar line, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpipolarResidual {
    /// In the pair's first image.
    pub in_a: Vector2<f64>,
    /// In its second image.
    pub in_b: Vector2<f64>,
}

/// Residuals of all matches under a model, pair by pair in the order of [`Correspondences::pairs`], match by match. A
/// pair whose cameras are at one place has no epipolar geometry and gives `None`.
pub fn epipolar_residuals(
    model: &Model,
    data: &Correspondences,
) -> Result<Vec<Option<Vec<EpipolarResidual>>>, CalibrationError> {
    data.check()?;
    let poses = camera_poses(model, &data.postures)?;
    let camera = &model.rig.color;
    let of_pair = |a: usize, b: usize| {
        let a_from_b = poses[a].inverse() * poses[b];
        (a_from_b.translation.vector.norm() >= SMALLEST_BASELINE_M)
            .then(|| FundamentalMatrix::from_pose(camera, camera, &a_from_b))
    };
    let residuals = data.pairs.iter().map(|pair| {
        let fundamental = of_pair(pair.a, pair.b)?;
        let of_match = |in_a: &Pixel, in_b: &Pixel| EpipolarResidual {
            in_a: to_line(&fundamental.line_in_a(in_b), in_a),
            in_b: to_line(&fundamental.line_in_b(in_a), in_b),
        };
        Some(pair.matches.iter().map(|m| of_match(&camera.undistort(&m.in_a), &camera.undistort(&m.in_b))).collect())
    });
    Ok(residuals.collect())
}

/// `base_from_color` at every posture under a model, corrections of joint values included.
pub fn camera_poses(model: &Model, postures: &[Posture]) -> Result<Vec<Isometry3>, CalibrationError> {
    CameraKinematics::new(&model.rig, postures)?.poses(model, &[])
}

/// The shortest way from a pixel to a line; zero to the line at infinity.
fn to_line(line: &EpipolarLine, pixel: &Pixel) -> Vector2<f64> {
    let normal = line.0.xy();
    let squared = normal.norm_squared();
    if squared == 0.0 {
        return Vector2::zeros();
    }
    normal * (-(normal.dot(&pixel.coords) + line.0.z) / squared)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::epipolar_statistics;
    use crate::synthetic::{diverse_postures, fresh_pairs, half_pixel, hp3j, neighbours, seeded};

    #[test]
    fn the_statistics_are_those_of_the_residuals() {
        let truth = hp3j();
        let mut rng = seeded(3);
        let postures = diverse_postures(&truth, 24, &mut rng);
        let pairs = fresh_pairs(&truth, &postures, &neighbours(24), 20, half_pixel(), &mut rng);
        let data = Correspondences { postures, pairs, ..Default::default() };
        let model = Model::new(truth);
        let mut lengths: Vec<f64> = epipolar_residuals(&model, &data)
            .unwrap()
            .into_iter()
            .flatten()
            .flatten()
            .flat_map(|residual| [residual.in_a.norm(), residual.in_b.norm()])
            .collect();
        assert!(lengths.len() > 100, "{} residuals", lengths.len());
        let statistics = epipolar_statistics(&model, &data).unwrap();
        let rms = (lengths.iter().map(|d| d * d).sum::<f64>() / lengths.len() as f64).sqrt();
        assert!((rms - statistics.rms_px).abs() < 1e-9 * rms, "{rms} {}", statistics.rms_px);
        let median = crate::robust::median(&mut lengths);
        assert!((median - statistics.median_px).abs() < 1e-9, "{median} {}", statistics.median_px);
    }

    #[test]
    fn the_way_to_a_line_ends_on_it() {
        let line = EpipolarLine(nalgebra::Vector3::new(3.0, 4.0, -10.0));
        let pixel = Pixel::new(7.0, -2.0);
        let end = pixel + to_line(&line, &pixel);
        assert!(line.distance(&end) < 1e-12);
        assert!((to_line(&line, &pixel).norm() - line.distance(&pixel)).abs() < 1e-12);
        assert_eq!(to_line(&EpipolarLine(nalgebra::Vector3::new(0.0, 0.0, 1.0)), &pixel), Vector2::zeros());
    }
}
