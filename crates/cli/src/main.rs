//! The command line of SKCLAM.

fn main() {}
