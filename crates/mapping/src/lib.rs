//! From posed depth images to a map: point cloud, surface, occupancy.
