//! Baselines of catalogues of any code: the metrics of `score`, or m and c of `bias`, with the sums of their independent units.
//! A later measurement of the same galaxies is compared unit by unit, so that the noise that both share cancels.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_bias::Design;
use shearq_catalogue::roles::named;
use shearq_dataset::fingerprint;
use shearq_files::open::{self, SETTINGS};
use shearq_files::{FileError, atomic};
use shearq_quantities::{hints, tried};
use shearq_scoring::resample::{PairedSet, mean_over_sets, paired_difference};
use shearq_scoring::{Convention, Metric, Metrics};
use thiserror::Error;

use super::{Checked, Shift};
use crate::bias::{BiasFailure, BiasResult, BinResult, Summed};
use crate::score::ScoredSet;

/// The file of a baseline of catalogues. The sums that paired differences need are in a file beside it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CatalogueBaseline {
    version: String,
    /// `score` or `bias` with its arguments, which a check repeats.
    pub command: Vec<String>,
    /// Fingerprint of the file of units.
    units: String,
    /// Galaxies that count, of as many rows.
    galaxies: u64,
    rows: u64,
    pub tolerance: Tolerance,
    /// What must not change unnoticed, for readers of this file: the convention of `score`, the columns by role of `bias`.
    settings: BTreeMap<String, String>,
    /// Value and standard error of each metric; of several sets the mean.
    metrics: BTreeMap<String, [f64; 2]>,
    /// Fingerprints of the catalogues when they were recorded. They are expected to change.
    catalogues: BTreeMap<String, String>,
}

/// What was measured: metrics with their jackknife replicates, or sums by unit.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Units {
    Score(Vec<ScoredUnits>),
    Bias(Box<Summed>),
}

/// A scored set with what a paired difference needs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScoredUnits {
    set: u32,
    /// Fingerprint of the true shear.
    truth: String,
    images: Vec<u32>,
    galaxies: u64,
    flagged: u64,
    /// Signs and axes of the ellipticities that were scored. Those that match the truth are chosen anew in each check, so that
    /// e2 with the other sign leaves all metrics as they were.
    convention: String,
    metrics: Metrics,
    errors: Metrics,
    /// The metrics with each group of images left out in turn.
    replicates: Vec<Metrics>,
}

impl ScoredUnits {
    /// Of a set that was scored against the true shear in the file `truth`.
    pub fn new(scored: &ScoredSet, truth: &Path) -> Result<Self, FileError> {
        let record = &scored.record;
        Ok(ScoredUnits {
            set: record.set,
            truth: fingerprint::of_file(truth)?,
            images: record.images.clone(),
            galaxies: record.galaxies,
            flagged: record.flagged,
            convention: described(scored.score.chosen),
            metrics: record.metrics,
            errors: record.errors,
            replicates: scored.score.replicates.clone(),
        })
    }
}

fn described(convention: Convention) -> String {
    format!("{} ({})", convention.number(), convention.describe())
}

/// The largest accepted shift of a metric: as many standard errors of the paired difference, or as large, whichever is more.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tolerance {
    /// In standard errors of the paired difference.
    pub sigma: f64,
    /// Of multiplicative biases.
    pub m: f64,
    /// Of additive biases.
    pub c: f64,
    /// Of leakages.
    pub alpha: f64,
    /// Of other metrics, as a share of their value.
    pub relative: f64,
}

impl Default for Tolerance {
    fn default() -> Self {
        Tolerance {
            // Chosen by hand: fourteen metrics of a changed code exceed it by noise in 4 % of all checks, and then only if the
            // shift has the size below, too.
            sigma: 3.0,
            // A quarter of GREAT3's limits, |m| < 2·10⁻³ and |c| < 2·10⁻⁴ (Mandelbaum et al. 2014, ApJS 212, 5), so that
            // several such changes stay within them.
            m: 5e-4,
            c: 5e-5,
            // c of a PSF of ellipticity 0.05.
            alpha: 1e-3,
            // Chosen by hand.
            relative: 0.01,
        }
    }
}

