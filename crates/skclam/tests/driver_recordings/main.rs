//! Recordings as real drivers write them: each fault in at least ten variants, by topic, order, rate and place. What
//! comes of one is right, or an error that names the cause; never wrong in silence.

mod cameras;
mod clocks;
mod files;
mod joints;
mod world;
