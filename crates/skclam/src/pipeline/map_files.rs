//! Maps for the tools that plan motions: fused surface, occupancy, distance field.

use super::{Config, RunError, for_each_view, voxel_m};
use crate::dataset::{Dataset, DatasetError};
use crate::output::StagedFolder;
use crate::progress::{Progress, Stage};
use serde::{Deserialize, Serialize};
use skclam_geometry::Isometry3;
use skclam_mapping::{
    Model, OccupancyGrid, OccupancyOptions, SurfaceOptions, TriangleMesh, Tsdf, TsdfOptions, decimate, write_glb,
    write_obj, write_pcd, write_ply, write_stl,
};
use skclam_rig::Rig;
use std::fs::File;
use std::io::{BufWriter, Write};

/// A file that a map can be written as, beside the cloud `map.ply`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapFile {
    /// `mesh.ply`: the fused surface with normals and colours.
    Mesh,
    /// `mesh.obj`.
    Obj,
    /// `mesh.glb`.
    Glb,
    /// `collision.stl`: the surface with fewer triangles, for planners.
    Stl,
    /// `cloud.pcd`: the surface's vertices with normals and colours.
    Pcd,
    /// `map.bt` and `map.ot`: OctoMap, free and occupied.
    Octomap,
    /// `esdf.npz`: the distance to the nearest obstacle.
    Esdf,
}

/// What was written.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MapFilesSummary {
    /// Edge of the surface's voxels, millimetres.
    pub voxel_mm: f64,
    /// Triangles of the fused surface.
    pub triangles: Option<usize>,
    /// Triangles of the collision mesh.
    pub collision_triangles: Option<usize>,
    /// Free and occupied cells.
    pub free_and_occupied_cells: Option<[usize; 2]>,
}

/// Cells of the collision mesh are this many voxels wide.
const COLLISION_CELL_VOXELS: f64 = 4.0;
/// Memory that the distance field may take, MiB.
const ESDF_MEMORY_MIB: u64 = 1024;

/// Fuses the depth images at the given poses and writes the files asked for.
pub fn write_map_files(
    dataset: &Dataset,
    poses: &[Isometry3],
    rig: &Rig,
    config: &Config,
    files: &[MapFile],
    staged: &StagedFolder,
    progress: &dyn Progress,
) -> Result<MapFilesSummary, RunError> {
    let Some(depth_camera) = rig.depth else { return Ok(MapFilesSummary::default()) };
    let wants = |wanted: &[MapFile]| files.iter().any(|file| wanted.contains(file));
    let voxel_m = voxel_m(dataset, &depth_camera, config)?;
    let mut summary = MapFilesSummary { voxel_mm: voxel_m * 1e3, ..MapFilesSummary::default() };
    if wants(&[MapFile::Mesh, MapFile::Obj, MapFile::Glb, MapFile::Stl, MapFile::Pcd]) {
        progress.begin(Stage::Map, dataset.len() as u64);
        let mut tsdf = Tsdf::new(TsdfOptions { voxel_m, filter: config.cloud.filter, ..TsdfOptions::default() })?;
        for_each_view(dataset, poses, rig, None, progress, |view| Ok(tsdf.integrate(view).map(drop)?))?;
        let mesh = tsdf.surface(&SurfaceOptions::default())?;
        drop(tsdf);
        summary.triangles = Some(mesh.triangles.len());
        summary.collision_triangles = write_mesh(mesh, COLLISION_CELL_VOXELS * voxel_m, files, staged)?;
    }
    if wants(&[MapFile::Octomap, MapFile::Esdf]) {
        progress.begin(Stage::Map, dataset.len() as u64);
        let mut grid =
            OccupancyGrid::new(OccupancyOptions { filter: config.cloud.filter, ..OccupancyOptions::default() })?;
        for_each_view(dataset, poses, rig, None, progress, |view| Ok(grid.add(view)?))?;
        let (free, occupied) = grid.counts();
        summary.free_and_occupied_cells = Some([free, occupied]);
        if files.contains(&MapFile::Octomap) {
            write(staged, "map.bt", |out| grid.write_bt(out))?;
            write(staged, "map.ot", |out| grid.write_ot(out))?;
        }
        if files.contains(&MapFile::Esdf) {
            let esdf = grid.esdf(ESDF_MEMORY_MIB)?;
            let path = staged.path("esdf.npz")?;
            let io = |source| DatasetError::Io { path: path.clone(), source };
            esdf.write_npz(BufWriter::new(File::create(&path).map_err(io)?))?;
        }
    }
    Ok(summary)
}

fn write_mesh(
    mesh: TriangleMesh,
    cell_m: f64,
    files: &[MapFile],
    staged: &StagedFolder,
) -> Result<Option<usize>, RunError> {
    let mut collision_triangles = None;
    for file in files {
        match file {
            MapFile::Obj => write(staged, "mesh.obj", |out| write_obj(&mesh, out))?,
            MapFile::Glb => write(staged, "mesh.glb", |out| write_glb(&mesh, out))?,
            MapFile::Pcd => write(staged, "cloud.pcd", |out| write_pcd(&mesh.vertices, out))?,
            MapFile::Stl => {
                let collision = decimate(&mesh, cell_m)?;
                collision_triangles = Some(collision.triangles.len());
                write(staged, "collision.stl", |out| write_stl(&collision, out))?;
            }
            MapFile::Mesh | MapFile::Octomap | MapFile::Esdf => {}
        }
    }
    if files.contains(&MapFile::Mesh) {
        let model = Model::Mesh(mesh);
        write(staged, "mesh.ply", |out| write_ply(&model, out))?;
    }
    Ok(collision_triangles)
}

fn write(
    staged: &StagedFolder,
    name: &str,
    contents: impl FnOnce(&mut BufWriter<File>) -> Result<(), skclam_mapping::Error>,
) -> Result<(), RunError> {
    let path = staged.path(name)?;
    let io = |source| DatasetError::Io { path: path.clone(), source };
    let mut out = BufWriter::new(File::create(&path).map_err(io)?);
    contents(&mut out)?;
    out.flush().map_err(io)?;
    Ok(())
}
