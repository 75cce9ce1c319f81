//! What people read of a validation by a tracker's points: the sentence, the table, the warnings.

use crate::screen::{self, say};
use skclam::marker_points::{ClusteredBy, OutlierPoint, PointsFit, PointsValidation};
use skclam::pipeline::Status;

/// Beyond this the joints, the points and the rig do not belong together, or a unit is wrong, millimetres.
const LARGE_RMS_MM: f64 = 50.0;
/// More outliers than this are no accidents of an instrument.
const MANY_OUTLIERS: f64 = 0.2;
/// Outliers that are named one by one.
const NAMED: usize = 8;

/// A metric of a fit, millimetres.
type Metric = fn(&PointsFit) -> f64;

/// Sentence, metrics and clusters.
pub fn show(validation: &PointsValidation) {
    say!("{}\n", sentence(validation));
    let nominal = validation.nominal.as_ref();
    let mut table = screen::table(&["points", "nominal rig", "rig under test", "unit"]);
    let cell =
        |fit: Option<&PointsFit>, value: Metric| fit.map_or_else(|| "-".to_owned(), |fit| screen::fixed(value(fit), 3));
    let rows: [(&str, Metric); 4] = [
        ("error of position, RMS", |fit| fit.rms_mm),
        ("error of position, median", |fit| fit.median_mm),
        ("error of position, largest", |fit| fit.max_mm),
        ("sigma of a coordinate", |fit| fit.sigma_mm),
    ];
    for (name, value) in rows {
        let (before, after) = (cell(nominal, value), cell(Some(&validation.tested), value));
        table.add_row([name.to_owned(), before, after, "mm".to_owned()]);
    }
    for (at, group) in validation.tested.groups.iter().enumerate() {
        let before = nominal.and_then(|fit| fit.groups.get(at));
        let before = before.map_or_else(|| "-".to_owned(), |group| screen::fixed(group.rms_mm, 3));
        let name = format!("RMS, group {} ({} points)", group.group, group.points);
        table.add_row([name, before, screen::fixed(group.rms_mm, 3), "mm".to_owned()]);
    }
    say!("{table}\n");
    say!("{}", counts(validation));
}

/// The judgement in one sentence.
pub fn sentence(validation: &PointsValidation) -> String {
    let rms_mm = validation.tested.rms_mm;
    let (Some(nominal), Some(comparison)) = (&validation.nominal, validation.comparison) else {
        return format!(
            "The measured points lie {rms_mm:.3} mm (RMS) from where the rig puts them; \
             there is no nominal rig beside it."
        );
    };
    let Some(error) = comparison.standard_error_mm else {
        return format!(
            "Too few groups of points ({}) to distinguish the rig from the nominal one: {rms_mm:.3} mm (RMS), \
             the nominal rig {:.3} mm.",
            validation.clusters, nominal.rms_mm
        );
    };
    let metrics = format!(
        "{rms_mm:.3} mm (RMS), the nominal rig {:.3} mm, difference {:.3} mm \
         with a standard error of {error:.3} mm over {} groups",
        nominal.rms_mm, comparison.improvement_mm, validation.clusters
    );
    match comparison.status {
        Status::Good => format!("The rig is better than the nominal one by the measured points: {metrics}."),
        Status::Caution => {
            format!("The measured points do NOT distinguish the rig from the nominal one: {metrics}.")
        }
        Status::Bad => format!("The rig is WORSE than the nominal one by the measured points: {metrics}."),
    }
}

fn counts(validation: &PointsValidation) -> String {
    let clusters = match validation.clustered_by {
        ClusteredBy::Group => "groups",
        ClusteredBy::Joints => "positions of the first three joints",
    };
    let fitted = validation.tested.offsets.iter().map(|offset| {
        let [x, y, z] = offset.offset_mm;
        let sigma = offset.sigma_mm.map(|[x, y, z]| format!(" +- [{x:.2}, {y:.2}, {z:.2}]")).unwrap_or_default();
        format!("{} on the flange: [{x:.2}, {y:.2}, {z:.2}]{sigma} mm", offset.marker)
    });
    let instrument = validation.instrument_sigma_mm.map(|sigma| format!("; the instrument's sigma {sigma:.3} mm"));
    format!(
        "{} points in {} {clusters}, {} outliers{}\n{}",
        validation.points,
        validation.clusters,
        validation.outliers.len(),
        instrument.unwrap_or_default(),
        fitted.collect::<Vec<_>>().join("\n")
    )
}

