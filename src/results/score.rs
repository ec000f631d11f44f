//! Scoring catalogues: read in parallel, added up in order.

use std::path::{Path, PathBuf};

use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::units::{Degrees, Pixels};
use shearq_scoring::{
    Choice, Convention, ConventionMatch, FieldSum, Figures, Grid, Options, Row, RowCounts,
    SetImages, SetScore, SetScorer, TrueShear, TruthSign,
};

use super::PipelineError;
use super::{engine, grid, inputs};
use crate::io::FileError;
use crate::io::layout::{DataFolder, MAX_SET, read_rows, read_truth_rows};
use crate::io::run::Run;
use crate::io::table::most_rows;

/// Columns of our catalogues that are scored.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// The convention of what shearq measured, which it is in by construction.
pub const OWN: Choice = Choice::Insist(Convention::STANDARD);

/// The score of one set and where its rows went.
pub struct ScoredSet {
    /// Set number; 0 for a set given as plain files.
    pub set: u32,
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

/// How a truth file is to be read.
#[derive(Debug, Clone, Copy)]
pub struct Reading {
    /// Side of the field in degrees.
    pub field: Degrees,
    /// Pixels a side of a cell.
    pub stamp: Pixels,
    /// Sign of g2 in the truth.
    pub sign: TruthSign,
}

/// Reads one catalogue onto the grid.
pub type ReadImage<'a> =
    &'a (dyn Fn(&Grid, &Path) -> Result<(FieldSum, RowCounts), FileError> + Sync);

/// Which values of other programs' ellipticities stand for "not measured".
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Deserialize)]
pub struct Screen {
    /// A value of either component.
    pub missing: Option<f64>,
    /// The largest |e| that is one.
    pub max_modulus: Option<f64>,
}

impl Screen {
    /// The row, without an ellipticity where its value stands for none.
    pub fn apply(&self, row: Row) -> Row {
        let missing = self.missing.is_some_and(|m| row.e1 == m || row.e2 == m);
        if missing
            || self
                .max_modulus
                .is_some_and(|max| row.e1.hypot(row.e2) > max)
        {
            return Row {
                e1: f64::NAN,
                e2: f64::NAN,
                ..row
            };
        }
        row
    }
}

/// A [`ReadImage`] for catalogues that we wrote.
///
/// # Errors
/// Where one cannot be read.
pub fn own_catalogue(grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, read_rows(path, &COLUMNS, most_rows(grid))?);
    Ok((sum, counts))
}

/// Sums rows of another program, of the catalogue `path`.
///
/// # Errors
/// Where they are not what they are taken for: values that are no ellipticities, positions in other units.
pub fn sum_foreign(
    grid: &Grid,
    path: &Path,
    rows: impl IntoIterator<Item = Row>,
) -> Result<(FieldSum, RowCounts), FileError> {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, rows);
    match counts.fault(grid) {
        Some(fault) => Err(FileError::new(path, fault)),
        None => Ok((sum, counts)),
    }
}

/// A [`ReadImage`] for other programs' catalogues with the given columns.
pub fn plain_columns<'a>(
    columns: [&'a str; 4],
    screen: Screen,
) -> impl Fn(&Grid, &Path) -> Result<(FieldSum, RowCounts), FileError> + Sync + 'a {
    move |grid, path| {
        let rows = read_rows(path, &columns, most_rows(grid))?;
        sum_foreign(grid, path, rows.into_iter().map(|row| screen.apply(row)))
    }
}

/// The true shear of a file on its grid, whose side is the square root of the number of rows.
///
/// # Errors
/// Where the file cannot be read or does not fill a square grid.
pub fn read_truth(truth: &Path, reading: &Reading) -> Result<(Grid, TrueShear), FileError> {
    let rows = read_truth_rows(truth)?;
    let side = grid::side(truth, rows.len())?;
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let shear = TrueShear::from_rows(&grid, reading.sign, rows).map_err(bad)?;
    Ok((grid, shear))
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
    let scoring = |source| PipelineError::Scoring { set: 0, source };
    let scorer = SetScorer::new(grid, shear, options).map_err(scoring)?;
    let (images, rows) = add_up(&grid, catalogues, read, threads)?;
    let score = scorer.score(&images).map_err(scoring)?;
    Ok(ScoredSet {
        set: 0,
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

/// How the truth of a set of a data folder is to be read.
///
/// # Errors
/// Where the set's first image cannot be read.
pub fn reading_of(data: &DataFolder, set: u32) -> Result<Reading, FileError> {
    Ok(Reading {
        field: Degrees(data.layout().field_degrees),
        stamp: Pixels(grid::stamp_of_set(data, set)? as f64),
        sign: data.layout().truth_sign,
    })
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
            let scoring = |source| PipelineError::Scoring { set: *set, source };
            let (scorer, images, rows) =
                prepare(data, *set, &files[k], variant.read, options, threads)?;
            own.push(ScoredSet {
                set: *set,
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
        let files: Vec<_> = variants.iter().map(|v| (v.of_set)(set)).collect();
        if files.iter().all(|files| !files.is_empty()) {
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
    let scorer = SetScorer::new(grid, shear, options)
        .map_err(|source| PipelineError::Scoring { set, source })?;
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
