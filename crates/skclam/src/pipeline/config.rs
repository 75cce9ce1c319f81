//! Everything that can be set in a run. The values that were in force are in every `summary.json`.

use super::{HeldOutOptions, Pairing, PairingOptions, RunError, Search};
use serde::{Deserialize, Serialize};
use skclam_calibration::{BundleOptions, Free, NelderMeadOptions, PairwiseOptions};
use skclam_features::akaze::Threading;
use skclam_features::{
    AkazeOptions, BoardOptions, FilterOptions, MaskOptions, RansacOptions, RefineOptions, TrackOptions,
};
use skclam_geometry::PinholeCamera;
use skclam_mapping::{CloudOptions, PointDepths};

/// Which estimator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Estimator {
    /// Eq. (7) minimised by Nelder-Mead: the paper's.
    NelderMead,
    /// Robust least squares on Sampson distances of pairs.
    Sampson,
    /// Bundle adjustment over tracks.
    Bundle,
}

/// What is used where the rig has a board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BoardUse {
    /// The board alone where (nearly) every posture shows it and there is no depth to use; together elsewhere.
    #[default]
    Auto,
    /// Corners of the board alone; postures that do not show it contribute nothing.
    Alone,
    /// Corners and natural features.
    Together,
}

/// The settings of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Seed of every random choice.
    pub seed: u64,
    /// Which parameters are free.
    pub free: Free,
    /// Detector and descriptor.
    pub akaze: AkazeOptions,
    /// Choice of pairs.
    pub pairing: PairingOptions,
    /// How candidates are searched.
    pub search: Search,
    /// `theta_th` of Eq. (6), degrees: how far a match may be from the epipolar line that the nominal arm predicts.
    /// `None`: no gate.
    pub epipolar_gate_deg: Option<f64>,
    /// The filters of section 3.2; the gate's pixels follow from `epipolar_gate_deg`, RANSAC's seed from `seed`.
    pub filter: FilterOptions,
    /// Looks for what moves with the camera (gripper, cable) and leaves it out; `None`: not.
    pub mask: Option<MaskOptions>,
    /// Joins matches to tracks over many images; `None`: pairs alone.
    pub tracks: Option<TrackOptions>,
    /// Observations that the estimator takes at most (approximately), from tracks evenly over the recording; `None`:
    /// all.
    pub max_observations: Option<usize>,
    /// Aligns the patches of a track's observations to a few hundredths of a pixel; `None`: positions as detected.
    pub refine: Option<RefineOptions>,
    /// Detector of the rig's board.
    pub board: BoardOptions,
    /// Whether natural features are used beside the board.
    pub board_use: BoardUse,
    /// Which estimator.
    pub estimator: Estimator,
    /// Settings of Nelder-Mead; what is free is said above, and [`Config::check`] refuses another `free` here.
    pub nelder_mead: NelderMeadOptions,
    /// Settings of the pairwise least squares; `free` as above.
    pub pairwise: PairwiseOptions,
    /// Settings of the bundle adjustment; `free` as above.
    pub bundle: BundleOptions,
    /// Judges the calibration on postures that it was not fitted to; `None`: not.
    pub held_out: Option<HeldOutOptions>,
    /// Edge of the map's voxels, metres; `None`: what the depth camera resolves at the range at which it was used.
    pub voxel_m: Option<f64>,
    /// The map; its voxels are set by `voxel_m` above.
    pub cloud: CloudOptions,
}

impl Default for Config {
    fn default() -> Self {
        Config {
            seed: 1,
            free: Free::Auto,
            akaze: AkazeOptions::default(),
            pairing: PairingOptions::default(),
            search: Search::Guided,
            epipolar_gate_deg: Some(7.3),
            filter: FilterOptions::default(),
            mask: Some(MaskOptions::default()),
            tracks: Some(TrackOptions::default()),
            max_observations: Some(90_000),
            refine: Some(RefineOptions::default()),
            board: BoardOptions::default(),
            board_use: BoardUse::default(),
            estimator: Estimator::Bundle,
            nelder_mead: NelderMeadOptions::default(),
            pairwise: PairwiseOptions::default(),
            bundle: BundleOptions::default(),
            held_out: Some(HeldOutOptions::default()),
            voxel_m: None,
            cloud: CloudOptions::default(),
        }
    }
}

