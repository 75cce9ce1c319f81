//! Whether a name that came from a file may be followed.
//!
//! A rig, a table or a robot description can come from anybody. What it names has to lie in its folder: no `..`, no
//! absolute path, no link that leads out of it. What the user names is not asked about.

use std::io;
use std::path::{Component, Path, PathBuf};

/// Whether a name stays in its folder by its letters alone: the test for names that are written.
pub fn is_inside(name: &Path) -> bool {
    let mut named = false;
    for component in name.components() {
        match component {
            Component::Normal(_) => named = true,
            Component::CurDir => {}
            Component::ParentDir | Component::RootDir | Component::Prefix(_) => return false,
        }
    }
    named
}

/// The path of an existing file or folder that a file in `folder` names.
///
/// # Errors `PermissionDenied` with a reason where the name leaves the folder, by its letters or by a link; otherwise
/// the system's, such as `NotFound`.
pub fn inside(folder: impl AsRef<Path>, name: impl AsRef<Path>) -> io::Result<PathBuf> {
    let name = name.as_ref();
    let refused = |why: &str| {
        let text = name.to_string_lossy();
        let problem = format!("\"{}\" {why}", crate::shortened(&crate::shown(&text), 200));
        io::Error::new(io::ErrorKind::PermissionDenied, problem)
    };
    if !is_inside(name) {
        return Err(refused("leaves the folder of the file that names it; name a file within that folder"));
    }
    // "" is what the parent of a plain file name is.
    let folder = match folder.as_ref() {
        empty if empty.as_os_str().is_empty() => Path::new("."),
        folder => folder,
    };
    let path = folder.join(name);
    if !path.canonicalize()?.starts_with(folder.canonicalize()?) {
        return Err(refused("is a link that leads out of the folder; put the file itself there"));
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_leave_are_distinguished_from_those_that_stay() {
        for stays in ["a", "./a", "a/b.png", "...", "a..b/c", "a//b"] {
            assert!(is_inside(Path::new(stays)), "{stays}");
        }
        for leaves in ["", ".", "..", "../a", "a/../../b", "/etc/passwd", "a/.."] {
            assert!(!is_inside(Path::new(leaves)), "{leaves}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_within_the_folder_and_not_out_of_it() {
        use std::os::unix::fs::symlink;
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("folder");
        std::fs::create_dir_all(folder.join("sub")).unwrap();
        std::fs::write(place.path().join("secret"), "secret").unwrap();
        std::fs::write(folder.join("sub/file"), "file").unwrap();
        symlink("sub/file", folder.join("near")).unwrap();
        symlink("../secret", folder.join("far")).unwrap();
        symlink("..", folder.join("up")).unwrap();
        for stays in ["near", "sub/file"] {
            assert!(inside(&folder, stays).is_ok(), "{stays}");
        }
        for leaves in ["far", "up/secret", "up", "sub/../../secret"] {
            assert_eq!(inside(&folder, leaves).unwrap_err().kind(), io::ErrorKind::PermissionDenied, "{leaves}");
        }
        assert_eq!(inside(&folder, "gone").unwrap_err().kind(), io::ErrorKind::NotFound);
        // The user may have named the folder by a link.
        symlink(&folder, place.path().join("named")).unwrap();
        assert!(inside(place.path().join("named"), "near").is_ok());
    }
}
