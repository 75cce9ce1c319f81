//! Our own visibility-buffer rasteriser: colour and z-depth of models as a pinhole camera sees them.
//!
//! Exactness is the point: a simulated corner must be where the camera model says, to a few hundredths of a pixel,
//! or the cell would teach a calibration errors of its own. Each pixel's value is the mean over its square, by
//! visibility samples for edges and by the texture filter within faces; light is a property of surfaces, never of
//! the view. Tiles are independent, so the bytes do not depend on the number of threads.

mod lens;
mod samples;
mod setup;
mod tile;

pub use samples::Antialiasing;

use crate::{Model, SimulationError};
use image::RgbImage;
use lens::Lens;
use rayon::prelude::*;
use samples::{Pattern, Samples};
use setup::{ViewedFace, ViewedTriangle};
use skclam_geometry::{DepthImage, Isometry3, PinholeCamera};
use tile::{LocalFaces, TILE, Tile, TileArea};

/// A camera that draws models.
#[derive(Debug, Clone)]
pub struct Renderer {
    camera: PinholeCamera,
    antialiasing: Antialiasing,
    lens: Lens,
}

/// Larger images are refused: their buffers would not fit a common machine.
const MAX_PIXELS: u64 = 1 << 27;

impl Renderer {
    /// Prepares a camera. Errors: no pixels, too many, focal lengths that are not positive and finite, or a
    /// distortion that folds back within the image.
    pub fn new(camera: &PinholeCamera, antialiasing: Antialiasing) -> Result<Self, SimulationError> {
        let pixels = u64::from(camera.width) * u64::from(camera.height);
        let finite = camera.intrinsics().iter().all(|value| value.is_finite());
        if pixels == 0 || pixels > MAX_PIXELS || !finite || camera.fx <= 0.0 || camera.fy <= 0.0 {
            return Err(SimulationError::Camera {
                width: camera.width,
                height: camera.height,
                fx: camera.fx,
                fy: camera.fy,
            });
        }
        let lens = Lens::new(camera);
        if camera.is_distorted() && !lens.is_invertible() {
            return Err(SimulationError::Distortion { distortion: camera.distortion });
        }
        Ok(Renderer { camera: *camera, antialiasing, lens })
    }

    /// The camera.
    pub fn camera(&self) -> &PinholeCamera {
        &self.camera
    }

    /// What the camera sees in colour. Black where there is no surface.
    pub fn color(&self, base_from_camera: &Isometry3, models: &[&Model]) -> RgbImage {
        match self.antialiasing {
            Antialiasing::None => self.color_with::<1>(base_from_camera, models),
            Antialiasing::Four => self.color_with::<4>(base_from_camera, models),
            Antialiasing::Eight => self.color_with::<8>(base_from_camera, models),
            Antialiasing::Sixteen => self.color_with::<16>(base_from_camera, models),
        }
    }

    /// z-depth at the pixels' centres, metres, without any noise; 0 where there is no surface.
    pub fn depth(&self, base_from_camera: &Isometry3, models: &[&Model]) -> DepthImage {
        let (faces, triangles) = setup::view(models, &self.camera, &base_from_camera.inverse());
        let (width, height) = (self.camera.width, self.camera.height);
        let mut depth_m = vec![0.0f32; width as usize * height as usize];
        depth_m.par_chunks_mut((width * TILE) as usize).enumerate().for_each_init(
            Tile::<1>::new,
            |tile, (band, row)| {
                self.band(tile, band as u32, &faces, &triangles, |tile| {
                    for_each_pixel(tile, |column, line| {
                        row[(line * width + tile.area.origin.0 + column) as usize] = tile.depth(column, line);
                    });
                });
            },
        );
        // A face is never nearer than the near plane, so that every value is finite and positive or zero.
        DepthImage::new(width, height, depth_m).expect("depths of faces before the near plane are finite")
    }

