//! `skclam simulate`.

use crate::args::{Cli, SimulateArgs};
use anyhow::Result;

/// Renders a data set.
pub fn simulate(_cli: &Cli, _args: &SimulateArgs) -> Result<()> {
    anyhow::bail!("not yet")
}
