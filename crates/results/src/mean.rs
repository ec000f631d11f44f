//! Mean ellipticities: the shear of a field that has one.

use std::path::{Path, PathBuf};

use shearq_measure::{Flag, Warning};
use shearq_quantities::statistics::RunningMean;

use shearq_files::FileError;
use shearq_files::table;
use shearq_pipeline::data::run::Run;

/// The mean over the galaxies of a set.
#[derive(Debug, Clone, PartialEq)]
pub struct SetMean {
    /// The set.
    pub set: u32,
    /// Images that there is a catalogue of.
    pub images: Vec<u32>,
    /// Galaxies with an ellipticity.
    pub galaxies: usize,
    /// Galaxies without one.
    pub flagged: usize,
    /// Galaxies with each of [`Flag::ALL`].
    pub flags: [usize; Flag::ALL.len()],
    /// Mean of e1 and e2.
    pub mean: [f64; 2],
    /// Standard error of the means, of galaxies that know nothing of one another.
    pub error: [f64; 2],
    /// Standard deviation of one galaxy.
    pub scatter: [f64; 2],
}

impl SetMean {
    /// A warning if more than half of the galaxies are flagged.
    pub fn mostly_flagged(&self) -> Option<Warning> {
        let with = |flag: Flag| {
            let mut counts = self.flags.iter().zip(Flag::ALL);
            counts
                .find(|(_, other)| *other == flag)
                .map_or(0, |(count, _)| *count)
        };
        Warning::of_counts(with, self.flagged, self.flagged + self.galaxies)
    }

    /// Whether all galaxies have one ellipticity, so that their scatter is no error.
    pub fn is_constant(&self) -> bool {
        self.galaxies > 1 && self.scatter == [0.0; 2]
    }
}

/// The means over the catalogues of each set of the results folder `out` (of `sets`, if there are some).
///
/// # Errors
/// Where a catalogue cannot be read, or there is none.
pub fn mean_shears(run: &Run, out: &Path, sets: &[u32]) -> Result<Vec<SetMean>, FileError> {
    let files = run.catalogues(out, sets)?;
    let mut means = Vec::new();
    for set in files.wanted(sets) {
        let catalogues = files.of_set(set);
        if catalogues.is_empty() {
            let message = format!("there is no catalogue of set {set}");
            return Err(FileError::new(out, message));
        }
        means.push(mean_of(set, &catalogues)?);
    }
    if means.is_empty() {
        return Err(FileError::new(
            out,
            "there is no catalogue; expected those of `measure`",
        ));
    }
    Ok(means)
}

fn mean_of(set: u32, catalogues: &[(u32, PathBuf)]) -> Result<SetMean, FileError> {
    let (mut moments, mut flagged) = ([RunningMean::default(); 2], 0);
    let mut flags = [0; Flag::ALL.len()];
    for (_, path) in catalogues {
        let read = table::read(path, Some(&["e1", "e2", "flag"]), table::MAX_ROWS)?;
        let (e1, e2) = (
            table::numbers(&read, "e1", path)?,
            table::numbers(&read, "e2", path)?,
        );
        for &bits in table::numbers(&read, "flag", path)?.iter() {
            for (count, flag) in flags.iter_mut().zip(Flag::ALL) {
                *count += usize::from(bits as u32 & flag as u32 != 0);
            }
        }
        for (&first, &second) in e1.iter().zip(e2.iter()) {
            if first.is_finite() && second.is_finite() {
                moments[0].add(first);
                moments[1].add(second);
            } else {
                flagged += 1;
            }
        }
    }
    let galaxies = moments[0].count();
    let scatter = moments.map(|m| m.deviation());
    Ok(SetMean {
        set,
        images: catalogues.iter().map(|(image, _)| *image).collect(),
        galaxies,
        flagged,
        flags,
        mean: moments.map(|m| m.mean()),
        error: scatter.map(|deviation| deviation / (galaxies as f64).sqrt()),
        scatter,
    })
}
