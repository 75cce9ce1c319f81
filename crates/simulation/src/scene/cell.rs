//! The furniture of the cell: a room around a table-top arm at the origin, drawn from a seed.
//!
//! The table's top is at z = 0. Benches, shelves, cabinets, cartons, pipes and paper are all around, at
//! 0.5 to 2.5 m from a camera on the wrist: epipolar geometry needs depth, and matches need things to look at.

use super::builder::{Builder, CuboidMaterials};
use super::material::Material;
use crate::scene_rng::SceneRng;
use nalgebra::{Translation3, UnitQuaternion, Vector3};
use skclam_geometry::{Isometry3, Point3};

/// Half sizes of the room, metres.
const ROOM: [f64; 2] = [2.15, 1.95];
const FLOOR_Z: f64 = -0.78;
const CEILING_Z: f64 = 1.85;
const TABLE_HALF: f64 = 0.62;

/// One of the four walls: a frame with x along the wall (to the right as seen from inside), y into the room,
/// z up from the table's height; the origin is in the wall's middle.
fn wall_frame(side: usize) -> (Isometry3, f64) {
    let angle = std::f64::consts::FRAC_PI_2 * side as f64;
    let (distance, half) = if side.is_multiple_of(2) { (ROOM[0], ROOM[1]) } else { (ROOM[1], ROOM[0]) };
    // Outward direction (cos, sin); into the room is its negative.
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle + std::f64::consts::FRAC_PI_2);
    let outward = Vector3::new(angle.cos(), angle.sin(), 0.0);
    (Isometry3::from_parts(Translation3::from(outward * distance), turn), half)
}

fn upright(x: f64, y: f64, z: f64, yaw: f64) -> Isometry3 {
    Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw))
}

/// Builds the whole room.
pub(crate) fn furnish(builder: &mut Builder, seed: u64) {
    let mut rng = SceneRng::new(seed, 1);
    room(builder);
    table(builder, &mut rng);
    for side in 0..4 {
        let (frame, half) = wall_frame(side);
        wall_hangings(builder, &mut rng, &frame, half, side);
        bench(builder, &mut rng, &frame, half, side);
    }
    corners(builder, &mut rng);
    floor_items(builder, &mut rng);
}

fn room(builder: &mut Builder) {
    let (hx, hy) = (ROOM[0], ROOM[1]);
    let height = CEILING_Z - FLOOR_Z;
    let materials = [
        (Material::Plaster([186.0, 184.0, 172.0]), Material::StrandBoard),
        (Material::Plaster([150.0, 172.0, 180.0]), Material::Plaster([104.0, 130.0, 122.0])),
        (Material::Concrete([158.0, 154.0, 148.0]), Material::Concrete([138.0, 136.0, 132.0])),
        (Material::Plaster([196.0, 178.0, 142.0]), Material::Wood([150.0, 108.0, 68.0])),
    ];
    for (side, (upper, lower)) in materials.into_iter().enumerate() {
        let (frame, half) = wall_frame(side);
        let rail = 0.42;
        for (top, bottom, material) in [(CEILING_Z, rail, upper), (rail, FLOOR_Z, lower)] {
            // Seen from inside, x of the frame runs to the left of (-half): right is +x turned by the wall's frame.
            let corner = frame * Point3::new(half, 0.0, top);
            let right = frame * Vector3::new(-2.0 * half, 0.0, 0.0);
            builder.sheet(corner, right, Vector3::new(0.0, 0.0, bottom - top), material);
        }
    }
    debug_assert!(height > 2.0);
    builder.sheet(
        Point3::new(-hx, hy, FLOOR_Z),
        Vector3::new(2.0 * hx, 0.0, 0.0),
        Vector3::new(0.0, -2.0 * hy, 0.0),
        Material::Concrete([132.0, 131.0, 128.0]),
    );
    builder.sheet(
        Point3::new(-hx, -hy, CEILING_Z),
        Vector3::new(2.0 * hx, 0.0, 0.0),
        Vector3::new(0.0, 2.0 * hy, 0.0),
        Material::Plain([206.0, 206.0, 200.0]),
    );
}

