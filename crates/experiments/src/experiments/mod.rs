//! The experiments, one module each.

pub mod boards_and_ruler;
pub mod flange_poses;
pub mod misspecification;
pub mod real_arm;
pub mod whole_pipeline;
