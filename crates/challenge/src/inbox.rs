//! Finds the entries that teams sent, and identifies them by their content.

use std::path::{Path, PathBuf};

use shearq_dataset::run::RUN_FILE;
use shearq_files::FileError;
use shearq_results::submit::{
    Entry, FileSum, Kind, MANIFEST_FILE, Manifest, is_archive, read_archive,
};

use crate::seal::{entries, sha256};

// Folders below a given folder that are searched.
const DEPTH: usize = 3;
// Endings of archives that cannot be read.
const OTHER_ARCHIVES: [&str; 7] = ["zip", "tar", "gz", "bz2", "xz", "zst", "7z"];

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Sending {
    /// Archive, or folder of files.
    pub path: PathBuf,
    /// The folder of the inbox that it was in. It is the name of the team, whatever the manifest states.
    pub team: Option<String>,
}

/// Finds archives and folders of catalogues or spectra below `paths`, in order of their names. In an inbox, the folder of
/// an archive is the name of its team.
pub fn find(paths: &[PathBuf]) -> Result<Vec<Sending>, FileError> {
    let mut found = Vec::new();
    for path in paths {
        if !path.exists() {
            let message = "there is no such file or folder; expected archives (.tar.gz) or folders of entries";
            return Err(FileError::new(path, message));
        }
        // Catalogues of `measure` have other names and contents than catalogues of an entry.
        if path.join(RUN_FILE).is_file() {
            let message = format!(
                "this folder was written by `measure` or `run`; expected an entry. Try: shearq pack --measured {0} --out {0}.tar.gz",
                path.display()
            );
            return Err(FileError::new(path, message));
        }
        search(path, None, DEPTH, &mut found)?;
    }
    found.sort();
    found.dedup();
    Ok(found)
}

fn search(
    path: &Path,
    team: Option<&str>,
    depth: usize,
    found: &mut Vec<Sending>,
) -> Result<(), FileError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    let other = OTHER_ARCHIVES.contains(&ending.as_ref());
    let mut add = || {
        found.push(Sending {
            path: path.to_owned(),
            team: team.map(str::to_owned),
        });
    };
    // A given path is searched whatever its name.
    if name.starts_with('.') && depth < DEPTH {
        return Ok(());
    }
    // Links inside an inbox are entries, which are refused later.
    let link = depth < DEPTH && path.is_symlink();
    if link || !path.is_dir() {
        if link || is_archive(path) || other {
            add();
        }
        return Ok(());
    }
    let mut inside = entries(path)?;
    inside.sort();
    let of_entry = |path: &PathBuf| {
        Kind::of(path).is_some() || path.file_name().is_some_and(|name| name == MANIFEST_FILE)
    };
    if inside.iter().any(of_entry) {
        add();
        return Ok(());
    }
    if depth > 0 {
        // The outermost folder is the inbox itself.
        let team = team.map_or_else(
            || (depth < DEPTH).then(|| name.into_owned()),
            |team| Some(team.to_owned()),
        );
        let before = found.len();
        for path in &inside {
            search(path, team.as_deref(), depth - 1, found)?;
        }
        // Files of other names would be left out silently.
        let is_file = |path: &&PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            path.is_file() && !name.starts_with('.')
        };
        let is_inbox = depth == DEPTH && inside.iter().any(|path| path.is_dir());
        if found.len() == before && !is_inbox && inside.iter().any(|path| is_file(&path)) {
            found.push(Sending {
                path: path.to_owned(),
                team,
            });
        }
    }
    Ok(())
}

/// Refuses an entry that is a symbolic link or contains one: it could name any file of the organiser's system, such as
/// the truth.
pub fn refuse_links(entry: &Path) -> Result<(), FileError> {
    let mut paths = vec![entry.to_owned()];
    if entry.is_dir() {
        paths.extend(entries(entry)?);
    }
    match paths.into_iter().find(|path| path.is_symlink()) {
        Some(link) => Err(FileError::new(
            link,
            "this is a link; expected a file or a folder",
        )),
        None => Ok(()),
    }
}

pub fn identify(path: &Path) -> Result<String, FileError> {
    refuse_links(path)?;
    Ok(match path.is_dir() {
        true => sha256(&list_of(&sums(path)?)),
        false => FileSum::of(path)?.sha256,
    })
}

