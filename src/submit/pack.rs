//! Packing: measured catalogues become the files that a challenge takes, with a manifest.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_scoring::Grid;
use shearq_scoring::units::{Degrees, Pixels};

use super::archive::{ArchiveWriter, is_archive};
use super::challenge::{Kind, Spectrum, catalogue_text, spectrum_text};
use super::manifest::{Contents, FileSum, MANIFEST_FILE, Manifest};
use crate::io::atomic::PartFolder;
use crate::io::layout::MAX_SET;
use crate::io::run::Run;
use crate::io::table;
use crate::io::{FileError, run::record_text};
use crate::pipeline::Progress;
use crate::pipeline::score::grid_side;

/// What is packed.
pub struct Packing<'a> {
    /// Folder of catalogues.
    pub measured: &'a Path,
    /// Its record.
    pub run: &'a Run,
    /// Method's name in file names.
    pub method: String,
    /// What the files are to hold.
    pub contents: Contents,
}

impl Packing<'_> {
    /// Catalogues by set, for sets that have some.
    fn catalogues(&self) -> impl Iterator<Item = (u32, Vec<(u32, PathBuf)>)> + '_ {
        (1..=MAX_SET)
            .map(|set| (set, self.run.catalogues(self.measured, set)))
            .filter(|(_, catalogues)| !catalogues.is_empty())
    }

    /// Number of galaxies to pack, for progress bars: an estimate from the first catalogue.
    ///
    /// # Errors
    /// Where there is no catalogue, or it cannot be read.
    pub fn galaxies(&self) -> Result<u64, FileError> {
        let mut all = self.catalogues().flat_map(|(_, catalogues)| catalogues);
        let Some((_, first)) = all.next() else {
            let message = "there is no catalogue here to pack";
            return Err(FileError::new(self.measured, message));
        };
        Ok(((1 + all.count()) * rows_of(&first)?) as u64)
    }

    /// Writes the files and their manifest to `out`, a new folder or, by its ending, an archive, which
    /// appears whole or not at all. The same catalogues give the same bytes. Returns the number of
    /// files without the manifest.
    ///
    /// # Errors
    /// Where a catalogue cannot be read or `out` cannot be written.
    pub fn write(&self, out: &Path, progress: &mut dyn Progress) -> Result<usize, FileError> {
        let mut destination = Destination::create(out)?;
        let mut files = BTreeMap::new();
        let mut covariances = BTreeMap::new();
        let mut add = |kind: Kind, text: String| -> Result<(), FileError> {
            let (name, mut bytes) = (kind.file_name(), text.as_bytes());
            destination.add(&name, bytes)?;
            let sum = FileSum::copying(&mut bytes, &mut std::io::sink())
                .map_err(FileError::doing(out, "cannot add up"))?;
            files.insert(name, sum);
            Ok(())
        };
        for (set, catalogues) in self.catalogues() {
            let method = self.method.clone();
            let spectrum = match self.contents {
                Contents::Catalogues => None,
                Contents::Spectra => Some(Spectrum::Averaged),
                Contents::CrossSpectra => Some(Spectrum::Cross),
            };
            if let Some(spectrum) = spectrum {
                let grid = self.grid(&catalogues[0].1)?;
                let paths: Vec<PathBuf> = catalogues.into_iter().map(|(_, path)| path).collect();
                let kind = Kind::Spectrum { set, method };
                let (text, covariance) = spectrum_text(&grid, &paths, spectrum)?;
                if let Some(covariance) = covariance {
                    covariances.insert(kind.file_name(), covariance);
                }
                add(kind, text)?;
                progress.advance((paths.len() * grid.cells()) as u64);
                continue;
            }
            for (image, path) in catalogues {
                let method = method.clone();
                let (text, rows) = catalogue_text(&path)?;
                add(Kind::Catalogue { set, image, method }, text)?;
                progress.advance(rows as u64);
            }
        }
        let count = files.len();
        let manifest = Manifest {
            version: crate::VERSION.into(),
            method: self.method.clone(),
            contents: self.contents,
            run: self.run.clone(),
            files,
            covariances,
        };
        destination.add(MANIFEST_FILE, record_text(out, &manifest)?.as_bytes())?;
        destination.finish()?;
        Ok(count)
    }

    /// Grid of a catalogue, which has a row for every cell, measured or not.
    fn grid(&self, catalogue: &Path) -> Result<Grid, FileError> {
        let layout = self.run.source.layout();
        Grid::new(
            grid_side(catalogue, rows_of(catalogue)?)?,
            Pixels(layout.stamp as f64),
            Degrees(layout.field_degrees),
        )
        .map_err(|error| FileError::new(catalogue, error))
    }
}

fn rows_of(catalogue: &Path) -> Result<usize, FileError> {
    Ok(table::read(catalogue, Some(&["x"]))?.rows())
}

/// Where packed files go.
enum Destination {
    Folder(PartFolder),
    Archive(Box<ArchiveWriter>),
}

impl Destination {
    fn create(out: &Path) -> Result<Self, FileError> {
        if is_archive(out) {
            let archive = Box::new(ArchiveWriter::create(out)?);
            return Ok(Destination::Archive(archive));
        }
        PartFolder::new(out).map(Destination::Folder)
    }

    fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), FileError> {
        match self {
            Destination::Archive(archive) => archive.add(name, bytes),
            Destination::Folder(folder) => {
                let path = folder.path().join(name);
                std::fs::write(&path, bytes)
                    .map_err(FileError::doing(&path, "cannot write the file"))
            }
        }
    }

    fn finish(self) -> Result<(), FileError> {
        match self {
            Destination::Archive(archive) => archive.finish(),
            Destination::Folder(folder) => folder.finish(),
        }
    }
}