impl Config {
    /// The paper to the letter: sections 3.2 and 3.3, `theta_th = 7.3 deg`, the 30 best of neighbouring pairs, the ten
    /// angles.
    pub fn paper() -> Self {
        Config {
            free: Free::Angles,
            pairing: PairingOptions { pairing: Pairing::Adjacent, ..PairingOptions::default() },
            search: Search::Exhaustive,
            // The paper names no threshold for RANSAC; half a pixel is what its 30 best matches keep to.
            filter: FilterOptions {
                ransac: Some(RansacOptions { threshold_px: 0.5, ..RansacOptions::default() }),
                ..FilterOptions::paper()
            },
            mask: None,
            tracks: None,
            refine: None,
            estimator: Estimator::NelderMead,
            cloud: CloudOptions { depths: PointDepths::Measured, ..CloudOptions::default() },
            ..Config::default()
        }
    }

    /// These settings with every key replaced that a JSON text gives; of a whole `summary.json` its `configuration` is
    /// taken.
    ///
    /// # Errors
    /// Text that is no JSON, unknown keys, values of another type, numbers that are too large for their setting, and
    /// what [`Config::check`] refuses.
    pub fn overlaid(&self, text: &str) -> Result<Config, serde_json::Error> {
        let mut given: serde_json::Value = serde_json::from_str(text)?;
        if let Some(inner) = given.get_mut("configuration") {
            given = inner.take();
        }
        let mut merged = serde_json::to_value(self)?;
        overlay(&mut merged, given);
        let config: Config = serde_json::from_value(merged.clone())?;
        // A number beyond a setting's precision becomes infinite, which JSON has no word for.
        if let Some((key, number)) = overflowing(&merged, &serde_json::to_value(&config)?) {
            return Err(serde::de::Error::custom(format!("{key}: {number} is too large; a finite number is needed")));
        }
        config.check().map_err(<serde_json::Error as serde::de::Error>::custom)?;
        Ok(config)
    }

    /// Refuses settings of single modules that the run's own settings override: they would be without effect.
    ///
    /// # Errors
    /// [`RunError::Overridden`] for one that is neither its module's default nor the value in force.
    pub fn check(&self) -> Result<(), RunError> {
        let free =
            |key: &'static str, given: &Free, default: Free| (key, "free", *given != default && *given != self.free);
        let seed = self.filter.ransac.as_ref().map(|ransac| ransac.seed);
        let (default_seed, threading) = (RansacOptions::default().seed, self.akaze.threading);
        let voxel_m = self.cloud.voxel_m;
        let settings = [
            free("nelder_mead.free", &self.nelder_mead.free, NelderMeadOptions::default().free),
            free("pairwise.free", &self.pairwise.free, PairwiseOptions::default().free),
            free("bundle.free", &self.bundle.free, BundleOptions::default().free),
            ("filter.ransac.seed", "seed", seed.is_some_and(|seed| seed != default_seed && seed != self.seed)),
            ("filter.gate_px", "epipolar_gate_deg", self.filter.gate_px != FilterOptions::default().gate_px),
            ("cloud.voxel_m", "voxel_m", voxel_m != CloudOptions::default().voxel_m && voxel_m != self.voxel_m),
            // One image a thread is quicker than bands of one image, and the result is the same.
            (
                "akaze.threading",
                "the number of threads",
                threading != AkazeOptions::default().threading && threading != Threading::Caller,
            ),
        ];
        match settings.into_iter().find(|(_, _, overridden)| *overridden) {
            Some((key, by, _)) => Err(RunError::Overridden { key, by }),
            None => Ok(()),
        }
    }

