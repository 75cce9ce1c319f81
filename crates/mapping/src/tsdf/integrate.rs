//! The update of a block's voxels from one image, a row of eight voxels at a time.

use super::block::{BLOCK_VOXELS, MOST_COLORS};
use super::frame::{Frame, Pixel};
use super::{BLOCK_EDGE, Block, Tsdf};
use crate::projector::Projector;
use multiversion::multiversion;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// One value for each voxel of a row.
type Row = [f32; BLOCK_EDGE];

/// A steep plane reaches this many truncations farther along the axis than across.
const DEEPEST: f32 = 3.0;

/// What all voxels of an image's update share.
struct Update<'a> {
    frame: &'a Frame,
    /// Takes a step of one voxel along the base's axes to the depth camera.
    steps: [Vector3<f32>; 3],
    /// Truncation: the larger of `truncation_m` and `sigmas_floor + sigmas_quadratic z^2`.
    truncation_m: f32,
    sigmas_floor: f32,
    sigmas_quadratic: f32,
    /// Voxels nearer to the surface than this take its colour.
    color_reach_m: f32,
    /// Weights fall from here on behind the surface.
    falloff_m: f32,
    max_weight: f32,
    /// `1 / count` for running means of colours.
    shares: [f32; MOST_COLORS as usize + 1],
}

impl Tsdf {
    /// Updates the blocks at the places given (sorted, no two alike), in parallel.
    pub(super) fn update(&mut self, frame: &Frame, places: &[u32]) {
        let options = &self.options;
        let depth_from_base = frame.base_from_depth.inverse();
        let axis = |axis: usize| {
            let unit = Vector3::ith(axis, options.voxel_m);
            (depth_from_base.rotation * unit).cast::<f32>()
        };
        let noise = &options.filter.noise;
        let update = Update {
            frame,
            steps: [axis(0), axis(1), axis(2)],
            truncation_m: (options.truncation_voxels * options.voxel_m) as f32,
            sigmas_floor: (options.truncation_sigmas * noise.floor_m) as f32,
            sigmas_quadratic: (options.truncation_sigmas * noise.quadratic_per_m) as f32,
            color_reach_m: (2.0 * options.voxel_m) as f32,
            falloff_m: options.voxel_m as f32,
            max_weight: options.max_weight as f32,
            shares: std::array::from_fn(|count| 1.0 / count.max(1) as f32),
        };
        let block_m = options.voxel_m * BLOCK_EDGE as f64;
        let half_voxel = Vector3::repeat(0.5 * options.voxel_m);
        let mut work: Vec<(Vector3<f32>, &mut Block)> = Vec::with_capacity(places.len());
        let mut rest = self.blocks.as_mut_slice();
        let mut passed = 0;
        for &place in places {
            let (before, after) = rest.split_at_mut(place as usize + 1 - passed);
            rest = after;
            passed = place as usize + 1;
            let corner = Point3::from(self.keys[place as usize].index().map(|index| f64::from(index) * block_m));
            let first = (depth_from_base * (corner + half_voxel)).coords.cast::<f32>();
            work.push((first, before.last_mut().expect("at least one block was split off")));
        }
        work.par_iter_mut().with_min_len(16).for_each(|(first, block)| update_block(&update, *first, block));
    }
}

/// Updates all voxels of a block; `first` is the centre of its first voxel in the depth camera's frame.
#[multiversion(targets("x86_64+avx2"))]
fn update_block(update: &Update<'_>, first: Vector3<f32>, block: &mut Block) {
    let frame = update.frame;
    let width = frame.camera.width as i32;
    let nothing = frame.surface.len() as i32 - 1;
    for row in 0..BLOCK_EDGE * BLOCK_EDGE {
        let (y, z) = ((row % BLOCK_EDGE) as f32, (row / BLOCK_EDGE) as f32);
        let start = first + update.steps[1] * y + update.steps[2] * z;
        let step = update.steps[0];
        let px: Row = std::array::from_fn(|x| start.x + step.x * x as f32);
        let py: Row = std::array::from_fn(|x| start.y + step.y * x as f32);
        let pz: Row = std::array::from_fn(|x| start.z + step.z * x as f32);
        let places = places_seen(&frame.projector, &px, &py, &pz, width, nothing);
        // Most rows of a block lie outside the image, before a hole in it or well behind the surface: the depths
        // alone, which stay in the cache, tell that.
        let depth: Row = std::array::from_fn(|x| frame.depth[places[x] as usize]);
        let truncation: Row = std::array::from_fn(|x| {
            update.truncation_m.max(update.sigmas_floor + update.sigmas_quadratic * depth[x] * depth[x])
        });
        let reached = (0..BLOCK_EDGE).any(|x| (depth[x] > 0.0) & (depth[x] - pz[x] >= -DEEPEST * truncation[x]));
        if !reached {
            continue;
        }
        let pixels: [&Pixel; BLOCK_EDGE] = std::array::from_fn(|x| &frame.surface[places[x] as usize]);
        let base = row * BLOCK_EDGE;
        let distances: &mut Row = (&mut block.distance[base..base + BLOCK_EDGE]).try_into().expect("a row");
        let weights: &mut Row = (&mut block.weight[base..base + BLOCK_EDGE]).try_into().expect("a row");
        let near = update_row(update, &pixels, &depth, &truncation, [&px, &py, &pz], distances, weights);
        for x in 0..BLOCK_EDGE {
            if near[x] && pixels[x].color[3] != 0 {
                update_color(update, &mut block.color, base + x, pixels[x].color);
            }
        }
    }
}

