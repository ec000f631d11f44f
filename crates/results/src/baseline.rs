//! Baselines: stored metrics with their settings and data, in a TOML file to compare with.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_submissions::{Configuration, checked_name};

use shearq_dataset::run::Source;
use shearq_files::{FileError, atomic};

mod measured;
mod moved;

pub use measured::{Wanted, measure, metrics_of};
pub use moved::{BaselineError, Checked, Settings, SettingsError, Shift, check};

/// A baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    /// Version of shearq that measured it.
    pub version: String,
    /// Number of sets of all configurations, to detect a truncated file. Older files have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sets_held: Option<usize>,
    /// Source of the galaxies.
    pub source: Source,
    /// Changes of the baseline, oldest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub history: Vec<Change>,
    /// The measured configurations.
    pub submissions: Vec<BaselineConfiguration>,
}

/// One configuration of a baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineConfiguration {
    /// Name of the configuration.
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    /// Configuration file, relative to the folder of the baseline. `None` for a named or unknown configuration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// All settings as a TOML table, so that settings of other versions can be compared.
    pub settings: toml::Table,
    /// Sets in ascending order.
    pub sets: Vec<BaselineSet>,
}

impl BaselineConfiguration {
    /// A measured configuration, with its `file` if known.
    ///
    /// # Errors
    /// If the settings cannot be written as TOML.
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

/// One set of a configuration.
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
    /// Number of these galaxies without an ellipticity.
    pub flagged: u64,
    /// Value and standard error of each metric, and of the scatter (rms) of e1 and e2. An unknown error is NaN.
    pub metrics: BTreeMap<String, [f64; 2]>,
}

/// A change of a baseline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Reason of the change.
    pub reason: String,
    /// Version of shearq before the change.
    pub from_version: String,
    /// Moved metrics and settings, one line each.
    pub moved: Vec<String>,
}

impl Baseline {
    /// A baseline measured by this version.
    pub fn new(
        source: Source,
        history: Vec<Change>,
        submissions: Vec<BaselineConfiguration>,
    ) -> Self {
        Baseline {
            version: shearq_dataset::VERSION.into(),
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
    /// If the folder cannot be read.
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
    /// If the file cannot be read or is invalid.
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
                "set {}: a metric is infinite, or its error is infinite or negative",
                set.set
            );
            return Err(FileError::new(path, message));
        }
        let found = sets_of(&baseline.submissions).count();
        if let Some(held) = baseline.sets_held.filter(|held| *held != found) {
            let message = format!(
                "the file was truncated or edited (found {found} sets, expected {held} as in `sets_held`)"
            );
            return Err(FileError::new(path, message));
        }
        Ok(baseline)
    }

    /// Writes a new baseline.
    ///
    /// # Errors
    /// If the file exists or cannot be written.
    pub fn create(&self, path: &Path) -> Result<(), FileError> {
        atomic::sweep_beside(path);
        if atomic::write_if_absent(path, self.text(path)?.as_bytes())? {
            return Ok(());
        }
        Err(Baseline::exists(path))
    }

    /// Replaces `earlier`, which was read from the same file before measuring.
    ///
    /// # Errors
    /// If the file has changed since, or cannot be written.
    pub fn replace(&self, path: &Path, earlier: &Baseline) -> Result<(), FileError> {
        atomic::sweep_beside(path);
        // Other processes wait here until the file is replaced, if the file system has locks.
        let folder = path
            .parent()
            .and_then(|folder| std::fs::File::open(folder).ok());
        let _ = folder.as_ref().map(std::fs::File::lock);
        // Compared as text, because NaN equals NaN there.
        if Baseline::read(path)?.text(path)? != earlier.text(path)? {
            let name = path.file_stem().unwrap_or_default().to_string_lossy();
            let message = format!(
                "another process changed the baseline during this command; it was not updated. Try: shearq baseline check {name}"
            );
            return Err(FileError::new(path, message));
        }
        atomic::write(path, self.text(path)?.as_bytes())
    }

    /// The error for a new baseline whose file exists.
    pub fn exists(path: &Path) -> FileError {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        FileError::new(
            path,
            format!(
                "the baseline exists. Try: shearq baseline check {name} --update --reason TEXT"
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
    fn the_second_of_two_replacements_is_refused() {
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
            message.ends_with("mine.toml: another process changed the baseline during this command; it was not updated. Try: shearq baseline check mine"),
            "{message}"
        );
        assert_eq!(Baseline::read(&path).unwrap(), of(2));
    }
}
