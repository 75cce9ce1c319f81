//! Times fusion and extraction on a dataset at its known poses, and writes the mesh. One line of JSON on stdout.
//!
//! `cargo run --release -p skclam-mapping --example benchmark_fusion -- DATASET VOXEL_MM OUT.ply [PASSES]`

#[path = "../tests/dataset/mod.rs"]
mod dataset;

use skclam_mapping::{Model, SurfaceOptions, Tsdf, TsdfOptions, write_ply};
use std::error::Error;
use std::fs::File;
use std::io::BufWriter;
use std::path::PathBuf;
use std::time::Instant;

/// A line of `/proc/self/status` in MiB; 0 where there is no such file.
fn memory_mib(name: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(name));
    line.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok()).unwrap_or(0) / 1024
}

/// CPU time of this process so far, all threads, ms; 0 where it is not known. In steps of 10 ms.
fn cpu_ms() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |index: usize| fields.get(index).and_then(|text| text.parse::<f64>().ok()).unwrap_or(0.0);
    10.0 * (ticks(11) + ticks(12))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("the dataset's folder is needed")?);
    let voxel_mm: f64 = arguments.next().ok_or("the voxel's edge in mm is needed")?.parse()?;
    let out = PathBuf::from(arguments.next().ok_or("a file for the mesh is needed")?);
    let passes: usize = arguments.next().map_or(Ok(1), |text| text.parse())?;
    let dataset = dataset::load(&folder, usize::MAX);
    let before_mib = memory_mib("VmRSS:");

    let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: voxel_mm / 1000.0, ..Default::default() })?;
    let mut times_ms = Vec::new();
    let cpu_start = cpu_ms();
    for _ in 0..passes {
        for index in 0..dataset.shots.len() {
            let start = Instant::now();
            tsdf.integrate(&dataset.view(index))?;
            times_ms.push(start.elapsed().as_secs_f64() * 1000.0);
        }
    }
    let integrate_cpu_ms = (cpu_ms() - cpu_start) / times_ms.len() as f64;
    let integrated_mib = memory_mib("VmHWM:");
    let (start, cpu_start) = (Instant::now(), cpu_ms());
    let mesh = tsdf.surface(&SurfaceOptions::default())?;
    let extract_ms = start.elapsed().as_secs_f64() * 1000.0;
    let extract_cpu_ms = cpu_ms() - cpu_start;
    let peak_mib = memory_mib("VmHWM:");

    let hundred = times_ms.len().min(100);
    let mean = |list: &[f64]| list.iter().sum::<f64>() / list.len().max(1) as f64;
    let mut sorted = times_ms.clone();
    sorted.sort_by(f64::total_cmp);
    println!(
        "{{\"program\": \"skclam\", \"voxel_mm\": {voxel_mm}, \"images\": {}, \"integrate_cpu_ms\": {integrate_cpu_ms:.2}, \
         \"extract_cpu_ms\": {extract_cpu_ms:.0}, \"integrate_mean_ms\": {:.2}, \
         \"integrate_median_ms\": {:.2}, \"first_100_ms\": {:.2}, \"last_100_ms\": {:.2}, \"extract_ms\": {extract_ms:.1}, \
         \"blocks\": {}, \"voxels_mib\": {}, \"before_mib\": {before_mib}, \"integrated_mib\": {integrated_mib}, \
         \"peak_mib\": {peak_mib}, \"vertices\": {}, \"triangles\": {}}}",
        times_ms.len(),
        mean(&times_ms),
        sorted[sorted.len() / 2],
        mean(&times_ms[..hundred]),
        mean(&times_ms[times_ms.len() - hundred..]),
        tsdf.blocks(),
        tsdf.memory_bytes() >> 20,
        mesh.vertices.len(),
        mesh.triangles.len(),
    );
    write_ply(&Model::Mesh(mesh), BufWriter::new(File::create(out)?))?;
    Ok(())
}
