//! Scoring catalogues: read in parallel, added up in order.

use std::path::{Path, PathBuf};

use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::units::{Degrees, Pixels};
use shearq_scoring::{
    FieldSum, Figures, Grid, Options, Row, RowCounts, SetImages, SetScore, SetScorer, TrueShear,
    TruthSign,
};

use super::PipelineError;
use super::engine;
use crate::io::FileError;
use crate::io::layout::{DataFolder, MAX_SET, read_rows, read_truth_rows};
use crate::io::run::Run;

/// Columns of our catalogues that are scored.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

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

/// A [`ReadImage`] for catalogues with the given columns in standard signs.
pub fn plain_columns<'a>(
    columns: [&'a str; 4],
) -> impl Fn(&Grid, &Path) -> Result<(FieldSum, RowCounts), FileError> + Sync + 'a {
    move |grid, path| {
        let rows: Vec<Row> = read_rows(path, &columns)?;
        let mut sum = FieldSum::new(grid);
        let counts = sum.add_image(grid, rows);
        Ok((sum, counts))
    }
}

/// The true shear of a file on its grid, whose side is the square root of the number of rows.
///
/// # Errors
/// Where the file cannot be read or does not fill a square grid.
pub fn read_truth(truth: &Path, reading: &Reading) -> Result<(Grid, TrueShear), FileError> {
    let rows = read_truth_rows(truth)?;
    let side = grid_side(truth, rows.len())?;
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let shear = TrueShear::from_rows(&grid, reading.sign, rows).map_err(bad)?;
    Ok((grid, shear))
}

/// Side of the grid that a file with one row per cell fills.
///
/// # Errors
/// Where the number of rows is no square.
pub fn grid_side(path: &Path, rows: usize) -> Result<usize, FileError> {
    Grid::side_of(rows).ok_or_else(|| {
        let message = format!("{rows} rows; expected the square of the grid's side");
        FileError::new(path, message)
    })
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
) -> Result<(SetScore, RowCounts), PipelineError> {
    let (grid, shear) = read_truth(truth, reading)?;
    let scoring = |source| PipelineError::Scoring { set: 0, source };
    let scorer = SetScorer::new(grid, shear, options).map_err(scoring)?;
    let (images, rows) = add_up(&grid, catalogues, read, threads)?;
    Ok((scorer.score(&images).map_err(scoring)?, rows))
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

/// How the truth of a data folder is to be read.
pub fn reading_of(data: &DataFolder) -> Reading {
    let layout = data.layout();
    Reading {
        field: Degrees(layout.field_degrees),
        stamp: Pixels(layout.stamp as f64),
        sign: layout.truth_sign,
    }
}

/// Catalogues of one variant of a measurement.
pub struct Catalogues<'a> {
    /// Those of a set that are there, by image number.
    pub of_set: &'a dyn Fn(u32) -> Vec<(u32, PathBuf)>,
    /// How one is read.
    pub read: ReadImage<'a>,
}

/// Scores several variants on sets of a data folder: all sets of which every variant has
/// catalogues, or those of `sets`, which all must have. The truth of each set is read once.
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
    let reading = reading_of(data);
    let mut scored: Vec<Vec<ScoredSet>> = variants.iter().map(|_| Vec::new()).collect();
    for set in 1..=MAX_SET {
        if !sets.is_empty() && !sets.contains(&set) {
            continue;
        }
        let files: Vec<Vec<(u32, PathBuf)>> = variants.iter().map(|v| (v.of_set)(set)).collect();
        if files.iter().any(Vec::is_empty) {
            if sets.contains(&set) {
                let message = format!("there is no catalogue of set {set} to score");
                return Err(PipelineError::Request(message));
            }
            continue;
        }
        let scoring = |source| PipelineError::Scoring { set, source };
        let (grid, shear) = read_truth(&data.truth(set), &reading)?;
        let scorer = SetScorer::new(grid, shear, options).map_err(scoring)?;
        for ((variant, files), scored) in variants.iter().zip(files).zip(&mut scored) {
            let (numbers, files): (Vec<u32>, Vec<PathBuf>) = files.into_iter().unzip();
            let (images, rows) = add_up(&grid, &files, variant.read, threads)?;
            scored.push(ScoredSet {
                set,
                images: numbers,
                score: scorer.score(&images).map_err(scoring)?,
                rows,
            });
        }
    }
    if scored.iter().any(Vec::is_empty) {
        let message = "there is no catalogue to score".into();
        return Err(PipelineError::Request(message));
    }
    Ok(scored)
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
    let read = plain_columns(COLUMNS);
    let catalogues = |set| run.catalogues(out, set);
    score_sets(data, sets, catalogues, &read, options, threads).map_err(|error| match error {
        PipelineError::Request(message) => FileError::new(out, message).into(),
        other => other,
    })
}

/// Means over sets of the headline figures and their errors, `None` for errors that are unknown.
pub fn means(scored: &[ScoredSet]) -> (Figures, Option<Figures>) {
    let values: Vec<([f64; 11], Option<[f64; 11]>)> = scored
        .iter()
        .map(|s| {
            (
                s.score.figures.values(),
                s.score.errors().map(|e| e.values()),
            )
        })
        .collect();
    let column = |k: usize| {
        let pairs: Vec<(f64, Option<f64>)> = values
            .iter()
            .map(|(v, e)| (v[k], e.map(|e| e[k])))
            .collect();
        mean_over_sets(&pairs)
    };
    let columns: [(f64, Option<f64>); 11] = std::array::from_fn(column);
    let errors = columns
        .iter()
        .map(|c| c.1)
        .collect::<Option<Vec<f64>>>()
        .and_then(|errors| <[f64; 11]>::try_from(errors).ok());
    (
        Figures::from_values(columns.map(|c| c.0)),
        errors.map(Figures::from_values),
    )
}
