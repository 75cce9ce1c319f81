//! From correspondences and a nominal rig to a calibrated rig with its covariance.
