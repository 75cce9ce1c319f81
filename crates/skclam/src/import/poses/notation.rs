//! How controllers write a pose: `base_from_flange` as six, seven or sixteen numbers.
//!
//! | maker | numbers | rotation |
//! | --- | --- | --- |
//! | KUKA | X Y Z A B C | `Rz(A) Ry(B) Rx(C)` |
//! | Fanuc | X Y Z W P R | `Rz(R) Ry(P) Rx(W)` |
//! | Yaskawa | X Y Z Rx Ry Rz | `Rz(Rz) Ry(Ry) Rx(Rx)` |
//! | Staubli | X Y Z Rx Ry Rz | `Rx(Rx) Ry(Ry) Rz(Rz)` |
//! | Universal Robots | X Y Z Rx Ry Rz | axis times angle |
//! | ABB | X Y Z q1 q2 q3 q4 | quaternion, the real part first |
//! | matrix | m11 ... m34 | three or four rows of four |

use nalgebra::{Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;

/// A maker's notation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseNotation {
    /// X Y Z A B C: turns about z, the new y, the newest x.
    Kuka,
    /// X Y Z W P R: turns about the fixed x, y, z.
    Fanuc,
    /// X Y Z q1 q2 q3 q4: a quaternion whose real part is first.
    Abb,
    /// X Y Z Rx Ry Rz: the axis of rotation, as long as the angle; metres and radians unless said otherwise.
    Ur,
    /// X Y Z Rx Ry Rz: turns about x, the new y, the newest z.
    Staubli,
    /// X Y Z Rx Ry Rz: turns about the fixed x, y, z.
    Yaskawa,
    /// m11 to m34, row by row; a fourth row may follow.
    Matrix,
}