/// What a user should know.
pub fn warnings(validation: &PointsValidation) -> Vec<String> {
    let mut warnings = Vec::new();
    let tested = &validation.tested;
    if tested.rms_mm > LARGE_RMS_MM {
        warnings.push(format!(
            "the points lie {:.0} mm (RMS) from where the rig puts them: do units, joints and rig belong together?",
            tested.rms_mm
        ));
    }
    let outliers = validation.outliers.len();
    if outliers as f64 > MANY_OUTLIERS * validation.points as f64 {
        warnings.push(format!("{outliers} of {} points are outliers; what is left may say little", validation.points));
    }
    if outliers > 0 {
        warnings.push(format!("points of gross error were left out: {}", named(&validation.outliers)));
    }
    for (fit, which) in [(Some(tested), "under test"), (validation.nominal.as_ref(), "to compare with")] {
        let Some(fit) = fit.filter(|fit| !fit.contradicted.is_empty()) else { continue };
        let points = named(&fit.contradicted);
        warnings.push(format!("points far off by the rig {which} alone; they count: {points}"));
    }
    for open in &tested.unobservable {
        let [x, y, z] = open.direction;
        warnings.push(format!(
            "the place of {} along [{x:.2}, {y:.2}, {z:.2}] of the flange is not observable and held at zero: \
             the flange was not turned enough",
            open.marker
        ));
    }
    warnings
}

fn named(points: &[OutlierPoint]) -> String {
    let name = |point: &OutlierPoint| {
        let index = point.index.map(|index| format!(", index {index}")).unwrap_or_default();
        format!("line {}{index} ({:.1} mm)", point.line, point.distance_mm)
    };
    let mut names: Vec<String> = points.iter().take(NAMED).map(name).collect();
    if points.len() > NAMED {
        names.push(format!("and {} more", points.len() - NAMED));
    }
    names.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use skclam::marker_points::{FittedFrame, PointsComparison, UnobservableOffset};

    fn fit(rms_mm: f64) -> PointsFit {
        PointsFit {
            rig: "arm".into(),
            points: 118,
            rms_mm,
            median_mm: 0.3,
            max_mm: 1.0,
            sigma_mm: 0.2,
            dof: 345,
            groups: Vec::new(),
            tracker_from_base: FittedFrame { translation_mm: [0.0; 3], quaternion_xyzw: [0.0, 0.0, 0.0, 1.0] },
            offsets: Vec::new(),
            unobservable: Vec::new(),
            contradicted: Vec::new(),
        }
    }

    fn validation(comparison: Option<(f64, Option<f64>, Status)>) -> PointsValidation {
        PointsValidation {
            points: 120,
            clusters: 6,
            clustered_by: ClusteredBy::Group,
            outliers: Vec::new(),
            instrument_sigma_mm: None,
            tested: fit(0.35),
            nominal: comparison.map(|_| fit(0.741)),
            comparison: comparison.map(|(improvement_mm, standard_error_mm, status)| PointsComparison {
                improvement_mm,
                standard_error_mm,
                status,
            }),
        }
    }

    #[test]
    fn good() {
        let said = sentence(&validation(Some((0.391, Some(0.05), Status::Good))));
        assert!(said.starts_with("The rig is better"), "{said}");
        assert!(said.contains(
            "0.350 mm (RMS), the nominal rig 0.741 mm, difference 0.391 mm \
             with a standard error of 0.050 mm over 6 groups"
        ));
    }

    #[test]
    fn caution() {
        let said = sentence(&validation(Some((0.391, Some(0.3), Status::Caution))));
        assert!(said.contains("do NOT distinguish"), "{said}");
    }

    #[test]
    fn bad() {
        let said = sentence(&validation(Some((-0.391, Some(0.05), Status::Bad))));
        assert!(said.contains("is WORSE") && said.contains("difference -0.391 mm"), "{said}");
    }

    #[test]
    fn too_few_groups() {
        let said = sentence(&validation(Some((0.391, None, Status::Caution))));
        assert!(said.starts_with("Too few groups of points (6)"), "{said}");
    }

    #[test]
    fn no_nominal_rig() {
        let said = sentence(&validation(None));
        assert!(said.contains("lie 0.350 mm (RMS)") && said.contains("no nominal rig"), "{said}");
    }

    #[test]
    fn warnings_name_points_and_directions() {
        let outlier = |line| OutlierPoint { line, index: Some(line as u64 - 2), group: None, distance_mm: 12.34 };
        let mut found = validation(None);
        assert!(warnings(&found).is_empty());
        found.outliers = (2..12).map(outlier).collect();
        found.tested.contradicted = vec![outlier(40)];
        found.tested.unobservable =
            vec![UnobservableOffset { marker: "ball".into(), direction: [0.0, 0.0, 1.0], sensitivity: 0.001 }];
        let said = warnings(&found).join("\n");
        for expected in [
            "left out: line 2, index 0 (12.3 mm)",
            "and 2 more",
            "under test alone; they count: line 40",
            "ball along [0.00, 0.00, 1.00]",
        ] {
            assert!(said.contains(expected), "{said} lacks {expected}");
        }
        found.outliers = (2..40).map(outlier).collect();
        found.tested.rms_mm = 300.0;
        let said = warnings(&found).join("\n");
        assert!(said.contains("38 of 120 points") && said.contains("300 mm (RMS)"), "{said}");
    }
}