fn table(builder: &mut Builder, rng: &mut SceneRng) {
    let size = 2.0 * TABLE_HALF;
    let materials = CuboidMaterials {
        top: Some(Material::Wood([166.0, 128.0, 86.0])),
        bottom: None,
        sides: [Some(Material::Wood([140.0, 104.0, 68.0])); 4],
    };
    builder.cuboid(&upright(0.0, 0.0, -0.05, 0.0), [size, size, 0.05], &materials);
    for (sx, sy) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let leg = TABLE_HALF - 0.06;
        let materials =
            CuboidMaterials { top: None, bottom: None, sides: [Some(Material::Lacquer([70.0, 78.0, 86.0])); 4] };
        builder.cuboid(&upright(sx * leg, sy * leg, FLOOR_Z, 0.0), [0.07, 0.07, -0.05 - FLOOR_Z], &materials);
    }
    // Low things near the table's edge: plates, trays, parts; the arm swings above them.
    let mut angle = rng.range(0.0, 0.4);
    while angle < std::f64::consts::TAU - 0.2 {
        let radius = rng.range(0.47, 0.56);
        let (x, y) = (radius * angle.cos(), radius * angle.sin());
        let yaw = angle + rng.range(-0.5, 0.5);
        let size = [rng.range(0.05, 0.11), rng.range(0.05, 0.13), rng.range(0.008, 0.05)];
        match rng.below(4) {
            0 => {
                let radius = rng.range(0.02, 0.045);
                let (bottom, top) = (Point3::new(x, y, 0.0), Point3::new(x, y, size[2]));
                builder.cylinder(bottom, top, radius, Material::Steel, [None, Some(Material::Steel)]);
            }
            1 => builder.cuboid(&upright(x, y, 0.0, yaw), size, &CuboidMaterials::freestanding(Material::Steel)),
            2 => builder.cuboid(&upright(x, y, 0.0, yaw), size, &CuboidMaterials::freestanding(lacquer(rng))),
            _ => builder.cuboid(&upright(x, y, 0.0, yaw), size, &CuboidMaterials::freestanding(Material::Cardboard)),
        }
        angle += rng.range(0.28, 0.5);
    }
}

fn lacquer(rng: &mut SceneRng) -> Material {
    Material::Lacquer(rng.pick(&[
        [66.0, 96.0, 140.0],
        [150.0, 62.0, 52.0],
        [196.0, 150.0, 52.0],
        [84.0, 122.0, 92.0],
        [150.0, 152.0, 150.0],
        [92.0, 94.0, 102.0],
    ]))
}

/// A flat thing on a wall: `x` its middle, `z` its lower edge in the wall's frame.
fn hang(builder: &mut Builder, frame: &Isometry3, x: f64, z: f64, size: (f64, f64), thickness: f64, front: Material) {
    let edge = Material::Plain([120.0, 116.0, 110.0]);
    // A quarter turn: the cuboid's +x side faces the room, as the wall frame's y does.
    let place = frame * upright(x, 0.0, z, std::f64::consts::FRAC_PI_2);
    let materials =
        CuboidMaterials { top: Some(edge), bottom: Some(edge), sides: [Some(front), Some(edge), None, Some(edge)] };
    builder.cuboid(
        &(place * Isometry3::translation(0.5 * thickness, 0.0, 0.0)),
        [thickness, size.0, size.1],
        &materials,
    );
}