/// What a notation's rotation is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum RotationPart {
    Angles([&'static str; 3]),
    RotationVector([&'static str; 3]),
    Quaternion([&'static str; 4]),
    Matrix,
}

impl PoseNotation {
    pub(super) fn rotation_part(self) -> RotationPart {
        match self {
            PoseNotation::Kuka => RotationPart::Angles(["a", "b", "c"]),
            PoseNotation::Fanuc => RotationPart::Angles(["w", "p", "r"]),
            PoseNotation::Staubli | PoseNotation::Yaskawa => RotationPart::Angles(["rx", "ry", "rz"]),
            PoseNotation::Ur => RotationPart::RotationVector(["rx", "ry", "rz"]),
            PoseNotation::Abb => RotationPart::Quaternion(["q1", "q2", "q3", "q4"]),
            PoseNotation::Matrix => RotationPart::Matrix,
        }
    }

    /// Metres a unit of length where the table does not say; `None`: it has to.
    pub(super) fn usual_length_m(self) -> Option<f64> {
        match self {
            PoseNotation::Matrix => None,
            PoseNotation::Ur => Some(1.0),
            _ => Some(1e-3),
        }
    }

    /// Radians a unit of angle where the table does not say.
    pub(super) fn usual_angle(self) -> f64 {
        if self == PoseNotation::Ur { 1.0 } else { 1f64.to_radians() }
    }

    /// The pose of a place (metres) and three angles (radians), four numbers of a quaternion, or nine of a matrix.
    ///
    /// # Errors
    /// What is wrong with the numbers, in words.
    pub fn pose(self, place: [f64; 3], rotation: &[f64]) -> Result<Isometry3, String> {
        let about = |axis: Vector3<f64>, angle: f64| UnitQuaternion::from_scaled_axis(axis * angle);
        let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
        let turn = match (self, rotation) {
            (PoseNotation::Kuka, &[a, b, c]) => about(z, a) * about(y, b) * about(x, c),
            (PoseNotation::Fanuc | PoseNotation::Yaskawa, &[rx, ry, rz]) => about(z, rz) * about(y, ry) * about(x, rx),
            (PoseNotation::Staubli, &[rx, ry, rz]) => about(x, rx) * about(y, ry) * about(z, rz),
            (PoseNotation::Ur, &[rx, ry, rz]) => UnitQuaternion::from_scaled_axis(Vector3::new(rx, ry, rz)),
            (PoseNotation::Abb, &[q1, q2, q3, q4]) => {
                let quaternion = Quaternion::new(q1, q2, q3, q4);
                let norm = quaternion.norm();
                if (norm - 1.0).abs() > 1e-2 {
                    return Err(format!("the quaternion has the length {norm:.4}; 1 is expected"));
                }
                UnitQuaternion::from_quaternion(quaternion)
            }
            (PoseNotation::Matrix, numbers) => rotation_of(numbers)?,
            (_, numbers) => return Err(format!("{} numbers of a rotation", numbers.len())),
        };
        Ok(Isometry3::from_parts(Translation3::from(place), turn))
    }

    /// Place (metres) and rotation (radians, or the numbers of a quaternion or a matrix) as the maker writes them.
    pub fn numbers(self, pose: &Isometry3) -> ([f64; 3], Vec<f64>) {
        let rotation = pose.rotation.to_rotation_matrix();
        let numbers = match self {
            PoseNotation::Kuka => {
                let (c, b, a) = rotation.euler_angles();
                vec![a, b, c]
            }
            PoseNotation::Fanuc | PoseNotation::Yaskawa => {
                let (rx, ry, rz) = rotation.euler_angles();
                vec![rx, ry, rz]
            }
            PoseNotation::Staubli => {
                // Rx Ry Rz is the inverse of Rz(-rz) Ry(-ry) Rx(-rx).
                let (rx, ry, rz) = rotation.inverse().euler_angles();
                vec![-rx, -ry, -rz]
            }
            PoseNotation::Ur => pose.rotation.scaled_axis().iter().copied().collect(),
            PoseNotation::Abb => {
                let q = pose.rotation.coords;
                vec![q.w, q.x, q.y, q.z]
            }
            PoseNotation::Matrix => rotation.matrix().transpose().iter().copied().collect(),
        };
        (pose.translation.vector.into(), numbers)
    }
}

/// The rotation of nine numbers, row by row.
fn rotation_of(numbers: &[f64]) -> Result<UnitQuaternion<f64>, String> {
    const MAX_OFF: f64 = 1e-2;
    if numbers.len() != 9 {
        return Err(format!("{} numbers of a rotation matrix; 9 are expected", numbers.len()));
    }
    let matrix = Matrix3::from_row_slice(numbers);
    let off = (matrix.transpose() * matrix - Matrix3::identity()).norm();
    if off > MAX_OFF {
        return Err(format!("the matrix is no rotation: its columns are {off:.3} off unit length or right angles"));
    }
    if matrix.determinant() < 0.0 {
        return Err("the matrix is a reflection (determinant -1); an axis has the wrong sign".to_owned());
    }
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_eps(&matrix, 1e-15, 100, Rotation3::identity())))
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: [PoseNotation; 7] = [
        PoseNotation::Kuka,
        PoseNotation::Fanuc,
        PoseNotation::Abb,
        PoseNotation::Ur,
        PoseNotation::Staubli,
        PoseNotation::Yaskawa,
        PoseNotation::Matrix,
    ];

    #[test]
    fn every_notation_comes_back() {
        for step in 0..50 {
            let k = f64::from(step);
            let turn =
                UnitQuaternion::from_scaled_axis(Vector3::new((1.3 * k).sin(), (0.7 * k).cos(), (2.1 * k).sin()) * 1.7);
            let pose = Isometry3::from_parts(Translation3::new(0.1 * k, -0.3, 0.5), turn);
            for notation in ALL {
                let (place, numbers) = notation.numbers(&pose);
                let off = notation.pose(place, &numbers).unwrap().inverse() * pose;
                assert!(off.translation.vector.norm() < 1e-12 && off.rotation.angle() < 1e-7, "{notation:?}: {off}");
            }
        }
    }

    #[test]
    fn rotations_are_those_of_the_manuals() {
        let quarter = std::f64::consts::FRAC_PI_2;
        let image = |notation: PoseNotation, numbers: &[f64]| {
            let turned = notation.pose([0.0; 3], numbers).unwrap().rotation * Vector3::x();
            turned.map(f64::round)
        };
        // KUKA: A about z first, then B about the new y: x goes to y and stays there in y.
        assert_eq!(image(PoseNotation::Kuka, &[quarter, quarter, 0.0]), -Vector3::z());
        // Fanuc: W about x, P about the fixed y, R about the fixed z.
        assert_eq!(image(PoseNotation::Fanuc, &[0.0, quarter, quarter]), -Vector3::z());
        // Staubli: x, the new y, the newest z.
        assert_eq!(image(PoseNotation::Staubli, &[quarter, 0.0, quarter]), Vector3::z());
        assert_eq!(image(PoseNotation::Yaskawa, &[quarter, 0.0, quarter]), Vector3::y());
        assert_eq!(image(PoseNotation::Ur, &[0.0, 0.0, quarter]), Vector3::y());
        let half = 0.5f64.sqrt();
        assert_eq!(image(PoseNotation::Abb, &[half, 0.0, 0.0, half]), Vector3::y());
        assert_eq!(image(PoseNotation::Matrix, &[0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]), Vector3::y());
    }

    #[test]
    fn numbers_that_are_no_rotation_are_refused() {
        let wrong = |notation: PoseNotation, numbers: &[f64]| notation.pose([0.0; 3], numbers).unwrap_err();
        assert!(wrong(PoseNotation::Abb, &[1.0, 1.0, 0.0, 0.0]).contains("1.4142"));
        assert!(wrong(PoseNotation::Matrix, &[1.0; 9]).contains("no rotation"));
        let mirror = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0];
        assert!(wrong(PoseNotation::Matrix, &mirror).contains("reflection"));
    }
}
