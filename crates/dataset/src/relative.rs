//! Relative paths between folders.

use std::io::Result;
use std::path::{Component, Path, PathBuf};

/// `path` relative to `folder` if possible, otherwise absolute. Both may be relative to the current folder, and need not
/// exist.
///
/// # Errors
/// If the current folder cannot be determined.
pub(crate) fn from(folder: &Path, path: &Path) -> Result<PathBuf> {
    let (folder, path) = (resolve(folder)?, resolve(path)?);
    let shared = folder
        .components()
        .zip(path.components())
        .take_while(|(a, b)| a == b)
        .count();
    if shared == 0 {
        return Ok(path);
    }
    let up = folder
        .components()
        .skip(shared)
        .map(|_| Component::ParentDir);
    let relative: PathBuf = up.chain(path.components().skip(shared)).collect();
    Ok(match relative.as_os_str().is_empty() {
        true => ".".into(),
        false => relative,
    })
}

/// `path` without the `folder/..` in it, if that is the same folder: a short name for messages.
pub fn shortened(path: PathBuf) -> PathBuf {
    let mut short = PathBuf::new();
    for part in path.components() {
        match (part, short.components().next_back()) {
            (Component::ParentDir, Some(Component::Normal(_))) => {
                short.pop();
            }
            (part, _) => short.push(part),
        }
    }
    if short.as_os_str().is_empty() {
        short.push(".");
    }
    // Behind a link, `..` leads elsewhere.
    match (resolve(&short), resolve(&path)) {
        (Ok(one), Ok(other)) if one == other => short,
        _ => path,
    }
}

/// An absolute path without links, as far as it exists, and without `.` and `..`.
fn resolve(path: &Path) -> Result<PathBuf> {
    let path = std::path::absolute(path)?;
    for there in path.ancestors() {
        let (Ok(mut resolved), Ok(rest)) = (there.canonicalize(), path.strip_prefix(there)) else {
            continue;
        };
        for part in rest.components() {
            match part {
                Component::ParentDir => {
                    resolved.pop();
                }
                part => resolved.push(part),
            }
        }
        return Ok(resolved);
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_shortened_unless_a_link_leads_elsewhere() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        std::fs::create_dir_all(at("out/deep")).unwrap();
        std::fs::create_dir_all(at("data")).unwrap();
        assert_eq!(shortened(at("out/deep/../../data")), at("data"));
        assert_eq!(shortened("src/..".into()), Path::new("."));
        assert_eq!(shortened("../..".into()), Path::new("../.."));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("out/deep"), at("link")).unwrap();
            std::fs::create_dir_all(at("out/data")).unwrap();
            assert_eq!(shortened(at("link/../data")), at("link/../data"));
        }
    }

    #[test]
    fn a_path_is_the_same_however_it_was_given() {
        let root = tempfile::tempdir().unwrap();
        let at = |name: &str| root.path().join(name);
        std::fs::create_dir_all(at("data/deep")).unwrap();
        let relative = |folder: &str, path: &str| from(&at(folder), &at(path)).unwrap();
        for same in ["data", "data/", "./data", "data/deep/..", "new/../data"] {
            assert_eq!(relative("out", same), Path::new("../data"), "{same}");
            assert_eq!(
                relative("new/out/", same),
                Path::new("../../data"),
                "{same}"
            );
        }
        assert_eq!(relative("data", "data"), Path::new("."));
        assert_eq!(relative("data", "data/deep"), Path::new("deep"));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(at("data"), at("link")).unwrap();
            assert_eq!(relative("out", "link"), Path::new("../data"));
        }
    }
}
