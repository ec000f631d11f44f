//! The record of a scored set, with the one list of its columns: conditions are met and tables printed by it.
//! docs/stores.md describes the columns, and the keys of the JSON, which are the fields of the structs.

use std::collections::BTreeSet;
use std::fmt::Display;
use std::str::FromStr;

use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use shearq_dataset::fingerprint::{self, Fingerprint};
use shearq_dataset::layout::{DataFolder, MAX_SET};
use shearq_dataset::run::{Source, nan_for_null};
use shearq_files::FileError;
use shearq_files::table::MAX_ROWS;
use shearq_quantities::Frame;
use shearq_render::table::Cell;
use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::{
    Choice, Convention, Definition, Metric, Metrics, Noise, Options, RowCounts, SetScore,
    SpectrumScore,
};
use shearq_simulate::kinds::SetKind;
use shearq_submissions::checked_name;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetRecord {
    /// 0 for plain files, which have no number.
    pub set: u32,
    /// Whether the set was simulated; its number then gives its kind.
    pub simulated: bool,
    /// [`fingerprint::of_set`], empty unless the record is stored.
    pub data: String,
    pub images: Vec<u32>,
    pub galaxies: u64,
    /// Galaxies without an ellipticity.
    pub flagged: u64,
    /// The axes of the ellipticities.
    #[serde(default, skip_serializing_if = "is_pixel")]
    pub frame: Frame,
    /// Metrics of the chosen convention.
    pub metrics: Metrics,
    pub errors: Metrics,
    /// Q with each group of images left out in turn, for paired differences.
    #[serde(deserialize_with = "nan_for_null")]
    pub q_replicates: Vec<f64>,
    #[serde(deserialize_with = "nan_for_null")]
    pub q_calibrated_replicates: Vec<f64>,
    /// The highest Q of the eight conventions.
    #[serde(deserialize_with = "nan_for_null")]
    pub q_leaderboard: f64,
    pub convention: Convention,
    /// Whether the convention was given or clearly matched to the truth. Differences from other records are
    /// meaningless otherwise.
    pub convention_known: bool,
    pub convention_leaderboard: Convention,
}

fn is_pixel(frame: &Frame) -> bool {
    *frame == Frame::Pixel
}

impl SetRecord {
    pub fn kind(&self) -> Option<SetKind> {
        SetKind::of(self.set).filter(|_| self.simulated)
    }

    /// The record of these images in the convention that `score` chose, without a fingerprint of its data.
    pub fn new(
        set: u32,
        simulated: bool,
        images: Vec<u32>,
        score: &SetScore,
        rows: &RowCounts,
        convention_known: bool,
    ) -> Self {
        SetRecord {
            simulated,
            images,
            galaxies: (rows.used + rows.not_finite) as u64,
            flagged: rows.not_finite as u64,
            metrics: score.metrics,
            errors: score.errors,
            q_replicates: score.replicates.iter().map(|r| r.q).collect(),
            q_calibrated_replicates: score.replicates.iter().map(|r| r.q_calibrated).collect(),
            // Without true power, Q of every convention is a measure of noise.
            q_leaderboard: match score.constant {
                None => score.conventions[score.best.index()].quality.q,
                Some(_) => f64::NAN,
            },
            convention: score.chosen,
            convention_known,
            convention_leaderboard: score.best,
            ..SetRecord::unknown(set)
        }
    }

    pub fn of_spectrum(set: u32, simulated: bool, images: Vec<u32>, score: &SpectrumScore) -> Self {
        SetRecord {
            simulated,
            images,
            metrics: score.metrics,
            errors: score.errors,
            q_leaderboard: score.metrics.q,
            ..SetRecord::unknown(set)
        }
    }

    /// A record without images and galaxies, whose metrics are unknown, in the standard convention.
    pub fn unknown(set: u32) -> Self {
        SetRecord {
            set,
            simulated: false,
            data: String::new(),
            images: Vec::new(),
            galaxies: 0,
            flagged: 0,
            frame: Frame::Pixel,
            metrics: Metrics::unknown(),
            errors: Metrics::unknown(),
            q_replicates: Vec::new(),
            q_calibrated_replicates: Vec::new(),
            q_leaderboard: f64::NAN,
            convention: Convention::STANDARD,
            convention_known: true,
            convention_leaderboard: Convention::STANDARD,
        }
    }
}

