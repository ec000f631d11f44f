//! Records of scored sets and runs.

use std::borrow::Borrow;
use std::path::Path;

use serde::{Deserialize, Serialize};
use shearq_files::frames::TableError;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::{
    Choice, Convention, Definition, Metric, Metrics, Noise, Options, SpectrumScore,
};
use shearq_submissions::check_name;

use super::score::ScoredSet;
use shearq_dataset::fingerprint::{self, Fingerprint};
use shearq_dataset::layout::DataFolder;
use shearq_dataset::record::nan_for_null;
use shearq_dataset::run::{Run, Source};
use shearq_files::FileError;
use shearq_files::table::MAX_ROWS;
use shearq_pipeline::PipelineError;
use shearq_simulate::kinds::SetKind;

/// Record of one set's score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetRecord {
    /// Set number.
    pub set: u32,
    /// Whether the set was simulated; its number then gives its kind. The default is true.
    #[serde(default = "yes")]
    pub simulated: bool,
    /// Fingerprint of the set's data ([`fingerprint::of_set`]).
    pub data: String,
    /// Numbers of the scored images.
    pub images: Vec<u32>,
    /// Galaxies in their catalogues.
    pub galaxies: u64,
    /// Number of these galaxies without an ellipticity.
    pub flagged: u64,
    /// Metrics of the chosen convention.
    pub metrics: Metrics,
    /// Standard errors of the metrics; NaN if unknown.
    pub errors: Metrics,
    /// Q with each group of images left out in turn, for paired differences.
    pub q_replicates: Vec<f64>,
    /// Calibrated Q with each group left out.
    #[serde(deserialize_with = "nan_for_null")]
    pub q_calibrated_replicates: Vec<f64>,
    /// Q of the leaderboard: the highest of the eight conventions.
    pub q_leaderboard: f64,
    /// Number of the chosen convention.
    pub convention: u8,
    /// Whether the convention is certain: given, or clearly matched to the truth.
    pub convention_known: bool,
    /// Number of the leaderboard's convention.
    pub convention_leaderboard: u8,
}

fn yes() -> bool {
    true
}

impl SetRecord {
    /// The kind of a simulated set.
    pub fn kind(&self) -> Option<SetKind> {
        SetKind::of(self.set).filter(|_| self.simulated)
    }

    /// Record of the scored set `set`, whose data have the fingerprint `data`.
    pub fn new(set: u32, scored: &ScoredSet, data: String) -> Self {
        let ScoredSet {
            set: _,
            kind,
            images,
            score,
            rows,
            basis,
            sign: _,
            findings: _,
            odd_images: _,
        } = scored;
        SetRecord {
            set,
            simulated: kind.is_some(),
            data,
            images: images.clone(),
            galaxies: (rows.used + rows.not_finite) as u64,
            flagged: rows.not_finite as u64,
            metrics: score.metrics,
            errors: score.errors,
            q_replicates: score.replicates.iter().map(|r| r.q).collect(),
            q_calibrated_replicates: score.replicates.iter().map(|r| r.q_calibrated).collect(),
            q_leaderboard: score.conventions[score.best.index()].quality.q,
            convention: score.chosen.number(),
            convention_known: basis.is_known(),
            convention_leaderboard: score.best.number(),
        }
    }

    /// Record of the power spectrum of set `set`, made from `images`. Catalogues alone have the other metrics.
    pub fn of_spectrum(
        set: u32,
        simulated: bool,
        score: &SpectrumScore,
        images: Vec<u32>,
        data: String,
    ) -> Self {
        let (mut metrics, mut errors) = (Metrics::unknown(), Metrics::unknown());
        metrics.q = score.quality.q;
        metrics.m_half = score.m_half;
        metrics.sqrt_a = score.sqrt_a;
        metrics.sigma_sys_1e4 = score.quality.sigma_sys * 1e4;
        errors.q = score.quality_error;
        errors.m_half = score.m_half_error;
        errors.sqrt_a = score.sqrt_a_error;
        let standard = Convention::STANDARD.number();
        SetRecord {
            set,
            simulated,
            data,
            images,
            galaxies: 0,
            flagged: 0,
            metrics,
            errors,
            q_replicates: Vec::new(),
            q_calibrated_replicates: Vec::new(),
            q_leaderboard: score.quality.q,
            convention: standard,
            convention_known: true,
            convention_leaderboard: standard,
        }
    }
}