fn sums(folder: &Path) -> Result<Vec<(String, FileSum)>, FileError> {
    let mut paths = entries(folder)?;
    paths.retain(|path| path.is_file());
    paths.sort();
    paths
        .into_iter()
        .map(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            Ok((name.into_owned(), FileSum::of(&path)?))
        })
        .collect()
}

fn list_of(sums: &[(String, FileSum)]) -> Vec<u8> {
    let lines = sums
        .iter()
        .map(|(name, sum)| format!("{name} {}\n", sum.sha256));
    lines.collect::<String>().into_bytes()
}

#[derive(Debug, Clone)]
pub struct Content {
    /// SHA-256 of sets, images and checksums of all files but the manifest. It depends neither on the name of the method nor on the
    /// compression.
    pub sha256: String,
    /// Team and challenge, if a manifest states them.
    pub entry: Option<Entry>,
}

/// Reads the manifest of an entry, and the checksum of its content.
pub fn content(sending: &Sending) -> Result<Content, FileError> {
    let path = &sending.path;
    let (manifest, files) = match path.is_dir() {
        true => (Manifest::read(path)?, sums(path)?),
        false if is_archive(path) => {
            let unpacked = read_archive(path, None)?;
            unpacked.verify(path, false)?;
            (unpacked.manifest, unpacked.files.into_iter().collect())
        }
        false => {
            let message = "unsupported archive (found another format, expected .tar.gz or .tgz)";
            return Err(FileError::new(path, message));
        }
    };
    let mut sums: Vec<(String, FileSum)> = files
        .into_iter()
        .filter_map(|(name, sum)| {
            // The manifest names team and method.
            (name != MANIFEST_FILE).then_some(())?;
            let name = match Kind::of(Path::new(&name)) {
                Some(Kind::Catalogue { set, image, .. }) => format!("{set} {image}"),
                Some(Kind::Spectrum { set, .. }) => format!("{set}"),
                // Checks see these files, so an entry with them is another entry.
                None => format!("other {name}"),
            };
            Some((name, sum))
        })
        .collect();
    sums.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(Content {
        sha256: sha256(&list_of(&sums)),
        entry: manifest.and_then(|manifest| manifest.entry),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_content_covers_all_files_but_the_manifest() {
        let root = tempfile::tempdir().unwrap();
        let of = |folder: &str, files: &[&str]| {
            let path = root.path().join(folder);
            std::fs::create_dir(&path).unwrap();
            for file in files {
                std::fs::write(path.join(file), "1 1 0 0\n").unwrap();
            }
            content(&Sending { path, team: None }).unwrap()
        };
        let plain = of("a", &["g10_v1_objs_1_1.M.dat"]);
        let renamed = of("b", &["g10_v1_objs_1_1.N.dat"]);
        let more = of("c", &["g10_v1_objs_1_1.M.dat", "LICENSE"]);
        assert_eq!(plain.sha256, renamed.sha256);
        assert_ne!(plain.sha256, more.sha256);
    }

    #[test]
    fn entries_are_found_with_the_teams_of_their_folders() {
        let root = tempfile::tempdir().unwrap();
        for file in [
            "a.tar.gz",
            "b.zip",
            "notes.txt",
            ".hidden.tar.gz",
            "A team/one.tgz",
            "A team/later/two.tar.gz",
            "B/sent/g10_v1_objs_1_1.M.dat",
            "B/sent/README",
            "C/set1_image1.dat",
        ] {
            let path = root.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "").unwrap();
        }
        let found: Vec<(String, Option<String>)> = find(&[root.path().to_owned()])
            .unwrap()
            .into_iter()
            .map(|sending| {
                let path = sending.path.strip_prefix(root.path()).unwrap();
                (path.display().to_string(), sending.team)
            })
            .collect();
        let expected = [
            ("A team/later/two.tar.gz", Some("A team")),
            ("A team/one.tgz", Some("A team")),
            ("B/sent", Some("B")),
            ("C", Some("C")),
            ("a.tar.gz", None),
            ("b.zip", None),
        ]
        .map(|(path, team)| (path.to_owned(), team.map(str::to_owned)));
        assert_eq!(found, expected);
        assert!(find(&[root.path().join("absent")]).is_err());
    }
}
