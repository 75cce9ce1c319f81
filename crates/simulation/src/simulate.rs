//! The whole experiment: from a nominal rig and a configuration to a true rig, postures and images, one at a time.

use crate::{
    Antialiasing, ArmBody, ColorNoiseOptions, DepthNoiseOptions, DiverseOptions, EncoderNoiseOptions, PaperView,
    PerturbationSigmas, Renderer, Scene, SceneOptions, SimulationError, diverse_postures, paper_postures,
    perturb_paper, perturb_random,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};
use skclam_geometry::{DepthImage, Isometry3};
use skclam_rig::{Posture, PostureState, Rig, joint_readings};

/// How the true arm differs from the nominal one.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum Perturbation {
    /// Not at all.
    None,
    /// As in the paper: +1 deg on alpha and theta offset of joints 2 to 6.
    #[default]
    Paper,
    /// Normal errors on every parameter and on the mount.
    Random {
        /// Other seeds give other arms.
        seed: u64,
        /// How large the errors are.
        #[serde(default)]
        sigmas: PerturbationSigmas,
    },
}

/// Which postures are taken.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "snake_case", tag = "kind")]
pub enum PosturePlan {
    /// The 73 postures of section 4.1.1.
    Paper {
        /// The one flange pose, given by where the camera is.
        #[serde(default)]
        view: PaperView,
    },
    /// Postures all over the arm's workspace, each overlapping with the one before.
    Diverse {
        /// How they are drawn.
        #[serde(default)]
        options: DiverseOptions,
    },
}

impl Default for PosturePlan {
    fn default() -> Self {
        PosturePlan::Paper { view: PaperView::default() }
    }
}

/// Everything about a simulated data set except the nominal rig. Default: the paper's experiment without image noise,
/// with the noise of a depth camera.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulationConfig {
    /// The cell.
    pub scene: SceneOptions,
    /// The true arm.
    pub perturbation: Perturbation,
    /// The postures.
    pub postures: PosturePlan,
    /// How smooth edges are.
    pub antialiasing: Antialiasing,
    /// Noise of the colour image.
    pub color_noise: ColorNoiseOptions,
    /// Noise of the depth image.
    pub depth_noise: DepthNoiseOptions,
    /// Noise of the joints.
    pub encoder_noise: EncoderNoiseOptions,
    /// Only the first so many postures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub first_postures: Option<usize>,
}

/// What one posture gave.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The posture as a controller would write it down: commanded joints.
    pub posture: Posture,
    /// Where the joints really were, radians or metres.
    pub true_joint_values: Vec<f64>,
    /// Where the colour camera really was.
    pub true_base_from_color: Isometry3,
    /// Colour image.
    pub color: RgbImage,
    /// Depth in whole units of the depth camera, where the rig has one; see [`depth_counts`](crate::depth_counts).
    pub depth: Option<DepthImage>,
}

/// A prepared simulation: everything but the images, which are drawn on demand.
#[derive(Debug)]
pub struct Simulation {
    config: SimulationConfig,
    nominal: Rig,
    truth: Rig,
    scene: Scene,
    body: ArmBody,
    postures: Vec<Posture>,
    color: Renderer,
    depth: Option<Renderer>,
}

impl Simulation {
    /// Draws scene, true arm and postures. Errors: no arm, options out of range, postures that cannot be had.
    pub fn new(nominal: &Rig, config: &SimulationConfig) -> Result<Self, SimulationError> {
        config.color_noise.check()?;
        config.depth_noise.check()?;
        config.encoder_noise.check()?;
        let chain = nominal.robot.as_ref().ok_or(SimulationError::NoRobot)?;
        let truth = match &config.perturbation {
            Perturbation::None => nominal.clone(),
            Perturbation::Paper => perturb_paper(nominal)?,
            Perturbation::Random { seed, sigmas } => perturb_random(nominal, *seed, sigmas)?,
        };
        let color = Renderer::new(&nominal.color, config.antialiasing)?;
        let depth = nominal.depth.as_ref().map(|d| Renderer::new(&d.camera, Antialiasing::None)).transpose()?;
        let scene = Scene::new(&config.scene, nominal.color.fx)?;
        let body = ArmBody::new(&truth, config.scene.seed, 1e-3 * (1371.0 / nominal.color.fx).clamp(0.5, 8.0))?;
        let mut joint_values = match &config.postures {
            PosturePlan::Paper { view } => paper_postures(chain, &view.base_from_flange(nominal))?,
            PosturePlan::Diverse { options } => diverse_postures(nominal, &scene, options)?,
        };
        if let Some(count) = config.first_postures {
            joint_values.truncate(count);
        }
        let postures = joint_values
            .into_iter()
            .zip(0u64..)
            .map(|(values, index)| Posture::new(index, PostureState::Joints(values)))
            .collect();
        Ok(Simulation { config: config.clone(), nominal: nominal.clone(), truth, scene, body, postures, color, depth })
    }