/// Record of a scored run.
#[derive(Debug, Clone, PartialEq)]
pub struct RunRecord {
    /// Name of the configuration, or of another program's catalogues.
    pub configuration: String,
    /// Version of shearq.
    pub version: String,
    /// All settings, as TOML.
    pub settings: String,
    /// Settings of the simulation as JSON, or the fingerprint of a data folder.
    pub source: String,
    /// Bandpower definition.
    pub definition: String,
    /// Choice of the convention: `matched`, `best` or a number.
    pub choice: String,
    /// `measured`, or the given noise variance.
    pub noise: String,
    /// The sets, in order.
    pub sets: Vec<SetRecord>,
}

/// Name of a bandpower definition in records.
pub fn definition_word(definition: Definition) -> &'static str {
    match definition {
        Definition::Leaderboard => "leaderboard",
        Definition::Corrected => "corrected",
    }
}

/// Name of a choice of a convention in records.
pub(super) fn choice_word(choice: Choice) -> String {
    match choice {
        Choice::Matched => "matched".into(),
        Choice::Best => "best".into(),
        Choice::Insist(convention) => convention.number().to_string(),
    }
}

/// Configuration and data of a measurement.
#[derive(Debug, Clone)]
pub struct Measured<'a> {
    /// Name of the configuration, or of another program's catalogues.
    pub name: &'a str,
    /// All settings, as TOML.
    pub settings: String,
    /// Source of the galaxies.
    pub source: &'a Source,
    /// Data folder with the true shear.
    pub data: &'a DataFolder,
}

impl<'a> Measured<'a> {
    /// A run of shearq.
    ///
    /// # Errors
    /// If the settings cannot be written as TOML.
    pub fn run(run: &'a Run, data: &'a DataFolder, folder: &Path) -> Result<Self, FileError> {
        let settings = toml::to_string(&run.configuration)
            .map_err(FileError::doing(folder, "cannot store the settings"))?;
        Ok(Measured {
            name: &run.configuration.name,
            settings,
            source: &run.source,
            data,
        })
    }
}

impl RunRecord {
    /// The record of a scored run.
    ///
    /// # Errors
    /// If the data cannot be read for their fingerprint.
    pub fn new(
        measured: Measured<'_>,
        scored: &[ScoredSet],
        options: Options,
    ) -> Result<Self, PipelineError> {
        let Measured { source, data, .. } = measured;
        let sets = scored
            .iter()
            // Plain files have no set number.
            .filter_map(|scored| Some((scored.set?, scored)))
            .map(|(set, scored)| {
                let print = fingerprint::of_set(source, data, set, &scored.images)?;
                Ok(SetRecord::new(set, scored, print))
            })
            .collect::<Result<_, FileError>>()?;
        RunRecord::of_records(measured, sets, options)
    }

    /// The record of a run with the records of its sets.
    ///
    /// # Errors
    /// As [`RunRecord::new`].
    pub fn of_records(
        measured: Measured<'_>,
        sets: Vec<SetRecord>,
        options: Options,
    ) -> Result<Self, PipelineError> {
        let Measured {
            name,
            settings,
            source,
            data,
        } = measured;
        Ok(RunRecord {
            configuration: name.to_owned(),
            version: shearq_dataset::VERSION.into(),
            settings,
            source: match source {
                Source::Simulated(settings) => serde_json::to_string(settings)
                    .map_err(FileError::doing(data.root(), "cannot store the settings"))?,
                Source::Folder { .. } => fingerprint::of_source(source, data)?,
            },
            definition: definition_word(options.definition).into(),
            choice: choice_word(options.choice),
            noise: match options.noise {
                Noise::Measured => "measured".into(),
                Noise::Given(variance) => variance.to_string(),
            },
            sets,
        })
    }

