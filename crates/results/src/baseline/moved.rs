//! What moved since a baseline.

use std::path::Path;

use shearq_submissions::{Configuration, Registry};

use super::measured::{SCATTER, Wanted};
use super::{Baseline, BaselineConfiguration, BaselineSet};
use shearq_pipeline::data::relative::shortened;
use shearq_pipeline::data::run::differences;

/// Metrics that must not move.
const CHECKED: [&str; 5] = ["q", "m_half", "sqrt_a", SCATTER[0], SCATTER[1]];

/// How far a metric may be off on the same data, relative to itself: a changed digit of Q as tables
/// print it is seen.
///
/// The network works in f32, and instruction sets round its sums differently. On the project's own
/// baseline, metrics with fused multiply-add (AVX2, AVX-512) and without differ by less than 2e-6 of
/// themselves and 1e-5 of their standard errors, a fiftieth of what is allowed.
pub const TOLERANCE: f64 = 1e-4;

/// The same in units of the metric's standard error, for metrics that are nearly zero.
pub const TOLERANCE_SIGMA: f64 = 1e-3;

/// A metric of a baseline, and what it is now.
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
    /// The difference in units of its error: that of the baseline's metric on the same data, on
    /// others that of both.
    pub sigma: f64,
    /// Whether it moved by more than may be.
    pub moved: bool,
}

/// What became of the checked metrics of a set.
///
/// On the same data a metric may be off by rounding alone: by [`TOLERANCE`] of itself or
/// [`TOLERANCE_SIGMA`] of its error, whichever is more. On other data it may be off by `sigmas` standard errors of the
/// difference.
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
                // The larger one; an unknown error leaves the other.
                (TOLERANCE_SIGMA * error).max(TOLERANCE * old[0].abs())
            } else {
                sigmas * error
            };
            // On other data nothing can be told where an error is withheld; a metric that is lost is a change.
            let untold = !same_data && error.is_nan() && difference.is_finite();
            let within = untold || difference.abs() <= allowed;
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

/// Settings of a baseline that are others now, as `key: before ≠ now`; and those that it does not
/// know, because they are newer.
///
/// # Errors
/// Where settings cannot be compared.
fn settings_moved(
    before: &BaselineConfiguration,
    now: &Configuration,
) -> anyhow::Result<(Vec<String>, Vec<String>)> {
    let mut current = toml::Table::try_from(now)?;
    let mut earlier = before.settings.clone();
    // Words do not change results.
    for table in [&mut current, &mut earlier] {
        table.remove("description");
    }
    let found = differences(&earlier, &current)?;
    Ok(found
        .into_iter()
        .partition(|line| !line.contains(": null ≠ ")))
}

/// What a check found about one submission of a baseline.
#[derive(Debug, Clone, PartialEq)]
pub struct Checked {
    /// Name of the baseline.
    pub baseline: String,
    /// Name of the submission.
    pub configuration: String,
    /// Every metric looked at.
    pub shifts: Vec<Shift>,
    /// Settings that are others now.
    pub settings: Vec<String>,
    /// What should be known and is no failure.
    pub notes: Vec<String>,
    /// Whether the settings are those stored, although their configuration may have changed.
    pub stored: bool,
}

impl Checked {
    /// Whether anything moved.
    pub fn failed(&self) -> bool {
        !self.settings.is_empty() || self.shifts.iter().any(|shift| shift.moved)
    }

    /// What moved, a line each.
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

/// The submission that those with the method of `settings` rest on.
fn base_of(settings: &toml::Table) -> &'static str {
    match settings.get("method").and_then(toml::Value::as_str) {
        Some("linear") => "48/linear/star",
        _ => "paper",
    }
}

/// Which settings a baseline is measured with again. Named submissions have the present ones always.
#[derive(Debug, Clone, Copy)]
pub enum Settings<'a> {
    /// Those of the configuration files, which are found from this folder.
    Files(&'a Path),
    /// Those stored in the baseline.
    Stored,
}

/// The settings by which a submission of a baseline is measured again, and whether they are those stored because its
/// file is not known. In stored settings, keys that the baseline does not have are the base's.
fn settings_now(
    before: &BaselineConfiguration,
    registry: &Registry,
    settings: Settings<'_>,
) -> Result<(Configuration, bool), anyhow::Error> {
    if let (Settings::Files(folder), Some(file)) = (settings, &before.file) {
        let path = shortened(folder.join(file));
        // A plain name could be one of the registry.
        let path = Path::new(".").join(path);
        anyhow::ensure!(
            path.is_file(),
            "{}: the configuration file is not there any more. Try: shearq baseline check --stored",
            path.display()
        );
        return Ok((registry.get(&path.to_string_lossy())?.configuration, false));
    }
    if before.file.is_none() && registry.names().contains(&before.name) {
        return Ok((registry.get(&before.name)?.configuration, false));
    }
    let base = registry.get(base_of(&before.settings))?.configuration;
    let mut all = toml::Table::try_from(&base)?;
    for (key, value) in &before.settings {
        match (all.get_mut(key), value) {
            (Some(toml::Value::Table(section)), toml::Value::Table(own)) => {
                section.extend(own.clone());
            }
            _ => {
                all.insert(key.clone(), value.clone());
            }
        }
    }
    Ok((all.try_into()?, matches!(settings, Settings::Files(_))))
}

/// Holds the submissions of the baseline `name` against what they are as `measure` measures them now; what
/// was found, and the submissions as they are now.
///
/// # Errors
/// Where settings are not valid, or something cannot be measured.
pub fn check(
    name: &str,
    baseline: &Baseline,
    sigmas: f64,
    settings: Settings<'_>,
    mut measure: impl FnMut(&Configuration, &[Wanted]) -> anyhow::Result<Vec<BaselineSet>>,
) -> anyhow::Result<(Vec<Checked>, Vec<BaselineConfiguration>)> {
    let registry = Registry::embedded()?;
    let (mut checks, mut submissions) = (Vec::new(), Vec::new());
    for before in &baseline.submissions {
        let (configuration, stored) = settings_now(before, &registry, settings)
            .map_err(|error| error.context(format!("settings of {}", before.name)))?;
        let (settings, new) = settings_moved(before, &configuration)?;
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
                anyhow::bail!("set {} was not measured again", old.set);
            };
            if now.data != old.data || now.images != old.images {
                check.notes.push(format!(
                    "the data of set {} are not the baseline's ({} images then, {} now); its metrics may differ by {sigmas} σ",
                    old.set,
                    old.images.len(),
                    now.images.len(),
                ));
            }
            check.shifts.extend(shifts(old, now, sigmas));
        }
        submissions.push(BaselineConfiguration::new(
            &configuration,
            before.file.clone(),
            sets,
        )?);
        checks.push(check);
    }
    Ok((checks, submissions))
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
    fn on_the_same_data_rounding_passes_and_on_others_noise_does() {
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
    fn a_figure_near_zero_may_be_off_by_a_part_of_its_error() {
        let before = set("a", 0.0);
        let moved = |q: f64| shifts(&before, &set("a", q), 3.0)[0].moved;
        assert!(!moved(1.9 * TOLERANCE_SIGMA) && moved(2.1 * TOLERANCE_SIGMA));
    }
}
