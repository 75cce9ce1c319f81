//! `skclam render`.

use crate::args::{Cli, RenderArgs, ViewArg};
use crate::screen::{self, say};
use anyhow::{Context, Result, bail};
use image::ImageFormat;
use skclam::geometry::Point3;
use skclam::mapping::{
    Model, Projection, RenderCamera, RenderOptions, ViewPreset, read_ply, render as draw, side_by_side,
};
use skclam::output::StagedFile;
use std::io::{BufReader, Cursor};
use std::path::Path;

/// Pixels between two images.
const GAP: u32 = 12;

/// Draws a map, or two from the same place.
pub fn render(cli: &Cli, args: &RenderArgs) -> Result<()> {
    let options = RenderOptions { point_radius_m: args.point_radius_mm * 1e-3, ..RenderOptions::default() };
    let ending = args.out.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
    if !["png", "jpg", "jpeg"].contains(&ending.as_str()) {
        bail!("--out {}: images are written as PNG or JPEG; end the name in .png or .jpg", args.out.display());
    }
    let staged = StagedFile::new(&args.out)?;
    let model = read(&args.map)?;
    let camera = camera(args, &model)?;
    let mut image = draw(&model, &camera, &options)?;
    if let Some(beside) = &args.beside {
        let second = draw(&read(beside)?, &camera, &options)?;
        image = side_by_side(&image, &second, GAP, options.background);
    }
    let format = if ending == "png" { ImageFormat::Png } else { ImageFormat::Jpeg };
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).with_context(|| args.out.display().to_string())?;
    staged.write(bytes.into_inner())?;
    staged.publish()?;
    if cli.json {
        let written = serde_json::json!({ "image": args.out, "width": image.width(), "height": image.height() });
        screen::json(&written)?;
    } else {
        say!("{} x {}: {}", image.width(), image.height(), args.out.display());
    }
    Ok(())
}

/// Reads a cloud or a mesh.
pub fn read(path: &Path) -> Result<Model> {
    let file = skclam_files::open(path, skclam_files::Kind::Map).with_context(|| path.display().to_string())?;
    read_ply(BufReader::new(file)).with_context(|| path.display().to_string())
}

fn camera(args: &RenderArgs, model: &Model) -> Result<RenderCamera> {
    if let (Some(eye), Some(target)) = (args.eye, args.target) {
        if !(1.0..=170.0).contains(&args.hfov_deg) {
            bail!("--hfov-deg {}: 1 to 170 is needed", args.hfov_deg);
        }
        let projection = Projection::Perspective { hfov: args.hfov_deg.to_radians() };
        return Ok(RenderCamera::looking_at(
            Point3::from(eye),
            Point3::from(target),
            projection,
            args.width,
            args.height,
        ));
    }
    let preset = match args.view {
        ViewArg::Front => ViewPreset::Front,
        ViewArg::Back => ViewPreset::Back,
        ViewArg::Left => ViewPreset::Left,
        ViewArg::Right => ViewPreset::Right,
        ViewArg::Top => ViewPreset::Top,
        ViewArg::Isometric => ViewPreset::Isometric,
        ViewArg::Perspective => ViewPreset::Perspective,
    };
    Ok(RenderCamera::framing(model, preset, args.width, args.height))
}