fn wall_hangings(builder: &mut Builder, rng: &mut SceneRng, frame: &Isometry3, half: f64, side: usize) {
    // A row at the height of the eyes and one above, with gaps where the plaster shows.
    for (row, (z, height)) in [(0.46, 0.44), (0.98, 0.40)].into_iter().enumerate() {
        let mut x = -half + rng.range(0.12, 0.3);
        while x < half - 0.4 {
            let width = rng.range(0.24, 0.62);
            if x + width > half - 0.1 {
                break;
            }
            let middle = x + 0.5 * width;
            let tall = height * rng.range(0.62, 1.0);
            let low = z + rng.range(0.0, height - tall);
            match rng.below(10) {
                0..=4 => hang(builder, frame, middle, low, (width, tall), 0.006, Material::Poster),
                5 => hang(builder, frame, middle, low, (width, tall), 0.02, Material::NoticeBoard),
                6 => {
                    let depth = rng.range(0.08, 0.16);
                    hang(builder, frame, middle, low, (0.7 * width, tall), depth, Material::Panel);
                }
                7 => hang(builder, frame, middle, low, (0.7 * width, 0.8 * tall), 0.14, lacquer(rng)),
                8 if row == 0 => shelf(builder, rng, frame, middle, low, width),
                _ => {}
            }
            x += width + rng.range(0.03, 0.16);
        }
    }
    // Pipes and a cable duct along the wall.
    let steel = Material::Steel;
    for pipe in 0..2 {
        let (z, out) = (1.44 + 0.09 * f64::from(pipe), 0.07);
        let radius = 0.018 + 0.008 * f64::from(pipe);
        let ends = [frame * Point3::new(-half + 0.02, out, z), frame * Point3::new(half - 0.02, out, z)];
        builder.cylinder(ends[0], ends[1], radius, if pipe == 0 { steel } else { lacquer(rng) }, [None, None]);
    }
    let x = half * if side.is_multiple_of(2) { 0.93 } else { -0.93 };
    let (low, high) = (frame * Point3::new(x, 0.05, FLOOR_Z), frame * Point3::new(x, 0.05, CEILING_Z));
    builder.cylinder(low, high, 0.028, lacquer(rng), [None, None]);
}

fn shelf(builder: &mut Builder, rng: &mut SceneRng, frame: &Isometry3, x: f64, z: f64, width: f64) {
    let depth = 0.2;
    let board = CuboidMaterials::all(Material::Wood([172.0, 138.0, 98.0]));
    builder.cuboid(&(frame * upright(x, 0.5 * depth, z, 0.0)), [width, depth, 0.018], &board);
    books(builder, rng, frame, (x - 0.5 * width + 0.01, x + 0.5 * width - 0.01), 0.45 * depth, z + 0.018);
}

/// A row of binders and books between two places along a wall.
fn books(builder: &mut Builder, rng: &mut SceneRng, frame: &Isometry3, range: (f64, f64), y: f64, z: f64) {
    let mut x = range.0;
    loop {
        let thickness = rng.range(0.018, 0.075);
        if x + thickness > range.1 {
            break;
        }
        let size = [thickness - 0.002, rng.range(0.11, 0.15), rng.range(0.17, 0.3)];
        let lean = if rng.chance(0.1) { rng.range(-0.1, 0.1) } else { 0.0 };
        let place = frame * upright(x + 0.5 * thickness, y, z, lean * 0.5);
        builder.cuboid(&place, size, &CuboidMaterials::freestanding(Material::Spine));
        x += thickness + if rng.chance(0.12) { rng.range(0.02, 0.08) } else { 0.0 };
    }
}

