//! Metrics and settings that moved since a baseline.

use std::path::{Path, PathBuf};

use shearq_submissions::{Configuration, ConfigurationError, Registry};
use thiserror::Error;

use super::measured::{SCATTER, Wanted};
use super::{Baseline, BaselineConfiguration, BaselineSet};
use shearq_dataset::record::differences;
use shearq_dataset::relative::shortened;
use shearq_pipeline::PipelineError;

/// Why a baseline cannot be checked.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BaselineError {
    /// The registry of configurations, or a configuration file.
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    /// The recorded configuration file is gone.
    #[error("{}: cannot find the configuration file of the baseline. Try: shearq baseline check --stored", path.display())]
    NoFile {
        /// The file.
        path: PathBuf,
    },
    /// Settings that this version cannot read, write or compare.
    #[error("settings of {configuration}")]
    Settings {
        /// Name of the configuration.
        configuration: String,
        /// What is wrong with them.
        source: SettingsError,
    },
    /// Measuring failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The data have fewer sets than the baseline.
    #[error("set {set} could not be measured again (found no such set in the data)")]
    NoSet {
        /// Set number.
        set: u32,
    },
}

/// Settings that cannot be read, written or compared.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SettingsError {
    /// A value of the wrong type or an unknown key.
    #[error(transparent)]
    Read(#[from] toml::de::Error),
    /// A value that TOML does not have.
    #[error(transparent)]
    Write(#[from] toml::ser::Error),
    /// A value that JSON does not have.
    #[error(transparent)]
    Compare(#[from] serde_json::Error),
}

impl SettingsError {
    /// The error for the configuration `name`.
    fn of(name: &str) -> impl FnOnce(SettingsError) -> BaselineError {
        let configuration = name.to_owned();
        move |source| BaselineError::Settings {
            configuration,
            source,
        }
    }
}

/// Metrics that must not move.
const CHECKED: [&str; 5] = ["q", "m_half", "sqrt_a", SCATTER[0], SCATTER[1]];

/// Accepted relative shift of a metric on the same data. It detects a changed digit of Q in a table.
///
/// The network works in f32, and instruction sets round its sums differently. On the project's baseline, metrics
/// with and without fused multiply-add (AVX2, AVX-512) differ by less than 2e-6, and by less than 1e-5 standard
/// errors. That is a fiftieth of the tolerance.
pub const TOLERANCE: f64 = 1e-4;

/// Accepted shift in standard errors on the same data, for metrics near zero.
pub const TOLERANCE_SIGMA: f64 = 1e-3;

/// A metric in the baseline and now.
#[derive(Debug, Clone, PartialEq)]
pub struct Shift {
    /// Set number.
    pub set: u32,
    /// Name of the metric.
    pub metric: &'static str,
    /// Value and standard error in the baseline.
    pub before: [f64; 2],
    /// Value and standard error now.
    pub now: [f64; 2],
    /// The difference over its error: the error of the baseline on the same data, of both metrics on other data.
    pub sigma: f64,
    /// Whether the shift exceeds the tolerance.
    pub moved: bool,
}

/// The shifts of the checked metrics of a set.
///
/// On the same data a metric may shift by rounding: by [`TOLERANCE`] of itself or [`TOLERANCE_SIGMA`] of its error,
/// whichever is larger. On other data it may shift by `sigmas` standard errors of the difference.
pub fn shifts(before: &BaselineSet, now: &BaselineSet, sigmas: f64) -> Vec<Shift> {
    let same_data = before.data == now.data && before.images == now.images;
    CHECKED
        .iter()
        .map(|&metric| {
            let get = |set: &BaselineSet| set.metrics.get(metric).copied();
            let (old, new) = (
                get(before).unwrap_or([f64::NAN; 2]),
                get(now).unwrap_or([f64::NAN; 2]),
            );
            let difference = new[0] - old[0];
            let error = if same_data {
                old[1]
            } else {
                old[1].hypot(new[1])
            };
            let allowed = if same_data {
                // `max` ignores an unknown error.
                (TOLERANCE_SIGMA * error).max(TOLERANCE * old[0].abs())
            } else {
                sigmas * error
            };
            // Without an error, other data cannot show a shift. A lost metric is a shift.
            let unknown = !same_data && error.is_nan() && difference.is_finite();
            let within = unknown || difference.abs() <= allowed;
            let neither = old[0].is_nan() && new[0].is_nan();
            Shift {
                set: before.set,
                metric,
                before: old,
                now: new,
                sigma: difference / error,
                moved: !neither && !within,
            }
        })
        .collect()
}

/// Changed settings of a baseline as `key: before ≠ now`, and settings that the baseline does not have.
///
/// # Errors
/// If settings cannot be compared.
fn settings_moved(
    before: &BaselineConfiguration,
    now: &Configuration,
) -> Result<(Vec<String>, Vec<String>), SettingsError> {
    let mut current = toml::Table::try_from(now)?;
    let mut earlier = before.settings.clone();
    // A description does not change results.
    for table in [&mut current, &mut earlier] {
        table.remove("description");
    }
    let found = differences(&earlier, &current)?;
    Ok(found
        .into_iter()
        .partition(|line| !line.contains(": null ≠ ")))
}

/// Result of a check of one configuration of a baseline.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// Name of the baseline.
    pub baseline: String,
    /// Name of the configuration.
    pub configuration: String,
    /// Every compared metric.
    pub shifts: Vec<Shift>,
    /// Changed settings, as `key: before ≠ now`.
    pub settings: Vec<String>,
    /// Remarks that are no failures.
    pub notes: Vec<String>,
    /// Whether stored settings were used although the configuration may have changed.
    pub stored: bool,
}

impl Checked {
    /// Whether anything moved.
    pub fn failed(&self) -> bool {
        !self.settings.is_empty() || self.shifts.iter().any(|shift| shift.moved)
    }

    /// One line per moved setting or metric.
    pub fn moved(&self) -> Vec<String> {
        let settings = self
            .settings
            .iter()
            .map(|line| format!("{}: setting {line}", self.configuration));
        let metrics = self.shifts.iter().filter(|shift| shift.moved).map(|shift| {
            format!(
                "{} set {}: {} from {} to {}, {:+.2} σ",
                self.configuration,
                shift.set,
                shift.metric,
                shift.before[0],
                shift.now[0],
                shift.sigma
            )
        });
        settings.chain(metrics).collect()
    }
}

/// The configuration that provides the defaults for the method of `settings`.
fn base_of(settings: &toml::Table) -> &'static str {
    match settings.get("method").and_then(toml::Value::as_str) {
        Some("linear") => "48/linear/star",
        _ => "paper",
    }
}

