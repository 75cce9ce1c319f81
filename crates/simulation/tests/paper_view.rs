//! How well the paper's postures constrain its ten angles, by the Cramer-Rao bound of their epipolar geometry.

use nalgebra::{DMatrix, DVector};
use skclam_geometry::{FundamentalMatrix, Pixel, Point3};
use skclam_kinematics::SerialChain;
use skclam_rig::Rig;
use skclam_simulation::{ArmBody, PaperView, RayCaster, paper_parameters, paper_postures, perturb_paper};

fn hp3j() -> Rig {
    skclam_rig::builtin_rig("hp3j").expect("a built-in robot").expect("it can be read")
}

/// A small generator of its own: the test must not lean on the code under test.
struct Lcg(u64);

impl Lcg {
    fn unit(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

struct Bound {
    /// Largest standard deviation of an angle, degrees.
    angle_deg: f64,
    /// Root of the mean variance of the flange's position over the postures, millimetres.
    flange_mm: f64,
    /// Of the matrix of the unscaled derivatives.
    condition: f64,
}

/// 30 matches a pair with 0.5 px of noise, points at 0.7 to 2.3 m, neighbours as pairs: the paper's amount of data.
fn bound(rig: &Rig, view: &PaperView) -> Option<Bound> {
    let nominal = rig.robot.as_ref()?;
    let postures = paper_postures(nominal, &view.base_from_flange(rig)).ok()?;
    let ids = paper_parameters(6);
    let step = 1e-5;
    let moved = |index: usize, by: f64| {
        let mut chain = nominal.clone();
        chain.set_parameter(ids[index], chain.parameter(ids[index]).unwrap() + by).unwrap();
        chain
    };
    let chains: Vec<(SerialChain, SerialChain)> = (0..10).map(|i| (moved(i, step), moved(i, -step))).collect();
    let camera_pose =
        |chain: &SerialChain, joints: &[f64]| chain.base_from_flange(joints).unwrap() * rig.flange_from_color;
    let sampson = |chain: &SerialChain, a: &[f64], b: &[f64], pixels: &[(Pixel, Pixel)]| -> Vec<f64> {
        let a_from_b = camera_pose(chain, a).inverse() * camera_pose(chain, b);
        let fundamental = FundamentalMatrix::from_pose(&rig.color, &rig.color, &a_from_b);
        pixels.iter().map(|(in_a, in_b)| fundamental.sampson_distance(in_a, in_b)).collect()
    };
    let mut random = Lcg(1);
    let mut information = DMatrix::<f64>::zeros(10, 10);
    for pair in postures.windows(2) {
        let (from_a, from_b) = (camera_pose(nominal, &pair[0]), camera_pose(nominal, &pair[1]));
        let mut pixels = Vec::new();
        for _ in 0..2000 {
            if pixels.len() == 30 {
                break;
            }
            let in_a = Pixel::new(random.unit() * 1919.0, random.unit() * 1079.0);
            let point = Point3::from(rig.color.unproject(&in_a) * (0.7 + 1.6 * random.unit()));
            let in_b = rig.color.project(&(from_b.inverse() * (from_a * point)));
            if let Some(in_b) = in_b.filter(|pixel| rig.color.contains(pixel)) {
                pixels.push((in_a, in_b));
            }
        }
        if pixels.len() < 30 {
            return None;
        }
        let columns: Vec<DVector<f64>> = chains
            .iter()
            .map(|(upper, lower)| {
                let (plus, minus) =
                    (sampson(upper, &pair[0], &pair[1], &pixels), sampson(lower, &pair[0], &pair[1], &pixels));
                (DVector::from_vec(plus) - DVector::from_vec(minus)) / (2.0 * step)
            })
            .collect();
        let jacobian = DMatrix::from_columns(&columns);
        information += jacobian.transpose() * &jacobian / (0.5 * 0.5);
    }
    let eigenvalues = information.symmetric_eigenvalues();
    let covariance = information.try_inverse()?;
    let angle = (0..10).map(|i| covariance[(i, i)].sqrt()).fold(0.0, f64::max);
    let mut variance = 0.0;
    for joints in &postures {
        let columns: Vec<DVector<f64>> = chains
            .iter()
            .map(|(upper, lower)| {
                let position = |chain: &SerialChain| chain.base_from_flange(joints).unwrap().translation.vector;
                let difference = (position(upper) - position(lower)) / (2.0 * step);
                DVector::from_column_slice(difference.as_slice())
            })
            .collect();
        let jacobian = DMatrix::from_columns(&columns);
        variance += (&jacobian * &covariance * jacobian.transpose()).trace();
    }
    Some(Bound {
        angle_deg: angle.to_degrees(),
        flange_mm: 1e3 * (variance / postures.len() as f64).sqrt(),
        condition: (eigenvalues.max() / eigenvalues.min()).sqrt(),
    })
}

/// Lowest point of the arm between base and flange, and fraction of the view that the arm itself covers, over the eight
/// solutions.
fn obstruction(rig: &Rig, body: &ArmBody, view: &PaperView) -> Option<(f64, f64)> {
    let postures = paper_postures(rig.robot.as_ref()?, &view.base_from_flange(rig)).ok()?;
    let (mut lowest, mut covered, mut rays) = (f64::INFINITY, 0, 0);
    for joints in &postures[..8] {
        for point in body.skeleton(joints).unwrap().iter().skip(3) {
            lowest = lowest.min(point.z);
        }
        let caster = RayCaster::new(&body.model_at(joints).unwrap());
        let base_from_color = rig.robot.as_ref()?.base_from_flange(joints).unwrap() * rig.flange_from_color;
        for column in 0..12 {
            for row in 0..8 {
                let pixel = Pixel::new(f64::from(column) * 1919.0 / 11.0, f64::from(row) * 1079.0 / 7.0);
                let way = base_from_color * rig.color.unproject(&pixel);
                let eye = Point3::from(base_from_color.translation.vector) + 0.005 * way;
                covered += usize::from(caster.is_blocked(&eye, &way, 3.0));
                rays += 1;
            }
        }
    }
    Some((lowest, covered as f64 / rays as f64))
}

#[test]
fn the_default_view_constrains_all_ten_angles() {
    let rig = hp3j();
    let view = PaperView::default();
    let bound = bound(&rig, &view).unwrap();
    let (lowest, covered) = obstruction(&rig, &ArmBody::new(&rig, 0, 0.02).unwrap(), &view).unwrap();
    println!(
        "largest sigma {:.4} deg, flange {:.3} mm, condition {:.1}; lowest point {lowest:.3} m, arm in view {covered:.3}",
        bound.angle_deg, bound.flange_mm, bound.condition
    );
    assert!(bound.angle_deg < 0.03, "{}", bound.angle_deg);
    assert!(bound.flange_mm < 0.2, "{}", bound.flange_mm);
    assert!(lowest > 0.04 && covered < 0.03, "{lowest} {covered}");
}

#[test]
fn the_papers_gate_keeps_true_matches_of_the_papers_arm() {
    let nominal = hp3j();
    let truth = perturb_paper(&nominal).unwrap();
    let chain = nominal.robot.as_ref().unwrap();
    let postures = paper_postures(chain, &PaperView::default().base_from_flange(&nominal)).unwrap();
    let pose = |rig: &Rig, joints: &[f64]| {
        rig.robot.as_ref().unwrap().base_from_flange(joints).unwrap() * rig.flange_from_color
    };
    let mut random = Lcg(3);
    let mut distances = Vec::new();
    let mut shifts = Vec::new();
    for pair in postures.windows(2) {
        let true_a_from_b = pose(&truth, &pair[0]).inverse() * pose(&truth, &pair[1]);
        let guess = pose(&nominal, &pair[0]).inverse() * pose(&nominal, &pair[1]);
        shifts.push(1e3 * true_a_from_b.translation.vector.norm());
        let fundamental = FundamentalMatrix::from_pose(&nominal.color, &nominal.color, &guess);
        for _ in 0..200 {
            let in_a = Pixel::new(random.unit() * 1919.0, random.unit() * 1079.0);
            let point = Point3::from(nominal.color.unproject(&in_a) * (1.0 + 1.4 * random.unit()));
            let in_b = nominal.color.project(&(true_a_from_b.inverse() * point));
            if let Some(in_b) = in_b.filter(|pixel| nominal.color.contains(pixel)) {
                let (a, b) = fundamental.point_line_distances(&in_a, &in_b);
                distances.extend([a, b]);
            }
        }
    }
    let position =
        |rig: &Rig, joints: &[f64]| rig.robot.as_ref().unwrap().base_from_flange(joints).unwrap().translation.vector;
    let error_mm: Vec<f64> =
        postures.iter().map(|joints| 1e3 * (position(&truth, joints) - position(&nominal, joints)).norm()).collect();
    distances.sort_by(f64::total_cmp);
    shifts.sort_by(f64::total_cmp);
    // Eq. (7): the root of the mean distance, as the paper prints it.
    let mean = distances.iter().sum::<f64>() / distances.len() as f64;
    let kept = distances.iter().filter(|distance| **distance < 200.0).count() as f64 / distances.len() as f64;
    println!(
        "before calibration: flange {:.2} mm, point-line distance mean {mean:.1}, median {:.1} px, Eq. (7) {:.2}; \
         {:.1} % within 200 px; baselines {:.1} to {:.1}, median {:.1} mm; overlap {:.2}",
        error_mm.iter().sum::<f64>() / error_mm.len() as f64,
        distances[distances.len() / 2],
        mean.sqrt(),
        100.0 * kept,
        shifts[0],
        shifts[shifts.len() - 1],
        shifts[shifts.len() / 2],
        distances.len() as f64 / (2.0 * 200.0 * 72.0),
    );
    assert!(kept > 0.9, "{kept}");
    assert!(distances.len() as f64 > 0.7 * 2.0 * 200.0 * 72.0, "neighbours overlap");
}

/// How the default was chosen: `cargo test --release -p skclam-simulation --test paper_view -- --ignored --nocapture`.
#[test]
#[ignore = "a search over a few thousand views; prints a table"]
fn search_for_a_view() {
    let rig = hp3j();
    let body = ArmBody::new(&rig, 0, 0.02).unwrap();
    let mut random = Lcg(7);
    let mut found: Vec<(f64, String)> = Vec::new();
    for _ in 0..4000 {
        let mut pick = |low: f64, high: f64| (low + (high - low) * random.unit()).round();
        let view = PaperView {
            radius_mm: pick(200.0, 420.0),
            height_mm: pick(300.0, 700.0),
            yaw_deg: pick(-75.0, 75.0),
            pitch_deg: pick(5.0, 30.0),
            roll_deg: 0.0,
        };
        let Some((lowest, covered)) = obstruction(&rig, &body, &view) else { continue };
        if lowest < 0.05 || covered > 0.02 {
            continue;
        }
        if let Some(bound) = bound(&rig, &view) {
            let text = format!(
                "sigma {:.4} deg, flange {:.3} mm, condition {:.1}, lowest {lowest:.3}, covered {covered:.3}: {view:?}",
                bound.angle_deg, bound.flange_mm, bound.condition
            );
            found.push((bound.angle_deg, text));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    println!("{} views", found.len());
    for (_, text) in found.iter().take(25) {
        println!("{text}");
    }
}