/// The sets of one configuration, scored in one way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// Name of the configuration, or of another program's catalogues.
    // Stores come from others, and names end up on terminals and in file names.
    #[serde(deserialize_with = "checked_name")]
    pub configuration: String,
    pub version: String,
    /// TOML, or where the catalogues are.
    pub settings: String,
    /// Settings of the simulation as JSON, or the fingerprint of a data folder.
    pub source: String,
    pub definition: Definition,
    #[serde(with = "as_text")]
    pub choice: Choice,
    #[serde(with = "as_text")]
    pub noise: Noise,
    /// In ascending order.
    pub sets: Vec<SetRecord>,
}

mod as_text {
    use super::*;

    pub fn serialize<T: Display, S: Serializer>(
        value: &T,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_str(value)
    }

    pub fn deserialize<'de, T, D>(deserializer: D) -> Result<T, D::Error>
    where
        T: FromStr<Err: Display>,
        D: Deserializer<'de>,
    {
        let text = String::deserialize(deserializer)?;
        let wrong = |expected| D::Error::custom(format_args!("found `{text}`, {expected}"));
        text.parse().map_err(wrong)
    }
}

impl RunRecord {
    pub fn new(
        configuration: &str,
        settings: &str,
        source: String,
        options: Options,
        sets: Vec<SetRecord>,
    ) -> Self {
        RunRecord {
            configuration: configuration.to_owned(),
            version: shearq_dataset::VERSION.into(),
            settings: settings.to_owned(),
            source,
            definition: options.definition,
            choice: options.choice,
            noise: options.noise,
            sets,
        }
    }

    /// The record with fingerprints of its data, by which a store recognises results that can be paired. They are
    /// hashes of all truths and images, which only a store is worth.
    pub fn with_fingerprints(
        mut self,
        source: &Source,
        data: &DataFolder,
    ) -> Result<Self, FileError> {
        self.source = match source {
            Source::Simulated(settings) => serde_json::to_string(settings)
                .map_err(FileError::doing(data.root(), "cannot store the settings"))?,
            Source::Folder { .. } => fingerprint::of_source(source, data)?,
        };
        for set in &mut self.sets {
            set.data = fingerprint::of_set(source, data, set.set, &set.images)?;
        }
        Ok(self)
    }

    /// The first digits of the id, enough to distinguish the runs of a store.
    pub fn short_id(&self) -> String {
        self.id().chars().take(8).collect()
    }

    pub fn name_with_id(&self) -> String {
        format!("{} {}", self.configuration, self.short_id())
    }

    /// Fingerprint of version, settings, data and way of scoring, but not of sets and images: shards of a run share it.
    pub fn id(&self) -> String {
        let RunRecord {
            configuration,
            version,
            settings,
            source,
            definition,
            choice,
            noise,
            sets: _,
        } = self;
        let mut print = Fingerprint::default();
        for part in [configuration, version, settings, source] {
            print.add(part);
        }
        print.add(definition.to_string());
        print.add(choice.to_string());
        print.add(noise.to_string());
        print.finish()
    }

    /// Checks what no type excludes. Records are easily edited, and a mean over impossible values looks like any other.
    pub fn check(&self) -> Result<(), String> {
        if self.sets.is_empty() {
            return Err("the run has no sets".into());
        }
        let mut numbers = BTreeSet::new();
        for set in &self.sets {
            let number = set.set;
            if number > MAX_SET || !numbers.insert(number) {
                return Err(format!(
                    "found set {number} twice, or above {MAX_SET}; expected every set once"
                ));
            }
            let images: BTreeSet<_> = set.images.iter().collect();
            // Sums over sets would overflow with counts that no images can have.
            let most = (images.len() * MAX_ROWS) as u64;
            if set.galaxies > most || set.flagged > set.galaxies {
                return Err(format!(
                    "set {number}: found {} galaxies, {} of them flagged; expected at most {most}",
                    set.galaxies, set.flagged
                ));
            }
            if images.len() < set.images.len() {
                return Err(format!(
                    "set {number}: found an image twice; expected each once"
                ));
            }
            let negative = |metric: &&Metric| (metric.value)(&set.errors) < 0.0;
            if let Some(metric) = Metrics::ALL.iter().find(negative) {
                return Err(format!(
                    "set {number}: the error of {} is {}; expected zero or a positive number",
                    metric.name,
                    (metric.value)(&set.errors)
                ));
            }
        }
        Ok(())
    }
}

