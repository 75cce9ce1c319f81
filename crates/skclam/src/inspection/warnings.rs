//! What a user should know of a dataset, each with advice.

use super::{ImageJudgement, Inspection, InspectionOptions};
use crate::dataset::Dataset;

/// Each with advice, what is worst first.
pub(super) fn warnings(dataset: &Dataset, inspection: &Inspection, options: &InspectionOptions) -> Vec<String> {
    let mut warnings = Vec::new();
    let count = inspection.postures;
    if count < options.min_postures {
        warnings
            .push(format!("{count} postures; {} or more, spread over the cell, calibrate well", options.min_postures));
    }
    if inspection.joints.is_empty() {
        warnings.push("only flange poses are known: the mount can be calibrated, the arm cannot".to_owned());
    }
    if let Some(expected) = &inspection.expected {
        warnings.extend(expected.joints_to_move.iter().map(|joint| {
            format!(
                "joint {} should move more: {} {} leave {} unknown",
                joint.joint,
                tenth(joint.range),
                joint.unit,
                joint.parameters.join(", ")
            )
        }));
        warnings.extend(expected.not_identifiable.iter().map(|reason| format!("not identifiable: {reason}")));
    }
    for joint in &inspection.joints {
        let (range, least) = (
            joint.max - joint.min,
            if joint.unit == "deg" { options.min_joint_range_deg } else { options.min_joint_range_mm },
        );
        if range < least {
            warnings.push(format!(
                "joint {} moves by {} {} only; let it move by {least} {} or more, or its parameters stay unknown",
                joint.joint,
                tenth(range),
                joint.unit,
                joint.unit
            ));
        }
        if let Some([lower, upper]) = joint.limits
            && (joint.min < lower || joint.max > upper)
        {
            warnings.push(format!(
                "joint {} goes from {} to {} {}, beyond its limits {lower:.1} to {upper:.1}; are units and order of the joints right?",
                joint.joint, tenth(joint.min), tenth(joint.max), joint.unit
            ));
        }
    }
    let mut values: Vec<f64> = inspection.images.iter().map(|image| image.sharpness).collect();
    values.sort_by(f64::total_cmp);
    let median = values[values.len() / 2];
    let mut list = |what: &str, advice: &str, bad: &dyn Fn(&ImageJudgement) -> bool| {
        let found: Vec<String> =
            inspection.images.iter().filter(|image| bad(image)).map(|image| image.index.to_string()).collect();
        if !found.is_empty() {
            const SHOWN: usize = 12;
            let more = if found.len() > SHOWN { ", ..." } else { "" };
            let shown = found[..found.len().min(SHOWN)].join(", ");
            warnings.push(format!("{what} in {} of {count} postures ({shown}{more}); {advice}", found.len()));
        }
    };
    list("blurred images", "let the arm come to rest before an image is taken", &|image| {
        image.sharpness < options.min_relative_sharpness * median
    });
    list("underexposed images", "more light, or a longer exposure at a standstill", &|image| {
        image.exposure.dark > options.max_clipped
    });
    list("overexposed images", "less light or a shorter exposure; avoid lamps in view", &|image| {
        image.exposure.bright > options.max_clipped
    });
    list("images without contrast", "the camera must see textured things, not a bare wall", &|image| {
        image.exposure.sd < 10.0
    });
    list("depth images that are mostly holes", "stay within the camera's range, off glass and mirrors", &|image| {
        image.depth_fraction.is_some_and(|fraction| fraction < options.min_depth_fraction)
    });
    warnings.extend(doubtful_unit(dataset, inspection, options));
    if let (Some(board), Some(of_rig)) = (&inspection.board, &dataset.rig.board) {
        warnings.extend(board.warnings(of_rig));
    }
    if dataset.rig.depth.is_none() {
        warnings.push("there is no depth: no map can be made".to_owned());
    }
    if inspection.groups.len() > 1 {
        let alone = inspection.groups.iter().filter(|group| group.len() == 1).count();
        warnings.push(format!(
            "by the nominal rig the postures see {} separate parts of the cell ({alone} postures see nothing that another sees); take postures between them",
            inspection.groups.len()
        ));
    }
    let neighbors = 2.0 * inspection.pairs.len() as f64 / count.max(1) as f64;
    if neighbors < 3.0 {
        warnings.push(format!(
            "each posture shares its view with {neighbors:.1} others in the mean; 4 or more make errors visible"
        ));
    }
    warnings
}

/// A median depth that no camera on a wrist sees: the images' unit is another than the rig says.
fn doubtful_unit(dataset: &Dataset, inspection: &Inspection, options: &InspectionOptions) -> Option<String> {
    let camera = dataset.rig.depth.as_ref()?;
    let mut depths: Vec<f64> = inspection.images.iter().filter_map(|image| image.median_depth_m).collect();
    let middle = depths.len() / 2;
    let median_m = (!depths.is_empty()).then(|| *depths.select_nth_unstable_by(middle, f64::total_cmp).1)?;
    let [least, most] = options.plausible_depth_m;
    let counts = median_m / camera.unit_m;
    (!(least..=most).contains(&median_m)).then(|| {
        format!(
            "the median depth is {median_m:.2e} m (counts about {counts:.0}, of {} mm each); is depth.unit_mm of rig.toml right? It is the length of one \
             count of the 16-bit images: 1 for most cameras, about {:.2} if the cell is about 1 m away",
            camera.unit_m * 1e3,
            1e3 / counts
        )
    })
}

/// One decimal, and a power of ten where that is longer.
fn tenth(value: f64) -> String {
    if value.abs() < 1e7 { format!("{value:.1}") } else { format!("{value:.1e}") }
}
