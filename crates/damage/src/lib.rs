//! Damaged files for the tests of readers: files that a stranger might bring get an answer or an error, no panic, in
//! bounded time and memory. Only tests depend on this crate.
//!
//! A [`Trial`] is a reader with seeds, which are whole files; each input is a seed with a few damages, drawn from
//! `(seed of the trial, number of the input)` alone, so that any input can be made again. [`damaged_bytes`] knows
//! lengths and flips, [`damaged_text`] numbers, words, lines and nesting.
//!
//! Environment: `SKCLAM_FUZZ` inputs a reader (few by default, so that tests stay quick), `SKCLAM_FUZZ_SECONDS` at most
//! for a reader (1800), `SKCLAM_FUZZ_SEED` begins elsewhere, `SKCLAM_FUZZ_ONLY` takes the readers with that in their
//! name.

mod bytes;
mod memory;
mod text;
mod trial;
mod watchdog;

pub use bytes::damaged_bytes;
pub use memory::peak_resident_mib;
pub use rand_chacha::ChaCha8Rng;
pub use text::damaged_text;
pub use trial::{Seed, Trial};