    fn color_with<const N: usize>(&self, base_from_camera: &Isometry3, models: &[&Model]) -> RgbImage
    where
        Samples: Pattern<N>,
    {
        let (faces, triangles) = setup::view(models, &self.camera, &base_from_camera.inverse());
        let (width, height) = (self.camera.width, self.camera.height);
        let mut image = RgbImage::new(width, height);
        image.par_chunks_mut((width * 3 * TILE) as usize).enumerate().for_each_init(
            Tile::<N>::new,
            |tile, (band, bytes)| {
                self.band(tile, band as u32, &faces, &triangles, |tile| {
                    let mut local = LocalFaces::new(&faces);
                    for_each_pixel(tile, |column, line| {
                        let start = 3 * (line * width + tile.area.origin.0 + column) as usize;
                        let colour = tile.colour(column, line, &mut local);
                        for channel in 0..3 {
                            bytes[start + channel] = (colour[channel] + 0.5) as u8;
                        }
                    });
                });
            },
        );
        image
    }

    /// Resolves the tiles of one band of rows, left to right.
    fn band<const N: usize>(
        &self,
        tile: &mut Tile<N>,
        band: u32,
        faces: &[ViewedFace<'_>],
        triangles: &[ViewedTriangle],
        mut finish: impl FnMut(&Tile<N>),
    ) where
        Samples: Pattern<N>,
    {
        let (width, height) = (self.camera.width, self.camera.height);
        let top = band * TILE;
        for left in (0..width).step_by(TILE as usize) {
            let area = TileArea { origin: (left, top), width: TILE.min(width - left), height: TILE.min(height - top) };
            tile.resolve(area, &self.lens, faces, triangles);
            finish(tile);
        }
    }
}

fn for_each_pixel<const N: usize>(tile: &Tile<N>, mut visit: impl FnMut(u32, u32)) {
    for row in 0..tile.area.height {
        for column in 0..tile.area.width {
            visit(column, row);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Face, RayCaster, Texture};
    use crate::{Scene, SceneOptions};
    use nalgebra::{Translation3, UnitQuaternion, Vector3};
    use skclam_geometry::{Pixel, Point3};
    use std::sync::Arc;

    /// A sheet of 0.4 x 0.3 m in the plane z = 0, seen from above (+z), texel (0, 0) at its corner (-0.2, 0.15).
    fn sheet(texture: Texture) -> Model {
        let (columns, rows) = texture.size();
        let face = Face {
            origin: Point3::new(-0.2, 0.15, 0.0),
            normal: Vector3::z(),
            s_axis: Vector3::x() * (f64::from(columns) / 0.4),
            t_axis: -Vector3::y() * (f64::from(rows) / 0.3),
            origin_texel: [0.0, 0.0],
            texture: 0,
            brightness: 1.0,
        };
        let mut model = Model { textures: Arc::new(vec![texture]), ..Model::default() };
        model.add_polygon(face, &corners());
        model
    }

    fn corners() -> [Point3; 4] {
        [(-0.2, 0.15), (-0.2, -0.15), (0.2, -0.15), (0.2, 0.15)].map(|(x, y)| Point3::new(x, y, 0.0))
    }

    /// A camera above the sheet that looks down at it, turned and tilted.
    fn above(tilt: Vector3<f64>, height: f64) -> Isometry3 {
        let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let turn = UnitQuaternion::from_scaled_axis(tilt);
        let rotation = turn * down;
        let back = rotation * Vector3::new(0.013, -0.021, -height);
        Isometry3::from_parts(Translation3::from(back), rotation)
    }

    fn cameras() -> [PinholeCamera; 2] {
        let plain = PinholeCamera::from_hfov(640, 400, 1.0);
        let mut distorted = plain;
        distorted.distortion = [-0.12, 0.03, 8e-4, -5e-4, 0.004];
        (distorted.cx, distorted.cy) = (311.3, 205.9);
        [plain, distorted]
    }

    fn tilts() -> [Vector3<f64>; 4] {
        [
            Vector3::new(0.0, 0.0, 0.1),
            Vector3::new(0.3, -0.2, 0.5),
            Vector3::new(-0.7, 0.1, 1.1),
            Vector3::new(0.2, 0.8, -2.0),
        ]
    }

    /// Where an edge crosses a line of pixels: the covered length from its bright end.
    #[test]
    fn edges_of_a_sheet_are_where_the_camera_projects_them() {
        let model = sheet(Texture::new(4, 3, vec![[200; 4]; 12]));
        let mut largest = 0.0f64;
        for camera in cameras() {
            let renderer = Renderer::new(&camera, Antialiasing::Eight).unwrap();
            for tilt in tilts() {
                let pose = above(tilt, 0.55);
                let image = renderer.color(&pose, &[&model]);
                let inverse = pose.inverse();
                for side in 0..4 {
                    let (from, to) = (corners()[side], corners()[(side + 1) % 4]);
                    let project = |fraction: f64| camera.project(&(inverse * (from + (to - from) * fraction))).unwrap();
                    // Mean signed distance of the rendered edge to the true one over the middle of the side.
                    let (mut sum, mut count) = (0.0, 0);
                    for step in 0..200 {
                        let fraction = 0.15 + 0.7 * f64::from(step) / 199.0;
                        let (at, next) = (project(fraction), project(fraction + 1e-4));
                        let along = next - at;
                        let horizontal_scan = along.y.abs() > along.x.abs();
                        let slope = if horizontal_scan { along.x / along.y } else { along.y / along.x };
                        let (row, column) = (at.y.round(), at.x.round());
                        // True crossing of the pixel line nearest to the point, to first order along the edge.
                        let crossing =
                            if horizontal_scan { at.x + slope * (row - at.y) } else { at.y + slope * (column - at.x) };
                        let value = |offset: i64| {
                            let (x, y) = if horizontal_scan {
                                (crossing.round() as i64 + offset, row as i64)
                            } else {
                                (column as i64, crossing.round() as i64 + offset)
                            };
                            let inside = x >= 0 && y >= 0 && x < 640 && y < 400;
                            inside.then(|| f64::from(image.get_pixel(x as u32, y as u32)[0]) / 200.0)
                        };
                        let line: Option<Vec<f64>> = (-3..=3).map(value).collect();
                        let Some(line) = line else { continue };
                        let covered: f64 = line.iter().sum();
                        let first_is_bright = line[0] > 0.5;
                        let start = crossing.round() - 3.5;
                        let measured = if first_is_bright { start + covered } else { start + 7.0 - covered };
                        sum += (measured - crossing) / (1.0 + slope * slope).sqrt();
                        count += 1;
                    }
                    if count > 60 {
                        largest = largest.max((sum / f64::from(count)).abs());
                    }
                }
            }
        }
        println!("largest mean offset of an edge: {largest:.4} px");
        assert!(largest < 0.02, "{largest}");
        assert!(largest > 0.0, "edges were measured");
    }

    #[test]
    fn marks_on_a_sheet_are_where_the_camera_projects_them() {
        // Soft round marks with a standard deviation of 3 mm on 0.5 mm texels, at places that are no multiples of one.
        let (columns, rows) = (800usize, 600usize);
        let marks: Vec<(f64, f64)> =
            (0..12).map(|i| (133.37 + 173.31 * f64::from(i % 4), 118.83 + 181.29 * f64::from(i / 4))).collect();
        let bright = |s: f64, t: f64| {
            let falloff = |(ms, mt): &(f64, f64)| (-((s - ms).powi(2) + (t - mt).powi(2)) / 72.0).exp();
            20.0 + 220.0 * marks.iter().map(falloff).sum::<f64>()
        };
        let texels = (0..columns * rows)
            .map(|i| [(bright((i % columns) as f64 + 0.5, (i / columns) as f64 + 0.5) + 0.5) as u8; 4])
            .collect();
        let model = sheet(Texture::new(columns, rows, texels));
        let (mut largest, mut squares, mut count) = (0.0f64, 0.0, 0);
        for camera in cameras() {
            let renderer = Renderer::new(&camera, Antialiasing::Four).unwrap();
            // From two pixels a texel to four texels a pixel, and as oblique as the tilts make it.
            for (tilt, height) in tilts().into_iter().flat_map(|tilt| [0.2, 0.5, 1.0].map(|height| (tilt, height))) {
                let pose = above(tilt, height);
                let image = renderer.color(&pose, &[&model]);
                // The truth by another road: each pixel's ray, met with the plane, the pattern as a formula.
                let truth = |x: f64, y: f64| {
                    let way = pose * camera.unproject(&Pixel::new(x, y));
                    let point = pose.translation.vector + way * (-pose.translation.z / way.z);
                    bright((point.x + 0.2) * 2000.0, (0.15 - point.y) * 2000.0)
                };
                for (ms, mt) in &marks {
                    let point = Point3::new(-0.2 + ms / 2000.0, 0.15 - mt / 2000.0, 0.0);
                    let in_camera = pose.inverse() * point;
                    let Some(expected) = camera.project(&in_camera) else { continue };
                    let reach = (0.0075 * camera.fx / in_camera.z).ceil() as i64;
                    let (cx, cy) = (expected.x.round() as i64, expected.y.round() as i64);
                    if cx < reach || cy < reach || cx + reach >= 640 || cy + reach >= 400 {
                        continue;
                    }
                    // The shift between image and truth, by one step of Gauss and Newton.
                    let mut normal = nalgebra::Matrix2::zeros();
                    let mut right = nalgebra::Vector2::zeros();
                    for y in cy - reach..=cy + reach {
                        for x in cx - reach..=cx + reach {
                            let (fx, fy) = (x as f64, y as f64);
                            let mean = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)]
                                .map(|(dx, dy)| truth(fx + dx, fy + dy))
                                .iter()
                                .sum::<f64>()
                                / 4.0;
                            let slope = nalgebra::Vector2::new(
                                truth(fx + 0.5, fy) - truth(fx - 0.5, fy),
                                truth(fx, fy + 0.5) - truth(fx, fy - 0.5),
                            );
                            normal += slope * slope.transpose();
                            right -= slope * (f64::from(image.get_pixel(x as u32, y as u32)[0]) - mean);
                        }
                    }
                    let offset = (normal.try_inverse().unwrap() * right).norm();
                    largest = largest.max(offset);
                    squares += offset * offset;
                    count += 1;
                }
            }
        }
        let rms = (squares / f64::from(count)).sqrt();
        println!("{count} marks: rms {rms:.4} px, largest {largest:.4} px");
        assert!(count > 80 && rms < 0.02 && largest < 0.05, "{count} marks, rms {rms}, largest {largest}");
    }

