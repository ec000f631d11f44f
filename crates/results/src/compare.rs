//! Compares scores: common sets, means over sets, and paired differences.

use std::borrow::Borrow;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use shearq_scoring::resample::{PairedDifference, PairedSet, paired_difference};
use shearq_scoring::{Choice, Definition, FieldSum, Grid, Options, RowCounts};
use shearq_submissions::{Published, Registry};

use super::conditions::{ChoiceError, choose};
use super::expression::Expression;
use super::foreign::Foreign;
use super::groups::Order;
use super::row::{RunRecord, SetRecord, choice_word, definition_word};
use super::score::{Catalogues, ScoredSet, own_catalogue, score_variants, unscored};
use super::submit::packed::PackedCatalogues;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::layout::MAX_SET;
use shearq_dataset::listing::Files;
use shearq_dataset::run::{Run, Source};
use shearq_files::FileError;
use shearq_pipeline::{PipelineError, inputs};

/// One variant in a comparison: a folder, or another program's catalogues.
#[derive(Debug, Clone)]
pub struct Variant {
    /// Name of the configuration or program.
    pub name: String,
    /// Published metrics.
    pub published: Option<Published>,
    /// The sets that all variants have, in ascending order.
    pub sets: Vec<ScoredSet>,
    /// Warnings about images and files that were not scored.
    pub unscored: Vec<String>,
    /// Its record, as in a results store.
    pub run: RunRecord,
}

impl Variant {
    /// Records of its sets.
    pub fn records(&self) -> Vec<SetRecord> {
        self.run.sets.clone()
    }
}

/// Records of sets that are scored against one truth, whose data need no fingerprint.
fn records(sets: &[ScoredSet]) -> Vec<SetRecord> {
    let record = |scored: &ScoredSet| Some(SetRecord::new(scored.set?, scored, String::new()));
    sets.iter().filter_map(record).collect()
}

/// The variants and sets that meet the conditions, in the given order.
///
/// # Errors
/// If a condition has an unknown column, or no set meets the conditions.
pub fn chosen(
    variants: Vec<Variant>,
    condition: Option<&Expression>,
    order: Option<&Order>,
) -> Result<Vec<Variant>, ChoiceError> {
    let mut kept = Vec::new();
    for mut variant in variants {
        if let Some(condition) = condition {
            let left = choose(condition, vec![variant.run])?;
            let Some(run) = left.into_iter().next() else {
                continue;
            };
            let holds = |set: &ScoredSet| run.sets.iter().any(|own| Some(own.set) == set.set);
            variant.sets.retain(holds);
            variant.run = run;
        }
        kept.push(variant);
    }
    if kept.is_empty() {
        return Err(ChoiceError::NoSet);
    }
    let sets: Vec<Vec<SetRecord>> = kept.iter().map(Variant::records).collect();
    if common_sets(&sets).is_empty() {
        return Err(ChoiceError::NoCommonSet);
    }
    if let Some(order) = order {
        kept.sort_by(|a, b| order.compare(&a.run, &b.run));
    }
    Ok(kept)
}

/// Names of variants with the records of their sets.
pub fn by_name(variants: &[Variant]) -> Vec<(String, Vec<SetRecord>)> {
    let named = |variant: &Variant| (variant.name.clone(), variant.records());
    variants.iter().map(named).collect()
}

/// A variant before it is scored.
struct Entrant<'a> {
    name: String,
    /// Folder, archive or file.
    path: PathBuf,
    published: Option<Published>,
    catalogues: Origin<'a>,
    settings: String,
}

/// Where the catalogues of a variant come from.
enum Origin<'a> {
    /// A folder that shearq measured.
    Measured(Files),
    /// Another program.
    Foreign(&'a Foreign, Files),
    /// A submission.
    Packed(Box<PackedCatalogues>),
}

impl Origin<'_> {
    fn of_set(&self, set: u32) -> Vec<(u32, PathBuf)> {
        match self {
            Origin::Measured(files) | Origin::Foreign(_, files) => files.of_set(set),
            Origin::Packed(packed) => packed.of_set(set),
        }
    }

    fn sets(&self) -> Vec<u32> {
        match self {
            Origin::Measured(files) | Origin::Foreign(_, files) => files.sets(),
            Origin::Packed(packed) => packed.sets(),
        }
    }

    /// Whether one pattern without a set number serves all sets.
    fn serve_all_sets(&self) -> bool {
        match self {
            Origin::Measured(files) | Origin::Foreign(_, files) => files.serve_all_sets(),
            Origin::Packed(_) => false,
        }
    }

    fn unread(&self) -> Vec<String> {
        match self {
            Origin::Measured(files) | Origin::Foreign(_, files) => files.unread(),
            Origin::Packed(_) => Vec::new(),
        }
    }

    fn sum(&self, grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
        match self {
            Origin::Measured(_) => own_catalogue(grid, path),
            Origin::Foreign(foreign, _) => foreign.sum(grid, path),
            Origin::Packed(packed) => packed.sum(grid, path),
        }
    }

    fn choice(&self, way: Way) -> Choice {
        match self {
            Origin::Measured(_) => way.own,
            Origin::Packed(packed) if packed.is_own() => way.own,
            Origin::Foreign(..) | Origin::Packed(_) => way.foreign,
        }
    }
}