impl Tolerance {
    /// Sets a number by a text such as `m=1e-3`.
    pub fn set(&mut self, text: &str) -> Result<(), String> {
        let expected = || {
            format!(
                "expected sigma, m, c, alpha or relative, `=`, and zero or a positive number (found `{text}`)"
            )
        };
        let (name, number) = text.split_once('=').ok_or_else(expected)?;
        let number: f64 = number.trim().parse().map_err(|_| expected())?;
        let place = match name.trim() {
            "sigma" => &mut self.sigma,
            "m" => &mut self.m,
            "c" => &mut self.c,
            "alpha" => &mut self.alpha,
            "relative" => &mut self.relative,
            _ => return Err(expected()),
        };
        *place = number;
        self.check().map_err(|_| expected())
    }

    // An infinite or NaN tolerance would accept everything or nothing.
    fn check(&self) -> Result<(), String> {
        let all = [self.sigma, self.m, self.c, self.alpha, self.relative];
        match all.iter().all(|own| own.is_finite() && *own >= 0.0) {
            true => Ok(()),
            false => Err(format!(
                "`tolerance`: found {all:?}, expected finite numbers of zero or more"
            )),
        }
    }

    fn size(&self, metric: &str, before: f64) -> f64 {
        match metric {
            "m_half" | "m1" | "m2" | "m_cross" | "m_plus" => self.m,
            "c1" | "c2" | "c_plus" | "c_cross" => self.c,
            "alpha" | "alpha1" | "alpha2" => self.alpha,
            _ => self.relative * before.abs(),
        }
    }

    fn described(&self) -> String {
        format!(
            "Counts as moved: by more than {} standard errors of the paired difference, and by more than {} (m), {} (c), {} (α) or {} % of other metrics. Without an error, as of fewer than 8 images, the size decides",
            self.sigma,
            self.m,
            self.c,
            self.alpha,
            100.0 * self.relative
        )
    }
}

// What users are told to judge a method by, of `score` and of `bias`.
const SCORED: [&str; 10] = [
    "q",
    "q_calibrated",
    "m_half",
    "sqrt_a",
    "m_cross",
    "galaxy_noise",
    "m1",
    "m2",
    "c1",
    "c2",
];
const BIASES: [&str; 11] = [
    "m1", "m2", "c1", "c2", "m_plus", "m_cross", "c_plus", "c_cross", "alpha", "alpha1", "alpha2",
];

