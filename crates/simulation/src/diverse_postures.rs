//! Postures all over the workspace that see the scene and overlap with their neighbours.
//!
//! A walk in joint space: steps of all joints, refused where the arm or the camera would touch something, where the
//! camera sees too little or too near, or where too little of what it saw one posture before is still in view.

use crate::scene::RayCaster;
use crate::scene_rng::SceneRng;
use crate::{ArmBody, Scene, SimulationError};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use skclam_geometry::{Isometry3, Pixel, Point3};
use skclam_rig::Rig;

/// How postures are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiverseOptions {
    /// Other seeds give other postures.
    pub seed: u64,
    /// How many.
    pub count: usize,
    /// Standard deviation of a joint's step, degrees (a prismatic joint: as many millimetres).
    pub step_deg: f64,
    /// Smallest fraction of what a posture sees that its predecessor saw too.
    pub min_overlap: f64,
    /// Nothing may be nearer to the camera, metres.
    pub clearance_m: f64,
    /// Median distance of what is seen: least and most, metres.
    pub view_distance_m: [f64; 2],
    /// Largest fraction of the view on plain surfaces.
    pub max_plain: f64,
    /// Largest fraction of the view on the arm itself.
    pub max_arm: f64,
}

impl Default for DiverseOptions {
    fn default() -> Self {
        DiverseOptions {
            seed: 5,
            count: 73,
            step_deg: 28.0,
            min_overlap: 0.45,
            clearance_m: 0.3,
            view_distance_m: [0.6, 2.6],
            max_plain: 0.3,
            max_arm: 0.03,
        }
    }
}

/// Rays of a view: columns and rows.
const RAYS: (usize, usize) = (8, 5);
/// The arm's links keep this distance from things, metres.
const LINK_CLEARANCE_M: f64 = 0.07;
const TRIES_PER_POSTURE: usize = 20_000;

/// Points that a view sees, in base.
struct View {
    base_from_color: Isometry3,
    points: Vec<Point3>,
}

/// Draws `count` postures, joint values in radians or metres, within the joints' limits (a revolute joint without
/// limits: half a turn to each side).
///
/// # Errors
/// No arm, options out of range, or no posture found in a bounded number of draws.
pub fn diverse_postures(rig: &Rig, scene: &Scene, options: &DiverseOptions) -> Result<Vec<Vec<f64>>, SimulationError> {
    check(options)?;
    let chain = rig.robot.as_ref().ok_or(SimulationError::NoRobot)?;
    let body = ArmBody::new(rig, 0, 0.02)?;
    let limits: Vec<[f64; 2]> = chain
        .joints()
        .iter()
        .map(|joint| {
            let [low, high] = joint.limits.unwrap_or([-std::f64::consts::PI, std::f64::consts::PI]);
            // Half a turn to each side says every posture of a revolute joint.
            [low.max(-std::f64::consts::PI), high.min(std::f64::consts::PI)]
        })
        .collect();
    let mut rng = SceneRng::new(options.seed, 40);
    let mut postures: Vec<Vec<f64>> = Vec::with_capacity(options.count);
    let mut last: Option<View> = None;
    // Joint 1 drifts, so that the walk goes around the arm and back instead of staying at one wall.
    let mut drift = (720.0 / options.count.max(1) as f64).min(0.5 * options.step_deg).to_radians();
    let mut tries = 0;
    while postures.len() < options.count {
        if tries >= TRIES_PER_POSTURE * (postures.len() + 1) {
            return Err(SimulationError::Postures { need: options.count, got: postures.len(), tries });
        }
        tries += 1;
        let candidate: Vec<f64> = match postures.last() {
            None => limits.iter().map(|[low, high]| rng.range(*low, *high)).collect(),
            Some(from) => from
                .iter()
                .zip(&limits)
                .enumerate()
                .map(|(joint, (value, [low, high]))| {
                    let mean = if joint == 0 { value + drift } else { *value };
                    let step = mean + options.step_deg.to_radians() * rng.normal();
                    // Mirrored at the limits: a walk that is cut there would stick to them.
                    let folded = if step > *high {
                        2.0 * high - step
                    } else if step < *low {
                        2.0 * low - step
                    } else {
                        step
                    };
                    folded.clamp(*low, *high)
                })
                .collect(),
        };
        let Some(view) = acceptable(rig, scene, &body, &candidate, options)? else { continue };
        if let Some(before) = &last {
            let overlap = |seen: &View, from: &View| {
                let color_from_base = from.base_from_color.inverse();
                let camera = &rig.color;
                let visible = seen.points.iter().filter(|point| {
                    let in_camera = color_from_base * **point;
                    let inside = camera.project(&in_camera).is_some_and(|pixel| camera.contains(&pixel));
                    let eye = Point3::from(from.base_from_color.translation.vector);
                    inside && !scene.caster().is_blocked(&eye, &(**point - eye), 0.98)
                });
                visible.count() as f64 / seen.points.len().max(1) as f64
            };
            if overlap(&view, before) < options.min_overlap || overlap(before, &view) < options.min_overlap {
                continue;
            }
        }
        // Turn back at the ends of joint 1's range.
        if let (Some([low, high]), Some(value)) = (limits.first(), candidate.first()) {
            let margin = 0.15 * (high - low);
            drift = if *value > high - margin {
                -drift.abs()
            } else if *value < low + margin {
                drift.abs()
            } else {
                drift
            };
        }
        postures.push(candidate);
        last = Some(view);
    }
    Ok(postures)
}

