//! The update of a block's voxels from one image.

use super::block::MOST_COLORS;
use super::frame::{Frame, Pixel};
use super::{BLOCK_EDGE, Block, Tsdf};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

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
        let distorted = frame.camera.is_distorted();
        work.par_iter_mut().with_min_len(16).for_each(|(first, block)| {
            if distorted {
                update.block(*first, block, |point| project_distorted(frame, point));
            } else {
                let camera = &frame.camera;
                let (fx, fy) = (camera.fx as f32, camera.fy as f32);
                let (cx, cy) = (camera.cx as f32 + 0.5, camera.cy as f32 + 0.5);
                update.block(*first, block, |point| {
                    let inverse_z = 1.0 / point.z;
                    (point.x * inverse_z * fx + cx, point.y * inverse_z * fy + cy)
                });
            }
        });
    }
}

/// Where a point is seen, counted from the image's outer corner.
fn project_distorted(frame: &Frame, point: &Vector3<f32>) -> (f32, f32) {
    match frame.camera.project(&point.cast::<f64>().into()) {
        Some(pixel) => (pixel.x as f32 + 0.5, pixel.y as f32 + 0.5),
        None => (-1.0, -1.0),
    }
}

impl Update<'_> {
    #[inline(always)]
    fn block(&self, first: Vector3<f32>, block: &mut Block, project: impl Fn(&Vector3<f32>) -> (f32, f32)) {
        let camera = &self.frame.camera;
        let (width, height) = (camera.width as f32, camera.height as f32);
        let outside = self.frame.surface.len() - 1;
        for row in 0..BLOCK_EDGE * BLOCK_EDGE {
            let (y, z) = ((row % BLOCK_EDGE) as f32, (row / BLOCK_EDGE) as f32);
            let start = first + self.steps[1] * y + self.steps[2] * z;
            let mut points = [Vector3::zeros(); BLOCK_EDGE];
            let mut pixels = [outside; BLOCK_EDGE];
            for x in 0..BLOCK_EDGE {
                let point = start + self.steps[0] * x as f32;
                points[x] = point;
                let (u, v) = project(&point);
                // NaN and points behind the camera fail one of these.
                if point.z > 1e-3 && u >= 0.0 && v >= 0.0 && u < width && v < height {
                    pixels[x] = v as usize * camera.width as usize + u as usize;
                }
            }
            for x in 0..BLOCK_EDGE {
                let pixel = &self.frame.surface[pixels[x]];
                if pixel.depth > 0.0 {
                    self.voxel(block, row * BLOCK_EDGE + x, &points[x], pixel);
                }
            }
        }
    }

    #[inline(always)]
    fn voxel(&self, block: &mut Block, place: usize, point: &Vector3<f32>, pixel: &Pixel) {
        let truncation = self.truncation_m.max(self.sigmas_floor + self.sigmas_quadratic * pixel.depth * pixel.depth);
        let [nx, ny, nz] = pixel.normal;
        let to_plane = nx * point.x + ny * point.y + nz * point.z - pixel.offset;
        let along_axis = pixel.depth - point.z;
        // Behind the surface nothing is known. A steep plane reaches farther along the axis than across.
        if to_plane < -truncation || along_axis < -3.0 * truncation {
            return;
        }
        let mut weight = pixel.weight;
        let mut distance = to_plane;
        if to_plane > truncation || along_axis > 3.0 * truncation {
            // Free space counts no more than the nearest truncation, so that rays passing close by an edge into the
            // distance do not pull it away.
            distance = self.truncation_m;
        } else if to_plane < -self.falloff_m {
            weight *= (to_plane + truncation) / (truncation - self.falloff_m);
        }
        let total = block.weight[place] + weight;
        if total <= 0.0 {
            return;
        }
        let share = weight / total;
        block.distance[place] += (distance - block.distance[place]) * share;
        block.weight[place] = total.min(self.max_weight);
        if pixel.color[3] != 0 && to_plane.abs() < self.color_reach_m {
            let color = &mut block.color[place];
            let count = (color[3] + 1).min(MOST_COLORS);
            for (mean, new) in color.iter_mut().zip(pixel.color).take(3) {
                let (old, new) = (i32::from(*mean), i32::from(new) << 8);
                *mean = (old + (new - old) / i32::from(count)) as u16;
            }
            color[3] = count;
        }
    }
}
