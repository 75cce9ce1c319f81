//! The spine: one run from images and joints to a calibrated rig and a map.

mod pairing;
mod registered_depth;

pub use pairing::{ImagePair, Pairing, PairingOptions, PredictedView, choose_pairs};
pub use registered_depth::RegisteredDepth;
