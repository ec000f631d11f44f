//! A results store: a folder with one Parquet file per recorded run, one row per set.
//!
//! A file's name is made of what is in it, so that processes which write into one store never meet,
//! and recording the same run twice changes nothing. docs/formats.md describes the columns.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_scoring::{Figure, Figures};

use super::error::FileError;
use super::fingerprint::Fingerprint;
use crate::simulate::kinds::SetKind;

mod conditions;
#[cfg(feature = "parquet")]
mod parquet;
#[cfg(feature = "parquet")]
use parquet as file;

pub use conditions::Conditions;

/// The store of a build that can neither read nor write Parquet.
#[cfg(not(feature = "parquet"))]
mod file {
    use super::{FileError, Path, PathBuf, RunRecord};
    use crate::io::table::WITHOUT_PARQUET;

    pub fn prepare(store: &Path) -> Result<(), FileError> {
        Err(FileError::new(store, WITHOUT_PARQUET))
    }

    pub fn write(store: &Path, _run: &RunRecord) -> Result<PathBuf, FileError> {
        Err(FileError::new(store, WITHOUT_PARQUET))
    }

    pub fn read(path: &Path) -> Result<RunRecord, FileError> {
        Err(FileError::new(path, WITHOUT_PARQUET))
    }
}

/// What is kept of one set's score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetRecord {
    /// Set number.
    pub set: u32,
    /// Fingerprint of the set's data ([`super::fingerprint::of_set`]).
    pub data: String,
    /// Numbers of the images scored.
    pub images: Vec<u32>,
    /// Galaxies in their catalogues.
    pub galaxies: u64,
    /// Of these, without an ellipticity.
    pub flagged: u64,
    /// Figures of the chosen convention.
    pub figures: Figures,
    /// Their standard errors; not a number where unknown.
    pub errors: Figures,
    /// Q with each group of images left out in turn, for paired differences.
    pub q_replicates: Vec<f64>,
    /// The leaderboard's Q: the best of the eight conventions.
    pub q_leaderboard: f64,
    /// Number of the chosen convention.
    pub convention: u8,
    /// Whether it is known: told, or clearly matched to the truth, and not chosen by its Q.
    pub convention_known: bool,
    /// Number of the leaderboard's convention.
    pub convention_leaderboard: u8,
}

/// What is kept of one scored run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunRecord {
    /// Name of the submission, or of another program's catalogues.
    pub submission: String,
    /// Version of shearq.
    pub version: String,
    /// All settings, as TOML.
    pub settings: String,
    /// Settings of the simulation as JSON, or the fingerprint of a data folder.
    pub source: String,
    /// Bandpower definition.
    pub definition: String,
    /// Convention asked for: `matched`, `best` or a number.
    pub choice: String,
    /// `measured`, or the noise variance given.
    pub noise: String,
    /// The sets, in order.
    pub sets: Vec<SetRecord>,
}

/// A value of a stored row.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Words.
    Text(String),
    /// A real number; NaN where there is none.
    Real(f64),
    /// A number of things.
    Count(u64),
}

impl RunRecord {
    /// Fingerprint of what made the run: version, settings, data and the way of scoring, but not
    /// which sets and images. Parts of one run, from several processes, have it in common.
    pub fn id(&self) -> String {
        let RunRecord {
            submission,
            version,
            settings,
            source,
            definition,
            choice,
            noise,
            sets: _,
        } = self;
        let mut print = Fingerprint::default();
        for part in [
            submission, version, settings, source, definition, choice, noise,
        ] {
            print.add(part);
        }
        print.finish()
    }