    fn small_scene() -> Scene {
        Scene::new(&SceneOptions { texel_at_1m_mm: Some(25.0), ..Default::default() }, 300.0).unwrap()
    }

    #[test]
    fn depth_agrees_with_rays_and_bytes_with_any_number_of_threads() {
        let scene = small_scene();
        let caster: &RayCaster = scene.caster();
        for camera in cameras() {
            let camera = camera.scaled(0.5);
            let renderer = Renderer::new(&camera, Antialiasing::Four).unwrap();
            let rotation = UnitQuaternion::from_euler_angles(-1.7, 0.2, 0.7);
            let pose = Isometry3::from_parts(Translation3::new(0.2, -0.3, 0.5), rotation);
            let depth = renderer.depth(&pose, &[&scene.model]);
            let (mut wrong, mut checked) = (0, 0);
            for y in (0..camera.height).step_by(3) {
                for x in (0..camera.width).step_by(3) {
                    let way = pose * camera.unproject(&Pixel::new(f64::from(x), f64::from(y)));
                    let hit = caster.first_hit(&Point3::from(pose.translation.vector), &way, 100.0);
                    let expected = hit.map_or(0.0, |hit| hit.distance);
                    let got = f64::from(depth.at(x, y).unwrap_or(0.0));
                    checked += 1;
                    wrong += usize::from((got - expected).abs() > 1e-4 * expected.max(1.0));
                }
            }
            // A pixel on an edge may fall to either side by rounding.
            assert!(wrong * 500 <= checked, "{wrong} of {checked} pixels differ");
            let threads = |count| rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
            let draw = || renderer.color(&pose, &[&scene.model]);
            let (one, three) = (threads(1).install(draw), threads(3).install(draw));
            assert_eq!(one, three);
            assert_eq!(threads(1).install(|| renderer.depth(&pose, &[&scene.model])), depth);
        }
    }

