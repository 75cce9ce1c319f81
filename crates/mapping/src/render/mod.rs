//! Images of a map, drawn on the CPU without a window.
//!
//! Points are drawn as discs of a given radius, triangles by scan conversion, both with a depth buffer at several
//! samples a pixel. Eye-dome lighting (Boucheny 2009: darken what lies behind its neighbours on the screen) makes depth
//! readable where there is no other light; normals, where there are any, add a soft light from the viewer. Surfaces
//! that turn their back to the viewer are left out, so that one can look into a closed cell through its walls.

mod camera;
mod raster;
mod shade;

pub use camera::{Projection, RenderCamera, ViewPreset};

use crate::{Error, Model};
use image::{Rgb, RgbImage};
use raster::Canvas;
use serde::{Deserialize, Serialize};

/// What is done with surfaces whose normals point away from the viewer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BackFaces {
    /// They are left out: one looks into a closed cell through its walls.
    #[default]
    Hidden,
    /// They are drawn like any other.
    Drawn,
}

/// How a map is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderOptions {
    /// Colour where nothing is.
    pub background: [u8; 3],
    /// Colour of maps that have none.
    pub material: [u8; 3],
    /// Radius of a point's disc, metres; about the spacing of the points.
    pub point_radius_m: f64,
    /// How strongly depth steps darken; 0 = not at all.
    pub eye_dome: f64,
    /// How strongly surfaces darken that turn away from the viewer, 0 to 1 (needs normals).
    pub headlight: f64,
    /// Surfaces seen from behind.
    pub back_faces: BackFaces,
    /// Samples a pixel along each axis, 1 to 4.
    pub supersampling: u32,
}

impl Default for RenderOptions {
    fn default() -> Self {
        RenderOptions {
            background: [255, 255, 255],
            material: [190, 190, 190],
            point_radius_m: 0.003,
            eye_dome: 0.7,
            headlight: 0.25,
            back_faces: BackFaces::Hidden,
            supersampling: 2,
        }
    }
}

impl RenderOptions {
    fn check(&self) -> Result<(), Error> {
        let fits = |value: f64, high: f64| value.is_finite() && (0.0..=high).contains(&value);
        let bad = |option, value: f64, need| Err(Error::Option { option, value: value.to_string(), need });
        if !fits(self.point_radius_m, 10.0) {
            return bad("point_radius_m", self.point_radius_m, "0 to 10 m is needed");
        }
        if !fits(self.eye_dome, 100.0) {
            return bad("eye_dome", self.eye_dome, "0 to 100 is needed");
        }
        if !fits(self.headlight, 1.0) {
            return bad("headlight", self.headlight, "0 to 1 is needed");
        }
        if !(1..=4).contains(&self.supersampling) {
            return bad("supersampling", f64::from(self.supersampling), "1 to 4 is needed");
        }
        Ok(())
    }
}

/// Draws a cloud or a mesh as a camera would see it. An empty map gives an empty image.
pub fn render(model: &Model, camera: &RenderCamera, options: &RenderOptions) -> Result<RgbImage, Error> {
    options.check()?;
    model.check()?;
    camera.check()?;
    let fine = camera.supersampled(options.supersampling);
    let canvas = match model {
        Model::Cloud(cloud) => Canvas::of_points(cloud, &fine, options),
        Model::Mesh(mesh) => Canvas::of_triangles(mesh, &fine, options),
    };
    Ok(shade::develop(&canvas, &fine, options))
}

