//! The update of a block's voxels from one image, a row of eight voxels at a time.

use super::block::{MAX_COLORS, Row, VoxelRow};
use super::frame::{Frame, Pixel};
use super::{BLOCK_EDGE, Block, Tsdf};
use crate::projector::Projector;
use multiversion::multiversion;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// A steep plane reaches this many truncations farther along the axis than across.
const DEEPEST: f32 = 3.0;
/// Voxels in a layer of a block.
const LAYER: usize = BLOCK_EDGE * BLOCK_EDGE;

/// What all voxels of an image's update share.
struct Update<'a> {
    pixels: &'a [Pixel],
    projector: Projector,
    width: i32,
    /// Where the pixel without information is.
    nothing: i32,
    /// From the first voxel of a layer to each of its voxels, x, y, z in the depth camera's frame.
    within_layer: [[f32; LAYER]; 3],
    /// From layer to layer.
    next_layer: Vector3<f32>,
    /// Truncation: the larger of `truncation_m` and `sigmas_floor + sigmas_quadratic z^2`.
    truncation_m: f32,
    sigmas_floor: f32,
    sigmas_quadratic: f32,
    /// Voxels nearer to the surface than this take its colour.
    color_reach_m: f32,
    /// Weights fall from here on behind the surface.
    falloff_m: f32,
    max_weight: f32,
}

impl Update<'_> {
    #[inline(always)]
    fn truncation(&self, depth: f32) -> f32 {
        self.truncation_m.max(self.sigmas_floor + self.sigmas_quadratic * depth * depth)
    }
}

impl Tsdf {
    /// Updates the blocks at the places given (sorted, no two alike), in parallel.
    pub(super) fn update(&mut self, frame: &Frame<'_>, places: &[u32]) {
        let options = &self.options;
        let depth_from_base = frame.base_from_depth.inverse();
        let step = |axis: usize| {
            let unit = Vector3::ith(axis, options.voxel_m);
            (depth_from_base.rotation * unit).cast::<f32>()
        };
        let noise = &options.filter.noise;
        let (step_x, step_y) = (step(0), step(1));
        let update = Update {
            pixels: frame.surface,
            projector: frame.projector,
            width: frame.camera.width as i32,
            nothing: frame.surface.len() as i32 - 1,
            within_layer: std::array::from_fn(|axis| {
                std::array::from_fn(|at| {
                    step_x[axis] * (at % BLOCK_EDGE) as f32 + step_y[axis] * (at / BLOCK_EDGE) as f32
                })
            }),
            next_layer: step(2),
            truncation_m: (options.truncation_voxels * options.voxel_m) as f32,
            sigmas_floor: (options.truncation_sigmas * noise.floor_m) as f32,
            sigmas_quadratic: (options.truncation_sigmas * noise.depth_sigma_per_m2) as f32,
            color_reach_m: (2.0 * options.voxel_m) as f32,
            falloff_m: options.voxel_m as f32,
            max_weight: options.max_weight as f32,
        };
        let block_m = options.voxel_m * BLOCK_EDGE as f64;
        let half_voxel = Vector3::repeat(0.5 * options.voxel_m);
        let keys = &self.keys;
        let mut blocks = self.blocks.get_many_mut(places);
        blocks.par_iter_mut().zip(places).with_min_len(16).for_each(|(block, &place)| {
            let corner = Point3::from(keys[place as usize].index().map(|index| f64::from(index) * block_m));
            let first = (depth_from_base * (corner + half_voxel)).coords.cast::<f32>();
            if update.projector.is_distorted() {
                update_block::<true>(&update, first, block);
            } else {
                update_block::<false>(&update, first, block);
            }
        });
    }
}

/// A layer of a block, seen by the depth camera.
struct Layer {
    /// x, y, z of the voxels in its frame.
    point: [[f32; LAYER]; 3],
    /// The pixels at which they are seen, row-major.
    place: [i32; LAYER],
}

/// Updates all voxels of a block; `first` is the centre of its first voxel in the depth camera's frame.
#[multiversion(targets("x86_64+avx2"))]
fn update_block<const DISTORTED: bool>(update: &Update<'_>, first: Vector3<f32>, block: &mut Block) {
    let mut layer = Layer { point: [[0.0; LAYER]; 3], place: [0; LAYER] };
    for (z, rows) in block.rows.chunks_exact_mut(BLOCK_EDGE).enumerate() {
        project_layer::<DISTORTED>(update, first + update.next_layer * z as f32, &mut layer);
        for (y, voxels) in rows.iter_mut().enumerate() {
            let span = y * BLOCK_EDGE..(y + 1) * BLOCK_EDGE;
            let [px, py, pz] = layer.point.each_ref().map(|axis| Row::try_from(&axis[span.clone()]).expect("a row"));
            let places = Row::try_from(&layer.place[span]).expect("a row");
            let pixels: Row<&Pixel> = places.map(|place| &update.pixels[place as usize]);
            // Many rows of a block lie outside the image, before a hole in it or well behind the surface.
            let depth = pixels.map(|pixel| pixel.depth);
            let mut reached = 0;
            for x in 0..BLOCK_EDGE {
                let reach = DEEPEST * update.truncation(depth[x]);
                reached |= u32::from((depth[x] > 0.0) & (depth[x] - pz[x] >= -reach));
            }
            if reached != 0 {
                update_row(update, &pixels, &depth, [&px, &py, &pz], voxels);
            }
        }
    }
}

