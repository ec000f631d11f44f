//! Fingerprints of the image, the PSF and the true shear of a catalogue. They are stored with the catalogue, and compared
//! when it is used.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_submissions::PsfForm;

use crate::fingerprint::{of_file, of_image};
use crate::images::ImageId;
use crate::layout::DataFolder;
use crate::run::{Run, Source};
use shearq_files::FileError;
use shearq_files::open::is_there;
use shearq_files::table::read_metadata;

/// Keys of a catalogue's metadata.
const GALAXIES: &str = "galaxies";
/// Key of the fingerprint of the PSF of an image.
pub const PSF: &str = "psf";
const TRUTH: &str = "truth";
/// Keys of the fingerprints in the metadata of a catalogue.
pub const PRINTS: [&str; 3] = [GALAXIES, PSF, TRUTH];

/// The files that a run measures, if they are there. A simulated run has none.
#[derive(Debug)]
pub struct Inputs<'a> {
    run: &'a Run,
    data: &'a DataFolder,
    /// Fingerprint of the truth of each set.
    truths: BTreeMap<u32, String>,
}

impl<'a> Inputs<'a> {
    /// The files of `images` of a run on `data`.
    ///
    /// # Errors
    /// If the true shear of a set is there and cannot be read.
    pub fn new(run: &'a Run, data: &'a DataFolder, images: &[ImageId]) -> Result<Self, FileError> {
        let mut truths = BTreeMap::new();
        if let Source::Folder { .. } = run.source {
            for of_set in images.chunk_by(|a, b| a.set == b.set) {
                let path = data.truth(of_set[0].set);
                if is_there(&path) {
                    truths.insert(of_set[0].set, of_file(&path)?);
                }
            }
        }
        Ok(Inputs { run, data, truths })
    }

    /// The files of an image, by their keys.
    fn files(&self, id: ImageId) -> BTreeMap<&'static str, PathBuf> {
        let psf = match self.run.configuration.psf.form {
            PsfForm::Star => self.data.psf_star(id.set, id.image),
            PsfForm::Functional => self.data.psf_functional(id.set, id.image),
        };
        BTreeMap::from([
            (GALAXIES, self.data.galaxies(id.set, id.image)),
            (PSF, psf),
            (TRUTH, self.data.truth(id.set)),
        ])
    }

    /// The fingerprints of an image's files, by their keys.
    ///
    /// # Errors
    /// If a file is there and cannot be read.
    pub fn prints(&self, id: ImageId) -> Result<BTreeMap<String, String>, FileError> {
        let mut prints = BTreeMap::new();
        if let Source::Simulated(_) = self.run.source {
            return Ok(prints);
        }
        for (key, path) in self.files(id) {
            let print = match key {
                TRUTH => self.truths.get(&id.set).cloned(),
                _ if is_there(&path) => Some(of_image(&path)?),
                _ => None,
            };
            prints.extend(print.map(|print| (key.to_owned(), print)));
        }
        Ok(prints)
    }

    /// Checks that the catalogue of an image in `out` was measured from the present files.
    ///
    /// # Errors
    /// If a file has changed or cannot be read.
    pub fn verify_image(&self, out: &Path, id: ImageId) -> Result<(), FileError> {
        let catalogue = self.run.catalogue(out, id.set, id.image);
        let now = self.prints(id)?;
        if now.is_empty() {
            return Ok(());
        }
        let kept = read_metadata(&catalogue, self.run.format, now.keys())?;
        for (key, path) in self.files(id) {
            if let (Some(now), Some(kept)) = (now.get(key), kept.get(key))
                && now != kept
            {
                let message = format!(
                    "the file has changed since {} was measured (found the fingerprint {now}, expected {kept}). Try: measure again into another folder",
                    catalogue.display()
                );
                return Err(FileError::new(path, message));
            }
        }
        Ok(())
    }
}
