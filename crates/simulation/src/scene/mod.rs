//! The scene: a workshop around a table-top arm, the same for the same seed.

mod builder;
mod canvas;
mod cell;
mod lattice;
mod light;
mod material;
mod model;
mod print;
mod raycast;
mod texture;
mod weathering;

pub use model::{Face, Model, Triangle};
pub use raycast::{Hit, RayCaster};
pub use texture::Texture;

pub(crate) use builder::{Builder, CuboidMaterials, TexelRule};
pub(crate) use light::light_on_moving;
pub(crate) use material::Material;
pub(crate) use texture::Footprint;

use crate::SimulationError;
use serde::{Deserialize, Serialize};

/// How the scene is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SceneOptions {
    /// Other seeds give other furniture and other textures.
    pub seed: u64,
    /// Size of a texel on a surface one metre from the nearest camera, millimetres. Textures take memory and time
    /// with its inverse square; more than one texel a pixel is of no use. `None`: as the colour camera needs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub texel_at_1m_mm: Option<f64>,
}

impl Default for SceneOptions {
    fn default() -> Self {
        SceneOptions { seed: 1, texel_at_1m_mm: None }
    }
}

/// The static part of the cell, in base.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Faces, triangles, textures.
    pub model: Model,
    caster: RayCaster,
    plain_texture: Vec<bool>,
}

/// A focal length of 1371 px is the paper's camera: at 1 m a pixel sees 0.73 mm.
const TEXELS_PER_PIXEL: f64 = 0.6;

impl Scene {
    /// Draws the scene for a camera of this focal length (pixels), from which the texel size follows unless the
    /// options give one. Errors: an option out of range.
    pub fn new(options: &SceneOptions, focal_px: f64) -> Result<Self, SimulationError> {
        let texel_mm = options.texel_at_1m_mm.unwrap_or(1000.0 / (focal_px * TEXELS_PER_PIXEL));
        if !(0.3..=50.0).contains(&texel_mm) {
            return Err(SimulationError::Option {
                option: "texel_at_1m_mm",
                value: texel_mm.to_string(),
                need: "0.3 to 50 is needed (or a focal length of 27 to 4400 px)",
            });
        }
        let mut builder = Builder::new(TexelRule::FromReach { texel_at_1m: 1e-3 * texel_mm, reach_m: 0.5 });
        cell::furnish(&mut builder, options.seed);
        let (model, sheets) = builder.finish(options.seed, 1000, true);
        let caster = RayCaster::new(&model);
        let plain_texture = sheets.iter().map(|sheet| sheet.material.is_plain()).collect();
        Ok(Scene { model, caster, plain_texture })
    }

    /// For rays against the scene.
    pub fn caster(&self) -> &RayCaster {
        &self.caster
    }

    /// Whether a face has next to no texture.
    pub fn is_plain(&self, face: u32) -> bool {
        self.plain_texture[self.model.faces[face as usize].texture as usize]
    }

    /// Number of separate surfaces (a cylinder's side is one).
    pub fn surface_count(&self) -> usize {
        self.model.textures.len()
    }
}
