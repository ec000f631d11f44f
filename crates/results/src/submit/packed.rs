//! Reads submissions: the files of a folder or an archive, recognised by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::archive::{self, Unpacked, is_archive};
use super::challenge::Kind;
use super::manifest::{FileSum, MANIFEST_FILE, Manifest};
use crate::foreign::{Screen, plain_columns};
use crate::score::{COLUMNS, own_catalogue};
use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::open::is_there;
use shearq_scoring::{FieldSum, Grid, RowCounts};

/// A given folder or file, or the temporary folder of an unpacked archive.
#[derive(Debug)]
pub struct Sent {
    path: PathBuf,
    given: PathBuf,
    _unpacked: Option<Scratch>,
}

impl Sent {
    /// Opens a submission, and unpacks it if it has the ending of an archive.
    ///
    /// # Errors
    /// If it cannot be unpacked.
    pub fn open(given: &Path) -> Result<Self, FileError> {
        let given = given.to_owned();
        if !is_archive(&given) {
            return Ok(Sent {
                path: given.clone(),
                given,
                _unpacked: None,
            });
        }
        let folder = Scratch::new()?;
        archive::read(&given, Some(folder.path()))?;
        Ok(Sent {
            path: folder.path().to_owned(),
            given,
            _unpacked: Some(folder),
        })
    }

    /// The folder or file with the content.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The name of a file for messages: a member of the archive, not of the temporary folder.
    pub fn as_given(&self, path: &Path) -> PathBuf {
        match path.strip_prefix(&self.path) {
            Ok(name) if name.as_os_str().is_empty() => self.given.clone(),
            Ok(name) => self.given.join(name),
            Err(_) => path.to_owned(),
        }
    }

    /// The error with the name [`Sent::as_given`].
    pub fn named(&self, error: FileError) -> FileError {
        FileError::new(self.as_given(&error.path), error.message)
    }

    /// The files without the manifest and hidden files, or the given file.
    ///
    /// # Errors
    /// If the folder cannot be listed, or the file does not exist.
    pub fn files(&self) -> std::io::Result<Vec<PathBuf>> {
        if !self.path.is_dir() {
            std::fs::metadata(&self.path)?;
            return Ok(vec![self.path.clone()]);
        }
        let mut files = Vec::new();
        for entry in std::fs::read_dir(&self.path)? {
            let file = entry?.path();
            let own = file.file_name().is_some_and(|name| {
                name == MANIFEST_FILE || name.to_string_lossy().starts_with('.')
            });
            if !file.is_dir() && !own {
                files.push(file);
            }
        }
        files.sort();
        Ok(files)
    }
}

/// Content of a submission.
#[derive(Debug, Clone)]
pub enum Packed {
    /// Catalogues by set and image.
    Catalogues(BTreeMap<u32, BTreeMap<u32, PathBuf>>),
    /// A power spectrum per set.
    Spectra(BTreeMap<u32, PathBuf>),
}

/// A submission of one method.
#[derive(Debug, Clone)]
pub struct Submission {
    /// Name of the method.
    pub method: String,
    /// Files of the submission.
    pub packed: Packed,
    /// Manifest, if there is one.
    pub manifest: Option<Manifest>,
}

impl Submission {
    /// Reads the files of `sent`.
    ///
    /// # Errors
    /// If files disagree with the manifest, or have several kinds or methods.
    pub fn read(sent: &Sent) -> Result<Self, FileError> {
        let whole = |message: String| FileError::new(&sent.given, message);
        if !sent.path.is_dir() {
            return Err(whole(
                "there is no such folder; expected a folder or an archive (.tar.gz)".into(),
            ));
        }
        let files = sent
            .files()
            .map_err(FileError::doing(&sent.given, "cannot list the folder"))?;
        let manifest = verified(sent, &files)?;
        let mut catalogues = BTreeMap::<u32, BTreeMap<u32, PathBuf>>::new();
        let mut spectra = BTreeMap::new();
        let mut methods = Vec::new();
        for file in files {
            let kind = Kind::of(&file).ok_or_else(|| {
                FileError::new(
                    sent.as_given(&file),
                    format!("the name is {}", Kind::EXPECTED),
                )
            })?;
            match kind {
                Kind::Catalogue { set, image, method } => {
                    catalogues.entry(set).or_default().insert(image, file);
                    methods.push(method);
                }
                Kind::Spectrum { set, method } => {
                    spectra.insert(set, file);
                    methods.push(method);
                }
            }
        }
        methods.sort();
        methods.dedup();
        let [method] = methods.as_slice() else {
            return Err(whole(match methods.len() {
                0 => "the submission contains no files".into(),
                _ => format!(
                    "the files belong to several methods: {}",
                    methods.join(", ")
                ),
            }));
        };
        let packed = match (catalogues.is_empty(), spectra.is_empty()) {
            (false, true) => Packed::Catalogues(catalogues),
            (true, false) => Packed::Spectra(spectra),
            _ => {
                return Err(whole(
                    "the submission contains catalogues and spectra; expected one kind".into(),
                ));
            }
        };
        Ok(Submission {
            method: method.clone(),
            packed,
            manifest,
        })
    }
}

