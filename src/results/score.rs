//! Scoring catalogues: read in parallel, added up in order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::{
    Choice, Convention, ConventionMatch, FieldSum, Figures, Grid, Options, RowCounts, SetImages,
    SetScore, SetScorer,
};

use crate::io::FileError;
use crate::io::layout::{DataFolder, MAX_SET, read_rows};
use crate::io::run::Run;
use crate::io::table::most_rows;
use crate::pipeline::simulate::kind_of;
use crate::pipeline::truth::{Reading, read_truth, reading_of};
use crate::pipeline::{PipelineError, engine, inputs};
use crate::simulate::kinds::SetKind;

/// Columns of our catalogues that are scored.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// The convention of what shearq measured, which it is in by construction.
pub const OWN: Choice = Choice::Insist(Convention::STANDARD);

/// The score of one set and where its rows went.
pub struct ScoredSet {
    /// Its number; a set given as plain files has none.
    pub set: Option<u32>,
    /// Its kind, if the data were simulated.
    pub kind: Option<SetKind>,
    /// Numbers of the images scored.
    pub images: Vec<u32>,
    /// The score.
    pub score: SetScore,
    /// How the catalogues' rows were used.
    pub rows: RowCounts,
    /// How the convention was chosen.
    pub basis: Basis,
}

/// What the convention of a submission's figures rests on. It is the same for all its sets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Basis {
    /// It was told, or is that of our own measurements.
    Told,
    /// It was matched to the truth of all sets together.
    Matched(ConventionMatch),
    /// The highest Q, set by set, as the leaderboard took it.
    HighestQ,
}

impl Basis {
    /// Whether the convention is known, so that differences from other submissions mean something.
    pub fn is_known(&self) -> bool {
        match self {
            Basis::Told => true,
            Basis::Matched(matching) => matching.is_clear(),
            Basis::HighestQ => false,
        }
    }
}

/// Reads one catalogue onto the grid.
pub type ReadImage<'a> =
    &'a (dyn Fn(&Grid, &Path) -> Result<(FieldSum, RowCounts), FileError> + Sync);

/// A [`ReadImage`] for catalogues that we wrote.
///
/// # Errors
/// Where one cannot be read.
pub fn own_catalogue(grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, read_rows(path, &COLUMNS, most_rows(grid))?);
    Ok((sum, counts))
}

/// Scores one set from a truth file and one catalogue per image.
///
/// # Errors
/// Where a file cannot be read, the truth does not fill a square grid, or no row falls on it.
pub fn score_files(
    truth: &Path,
    catalogues: &[PathBuf],
    reading: &Reading,
    read: ReadImage<'_>,
    options: Options,
    threads: usize,
) -> Result<ScoredSet, PipelineError> {
    let (grid, shear) = read_truth(truth, reading)?;
    let scoring = |source| PipelineError::Scoring { set: None, source };
    let scorer = SetScorer::new(grid, shear, options).map_err(scoring)?;
    let (images, rows) = add_up(&grid, catalogues, read, threads)?;
    let score = scorer.score(&images).map_err(scoring)?;
    Ok(ScoredSet {
        set: None,
        kind: None,
        images: (1..=catalogues.len() as u32).collect(),
        basis: match options.choice {
            Choice::Matched => Basis::Matched(score.matching),
            Choice::Best => Basis::HighestQ,
            Choice::Insist(_) => Basis::Told,
        },
        score,
        rows,
    })
}

/// Reads catalogues in parallel and adds them up in order.
fn add_up(
    grid: &Grid,
    catalogues: &[PathBuf],
    read: ReadImage<'_>,
    threads: usize,
) -> Result<(SetImages, RowCounts), PipelineError> {
    let mut images = SetImages::new(grid);
    let mut counts = RowCounts::default();
    engine::ordered(
        threads,
        |feeder| {
            for path in catalogues {
                if !feeder.push(path.clone()) {
                    break;
                }
            }
            Ok(())
        },
        || (),
        |(), path: PathBuf| Ok(read(grid, &path)?),
        |(sum, more)| {
            images.add(&sum);
            counts += more;
            Ok(())
        },
    )?;
    if counts.used == 0
        && counts.outside > 0
        && let Some(first) = catalogues.first()
    {
        let message = format!(
            "no row of the {} catalogue(s) falls on the {1} × {1} grid of {2} px stamps",
            catalogues.len(),
            grid.n,
            grid.stamp.0
        );
        return Err(FileError::new(first, message).into());
    }
    Ok((images, counts))
}

