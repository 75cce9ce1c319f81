//! A rig on a recording that it was not fitted to: another day, other postures, the camera taken off and put back.

use super::gather::{Gathered, gather};
use super::verdict::UNEXPLAINED_PX;
use super::{Config, RunError, SurfaceAgreement, localize, surface_agreement};
use crate::dataset::Dataset;
use crate::progress::{Progress, Stage};
use serde::{Deserialize, Serialize};
use skclam_calibration::{
    BundleOptions, Comparison, Correspondences, EpipolarStatistics, Free, Model, MountComponent, Parameter,
    PostureErrorPolicy, PriorPolicy, ReprojectionStatistics, Rigs, calibrate_bundle, compare_models,
};
use skclam_geometry::Isometry3;
use skclam_rig::Rig;

/// How a rig fares beside the nominal one of the data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Validation {
    /// The judgement in one sentence.
    pub verdict: String,
    /// Name of the rig under test.
    pub rig: String,
    /// What was fitted anew on this recording, for both rigs alike; "" for nothing.
    pub refit: String,
    /// Postures of the recording.
    pub postures: usize,
    /// Pair matches.
    pub matches: usize,
    /// Sights of points followed over several images.
    pub observations: usize,
    /// By which figure rigs are judged: "reprojection, RMS" or "epipolar distance, median".
    pub figure: String,
    /// That figure, px: the nominal rig of the data set and (as `calibrated`) the rig under test.
    pub figure_px: Rigs<f64>,
    /// Reprojection over the sights that fit one of the rigs.
    pub reprojection: Rigs<ReprojectionStatistics>,
    /// Epipolar distances of the pair matches.
    pub epipolar: Rigs<EpipolarStatistics>,
    /// How far apart the depth images are; `null` without depth.
    pub depth_agreement: Option<Rigs<SurfaceAgreement>>,
    /// What a person should hear of.
    pub warnings: Vec<String>,
}

/// Measures `rig` on a data set, beside the data set's own. With `refit`, those parameters of either rig are fitted to the data set first, and
/// nothing else: `mount` after the camera was taken off.
pub fn validate(
    dataset: &Dataset,
    rig: &Rig,
    refit: Option<&Free>,
    config: &Config,
    progress: &dyn Progress,
) -> Result<Validation, RunError> {
    let Gathered { data, .. } = gather(dataset, config, progress)?;
    progress.begin(Stage::Validate, 2);
    let fitted = |rig: &Rig| -> Result<Model, RunError> {
        let model = match refit {
            None => Model::new(rig.clone()),
            Some(free) => refitted(rig, free, &data, config)?,
        };
        progress.step();
        Ok(model)
    };
    let (nominal, tested) = (fitted(&dataset.rig)?, fitted(rig)?);
    let everything: Vec<usize> = (0..dataset.len()).collect();
    let models = Rigs { nominal: &nominal, mount_only: None, calibrated: &tested };
    let comparison = compare_models(models, &data, &everything, SIGMA_PX)?;
    let figure_px = comparison.metric_px();
    let figure = if comparison.reprojection.calibrated.observations > 0 {
        "reprojection, RMS"
    } else {
        "epipolar distance, median"
    };
    let poses = |rig: &Rig| -> Result<Vec<Isometry3>, RunError> {
        Ok(localize(dataset, rig)?.into_iter().map(|stamped| stamped.base_from_camera).collect())
    };
    let (nominal_poses, tested_poses) = (poses(&nominal.rig)?, poses(&tested.rig)?);
    let [before, after] = surface_agreement(dataset, [&nominal_poses, &tested_poses], &dataset.rig)?;
    let depth_agreement =
        before.surfaces.zip(after.surfaces).map(|(nominal, calibrated)| Rigs { nominal, mount_only: None, calibrated });
    let refit = refit.map(label).unwrap_or_default();
    Ok(Validation {
        verdict: verdict(figure, figure_px, &refit, &comparison, depth_agreement.as_ref()),
        rig: rig.name.clone(),
        refit,
        postures: dataset.len(),
        matches: data.match_count(),
        observations: data.observation_count(),
        figure: figure.to_owned(),
        figure_px,
        reprojection: comparison.reprojection,
        epipolar: comparison.epipolar,
        depth_agreement,
        warnings: Vec::new(),
    })
}

