//! Finds the entries that teams sent, and identifies them by their content.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use shearq_dataset::run::RUN_FILE;
use shearq_files::FileError;
use shearq_files::atomic::list;
use shearq_results::submit::archive::{ArchiveFormat, is_archive, is_of_system, read_archive};
use shearq_results::submit::{FileSum, Kind, MANIFEST_FILE, Manifest};

use crate::scenes;
use crate::seal::{Receipt, sha256};
use crate::terms::Data;

// Folders below a given folder that are searched. Links are not followed, so that only a mistake is deeper. Chosen by hand.
const MAX_DEPTH: usize = 16;
// Folders below a given folder whose entries need no remark: that of the team, and that of an entry.
const USUAL_DEPTH: usize = 2;
// Endings of archives that cannot be read.
const OTHER_ARCHIVES: [&str; 9] = ["tar", "gz", "bz2", "xz", "zst", "7z", "rar", "tbz2", "txz"];

#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Sending {
    /// Archive, or folder of files.
    pub path: PathBuf,
    /// The folder of the inbox that it was in. It is the name of the team, whatever the manifest states.
    pub team: Option<String>,
}

/// What an inbox contains.
#[derive(Debug, Default)]
pub struct Found {
    /// In order of their names.
    pub sendings: Vec<Sending>,
    /// Files that are no entries, and entries of unusual names or places.
    pub remarks: Vec<(PathBuf, String)>,
}

/// Finds archives and folders of catalogues or spectra below `paths`, or of catalogues of scenes (`of_scenes`), which may be in
/// folders. In an inbox, the folder of an archive is the name of its team.
pub fn find(paths: &[PathBuf], of_scenes: bool) -> Result<Found, FileError> {
    let mut found = Found::default();
    for path in paths {
        if !path.exists() {
            let message = "there is no such file or folder; expected archives (.tar.gz, .zip) or folders of entries";
            return Err(FileError::new(path, message));
        }
        match path.is_dir() {
            true => found.search(path, of_scenes, None, 0)?,
            false => found.add(path, None, 0),
        }
    }
    found.sendings.sort();
    found.sendings.dedup();
    Ok(found)
}

impl Found {
    fn add(&mut self, path: &Path, team: Option<&str>, depth: usize) {
        if let (true, Some(team)) = (depth > USUAL_DEPTH, team) {
            let remark =
                format!("taken as an entry of {team}, the first folder of the inbox on its way");
            self.remarks.push((path.to_owned(), remark));
        }
        if path.is_file() && !is_archive(path) && has_archive(path) {
            let remark = "the name does not end in .tar.gz, .tgz or .zip; read as the archive that its content is";
            self.remarks.push((path.to_owned(), remark.into()));
        }
        self.sendings.push(Sending {
            path: path.to_owned(),
            team: team.map(str::to_owned),
        });
    }

    fn remark(&mut self, path: PathBuf, remark: &str) {
        self.remarks.push((path, remark.into()));
    }

    // A folder is an entry if it contains files and no entries.
    fn search(
        &mut self,
        folder: &Path,
        of_scenes: bool,
        team: Option<&str>,
        depth: usize,
    ) -> Result<(), FileError> {
        if depth > MAX_DEPTH {
            self.remark(
                folder.to_owned(),
                "too many folders in folders; not searched",
            );
            return Ok(());
        }
        let mut inside = list(folder)?;
        inside.sort();
        if of_scenes && scenes::is_entry(&inside, depth == 0) {
            self.add(folder, team, depth);
            return Ok(());
        }
        let (mut folders, mut archives, mut loose) = (Vec::new(), Vec::new(), Vec::new());
        for path in inside {
            if is_hidden(&path) {
                self.remark(
                    path,
                    "hidden, or a file of the operating system, and no entry",
                );
            } else if Kind::of(&path).is_some() && !path.is_dir() {
                loose.push(path);
            } else if path.is_symlink() || (!path.is_dir() && looks_like_archive(&path)) {
                archives.push(path);
            } else if path.is_dir() {
                folders.push(path);
            } else {
                match Receipt::entry_of(&path) {
                    None => loose.push(path),
                    Some(entry) if entry.exists() => {}
                    Some(_) => self.remark(path, "a receipt without its entry"),
                }
            }
        }
        // `content` refuses a folder of `measure` as a whole.
        let is_of_entry = |path: &PathBuf| Kind::of(path).is_some() || path.ends_with(RUN_FILE);
        let is_entry = archives.is_empty()
            && loose.iter().any(is_of_entry)
            && !folders.iter().any(|path| contains_entries(path, depth + 1));
        if is_entry {
            self.add(folder, team, depth);
            for path in folders {
                self.remark(path, "a folder inside an entry, which is not read");
            }
            return Ok(());
        }
        let before = self.sendings.len();
        for path in &archives {
            self.add(path, team, depth);
        }
        for path in &folders {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            // The outermost folder is the inbox itself.
            let team = Some(team.unwrap_or(&name));
            self.search(path, of_scenes, team, depth + 1)?;
        }
        if self.sendings.len() == before && !loose.is_empty() {
            self.add(folder, team, depth);
            return Ok(());
        }
        for path in loose {
            self.remark(
                path,
                "no entry; expected an archive (.tar.gz, .zip), or a folder of catalogues alone",
            );
        }
        Ok(())
    }
}

fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with('.') || is_of_system(&name)
}

fn has_archive(path: &Path) -> bool {
    ArchiveFormat::of_content(path).is_ok_and(|format| format.is_some())
}

fn looks_like_archive(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    let other = OTHER_ARCHIVES.iter().any(|other| ending == **other);
    other || is_archive(path) || has_archive(path)
}

fn contains_entries(folder: &Path, depth: usize) -> bool {
    let inside = list(folder).unwrap_or_default();
    inside.iter().any(|path| match path.is_dir() {
        _ if is_hidden(path) || depth > MAX_DEPTH => false,
        _ if path.is_symlink() => true,
        true => contains_entries(path, depth + 1),
        false => Kind::of(path).is_some() || looks_like_archive(path),
    })
}

/// Refuses an entry that is a symbolic link or contains one: it could name any file of the organiser's system, such as
/// the truth.
pub fn refuse_links(entry: &Path, data: &Data) -> Result<(), FileError> {
    let mut paths = VecDeque::from([entry.to_owned()]);
    while let Some(path) = paths.pop_front() {
        if path.is_symlink() {
            let message = "this is a link; expected a file or a folder";
            return Err(FileError::new(path, message));
        }
        if path.is_dir() && (path == entry || data.scene.is_some()) {
            paths.extend(list(&path)?);
        }
    }
    Ok(())
}

/// The SHA-256 of an archive, or of the list of a folder's files, which have the bytes of the largest entry together at most: a
/// file of holes has any size and costs its sender nothing.
pub fn identify(path: &Path, data: &Data) -> Result<String, FileError> {
    refuse_links(path, data)?;
    let most = data.largest_entry();
    let files = match path.is_dir() {
        true => files_of(path, data)?,
        false => vec![path.to_owned()],
    };
    let size = |file: &PathBuf| file.metadata().map_or(0, |about| about.len());
    let bytes = files.iter().map(size).fold(0, u64::saturating_add);
    if bytes > most {
        let message = format!(
            "too large (found {bytes} bytes, expected at most {most}, the size of the largest entry)"
        );
        return Err(FileError::new(path, message));
    }
    Ok(match path.is_dir() {
        true => sha256(&list_of(&FileSum::of_files(path, &files)?)),
        false => FileSum::of(path)?.sha256,
    })
}

/// When the newest file of an entry was changed.
pub fn modified(path: &Path, data: &Data) -> Result<SystemTime, FileError> {
    let mut files = match path.is_dir() {
        true => files_of(path, data)?,
        false => Vec::new(),
    };
    if files.is_empty() {
        files.push(path.to_owned());
    }
    let times = files.iter().map(|file| file.metadata()?.modified());
    let newest = times.collect::<std::io::Result<Vec<_>>>();
    let newest = newest.map(|times| times.into_iter().max());
    newest
        .map(|newest| newest.unwrap_or(SystemTime::UNIX_EPOCH))
        .map_err(FileError::doing(path, "cannot read the time of the file"))
}

// The files of an entry that is a folder, in order of their names.
fn files_of(folder: &Path, data: &Data) -> Result<Vec<PathBuf>, FileError> {
    if data.scene.is_some() {
        return scenes::files(folder);
    }
    let mut paths = list(folder)?;
    paths.retain(|path| path.is_file() && !is_hidden(path));
    paths.sort();
    Ok(paths)
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
    pub manifest: Option<Manifest>,
}