/// How variants are scored.
#[derive(Debug, Clone, Copy)]
pub struct Way {
    /// Bandpower definition.
    pub definition: Definition,
    /// Convention of what shearq measured.
    pub own: Choice,
    /// Convention of other programs' catalogues.
    pub foreign: Choice,
}

/// Scores results folders, and other programs' catalogues described by the files `foreign`, on their common sets.
/// The truth is in `data`, or in the data that the first folder was measured from.
///
/// # Errors
/// If a file cannot be read, the folders have several sources, or no set is common.
pub fn score_all(
    folders: &[PathBuf],
    foreign: &[PathBuf],
    data: Option<&Path>,
    way: Way,
    threads: usize,
) -> Result<Vec<Variant>, PipelineError> {
    let files = foreign;
    let foreign: Vec<Foreign> = files
        .iter()
        .map(|path| Foreign::read(path))
        .collect::<Result<_, _>>()?;
    let mut data = data.map(DataFolder::open).transpose()?;
    let mut entrants = own_entrants(folders, &mut data, threads)?;
    let data = data.ok_or_else(|| {
        PipelineError::Request("--foreign needs the true shear. Try: --data DIR".into())
    })?;
    for (path, foreign) in files.iter().zip(&foreign) {
        entrants.push(Entrant {
            name: foreign.name.clone(),
            path: path.clone(),
            published: None,
            catalogues: Origin::Foreign(foreign, foreign.catalogues(&[])?),
            settings: foreign.pattern().display().to_string(),
        });
    }
    if entrants.iter().all(|e| e.catalogues.serve_all_sets()) {
        let message = "cannot determine the sets, because no `catalogues` contains {set}. Try: add {set} to the pattern";
        return Err(PipelineError::Request(message.into()));
    }
    if let Some(entrant) = entrants.iter().find(|e| e.catalogues.sets().is_empty()) {
        let message = format!("{}: there is no catalogue to score", entrant.name);
        return Err(PipelineError::Request(message));
    }
    let common = |set: u32| {
        entrants
            .iter()
            .all(|e| !e.catalogues.of_set(set).is_empty())
    };
    if !(1..=MAX_SET).any(common) {
        let message = "the catalogues have no set in common".into();
        return Err(PipelineError::Request(message));
    }
    let readers: Vec<_> = entrants
        .iter()
        .map(|entrant| |grid: &Grid, path: &Path| entrant.catalogues.sum(grid, path))
        .collect();
    let of_set: Vec<_> = entrants
        .iter()
        .map(|entrant| |set: u32| entrant.catalogues.of_set(set))
        .collect();
    let catalogues: Vec<Catalogues<'_>> = entrants
        .iter()
        .zip(of_set.iter().zip(&readers))
        .map(|(entrant, (of_set, read))| Catalogues {
            of_set,
            read,
            choice: entrant.catalogues.choice(way),
        })
        .collect();
    let options = Options {
        definition: way.definition,
        ..Options::default()
    };
    let scored = score_variants(&data, &catalogues, &[], options, threads)?;
    entrants
        .iter()
        .zip(scored)
        .map(|(entrant, sets)| {
            let numbers: Vec<u32> = sets.iter().filter_map(|set| set.set).collect();
            let run = RunRecord {
                configuration: entrant.name.clone(),
                version: shearq_dataset::VERSION.into(),
                settings: entrant.settings.clone(),
                source: data.root().display().to_string(),
                definition: definition_word(way.definition).into(),
                choice: choice_word(entrant.catalogues.choice(way)),
                noise: "measured".into(),
                sets: records(&sets),
            };
            let alike = entrants.iter().filter(|own| own.name == entrant.name);
            Ok(Variant {
                // Runs of one name may have other settings or versions.
                name: match alike.count() {
                    1 => entrant.name.clone(),
                    _ => format!("{} ({})", entrant.name, entrant.path.display()),
                },
                published: entrant.published,
                unscored: {
                    let unread = entrant.catalogues.unread().into_iter();
                    let mut lines: Vec<String> =
                        unread.map(|line| format!("warning: {line}.")).collect();
                    lines.extend(unscored(&data, &sets, &numbers)?);
                    lines
                },
                sets,
                run,
            })
        })
        .collect()
}