fn bench(builder: &mut Builder, rng: &mut SceneRng, frame: &Isometry3, half: f64, side: usize) {
    let (depth, top) = (0.55, [-0.04, 0.06, -0.12, 0.02][side]);
    let (left, right) = (-half + 0.5, half - 0.5);
    let width = right - left;
    let surface = [
        Material::Wood([176.0, 140.0, 96.0]),
        Material::Terrazzo([168.0, 166.0, 158.0]),
        Material::Steel,
        Material::StrandBoard,
    ][side];
    let edge = [
        Material::Wood([120.0, 92.0, 60.0]),
        Material::Plain([110.0, 112.0, 114.0]),
        Material::Steel,
        Material::StrandBoard,
    ][side];
    let materials = CuboidMaterials { top: Some(surface), bottom: None, sides: [Some(edge); 4] };
    let place = |x: f64, y: f64, z: f64, yaw: f64| frame * upright(x, y, z, yaw);
    builder.cuboid(&place(0.0, 0.5 * depth + 0.01, top - 0.04, 0.0), [width, depth, 0.04], &materials);
    // Below: drawers here, open legs and crates there.
    let mut x = left;
    while x < right - 0.3 {
        let bay = rng.range(0.38, 0.62).min(right - x);
        let middle = x + 0.5 * bay;
        if rng.chance(0.55) {
            let front = lacquer(rng);
            let drawers = 2 + rng.below(3);
            let height = (top - 0.04 - FLOOR_Z - 0.06) / drawers as f64;
            for drawer in 0..drawers {
                let z = FLOOR_Z + 0.06 + height * drawer as f64;
                let inset = rng.range(0.0, 0.03);
                let materials = CuboidMaterials::freestanding(front);
                builder.cuboid(
                    &place(middle, 0.5 * (depth - 0.06) - inset, z + 0.006, 0.0),
                    [bay - 0.03, depth - 0.08, height - 0.012],
                    &materials,
                );
            }
        } else {
            let mut z = FLOOR_Z;
            while z < top - 0.28 {
                let size = [rng.range(0.24, (bay - 0.04).max(0.25)), rng.range(0.24, 0.4), rng.range(0.12, 0.24)];
                let yaw = rng.range(-0.12, 0.12);
                let material =
                    if rng.chance(0.75) { Material::Cardboard } else { Material::Wood([160.0, 122.0, 80.0]) };
                builder.cuboid(
                    &place(middle, rng.range(0.24, 0.34), z, yaw),
                    size,
                    &CuboidMaterials::freestanding(material),
                );
                z += size[2];
                if rng.chance(0.3) {
                    break;
                }
            }
        }
        x += bay;
    }
    bench_top(builder, rng, frame, (left + 0.06, right - 0.06), top);
}

fn bench_top(builder: &mut Builder, rng: &mut SceneRng, frame: &Isometry3, range: (f64, f64), top: f64) {
    let mut x = range.0;
    while x < range.1 - 0.1 {
        let width = rng.range(0.1, 0.34).min(range.1 - x);
        let middle = x + 0.5 * width;
        let y = rng.range(0.2, 0.36);
        match rng.below(8) {
            0..=2 => {
                // Cartons, one or two high.
                let mut z = top;
                let mut size = [0.9 * width, rng.range(0.14, 0.28), rng.range(0.1, 0.26)];
                for _ in 0..1 + rng.below(2) {
                    let place = frame * upright(middle, y, z, rng.range(-0.3, 0.3));
                    builder.cuboid(&place, size, &CuboidMaterials::freestanding(Material::Cardboard));
                    z += size[2];
                    size = [0.75 * size[0], 0.8 * size[1], rng.range(0.07, 0.16)];
                }
            }
            3 => books(builder, rng, frame, (x, x + width), y, top),
            4 => {
                // An instrument: lacquered box with a panel to the front.
                let size = [0.92 * width, 0.24, rng.range(0.12, 0.22)];
                let body = lacquer(rng);
                let sides = [Some(body), Some(Material::Panel), Some(body), None];
                let materials = CuboidMaterials { top: Some(body), bottom: None, sides };
                builder.cuboid(&(frame * upright(middle, y, top, rng.range(-0.1, 0.1))), size, &materials);
            }
            5 => {
                // Tins and bottles.
                let mut along = x + 0.03;
                while along < x + width - 0.03 {
                    let radius = rng.range(0.022, 0.05);
                    let height = rng.range(0.07, 0.22);
                    let at = (along + radius, y + rng.range(-0.08, 0.08));
                    let (bottom, up) =
                        (frame * Point3::new(at.0, at.1, top), frame * Point3::new(at.0, at.1, top + height));
                    let material = rng.pick(&[Material::Spine, Material::Steel, Material::Cardboard, Material::Poster]);
                    builder.cylinder(bottom, up, radius, material, [None, Some(Material::Steel)]);
                    along += 2.0 * radius + rng.range(0.005, 0.04);
                }
            }
            6 => {
                // A board that leans against the wall.
                let lean = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.22);
                let place =
                    frame * upright(middle, 0.13, top, 0.0) * Isometry3::from_parts(Translation3::identity(), lean);
                let front =
                    rng.pick(&[Material::Poster, Material::StrandBoard, Material::Panel, Material::NoticeBoard]);
                let plain = Some(Material::Plain([150.0, 140.0, 120.0]));
                let materials = CuboidMaterials { top: plain, bottom: None, sides: [plain, Some(front), plain, None] };
                builder.cuboid(&place, [0.95 * width, 0.015, rng.range(0.22, 0.36)], &materials);
            }
            _ => {}
        }
        x += width + rng.range(0.02, 0.07);
    }
}

