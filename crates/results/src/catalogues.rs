//! The catalogues of one method: measured by shearq, of another program, or of a submission. Scoring, comparing and
//! packing read all three in the same way.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::layout::{DataFolder, read_rows};
use shearq_dataset::listing::Files;
use shearq_dataset::metadata::{CommonAxes, stated_axes};
use shearq_dataset::run::{Run, Source};
use shearq_files::FileError;
use shearq_files::table::most_rows;
use shearq_scoring::{Choice, Convention, FieldSum, Grid, Row, RowCounts};

use crate::foreign::{Foreign, Screen, folder_of, plain_columns};
use crate::response::response_of;
use crate::submit::{Packed, Sent, Submission, settings_of};

/// The scored columns of catalogues by shearq.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// The convention of catalogues by shearq, which is the standard one by construction.
pub const OWN: Choice = Choice::Insist(Convention::STANDARD);

/// Reads catalogues by shearq.
pub fn own_catalogue(grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, read_rows(path, &COLUMNS, most_rows(grid.cells()))?);
    Ok((sum, counts))
}

#[derive(Debug)]
pub struct Catalogues {
    /// Name of the configuration, program or method.
    pub name: String,
    /// The folder, archive or description that the user gave.
    pub path: PathBuf,
    /// What distinguishes methods of one name: the configuration as TOML, the description, or the path.
    pub settings: String,
    origin: Origin,
}

#[derive(Debug)]
enum Origin {
    Measured(Box<Run>, Files),
    Foreign(Box<Foreign>, Files),
    Packed {
        sent: Sent,
        own: bool,
        files: BTreeMap<u32, BTreeMap<u32, PathBuf>>,
    },
}

impl Catalogues {
    /// The catalogues of `sets` (of all if empty) that shearq measured into `folder`.
    pub fn measured(run: &Run, folder: &Path, sets: &[u32]) -> Result<Self, FileError> {
        Ok(Catalogues {
            name: run.configuration.name.clone(),
            path: folder.to_owned(),
            settings: settings_of(run, folder)?,
            origin: Origin::Measured(Box::new(run.clone()), run.catalogues(folder, sets)?),
        })
    }