/// The catalogues of a submission, ready to be scored.
#[derive(Debug)]
pub struct PackedCatalogues {
    /// The open folder or archive.
    pub sent: Sent,
    /// Name of the method.
    pub method: String,
    /// Manifest, if there is one.
    pub manifest: Option<Manifest>,
    files: BTreeMap<u32, BTreeMap<u32, PathBuf>>,
}

impl PackedCatalogues {
    /// Whether a path is an archive, or a folder that `pack` wrote.
    pub fn is_packed(path: &Path) -> bool {
        is_archive(path) || is_there(&path.join(MANIFEST_FILE))
    }

    /// Opens an archive or folder of catalogues.
    ///
    /// # Errors
    /// As [`Sent::open`] and [`Submission::read`], and if it contains power spectra.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        let sent = Sent::open(path)?;
        let submission = Submission::read(&sent)?;
        PackedCatalogues::new(sent, submission)
    }

    /// The catalogues of a submission that was read from `sent`.
    ///
    /// # Errors
    /// If it contains power spectra.
    pub fn new(sent: Sent, submission: Submission) -> Result<Self, FileError> {
        let Submission {
            method,
            packed,
            manifest,
        } = submission;
        match packed {
            Packed::Catalogues(files) => Ok(PackedCatalogues {
                sent,
                method,
                manifest,
                files,
            }),
            Packed::Spectra(_) => {
                let message = format!(
                    "this submission contains power spectra; expected catalogues. Try: shearq score --packed {} --data DIR --store DIR",
                    sent.given.display()
                );
                Err(FileError::new(&sent.given, message))
            }
        }
    }

    /// The catalogues of a set, by image number.
    pub fn of_set(&self, set: u32) -> Vec<(u32, PathBuf)> {
        let images = self.files.get(&set).into_iter().flatten();
        images.map(|(image, path)| (*image, path.clone())).collect()
    }

    /// Sets with catalogues, in order.
    pub fn sets(&self) -> Vec<u32> {
        self.files.keys().copied().collect()
    }

    /// Whether shearq measured the catalogues, so that their convention is the standard one.
    pub fn is_own(&self) -> bool {
        self.manifest
            .as_ref()
            .is_some_and(|manifest| manifest.run.is_some())
    }

    /// Reads one of the catalogues.
    ///
    /// # Errors
    /// If it cannot be read, or the values are no ellipticities.
    pub fn sum(&self, grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
        let sum = match self.is_own() {
            true => own_catalogue(grid, path),
            false => plain_columns(COLUMNS, Screen::default())(grid, path),
        };
        sum.map_err(|error| self.sent.named(error))
    }
}

/// The manifest of a submission, if it has one, after comparing the files with it.
fn verified(sent: &Sent, files: &[PathBuf]) -> Result<Option<Manifest>, FileError> {
    let Some(manifest) = Manifest::read(&sent.path)? else {
        return Ok(None);
    };
    let mut found = Unpacked {
        manifest: Some(manifest),
        files: BTreeMap::new(),
    };
    for file in files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        found.files.insert(name.into_owned(), FileSum::of(file)?);
    }
    found.verify(&sent.given, true)?;
    Ok(found.manifest)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads a folder of empty files.
    fn read(names: &[&str]) -> Result<Submission, FileError> {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        Submission::read(&Sent::open(folder.path())?)
    }

    #[test]
    fn files_are_sorted_by_kind_set_and_image() {
        let names = ["g10_v1_objs_2_10.M.dat", "g10_v1_objs_2_9.M.dat", ".hidden"];
        let submission = read(&names).unwrap();
        let Packed::Catalogues(sets) = submission.packed else {
            panic!("catalogues are no spectra");
        };
        let images: Vec<u32> = sets[&2].keys().copied().collect();
        assert_eq!((submission.method.as_str(), images), ("M", vec![9, 10]));
        let spectra = read(&["M_set1.dat", "M_set2.dat"]).unwrap();
        assert!(matches!(spectra.packed, Packed::Spectra(files) if files.len() == 2));
    }

    #[test]
    fn a_submission_has_one_method_and_one_kind() {
        let one = "g10_v1_objs_2_1.M.dat";
        for (names, expected) in [
            (&[][..], "contains no files"),
            (&[one, "g10_v1_objs_2_2.N.dat"], "several methods: M, N"),
            (&[one, "M_set2.dat"], "catalogues and spectra"),
            (&[one, "notes.txt"], "the name is neither"),
        ] {
            let message = read(names).unwrap_err().to_string();
            assert!(message.contains(expected), "{names:?}: {message}");
        }
    }
}
