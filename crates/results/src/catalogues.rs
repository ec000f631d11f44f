//! The catalogues of one method: measured by shearq, of another program, or of a submission. Scoring, comparing and
//! packing read all three in the same way.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::images::Files;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::metadata::{Axes, CommonAxes, stated_axes};
use shearq_dataset::run::{Run, Source};
use shearq_files::FileError;
use shearq_files::table::{self, FileFormat, MAX_ROWS, Place, most_rows};
use shearq_quantities::Frame;
use shearq_scoring::{Choice, Convention, FieldSum, Grid, Row, RowCounts};

use crate::response::response_of;
use crate::submit::{Packed, Sent, Submission, settings_of};
use shearq_catalogue::foreign::{ADVICE_ON_SENTINELS, Foreign, HINT_OF_COLUMNS, fault_of_rows};
use shearq_catalogue::galaxies::{Calibration, CalibrationSums, Galaxies, Galaxy};
use shearq_catalogue::source::states_shearq;
use shearq_files::atomic::folder_of;

/// The rows of a catalogue in the format of a challenge or of shearq, with the columns x, y, e1 and e2; at most `most`.
pub fn read_rows(path: &Path, most: usize) -> Result<Vec<Row>, FileError> {
    let names = ["x", "y", "e1", "e2"];
    let read = table::read(path, Some(&names), most)
        .map_err(|error| error.hint_of_columns(HINT_OF_COLUMNS))?;
    let [x, y, e1, e2] = names.map(|name| table::numbers(&read, name, path));
    let (x, y, e1, e2) = (x?, y?, e1?, e2?);
    let row = |k: usize| Row {
        x: x[k],
        y: y[k],
        e1: e1[k],
        e2: e2[k],
    };
    Ok((0..x.len()).map(row).collect())
}

/// The convention of catalogues by shearq, which is the standard one by construction.
pub const OWN: Choice = Choice::Insist(Convention::STANDARD);

/// The number of the set of plain files, which have none: sets of data folders may be 0.
pub const PLAIN_SET: u32 = u32::MAX;

#[derive(Debug)]
pub struct Catalogues {
    /// Name of the configuration, program or method.
    pub name: String,
    /// The folder, archive or description that the user gave.
    pub path: PathBuf,
    /// What distinguishes methods of one name: the configuration as TOML, the description, or the path.
    pub settings: String,
    pub files: Files,
    /// The run of catalogues that shearq measured into a folder.
    pub run: Option<Run>,
    /// How columns are found; `None` of catalogues by shearq.
    pub description: Option<Foreign>,
    sent: Option<Sent>,
    // Catalogues by shearq have its convention also after packing.
    by_shearq: bool,
}

impl Catalogues {
    fn of_files(name: String, path: &Path, settings: String, files: Files) -> Self {
        Catalogues {
            name,
            path: path.to_owned(),
            settings,
            files,
            run: None,
            description: None,
            sent: None,
            by_shearq: false,
        }
    }

    /// The catalogues of `sets` (of all if empty) that shearq measured into `folder`.
    pub fn measured(run: &Run, folder: &Path, sets: &[u32]) -> Result<Self, FileError> {
        let name = run.configuration.name.clone();
        let (settings, files) = (settings_of(run, folder)?, run.catalogues(folder, sets)?);
        Ok(Catalogues {
            run: Some(run.clone()),
            by_shearq: true,
            ..Self::of_files(name, folder, settings, files)
        })
    }

    /// The catalogues of `sets` (of all if empty) of another program with the description `path`.
    pub fn foreign(path: &Path, sets: &[u32]) -> Result<Self, FileError> {
        let (foreign, settings) = Foreign::read(path)?;
        let (name, files) = (foreign.name.clone(), foreign.catalogues(sets)?);
        Ok(Catalogues {
            description: Some(foreign),
            ..Self::of_files(name, path, settings, files)
        })
    }