    /// The columns of one set's row, in order: those of the file, of `--where` and of `--sort`.
    pub fn row(&self, set: &SetRecord) -> Vec<(String, Value)> {
        let text = |words: &str| Value::Text(words.to_owned());
        let kind = SetKind::of(set.set);
        let class =
            |of: fn(&SetKind) -> &'static str| Value::Text(kind.as_ref().map_or("", of).to_owned());
        let mut row = vec![
            ("run", Value::Text(self.id())),
            ("submission", text(&self.submission)),
            ("version", text(&self.version)),
            ("settings", text(&self.settings)),
            ("source", text(&self.source)),
            ("definition", text(&self.definition)),
            ("choice", text(&self.choice)),
            ("noise", text(&self.noise)),
            ("set", Value::Count(u64::from(set.set))),
            ("set_kind", class(|k| k.image.label())),
            ("psf", class(|k| k.psf.label())),
            ("psf_profile", class(|k| k.image.psf_profile())),
            ("ellipticity", class(|k| k.ellipticity.label())),
            ("snr", class(|k| k.image.snr_class())),
            ("size", class(|k| k.image.size_class())),
            ("data", text(&set.data)),
            ("images", Value::Count(set.images.len() as u64)),
            ("image_numbers", Value::Text(list(&set.images))),
            ("galaxies", Value::Count(set.galaxies)),
            ("flagged", Value::Count(set.flagged)),
        ]
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value))
        .collect::<Vec<_>>();
        let values = set.figures.values().into_iter().zip(set.errors.values());
        for (Figure { name, .. }, (value, error)) in Figures::ALL.iter().zip(values) {
            row.push(((*name).to_owned(), Value::Real(value)));
            row.push((format!("{name}_error"), Value::Real(error)));
        }
        row.extend(
            [
                ("q_leaderboard", Value::Real(set.q_leaderboard)),
                ("convention", Value::Count(u64::from(set.convention))),
                (
                    "convention_known",
                    Value::Count(u64::from(set.convention_known)),
                ),
                (
                    "convention_leaderboard",
                    Value::Count(u64::from(set.convention_leaderboard)),
                ),
                ("q_replicates", Value::Text(list(&set.q_replicates))),
            ]
            .map(|(name, value)| (name.to_owned(), value)),
        );
        row
    }
}

/// The value of a row's column.
///
/// # Errors
/// A message with the names there are, where there is no such column.
pub fn column<'a>(row: &'a [(String, Value)], name: &str) -> Result<&'a Value, String> {
    let found = row.iter().find(|(own, _)| own == name);
    found.map(|(_, value)| value).ok_or_else(|| {
        let names: Vec<&str> = row.iter().map(|(own, _)| own.as_str()).collect();
        format!(
            "the store has no column `{name}`; it has {}",
            names.join(", ")
        )
    })
}

/// Numbers as a JSON list, with all their digits; what is not finite is null.
fn list<T: ToString>(numbers: &[T]) -> String {
    let texts: Vec<String> = numbers
        .iter()
        .map(|number| match number.to_string() {
            text if text.contains("NaN") || text.contains("inf") => "null".into(),
            text => text,
        })
        .collect();
    format!("[{}]", texts.join(","))
}

/// Makes the folder of a store, so that a long run does not find out at its end that it cannot.
///
/// # Errors
/// Where it cannot be made, or this build has no Parquet.
pub fn prepare(store: &Path) -> Result<(), FileError> {
    file::prepare(store)
}

/// Records a run; the file it is now in.
///
/// # Errors
/// Where the file cannot be written, or this build has no Parquet.
pub fn write(store: &Path, run: &RunRecord) -> Result<PathBuf, FileError> {
    file::write(store, run)
}

/// All runs of a store, by submission and id, and what should be known about them.
///
/// Where several files hold the same set of the same run, the one with most images counts: the
/// others are earlier looks at it.
///
/// # Errors
/// Where there is no such folder, or a Parquet file in it is not one of a store.
pub fn read(store: &Path) -> Result<(Vec<RunRecord>, Vec<String>), FileError> {
    let entries = std::fs::read_dir(store)
        .and_then(Iterator::collect::<std::io::Result<Vec<_>>>)
        .map_err(FileError::doing(store, "cannot read the results store"))?;
    let mut paths: Vec<PathBuf> = entries
        .into_iter()
        .map(|entry| entry.path())
        .filter(|path| {
            let hidden = path
                .file_name()
                .is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
            !hidden && path.extension().is_some_and(|ending| ending == "parquet")
        })
        .collect();
    paths.sort();
    let mut runs: BTreeMap<(String, String), RunRecord> = BTreeMap::new();
    let mut notes = Vec::new();
    for path in paths {
        let run = file::read(&path)?;
        match runs.entry((run.submission.clone(), run.id())) {
            Entry::Vacant(place) => {
                place.insert(run);
            }
            Entry::Occupied(mut place) => merge(place.get_mut(), run, &path, &mut notes),
        }
    }
    Ok((runs.into_values().collect(), notes))
}

/// Adds the sets of another file of the same run.
fn merge(run: &mut RunRecord, more: RunRecord, path: &Path, notes: &mut Vec<String>) {
    for set in more.sets {
        match run.sets.iter_mut().find(|own| own.set == set.set) {
            None => run.sets.push(set),
            Some(own) => {
                if own.images.len() == set.images.len() {
                    notes.push(format!(
                        "Warning: {} holds set {} of a run that another file holds too, with other results on as many images; that other one counts.",
                        path.display(),
                        set.set
                    ));
                } else if own.images.len() < set.images.len() {
                    *own = set;
                }
            }
        }
    }
    run.sets.sort_by_key(|set| set.set);
}
