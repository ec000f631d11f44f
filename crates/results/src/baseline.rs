//! Baselines: what was measured once, and everything that made it, in a TOML file to compare with.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_submissions::{Configuration, checked_name};

use shearq_files::{FileError, atomic};
use shearq_pipeline::data::run::Source;

mod measured;
mod moved;

pub use measured::{Wanted, measure, metrics_of};
pub use moved::{Checked, Settings, Shift, check};

/// A baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Version of shearq that measured it.
    pub version: String,
    /// Number of sets of all submissions together, by which a file that was cut short is known. Older ones have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sets_held: Option<usize>,
    /// Where the galaxies come from.
    pub source: Source,
    /// Why it was changed, oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Change>,
    /// What was measured.
    pub submissions: Vec<BaselineConfiguration>,
}

/// One submission of a baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineConfiguration {
    /// Its name.
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    /// Its configuration file, from the folder of the baseline. None if it is a named one, or not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// All settings. Kept as text would be, so that settings of later versions can be told apart
    /// from them.
    pub settings: toml::Table,
    /// Its sets, in order.
    pub sets: Vec<BaselineSet>,
}

impl BaselineConfiguration {
    /// A measured submission, of the configuration `file` if it is known.
    ///
    /// # Errors
    /// Where its settings cannot be stored.
    pub fn new(
        configuration: &Configuration,
        file: Option<PathBuf>,
        sets: Vec<BaselineSet>,
    ) -> Result<Self, toml::ser::Error> {
        Ok(BaselineConfiguration {
            name: configuration.name.clone(),
            file,
            settings: toml::Table::try_from(configuration)?,
            sets,
        })
    }
}

/// One set of a submission.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineSet {
    /// Set number.
    pub set: u32,
    /// Fingerprint of its data.
    pub data: String,
    /// Numbers of the images.
    pub images: Vec<u32>,
    /// Galaxies in their catalogues.
    pub galaxies: u64,
    /// Of these, without an ellipticity.
    pub flagged: u64,
    /// Value and standard error of each metric, and of the scatter (rms) of either component of the
    /// ellipticity. An unknown error is NaN.
    pub metrics: BTreeMap<String, [f64; 2]>,
}

/// A change of a baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Why.
    pub reason: String,
    /// Version of shearq before.
    pub from_version: String,
    /// What moved.
    pub moved: Vec<String>,
}

impl Baseline {
    /// Of what this version measured.
    pub fn new(
        source: Source,
        history: Vec<Change>,
        submissions: Vec<BaselineConfiguration>,
    ) -> Self {
        Baseline {
            version: shearq_pipeline::VERSION.into(),
            sets_held: Some(sets_of(&submissions).count()),
            source,
            history,
            submissions,
        }
    }

    /// The file of the baseline `name` in `folder`.
    pub fn path(folder: &Path, name: &str) -> PathBuf {
        folder.join(format!("{name}.{ENDING}"))
    }

    /// Names of the baselines in `folder`, in order.
    ///
    /// # Errors
    /// Where the folder cannot be read.
    pub fn names(folder: &Path) -> Result<Vec<String>, FileError> {
        let entries = std::fs::read_dir(folder)
            .and_then(Iterator::collect::<std::io::Result<Vec<_>>>)
            .map_err(FileError::doing(folder, "cannot read the baselines"))?;
        let mut names: Vec<String> = entries
            .into_iter()
            .map(|entry| entry.path())
            .filter(|path| path.extension().is_some_and(|ending| ending == ENDING))
            .filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned()))
            .collect();
        names.sort();
        Ok(names)
    }

    /// Reads a baseline.
    ///
    /// # Errors
    /// Where it cannot be read or is not valid.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        let text = shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS)
            .map_err(FileError::doing(path, "cannot read the baseline"))?;
        let baseline: Baseline = toml::from_str(&text)
            .map_err(|error| FileError::new(path, error.to_string().trim_end()))?;
        let wild = |set: &&BaselineSet| {
            let mut metrics = set.metrics.values();
            metrics.any(|[value, error]| value.is_infinite() || error.is_infinite() || *error < 0.0)
        };
        if let Some(set) = sets_of(&baseline.submissions).find(wild) {
            let message = format!(
                "set {} has an infinite metric, or an error that is infinite or negative",
                set.set
            );
            return Err(FileError::new(path, message));
        }
        let found = sets_of(&baseline.submissions).count();
        if let Some(held) = baseline.sets_held.filter(|held| *held != found) {
            let message = format!(
                "{found} of {held} sets are there, as `sets_held` counts them: it was cut short or edited"
            );
            return Err(FileError::new(path, message));
        }
        Ok(baseline)
    }

    /// Writes the baseline, which must be new.
    ///
    /// # Errors
    /// Where it cannot be written, or another process was first.
    pub fn create(&self, path: &Path) -> Result<(), FileError> {
        atomic::sweep_beside(path);
        if atomic::write_if_absent(path, self.text(path)?.as_bytes())? {
            return Ok(());
        }
        Err(Baseline::exists(path))
    }

    /// Writes the baseline in place of `earlier`, which was read from the same file before the work.
    ///
    /// # Errors
    /// Where the file has changed since, or cannot be written.
    pub fn replace(&self, path: &Path, earlier: &Baseline) -> Result<(), FileError> {
        atomic::sweep_beside(path);
        // Until the file is replaced, other processes wait here. Without locks in the file system they do not.
        let folder = path
            .parent()
            .and_then(|folder| std::fs::File::open(folder).ok());
        let _ = folder.as_ref().map(std::fs::File::lock);
        // As texts, in which unknown errors are equal.
        if Baseline::read(path)?.text(path)? != earlier.text(path)? {
            let name = path.file_stem().unwrap_or_default().to_string_lossy();
            let message = format!(
                "the baseline was changed while this command measured; nothing was written. Try: shearq baseline check {name}"
            );
            return Err(FileError::new(path, message));
        }
        atomic::write(path, self.text(path)?.as_bytes())
    }

    /// What is wrong where a baseline that is to be new exists.
    pub fn exists(path: &Path) -> FileError {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        FileError::new(
            path,
            format!(
                "the baseline exists; `baseline check {name} --update --reason TEXT` changes it"
            ),
        )
    }

    fn text(&self, path: &Path) -> Result<String, FileError> {
        toml::to_string(self).map_err(FileError::doing(path, "cannot write the baseline"))
    }
}

fn sets_of(submissions: &[BaselineConfiguration]) -> impl Iterator<Item = &BaselineSet> {
    submissions
        .iter()
        .flat_map(|configuration| &configuration.sets)
}

/// Ending of file names.
const ENDING: &str = "toml";

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_simulate::set::SimulationSettings;

    #[test]
    fn of_two_that_replace_one_baseline_the_second_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = Baseline::path(folder.path(), "mine");
        let of = |seed| {
            let source = Source::Simulated(SimulationSettings::new(seed, 8));
            Baseline::new(source, Vec::new(), Vec::new())
        };
        of(1).create(&path).unwrap();
        let earlier = Baseline::read(&path).unwrap();
        of(2).replace(&path, &earlier).unwrap();
        let message = of(3).replace(&path, &earlier).unwrap_err().to_string();
        assert!(
            message.ends_with("mine.toml: the baseline was changed while this command measured; nothing was written. Try: shearq baseline check mine"),
            "{message}"
        );
        assert_eq!(Baseline::read(&path).unwrap(), of(2));
    }
}