/// A column of the tables that are printed from records, and of conditions on these.
#[derive(Debug, Clone, Copy)]
pub struct Column {
    pub name: &'static str,
    pub heading: &'static str,
    value: Value,
}

// The type of a column. It determines how a cell shows several sets.
#[derive(Debug, Clone, Copy)]
enum Value {
    /// The same for all sets.
    OfRun(fn(&RunRecord) -> String),
    /// The text of the first set.
    Text(fn(&SetRecord) -> String),
    /// The sum.
    Count(fn(&SetRecord) -> u64),
    /// The mean.
    Real(fn(&SetRecord) -> f64),
    /// The mean with its error.
    Metric(Metric),
    /// The error, in conditions alone.
    Error(fn(&Metrics) -> f64),
}

const fn column(name: &'static str, heading: &'static str, value: Value) -> Column {
    Column {
        name,
        heading,
        value,
    }
}

const fn of_run(
    name: &'static str,
    heading: &'static str,
    value: fn(&RunRecord) -> String,
) -> Column {
    column(name, heading, Value::OfRun(value))
}

const fn text(
    name: &'static str,
    heading: &'static str,
    value: fn(&SetRecord) -> String,
) -> Column {
    column(name, heading, Value::Text(value))
}

const fn count(name: &'static str, heading: &'static str, value: fn(&SetRecord) -> u64) -> Column {
    column(name, heading, Value::Count(value))
}

fn kind(set: &SetRecord, label: fn(&SetKind) -> &'static str) -> String {
    set.kind().as_ref().map_or("", label).to_owned()
}

/// The column of the frame, which tables have if it is not that of the pixels.
pub const FRAME: &str = "frame";

const BEFORE_METRICS: [Column; 20] = [
    of_run("run", "Run", RunRecord::id),
    of_run("submission", "Configuration", |run| {
        run.configuration.clone()
    }),
    of_run("version", "Version", |run| run.version.clone()),
    of_run("settings", "Settings", |run| run.settings.clone()),
    of_run("source", "Source", |run| run.source.clone()),
    of_run("definition", "Definition", |run| run.definition.to_string()),
    of_run("choice", "Choice", |run| run.choice.to_string()),
    of_run("noise", "Noise", |run| run.noise.to_string()),
    count("set", "Set", |set| set.set.into()),
    text("data", "Data", |set| set.data.clone()),
    text("set_kind", "Kind", |set| kind(set, |k| k.image.label())),
    text("psf", "PSF", |set| kind(set, |k| k.psf.label())),
    text("psf_profile", "PSF profile", |set| {
        kind(set, |k| k.image.psf_profile())
    }),
    text("ellipticity", "Ellipticity", |set| {
        kind(set, |k| k.ellipticity.label())
    }),
    text("snr", "S/N", |set| kind(set, |k| k.image.snr_class())),
    text("size", "Size", |set| kind(set, |k| k.image.size_class())),
    count("images", "Images", |set| set.images.len() as u64),
    count("galaxies", "Galaxies", |set| set.galaxies),
    count("flagged", "Flagged", |set| set.flagged),
    text(FRAME, "Frame", |set| set.frame.to_string()),
];

const AFTER_METRICS: [Column; 4] = [
    column(
        "q_leaderboard",
        "Q leaderboard",
        Value::Real(|set| set.q_leaderboard),
    ),
    count("convention", "Conv.", |set| set.convention.number().into()),
    count("convention_known", "Conv. known", |set| {
        set.convention_known.into()
    }),
    count("convention_leaderboard", "Conv. leaderboard", |set| {
        set.convention_leaderboard.number().into()
    }),
];

pub fn columns() -> impl Iterator<Item = Column> {
    let metrics = Metrics::ALL
        .into_iter()
        .map(|metric| column(metric.name, metric.heading, Value::Metric(metric)));
    BEFORE_METRICS
        .into_iter()
        .chain(metrics)
        .chain(AFTER_METRICS)
}

