//! Whole imports: a recording of a robot becomes a data set.

use super::seeds::IMAGE_SIZE;
use skclam::dataset::{Dataset, write_depth_png};
use skclam::geometry::DepthImage;
use skclam::import::{ImportOptions, import_recording};
use skclam::output::{Contents, StagedFolder};
use skclam::progress::Silent;
use skclam::recordings::{Recording, Selection};
use skclam::rig::{Rig, builtin_rig};
use skclam::robot_recording::write_robot_recording;
use skclam_damage::Seed;
use std::path::Path;
use std::sync::OnceLock;

fn rig() -> &'static Rig {
    static RIG: OnceLock<Rig> = OnceLock::new();
    RIG.get_or_init(|| {
        let mut rig = builtin_rig("hp3j").unwrap().unwrap();
        let mut depth = rig.depth.unwrap();
        (rig.color.width, rig.color.height) = IMAGE_SIZE;
        (depth.camera.width, depth.camera.height) = IMAGE_SIZE;
        rig.depth = Some(depth);
        rig
    })
}

/// Two postures as the robot would have recorded them: as it was written, and without chunks, so that no checksum
/// guards the messages.
pub fn recordings() -> Vec<Seed> {
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = IMAGE_SIZE;
    image::RgbImage::new(width, height).save(folder.path().join("color.png")).unwrap();
    let depth = DepthImage::new(width, height, vec![0.5; (width * height) as usize]).unwrap();
    write_depth_png(&folder.path().join("depth.png"), &depth, rig().depth.unwrap().unit_m).unwrap();
    let table = "index,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,color,depth\n0,0,0,0,0,0,0,color.png,depth.png\n1,0,0,0,0,9,0,color.png,depth.png\n";
    std::fs::write(folder.path().join("postures.csv"), table).unwrap();
    let dataset = Dataset::open_with_rig(folder.path(), rig().clone()).unwrap();
    let mut chunked = std::io::Cursor::new(Vec::new());
    write_robot_recording(&dataset, &mut chunked, &Silent).unwrap();
    let chunked = chunked.into_inner();
    let mut plain = std::io::Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().use_chunks(false).compression(None);
    let mut writer = options.create(&mut plain).unwrap();
    for message in mcap::MessageStream::new(&chunked).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    vec![Seed::new("plain.mcap", plain.into_inner()), Seed::new("chunked.mcap", chunked)]
}

/// Imports with and without regard to the arm's standing still.
pub fn import(path: &Path) -> bool {
    let folder = path.parent().unwrap();
    let mut done = 0;
    for selection in [Selection::Automatic, Selection::Moving { every: 1 }] {
        let Ok(mut recording) = Recording::open(path) else { return false };
        let mut options = ImportOptions::default();
        options.selection.selection = selection;
        let staged = StagedFolder::new(folder.join("out"), Contents::DataSet).unwrap();
        done += usize::from(import_recording(&mut recording, rig(), None, &options, &staged, &Silent).is_ok());
    }
    done == 2
}