/// Where the voxels of a layer are, and which pixels see them; `nothing` for those outside the image.
#[inline(always)]
fn project_layer<const DISTORTED: bool>(update: &Update<'_>, start: Vector3<f32>, layer: &mut Layer) {
    let projector = update.projector;
    let (width, nothing) = (update.width, update.nothing);
    let [within_x, within_y, within_z] = &update.within_layer;
    let [px, py, pz] = &mut layer.point;
    for at in 0..LAYER {
        let (x, y, z) = (start.x + within_x[at], start.y + within_y[at], start.z + within_z[at]);
        (px[at], py[at], pz[at]) = (x, y, z);
        let (u, v) = if DISTORTED { projector.project_distorted(x, y, z) } else { projector.project_straight(x, y, z) };
        let place = whole(v).wrapping_mul(width).wrapping_add(whole(u));
        let outside = projector.outside(z, u, v);
        layer.place[at] = (place & !outside) | (nothing & outside);
    }
}

/// 1.5 x 2^23. Single precision steps by one around it, so that adding it rounds, and leaves the number in the lowest
/// bits.
const SHIFT: f32 = 12_582_912.0;

/// The whole part of a number of at least 0 and below 2^22 (or one less at a whole number): two instructions, where a
/// cast must mind all numbers that no integer can hold.
#[inline(always)]
fn whole(value: f32) -> i32 {
    ((value - 0.5 + SHIFT).to_bits() & 0x3f_ffff) as i32
}

/// Updates distances, weights and colours of a row.
#[inline(always)]
fn update_row(update: &Update<'_>, pixels: &Row<&Pixel>, depth: &Row, [px, py, pz]: [&Row; 3], voxels: &mut VoxelRow) {
    let nx: Row = pixels.map(|pixel| pixel.normal[0]);
    let ny: Row = pixels.map(|pixel| pixel.normal[1]);
    let nz: Row = pixels.map(|pixel| pixel.normal[2]);
    let offset: Row = pixels.map(|pixel| pixel.offset);
    let pixel_weight: Row = pixels.map(|pixel| pixel.weight);
    let (mut distance, mut weight) = ([0.0; BLOCK_EDGE], [0.0; BLOCK_EDGE]);
    let mut near = [0i32; BLOCK_EDGE];
    let (mut any_weight, mut any_near) = (0, 0);
    for x in 0..BLOCK_EDGE {
        let truncation = update.truncation(depth[x]);
        let to_plane = nx[x] * px[x] + ny[x] * py[x] + nz[x] * pz[x] - offset[x];
        let along_axis = depth[x] - pz[x];
        // Behind the surface nothing is known.
        let known = (depth[x] > 0.0) & (to_plane >= -truncation) & (along_axis >= -DEEPEST * truncation);
        // Free space counts no more than the nearest truncation, so that rays passing close by an edge into the
        // distance do not move it away.
        let free = (to_plane > truncation) | (along_axis > DEEPEST * truncation);
        distance[x] = if free { update.truncation_m } else { to_plane };
        let falling = (to_plane + truncation) / (truncation - update.falloff_m);
        let weight_fraction = if !free & (to_plane < -update.falloff_m) { falling } else { 1.0 };
        weight[x] = if known { pixel_weight[x] * weight_fraction } else { 0.0 };
        near[x] = -i32::from(known & (to_plane.abs() < update.color_reach_m));
        any_weight |= weight[x].to_bits();
        any_near |= near[x];
    }
    // The voxels themselves are far away in memory: no use fetching those that stay as they are.
    if any_weight == 0 {
        return;
    }
    for x in 0..BLOCK_EDGE {
        let total = voxels.weight[x] + weight[x];
        let fraction = if total > 0.0 { weight[x] / total } else { 0.0 };
        voxels.distance[x] += (distance[x] - voxels.distance[x]) * fraction;
        voxels.weight[x] = total.min(update.max_weight);
    }
    if any_near != 0 {
        update_colors(pixels, &near, &mut voxels.color);
    }
}

/// Updates the colours of the voxels whose mask is not 0.
#[inline(always)]
fn update_colors(pixels: &Row<&Pixel>, near: &Row<i32>, color: &mut [Row<u16>; 4]) {
    let new: Row<u32> = pixels.map(|pixel| u32::from_le_bytes(pixel.color));
    let [red, green, blue, count] = color;
    let (mut taken, mut fraction) = ([0i32; BLOCK_EDGE], [0.0; BLOCK_EDGE]);
    for x in 0..BLOCK_EDGE {
        // One where there is a colour and the voxel is near.
        taken[x] = (new[x] >> 24) as i32 & near[x];
        let more = (i32::from(count[x]) + taken[x]).min(i32::from(MAX_COLORS));
        count[x] = more as u16;
        fraction[x] = if taken[x] != 0 { 1.0 / more as f32 } else { 0.0 };
    }
    for (channel, mean) in [red, green, blue].into_iter().enumerate() {
        for x in 0..BLOCK_EDGE {
            let old = f32::from(mean[x]);
            let new = ((new[x] >> (8 * channel)) & 0xff) as i32 as f32 * 256.0;
            mean[x] = (old + (new - old) * fraction[x] + SHIFT).to_bits() as u16;
        }
    }
}
