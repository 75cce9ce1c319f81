//! From posed depth images to a map: point cloud, surface, occupancy.
//!
//! Poses and depth come in, a map goes out. This crate knows nothing of robots or of how the poses were found:
//! every input is a [`View`], a depth image (and perhaps a colour image) with `base_from_color`.
//! Maps live in the base frame, in metres.
//!
//! - [`CloudBuilder`] piles the views up into a coloured [`PointCloud`], the map of the paper;
//! - [`Tsdf`] fuses them into one clean surface, a [`TriangleMesh`];
//! - [`depth_consistency`] and [`score_surface`] say how good a map is;
//! - [`OccupancyGrid`] separates free, occupied and unknown space, as OctoMap files and as a distance field;
//! - [`without_bodies`] keeps the arm and its gripper out of them;
//! - [`render`] draws a map without a window;
//! - [`write_ply`] and [`read_ply`] carry clouds and meshes to and from files; [`write_obj`], [`write_glb`],
//!   [`write_stl`] and [`write_pcd`] to other tools; [`decimate`] makes a mesh small enough for planners.
//!
#![doc = include_str!("../README.md")]

mod bodies;
mod cloud;
mod cloud_builder;
mod cloud_cell;
mod color_lookup;
mod depth_filter;
mod error;
mod formats;
mod nearest;
mod normals;
mod occupancy;
mod ply;
mod projector;
mod quality;
mod rays;
mod render;
mod surface;
mod tsdf;
mod valid_depth;
mod view;
mod view_points;
mod voxel;

pub use bodies::{Body, BodyShape, without_bodies};
pub use cloud::{Model, PointCloud, TriangleMesh};
pub use cloud_builder::{CloudBuilder, CloudOptions, PointDepths, PointNormals, UncoloredPoints};
pub use depth_filter::{DepthFilter, DepthNoise};
pub use error::Error;
pub use formats::{read_stl, write_glb, write_obj, write_pcd, write_stl};
pub use nearest::SurfaceIndex;
pub use occupancy::{Esdf, FreeBoundary, Occupancy, OccupancyGrid, OccupancyOptions};
pub use ply::{read_ply, write_cloud_ply, write_ply};
pub use quality::{
    DepthConsistency, DepthConsistencyOptions, DistanceSummary, PairConsistency, PointToPlaneSample, ReferenceOptions,
    SCORE_THRESHOLDS_M, SurfaceScore, depth_consistency, score_surface,
};
pub use render::{BackFaces, Projection, RenderCamera, RenderOptions, ViewPreset, render, side_by_side};
pub use surface::{SurfaceOptions, decimate, remove_small_clusters, vertex_normals};
pub use tsdf::{Integration, SpaceCarving, Tsdf, TsdfOptions};
pub use view::View;
pub use view_points::ViewPoints;
