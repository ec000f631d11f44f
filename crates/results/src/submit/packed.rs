//! Submissions as they are sent: the files of a folder or an archive, told apart by their names.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::archive::{self, Unpacked, is_archive};
use super::challenge::Kind;
use super::manifest::{FileSum, MANIFEST_FILE, Manifest};
use shearq_files::FileError;
use shearq_files::atomic::Scratch;

/// A folder or file as it was given, or the folder that an archive was unpacked to for a while.
pub struct Sent {
    path: PathBuf,
    given: PathBuf,
    _unpacked: Option<Scratch>,
}

impl Sent {
    /// Unpacks what is an archive by its ending.
    ///
    /// # Errors
    /// Where it cannot be unpacked.
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

    /// Where the files are.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// How a file or the folder is called for those who gave it: as a member of the archive.
    pub fn as_given(&self, path: &Path) -> PathBuf {
        match path.strip_prefix(&self.path) {
            Ok(name) if name.as_os_str().is_empty() => self.given.clone(),
            Ok(name) => self.given.join(name),
            Err(_) => path.to_owned(),
        }
    }

    /// An error about a file of it, under the name [`Sent::as_given`].
    pub fn named(&self, error: FileError) -> FileError {
        FileError::new(self.as_given(&error.path), error.message)
    }

    /// The files, without the manifest and hidden ones; a file that was given is the only one.
    ///
    /// # Errors
    /// Where the folder cannot be listed, or the file is not there.
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

/// What a submission holds.
pub enum Packed {
    /// Catalogues by set and image.
    Catalogues(BTreeMap<u32, BTreeMap<u32, PathBuf>>),
    /// A power spectrum for each set.
    Spectra(BTreeMap<u32, PathBuf>),
}

/// A submission of one method, as its manifest says if it has one.
pub struct Submission {
    /// The method's name.
    pub method: String,
    /// Its files.
    pub packed: Packed,
    /// Its manifest.
    pub manifest: Option<Manifest>,
}

impl Submission {
    /// Reads what `sent` holds.
    ///
    /// # Errors
    /// Where files are not as the manifest says, or their names not those of one kind and one method.
    pub fn read(sent: &Sent) -> Result<Self, FileError> {
        let whole = |message: String| FileError::new(&sent.given, message);
        if !sent.path.is_dir() {
            return Err(whole(
                "there is no such folder; expected one, or an archive (.tar.gz)".into(),
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
                0 => "there is no file here".into(),
                _ => format!("files of several methods: {}", methods.join(", ")),
            }));
        };
        let packed = match (catalogues.is_empty(), spectra.is_empty()) {
            (false, true) => Packed::Catalogues(catalogues),
            (true, false) => Packed::Spectra(spectra),
            _ => {
                return Err(whole(
                    "it holds catalogues and spectra; expected one kind".into(),
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

/// The manifest of a submission if it has one, of which its files must be those.
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
