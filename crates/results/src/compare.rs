//! Compares scores: methods on their common sets, recorded runs, and paired differences.

use std::cmp::Ordering;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use shearq_dataset::fingerprint;
use shearq_dataset::layout::{DataFolder, MAX_SET};
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::Pool;
use shearq_files::{FileError, names_of};
use shearq_render::table::Cell;
use shearq_scoring::resample::{PairedDifference, PairedSet, paired_difference};
use shearq_scoring::{Choice, Metrics, Options};
use shearq_submissions::{Published, Registry};
use thiserror::Error;

use crate::catalogues::Catalogues;
use crate::record::{Column, RunRecord, SetRecord, columns_named, compared};
use crate::score::{ScoreError, ScoredSet, score_variants, unscored};
use crate::submit::{Sent, Submission, is_packed};
use shearq_catalogue::expression::{Expression, Operand};

/// A method in a comparison.
#[derive(Debug, Clone)]
pub struct Variant {
    /// Name of the configuration or program, with the path if several have the name.
    pub name: String,
    pub published: Option<Published>,
    /// The sets that all variants have and that meet the conditions.
    pub run: RunRecord,
    scored: Vec<ScoredSet>,
    /// Warnings about images and files that were not scored.
    pub unscored: Vec<String>,
}

impl Variant {
    /// The scores of the compared sets.
    pub fn scored(&self) -> Vec<ScoredSet> {
        let compared = |scored: &&ScoredSet| {
            let mut sets = self.run.sets.iter();
            sets.any(|own| own.set == scored.record.set)
        };
        self.scored.iter().filter(compared).cloned().collect()
    }
}

/// The variants and their common sets that meet the conditions, in the given order.
pub fn chosen(
    variants: Vec<Variant>,
    condition: Option<&Expression>,
    order: Option<&Order>,
) -> Result<Vec<Variant>, ChoiceError> {
    let mut kept = Vec::new();
    for mut variant in variants {
        let mut runs = vec![variant.run];
        if let Some(condition) = condition {
            runs = choose(condition, runs)?;
        }
        if let Some(run) = runs.pop() {
            variant.run = run;
            kept.push(variant);
        }
    }
    if kept.is_empty() {
        return Err(ChoiceError::NoSet);
    }
    if keep_common_sets(kept.iter_mut().map(|variant| &mut variant.run)) == 0 {
        return Err(ChoiceError::NoCommonSet);
    }
    if let Some(order) = order {
        let key = |variant: &Variant| order.key(&variant.run);
        kept.sort_by(|a, b| in_order(&key(a), &key(b), order.descending));
    }
    Ok(kept)
}

/// Removes sets that not all runs have, and returns the number of the others.
pub fn keep_common_sets<'a>(runs: impl Iterator<Item = &'a mut RunRecord>) -> usize {
    let mut runs: Vec<&mut RunRecord> = runs.collect();
    let sets = runs
        .iter()
        .map(|run| run.sets.iter().map(|set| set.set).collect());
    let common = sets.reduce(|all: BTreeSet<u32>, more| &all & &more);
    let common = common.unwrap_or_default();
    for run in &mut runs {
        run.sets.retain(|set| common.contains(&set.set));
    }
    common.len()
}

/// Scores folders of results and submissions, and other programs' catalogues with the descriptions `foreign`, on their
/// common sets. `choice` replaces the usual convention of each. The truth is in `data`, or in the data that the first
/// folder was measured from.
pub fn score_all(
    folders: &[PathBuf],
    foreign: &[PathBuf],
    data: Option<&Path>,
    choice: Option<Choice>,
    options: Options,
    threads: usize,
) -> Result<Vec<Variant>, ScoreError> {
    let described = foreign.iter().map(|path| Catalogues::foreign(path, &[]));
    let described = described.collect::<Result<Vec<_>, _>>()?;
    let mut data = data.map(DataFolder::open).transpose()?;
    let mut all = given_catalogues(folders, &mut data, threads)?;
    all.extend(described);
    let data = data.ok_or(ScoreError::NoTruth)?;
    if all.iter().all(|own| own.files.serve_all_sets()) {
        return Err(ScoreError::NoSetNumber);
    }
    if let Some(empty) = all
        .iter()
        .find(|catalogues| catalogues.files.sets().is_empty())
    {
        return Err(ScoreError::NoCatalogueOf(empty.name.clone()));
    }
    let common = |set: u32| all.iter().all(|own| !own.files.of_set(set).is_empty());
    if !(0..=MAX_SET).any(common) {
        return Err(ScoreError::NoCommonSet);
    }
    let variants = all.iter().map(|own| (own, choice.unwrap_or(own.choice())));
    let variants: Vec<(&Catalogues, Choice)> = variants.collect();
    let scored = score_variants(&data, &variants, &[], options, threads)?;
    let registry = Registry::embedded()?;
    let mut found = Vec::new();
    for (&(catalogues, choice), scored) in variants.iter().zip(scored) {
        let sets: Vec<SetRecord> = scored.iter().map(|set| set.record.clone()).collect();
        let numbers: Vec<u32> = sets.iter().map(|set| set.set).collect();
        let unread = catalogues.files.unread().into_iter();
        let mut warnings: Vec<String> = unread.map(|line| format!("warning: {line}.")).collect();
        warnings.extend(unscored(&data, &scored, &numbers)?);
        let name = &catalogues.name;
        warnings.extend(catalogues.account()?);
        found.push(Variant {
            // Runs of one name may have other settings or versions.
            name: match all.iter().filter(|other| other.name == *name).count() {
                1 => name.clone(),
                _ => format!("{name} ({})", catalogues.path.display()),
            },
            // Published metrics belong to the built-in settings, not to a file with their name.
            published: catalogues.run.as_ref().and_then(|run| {
                let entry = registry.get(&run.configuration.name).ok()?;
                (entry.configuration == run.configuration).then_some(entry.published)?
            }),
            run: RunRecord::new(
                name,
                &catalogues.settings,
                data.root().display().to_string(),
                Options { choice, ..options },
                sets,
            ),
            scored,
            unscored: warnings,
        });
    }
    Ok(found)
}