    /// The catalogues of `sets` (of all if empty) of another program with the description `path`.
    pub fn foreign(path: &Path, sets: &[u32]) -> Result<Self, FileError> {
        let foreign = Foreign::read(path)?;
        let settings =
            shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS).map_err(
                FileError::doing(path, "cannot read the description of catalogues"),
            )?;
        let files = foreign.catalogues(sets)?;
        Ok(Catalogues {
            name: foreign.name.clone(),
            path: path.to_owned(),
            settings,
            origin: Origin::Foreign(Box::new(foreign), files),
        })
    }

    /// The catalogues of a submission, to be scored against `data`.
    pub fn packed(
        sent: Sent,
        submission: Submission,
        data: &DataFolder,
    ) -> Result<Self, FileError> {
        let path = sent.as_given(sent.path());
        let settings = submission.settings(&path, data)?;
        let Packed::Catalogues(files) = submission.packed else {
            let message = format!(
                "this submission contains power spectra; expected catalogues. Try: shearq score --packed {} --data DIR --store DIR",
                path.display()
            );
            return Err(FileError::new(path, message));
        };
        Ok(Catalogues {
            settings,
            name: submission.method,
            path,
            origin: Origin::Packed {
                sent,
                // Catalogues by shearq have its convention also after packing. Only their manifest has a run.
                own: submission.manifest.is_some_and(|own| own.run.is_some()),
                files,
            },
        })
    }

    /// The catalogues of a set, by image number.
    pub fn of_set(&self, set: u32) -> Vec<(u32, PathBuf)> {
        match &self.origin {
            Origin::Measured(_, files) | Origin::Foreign(_, files) => files.of_set(set),
            Origin::Packed { files, .. } => {
                let images = files.get(&set).into_iter().flatten();
                images.map(|(image, path)| (*image, path.clone())).collect()
            }
        }
    }

    /// Refuses a set of which only some catalogues by shearq are in the frame of the sky. The true shear is that of one frame.
    pub fn check_axes(&self, set: u32) -> Result<(), FileError> {
        let Origin::Measured(run, files) = &self.origin else {
            return Ok(());
        };
        let mut axes = CommonAxes::default();
        for (_, path) in files.of_set(set) {
            axes.add(&path, stated_axes(&path, run.format)?, true)?;
        }
        Ok(())
    }

    pub fn sets(&self) -> Vec<u32> {
        match &self.origin {
            Origin::Measured(_, files) | Origin::Foreign(_, files) => files.sets(),
            Origin::Packed { files, .. } => files.keys().copied().collect(),
        }
    }

    /// Whether one pattern without a set number serves all sets.
    pub fn serve_all_sets(&self) -> bool {
        match &self.origin {
            Origin::Measured(_, files) | Origin::Foreign(_, files) => files.serve_all_sets(),
            Origin::Packed { .. } => false,
        }
    }

    /// Sentences about files with similar names that are not read.
    pub fn unread(&self) -> Vec<String> {
        match &self.origin {
            Origin::Measured(_, files) | Origin::Foreign(_, files) => files.unread(),
            Origin::Packed { .. } => Vec::new(),
        }
    }

    /// The run of catalogues that shearq measured into a folder.
    pub fn run(&self) -> Option<&Run> {
        match &self.origin {
            Origin::Measured(run, _) => Some(run),
            _ => None,
        }
    }

    pub fn description(&self) -> Option<&Foreign> {
        match &self.origin {
            Origin::Foreign(foreign, _) => Some(foreign),
            _ => None,
        }
    }

    /// The source of the galaxies, for a store.
    pub fn source(&self, data: &DataFolder) -> Result<Source, FileError> {
        match &self.origin {
            Origin::Measured(run, _) => Ok(run.source.clone()),
            // Other programs do not record what they measured, so that the fingerprints of the data identify it.
            _ => Source::folder(data, folder_of(&self.path)),
        }
    }

    /// The convention to score in, if the user gives none. Catalogues by shearq have the standard one by construction.
    pub fn choice(&self) -> Choice {
        match &self.origin {
            Origin::Measured(..) | Origin::Packed { own: true, .. } => OWN,
            // Noise would choose the highest Q, so that it is matched to the truth of all sets.
            Origin::Foreign(..) | Origin::Packed { own: false, .. } => Choice::Matched,
        }
    }

    /// The name of a file in messages.
    pub fn as_given(&self, path: &Path) -> PathBuf {
        match &self.origin {
            Origin::Packed { sent, .. } => sent.as_given(path),
            _ => path.to_owned(),
        }
    }

    /// The mean responses R11 and R22 of a set that its ellipticities are still to be divided by; 1 if none.
    pub fn response(&self, set: u32) -> Result<[f64; 2], FileError> {
        match &self.origin {
            Origin::Packed { .. } => Ok([1.0; 2]),
            _ => response_of(self.of_set(set).iter().map(|(_, path)| path.as_path())),
        }
    }

    /// The rows of one catalogue, at most `most`, with the signs and the type of ellipticity that are scored, divided by
    /// `response`.
    pub fn rows(
        &self,
        path: &Path,
        response: [f64; 2],
        most: usize,
    ) -> Result<Vec<Row>, FileError> {
        let mut rows = match &self.origin {
            Origin::Foreign(foreign, _) => foreign.rows(path, most)?,
            // Catalogues of other programs were converted when they were packed.
            Origin::Measured(..) | Origin::Packed { .. } => read_rows(path, &COLUMNS, most)?,
        };
        for row in &mut rows {
            row.e1 /= response[0];
            row.e2 /= response[1];
        }
        Ok(rows)
    }

    /// One catalogue on the grid, not divided by a response.
    pub fn sum(&self, grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
        match &self.origin {
            Origin::Measured(..) => own_catalogue(grid, path),
            Origin::Foreign(foreign, _) => foreign.sum(grid, path),
            Origin::Packed { sent, own, .. } => match own {
                true => own_catalogue(grid, path),
                false => plain_columns(COLUMNS, Screen::default())(grid, path),
            }
            .map_err(|error| sent.named(error)),
        }
    }
}