    #[test]
    fn the_scene_is_closed_varied_and_the_same_for_its_seed() {
        let scene = small_scene();
        assert!(scene.surface_count() > 500, "{}", scene.surface_count());
        for index in 0..400u32 {
            // From a point above the table every direction meets a face that looks back.
            let angle = f64::from(index) * 2.399_963;
            let height = 1.0 - 2.0 * (f64::from(index) + 0.5) / 400.0;
            let radius = (1.0 - height * height).sqrt();
            let way = Vector3::new(radius * angle.cos(), radius * angle.sin(), height);
            let hit = scene.caster().first_hit(&Point3::new(0.1, 0.05, 0.55), &way, 10.0).expect("the cell is closed");
            assert!(scene.model.faces[hit.face as usize].normal.dot(&way) < 0.0, "a face shows its back");
        }
        let again = small_scene();
        assert_eq!(scene.model.vertices, again.model.vertices);
        let texels =
            |scene: &Scene| scene.model.textures.iter().map(|texture| texture.texel(3, 2)).collect::<Vec<[u8; 3]>>();
        assert_eq!(texels(&scene), texels(&again));
        let other = Scene::new(&SceneOptions { seed: 2, texel_at_1m_mm: Some(25.0) }, 300.0).unwrap();
        assert_ne!(scene.model.vertices, other.model.vertices);
    }