/// Why catalogues cannot be compared with their baseline.
#[derive(Debug, Error)]
pub enum CatalogueError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error(transparent)]
    Bias(#[from] BiasFailure),
    #[error("{}", .0)]
    Estimate(#[from] shearq_bias::BiasError),
    #[error("{what} are not the baseline's (found {found}, expected {expected}): a paired difference needs the same galaxies{}", tried(self.hint()))]
    OtherGalaxies {
        what: String,
        found: String,
        expected: String,
    },
}

impl CatalogueError {
    hints! {
        Self::File(error) => return error.hint.clone(),
        Self::Bias(error) => return error.hint(),
        Self::Estimate(error) => return error.hint(),
        Self::OtherGalaxies { .. } => "--update if they changed on purpose",
    }
}

fn same<T: PartialEq>(
    what: &str,
    found: &T,
    expected: &T,
    text: impl Fn(&T) -> String,
) -> Result<(), CatalogueError> {
    match found == expected {
        true => Ok(()),
        false => Err(CatalogueError::OtherGalaxies {
            what: what.to_owned(),
            found: text(found),
            expected: text(expected),
        }),
    }
}

impl Units {
    /// Value and standard error of each metric.
    pub fn metrics(&self) -> Result<BTreeMap<String, [f64; 2]>, CatalogueError> {
        match self {
            Units::Score(sets) => {
                let mean = |metric: Metric| {
                    let of = |own: &ScoredUnits| {
                        ((metric.value)(&own.metrics), (metric.value)(&own.errors))
                    };
                    let (value, error) = mean_over_sets(&sets.iter().map(of).collect::<Vec<_>>());
                    (metric.name.to_owned(), [value, error])
                };
                Ok(scored_metrics().map(mean).collect())
            }
            Units::Bias(summed) => {
                let result = summed.result()?;
                let of_bin = |bin: &BinResult| {
                    let label = bin.label.clone();
                    let found = bin.estimate.as_ref().ok().cloned();
                    let known = BIASES.into_iter().filter_map(move |key| {
                        let own = found.as_ref()?.value(key)?;
                        Some((in_bin(key, &label), [own.value, own.error]))
                    });
                    known.collect::<Vec<_>>()
                };
                Ok(result.bins.iter().flat_map(of_bin).collect())
            }
        }
    }

    /// The shifts of all metrics from `before`, which must be of the same galaxies.
    pub fn shifts(
        &self,
        before: &Units,
        tolerance: &Tolerance,
    ) -> Result<Vec<Shift>, CatalogueError> {
        match (before, self) {
            (Units::Score(before), Units::Score(now)) => {
                check_sets(before, now)?;
                let shift = |metric| shift_of_score(metric, before, now, tolerance);
                Ok(scored_metrics().map(shift).collect())
            }
            (Units::Bias(before), Units::Bias(now)) => {
                let (old, new) = (before.result()?, now.result()?);
                let count = |own: &usize| format!("{own} catalogues");
                let catalogues = |about: &crate::bias::About| about.catalogues.len();
                same(
                    "the catalogues",
                    &catalogues(&new.about),
                    &catalogues(&old.about),
                    count,
                )?;
                let rows = |own: &u64| format!("{own} rows");
                same(
                    "the catalogues",
                    &new.about.total().rows,
                    &old.about.total().rows,
                    rows,
                )?;
                let list = |all: &Vec<String>| all.join("; ");
                same(
                    "the true shears",
                    &new.about.shears_in_words(),
                    &old.about.shears_in_words(),
                    list,
                )?;
                check_galaxies(&old, &new)?;
                let difference = now.difference(before)?;
                let bins = old.bins.iter().zip(&new.bins).zip(&difference.bins);
                let shifts = bins.flat_map(|((old, new), difference)| {
                    shifts_of_bin([old, new, difference], tolerance)
                });
                Ok(shifts.collect())
            }
            _ => Err(CatalogueError::OtherGalaxies {
                what: "the command and its metrics".into(),
                found: self.name().into(),
                expected: before.name().into(),
            }),
        }
    }

    fn name(&self) -> &'static str {
        match self {
            Units::Score(_) => "score",
            Units::Bias(_) => "bias",
        }
    }

    // By name, with `none` for columns that are not there.
    fn settings(&self) -> BTreeMap<String, String> {
        match self {
            Units::Score(sets) => {
                let all_equal = sets.iter().all(|own| own.convention == sets[0].convention);
                let name = |own: &ScoredUnits| match all_equal {
                    true => "convention".to_owned(),
                    false => format!("convention of set {}", own.set),
                };
                let of = |own: &ScoredUnits| (name(own), own.convention.clone());
                sets.iter().map(of).collect()
            }
            Units::Bias(summed) => summed.kind().iter().cloned().collect(),
        }
    }

    // What changed from the settings `before`, and columns of which only the name did.
    fn changed(&self, before: &Units) -> (Vec<String>, Vec<String>) {
        let (old, new) = (before.settings(), self.settings());
        let of = |all: &BTreeMap<String, String>, name: &String| {
            all.get(name).cloned().unwrap_or_else(|| "none".into())
        };
        let names: BTreeSet<&String> = old.keys().chain(new.keys()).collect();
        let changed = names
            .into_iter()
            .filter(|name| of(&old, name) != of(&new, name));
        let (renamed, changed): (Vec<_>, Vec<_>) = changed.partition(|name| {
            let is_name = named(name).is_some() || *name == "the program";
            is_name && old.contains_key(*name) && new.contains_key(*name)
        });
        let line = |name: &String| format!("{name}: {} ≠ {}", of(&old, name), of(&new, name));
        let renamed = renamed.into_iter().map(line);
        let renamed = renamed.map(|line| format!("another column: {line}"));
        (changed.into_iter().map(line).collect(), renamed.collect())
    }

    // Galaxies with an ellipticity.
    fn measured(&self) -> u64 {
        match self {
            Units::Score(sets) => sets.iter().map(|own| own.galaxies - own.flagged).sum(),
            Units::Bias(summed) => summed
                .result()
                .and_then(|result| Ok(result.all()?.galaxies as u64))
                .unwrap_or(0),
        }
    }

    fn rows(&self) -> u64 {
        match self {
            Units::Score(sets) => sets.iter().map(|own| own.galaxies).sum(),
            Units::Bias(summed) => summed
                .result()
                .map_or(0, |result| result.about.total().rows),
        }
    }
}

