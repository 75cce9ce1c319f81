//! Image-free recordings for tests, examples and benchmarks: an HP3J-like arm amid random points.
//!
//! Included by path, not part of the library: an estimator must not know its truth.
#![allow(dead_code)]

use crate::{
    BoardObservation, Correspondences, Free, Model, PairMatch, PairMatches, Parameter, Track, TrackObservation, Unit,
    isotropic_covariance,
};
use nalgebra::{Matrix6, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use skclam_geometry::{DepthCamera, Isometry3, PinholeCamera, Pixel, Point3};
use skclam_kinematics::{Joint, Link, SerialChain};
use skclam_rig::{Board, BoardPattern, JointCorrections, Posture, PostureState, Prior, Rig, fill_joint_rates};

pub fn seeded(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Standard normal, by Box and Muller.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let u: f64 = 1.0 - rng.random::<f64>();
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// The arm and the cameras of the paper's virtual cell: 1920 x 1080, 70 deg.
pub fn hp3j() -> Rig {
    let deg = f64::to_radians;
    let joints = vec![
        Joint::revolute("S", Link::modified_dh(0.0, 0.0, 0.0, 0.29)).with_limits(deg(-180.0), deg(180.0)),
        Joint::revolute("L", Link::modified_dh(deg(90.0), 0.1, deg(90.0), 0.0)).with_limits(deg(-150.0), deg(150.0)),
        Joint::revolute("U", Link::hayati(deg(180.0), 0.29, 0.0, deg(-90.0))).with_limits(deg(-170.0), deg(170.0)),
        Joint::revolute("R", Link::modified_dh(deg(-90.0), 0.085, 0.0, 0.3)).with_limits(deg(-190.0), deg(190.0)),
        Joint::revolute("B", Link::modified_dh(deg(90.0), 0.0, 0.0, 0.0)).with_limits(deg(-135.0), deg(135.0)),
        Joint::revolute("T", Link::modified_dh(deg(-90.0), 0.0, deg(-90.0), 0.09)).with_limits(deg(-360.0), deg(360.0)),
    ];
    Rig {
        name: "HP3J-like".to_owned(),
        robot: Some(SerialChain::new(joints).unwrap()),
        joint_corrections: JointCorrections::default(),
        flange_from_color: Isometry3::new(Vector3::new(-0.06, 0.0, 0.04), Vector3::new(0.0, 0.0, -deg(90.0))),
        color: PinholeCamera::from_hfov(1920, 1080, deg(70.0)),
        depth: Some(DepthCamera {
            camera: PinholeCamera::from_hfov(480, 360, deg(59.0)),
            unit_m: 1e-3,
            offset_m: 0.0,
            color_from_depth: Isometry3::identity(),
        }),
        board: None,
        prior: Prior::default(),
        color_mask: None,
        depth_mask: None,
    }
}

/// How a true arm differs from its nominal one: standard deviations, or with `fixed_size` the size of every change.
#[derive(Clone, Copy)]
pub struct Errors {
    pub angle: f64,
    pub length: f64,
    pub mount_angle: f64,
    pub mount_length: f64,
    pub fixed_size: bool,
}

pub fn manufacture() -> Errors {
    Errors { angle: 0.3f64.to_radians(), length: 5e-4, mount_angle: 0.0175, mount_length: 3e-3, fixed_size: false }
}

/// A rig that differs from `rig` in the parameters of `free`.
pub fn perturbed(rig: &Rig, free: &Free, errors: Errors, rng: &mut ChaCha8Rng) -> Rig {
    let parameters = free.candidates(rig, true, false).unwrap();
    let delta: Vec<f64> = parameters
        .iter()
        .map(|parameter| {
            let size = match (parameter, parameter.unit()) {
                (Parameter::Mount(_), Unit::Radian) => errors.mount_angle,
                (Parameter::Mount(_), _) => errors.mount_length,
                (Parameter::Chain(_), Unit::Radian) => errors.angle,
                (Parameter::Chain(_), _) => errors.length,
                _ => 0.0,
            };
            let z = normal(rng);
            size * if errors.fixed_size { z.signum() } else { z }
        })
        .collect();
    Model::new(rig.clone()).stepped(&parameters, &delta).unwrap().rig
}

pub fn joints(index: usize, values: &[f64]) -> Posture {
    Posture::new(index as u64, PostureState::Joints(values.to_vec())).at(Some(index as f64))
}

/// Random postures whose camera is inside the cell, within 0.85 m of its middle and above the floor.
pub fn diverse_postures(rig: &Rig, count: usize, rng: &mut ChaCha8Rng) -> Vec<Posture> {
    let mut postures = Vec::new();
    while postures.len() < count {
        let ranges = [2.6, 1.2, 1.3, 2.6, 1.7, 2.8];
        let values: Vec<f64> = ranges.iter().map(|range| rng.random_range(-range..*range)).collect();
        let posture = joints(postures.len(), &values);
        let center = rig.base_from_color(&posture).unwrap().translation.vector;
        if (center - Vector3::new(0.0, 0.0, 0.6)).norm() < 0.85 && center.z > 0.1 && center.xy().norm() > 0.15 {
            postures.push(posture);
        }
    }
    fill_joint_rates(&mut postures);
    postures
}

/// The paper's 73 postures (4.1.1): one flange pose, eight solutions, joint 1 turned by 5 deg each time, nine rounds.
pub fn paper_postures(rig: &Rig) -> Vec<Posture> {
    let robot = rig.robot.as_ref().unwrap();
    let seed = [0.0, 0.4, 0.9, 0.4, 0.9, 0.3];
    let target = robot.base_from_flange(&seed).unwrap();
    let mut solutions: Vec<Vec<f64>> = vec![seed.to_vec()];
    let mut rng = seeded(73);
    for _ in 0..4000 {
        let mut q: Vec<f64> = (0..6).map(|_| rng.random_range(-3.1..3.1)).collect();
        for _ in 0..60 {
            let jacobian = robot.jacobian(&q).unwrap();
            let pose = jacobian.base_from_flange;
            let omega = (target.rotation * pose.rotation.inverse()).scaled_axis();
            let at_target = target.translation.vector - pose.translation.vector;
            let v = at_target - omega.cross(&pose.translation.vector);
            let error = Vector6::new(v.x, v.y, v.z, omega.x, omega.y, omega.z);
            let mut columns = Matrix6::zeros();
            for (k, twist) in jacobian.by_joint.iter().enumerate() {
                columns.set_column(k, twist);
            }
            let damped = columns.transpose() * columns + Matrix6::identity() * 1e-6;
            let step = damped.try_inverse().unwrap() * columns.transpose() * error;
            let limit = (0.5 / step.amax()).min(1.0);
            for (value, change) in q.iter_mut().zip(step.iter()) {
                *value += limit * change;
            }
        }
        let wrap = |angle: f64| angle - std::f64::consts::TAU * (angle / std::f64::consts::TAU).round();
        q.iter_mut().for_each(|value| *value = wrap(*value));
        let reached = robot.base_from_flange(&q).unwrap();
        let exact = (reached.inverse() * target).to_homogeneous() - nalgebra::Matrix4::identity();
        let known = solutions.iter().any(|s| s.iter().zip(&q).all(|(a, b)| wrap(a - b).abs() < 1e-3));
        if exact.norm() < 1e-7 && !known {
            solutions.push(q);
        }
        if solutions.len() == 8 {
            break;
        }
    }
    (0..73)
        .map(|index| {
            let mut q = solutions[index % solutions.len()].clone();
            q[0] += if index == 72 { 0.0 } else { 5f64.to_radians() * index as f64 };
            joints(index, &if index == 72 { solutions[0].clone() } else { q })
        })
        .collect()
}

/// Points on the walls, floor and ceiling of a cell and on boxes around the arm.
pub fn box_points(count: usize, rng: &mut ChaCha8Rng) -> Vec<Point3> {
    (0..count)
        .map(|_| {
            // One in three on a nearer shell, so that depths vary within an image.
            let shrink = if rng.random::<f64>() < 0.33 { rng.random_range(0.7..1.0) } else { 1.0 };
            let half = Vector3::new(1.5, 1.5, 1.1) * shrink;
            let axis = rng.random_range(0..3usize);
            let mut point = half.map(|extent| rng.random_range(-extent..extent));
            point[axis] = if rng.random::<bool>() { half[axis] } else { -half[axis] };
            Point3::from(point + Vector3::new(0.0, 0.0, 0.7))
        })
        .collect()
}

/// What is measured, and how badly.
#[derive(Clone, Copy)]
pub struct Sensing {
    pub sigma_px: f64,
    /// `sigma = depth_relative z^2`; `None`: no depth.
    pub depth_relative: Option<f64>,
    /// Fraction of wrong observations.
    pub outliers: f64,
    /// At most so many keypoints an image.
    pub keypoints: usize,
    /// Sigma of the encoders, rad.
    pub encoder: f64,
}

pub fn half_pixel() -> Sensing {
    Sensing { sigma_px: 0.5, depth_relative: None, outliers: 0.0, keypoints: 400, encoder: 0.0 }
}

/// Tracks of the points as the true rig sees them. The postures come back as the encoders report them.
pub fn record(
    truth: &Rig,
    postures: &[Posture],
    points: &[Point3],
    sensing: Sensing,
    rng: &mut ChaCha8Rng,
) -> Correspondences {
    let poses: Vec<Isometry3> = postures
        .iter()
        .map(|posture| {
            let mut moved = posture.clone();
            if let PostureState::Joints(values) = &mut moved.state {
                values.iter_mut().for_each(|value| *value += sensing.encoder * normal(rng));
            }
            truth.base_from_color(&moved).unwrap().inverse()
        })
        .collect();
    let mut seen = vec![0usize; postures.len()];
    let mut tracks = Vec::new();
    for point in points {
        let mut track = Track::default();
        for (posture, color_from_base) in poses.iter().enumerate() {
            let in_color = color_from_base * point;
            let Some(pixel) = truth.color.project(&in_color) else { continue };
            if !truth.color.contains(&pixel) || in_color.z < 0.15 || seen[posture] >= sensing.keypoints {
                continue;
            }
            seen[posture] += 1;
            let wrong = rng.random::<f64>() < sensing.outliers;
            let (width, height) = (f64::from(truth.color.width), f64::from(truth.color.height));
            let noisy = pixel + nalgebra::Vector2::new(normal(rng), normal(rng)) * sensing.sigma_px;
            let elsewhere = Pixel::new(rng.random::<f64>() * width, rng.random::<f64>() * height);
            let depth = sensing
                .depth_relative
                .map(|relative| in_color.z + relative * in_color.z * in_color.z * normal(rng))
                .filter(|&z| z > 0.05);
            track.observations.push(TrackObservation {
                posture,
                pixel: if wrong { elsewhere } else { noisy },
                covariance: isotropic_covariance(1.0),
                depth_m: depth,
                depth_slope: [0.0; 2],
            });
        }
        if track.observations.len() >= 2 {
            tracks.push(track);
        } else {
            track.observations.iter().for_each(|observation| seen[observation.posture] -= 1);
        }
    }
    Correspondences { postures: postures.to_vec(), tracks, ..Default::default() }
}

/// Matches of neighbouring postures, at most `limit` a pair, read off the tracks.
pub fn neighbour_pairs(data: &Correspondences, limit: usize) -> Vec<PairMatches> {
    (1..data.postures.len())
        .map(|b| {
            let a = b - 1;
            let at = |track: &Track, posture| {
                track.observations.iter().find(|observation| observation.posture == posture).map(|o| o.pixel)
            };
            let matches = data.tracks.iter().filter_map(|track| {
                Some(PairMatch { in_a: at(track, a)?, in_b: at(track, b)?, sigma_px: 1.0, distance: 0 })
            });
            PairMatches { a, b, matches: matches.take(limit).collect() }
        })
        .collect()
}

/// Matches between `pairs` of postures made afresh (not through tracks), each with its own point in front of both
/// cameras.
pub fn fresh_pairs(
    truth: &Rig,
    postures: &[Posture],
    pairs: &[(usize, usize)],
    per_pair: usize,
    sensing: Sensing,
    rng: &mut ChaCha8Rng,
) -> Vec<PairMatches> {
    pairs
        .iter()
        .map(|&(a, b)| {
            let base_from_a = truth.base_from_color(&postures[a]).unwrap();
            let b_from_base = truth.base_from_color(&postures[b]).unwrap().inverse();
            let (width, height) = (f64::from(truth.color.width), f64::from(truth.color.height));
            let mut matches = Vec::new();
            for _ in 0..per_pair * 60 {
                if matches.len() == per_pair {
                    break;
                }
                let in_a = Pixel::new(rng.random::<f64>() * width, rng.random::<f64>() * height);
                let point = Point3::from(truth.color.unproject(&in_a) * rng.random_range(0.5..2.0));
                let Some(in_b) = truth.color.project(&(b_from_base * base_from_a * point)) else { continue };
                if !truth.color.contains(&in_b) {
                    continue;
                }
                let mut noise = || nalgebra::Vector2::new(normal(rng), normal(rng)) * sensing.sigma_px;
                let (in_a, mut in_b) = (in_a + noise(), in_b + noise());
                if rng.random::<f64>() < sensing.outliers {
                    in_b = Pixel::new(rng.random::<f64>() * width, rng.random::<f64>() * height);
                }
                matches.push(PairMatch { in_a, in_b, sigma_px: 1.0, distance: 0 });
            }
            PairMatches { a, b, matches }
        })
        .collect()
}

/// Neighbours, one after the other.
pub fn neighbours(count: usize) -> Vec<(usize, usize)> {
    (1..count).map(|b| (b - 1, b)).collect()
}

/// An 11 x 8 board of 15 mm squares as the true rig sees it.
pub fn record_board(
    truth: &Rig,
    postures: &[Posture],
    base_from_board: &Isometry3,
    sigma_px: f64,
    rng: &mut ChaCha8Rng,
) -> (Board, Vec<BoardObservation>) {
    let board = Board { pattern: BoardPattern::Checkerboard, columns: 11, rows: 8, square_m: 0.015 };
    let observations = postures.iter().enumerate().filter_map(|(posture, at)| {
        let color_from_board = truth.base_from_color(at).unwrap().inverse() * base_from_board;
        let mut corners = Vec::new();
        for row in 0..board.rows {
            for column in 0..board.columns {
                let point = Point3::new(f64::from(column), f64::from(row), 0.0) * board.square_m;
                let pixel = truth.color.project(&(color_from_board * point))?;
                if !truth.color.contains(&pixel) {
                    return None;
                }
                corners.push((column, row, pixel + nalgebra::Vector2::new(normal(rng), normal(rng)) * sigma_px));
            }
        }
        Some(BoardObservation { posture, corners, sigma_px: 1.0 })
    });
    let observations = observations.collect();
    (board, observations)
}

/// Mean distance, metres, between the cameras of two rigs over the postures, after the rigid motion of the base that
/// fits best is *not* applied: both rigs must share the gauge.
pub fn camera_error(truth: &Rig, rig: &Rig, postures: &[Posture]) -> f64 {
    let sum: f64 = postures
        .iter()
        .map(|posture| {
            let (a, b) = (truth.base_from_color(posture).unwrap(), rig.base_from_color(posture).unwrap());
            (a.translation.vector - b.translation.vector).norm()
        })
        .sum();
    sum / postures.len() as f64
}