    /// The true rig: arm, mount and cameras as they are.
    pub fn true_rig(&self) -> &Rig {
        &self.truth
    }

    /// The nominal rig that came in.
    pub fn nominal_rig(&self) -> &Rig {
        &self.nominal
    }

    /// The static scene, the ground truth of a map.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// The arm's body with true parameters.
    pub fn arm_body(&self) -> &ArmBody {
        &self.body
    }

    /// The postures as commanded.
    pub fn postures(&self) -> &[Posture] {
        &self.postures
    }

    /// What the configuration was.
    pub fn config(&self) -> &SimulationConfig {
        &self.config
    }

    /// Takes the images of one posture (counted from 0). The true arm is where its joints, noise included, and
    /// its true parameters put it. Errors: no such posture.
    pub fn capture(&self, number: usize) -> Result<Capture, SimulationError> {
        let posture = self.postures.get(number).ok_or_else(|| SimulationError::Option {
            option: "posture",
            value: number.to_string(),
            need: "a number below the number of postures is needed",
        })?;
        let (PostureState::Joints(commanded), Some(chain)) = (&posture.state, self.truth.robot.as_ref()) else {
            return Err(SimulationError::NoRobot);
        };
        let index = posture.index;
        let noisy = self.config.encoder_noise.apply(chain, commanded, index)?;
        let corrections = &self.truth.joint_corrections;
        let true_joint_values = if corrections.is_none() {
            noisy
        } else {
            corrections.applied(&joint_readings(chain, &noisy, &posture.joint_rates)?)
        };
        let true_base_from_color = chain.base_from_flange(&true_joint_values)? * self.truth.flange_from_color;
        let body = self.body.model_at(&true_joint_values)?;
        let models = [&self.scene.model, &body];
        let mut color = self.color.color(&true_base_from_color, &models);
        self.config.color_noise.apply(&mut color, index)?;
        let depth = match (&self.depth, &self.truth.depth) {
            (Some(renderer), Some(camera)) => {
                let exact = renderer.depth(&(true_base_from_color * camera.color_from_depth), &models);
                Some(self.config.depth_noise.apply(&exact, camera.unit_m, index)?)
            }
            _ => None,
        };
        Ok(Capture { posture: posture.clone(), true_joint_values, true_base_from_color, color, depth })
    }