fn in_bin(key: &str, label: &str) -> String {
    match label {
        "all" => key.to_owned(),
        label => format!("{key}, {label}"),
    }
}

// Of a bin before, now, and of their difference.
fn shifts_of_bin(bins: [&BinResult; 3], tolerance: &Tolerance) -> Vec<Shift> {
    let shift = |key: &&str| {
        let [before, now, difference] = bins.map(|bin| {
            let found = bin.estimate.as_ref().ok().and_then(|own| own.value(key));
            found.map_or([f64::NAN; 2], |own| [own.value, own.error])
        });
        let is_known = !before[0].is_nan() || !now[0].is_nan();
        is_known.then(|| Shift {
            metric: in_bin(key, &bins[0].label),
            ..judged(key, before, now, difference[1], tolerance)
        })
    };
    BIASES.iter().filter_map(shift).collect()
}

// Refuses galaxies that are not those of the baseline: with other identifiers, a shift of 57 standard errors was one of 0.2.
fn check_galaxies(old: &BiasResult, new: &BiasResult) -> Result<(), CatalogueError> {
    let overlap = new.grouping.units.overlap(&old.grouping.units);
    // Their shapes cancel within a unit.
    let are_rotated = new.design == Design::Rotated;
    if overlap.is_of_same_galaxies() || are_rotated && overlap.is_shared() {
        return Ok(());
    }
    let unit = |result: &BiasResult| match &result.about.named_unit {
        Some(column) => format!("`{column}`"),
        None => result.grouping.unit.to_owned(),
    };
    let found = match overlap.is_shared() {
        false => format!("{:.0} % of them in the same units", 100.0 * overlap.shared),
        true => format!(
            "ellipticities that correlate by {:.2}",
            overlap.correlation.unwrap_or(f64::NAN)
        ),
    };
    Err(CatalogueError::OtherGalaxies {
        what: "the galaxies".into(),
        found: format!("{found}, units by {}", unit(new)),
        expected: format!("the same galaxies, units by {}", unit(old)),
    })
}

fn scored_metrics() -> impl Iterator<Item = Metric> {
    SCORED.iter().filter_map(|name| Metrics::named(name))
}

fn check_sets(before: &[ScoredUnits], now: &[ScoredUnits]) -> Result<(), CatalogueError> {
    let numbers = |all: &[ScoredUnits]| all.iter().map(|own| own.set).collect::<Vec<_>>();
    let list = |all: &Vec<u32>| format!("{all:?}");
    same("the sets", &numbers(now), &numbers(before), list)?;
    for (old, new) in before.iter().zip(now) {
        let of = |what: &str| match old.set {
            crate::catalogues::PLAIN_SET => format!("the {what}"),
            set => format!("the {what} of set {set}"),
        };
        same(&of("images"), &new.images, &old.images, list)?;
        same(&of("true shears"), &new.truth, &old.truth, |print| {
            print.chars().take(8).collect()
        })?;
    }
    Ok(())
}

// The mean over the sets that have the metric before and now.
fn shift_of_score(
    metric: Metric,
    before: &[ScoredUnits],
    now: &[ScoredUnits],
    tolerance: &Tolerance,
) -> Shift {
    let value = metric.value;
    let pairs = || before.iter().zip(now);
    let is_known = |(old, new): &(&ScoredUnits, &ScoredUnits)| {
        !value(&old.metrics).is_nan() && !value(&new.metrics).is_nan()
    };
    let mean = |all: Vec<&ScoredUnits>| {
        let each = all
            .iter()
            .map(|own| (value(&own.metrics), value(&own.errors)));
        let (value, error) = mean_over_sets(&each.collect::<Vec<_>>());
        [value, error]
    };
    let (old, new): (Vec<_>, Vec<_>) = pairs().filter(is_known).unzip();
    let replicates = |own: &&ScoredUnits| own.replicates.iter().map(value).collect::<Vec<f64>>();
    let kept: Vec<[Vec<f64>; 2]> = old
        .iter()
        .zip(&new)
        .map(|(old, new)| [replicates(old), replicates(new)])
        .collect();
    let paired: Vec<PairedSet<'_>> = old
        .iter()
        .zip(&new)
        .zip(&kept)
        .map(|((old, new), [first, second])| PairedSet {
            images: old.images.len(),
            first: value(&old.metrics),
            first_replicates: first,
            second: value(&new.metrics),
            second_replicates: second,
        })
        .collect();
    let error = paired_difference(&paired).map_or(f64::NAN, |found| found.error);
    let mut shift = judged(metric.name, mean(old), mean(new), error, tolerance);
    // A set that lost or gained the metric.
    shift.moved |=
        pairs().any(|(old, new)| value(&old.metrics).is_nan() != value(&new.metrics).is_nan());
    shift
}