/// Expected sigma of a sight, px: only for the gate beyond which a sight that fits neither rig counts as a wrong match.
const SIGMA_PX: f64 = 1.0;

fn refitted(rig: &Rig, free: &Free, data: &Correspondences, config: &Config) -> Result<Model, RunError> {
    let options = BundleOptions {
        free: free.clone(),
        // What is refitted has moved: its old value says nothing of the new one.
        priors: PriorPolicy::Never,
        posture_errors: PostureErrorPolicy::Off,
        ..config.bundle.clone()
    };
    Ok(calibrate_bundle(rig, data, &options)?.model)
}

/// The mount by its name, anything else by its parameters.
fn label(free: &Free) -> String {
    let mount = Free::List(MountComponent::ALL.map(Parameter::Mount).to_vec());
    if *free == mount { "the mount".to_owned() } else { free.to_string() }
}

/// A rig under which the depth images lie farther apart than this times the other's does not hold.
const WORSE_AGREEMENT: f64 = 1.05;
/// A figure over fewer of the sights says little of the rig.
const MANY_LEFT_OUT: f64 = 0.5;

fn verdict(
    figure: &str,
    px: Rigs<f64>,
    refit: &str,
    comparison: &Comparison,
    depth: Option<&Rigs<SurfaceAgreement>>,
) -> String {
    let with = if refit.is_empty() { String::new() } else { format!(", after fitting {refit} of both anew") };
    let sights = comparison.reprojection.calibrated;
    let left_out = 1.0 - sights.inliers as f64 / sights.observations.max(1) as f64;
    let share = match sights.observations {
        0 => String::new(),
        _ => format!(", without the {:.0} % of the sights that fit neither", 100.0 * left_out),
    };
    let figures =
        format!("{figure}: {:.2} px, the data set's own rig {:.2} px{share}{with}", px.calibrated, px.nominal);
    let lines = comparison.epipolar.calibrated;
    if px.calibrated >= px.nominal {
        format!("The rig does NOT beat the data set's own on this recording ({figures}).")
    } else if lines.matches > 0 && lines.median_px > UNEXPLAINED_PX
        || sights.observations > 0 && left_out > MANY_LEFT_OUT
    {
        format!(
            "The rig is better than the data set's own, but it does NOT explain this recording: matches keep {:.1} px from their lines in the median ({figures}).",
            lines.median_px
        )
    } else if let Some(depth) = depth.filter(|d| d.calibrated.median_mm > d.nominal.median_mm * WORSE_AGREEMENT) {
        format!(
            "The rig fits the images, but NOT the depth: its depth images lie {:.1} mm apart, those of the data set's own rig {:.1} mm; is its scale right? ({figures}).",
            depth.calibrated.median_mm, depth.nominal.median_mm
        )
    } else {
        format!("The rig holds on this recording ({figures}).")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rig_holds_only_where_it_explains_the_recording() {
        fn rigs<T>(nominal: T, calibrated: T) -> Rigs<T> {
            Rigs { nominal, mount_only: None, calibrated }
        }
        let said = |median_px: f64, inliers: usize, apart: f64| {
            let lines = EpipolarStatistics { matches: 100, median_px, ..Default::default() };
            let sights = ReprojectionStatistics { observations: 100, inliers, ..Default::default() };
            let comparison = Comparison { reprojection: rigs(sights, sights), epipolar: rigs(lines, lines) };
            let surfaces = |median_mm| SurfaceAgreement { median_mm, ..Default::default() };
            let depth = rigs(surfaces(5.0), surfaces(apart));
            verdict("reprojection, RMS", rigs(9.0, 1.0), "", &comparison, Some(&depth))
        };
        assert!(
            said(0.2, 95, 5.0).starts_with("The rig holds") && said(0.2, 95, 5.0).contains("the 5 % of the sights")
        );
        assert!(said(3.0, 95, 5.0).contains("does NOT explain"));
        assert!(said(0.2, 30, 5.0).contains("does NOT explain"));
        assert!(said(0.2, 95, 9.0).contains("NOT the depth"));
    }
}
