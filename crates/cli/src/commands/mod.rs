//! One file a command.

pub mod compensate;
pub mod evaluate;
pub mod export;
pub mod import;
pub mod inspect;
pub mod map;
pub mod render;
pub mod report;
pub mod reproduce;
pub mod run;
pub mod simulate;
pub mod validate;
mod validate_points;