/// The pixels at which the voxels of a row are seen, row-major; `nothing` for those outside the image.
#[inline(always)]
fn places_seen(projector: &Projector, px: &Row, py: &Row, pz: &Row, width: i32, nothing: i32) -> [i32; BLOCK_EDGE] {
    let (mut u, mut v): (Row, Row) = ([0.0; BLOCK_EDGE], [0.0; BLOCK_EDGE]);
    // Two loops without a branch inside, so that each becomes a handful of instructions for the whole row.
    if projector.is_distorted() {
        for x in 0..BLOCK_EDGE {
            (u[x], v[x]) = projector.project_distorted(px[x], py[x], pz[x]);
        }
    } else {
        for x in 0..BLOCK_EDGE {
            (u[x], v[x]) = projector.project_straight(px[x], py[x], pz[x]);
        }
    }
    let mut places = [nothing; BLOCK_EDGE];
    for x in 0..BLOCK_EDGE {
        let seen = projector.sees(pz[x], u[x], v[x]);
        let (column, line) = (if seen { u[x] } else { 0.0 }, if seen { v[x] } else { 0.0 });
        let place = line as i32 * width + column as i32;
        places[x] = if seen { place } else { nothing };
    }
    places
}

/// Updates distances and weights of a row and tells which voxels are near enough to the surface to take its colour.
#[inline(always)]
fn update_row(
    update: &Update<'_>,
    pixels: &[&Pixel; BLOCK_EDGE],
    depth: &Row,
    truncation: &Row,
    [px, py, pz]: [&Row; 3],
    distances: &mut Row,
    weights: &mut Row,
) -> [bool; BLOCK_EDGE] {
    let nx: Row = std::array::from_fn(|x| pixels[x].normal[0]);
    let ny: Row = std::array::from_fn(|x| pixels[x].normal[1]);
    let nz: Row = std::array::from_fn(|x| pixels[x].normal[2]);
    let offset: Row = std::array::from_fn(|x| pixels[x].offset);
    let pixel_weight: Row = std::array::from_fn(|x| pixels[x].weight);
    let (mut distance, mut weight, mut near) = ([0.0; BLOCK_EDGE], [0.0; BLOCK_EDGE], [false; BLOCK_EDGE]);
    for x in 0..BLOCK_EDGE {
        let truncation = truncation[x];
        let to_plane = nx[x] * px[x] + ny[x] * py[x] + nz[x] * pz[x] - offset[x];
        let along_axis = depth[x] - pz[x];
        // Behind the surface nothing is known.
        let known = (depth[x] > 0.0) & (to_plane >= -truncation) & (along_axis >= -DEEPEST * truncation);
        // Free space counts no more than the nearest truncation, so that rays passing close by an edge into the
        // distance do not pull it away.
        let free = (to_plane > truncation) | (along_axis > DEEPEST * truncation);
        distance[x] = if free { update.truncation_m } else { to_plane };
        let falling = (to_plane + truncation) / (truncation - update.falloff_m);
        let share_of_weight = if !free & (to_plane < -update.falloff_m) { falling } else { 1.0 };
        weight[x] = if known { pixel_weight[x] * share_of_weight } else { 0.0 };
        near[x] = known & (to_plane.abs() < update.color_reach_m);
    }
    // The voxels themselves are far away in memory: no use fetching those that stay as they are.
    if weight == [0.0; BLOCK_EDGE] {
        return near;
    }
    for x in 0..BLOCK_EDGE {
        let total = weights[x] + weight[x];
        let share = if total > 0.0 { weight[x] / total } else { 0.0 };
        distances[x] += (distance[x] - distances[x]) * share;
        weights[x] = total.min(update.max_weight);
    }
    near
}

#[inline(always)]
fn update_color(update: &Update<'_>, colors: &mut [[u16; 4]; BLOCK_VOXELS], place: usize, new: [u8; 4]) {
    let color = &mut colors[place];
    let count = (color[3] + 1).min(MOST_COLORS);
    let share = update.shares[usize::from(count)];
    for (mean, new) in color.iter_mut().zip(new).take(3) {
        let (old, new) = (f32::from(*mean), f32::from(new) * 256.0);
        *mean = (old + (new - old) * share) as u16;
    }
    color[3] = count;
}
