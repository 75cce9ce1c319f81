//! One file a command.

pub mod compensate;
pub mod evaluate;
pub mod export;
pub mod import;
pub mod map;
pub mod render;
pub mod reproduce;
pub mod run;
pub mod simulate;
