//! Experiments that judge what SKCLAM says of itself: virtual cells whose truth is known, and what a run claims of
//! them.
//!
//! Each experiment is a command of this crate's program (`cargo run --release -p skclam-experiments -- EXPERIMENT
//! --help`) that prints Markdown tables as its rows finish; the tables are kept, dated, under `benchmarks/truth/`. What
//! an experiment needs of a run passes through one module, [`measured`].
//!
//! | experiment | question |
//! | --- | --- |
//! | `whole-pipeline` | do sigmas, intervals and the predicted sigma hold on random cells with images? |
//! | `misspecification` | what does a run claim, and which cause does it name, when one assumption is wrong? |
//! | `flange-poses` | is the mount found by default as well as by `--free mount` when the controller's arm is wrong? |
//! | `real-arm` | does a real arm come out better than nominal by a tracker, and do two days agree? |
//! | `boards-and-ruler` | what does a run claim when the depth camera's scale is wrong? |

pub mod causes;
pub mod cells;
pub mod experiments;
pub mod gauge;
pub mod limited;
pub mod measured;
pub mod rows;
pub mod statistics;
pub mod true_poses;
pub mod two_days;
pub mod verdict_rules;
