//! Serial chains in Denavit-Hartenberg and Hayati form: forward kinematics, Jacobians, inverse kinematics.