// The catalogues of folders and submissions. `data` becomes the data of the first folder, if it is `None`.
fn given_catalogues(
    folders: &[PathBuf],
    data: &mut Option<DataFolder>,
    threads: usize,
) -> Result<Vec<Catalogues>, ScoreError> {
    let given = data.is_some();
    let mut first: Option<(&Path, Source)> = None;
    let mut found = Vec::new();
    for folder in folders {
        if is_packed(folder) {
            // Its files do not lead to the data.
            let Some(data) = data.as_ref().filter(|_| given) else {
                let message = "a submission needs the true shear";
                return Err(FileError::new(folder, message).hint("--data DIR").into());
            };
            let sent = Sent::open(folder)?;
            let submission = Submission::read(&sent)?;
            found.push(Catalogues::packed(sent, submission, data)?);
            continue;
        }
        let run = Run::require(folder)?;
        if !given {
            let (beside, source) = first.get_or_insert_with(|| (folder, run.source.clone()));
            if *source != run.source.moved(folder, beside)? {
                let message = format!(
                    "the folders were measured from different data (found {}, expected {source})",
                    run.source
                );
                return Err(FileError::new(folder, message)
                    .hint("--data DIR with the truth of both")
                    .into());
            }
        }
        let data = match data {
            Some(data) => data,
            None => data.insert(run.source.data(folder).map_err(|error| {
                let message = format!(
                    "{} (the data folder of {}; --data gives another)",
                    error.text(),
                    folder.display()
                );
                FileError::new(error.path, message)
            })?),
        };
        // Catalogues of other images than those of the truth would have a low Q without any warning.
        fingerprint::verify(data, folder, &run, &[], &Pool::new(threads)?)?;
        found.push(Catalogues::measured(&run, folder, &[])?);
    }
    Ok(found)
}

/// Why sets cannot be chosen.
#[derive(Debug, Error)]
pub enum ChoiceError {
    #[error(
        "--where: unknown column of a results store (found `{found}`, expected one of {known})"
    )]
    UnknownColumn { found: String, known: String },
    #[error(
        "--where: column `{0}` contains numbers (found a comparison with a text, expected a number)"
    )]
    Numbers(String),
    #[error(
        "--where: column `{0}` contains text (expected == or != with a text in quotation marks, such as {0} == 'a*')"
    )]
    Text(String),
    #[error("--where: no set meets the conditions")]
    NoSet,
    #[error("--where: the sets that meet the conditions have none in common")]
    NoCommonSet,
}

/// Keeps the sets of each run for which the `condition` holds, and drops runs without such a set.
pub fn choose(
    condition: &Expression,
    mut runs: Vec<RunRecord>,
) -> Result<Vec<RunRecord>, ChoiceError> {
    let operands = condition.operands().iter().map(compared_column);
    let columns: Vec<Column> = operands.collect::<Result<_, _>>()?;
    for run in &mut runs {
        let mut sets = std::mem::take(&mut run.sets);
        sets.retain(|set| {
            let holds = condition.holds(&|place| match (
                &condition.operands()[place].texts,
                columns[place].number(set),
            ) {
                (_, Some(number)) => condition.operands()[place].of_number(number),
                (texts, None) => {
                    let text = columns[place].text(run, set).unwrap_or_default();
                    texts.as_ref().map_or(0.0, |own| own.value(&text))
                }
            });
            // A missing number, such as Q of a set without errors, meets no condition.
            holds == Some(true)
        });
        run.sets = sets;
    }
    runs.retain(|run| !run.sets.is_empty());
    Ok(runs)
}

