//! What a destination can be, and what becomes of what lies in it.

use skclam_files::{Contents, MANIFEST, StagedFile, StagedFolder, verify};
use std::fs;
use std::path::{Path, PathBuf};

fn publish(folder: &Path, word: &str) -> Result<PathBuf, String> {
    let staged = StagedFolder::new(folder, Contents::Result).map_err(|error| error.to_string())?;
    for name in ["a.txt", "sub/b.txt", &format!("{word}.txt")] {
        staged.write(name, word).map_err(|error| error.to_string())?;
    }
    staged.publish().map_err(|error| error.to_string())
}

/// All entries below a folder, sorted.
fn listing(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        let name = entry.file_name().into_string().unwrap();
        if entry.file_type().unwrap().is_dir() {
            found.extend(listing(&entry.path()).into_iter().map(|below| format!("{name}/{below}")));
        } else {
            found.push(name);
        }
    }
    found.sort();
    found
}

fn text(path: PathBuf) -> String {
    fs::read_to_string(path).unwrap()
}

#[test]
fn a_new_result_appears_whole_and_an_abandoned_one_leaves_no_trace() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("deep/out");
    let staged = StagedFolder::new(&out, Contents::Result).unwrap();
    staged.write("a.txt", "a").unwrap();
    assert!(!out.exists());
    drop(staged);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0, "the folder above went too");
    publish(&out, "one").unwrap();
    assert_eq!(
        listing(place.path()),
        ["a.txt", MANIFEST, "one.txt", "sub/b.txt"].map(|name| format!("deep/out/{name}"))
    );
    assert_eq!(verify(&out).unwrap().unwrap().files.len(), 3);
}

#[test]
fn an_earlier_result_is_kept_once_and_nothing_of_it_stays_beside_the_new_one() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    fs::create_dir(&out).unwrap();
    for word in ["one", "two", "three"] {
        publish(&out, word).unwrap();
        fs::write(out.join("notes.txt"), "mine").unwrap();
    }
    assert_eq!(listing(&out), ["a.txt", MANIFEST, "notes.txt", "sub/b.txt", "three.txt"]);
    assert_eq!(listing(&place.path().join("out.previous")), ["a.txt", MANIFEST, "sub/b.txt", "two.txt"]);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 2);
    assert_eq!(text(out.join("sub/b.txt")), "three");
}

#[test]
fn a_folder_with_folders_of_the_user_stays_the_same_folder() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    fs::create_dir_all(out.join("mine")).unwrap();
    fs::write(out.join("mine/notes.txt"), "mine").unwrap();
    let folder = fs::File::open(&out).unwrap();
    for word in ["one", "two"] {
        publish(&out, word).unwrap();
    }
    assert_eq!(listing(&out), ["a.txt", MANIFEST, "mine/notes.txt", "sub/b.txt", "two.txt"]);
    assert_eq!(listing(&place.path().join("out.previous")), ["a.txt", MANIFEST, "one.txt", "sub/b.txt"]);
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 2, "{:?}", listing(place.path()));
    drop(folder);
}

#[test]
fn what_is_not_of_an_earlier_command_is_never_replaced() {
    let place = tempfile::tempdir().unwrap();
    let refused = |path: &Path| StagedFolder::new(path, Contents::Result).map(drop).unwrap_err().to_string();
    let path = |name: &str| place.path().join(name);
    // Files without a manifest under names that a run would take, or a folder there.
    fs::create_dir_all(path("half/summary.json")).unwrap();
    assert!(refused(&path("half")).contains("summary.json in it is not known"), "{}", refused(&path("half")));
    fs::create_dir(path("cell")).unwrap();
    fs::write(path("cell/postures.csv"), "").unwrap();
    fs::write(path("cell/rig.toml"), "").unwrap();
    assert!(refused(&path("cell")).contains("holds a data set"));
    // A name that nobody foresaw: reported in the end, and the results are kept.
    fs::create_dir(path("late")).unwrap();
    fs::write(path("late/a.txt"), "mine").unwrap();
    let message = publish(&path("late"), "one").unwrap_err();
    assert!(message.contains("a.txt is there") && message.contains("late.unpublished"), "{message}");
    assert_eq!((text(path("late/a.txt")), text(path("late.unpublished/a.txt"))), ("mine".into(), "one".into()));
    assert_eq!(listing(&path("late")), ["a.txt"]);
    // Results of another kind.
    publish(&path("out"), "one").unwrap();
    let message = StagedFolder::new(path("out"), Contents::Map).map(drop).unwrap_err().to_string();
    assert!(message.contains("holds the result of a calibration, which a map would replace"), "{message}");
    // A place where the earlier result cannot be kept.
    fs::create_dir(path("out.previous")).unwrap();
    assert!(refused(&path("out")).contains("is where the earlier result is kept, and holds no result"));
    fs::write(path("file"), "").unwrap();
    assert!(refused(&path("file")).contains("is a file; name a folder"));
    assert!(refused(&path("file/below")).contains("file"));
}

