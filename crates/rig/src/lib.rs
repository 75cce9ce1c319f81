//! A robot, its camera mount and its cameras as one value and as one file; postures.