    /// The filters with the gate in pixels, Eq. (6): `d_th = theta_th / theta_h * q_h`, and with this run's seed.
    pub fn filter(&self, camera: &PinholeCamera) -> FilterOptions {
        let gate_px = self.epipolar_gate_deg.map(|angle| angle.to_radians() / camera.hfov() * f64::from(camera.width));
        let ransac = self.filter.ransac.clone().map(|ransac| RansacOptions { seed: self.seed, ..ransac });
        FilterOptions { gate_px, ransac, ..self.filter.clone() }
    }
}

fn overlay(base: &mut serde_json::Value, given: serde_json::Value) {
    match (base, given) {
        (serde_json::Value::Object(base), serde_json::Value::Object(given)) => {
            for (key, value) in given {
                overlay(base.entry(key).or_insert(serde_json::Value::Null), value);
            }
        }
        (base, given) => *base = given,
    }
}

/// The key and the number of the first setting that was given as a number and is none.
fn overflowing(given: &serde_json::Value, kept: &serde_json::Value) -> Option<(String, String)> {
    use serde_json::Value::{Array, Null, Number, Object};
    let below = |key: &str, inner: (String, String)| match inner.0.is_empty() {
        true => (key.to_owned(), inner.1),
        false => (format!("{key}.{}", inner.0), inner.1),
    };
    match (given, kept) {
        (Number(number), Null) => Some((String::new(), number.to_string())),
        (Object(given), Object(kept)) => {
            given.iter().find_map(|(key, value)| Some(below(key, overflowing(value, kept.get(key)?)?)))
        }
        (Array(given), Array(kept)) => given
            .iter()
            .zip(kept)
            .enumerate()
            .find_map(|(at, (given, kept))| Some(below(&at.to_string(), overflowing(given, kept)?))),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_gate_is_200_px() {
        let camera = PinholeCamera::from_hfov(1920, 1080, 70f64.to_radians());
        let gate_px = Config::paper().filter(&camera).gate_px.unwrap();
        assert!((gate_px - 200.0).abs() < 0.5, "{gate_px}");
    }

    #[test]
    fn a_configuration_survives_json_and_unknown_keys_do_not() {
        let config = Config::paper();
        let text = serde_json::to_string(&config).unwrap();
        assert_eq!(serde_json::from_str::<Config>(&text).unwrap(), config);
        assert!(serde_json::from_str::<Config>(r#"{"sed": 3}"#).unwrap_err().to_string().contains("sed"));
    }

    #[test]
    fn a_file_replaces_only_what_it_names() {
        let config = Config::paper().overlaid(r#"{"filter": {"best": 50}, "seed": 9}"#).unwrap();
        let mut expected = Config::paper();
        expected.filter.best = Some(50);
        expected.seed = 9;
        assert_eq!(config, expected);
        let summary =
            format!(r#"{{"program": "skclam", "configuration": {}}}"#, serde_json::to_string(&expected).unwrap());
        assert_eq!(Config::default().overlaid(&summary).unwrap(), expected);
        assert!(Config::default().overlaid(r#"{"filter": {"bets": 50}}"#).unwrap_err().to_string().contains("bets"));
    }

    #[test]
    fn settings_without_effect_are_refused_by_name() {
        for config in [Config::default(), Config::paper()] {
            config.check().unwrap();
        }
        let wrong = [
            (r#"{"bundle": {"free": "all"}}"#, "bundle.free"),
            (r#"{"pairwise": {"free": "all"}}"#, "pairwise.free"),
            (r#"{"nelder_mead": {"free": "all"}}"#, "nelder_mead.free"),
            (r#"{"filter": {"ransac": {"seed": 77}}}"#, "filter.ransac.seed"),
            (r#"{"filter": {"gate_px": 50.0}}"#, "filter.gate_px"),
            (r#"{"cloud": {"voxel_m": 0.5}}"#, "cloud.voxel_m"),
        ];
        for (text, key) in wrong {
            let message = Config::paper().overlaid(text).unwrap_err().to_string();
            assert!(message.contains(key), "{text}: {message}");
        }
        let same = Config::default().overlaid(r#"{"voxel_m": 0.5, "cloud": {"voxel_m": 0.5}}"#).unwrap();
        assert_eq!(same.voxel_m, Some(0.5));
    }
}