fn judged(
    metric: &str,
    before: [f64; 2],
    now: [f64; 2],
    error: f64,
    tolerance: &Tolerance,
) -> Shift {
    let difference = now[0] - before[0];
    let size = tolerance.size(metric, before[0]);
    // `max` ignores an unknown error. A lost or gained metric differs by NaN, which is not within.
    let within = difference.abs() <= size.max(tolerance.sigma * error);
    let neither = before[0].is_nan() && now[0].is_nan();
    Shift {
        set: None,
        metric: metric.to_owned(),
        before,
        now,
        error,
        moved: !neither && !within,
    }
}

impl CatalogueBaseline {
    /// Where the units of the baseline at `path` are.
    pub fn units_path(path: &Path) -> PathBuf {
        path.with_extension("units.json")
    }

    /// `None` if the file is a baseline of configurations.
    pub fn read(path: &Path) -> Result<Option<(Self, Units)>, FileError> {
        let text = open::read_to_string(path, SETTINGS)
            .map_err(FileError::doing(path, "cannot read the baseline"))?;
        let wrong = |error: toml::de::Error| FileError::new(path, error.to_string().trim_end());
        let table: toml::Table = text.parse().map_err(wrong)?;
        if !table.contains_key("command") {
            return Ok(None);
        }
        let baseline: Self = toml::from_str(&text).map_err(wrong)?;
        let tolerance = baseline.tolerance.check();
        tolerance.map_err(|message| FileError::new(path, message))?;
        let place = Self::units_path(path);
        let bytes = open::read(&place, MAX_UNITS_BYTES).map_err(FileError::doing(
            &place,
            "cannot read the units of the baseline",
        ))?;
        let found = fingerprint::of_bytes(&bytes);
        if found != baseline.units {
            let message = format!(
                "these are not the units of {} (found the hash {found}, expected {})",
                path.display(),
                baseline.units
            );
            return Err(FileError::new(place, message).hint("both files of one `baseline record`"));
        }
        let units = serde_json::from_slice(&bytes)
            .map_err(FileError::doing(&place, "these are no units of a baseline"))?;
        Ok(Some((baseline, units)))
    }

    /// Writes the baseline of `units` to a new file, or over an earlier one.
    pub fn write(
        path: &Path,
        command: &[String],
        tolerance: Tolerance,
        units: &Units,
        catalogues: &[PathBuf],
        replace: bool,
    ) -> Result<(), CatalogueError> {
        let place = Self::units_path(path);
        let cannot = "cannot write the units of the baseline";
        let bytes = serde_json::to_vec(units).map_err(FileError::doing(&place, cannot))?;
        let mut prints = BTreeMap::new();
        for path in catalogues {
            prints.insert(path.display().to_string(), fingerprint::of_file(path)?);
        }
        let baseline = CatalogueBaseline {
            version: shearq_dataset::VERSION.into(),
            command: command.to_vec(),
            units: fingerprint::of_bytes(&bytes),
            galaxies: units.measured(),
            rows: units.rows(),
            tolerance,
            settings: units.settings(),
            metrics: units.metrics()?,
            catalogues: prints,
        };
        let text = toml::to_string(&baseline)
            .map_err(FileError::doing(path, "cannot write the baseline"))?;
        let folder = path.parent().unwrap_or(path);
        std::fs::create_dir_all(folder)
            .map_err(FileError::doing(folder, "cannot make the folder"))?;
        let _held = atomic::hold(folder)?;
        if !replace && path.exists() {
            return Err(super::Baseline::exists(path).into());
        }
        atomic::write(&place, &bytes)?;
        Ok(atomic::write(path, text.as_bytes())?)
    }