/// The settings to measure a baseline with. Named configurations always have their present settings.
#[derive(Debug, Clone, Copy)]
pub enum Settings<'a> {
    /// The settings in the configuration files; their paths are relative to this folder.
    Files(&'a Path),
    /// The settings in the baseline.
    Stored,
}

/// The settings to measure a configuration of a baseline with, and whether stored settings replace an unknown file.
/// A key that stored settings lack has its default.
fn settings_now(
    before: &BaselineConfiguration,
    registry: &Registry,
    settings: Settings<'_>,
) -> Result<(Configuration, bool), BaselineError> {
    if let (Settings::Files(folder), Some(file)) = (settings, &before.file) {
        let path = shortened(folder.join(file));
        // The registry could know a plain name.
        let path = Path::new(".").join(path);
        if !path.is_file() {
            return Err(BaselineError::NoFile { path });
        }
        return Ok((registry.get(&path.to_string_lossy())?.configuration, false));
    }
    if before.file.is_none() && registry.names().contains(&before.name) {
        return Ok((registry.get(&before.name)?.configuration, false));
    }
    let base = registry.get(base_of(&before.settings))?.configuration;
    let configuration =
        with_defaults(&base, &before.settings).map_err(SettingsError::of(&before.name))?;
    Ok((configuration, matches!(settings, Settings::Files(_))))
}