    /// All captures in order, each drawn when it is asked for.
    pub fn captures(&self) -> impl Iterator<Item = Result<Capture, SimulationError>> + '_ {
        (0..self.postures.len()).map(|number| self.capture(number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth_counts;
    use skclam_geometry::{DepthCamera, Pixel, Point3};

    fn small_rig() -> Rig {
        let mut rig = skclam_rig::builtin_rig("hp3j").unwrap().unwrap();
        rig.color = rig.color.scaled(0.125);
        rig.depth = rig.depth.map(|depth| DepthCamera { camera: depth.camera.scaled(0.25), ..depth });
        rig
    }

    fn config() -> SimulationConfig {
        SimulationConfig {
            scene: SceneOptions { texel_at_1m_mm: Some(16.0), ..Default::default() },
            ..Default::default()
        }
    }

    #[test]
    fn captures_are_taken_by_the_true_arm_and_repeat() {
        let rig = small_rig();
        let noisy = SimulationConfig {
            color_noise: ColorNoiseOptions { sensor_sigma: 2.0, ..ColorNoiseOptions::paper() },
            encoder_noise: EncoderNoiseOptions { sigma_deg: 0.01, ..Default::default() },
            ..config()
        };
        let simulation = Simulation::new(&rig, &noisy).unwrap();
        assert_eq!(simulation.postures().len(), 73);
        let capture = simulation.capture(5).unwrap();
        let chain = simulation.true_rig().robot.as_ref().unwrap();
        let expected = chain.base_from_flange(&capture.true_joint_values).unwrap() * rig.flange_from_color;
        assert_eq!(capture.true_base_from_color, expected);
        let PostureState::Joints(commanded) = &capture.posture.state else { panic!("joints") };
        let noise: Vec<f64> =
            commanded.iter().zip(&capture.true_joint_values).map(|(a, b)| (b - a).to_degrees()).collect();
        assert!(
            noise.iter().all(|error| error.abs() < 0.05) && noise.iter().any(|error| error.abs() > 1e-4),
            "{noise:?}"
        );
        let nominal = rig.base_from_color(&capture.posture).unwrap();
        assert!(
            (nominal.translation.vector - expected.translation.vector).norm() > 1e-3,
            "the true arm is another one"
        );
        assert_eq!((capture.color.width(), capture.color.height()), (240, 135));
        // Another simulation, another order: the same bytes.
        let again = Simulation::new(&rig, &noisy).unwrap().capture(5).unwrap();
        assert_eq!(capture.color, again.color);
        assert_eq!(capture.depth, again.depth);
        assert_ne!(capture.color, simulation.capture(6).unwrap().color);
        assert!(simulation.capture(73).is_err());
    }

    #[test]
    fn gears_of_the_rig_turn_the_true_arm() {
        let mut rig = small_rig();
        let one = skclam_rig::JointCorrection { transmission_sin: 2e-3, transmission_cos: 1e-3, compliance: 1e-3 };
        rig.joint_corrections.joints = vec![one; 6];
        let simulation =
            Simulation::new(&rig, &SimulationConfig { perturbation: Perturbation::None, ..config() }).unwrap();
        let capture = simulation.capture(5).unwrap();
        let expected = rig.base_from_color(&capture.posture).unwrap();
        assert!((capture.true_base_from_color.to_homogeneous() - expected.to_homogeneous()).norm() < 1e-12);
        rig.joint_corrections = Default::default();
        let without = rig.base_from_color(&capture.posture).unwrap();
        assert!((without.translation.vector - expected.translation.vector).norm() > 1e-4);
    }

    #[test]
    fn exact_depth_and_pose_put_points_on_the_scene() {
        let rig = small_rig();
        let exact = SimulationConfig { depth_noise: DepthNoiseOptions::none(), ..config() };
        let simulation = Simulation::new(&rig, &exact).unwrap();
        let capture = simulation.capture(17).unwrap();
        let (depth, camera) = (capture.depth.unwrap(), rig.depth.unwrap());
        let eye = Point3::from(capture.true_base_from_color.translation.vector);
        let (mut near, mut all) = (0, 0);
        for (x, y) in (0..depth.height()).flat_map(|y| (0..depth.width()).map(move |x| (x, y))) {
            let Some(z) = depth.at(x, y) else { continue };
            let pixel = Pixel::new(f64::from(x), f64::from(y));
            let point = capture.true_base_from_color * camera.point_in_color(&pixel, f64::from(z));
            let way = (point - eye).normalize();
            let hit = simulation.scene().caster().first_hit(&eye, &way, 20.0).unwrap();
            all += 1;
            near += usize::from((hit.distance - (point - eye).norm()).abs() < 0.002);
        }
        // The colour camera beside the depth camera sees past some edges.
        assert!(all > 9000 && near as f64 > 0.95 * all as f64, "{near} of {all}");
        assert_eq!(depth_counts(&depth, 0.001).len(), 120 * 90);
    }

    #[test]
    fn a_rig_without_an_arm_or_with_bad_options_is_refused() {
        let rig = Rig { robot: None, ..small_rig() };
        assert!(matches!(Simulation::new(&rig, &config()), Err(SimulationError::NoRobot)));
        let mut bad = config();
        bad.color_noise.blur_size = 6;
        assert!(matches!(
            Simulation::new(&small_rig(), &bad),
            Err(SimulationError::Option { option: "blur_size", .. })
        ));
        let mut bad = config();
        bad.scene.texel_at_1m_mm = Some(f64::NAN);
        assert!(matches!(
            Simulation::new(&small_rig(), &bad),
            Err(SimulationError::Option { option: "texel_at_1m_mm", .. })
        ));
    }

    #[test]
    fn configurations_survive_a_file_and_unknown_keys_are_named() {
        let drawn = SimulationConfig {
            perturbation: Perturbation::Random { seed: 4, sigmas: PerturbationSigmas::default() },
            postures: PosturePlan::Diverse { options: DiverseOptions::default() },
            first_postures: Some(5),
            ..config()
        };
        for config in [SimulationConfig::default(), drawn] {
            let text = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<SimulationConfig>(&text).unwrap(), config);
        }
        assert_eq!(serde_json::from_str::<SimulationConfig>("{}").unwrap(), SimulationConfig::default());
        for (text, key) in [
            (r#"{"scenery": {}}"#, "scenery"),
            (r#"{"color_noise": {"blur": 9}}"#, "blur"),
            (r#"{"perturbation": {"kind": "random", "seed": 1, "sigma": 2}}"#, "sigma"),
            (r#"{"postures": {"kind": "paper", "view": {"tilt": 1.0}}}"#, "tilt"),
        ] {
            let error = serde_json::from_str::<SimulationConfig>(text).unwrap_err().to_string();
            assert!(error.contains("unknown field") && error.contains(key), "{error}");
        }
    }
}
