//! One file a command.

pub mod evaluate;
pub mod map;
pub mod render;
pub mod reproduce;
pub mod run;
pub mod simulate;