/// The configuration of `settings`; keys that they lack are `base`'s.
fn with_defaults(
    base: &Configuration,
    settings: &toml::Table,
) -> Result<Configuration, SettingsError> {
    let mut all = toml::Table::try_from(base)?;
    for (key, value) in settings {
        match (all.get_mut(key), value) {
            (Some(toml::Value::Table(section)), toml::Value::Table(own)) => {
                section.extend(own.clone());
            }
            _ => {
                all.insert(key.clone(), value.clone());
            }
        }
    }
    Ok(all.try_into()?)
}

/// Measures the configurations of the baseline `name` again with `measure`, and compares.
/// Returns the checks and the configurations with their present settings and metrics.
///
/// # Errors
/// If settings are invalid, or measuring fails.
pub fn check(
    name: &str,
    baseline: &Baseline,
    sigmas: f64,
    settings: Settings<'_>,
    mut measure: impl FnMut(&Configuration, &[Wanted]) -> Result<Vec<BaselineSet>, PipelineError>,
) -> Result<(Vec<Checked>, Vec<BaselineConfiguration>), BaselineError> {
    let registry = Registry::embedded()?;
    let (mut checks, mut configurations) = (Vec::new(), Vec::new());
    for before in &baseline.submissions {
        let (configuration, stored) = settings_now(before, &registry, settings)?;
        let (settings, new) =
            settings_moved(before, &configuration).map_err(SettingsError::of(&before.name))?;
        let mut check = Checked {
            baseline: name.to_owned(),
            configuration: before.name.clone(),
            shifts: Vec::new(),
            settings,
            notes: new
                .iter()
                .map(|line| format!("a setting is new: {line}"))
                .collect(),
            stored,
        };
        let wanted: Vec<Wanted> = before
            .sets
            .iter()
            .map(|set| Wanted {
                set: set.set,
                images: set.images.len() as u32,
            })
            .collect();
        let sets = measure(&configuration, &wanted)?;
        for old in &before.sets {
            let Some(now) = sets.iter().find(|now| now.set == old.set) else {
                return Err(BaselineError::NoSet { set: old.set });
            };
            if now.data != old.data || now.images != old.images {
                check.notes.push(format!(
                    "the data of set {} are not the baseline's ({} images then, {} now). Metrics may differ by {sigmas} σ",
                    old.set,
                    old.images.len(),
                    now.images.len(),
                ));
            }
            check.shifts.extend(shifts(old, now, sigmas));
        }
        let file = before.file.clone();
        configurations.push(
            BaselineConfiguration::new(&configuration, file, sets)
                .map_err(|error| SettingsError::of(&before.name)(error.into()))?,
        );
        checks.push(check);
    }
    Ok((checks, configurations))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn set(data: &str, q: f64) -> BaselineSet {
        let metrics = CHECKED.map(|name| (name.to_owned(), [q, 2.0]));
        BaselineSet {
            set: 1,
            data: data.into(),
            images: vec![1, 2],
            galaxies: 10,
            flagged: 0,
            metrics: metrics.into(),
        }
    }

    #[test]
    fn the_same_data_allow_rounding_and_other_data_noise() {
        let before = set("a", 80.0);
        let moved = |now: &BaselineSet| shifts(&before, now, 3.0)[0].moved;
        assert!(!moved(&set("a", 80.0 * (1.0 + 0.9 * TOLERANCE))));
        assert!(moved(&set("a", 80.0 * (1.0 - 1.1 * TOLERANCE))));
        // 3 σ of the difference of two metrics with errors of 2 is 8.5.
        assert!(!moved(&set("b", 88.0)) && moved(&set("b", 89.0)));
        assert!(moved(&set("a", f64::NAN)) && moved(&set("b", f64::NAN)));
        let mut unsure = set("b", 1e9);
        for value in unsure.metrics.values_mut() {
            value[1] = f64::NAN;
        }
        assert!(!moved(&unsure));
    }

    #[test]
    fn a_metric_near_zero_may_shift_by_a_share_of_its_error() {
        let before = set("a", 0.0);
        let moved = |q: f64| shifts(&before, &set("a", q), 3.0)[0].moved;
        assert!(!moved(1.9 * TOLERANCE_SIGMA) && moved(2.1 * TOLERANCE_SIGMA));
    }
}