fn compared_column(
    Operand {
        column: name,
        texts,
        ..
    }: &Operand,
) -> Result<Column, ChoiceError> {
    let Some((_, column)) = compared().find(|(own, _)| own == name) else {
        let known: Vec<String> = compared().map(|(name, _)| name).collect();
        return Err(ChoiceError::UnknownColumn {
            found: name.clone(),
            known: names_of(&known),
        });
    };
    match (texts, column.is_text()) {
        (Some(_), false) => Err(ChoiceError::Numbers(name.clone())),
        (None, true) => Err(ChoiceError::Text(name.clone())),
        _ => Ok(column),
    }
}

/// Field and direction of sorting: `q:desc`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Order {
    field: String,
    descending: bool,
}

// Fields other than metrics to sort by.
const SORTED: [&str; 4] = ["submission", "run", "version", "images"];

impl FromStr for Order {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (field, descending) = match text.split_once(':') {
            None => (text, false),
            Some((field, "asc")) => (field, false),
            Some((field, "desc")) => (field, true),
            Some((_, other)) => {
                return Err(format!(
                    "unknown order (found `{other}`, expected `asc` or `desc`)"
                ));
            }
        };
        if !SORTED.contains(&field) && Metrics::named(field).is_none() {
            return Err(format!(
                "cannot sort by `{field}`; expected one of {}, {}",
                SORTED.join(", "),
                Metrics::ALL.map(|metric| metric.name).join(", ")
            ));
        }
        Ok(Order {
            field: field.to_owned(),
            descending,
        })
    }
}

impl Order {
    fn key(&self, run: &RunRecord) -> Cell {
        let column = columns_named(&[&self.field]).pop();
        column.map_or(Cell::Empty, |column| column.cell(run))
    }

    pub fn sort(&self, runs: &mut [RunRecord]) {
        runs.sort_by(|a, b| in_order(&self.key(a), &self.key(b), self.descending));
    }
}

// Compares two cells of a column. NaN comes last in both directions.
fn in_order(a: &Cell, b: &Cell, descending: bool) -> Ordering {
    let order = match (a, b) {
        (Cell::Text(a), Cell::Text(b)) => a.cmp(b),
        (Cell::Number { value: a, .. }, Cell::Number { value: b, .. }) => {
            if a.is_nan() || b.is_nan() {
                return a.is_nan().cmp(&b.is_nan());
            }
            a.total_cmp(b)
        }
        _ => Ordering::Equal,
    };
    if descending { order.reverse() } else { order }
}

/// A metric with jackknife replicates, so that differences can be paired.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Paired {
    Q,
    Calibrated,
}

impl Paired {
    fn of(self, set: &SetRecord) -> (f64, &[f64]) {
        match self {
            Paired::Q => (set.metrics.q, &set.q_replicates),
            Paired::Calibrated => (set.metrics.q_calibrated, &set.q_calibrated_replicates),
        }
    }
}

/// Paired difference of a metric, `second` minus `first`. `None` if sets, data or images differ, or if a convention is
/// uncertain: a wrong convention changes Q by more than methods do.
pub fn difference(
    metric: Paired,
    first: &[SetRecord],
    second: &[SetRecord],
) -> Option<PairedDifference> {
    let mut pairs = Vec::new();
    for (a, b) in first.iter().zip(second) {
        // Replicates of other images do not share their noise.
        let known = a.convention_known && b.convention_known;
        if !(known && a.set == b.set && a.data == b.data && a.images == b.images) {
            return None;
        }
        let ((first, first_replicates), (second, second_replicates)) = (metric.of(a), metric.of(b));
        pairs.push(PairedSet {
            images: a.images.len(),
            first,
            first_replicates,
            second,
            second_replicates,
        });
    }
    (first.len() == second.len()).then(|| paired_difference(&pairs))?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_checked() {
        assert!("q:desc".parse::<Order>().unwrap().descending);
        assert!("q:down".parse::<Order>().is_err() && "colour".parse::<Order>().is_err());
    }

    #[test]
    fn nan_comes_last_in_both_directions() {
        let (one, two, none) = (1.0, 2.0, f64::NAN);
        for (a, b, descending, expected) in [
            (one, two, false, Ordering::Less),
            (one, two, true, Ordering::Greater),
            (none, two, false, Ordering::Greater),
            (none, two, true, Ordering::Greater),
            (one, none, true, Ordering::Less),
            (none, none, true, Ordering::Equal),
        ] {
            let found = in_order(&Cell::number(a, 0), &Cell::number(b, 0), descending);
            assert_eq!(found, expected, "{a} {b} {descending}");
        }
    }
}
