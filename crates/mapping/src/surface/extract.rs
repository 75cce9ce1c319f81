//! Marching cubes, block by block, with vertices shared across blocks.
//!
//! A cell's lower corner is a voxel's centre, so a cell belongs to the block of that voxel, and so does an edge. First
//! every block finds its crossed edges and its cells, then vertices are numbered in the order of blocks, axes and
//! voxels, and then every block writes its triangles.

use super::table::{EDGES, TRIANGLES};
use crate::cloud_cell::to_byte;
use crate::tsdf::{BLOCK_EDGE, Block};
use crate::voxel::{VoxelKey, VoxelMap};
use crate::{PointCloud, TriangleMesh, Tsdf};
use rayon::prelude::*;

/// A block and the first layer of its upper neighbours.
const PADDED: usize = BLOCK_EDGE + 1;
/// Words of 64 voxels in a block.
const WORDS: usize = BLOCK_EDGE * BLOCK_EDGE * BLOCK_EDGE / 64;
/// A surface between two voxels whose distances differ by more voxels than this is none: free space as one camera saw
/// it meets the unknown behind what another saw.
const STEEPEST_STEP: f32 = 3.0;

/// What a block contributes.
struct Part {
    /// Crossed edges: a bit a voxel, an axis after the other.
    crossed: [[u64; WORDS]; 3],
    /// Number of crossed edges before each word.
    rank: [[u16; WORDS]; 3],
    points: Vec<[f32; 3]>,
    /// With `None` where no colour was seen.
    colors: Vec<Option<[u8; 3]>>,
    /// Cells with a surface: voxel and which corners are inside.
    cells: Vec<(u16, u8)>,
}

impl Part {
    fn vertex(&self, axis: usize, voxel: usize) -> u32 {
        let (word, bit) = (voxel / 64, voxel % 64);
        u32::from(self.rank[axis][word]) + (self.crossed[axis][word] & ((1 << bit) - 1)).count_ones()
    }
}

fn voxel_of(x: usize, y: usize, z: usize) -> usize {
    (z * BLOCK_EDGE + y) * BLOCK_EDGE + x
}

pub(super) fn marching_cubes(tsdf: &Tsdf, min_weight: f32) -> TriangleMesh {
    let blocks = tsdf.sorted_blocks();
    let voxel_m = tsdf.options().voxel_m;
    let parts: Vec<Option<Part>> =
        blocks.par_iter().map(|(index, block)| part(tsdf, *index, block, voxel_m, min_weight)).collect();
    let mut place_of = VoxelMap::default();
    let mut first_vertex = Vec::with_capacity(parts.len());
    let mut vertices = 0u32;
    for (place, part) in parts.iter().enumerate() {
        first_vertex.push(vertices);
        if let Some(part) = part {
            place_of.insert(VoxelKey::new(blocks[place].0).expect("it is a block's address"), place);
            vertices += part.points.len() as u32;
        }
    }
    let triangles: Vec<Vec<[u32; 3]>> = parts
        .par_iter()
        .enumerate()
        .map(|(place, part)| {
            let Some(part) = part else { return Vec::new() };
            let around: [Option<usize>; 8] = std::array::from_fn(|corner| {
                let neighbour = upper_neighbour(blocks[place].0, corner);
                VoxelKey::new(neighbour).and_then(|key| place_of.get(&key).copied())
            });
            let mut triangles = Vec::with_capacity(2 * part.cells.len());
            for &(voxel, inside) in &part.cells {
                let voxel = usize::from(voxel);
                let cell = [voxel % BLOCK_EDGE, voxel / BLOCK_EDGE % BLOCK_EDGE, voxel / BLOCK_EDGE / BLOCK_EDGE];
                for triangle in &TRIANGLES[usize::from(inside)] {
                    triangles.push(triangle.map(|edge| {
                        let edge = EDGES[usize::from(edge)];
                        let at: [usize; 3] = std::array::from_fn(|axis| cell[axis] + (edge.from >> axis & 1));
                        let corner = (0..3).fold(0, |corner, axis| corner | (at[axis] / BLOCK_EDGE) << axis);
                        let owner = around[corner].expect("the cell's corners are all known");
                        let [x, y, z] = at.map(|index| index % BLOCK_EDGE);
                        let local = parts[owner].as_ref().expect("it has the edge");
                        first_vertex[owner] + local.vertex(edge.axis, voxel_of(x, y, z))
                    }));
                }
            }
            triangles
        })
        .collect();
    let any_color = parts.iter().flatten().any(|part| part.colors.iter().any(Option::is_some));
    let mut mesh = TriangleMesh { triangles: triangles.concat(), ..Default::default() };
    mesh.vertices.points.reserve_exact(vertices as usize);
    for part in parts.into_iter().flatten() {
        mesh.vertices.points.extend(part.points);
        if any_color {
            mesh.vertices.colors.extend(part.colors.iter().map(|color| color.unwrap_or([128; 3])));
        }
    }
    drop_unused_vertices(&mut mesh);
    mesh
}

fn upper_neighbour(index: [i32; 3], corner: usize) -> [i32; 3] {
    std::array::from_fn(|axis| index[axis] + (corner >> axis & 1) as i32)
}

