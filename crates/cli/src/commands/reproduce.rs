//! `skclam reproduce`.

use crate::args::{Cli, ReproduceArgs};
use anyhow::Result;

/// Repeats the experiments.
pub fn reproduce(_cli: &Cli, _args: &ReproduceArgs) -> Result<()> {
    anyhow::bail!("not yet")
}