/// The columns called `names`, in this order.
pub fn columns_named(names: &[&str]) -> Vec<Column> {
    let named = |name: &&str| columns().find(|column| column.name == *name);
    names.iter().filter_map(named).collect()
}

/// The columns that conditions name: all, and the error of each metric, such as `q_error`.
pub fn compared() -> impl Iterator<Item = (String, Column)> {
    columns().flat_map(|own| {
        let error = match own.value {
            Value::Metric(Metric { value, .. }) => {
                let value = Value::Error(value);
                Some((format!("{}_error", own.name), Column { value, ..own }))
            }
            _ => None,
        };
        [(own.name.to_owned(), own)].into_iter().chain(error)
    })
}

// The mean of a text or a convention over sets has no meaning, so that such columns are printed for single sets and for
// groups in which they are equal.
impl Column {
    pub fn is_text(&self) -> bool {
        matches!(self.value, Value::OfRun(_) | Value::Text(_))
    }

    /// The text of a set; `None` in a column of numbers.
    pub fn text(&self, run: &RunRecord, set: &SetRecord) -> Option<String> {
        match self.value {
            Value::OfRun(value) => Some(value(run)),
            Value::Text(value) => Some(value(set)),
            _ => None,
        }
    }

    /// The number of a set; `None` in a column of texts.
    pub fn number(&self, set: &SetRecord) -> Option<f64> {
        match self.value {
            Value::OfRun(_) | Value::Text(_) => None,
            Value::Count(value) => Some(value(set) as f64),
            Value::Real(value) => Some(value(set)),
            Value::Metric(metric) => Some((metric.value)(&set.metrics)),
            Value::Error(value) => Some(value(&set.errors)),
        }
    }

    /// The cell of the sets of `run`.
    pub fn cell(&self, run: &RunRecord) -> Cell {
        match self.value {
            Value::OfRun(value) => Cell::text(value(run)),
            _ => self.cell_of_sets(&run.sets),
        }
    }

    /// The cell of sets, empty for a column of runs.
    pub fn cell_of_sets(&self, sets: &[SetRecord]) -> Cell {
        let count = sets.len() as f64;
        match self.value {
            Value::OfRun(_) | Value::Error(_) => Cell::Empty,
            Value::Text(value) => sets
                .first()
                .map_or(Cell::Empty, |set| Cell::text(value(set))),
            Value::Count(value) => Cell::number(sets.iter().map(value).sum::<u64>() as f64, 0),
            Value::Real(value) => Cell::number(sets.iter().map(value).sum::<f64>() / count, 2),
            Value::Metric(metric) => {
                let (value, error) = mean(sets, metric.value);
                Cell::with_error(value, Some(error), metric.decimals)
            }
        }
    }
}

/// Mean of a metric over sets, and its error.
pub fn mean(sets: &[SetRecord], metric: fn(&Metrics) -> f64) -> (f64, f64) {
    let pairs: Vec<(f64, f64)> = sets
        .iter()
        .map(|set| (metric(&set.metrics), metric(&set.errors)))
        .collect();
    mean_over_sets(&pairs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_read_back_from_json() {
        let read = |record: &SetRecord| -> SetRecord {
            serde_json::from_str(&serde_json::to_string(record).unwrap()).unwrap()
        };
        let metrics =
            |first: u8| Metrics::from_values(std::array::from_fn(|k| f64::from(first) + k as f64));
        // No value is that of a record of unknown metrics.
        let record = SetRecord {
            set: 20,
            simulated: true,
            data: "d".into(),
            images: vec![1, 3],
            galaxies: 6,
            flagged: 2,
            frame: Frame::Sky,
            metrics: metrics(30),
            errors: metrics(60),
            q_replicates: vec![7.0],
            q_calibrated_replicates: vec![8.0, 9.0],
            q_leaderboard: 10.0,
            convention: Convention::ALL[1],
            convention_known: false,
            convention_leaderboard: Convention::ALL[2],
        };
        assert_eq!(read(&record), record);
        let unknown = read(&SetRecord {
            q_calibrated_replicates: vec![f64::NAN],
            ..SetRecord::unknown(20)
        });
        assert!(unknown.q_leaderboard.is_nan() && unknown.q_calibrated_replicates[0].is_nan());
    }
}