/// Reads the manifest of an entry that unpacks to the size of the largest entry at most, and the checksum of its content.
pub fn content(sending: &Sending, data: &Data) -> Result<Content, FileError> {
    let path = &sending.path;

    let (manifest, files) = match path.is_dir() {
        // Catalogues of `measure` have other names and contents than catalogues of an entry.
        true if data.scene.is_none() && path.join(RUN_FILE).is_file() => {
            let message = "this folder was written by `measure` or `run`; expected an entry";
            return Err(FileError::new(path, message).hint(format!(
                "shearq pack --measured {0} --out {0}.tar.gz",
                path.display()
            )));
        }
        true => (
            Manifest::read(path)?,
            FileSum::of_files(path, &files_of(path, data)?)?,
        ),
        false if has_archive(path) => {
            let unpacked = read_archive(path, None, Some(data.largest_entry()))?;
            unpacked.verify(path, false)?;
            (unpacked.manifest, unpacked.files.into_iter().collect())
        }
        false => {
            let message = "not an archive that can be read (expected .tar.gz or .zip)";
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
                // Of scenes, the record of a run names files of the sender's disk. Archives have no folders.
                None if data.scene.is_some() && name == RUN_FILE => return None,
                None if data.scene.is_some() => name.rsplit('/').next()?.to_owned(),
                // Checks see these files, so an entry with them is another entry.
                None => format!("other {name}"),
            };
            Some((name, sum))
        })
        .collect();
    sums.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(Content {
        sha256: sha256(&list_of(&sums)),
        manifest,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    // A challenge of one image of 8² galaxies.
    const DATA: Data = Data {
        sets: Vec::new(),
        images: 1,
        grid: 8,
        stamp: 48,
        field_degrees: 10.0,
        scene: None,
    };

    #[test]
    fn the_content_covers_all_files_but_the_manifest() {
        let root = tempfile::tempdir().unwrap();
        let of = |folder: &str, files: &[&str]| {
            let path = root.path().join(folder);
            std::fs::create_dir(&path).unwrap();
            for file in files {
                std::fs::write(path.join(file), "1 1 0 0\n").unwrap();
            }
            content(&Sending { path, team: None }, &DATA)
                .unwrap()
                .sha256
        };
        let plain = of("a", &["g10_v1_objs_1_1.M.dat"]);
        assert_eq!(plain, of("b", &["g10_v1_objs_1_1.N.dat", ".DS_Store"]));
        assert_ne!(plain, of("c", &["g10_v1_objs_1_1.M.dat", "LICENSE"]));
    }

    // Makes files, and gives paths and teams of the entries, and the paths that have remarks.
    fn found(files: &[&str]) -> (Vec<(String, Option<String>)>, Vec<String>) {
        let root = tempfile::tempdir().unwrap();
        for file in files {
            let path = root.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            let content: &[u8] = if file.contains("gzip") {
                &[0x1f, 0x8b]
            } else {
                &[]
            };
            std::fs::write(path, content).unwrap();
        }
        let name = |path: &Path| {
            let path = path.strip_prefix(root.path()).unwrap();
            path.display().to_string()
        };
        let Found { sendings, remarks } = find(&[root.path().to_owned()], false).unwrap();
        let entries = sendings
            .iter()
            .map(|own| (name(&own.path), own.team.clone()));
        let mut remarks: Vec<String> = remarks.iter().map(|(path, _)| name(path)).collect();
        remarks.sort();
        (entries.collect(), remarks)
    }

    #[test]
    fn entries_are_found_with_the_teams_of_their_folders() {
        let (entries, remarks) = found(&[
            "a.tar.gz",
            "b.ZIP",
            "c.rar",
            "gzip of mine",
            "notes.txt",
            ".hidden.tar.gz",
            "A team/one.tgz",
            "A team/later/two.tar.gz",
            "A team/1/2/3/deep.tar.gz",
            "A team/plan.tar.gz.receipt.toml",
            "B/sent/g10_v1_objs_1_1.M.dat",
            "B/sent/README",
            "B/sent/plots/a.png",
            "C/set1_image1.dat",
        ]);
        let a = Some("A team".to_owned());
        let expected = [
            ("A team/1/2/3/deep.tar.gz", a.clone()),
            ("A team/later/two.tar.gz", a.clone()),
            ("A team/one.tgz", a),
            ("B/sent", Some("B".to_owned())),
            ("C", Some("C".to_owned())),
            ("a.tar.gz", None),
            ("b.ZIP", None),
            ("c.rar", None),
            ("gzip of mine", None),
        ];
        assert_eq!(
            entries,
            expected.map(|(path, team)| (path.to_owned(), team))
        );
        let expected = [
            ".hidden.tar.gz",
            "A team/1/2/3/deep.tar.gz",
            "A team/plan.tar.gz.receipt.toml",
            "B/sent/plots",
            "gzip of mine",
            "notes.txt",
        ];
        assert_eq!(remarks, expected);
        assert!(find(&[PathBuf::from("absent")], false).is_err());
    }

    #[test]
    fn stray_files_do_not_make_an_inbox_an_entry() {
        for stray in [
            "manifest.json",
            "x_set2.dat",
            "g10_v1_objs_2_1.X.dat",
            "run.json",
        ] {
            for entry in ["a.tar.gz", "A/b.tgz", "A/g10_v1_objs_2_1.M.dat"] {
                let (entries, remarks) = found(&[stray, entry]);
                assert_eq!(entries.len(), 1, "{stray} {entry}: {entries:?}");
                assert_eq!(remarks, [stray], "{entry}");
            }
        }
    }

    #[test]
    fn files_of_holes_are_refused_before_they_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.tar.gz");
        let file = std::fs::File::create(&path).unwrap();
        file.set_len(1 << 40).unwrap();
        for entry in [path.as_path(), folder.path()] {
            let error = identify(entry, &DATA).unwrap_err();
            assert!(error.text().contains("too large"), "{error}");
        }
    }
}
