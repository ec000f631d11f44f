//! Reads submissions: the files of a folder or an archive, recognised by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::archive::{self, Unpacked, is_archive};
use super::challenge::Kind;
use super::manifest::{FileSum, MANIFEST_FILE, Manifest};
use shearq_dataset::layout::{DataFolder, check_folder};
use shearq_dataset::run::{Run, way};
use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::open::is_there;

/// A given folder or file, or the temporary folder of an unpacked archive.
#[derive(Debug)]
pub struct Sent {
    path: PathBuf,
    given: PathBuf,
    _unpacked: Option<Scratch>,
}

impl Sent {
    /// Opens a submission, and unpacks it if it has the ending of an archive.
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

    pub fn named(&self, error: FileError) -> FileError {
        FileError::new(self.as_given(&error.path), error.message)
    }

    /// The files without the manifest and hidden files, or the given file.
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

#[derive(Debug, Clone)]
pub enum Packed {
    /// Catalogues by set and image.
    Catalogues(BTreeMap<u32, BTreeMap<u32, PathBuf>>),
    /// A power spectrum per set.
    Spectra(BTreeMap<u32, PathBuf>),
}

#[derive(Debug, Clone)]
pub struct Submission {
    pub method: String,
    pub packed: Packed,
    pub manifest: Option<Manifest>,
}

impl Submission {
    /// What distinguishes methods of one name: the configuration as TOML, or the path from the data to the submission.
    pub fn settings(&self, path: &Path, data: &DataFolder) -> Result<String, FileError> {
        let run = self.manifest.as_ref().and_then(|own| own.run.as_ref());
        match run {
            Some(run) => settings_of(run, path),
            None => Ok(way(data.root(), path)?.display().to_string()),
        }
    }

    pub fn read(sent: &Sent) -> Result<Self, FileError> {
        let whole = |message: String| FileError::new(&sent.given, message);
        check_folder(&sent.path, "a folder or an archive (.tar.gz)")?;
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

pub fn settings_of(run: &Run, path: &Path) -> Result<String, FileError> {
    toml::to_string(&run.configuration)
        .map_err(FileError::doing(path, "cannot write the settings as TOML"))
}

/// Whether a path is an archive, or a folder that `pack` wrote.
pub fn is_packed(path: &Path) -> bool {
    // Below a file, the system's answer is an error other than "not found", which counts as there.
    is_archive(path) || (path.is_dir() && is_there(&path.join(MANIFEST_FILE)))
}

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