#[cfg(unix)]
#[test]
fn links_and_special_files_stay_what_they_are() {
    use std::os::unix::fs::symlink;
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    symlink("nowhere", path("dangling")).unwrap();
    for error in [
        StagedFolder::new(path("dangling"), Contents::Result).map(drop).unwrap_err(),
        StagedFile::new(path("dangling")).map(drop).unwrap_err(),
        StagedFile::new("/dev/null").map(drop).unwrap_err(),
    ] {
        assert!(
            error.to_string().contains("is a link to what") || error.to_string().contains("is a device"),
            "{error}"
        );
    }
    // A link to a folder is the folder.
    fs::create_dir(path("real")).unwrap();
    symlink("real", path("link")).unwrap();
    for word in ["one", "two"] {
        publish(&path("link"), word).unwrap();
    }
    assert!(path("link").symlink_metadata().unwrap().is_symlink());
    assert_eq!((text(path("real/a.txt")), text(path("real.previous/a.txt"))), ("two".into(), "one".into()));
    // A file of the result that became a link since.
    fs::remove_file(path("real/a.txt")).unwrap();
    symlink("sub/b.txt", path("real/a.txt")).unwrap();
    assert!(publish(&path("real"), "three").unwrap_err().contains("a.txt in it is a link now"));
    // A file behind a link is written, and the link stays.
    fs::write(path("target"), "old").unwrap();
    symlink("target", path("page")).unwrap();
    let staged = StagedFile::new(path("page")).unwrap();
    staged.write("new").unwrap();
    staged.publish().unwrap();
    assert!(path("page").symlink_metadata().unwrap().is_symlink());
    assert_eq!(text(path("target")), "new");
}

#[test]
fn a_file_of_a_result_is_not_replaced_by_a_single_file() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let mut staged = StagedFolder::new(&out, Contents::Result).unwrap();
    staged.write("summary.json", "{}").unwrap();
    staged.write_derived("report.html", "page").unwrap();
    staged.publish().unwrap();
    for part in ["summary.json", MANIFEST] {
        let message = StagedFile::new(out.join(part)).map(drop).unwrap_err().to_string();
        assert!(message.contains("belongs to the result"), "{message}");
    }
    let staged = StagedFile::new(out.join("report.html")).unwrap();
    staged.write("another page").unwrap();
    staged.publish().unwrap();
    verify(&out).unwrap();
    assert_eq!(listing(&out), [MANIFEST, "report.html", "summary.json"]);
}

#[test]
fn no_name_leads_out_of_the_results() {
    let place = tempfile::tempdir().unwrap();
    let staged = StagedFolder::new(place.path().join("out"), Contents::Result).unwrap();
    for name in ["../victim.txt", "/tmp/victim.txt", "a/../../victim.txt"] {
        assert!(staged.write(name, "attack").unwrap_err().to_string().contains("leads out"), "{name}");
    }
}

#[cfg(unix)]
#[test]
fn a_journal_from_a_stranger_moves_nothing_outside() {
    use std::os::unix::fs::symlink;
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| place.path().join(name);
    fs::create_dir_all(path("home")).unwrap();
    fs::write(path("home/secret"), "secret").unwrap();
    fs::create_dir_all(path("out/.out.partial-1-0")).unwrap();
    symlink("../home", path("out/link")).unwrap();
    for (old, new) in [("link/secret", "a"), ("../home/secret", "a"), ("a", "link/a"), ("a", "../a")] {
        let journal =
            serde_json::json!({ "staging": ".out.partial-1-0", "is_inside": true, "old": [old], "new": [new] });
        fs::write(path("out/.skclam-journal"), journal.to_string()).unwrap();
        assert!(
            verify(&path("out")).unwrap_err().to_string().contains("names what is not of the folder"),
            "{old} {new}"
        );
        assert_eq!(text(path("home/secret")), "secret");
    }
    let marker = serde_json::json!({ "earlier": "../home" });
    fs::remove_file(path("out/.skclam-journal")).unwrap();
    fs::write(path("out/.skclam-staging"), marker.to_string()).unwrap();
    verify(&path("out")).unwrap();
    assert_eq!(text(path("home/secret")), "secret");
}