    /// Compares a later measurement with that of the baseline `name`.
    pub fn check(
        &self,
        name: &str,
        before: &Units,
        now: &Units,
    ) -> Result<Checked, CatalogueError> {
        let [was, is] = [before, now].map(Units::measured);
        let mut notes = vec![self.tolerance.described()];
        if let Units::Score(_) = now {
            let all = now.settings().into_iter();
            notes.extend(all.map(|(name, own)| format!("{name}: {own}")));
        }
        let (settings, renamed) = now.changed(before);
        notes.extend(renamed);
        if was != is {
            notes.push(format!("{is} galaxies count; {was} then"));
        }
        Ok(Checked {
            baseline: name.to_owned(),
            configuration: now.name().to_owned(),
            shifts: now.shifts(before, &self.tolerance)?,
            settings,
            notes,
        })
    }
}

// 8192 units of 100 numbers of 20 digits, and some. Chosen by hand.
const MAX_UNITS_BYTES: u64 = 1 << 28;

#[cfg(test)]
mod tests {
    use super::*;

    fn units(m: f64, noise: f64) -> Units {
        let of = |m: f64| {
            let mut values = [f64::NAN; Metrics::ALL.len()];
            for (place, own) in Metrics::ALL.iter().enumerate() {
                if ["q", "m_cross"].contains(&own.name) {
                    values[place] = if own.name == "q" { 50.0 } else { m };
                }
            }
            Metrics::from_values(values)
        };
        Units::Score(vec![ScoredUnits {
            set: 2,
            truth: "t".into(),
            images: (1..=20).collect(),
            galaxies: 100,
            flagged: 0,
            convention: described(Convention::STANDARD),
            metrics: of(m),
            errors: of(0.01),
            // The noise is the same before and now.
            replicates: (0..20)
                .map(|k| of(m + 0.01 * f64::from(k) + noise * f64::from(k % 3)))
                .collect(),
        }])
    }

    fn moved(before: &Units, now: &Units, tolerance: &Tolerance) -> Vec<String> {
        let shifts = now.shifts(before, tolerance).unwrap();
        let moved = shifts.into_iter().filter(|own| own.moved);
        moved.map(|own| own.metric).collect()
    }

    #[test]
    fn a_shift_must_exceed_its_paired_error_and_its_size() {
        let tolerance = Tolerance::default();
        let before = units(0.01, 0.0);
        // A fifth of the error of m alone.
        assert_eq!(moved(&before, &units(0.012, 0.0), &tolerance), ["m_cross"]);
        assert!(moved(&before, &units(0.0104, 0.0), &tolerance).is_empty());
        assert!(moved(&before, &before, &tolerance).is_empty());
        assert!(moved(&before, &units(0.012, 0.01), &tolerance).is_empty());
        assert_eq!(
            moved(&before, &units(f64::NAN, 0.0), &tolerance),
            ["m_cross"]
        );
    }

    #[test]
    fn tolerances_are_read_and_wild_ones_refused() {
        let mut tolerance = Tolerance::default();
        tolerance.set("m=1e-3").unwrap();
        assert_eq!(tolerance.m, 1e-3);
        for wrong in ["m", "m=x", "n=1", "c=-1", "sigma=nan", "relative=inf"] {
            assert!(Tolerance::default().set(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_changed_convention_is_a_changed_setting() {
        let before = units(0.01, 0.0);
        let Units::Score(mut sets) = before.clone() else {
            unreachable!("made above")
        };
        sets[0].convention = described(Convention::ALL[5]);
        let expected = ["convention: 5 (standard) ≠ 6 (e2 flipped)"];
        let (changed, _) = Units::Score(sets).changed(&before);
        assert_eq!(changed, expected);
        assert_eq!(before.changed(&before), (Vec::new(), Vec::new()));
    }

    #[test]
    fn other_truths_and_images_are_refused() {
        let before = units(0.01, 0.0);
        for change in [
            |own: &mut ScoredUnits| own.truth = "u".into(),
            |own: &mut ScoredUnits| own.images = vec![1],
            |own: &mut ScoredUnits| own.set = 3,
        ] {
            let Units::Score(mut sets) = before.clone() else {
                unreachable!("made above")
            };
            change(&mut sets[0]);
            let shifts = Units::Score(sets).shifts(&before, &Tolerance::default());
            assert!(matches!(shifts, Err(CatalogueError::OtherGalaxies { .. })));
        }
    }
}