    /// Fingerprint of version, settings, data and way of scoring, but not of sets and images. Shards of a run share
    /// it.
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
        for part in [
            configuration,
            version,
            settings,
            source,
            definition,
            choice,
            noise,
        ] {
            print.add(part);
        }
        print.finish()
    }

    /// The run whose sets are the rows of the table in `path`.
    ///
    /// # Errors
    /// If a column is absent or has another type, or the rows belong to several runs.
    pub fn from_table(table: &DataFrame, path: &Path) -> Result<Self, FileError> {
        let rows = Rows { path, table };
        let text = |name| rows.text(name, 0).map(str::to_owned);
        let configuration = text("submission")?;
        check_name(&configuration).map_err(|error| FileError::new(path, error.to_string()))?;
        let run = RunRecord {
            configuration,
            version: text("version")?,
            settings: text("settings")?,
            source: text("source")?,
            definition: text("definition")?,
            choice: text("choice")?,
            noise: text("noise")?,
            sets: (0..table.height())
                .map(|row| rows.set(row))
                .collect::<Result<_, _>>()?,
        };
        for row in 0..table.height() {
            let found = rows.text("run", row)?;
            if found != run.id() {
                let message = format!(
                    "row {}: `run` disagrees with the other columns (found {found}, expected {}). Was the file edited?",
                    row + 1,
                    run.id()
                );
                return Err(FileError::new(path, message));
            }
        }
        Ok(run)
    }
}

/// The table of a store, with a row per set of each run.
///
/// # Errors
/// If polars cannot make the table.
pub fn table_of(runs: &[RunRecord]) -> Result<DataFrame, TableError> {
    let ids: Vec<String> = runs.iter().map(RunRecord::id).collect();
    let rows: Vec<(&RunRecord, &str, &SetRecord)> = runs
        .iter()
        .zip(&ids)
        .flat_map(|(run, id)| run.sets.iter().map(move |set| (run, id.as_str(), set)))
        .collect();
    let of_run = |name: &str, value: &dyn Fn(&RunRecord) -> &str| {
        let values: Vec<&str> = rows.iter().map(|row| value(row.0)).collect();
        Column::new(name.into(), values)
    };
    let kind = |name: &str, value: &dyn Fn(&SetKind) -> &'static str| {
        let values = rows
            .iter()
            .map(|row| row.2.kind().as_ref().map_or("", value));
        Column::new(name.into(), values.collect::<Vec<&str>>())
    };
    let text = |name: &str, value: &dyn Fn(&SetRecord) -> String| {
        let values: Vec<String> = rows.iter().map(|row| value(row.2)).collect();
        Column::new(name.into(), values)
    };
    let count = |name: &str, value: &dyn Fn(&SetRecord) -> u64| {
        let values: Vec<i64> = rows.iter().map(|row| value(row.2) as i64).collect();
        Column::new(name.into(), values)
    };
    let real = |name: &str, value: &dyn Fn(&SetRecord) -> f64| {
        let values: Vec<f64> = rows.iter().map(|row| value(row.2)).collect();
        Column::new(name.into(), values)
    };
    let run_ids: Vec<&str> = rows.iter().map(|row| row.1).collect();
    let mut columns = vec![
        Column::new("run".into(), run_ids),
        of_run("submission", &|run| &run.configuration),
        of_run("version", &|run| &run.version),
        of_run("settings", &|run| &run.settings),
        of_run("source", &|run| &run.source),
        of_run("definition", &|run| &run.definition),
        of_run("choice", &|run| &run.choice),
        of_run("noise", &|run| &run.noise),
        count("set", &|set| u64::from(set.set)),
        kind("set_kind", &|kind| kind.image.label()),
        kind("psf", &|kind| kind.psf.label()),
        kind("psf_profile", &|kind| kind.image.psf_profile()),
        kind("ellipticity", &|kind| kind.ellipticity.label()),
        kind("snr", &|kind| kind.image.snr_class()),
        kind("size", &|kind| kind.image.size_class()),
        text("data", &|set| set.data.clone()),
        count("images", &|set| set.images.len() as u64),
        text("image_numbers", &|set| list(&set.images)),
        count("galaxies", &|set| set.galaxies),
        count("flagged", &|set| set.flagged),
    ];
    for (k, Metric { name, .. }) in Metrics::ALL.iter().enumerate() {
        columns.push(real(name, &|set| set.metrics.values()[k]));
        columns.push(real(&error_of(name), &|set| set.errors.values()[k]));
    }
    columns.extend([
        real("q_leaderboard", &|set| set.q_leaderboard),
        count("convention", &|set| u64::from(set.convention)),
        count("convention_known", &|set| u64::from(set.convention_known)),
        count("convention_leaderboard", &|set| {
            u64::from(set.convention_leaderboard)
        }),
        text("q_replicates", &|set| list(&set.q_replicates)),
        text("q_calibrated_replicates", &|set| {
            list(&set.q_calibrated_replicates)
        }),
    ]);
    shearq_files::frames::frame(columns)
}

/// Name of the column with the standard errors of a metric.
fn error_of(metric: &str) -> String {
    format!("{metric}_error")
}