fn part(tsdf: &Tsdf, index: [i32; 3], block: &Block, voxel_m: f64, min_weight: f32) -> Option<Part> {
    let around: [Option<&Block>; 8] = std::array::from_fn(|corner| match corner {
        0 => Some(block),
        _ => tsdf.block(upper_neighbour(index, corner)),
    });
    // Distances of the block and the first layer beyond, NaN where too little is known.
    let mut field = [f32::NAN; PADDED * PADDED * PADDED];
    let (mut any_inside, mut any_free) = (false, false);
    for z in 0..PADDED {
        for y in 0..PADDED {
            let corner = (y / BLOCK_EDGE) << 1 | (z / BLOCK_EDGE) << 2;
            let from = voxel_of(0, y % BLOCK_EDGE, z % BLOCK_EDGE);
            let to = (z * PADDED + y) * PADDED;
            if let Some(block) = around[corner] {
                let row = &block.rows[from / BLOCK_EDGE];
                for x in 0..BLOCK_EDGE {
                    let distance = row.distance[x];
                    let known = row.weight[x] >= min_weight;
                    field[to + x] = if known { distance } else { f32::NAN };
                    any_inside |= known & (distance < 0.0);
                    any_free |= known & (distance >= 0.0);
                }
            }
            if let Some(row) = around[corner | 1].map(|block| &block.rows[from / BLOCK_EDGE])
                && row.weight[0] >= min_weight
            {
                let distance = row.distance[0];
                field[to + BLOCK_EDGE] = distance;
                any_inside |= distance < 0.0;
                any_free |= distance >= 0.0;
            }
        }
    }
    if !(any_inside && any_free) {
        return None;
    }
    let steepest = STEEPEST_STEP * voxel_m as f32;
    let strides = [1, PADDED, PADDED * PADDED];
    let mut part = Part {
        crossed: [[0; WORDS]; 3],
        rank: [[0; WORDS]; 3],
        points: Vec::new(),
        colors: Vec::new(),
        cells: Vec::new(),
    };
    let crosses = |from: f32, to: f32| (from < 0.0) != (to < 0.0) && (from - to).abs() <= steepest;
    for axis in 0..3 {
        for voxel in 0..BLOCK_EDGE * BLOCK_EDGE * BLOCK_EDGE {
            let at = [voxel % BLOCK_EDGE, voxel / BLOCK_EDGE % BLOCK_EDGE, voxel / BLOCK_EDGE / BLOCK_EDGE];
            let place = (at[2] * PADDED + at[1]) * PADDED + at[0];
            let (from, to) = (field[place], field[place + strides[axis]]);
            if voxel % 64 == 0 {
                part.rank[axis][voxel / 64] = part.points.len() as u16;
            }
            if !crosses(from, to) {
                continue;
            }
            part.crossed[axis][voxel / 64] |= 1 << (voxel % 64);
            let fraction = f64::from(from / (from - to));
            part.points.push(std::array::from_fn(|a| {
                let cell = f64::from(index[a]) * BLOCK_EDGE as f64 + at[a] as f64 + 0.5;
                ((cell + if a == axis { fraction } else { 0.0 }) * voxel_m) as f32
            }));
            let mut other = at;
            other[axis] += 1;
            let corner = (0..3).fold(0, |corner, a| corner | (other[a] / BLOCK_EDGE) << a);
            let [x, y, z] = other.map(|index| index % BLOCK_EDGE);
            let other = around[corner].expect("its distance is known").color(voxel_of(x, y, z));
            part.colors.push(mixed(block.color(voxel), other, fraction as f32));
        }
    }
    for voxel in 0..BLOCK_EDGE * BLOCK_EDGE * BLOCK_EDGE {
        let at = [voxel % BLOCK_EDGE, voxel / BLOCK_EDGE % BLOCK_EDGE, voxel / BLOCK_EDGE / BLOCK_EDGE];
        let place = (at[2] * PADDED + at[1]) * PADDED + at[0];
        let corners: [f32; 8] = std::array::from_fn(|corner| {
            field[place + (corner & 1) + (corner >> 1 & 1) * PADDED + (corner >> 2) * PADDED * PADDED]
        });
        let inside = (0..8).fold(0u8, |mask, corner| mask | u8::from(corners[corner] < 0.0) << corner);
        if inside == 0 || inside == 255 || corners.iter().any(|distance| distance.is_nan()) {
            continue;
        }
        let sound = EDGES.iter().all(|edge| {
            let (from, to) = (corners[edge.from], corners[edge.to]);
            (from < 0.0) == (to < 0.0) || crosses(from, to)
        });
        if sound {
            part.cells.push((voxel as u16, inside));
        }
    }
    Some(part)
}

/// The colour between two voxels, as far as they have one.
fn mixed(from: [u16; 4], to: [u16; 4], fraction: f32) -> Option<[u8; 3]> {
    let value = |color: [u16; 4], channel: usize| f32::from(color[channel]) / 256.0;
    match (from[3] > 0, to[3] > 0) {
        (false, false) => None,
        (true, false) => Some(std::array::from_fn(|c| to_byte(value(from, c)))),
        (false, true) => Some(std::array::from_fn(|c| to_byte(value(to, c)))),
        (true, true) => {
            Some(std::array::from_fn(|c| to_byte(value(from, c) + fraction * (value(to, c) - value(from, c)))))
        }
    }
}

/// Keeps the vertices that some triangle names, in their order, and renumbers the triangles.
pub(super) fn drop_unused_vertices(mesh: &mut TriangleMesh) {
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    for &vertex in mesh.triangles.iter().flatten() {
        number[vertex as usize] = 0;
    }
    let mut kept = 0;
    for place in &mut number {
        if *place == 0 {
            *place = kept;
            kept += 1;
        }
    }
    fn keep<T: Copy>(list: &mut Vec<T>, number: &[u32]) {
        let mut numbers = number.iter();
        list.retain(|_| numbers.next().is_some_and(|&place| place != u32::MAX));
        list.shrink_to_fit();
    }
    let PointCloud { points, colors, normals } = &mut mesh.vertices;
    keep(points, &number);
    keep(colors, &number);
    keep(normals, &number);
    for vertex in mesh.triangles.iter_mut().flatten() {
        *vertex = number[*vertex as usize];
    }
}
