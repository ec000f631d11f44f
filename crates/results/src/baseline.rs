//! Baselines: accepted metrics, in a TOML file. A later measurement has to repeat them: of configurations up to rounding, with the
//! settings and data that the file states; of [`catalogues`] of any code within a tolerance.

pub mod catalogues;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_dataset::fingerprint;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source, differences, shortened};
use shearq_dataset::threads::Pool;
use shearq_files::table::{self, MAX_ROWS};
use shearq_files::{FileError, atomic};
use shearq_quantities::{hints, tried};
use shearq_render::table::{Cell, Table};
use shearq_scoring::{Metric, Metrics, Options};
use shearq_submissions::{Configuration, ConfigurationError, Registry, checked_name};
use thiserror::Error;

use crate::catalogues::{Catalogues, OWN};
use crate::record::SetRecord;
use crate::response::response_of;
use crate::score::{ScoreError, score_catalogues};

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baseline {
    pub version: String,
    /// Number of sets of all configurations, to detect a truncated file.
    pub sets_held: usize,
    pub source: Source,
    pub submissions: Vec<BaselineConfiguration>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineConfiguration {
    #[serde(deserialize_with = "checked_name")]
    pub name: String,
    /// Configuration file, relative to the folder of the baseline. `None` for a named configuration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// All settings as a TOML table, so that settings of other versions can be compared.
    pub settings: toml::Table,
    pub sets: Vec<BaselineSet>,
}

impl BaselineConfiguration {
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

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BaselineSet {
    pub set: u32,
    // Compared first: other data have other noise, so that metrics may differ by standard errors.
    pub data: String,
    pub images: Vec<u32>,
    pub galaxies: u64,
    /// Number of these galaxies without an ellipticity.
    pub flagged: u64,
    /// Value and standard error of each metric, and of the scatter (rms) of e1 and e2. An unknown error is NaN.
    pub metrics: BTreeMap<String, [f64; 2]>,
}

impl Baseline {
    pub fn new(source: Source, submissions: Vec<BaselineConfiguration>) -> Self {
        Baseline {
            version: shearq_dataset::VERSION.into(),
            sets_held: sets_of(&submissions).count(),
            source,
            submissions,
        }
    }

    pub fn path(folder: &Path, name: &str) -> PathBuf {
        folder.join(format!("{name}.{ENDING}"))
    }

    pub fn names(folder: &Path) -> Result<Vec<String>, FileError> {
        let mut paths = atomic::list(folder)?;
        paths.retain(|path| path.extension().is_some_and(|ending| ending == ENDING));
        let name = |path: &PathBuf| Some(path.file_stem()?.to_str()?.to_owned());
        Ok(paths.iter().filter_map(name).collect())
    }

    pub fn read(path: &Path) -> Result<Self, FileError> {
        let text = shearq_files::open::read_to_string(path, shearq_files::open::SETTINGS)
            .map_err(FileError::doing(path, "cannot read the baseline"))?;
        let baseline: Baseline = toml::from_str(&text)
            .map_err(|error| FileError::new(path, error.to_string().trim_end()))?;
        let wild = |set: &&BaselineSet| {
            let mut metrics = set.metrics.values();
            metrics.any(|[value, error]| value.is_infinite() || error.is_infinite() || *error < 0.0)
        };
        // No metric would move by more than an infinite error.
        if let Some(set) = sets_of(&baseline.submissions).find(wild) {
            let message = format!(
                "set {}: a metric is infinite, or its error is infinite or negative",
                set.set
            );
            return Err(FileError::new(path, message));
        }
        let found = sets_of(&baseline.submissions).count();
        // A TOML file that ends early after a set is valid.
        let held = baseline.sets_held;
        if held != found {
            let message = format!(
                "the file was truncated or edited (found {found} sets, expected {held} as in `sets_held`)"
            );
            return Err(FileError::new(path, message));
        }
        Ok(baseline)
    }

    pub fn create(&self, path: &Path) -> Result<(), FileError> {
        if atomic::write_if_absent(path, self.text(path)?.as_bytes())? {
            return Ok(());
        }
        Err(Baseline::exists(path))
    }

    /// Replaces the file. It belongs under version control, which keeps the earlier one.
    pub fn replace(&self, path: &Path) -> Result<(), FileError> {
        atomic::write(path, self.text(path)?.as_bytes())
    }

    pub fn exists(path: &Path) -> FileError {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        FileError::new(path, "the baseline exists")
            .hint(format!("shearq baseline check {name} --update"))
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

const ENDING: &str = "toml";

// Names in the file of the scatter of e1 and of e2: it notices changes that Q averages out.
const SCATTER: [&str; 2] = ["scatter_e1", "scatter_e2"];

pub fn metrics_of(
    run: &Run,
    data: &DataFolder,
    out: &Path,
    threads: usize,
) -> Result<Vec<BaselineSet>, ScoreError> {
    let options = Options {
        choice: OWN,
        ..Options::default()
    };
    let catalogues = Catalogues::measured(run, out, &[])?;
    let scored = score_catalogues(data, &catalogues, &[], options, threads)?;
    scored
        .iter()
        .map(|scored| {
            let SetRecord {
                set,
                images,
                galaxies,
                flagged,
                metrics,
                errors,
                ..
            } = scored.record.clone();
            let mut all: BTreeMap<String, [f64; 2]> = Metrics::ALL
                .into_iter()
                .map(|Metric { name, value, .. }| {
                    (name.to_owned(), [value(&metrics), value(&errors)])
                })
                .collect();
            for (name, value) in SCATTER.iter().zip(scatter(run, out, set, threads)?) {
                all.insert((*name).to_owned(), value);
            }
            Ok(BaselineSet {
                set,
                data: fingerprint::of_set(&run.source, data, set, &images)?,
                images,
                galaxies,
                flagged,
                metrics: all,
            })
        })
        .collect()
}

// Rms of e1 and e2 over the measured galaxies of a set, each with its standard error rms/√(2N).
fn scatter(run: &Run, out: &Path, set: u32, threads: usize) -> Result<[[f64; 2]; 2], ScoreError> {
    let catalogues = run.catalogues(out, &[set])?.of_set(set);
    let response = response_of(catalogues.iter().map(|(_, path)| path.as_path()))?;
    let pool = Pool::new(threads)?;
    let sums = pool.in_order(catalogues, |(_, path)| {
        let table = table::read(&path, Some(&["e1", "e2"]), MAX_ROWS)?;
        let e1 = table::numbers(&table, "e1", &path)?;
        let e2 = table::numbers(&table, "e2", &path)?;
        let mut sums = ([0.0; 2], 0.0);
        for (e1, e2) in e1.iter().zip(e2.iter()) {
            if e1.is_finite() && e2.is_finite() {
                sums.0[0] += e1 * e1;
                sums.0[1] += e2 * e2;
                sums.1 += 1.0;
            }
        }
        Ok::<_, FileError>(sums)
    });
    let (mut squares, mut count) = ([0.0; 2], 0.0_f64);
    for image in sums {
        let (more, galaxies) = image?;
        squares[0] += more[0];
        squares[1] += more[1];
        count += galaxies;
    }
    Ok([0, 1].map(|k| {
        let rms = (squares[k] / count).sqrt() / response[k];
        [rms, rms / (2.0 * count).sqrt()]
    }))
}

#[derive(Debug, Error)]
pub enum BaselineError {
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    #[error("{}: cannot find the configuration file of the baseline", path.display())]
    NoFile { path: PathBuf },
    // A value of the wrong type, an unknown key, or a value that TOML or JSON does not have.
    #[error("settings of {configuration}")]
    Settings {
        configuration: String,
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    #[error("set {set} could not be measured again (found no such set in the data)")]
    NoSet { set: u32 },
    #[error("the data of set {set} are not the baseline's ({then} images then, {now} now), so that metrics differ by noise{}", tried(self.hint()))]
    OtherData { set: u32, then: usize, now: usize },
}

impl BaselineError {
    hints! {
        Self::OtherData { .. } => "--update if they changed on purpose",
    }
}

fn settings_error<E: Into<Box<dyn std::error::Error + Send + Sync>>>(
    configuration: &str,
) -> impl Fn(E) -> BaselineError {
    move |source| BaselineError::Settings {
        configuration: configuration.to_owned(),
        source: source.into(),
    }
}

const CHECKED: [&str; 8] = [
    "q",
    "q_calibrated",
    "m_half",
    "sqrt_a",
    "m_cross",
    "galaxy_noise",
    SCATTER[0],
    SCATTER[1],
];

/// Accepted relative shift of a metric. It detects a changed digit of Q in a table.
///
/// The network works in f32, and instruction sets round its sums differently. On the project's baseline, metrics
/// with and without fused multiply-add (AVX2, AVX-512) differ by less than 2e-6, and by less than 1e-5 standard
/// errors. That is a fiftieth of the tolerance.
pub const TOLERANCE: f64 = 1e-4;

/// Accepted shift in standard errors, for metrics near zero.
pub const TOLERANCE_SIGMA: f64 = 1e-3;

/// A metric before and now.
#[derive(Debug, Clone, PartialEq)]
pub struct Shift {
    /// `None` for the mean over all sets, or without sets.
    pub set: Option<u32>,
    pub metric: String,
    pub before: [f64; 2],
    pub now: [f64; 2],
    /// The error that the difference is compared with: of the metric, or of the paired difference.
    pub error: f64,
    pub moved: bool,
}

impl Shift {
    /// The difference in standard errors; `None` if nothing changed, or all galaxies alike.
    pub fn sigma(&self) -> Option<f64> {
        let difference = self.now[0] - self.before[0];
        let rounding = SHIFT_ROUNDING * self.before[0].abs().max(self.before[1]);
        let has_scatter = self.error > MIN_PAIRED_ERROR * self.before[1];
        (difference.abs() > rounding && has_scatter).then(|| difference / self.error)
    }
}

/// The shifts of the checked metrics of a set that was measured on the same data. A metric may shift by rounding: by
/// [`TOLERANCE`] of itself or [`TOLERANCE_SIGMA`] of its error, whichever is larger.
pub fn shifts(before: &BaselineSet, now: &BaselineSet) -> Vec<Shift> {
    let shift = |metric: &str| {
        let get = |set: &BaselineSet| set.metrics.get(metric).copied().unwrap_or([f64::NAN; 2]);
        let (old, new) = (get(before), get(now));
        // `max` ignores an unknown error.
        let allowed = (TOLERANCE_SIGMA * old[1]).max(TOLERANCE * old[0].abs());
        // A lost metric is a shift.
        let neither = old[0].is_nan() && new[0].is_nan();
        let within = (new[0] - old[0]).abs() <= allowed;
        Shift {
            set: Some(before.set),
            metric: metric.to_owned(),
            before: old,
            now: new,
            error: old[1],
            moved: !neither && !within,
        }
    };
    CHECKED.into_iter().map(shift).collect()
}

// Changed settings of a baseline as `key: before ≠ now`, and settings that the baseline does not have.
fn settings_moved(
    before: &BaselineConfiguration,
    now: &Configuration,
) -> Result<(Vec<String>, Vec<String>), BaselineError> {
    let mut current = toml::Table::try_from(now).map_err(settings_error(&before.name))?;
    let mut earlier = before.settings.clone();
    // A description does not change results.
    for table in [&mut current, &mut earlier] {
        table.remove("description");
    }
    let filled = with_defaults(current.clone(), &earlier);
    let compare =
        |a: &toml::Table, b: &toml::Table| differences(a, b).map_err(settings_error(&before.name));
    Ok((compare(&filled, &current)?, compare(&earlier, &filled)?))
}

#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    pub baseline: String,
    pub configuration: String,
    pub shifts: Vec<Shift>,
    /// Changed settings, as `key: before ≠ now`.
    pub settings: Vec<String>,
    pub notes: Vec<String>,
}

impl Checked {
    /// Whether a metric or a setting moved.
    pub fn has_moved(&self) -> bool {
        !self.settings.is_empty() || self.shifts.iter().any(|shift| shift.moved)
    }
}

// The present settings, so that a check notices changed ones. Files lie relative to the folder `beside`.
fn settings_now(
    before: &BaselineConfiguration,
    registry: &Registry,
    beside: &Path,
) -> Result<Configuration, BaselineError> {
    let Some(file) = &before.file else {
        return Ok(registry.get(&before.name)?.configuration);
    };
    // The registry could know a plain name.
    let path = Path::new(".").join(shortened(beside.join(file)));
    if !path.is_file() {
        return Err(BaselineError::NoFile { path });
    }
    Ok(registry.get(&path.to_string_lossy())?.configuration)
}

// `settings`, with the `defaults` of keys that they lack.
fn with_defaults(mut defaults: toml::Table, settings: &toml::Table) -> toml::Table {
    for (key, value) in settings {
        match (defaults.get_mut(key), value) {
            (Some(toml::Value::Table(section)), toml::Value::Table(own)) => {
                section.extend(own.clone());
            }
            _ => {
                defaults.insert(key.clone(), value.clone());
            }
        }
    }
    defaults
}

/// Measures the configurations of the baseline `name` again with `measure`, and compares. Configuration files lie relative
/// to the folder `beside`. Other data than the baseline's are an error, unless it is to be replaced (`updates`). Returns the checks and the configurations with their present settings and metrics.
pub fn check<E: From<BaselineError>>(
    name: &str,
    baseline: &Baseline,
    updates: bool,
    beside: &Path,
    mut measure: impl FnMut(&Configuration, &[ImageId]) -> Result<Vec<BaselineSet>, E>,
) -> Result<(Vec<Checked>, Vec<BaselineConfiguration>), E> {
    let registry = Registry::embedded().map_err(BaselineError::from)?;
    let (mut checks, mut configurations) = (Vec::new(), Vec::new());
    for before in &baseline.submissions {
        let configuration = settings_now(before, &registry, beside)?;
        let (settings, new) = settings_moved(before, &configuration)?;
        let notes = new
            .iter()
            .map(|line| format!("a setting is new: {line}"))
            .collect();
        let mut check = Checked {
            baseline: name.to_owned(),
            configuration: before.name.clone(),
            shifts: Vec::new(),
            settings,
            notes,
        };
        let of_set = |old: &BaselineSet| {
            let set = old.set;
            let images = old.images.clone().into_iter();
            images.map(move |image| ImageId { set, image })
        };
        let images: Vec<ImageId> = before.sets.iter().flat_map(of_set).collect();
        let sets = measure(&configuration, &images)?;
        for old in &before.sets {
            let Some(now) = sets.iter().find(|now| now.set == old.set) else {
                return Err(BaselineError::NoSet { set: old.set }.into());
            };
            if (now.data != old.data || now.images != old.images) && !updates {
                let (then, now) = (old.images.len(), now.images.len());
                let set = old.set;
                return Err(BaselineError::OtherData { set, then, now }.into());
            }
            check.shifts.extend(shifts(old, now));
        }
        let file = before.file.clone();
        configurations.push(
            BaselineConfiguration::new(&configuration, file, sets)
                .map_err(settings_error(&before.name))?,
        );
        checks.push(check);
    }
    Ok((checks, configurations))
}

// Share of a metric or its error that rounding reaches: sums of 10⁶ galaxies are off by 10⁻¹⁰.
const SHIFT_ROUNDING: f64 = 1e-9;
// Share of the error of a metric below which a paired one shows that all galaxies shifted alike. Chosen by hand.
const MIN_PAIRED_ERROR: f64 = 1e-3;

/// The metrics of all checks, or only the moved ones.
pub fn shift_table(checks: &[Checked], all: bool) -> Table {
    let rows = checks.iter().flat_map(|check| {
        let shown = check.shifts.iter().filter(|shift| all || shift.moved);
        shown.map(move |shift| (check, shift))
    });
    let rows: Vec<(&Checked, &Shift)> = rows.collect();
    let value = |[value, error]: [f64; 2]| {
        Cell::with_error(value, Some(error).filter(|e| e.is_finite()), 6)
    };
    let mut table = Table::titled("Shifts from baselines");
    table.column("baseline", "Baseline", &rows, |(check, _)| {
        Cell::text(&check.baseline)
    });
    table.column("submission", "Configuration", &rows, |(check, _)| {
        Cell::text(&check.configuration)
    });
    table.column("set", "Set", &rows, |(_, shift)| {
        shift
            .set
            .map_or(Cell::Empty, |set| Cell::number(f64::from(set), 0))
    });
    table.column("metric", "Metric", &rows, |(_, shift)| {
        Cell::text(&shift.metric)
    });
    table.column("before", "Before", &rows, |(_, shift)| value(shift.before));
    table.column("now", "Now", &rows, |(_, shift)| value(shift.now));
    table.column("difference", "Difference", &rows, |(_, shift)| {
        Cell::number(shift.now[0] - shift.before[0], 6)
    });
    table.column("sigma", "in σ", &rows, |(_, shift)| {
        Cell::number(shift.sigma().unwrap_or(f64::NAN), 3)
    });
    table.column("moved", "Moved", &rows, |(_, shift)| {
        Cell::text(if shift.moved { "yes" } else { "no" })
    });
    let compared: usize = checks.iter().map(|check| check.shifts.len()).sum();
    let moved = checks
        .iter()
        .flat_map(|check| &check.shifts)
        .filter(|shift| shift.moved)
        .count();
    let notes = &mut table.notes;
    notes.push(format!(
        "{moved} of {compared} metrics of {} configuration(s) moved. In σ: difference over its standard error, of configurations over that of the metric; missing if nothing changed, or all galaxies alike.",
        checks.len()
    ));
    for check in checks {
        let name = format!("{}, {}", check.baseline, check.configuration);
        for line in &check.settings {
            notes.push(format!("{name}: the setting changed: {line}"));
        }
        for line in &check.notes {
            notes.push(format!("{name}: {line}"));
        }
    }
    table
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(q: f64) -> BaselineSet {
        let metrics = CHECKED.map(|name| (name.to_owned(), [q, 2.0]));
        BaselineSet {
            set: 1,
            data: "a".into(),
            images: vec![1, 2],
            galaxies: 10,
            flagged: 0,
            metrics: metrics.into(),
        }
    }

    #[test]
    fn configurations_may_shift_by_rounding() {
        let moved = |q: f64| shifts(&set(80.0), &set(q))[0].moved;
        assert!(!moved(80.0 * (1.0 + 0.9 * TOLERANCE)));
        assert!(moved(80.0 * (1.0 - 1.1 * TOLERANCE)) && moved(f64::NAN));
    }

    #[test]
    fn shifts_of_rounding_have_no_significance() {
        let sigma = |now: f64, error: f64| {
            let shift = Shift {
                set: None,
                metric: "m1".into(),
                before: [0.011, 0.003],
                now: [now, 0.003],
                error,
                moved: false,
            };
            shift.sigma()
        };
        assert_eq!(sigma(0.011 + 1e-17, 1e-17), None);
        assert_eq!(sigma(0.013, 1e-17), None);
        assert_eq!(sigma(0.011, 0.001), None);
        assert!((sigma(0.013, 0.001).unwrap() - 2.0).abs() < 1e-9);
    }

    #[test]
    fn a_metric_near_zero_may_shift_by_a_share_of_its_error() {
        let moved = |q: f64| shifts(&set(0.0), &set(q))[0].moved;
        assert!(!moved(1.9 * TOLERANCE_SIGMA) && moved(2.1 * TOLERANCE_SIGMA));
    }
}