/// Numbers as a JSON list with all digits; numbers that are not finite become null.
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

/// Rows of a file's table.
struct Rows<'a> {
    path: &'a Path,
    table: &'a DataFrame,
}

impl Rows<'_> {
    fn wrong(&self, name: &str, row: usize, expected: &str) -> FileError {
        let message = format!("row {}: column `{name}`: expected a {expected}", row + 1);
        FileError::new(self.path, message)
    }

    fn text(&self, name: &str, row: usize) -> Result<&str, FileError> {
        let column = self.table.column(name).ok();
        column
            .and_then(|column| column.str().ok()?.get(row))
            .ok_or_else(|| self.wrong(name, row, "text"))
    }

    fn real(&self, name: &str, row: usize) -> Result<f64, FileError> {
        let column = self.table.column(name).ok();
        column
            .and_then(|column| column.f64().ok()?.get(row))
            .ok_or_else(|| self.wrong(name, row, "real number"))
    }

    fn count<T: TryFrom<i64>>(&self, name: &str, row: usize) -> Result<T, FileError> {
        let column = self.table.column(name).ok();
        column
            .and_then(|column| T::try_from(column.i64().ok()?.get(row)?).ok())
            .ok_or_else(|| self.wrong(name, row, "number in the range of counts"))
    }

    /// Numbers of a JSON list; null becomes NaN.
    fn list<T: std::str::FromStr>(&self, name: &str, row: usize) -> Result<Vec<T>, FileError> {
        let text = self.text(name, row)?;
        text.strip_prefix('[')
            .and_then(|rest| rest.strip_suffix(']'))
            .and_then(|inner| {
                let numbers = inner.split(',').filter(|part| !part.is_empty());
                numbers
                    .map(|part| if part == "null" { "NaN" } else { part })
                    .map(|part| part.parse().ok())
                    .collect()
            })
            .ok_or_else(|| self.wrong(name, row, "list of numbers"))
    }

    fn set(&self, row: usize) -> Result<SetRecord, FileError> {
        let metrics = |column: &dyn Fn(&str) -> String| -> Result<Metrics, FileError> {
            let mut values = [f64::NAN; Metrics::ALL.len()];
            for (value, Metric { name, .. }) in values.iter_mut().zip(Metrics::ALL) {
                let name = column(name);
                if name == column(Metrics::ALWAYS) || self.table.column(&name).is_ok() {
                    *value = self.real(&name, row)?;
                }
            }
            Ok(Metrics::from_values(values))
        };
        let images: Vec<u32> = self.list("image_numbers", row)?;
        // Larger numbers would overflow sums.
        let at_most = |name: &str, most: u64| match self.count::<u64>(name, row)? {
            found if found <= most => Ok(found),
            found => {
                let message = format!(
                    "row {}: column `{name}` is {found}; expected at most {most}",
                    row + 1
                );
                Err(FileError::new(self.path, message))
            }
        };
        at_most("images", images.len() as u64)?;
        let galaxies = at_most("galaxies", images.len() as u64 * MAX_ROWS as u64)?;
        Ok(SetRecord {
            set: self.count("set", row)?,
            simulated: self
                .text("set_kind", row)
                .is_ok_and(|kind| !kind.is_empty()),
            data: self.text("data", row)?.to_owned(),
            images,
            galaxies,
            flagged: at_most("flagged", galaxies)?,
            metrics: metrics(&str::to_owned)?,
            errors: metrics(&error_of)?,
            q_replicates: self.list("q_replicates", row)?,
            q_calibrated_replicates: self.list("q_calibrated_replicates", row)?,
            q_leaderboard: self.real("q_leaderboard", row)?,
            convention: self.count("convention", row)?,
            convention_known: self.count::<u8>("convention_known", row)? > 0,
            convention_leaderboard: self.count("convention_leaderboard", row)?,
        })
    }
}

/// Mean of the metric called `name` over sets, and its error.
pub fn mean_metric<R: Borrow<SetRecord>>(sets: &[R], name: &str) -> (f64, f64) {
    let value =
        |metrics: &Metrics| Metrics::place(name).map_or(f64::NAN, |place| metrics.values()[place]);
    let pairs: Vec<(f64, f64)> = sets
        .iter()
        .map(Borrow::borrow)
        .map(|set| (value(&set.metrics), value(&set.errors)))
        .collect();
    mean_over_sets(&pairs)
}
