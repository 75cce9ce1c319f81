//! Simultaneous kinematic calibration, localization and mapping: datasets, the pipeline, evaluation.