    /// Plain files of one set, one per image, whose columns are recognised; `described` if the user states some.
    pub fn plain(paths: &[PathBuf], described: Option<Foreign>) -> Result<Self, FileError> {
        let images = (1..).zip(paths.iter().cloned()).collect();
        let files = Files::from_sets(BTreeMap::from([(PLAIN_SET, images)]));
        let first = paths.first().map_or(Path::new(""), PathBuf::as_path);
        let mut is_own = described.is_none();
        for path in paths {
            is_own = is_own && states_shearq(path)? == Some(true);
        }
        Ok(Catalogues {
            description: (!is_own).then(|| described.unwrap_or_default()),
            by_shearq: is_own,
            ..Self::of_files(String::new(), first, String::new(), files)
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
            let message = "this submission contains power spectra; expected catalogues";
            return Err(FileError::new(&path, message).hint(format!(
                "shearq score --packed {} --data DIR --store DIR",
                path.display()
            )));
        };
        let files = Files::from_sets(files);
        // Only their manifest has a run.
        let by_shearq = (submission.manifest).is_some_and(|own| own.run.is_some());
        // Catalogues of other programs were converted when they were packed, so that their description would convert them again.
        // Tables with names of columns, which `pack` does not write, are recognised.
        Ok(Catalogues {
            sent: Some(sent),
            description: (!by_shearq).then(Foreign::default),
            by_shearq,
            ..Self::of_files(submission.method, &path, settings, files)
        })
    }

    /// The frame of a set. A set is refused if only some of its catalogues by shearq are in the frame of the sky, because the true
    /// shear is in one frame.
    pub fn frame(&self, set: u32) -> Result<Frame, FileError> {
        let mut axes = CommonAxes::default();
        let is_measured = self.by_shearq && self.sent.is_none();
        for (_, path) in self.files.of_set(set).iter().filter(|_| is_measured) {
            let format = self.run.as_ref().map(|run| run.format);
            if let Some(format) = format.or_else(|| FileFormat::of(path)) {
                axes.add(path, stated_axes(path, format)?, true)?;
            }
        }
        Ok(axes.common().map_or(Frame::Pixel, Axes::frame))
    }

    /// The source of the galaxies, for a store.
    pub fn source(&self, data: &DataFolder) -> Result<Source, FileError> {
        match &self.run {
            Some(run) => Ok(run.source.clone()),
            // Other programs do not record what they measured, so that the fingerprints of the data identify it.
            None => Source::folder(data, folder_of(&self.path)),
        }
    }

    /// The convention to score in, if the user gives none. Catalogues by shearq have the standard one by construction.
    pub fn choice(&self) -> Choice {
        match self.by_shearq {
            true => OWN,
            // Noise would choose the highest Q, so that it is matched to the truth of all sets.
            false => Choice::Matched,
        }
    }

    /// The name of a file in messages.
    pub fn as_given(&self, path: &Path) -> PathBuf {
        let sent = self.sent.as_ref();
        sent.map_or_else(|| path.to_owned(), |sent| sent.as_given(path))
    }

    /// What the ellipticities of a set are still to be divided by.
    pub fn calibration(&self, set: u32) -> Result<Calibration, FileError> {
        let files = self.files.of_set(set);
        let Some(foreign) = &self.description else {
            return match &self.sent {
                // Packing divides by the response.
                Some(_) => Ok(Calibration::NONE),
                None => response_of(files.iter().map(|(_, path)| path.as_path()))
                    .map(Calibration::diagonal),
            };
        };
        let mut mean = CalibrationSums::default();
        for (_, path) in &files {
            if let Some(own) = recognised(foreign, path, MAX_ROWS)? {
                mean.add(&own)?;
            }
        }
        let calibration = mean.calibration()?;
        Ok(match foreign.has_other_sign_of_e2() {
            true => calibration.with_other_sign_of_e2(),
            false => calibration,
        })
    }

    /// Which columns of the first catalogue are used as what, and columns of any other that look as if they should be used; empty of
    /// catalogues by shearq, and without names of columns.
    pub fn account(&self) -> Result<Vec<String>, FileError> {
        let Some(foreign) = &self.description else {
            return Ok(Vec::new());
        };
        let mut sets = self.files.sets();
        // A pattern without {set} gives each of them the same files.
        if self.files.serve_all_sets() {
            sets.truncate(1);
        }
        let paths = sets.iter().flat_map(|set| self.files.of_set(*set));
        let mut all = Vec::new();
        for (_, path) in paths {
            match recognised(foreign, &path, MAX_ROWS)? {
                Some(own) => all.push(own),
                None => return Ok(Vec::new()),
            }
        }
        let Some((first, others)) = all.split_first() else {
            return Ok(Vec::new());
        };
        Ok([first.account(), first.unused_in(others)].concat())
    }

    /// The columns of the first catalogue that are used, by role; empty of catalogues by shearq, and without names of columns.
    pub fn columns(&self) -> Result<Vec<(String, String)>, FileError> {
        let sets = self.files.sets();
        let mut paths = sets.iter().flat_map(|set| self.files.of_set(*set));
        let (Some(foreign), Some((_, first))) = (&self.description, paths.next()) else {
            return Ok(Vec::new());
        };
        let first = recognised(foreign, &first, MAX_ROWS)?;
        Ok(first.map_or_else(Vec::new, |own| own.columns()))
    }

    /// The rows of one catalogue, at most `most`, with the signs and the type of ellipticity that are scored, and their weights.
    pub fn rows(&self, path: &Path, most: usize) -> Result<Vec<Galaxy>, FileError> {
        match &self.description {
            Some(foreign) => foreign.rows(&foreign.open(path, most)?, most),
            None => Ok(unweighted(read_rows(path, most)?)),
        }
    }

    /// One catalogue on the grid, before its calibration.
    pub fn sum(&self, grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
        let named = |error| match &self.sent {
            Some(sent) => sent.named(error),
            None => error,
        };
        let rows = self.rows(path, most_rows(grid.cells())).map_err(named)?;
        let (sum, counts, fault) = sum_on(grid, rows, self.by_shearq);
        match fault {
            Some(fault) => Err(named(FileError::new(path, fault))),
            None => Ok((sum, counts)),
        }
    }
}

/// A catalogue whose columns have names, which are recognised; columns without names have no other roles than x, y, e1 and e2.
pub fn recognised(
    foreign: &Foreign,
    path: &Path,
    most: usize,
) -> Result<Option<Galaxies>, FileError> {
    let has_names = !table::columns(&Place::of(path))?.named.is_empty();
    has_names.then(|| foreign.open(path, most)).transpose()
}

/// The galaxies of one catalogue that was sent, at most `most`, before calibration.
pub fn sent_galaxies(path: &Path, most: usize) -> Result<Vec<Galaxy>, FileError> {
    let own = recognised(&Foreign::default(), path, most)?;
    galaxies_of(own.as_ref(), path, most)
}

/// The galaxies of a catalogue by its recognised columns, which are x, y, e1 and e2 if they have no names.
pub(crate) fn galaxies_of(
    recognised: Option<&Galaxies>,
    path: &Path,
    most: usize,
) -> Result<Vec<Galaxy>, FileError> {
    match recognised {
        Some(own) => own.read(most),
        None => Ok(unweighted(read_rows(path, most)?)),
    }
}

/// Galaxies on the grid, before their calibration, and why they are not to be scored, if there is a reason.
pub(crate) fn sum_on(
    grid: &Grid,
    galaxies: impl IntoIterator<Item = Galaxy>,
    by_shearq: bool,
) -> (FieldSum, RowCounts, Option<String>) {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_weighted(grid, galaxies);
    // shearq writes no numbers that stand for failed measurements, and its ellipticities may be large: they are moments
    // over fluxes. A manifest that states its run falsely spares nothing but a refusal of the own galaxies.
    let fault = fault_of_rows(&counts, grid, ADVICE_ON_SENTINELS).filter(|_| !by_shearq);
    (sum, counts, fault)
}

fn unweighted(rows: Vec<Row>) -> Vec<Galaxy> {
    rows.into_iter().map(|row| (row, 1.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_ellipticities_are_no_fault_of_shearq() {
        let grid = Grid::great10(8).unwrap();
        let row = |k: usize| Row {
            x: 24.5 + 48.0 * (k % 8) as f64,
            y: 24.5 + 48.0 * (k / 8) as f64,
            e1: 6.0,
            e2: 0.0,
        };
        let fault = |by_shearq| {
            let (_, counts, fault) = sum_on(&grid, (0..64).map(|k| (row(k), 1.0)), by_shearq);
            assert_eq!(counts.used, 64);
            fault.is_some()
        };
        assert_eq!([true, false].map(fault), [false, true]);
    }
}