    #[test]
    fn what_is_behind_or_cut_by_the_camera_plane_is_drawn_right() {
        let model = sheet(Texture::new(2, 2, vec![[200; 4]; 4]));
        let camera = PinholeCamera::from_hfov(320, 200, 1.2);
        let renderer = Renderer::new(&camera, Antialiasing::Four).unwrap();
        // 2 cm above the sheet, looking along it: the sheet runs below and behind the camera.
        let level = nalgebra::Rotation3::from_basis_unchecked(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
        let pose =
            Isometry3::from_parts(Translation3::new(0.0, 0.0, 0.02), UnitQuaternion::from_rotation_matrix(&level));
        let depth = renderer.depth(&pose, &[&model]);
        // Straight ahead and down by 45 degrees would be depth 0.02; the lowest row of this camera looks down by less.
        let down = camera.unproject(&Pixel::new(160.0, 199.0)).y;
        assert!((f64::from(depth.at(160, 199).unwrap()) - 0.02 / down).abs() < 1e-4);
        assert_eq!(depth.at(160, 90), None, "above the horizon");
        let turned = pose * Isometry3::rotation(Vector3::x() * std::f64::consts::PI);
        assert!(renderer.color(&turned, &[&model]).height() == 200);
        let beneath = Isometry3::translation(0.0, 0.0, -0.3);
        assert!(renderer.depth(&beneath, &[&model]).as_slice().iter().all(|z| *z == 0.0), "a face has one side");
    }

    #[test]
    fn unusable_cameras_are_refused() {
        let mut camera = PinholeCamera::from_hfov(0, 10, 1.0);
        assert!(matches!(Renderer::new(&camera, Antialiasing::Four), Err(SimulationError::Camera { .. })));
        camera = PinholeCamera::from_hfov(100, 100, 1.0);
        camera.fy = f64::NAN;
        assert!(matches!(Renderer::new(&camera, Antialiasing::Four), Err(SimulationError::Camera { .. })));
        camera = PinholeCamera::from_hfov(100, 100, 1.0);
        camera.distortion[0] = -3.0;
        assert!(matches!(Renderer::new(&camera, Antialiasing::Four), Err(SimulationError::Distortion { .. })));
    }
}
