//! What may be wrong with a data set that could not be calibrated: the error of an estimator is about matrices, a
//! person looks for a slip.

use super::InspectionOptions;
use crate::dataset::Dataset;
use skclam_geometry::PinholeCamera;

/// Postures that are looked at.
const LOOKED_AT: usize = 5;
/// Horizontal fields of view of cameras on wrists, degrees.
const VIEW_DEG: [f64; 2] = [15.0, 150.0];
/// Lengths of arms, metres: the sum of all links.
const ARM_M: [f64; 2] = [0.05, 30.0];

/// The first thing in a data set that no real one has, in one sentence; `None` where there is nothing of the kind.
pub fn likely_cause(dataset: &Dataset) -> Option<String> {
    let depth = dataset.rig.depth.as_ref();
    let cameras = [("color", Some(&dataset.rig.color)), ("depth", depth.map(|depth| &depth.camera))];
    let view = cameras.into_iter().find_map(|(table, camera)| doubtful_view(table, camera?));
    view.or_else(|| doubtful_depth(dataset)).or_else(|| doubtful_arm(dataset))
}

fn doubtful_view(table: &str, camera: &PinholeCamera) -> Option<String> {
    let view_deg = 2.0 * (0.5 * f64::from(camera.width) / camera.fx).atan().to_degrees();
    (!(VIEW_DEG[0]..=VIEW_DEG[1]).contains(&view_deg)).then(|| {
        format!(
            "[{table}] of the rig describes a camera with a field of view of {view_deg:.1} deg (fx = {}, width = {}); is fx right?",
            camera.fx, camera.width
        )
    })
}

fn doubtful_depth(dataset: &Dataset) -> Option<String> {
    let camera = dataset.rig.depth.as_ref()?;
    let step = dataset.len().div_ceil(LOOKED_AT).max(1);
    // An image that cannot be read has been reported.
    let images = (0..dataset.len()).step_by(step).filter_map(|index| dataset.depth(index).ok().flatten());
    let mut medians: Vec<f64> = images
        .filter_map(|image| {
            let mut values: Vec<f32> = image.as_slice().iter().copied().filter(|z| *z > 0.0).collect();
            let middle = values.len() / 2;
            (!values.is_empty()).then(|| f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1))
        })
        .collect();
    medians.sort_by(f64::total_cmp);
    let median_m = *medians.get(medians.len() / 2)?;
    let [least, most] = InspectionOptions::default().plausible_depth_m;
    (!(least..=most).contains(&median_m)).then(|| {
        format!(
            "the median depth is {median_m:.3e} m, which no camera on a wrist sees: is depth.unit_mm = {} of the rig right? It is the length \
             of one count of the 16-bit images, 1 for most cameras",
            camera.unit_m * 1e3
        )
    })
}

fn doubtful_arm(dataset: &Dataset) -> Option<String> {
    let joints = dataset.rig.robot.as_ref()?.joints();
    let length_m: f64 = joints.iter().map(|joint| joint.link.a.abs() + joint.link.d.abs()).sum();
    (!(ARM_M[0]..=ARM_M[1]).contains(&length_m)).then(|| {
        format!("the links of the rig's arm are {length_m:.3e} m long together; are a_mm and d_mm in millimetres?")
    })
}
