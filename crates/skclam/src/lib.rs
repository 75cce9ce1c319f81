//! Simultaneous kinematic calibration, localization and mapping: datasets, the pipeline, evaluation.

pub mod dataset;
pub mod evaluation;
pub mod output;
pub mod pipeline;
pub mod progress;
pub mod trajectory;