/// Catalogues of one variant of a measurement.
pub struct Catalogues<'a> {
    /// Those of a set that are there, by image number.
    pub of_set: &'a dyn Fn(u32) -> Vec<(u32, PathBuf)>,
    /// How one is read.
    pub read: ReadImage<'a>,
    /// Which convention they are scored in; [`Choice::Matched`] is one for all sets together.
    pub choice: Choice,
}

/// A set to score, and every variant's catalogues of it.
type SetFiles = (u32, Vec<Vec<(u32, PathBuf)>>);

/// Scores several variants on sets of a data folder: all sets of which every variant has
/// catalogues, or those of `sets`, which all must have. Of `options`, each variant has its own choice of a
/// convention.
///
/// # Errors
/// Where files are absent or damaged, or there is nothing to score.
pub fn score_variants(
    data: &DataFolder,
    variants: &[Catalogues<'_>],
    sets: &[u32],
    options: Options,
    threads: usize,
) -> Result<Vec<Vec<ScoredSet>>, PipelineError> {
    let sets = sets_to_score(variants, sets)?;
    let mut scored = Vec::new();
    for (k, variant) in variants.iter().enumerate() {
        let basis = match variant.choice {
            Choice::Matched => Basis::Matched(match_over_sets(data, &sets, k, variant, threads)?),
            Choice::Best => Basis::HighestQ,
            Choice::Insist(_) => Basis::Told,
        };
        let options = Options {
            choice: match basis {
                Basis::Matched(matching) => Choice::Insist(matching.convention()),
                Basis::Told | Basis::HighestQ => variant.choice,
            },
            ..options
        };
        let mut own = Vec::new();
        for (set, files) in &sets {
            let scoring = |source| PipelineError::Scoring {
                set: Some(*set),
                source,
            };
            let (scorer, images, rows) =
                prepare(data, *set, &files[k], variant.read, options, threads)?;
            own.push(ScoredSet {
                set: Some(*set),
                kind: kind_of(data, *set),
                images: files[k].iter().map(|file| file.0).collect(),
                score: scorer.score(&images).map_err(scoring)?,
                rows,
                basis,
            });
        }
        scored.push(own);
    }
    Ok(scored)
}

/// The sets of which every variant has catalogues.
fn sets_to_score(
    variants: &[Catalogues<'_>],
    wanted: &[u32],
) -> Result<Vec<SetFiles>, PipelineError> {
    let mut sets = Vec::new();
    for set in 1..=MAX_SET {
        if !wanted.is_empty() && !wanted.contains(&set) {
            continue;
        }
        let files = variants.iter().map(|v| (v.of_set)(set));
        let files: Vec<_> = files.take_while(|files| !files.is_empty()).collect();
        if files.len() == variants.len() {
            sets.push((set, files));
        } else if wanted.contains(&set) {
            let message = format!("there is no catalogue of set {set} to score");
            return Err(PipelineError::Request(message));
        }
    }
    if sets.is_empty() {
        let message = "there is no catalogue to score".into();
        return Err(PipelineError::Request(message));
    }
    Ok(sets)
}

/// How well each convention of the `k`-th variant goes with the truth of all sets together.
fn match_over_sets(
    data: &DataFolder,
    sets: &[SetFiles],
    k: usize,
    variant: &Catalogues<'_>,
    threads: usize,
) -> Result<ConventionMatch, PipelineError> {
    let mut all = ConventionMatch::default();
    for (set, files) in sets {
        let (scorer, images, _) = prepare(
            data,
            *set,
            &files[k],
            variant.read,
            Options::default(),
            threads,
        )?;
        all.merge(&scorer.match_convention(&images));
    }
    Ok(all)
}

/// One set's scorer and catalogues.
fn prepare(
    data: &DataFolder,
    set: u32,
    files: &[(u32, PathBuf)],
    read: ReadImage<'_>,
    options: Options,
    threads: usize,
) -> Result<(SetScorer, SetImages, RowCounts), PipelineError> {
    let (grid, shear) = read_truth(&data.truth(set), &reading_of(data, set)?)?;
    let scorer = SetScorer::new(grid, shear, options).map_err(|source| PipelineError::Scoring {
        set: Some(set),
        source,
    })?;
    let files: Vec<PathBuf> = files.iter().map(|file| file.1.clone()).collect();
    let (images, rows) = add_up(&grid, &files, read, threads)?;
    Ok((scorer, images, rows))
}

/// Scores sets of a data folder from catalogues found by `catalogues`: all sets that have some, or
/// those of `sets`, which then must have some.
///
/// # Errors
/// As [`score_variants`].
pub fn score_sets(
    data: &DataFolder,
    sets: &[u32],
    catalogues: impl Fn(u32) -> Vec<(u32, PathBuf)>,
    read: ReadImage<'_>,
    options: Options,
    threads: usize,
) -> Result<Vec<ScoredSet>, PipelineError> {
    let variant = Catalogues {
        of_set: &catalogues,
        read,
        choice: options.choice,
    };
    let scored = score_variants(data, &[variant], sets, options, threads)?;
    Ok(scored.into_iter().flatten().collect())
}

/// Scores every measured set of a results folder (or those of `sets`) against the truth of `data`.
///
/// # Errors
/// As [`score_sets`].
pub fn score_folder(
    data: &DataFolder,
    out: &Path,
    run: &Run,
    sets: &[u32],
    options: Options,
    threads: usize,
) -> Result<Vec<ScoredSet>, PipelineError> {
    inputs::verify(data, out, run, sets, threads)?;
    let files = run.catalogues(out, sets)?;
    let catalogues = |set| files.of_set(set);
    score_sets(data, sets, catalogues, &own_catalogue, options, threads).map_err(
        |error| match error {
            PipelineError::Request(message) => FileError::new(out, message).into(),
            other => other,
        },
    )
}

/// What of the images of `data`, of `sets` (of all if empty), was not scored, a line each.
///
/// # Errors
/// Where the data's folders cannot be listed.
pub fn unscored(
    data: &DataFolder,
    scored: &[ScoredSet],
    sets: &[u32],
) -> Result<Vec<String>, FileError> {
    let numbered = scored
        .iter()
        .filter_map(|scored| Some((scored.set?, scored.images.as_slice())));
    without_catalogue(data, &numbered.collect(), sets)
}

/// The same where `used` has the images of each set that there is a catalogue of.
///
/// # Errors
/// As [`unscored`].
pub fn without_catalogue(
    data: &DataFolder,
    used: &BTreeMap<u32, &[u32]>,
    sets: &[u32],
) -> Result<Vec<String>, FileError> {
    let images = data.images(sets)?;
    let mut absent = Vec::new();
    let unread = images.unread().into_iter();
    let mut lines: Vec<String> = unread.map(|line| format!("Warning: {line}.")).collect();
    for set in images.sets() {
        let there = images.of_set(set);
        let Some(used) = used.get(&set) else {
            absent.push(set.to_string());
            continue;
        };
        let lacking = there.iter().filter(|(image, _)| !used.contains(image));
        match lacking.count() {
            0 => {}
            count => lines.push(format!(
                "Warning: {count} of the {} images of set {set} have no catalogue; figures depend on the number of images.",
                there.len()
            )),
        }
    }
    if !absent.is_empty() {
        let absent = absent.join(", ");
        lines.push(format!(
            "Warning: there are data of sets without a catalogue: {absent}."
        ));
    }
    Ok(lines)
}

/// Means over sets of the headline figures and their errors.
pub fn means(scored: &[ScoredSet]) -> (Figures, Figures) {
    let columns: [(f64, f64); Figures::ALL.len()] = std::array::from_fn(|k| {
        let pairs: Vec<(f64, f64)> = scored
            .iter()
            .map(|s| (s.score.figures.values()[k], s.score.errors.values()[k]))
            .collect();
        mean_over_sets(&pairs)
    });
    (
        Figures::from_values(columns.map(|c| c.0)),
        Figures::from_values(columns.map(|c| c.1)),
    )
}