/// The folders that shearq measured. `data` becomes the data of the first, if it is `None`.
fn own_entrants(
    folders: &[PathBuf],
    data: &mut Option<DataFolder>,
    threads: usize,
) -> Result<Vec<Entrant<'static>>, PipelineError> {
    let registry =
        Registry::embedded().map_err(|error| PipelineError::Request(error.to_string()))?;
    let given = data.is_some();
    let mut first: Option<(&Path, Source)> = None;
    let mut entrants = Vec::new();
    for folder in folders {
        if PackedCatalogues::is_packed(folder) {
            entrants.push(packed_entrant(folder, given)?);
            continue;
        }
        let run = Run::require(folder)?;
        if !given {
            let (beside, source) = first.get_or_insert_with(|| (folder, run.source.clone()));
            if *source != run.source.moved(folder, beside)? {
                let message = format!(
                    "the folders were measured from different data (found {}, expected {source}). Try: --data DIR with the truth of both",
                    run.source
                );
                return Err(FileError::new(folder, message).into());
            }
        }
        if data.is_none() {
            let hinted = |FileError { path, message, .. }| {
                let place = folder.display();
                let hint = format!("{message} (the data folder of {place}; --data gives another)");
                FileError::new(path, hint)
            };
            *data = Some(run.source.data(folder).map_err(hinted)?);
        }
        if let Some(data) = data {
            inputs::verify(data, folder, &run, &[], threads)?;
        }
        entrants.push(Entrant {
            path: folder.clone(),
            // Published metrics belong to the built-in settings, not to a file with their name.
            published: registry
                .get(&run.configuration.name)
                .ok()
                .filter(|entry| entry.configuration == run.configuration)
                .and_then(|entry| entry.published),
            name: run.configuration.name.clone(),
            catalogues: Origin::Measured(run.catalogues(folder, &[])?),
            settings: toml::to_string(&run.configuration).map_err(FileError::doing(
                folder,
                "cannot write the settings as TOML",
            ))?,
        });
    }
    Ok(entrants)
}

/// A submission. Its files do not lead to the data, so these must be `given`.
fn packed_entrant(path: &Path, given: bool) -> Result<Entrant<'static>, PipelineError> {
    if !given {
        let message = "a submission needs the true shear. Try: --data DIR";
        return Err(FileError::new(path, message).into());
    }
    let packed = PackedCatalogues::open(path)?;
    let run = packed
        .manifest
        .as_ref()
        .and_then(|manifest| manifest.run.as_ref());
    let settings = run.map(|run| toml::to_string(&run.configuration));
    let settings = settings.unwrap_or_else(|| Ok(path.display().to_string()));
    Ok(Entrant {
        path: path.to_owned(),
        name: packed.method.clone(),
        published: None,
        settings: settings.map_err(FileError::doing(path, "cannot write the settings as TOML"))?,
        catalogues: Origin::Packed(Box::new(packed)),
    })
}

/// Sets that all variants have.
pub fn common_sets(all: &[Vec<SetRecord>]) -> BTreeSet<u32> {
    all.iter()
        .map(|sets| sets.iter().map(|set| set.set).collect())
        .reduce(|all: BTreeSet<u32>, more| &all & &more)
        .unwrap_or_default()
}

/// A metric with jackknife replicates, so that differences can be paired.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Paired {
    /// Q.
    Q,
    /// Calibrated Q.
    Calibrated,
}

impl Paired {
    /// Value of a set, and the values with each group of images left out.
    fn of(self, set: &SetRecord) -> (f64, &[f64]) {
        match self {
            Paired::Q => (set.metrics.q, &set.q_replicates),
            Paired::Calibrated => (set.metrics.q_calibrated, &set.q_calibrated_replicates),
        }
    }
}

/// Paired difference of a metric, `second` minus `first`. `None` if sets, data or images differ, or if a convention
/// is uncertain.
pub fn difference<R: Borrow<SetRecord>>(
    metric: Paired,
    first: &[R],
    second: &[R],
) -> Option<PairedDifference> {
    let pairs = || {
        let sets = first.iter().zip(second);
        sets.map(|(a, b)| (a.borrow(), b.borrow()))
    };
    let same = |(a, b): (&SetRecord, &SetRecord)| {
        let known = a.convention_known && b.convention_known;
        known && a.set == b.set && a.data == b.data && a.images == b.images
    };
    if first.len() != second.len() || !pairs().all(same) {
        return None;
    }
    let pairs: Vec<PairedSet<'_>> = pairs()
        .map(|(a, b)| {
            let ((first, first_replicates), (second, second_replicates)) =
                (metric.of(a), metric.of(b));
            PairedSet {
                images: a.images.len(),
                first,
                first_replicates,
                second,
                second_replicates,
            }
        })
        .collect();
    paired_difference(&pairs)
}
