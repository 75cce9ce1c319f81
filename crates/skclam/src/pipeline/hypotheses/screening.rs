//! What a table of postures is worth, by rotations alone: cheap, so that every hypothesis can be compared with the
//! images.
//!
//! The camera turned by `A`, the flange by `B`, and `A = X^-1 B X` with the rotation `X` of the mount. Rotation vectors
//! then satisfy `a = X^-1 b` (Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group",
//! 1994), two of them determine `X`, and the best of many twos is refined on the half that it explains.

use super::pairs::FreePair;
use super::relative_pose::median;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use skclam_geometry::Isometry3;

/// Pairs from which twos are drawn.
const DRAWN: usize = 24;
/// Smaller rotations have no axis worth its name, and larger ones nearly two.
const USABLE_RAD: [f64; 2] = [0.07, 2.97];
/// Sine of the least angle between the axes of two.
const MIN_SINE: f64 = 0.3;

/// Median angle between the flange's rotations and the camera's, rad, with the mount's rotation that fits them
/// best.
pub(super) fn rotation_misfit_rad(pairs: &[FreePair], base_from_flange: &[Option<Isometry3>]) -> f64 {
    let rotations: Vec<(&[UnitQuaternion<f64>], UnitQuaternion<f64>)> = pairs
        .iter()
        .filter_map(|pair| {
            let (a, b) = (base_from_flange[pair.a]?, base_from_flange[pair.b]?);
            Some((&pair.rotation.candidates[..], a.rotation.inverse() * b.rotation))
        })
        .filter(|(candidates, _)| !candidates.is_empty())
        .collect();
    let misfits = |mount: &UnitQuaternion<f64>| -> Vec<f64> {
        rotations
            .iter()
            .map(|(camera, flange)| {
                let expected = mount.inverse() * flange * mount;
                camera.iter().map(|turn| turn.angle_to(&expected)).fold(f64::INFINITY, f64::min)
            })
            .collect()
    };
    let usable: Vec<(Vector3<f64>, Vector3<f64>)> = rotations
        .iter()
        .map(|(camera, flange)| (camera[0].scaled_axis(), flange.scaled_axis()))
        .filter(|(camera, flange)| {
            [camera, flange].iter().all(|turn| (USABLE_RAD[0]..USABLE_RAD[1]).contains(&turn.norm()))
        })
        .collect();
    let drawn: Vec<_> = usable.iter().step_by(usable.len().div_ceil(DRAWN).max(1)).collect();
    let mut best: Option<(f64, UnitQuaternion<f64>)> = None;
    let mut consider = |mount: UnitQuaternion<f64>| {
        let misfit = median(misfits(&mount));
        if best.is_none_or(|(least, _)| misfit < least) {
            best = Some((misfit, mount));
        }
        best
    };
    for (k, first) in drawn.iter().enumerate() {
        for second in &drawn[k + 1..] {
            let sine = |u: &Vector3<f64>, v: &Vector3<f64>| u.normalize().cross(&v.normalize()).norm();
            if sine(&first.0, &second.0).min(sine(&first.1, &second.1)) > MIN_SINE {
                consider(aligned([**first, **second].into_iter()));
            }
        }
    }
    let mut current = best;
    for _ in 0..2 {
        let Some((least, mount)) = current else { break };
        let close = usable.iter().filter(|(camera, flange)| (mount.inverse() * flange - camera).norm() <= 1.5 * least);
        let refined = aligned(close.copied());
        let misfit = median(misfits(&refined));
        if misfit < least {
            current = Some((misfit, refined));
        }
    }
    // Where all turn about one axis, the sizes of the rotations are all that can be compared.
    current.map_or_else(
        || {
            let sizes = rotations.iter().map(|(camera, flange)| camera[0].angle() - flange.angle());
            median(sizes.collect())
        },
        |(misfit, _)| misfit,
    )
}

/// The rotation `X` with `b = X a` for pairs of vectors `(a, b)`, least squares (Wahba's problem, by the singular value
/// decomposition).
fn aligned(rotations: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) -> UnitQuaternion<f64> {
    let profile: Matrix3<f64> = rotations.map(|(camera, flange)| flange * camera.transpose()).sum();
    let svd = profile.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return UnitQuaternion::identity() };
    let mut signs = Vector3::repeat(1.0);
    signs[svd.singular_values.imin()] = (u.determinant() * v_t.determinant()).signum();
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&signs) * v_t);
    UnitQuaternion::from_rotation_matrix(&rotation)
}