fn check(options: &DiverseOptions) -> Result<(), SimulationError> {
    let bad = |option, value: String, need| Err(SimulationError::Option { option, value, need });
    if options.count > 100_000 {
        return bad("count", options.count.to_string(), "at most 100,000 postures are possible");
    }
    if !(options.step_deg > 0.0 && options.step_deg <= 360.0) {
        return bad("step_deg", options.step_deg.to_string(), "more than 0 and at most 360 degrees are needed");
    }
    for (option, value) in
        [("min_overlap", options.min_overlap), ("max_plain", options.max_plain), ("max_arm", options.max_arm)]
    {
        if !(0.0..=1.0).contains(&value) {
            return bad(option, value.to_string(), "0 to 1 is needed");
        }
    }
    let [near, far] = options.view_distance_m;
    if !(options.clearance_m >= 0.0 && near >= 0.0 && far > near) {
        return bad(
            "view_distance_m",
            format!("{near} to {far}"),
            "two rising distances and a clearance of at least 0 are needed",
        );
    }
    Ok(())
}

/// The view of a posture that touches nothing and sees enough; `None` otherwise.
fn acceptable(
    rig: &Rig,
    scene: &Scene,
    body: &ArmBody,
    joint_values: &[f64],
    options: &DiverseOptions,
) -> Result<Option<View>, SimulationError> {
    let skeleton = body.skeleton(joint_values)?;
    let Some(&flange) = skeleton.last() else { return Ok(None) };
    let Some(chain) = rig.robot.as_ref() else { return Err(SimulationError::NoRobot) };
    let base_from_color = chain.base_from_flange(joint_values)? * rig.flange_from_color;
    let eye = Point3::from(base_from_color.translation.vector);
    // Above the table, and the links clear of what is on it; the first two points are the base itself.
    let too_low = |point: &Point3| point.z < LINK_CLEARANCE_M && point.coords.xy().norm() > 0.02;
    if skeleton.iter().skip(2).any(too_low) || eye.z < 0.12 {
        return Ok(None);
    }
    let caster = scene.caster();
    let mut path: Vec<(Point3, Point3)> = skeleton.windows(2).skip(1).map(|pair| (pair[0], pair[1])).collect();
    path.push((flange, eye));
    if path.iter().any(|(a, b)| (b - a).norm() > 1e-6 && caster.is_blocked(a, &(b - a), 1.0)) {
        return Ok(None);
    }
    // Space around the camera and the flange in all directions of a cube's faces and corners.
    for x in -1..=1i8 {
        for y in -1..=1i8 {
            for z in -1..=1i8 {
                let way = Vector3::new(f64::from(x), f64::from(y), f64::from(z));
                if way.norm() > 0.0 {
                    let unit = way.normalize();
                    if caster.is_blocked(&eye, &unit, 0.15) || caster.is_blocked(&flange, &unit, LINK_CLEARANCE_M) {
                        return Ok(None);
                    }
                }
            }
        }
    }
    let camera = &rig.color;
    let (mut points, mut distances, mut plain) = (Vec::new(), Vec::new(), 0usize);
    for row in 0..RAYS.1 {
        for column in 0..RAYS.0 {
            let pixel = Pixel::new(
                (column as f64 + 0.5) / RAYS.0 as f64 * f64::from(camera.width) - 0.5,
                (row as f64 + 0.5) / RAYS.1 as f64 * f64::from(camera.height) - 0.5,
            );
            let way = base_from_color * camera.unproject(&pixel).normalize();
            let Some(hit) = caster.first_hit(&eye, &way, 20.0) else { return Ok(None) };
            if hit.distance < options.clearance_m {
                return Ok(None);
            }
            plain += usize::from(scene.is_plain(hit.face));
            points.push(eye + way * hit.distance);
            distances.push(hit.distance);
        }
    }
    distances.sort_by(f64::total_cmp);
    let median = distances[distances.len() / 2];
    let [near, far] = options.view_distance_m;
    let rays = points.len() as f64;
    if !(near..=far).contains(&median) || plain as f64 > options.max_plain * rays {
        return Ok(None);
    }
    // Last, because it is dear: the arm's own body in the view.
    let own = RayCaster::new(&body.model_at(joint_values)?);
    let hidden = points.iter().filter(|point| {
        let way = *point - eye;
        own.is_blocked(&(eye + 0.005 * way.normalize()), &way, 1.0)
    });
    let seen = hidden.count() as f64 <= options.max_arm * rays;
    Ok(seen.then_some(View { base_from_color, points }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SceneOptions;

    #[test]
    fn diverse_postures_are_within_limits_apart_and_repeat() {
        let rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        let scene = Scene::new(&SceneOptions { texel_at_1m_mm: Some(20.0), ..Default::default() }, 300.0).unwrap();
        let options = DiverseOptions { count: 12, ..Default::default() };
        let postures = diverse_postures(&rig, &scene, &options).unwrap();
        assert_eq!(postures, diverse_postures(&rig, &scene, &options).unwrap());
        let chain = rig.robot.as_ref().unwrap();
        for (index, joints) in postures.iter().enumerate() {
            assert!(chain.admits(joints), "posture {index}");
            let eye = chain.base_from_flange(joints).unwrap() * rig.flange_from_color * Point3::origin();
            assert!(eye.z > 0.12);
            for other in &postures[..index] {
                assert!(joints.iter().zip(other).any(|(a, b)| (a - b).abs() > 0.05));
            }
        }
        let impossible = DiverseOptions { count: 1, view_distance_m: [9.0, 10.0], ..Default::default() };
        let error = diverse_postures(&rig, &scene, &impossible).unwrap_err();
        assert!(matches!(error, SimulationError::Postures { need: 1, got: 0, .. }), "{error}");
    }
}