fn corners(builder: &mut Builder, rng: &mut SceneRng) {
    for (index, (sx, sy)) in [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)].into_iter().enumerate() {
        let (x, y) = (sx * (ROOM[0] - 0.26), sy * (ROOM[1] - 0.26));
        match index {
            0 | 2 => {
                // A cabinet.
                let materials = CuboidMaterials::freestanding(lacquer(rng));
                builder.cuboid(&upright(x, y, FLOOR_Z, 0.0), [0.44, 0.44, rng.range(1.35, 1.7)], &materials);
            }
            1 => {
                // Drums, one upon the other.
                let mut z = FLOOR_Z;
                for _ in 0..2 {
                    let (bottom, top) = (Point3::new(x, y, z), Point3::new(x, y, z + 0.62));
                    builder.cylinder(bottom, top, 0.21, lacquer(rng), [None, Some(Material::Steel)]);
                    z += 0.62;
                }
            }
            _ => {
                // A stack of crates and cartons.
                let mut z = FLOOR_Z;
                while z < 0.75 {
                    let size = [rng.range(0.3, 0.44), rng.range(0.3, 0.44), rng.range(0.16, 0.34)];
                    let material =
                        if rng.chance(0.6) { Material::Cardboard } else { Material::Wood([164.0, 124.0, 82.0]) };
                    builder.cuboid(
                        &upright(x, y, z, rng.range(-0.25, 0.25)),
                        size,
                        &CuboidMaterials::freestanding(material),
                    );
                    z += size[2];
                }
            }
        }
    }
}

/// Things on the floor between the table and the benches: depth, and something to see beyond.
fn floor_items(builder: &mut Builder, rng: &mut SceneRng) {
    let places = 9;
    for place in 0..places {
        let angle = std::f64::consts::TAU * (place as f64 + rng.range(0.2, 0.8)) / places as f64;
        let radius = rng.range(1.05, 1.2);
        let (x, y) = (radius * angle.cos(), radius * angle.sin());
        let yaw = angle + rng.range(-0.4, 0.4);
        match rng.below(5) {
            0 => {
                // A tripod with an instrument on a pole.
                let height = rng.range(0.75, 1.0);
                let (bottom, top) = (Point3::new(x, y, FLOOR_Z), Point3::new(x, y, FLOOR_Z + height));
                builder.cylinder(bottom, top, 0.02, Material::Steel, [None, None]);
                let foot = Point3::new(x, y, FLOOR_Z + 0.02);
                builder.cylinder(bottom, foot, 0.16, Material::Steel, [None, Some(Material::Steel)]);
                let materials = CuboidMaterials::all(Material::Panel);
                let size = [rng.range(0.06, 0.12), rng.range(0.16, 0.28), rng.range(0.14, 0.24)];
                builder.cuboid(&upright(x, y, top.z, yaw), size, &materials);
            }
            1 => {
                // A waste drum.
                let height = rng.range(0.5, 0.7);
                let (bottom, top) = (Point3::new(x, y, FLOOR_Z), Point3::new(x, y, FLOOR_Z + height));
                builder.cylinder(bottom, top, rng.range(0.12, 0.17), lacquer(rng), [None, Some(Material::Steel)]);
            }
            _ => {
                // A stack on the floor.
                let mut z = FLOOR_Z;
                let limit = rng.range(-0.25, 0.28);
                while z < limit {
                    let size = [rng.range(0.2, 0.36), rng.range(0.2, 0.36), rng.range(0.12, 0.3)];
                    let material = match rng.below(4) {
                        0 => Material::Wood([158.0, 118.0, 76.0]),
                        1 => lacquer(rng),
                        _ => Material::Cardboard,
                    };
                    builder.cuboid(
                        &upright(x, y, z, yaw + rng.range(-0.2, 0.2)),
                        size,
                        &CuboidMaterials::freestanding(material),
                    );
                    z += size[2];
                }
            }
        }
    }
}
