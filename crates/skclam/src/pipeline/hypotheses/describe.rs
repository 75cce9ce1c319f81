//! A gross mistake in words: what was found, by how much, and which key of which file to change.

use super::{DepthShift, GrossCause, GrossFinding};

/// One or two sentences for a person who knows the robot and not the program.
pub fn describe(finding: &GrossFinding) -> String {
    let [before, after] = [finding.before_px, finding.after_px]
        .map(|px| px.map_or_else(|| "no fit at all".to_owned(), |px| format!("{px:.1} px")));
    let gain = format!(
        "the median distance of {} matches to their epipolar lines goes from {before} to {after}",
        finding.matches
    );
    let second = match finding.second {
        Some((_, px)) if px.is_finite() => format!(", and the next best explanation leaves {px:.1} px"),
        _ => String::new(),
    };
    let cured =
        |what: String, cure: String| format!("{what}: {gain} with that undone and the mount fitted{second}. {cure}");
    match finding.cause {
        GrossCause::JointSign { joint } => {
            let q = joint + 1;
            cured(
                format!("joint {q} turns the other way round than the rig has it"),
                format!("Change the sign of column q{q} in postures.csv."),
            )
        }
        GrossCause::JointsSwapped { a, b } => {
            let (a, b) = (a + 1, b + 1);
            cured(
                format!("the values of joints {a} and {b} are swapped"),
                format!("Swap the columns q{a} and q{b} in postures.csv (their names in the header suffice)."),
            )
        }
        GrossCause::DegreesForRadians => cured(
            "the joint values are degrees, but the columns say radians".to_owned(),
            "Rename the columns q1_rad ... to q1_deg ... in postures.csv.".to_owned(),
        ),
        GrossCause::RadiansForDegrees => cured(
            "the joint values are radians, but the columns say degrees".to_owned(),
            "Rename the columns q1_deg ... to q1_rad ... in postures.csv.".to_owned(),
        ),
        GrossCause::PosturesShifted { by } => {
            let (rows, where_to) = (by.unsigned_abs(), if by > 0 { "below" } else { "above" });
            let plural = if rows == 1 { "row" } else { "rows" };
            cured(
                format!(
                    "images and postures are shifted: an image belongs to the posture {rows} {plural} \
                {where_to} it"
                ),
                format!(
                    "In postures.csv, move the names in the column color (and depth) {rows} {plural} {}.",
                    if by > 0 { "down" } else { "up" }
                ),
            )
        }
        GrossCause::LinkConvention => cured(
            "the arm's table of link parameters is given in the wrong convention".to_owned(),
            "Change robot.convention in rig.toml: \"modified_dh\" to \"standard_dh\", or the other way \
            round."
                .to_owned(),
        ),
        GrossCause::MountFarOff { rotation_deg, translation_mm, .. } => format!(
            "the mount in rig.toml is far off, by {rotation_deg:.0} deg and {translation_mm:.0} mm: {gain} with a \
            mount that was found from the images alone. \
             Run with --find-mount, or correct [mount] in rig.toml."
        ),
        GrossCause::QuaternionOrder => cured(
            "the quaternions of the flange poses have their scalar part first".to_owned(),
            "In postures.csv, name the four columns qw, qx, qy, qz in the order of the values.".to_owned(),
        ),
        GrossCause::PoseInverted => cured(
            "the flange poses are inverted: they take points from the base to the flange".to_owned(),
            "Write the inverse of every pose (base_from_flange: the flange's place in the base frame) into \
            postures.csv."
                .to_owned(),
        ),
        GrossCause::OtherArm => format!(
            "the images agree with each other, but these postures of this arm do not explain them: {before} remain \
             with the mount fitted, and none of {} mistakes that were tried explains it (the best leaves {after}). Is it the rig of this \
             arm, are these the postures of this recording, and is [color] of this camera at this resolution?",
            finding.tried,
        ),
        GrossCause::SceneOrCamera => format!(
            "two images at a time, without the arm, do not fit [color] in rig.toml: {before} remain in the median \
            pair with these intrinsics, {after} without any. \
             Are focal length, centre and distortion those of this camera at this resolution? Did the scene stay \
             still?",
        ),
    }
}

/// The same of depth images that belong to other rows.
pub fn describe_depth_shift(shift: &DepthShift) -> String {
    let (rows, where_to, move_to) = match shift.by > 0 {
        true => (shift.by, "below", "up"),
        false => (-shift.by, "above", "down"),
    };
    let plural = if rows == 1 { "row" } else { "rows" };
    format!(
        "the depth images are shifted: the one that belongs to a posture is {rows} {plural} {where_to} it; \
        depths at {} points then scatter by {:.1} % about \
         what the images say, not by {:.1} %. In postures.csv, move the names in the column depth {rows} {plural} \
         {move_to}.",
        shift.points, shift.after_percent, shift.before_percent
    )
}
