//! The reference cell at its true poses: what the map must reach there. Skips where the data are missing.

mod dataset;

use skclam_geometry::Isometry3;
use skclam_mapping::{
    CloudBuilder, CloudOptions, DepthConsistencyOptions, Model, ReferenceOptions, SurfaceOptions, Tsdf, TsdfOptions,
    View, depth_consistency, read_ply, score_surface,
};
use std::fs::File;
use std::io::BufReader;

const VIEWS: usize = 12;

#[test]
fn the_fused_surface_is_nearer_to_the_truth_than_the_pixels_are() {
    let Some(folder) = dataset::data_folder("virtual-cell") else { return };
    let cell = dataset::load(&folder, VIEWS);
    let views: Vec<View<'_>> = (0..cell.shots.len()).map(|index| cell.view(index)).collect();
    let reference = read_ply(BufReader::new(File::open(folder.join("truth/scene.ply")).unwrap())).unwrap();
    let mut tsdf = Tsdf::new(TsdfOptions { voxel_m: 0.01, ..Default::default() }).unwrap();
    let mut cloud = CloudBuilder::new(CloudOptions { voxel_m: Some(0.01), ..Default::default() }).unwrap();
    for view in &views {
        tsdf.integrate(view).unwrap();
        cloud.add(view).unwrap();
    }
    let options = ReferenceOptions { spacing_m: 0.02, ..Default::default() };
    let mesh = Model::Mesh(tsdf.surface(&SurfaceOptions::default()).unwrap());
    let surface = score_surface(&mesh, &reference, &views, &options).unwrap();
    let pixels = score_surface(&Model::Cloud(cloud.finish()), &reference, &views, &options).unwrap();
    println!("surface {surface:?}\npixels {pixels:?}");
    // Measured on all 48 views: 1.2 mm; on these 12, where most is seen once or twice, somewhat more.
    assert!(surface.accuracy.median_m < 0.0020, "{surface:?}");
    assert!(surface.accuracy.median_m < pixels.accuracy.median_m);
    assert!(surface.completeness.within[2] > 0.6, "{surface:?}");
}

#[test]
fn depth_consistency_separates_true_poses_from_wrong_ones() {
    let Some(folder) = dataset::data_folder("virtual-cell") else { return };
    let cell = dataset::load(&folder, VIEWS);
    let options = DepthConsistencyOptions { stride: 8, ..Default::default() };
    let views: Vec<View<'_>> = (0..cell.shots.len()).map(|index| cell.view(index)).collect();
    let at_truth = depth_consistency(&views, &options).unwrap();
    // Every camera is moved by 2 cm in a direction of its own.
    let moved: Vec<View<'_>> = views
        .iter()
        .enumerate()
        .map(|(index, view)| {
            let angle = 2.4 * index as f64;
            let shift = Isometry3::translation(0.02 * angle.cos(), 0.02 * angle.sin(), 0.0);
            View { base_from_color: shift * view.base_from_color, ..*view }
        })
        .collect();
    let off = depth_consistency(&moved, &options).unwrap();
    println!("truth {:?} mm, moved {:?} mm, {} pairs", at_truth.median_m, off.median_m, at_truth.pairs.len());
    assert!(at_truth.pairs.len() > 10);
    assert!(at_truth.median_m.unwrap() < 0.008);
    assert!(off.median_m.unwrap() > 1.3 * at_truth.median_m.unwrap());
}