/// Two images beside each other, `gap` pixels of the background between them; the lower one is padded at its foot.
pub fn side_by_side(left: &RgbImage, right: &RgbImage, gap: u32, background: [u8; 3]) -> RgbImage {
    let height = left.height().max(right.height());
    let mut both = RgbImage::from_pixel(left.width() + gap + right.width(), height, Rgb(background));
    for (image, offset) in [(left, 0), (right, left.width() + gap)] {
        for (x, y, pixel) in image.enumerate_pixels() {
            both.put_pixel(x + offset, y, *pixel);
        }
    }
    both
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{PointCloud, TriangleMesh};
    use skclam_geometry::Isometry3;

    fn square(z: f32, color: [u8; 3], from: u32) -> (PointCloud, Vec<[u32; 3]>) {
        let points = vec![[-1.0, -1.0, z], [1.0, -1.0, z], [1.0, 1.0, z], [-1.0, 1.0, z]];
        let cloud = PointCloud { points, colors: vec![color; 4], normals: vec![[0.0, 0.0, 1.0]; 4] };
        (cloud, vec![[from, from + 1, from + 2], [from, from + 2, from + 3]])
    }

    fn above(width: u32, height: u32) -> RenderCamera {
        RenderCamera {
            width,
            height,
            projection: Projection::Orthographic { height_m: 2.5 },
            base_from_eye: Isometry3::from_parts(
                nalgebra::Translation3::new(0.0, 0.0, 5.0),
                nalgebra::UnitQuaternion::from_axis_angle(&nalgebra::Vector3::x_axis(), std::f64::consts::PI),
            ),
        }
    }

    #[test]
    fn the_nearer_surface_hides_the_farther_one_and_backs_are_hidden() {
        let (mut vertices, mut triangles) = square(0.0, [255, 0, 0], 0);
        let (upper, upper_triangles) = square(1.0, [0, 0, 255], 4);
        vertices.points.extend(upper.points);
        vertices.colors.extend(upper.colors);
        vertices.normals.extend(upper.normals);
        triangles.extend(upper_triangles);
        let mut mesh = TriangleMesh { vertices, triangles };
        let options = RenderOptions { eye_dome: 0.0, headlight: 0.0, ..Default::default() };
        let image = render(&mesh.clone().into(), &above(50, 50), &options).unwrap();
        assert_eq!(image.get_pixel(25, 25).0, [0, 0, 255]);
        assert_eq!(image.get_pixel(0, 0).0, [255; 3], "the background");
        for triangle in &mut mesh.triangles[2..] {
            triangle.reverse();
        }
        mesh.vertices.normals.clear();
        let image = render(&mesh.clone().into(), &above(50, 50), &options).unwrap();
        assert_eq!(image.get_pixel(25, 25).0, [255, 0, 0], "the upper one shows its back");
        let drawn = RenderOptions { back_faces: BackFaces::Drawn, ..options };
        assert_eq!(render(&mesh.into(), &above(50, 50), &drawn).unwrap().get_pixel(25, 25).0, [0, 0, 255]);
    }

    #[test]
    fn a_point_is_a_disc_of_its_radius_where_the_camera_sees_it() {
        let cloud = PointCloud { points: vec![[0.5, 0.25, 0.0]], ..Default::default() };
        let options = RenderOptions { point_radius_m: 0.2, eye_dome: 0.0, supersampling: 1, ..Default::default() };
        let image = render(&cloud.into(), &above(100, 100), &options).unwrap();
        let drawn: Vec<(u32, u32)> =
            image.enumerate_pixels().filter(|(_, _, p)| p.0 != [255; 3]).map(|(x, y, _)| (x, y)).collect();
        // 100 px over 2.5 m: 40 px/m, so 8 px of radius around (49.5 + 20, 49.5 - 10).
        let area = drawn.len() as f64;
        assert!((area - std::f64::consts::PI * 64.0).abs() < 15.0, "{area}");
        let mean = drawn.iter().fold((0.0, 0.0), |sum, p| (sum.0 + f64::from(p.0), sum.1 + f64::from(p.1)));
        assert!((mean.0 / area - 69.5).abs() < 0.3 && (mean.1 / area - 39.5).abs() < 0.3, "{mean:?}");
    }

    #[test]
    fn a_triangle_through_the_camera_is_clipped_and_not_wrapped() {
        let vertices =
            PointCloud { points: vec![[-5.0, 1.0, -5.0], [5.0, 1.0, -5.0], [0.0, 1.0, 20.0]], ..Default::default() };
        let mesh = TriangleMesh { vertices, triangles: vec![[0, 1, 2]] };
        let camera = RenderCamera {
            width: 64,
            height: 64,
            projection: Projection::Perspective { hfov: 1.2 },
            base_from_eye: Isometry3::identity(),
        };
        let options = RenderOptions { back_faces: BackFaces::Drawn, ..Default::default() };
        let image = render(&mesh.into(), &camera, &options).unwrap();
        assert_ne!(image.get_pixel(32, 60).0, [255; 3], "the floor");
        assert_eq!(image.get_pixel(32, 10).0, [255; 3], "the sky");
    }

    #[test]
    fn the_same_image_on_any_number_of_threads() {
        let points: Vec<[f32; 3]> =
            (0..4000).map(|i| [(i as f32 * 0.37).sin(), (i as f32 * 0.71).cos(), (i % 7) as f32 * 0.1]).collect();
        let colors = (0..4000).map(|i| [i as u8, (i / 3) as u8, 40]).collect();
        let cloud: Model = PointCloud { points, colors, ..Default::default() }.into();
        let draw = |threads| {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| {
                let options = RenderOptions { point_radius_m: 0.05, ..Default::default() };
                render(&cloud, &above(120, 90), &options).unwrap()
            })
        };
        assert_eq!(draw(1), draw(3));
    }

    #[test]
    fn empty_maps_give_empty_images_and_bad_options_errors() {
        let empty: Model = PointCloud::default().into();
        let image = render(&empty, &above(10, 10), &RenderOptions::default()).unwrap();
        assert!(image.pixels().all(|pixel| pixel.0 == [255; 3]));
        let bad = RenderOptions { supersampling: 9, ..Default::default() };
        assert!(matches!(render(&empty, &above(10, 10), &bad), Err(Error::Option { .. })));
        let mut blind = above(10, 10);
        blind.projection = Projection::Perspective { hfov: f64::NAN };
        assert!(render(&empty, &blind, &RenderOptions::default()).is_err());
    }

    #[test]
    fn two_images_are_drawn_side_by_side() {
        let both = side_by_side(&RgbImage::new(4, 2), &RgbImage::new(3, 5), 2, [9, 9, 9]);
        assert_eq!(both.dimensions(), (9, 5));
        assert_eq!(both.get_pixel(4, 0).0, [9; 3]);
        assert_eq!(both.get_pixel(8, 4).0, [0; 3]);
    }
}
