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
use crate::io::layout::{DataFolder, read_rows, read_truth_rows};
use crate::io::run::Run;

/// Columns of our catalogues that are scored.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// The score of one set and where its rows went.
pub struct ScoredSet {
    /// Set number; 0 for a set given as plain files.
    pub set: u32,
    /// The score.
    pub score: SetScore,
    /// How the catalogues' rows were used.
    pub rows: RowCounts,
}

/// How the truth and the catalogues of a set are to be read.
#[derive(Debug, Clone, Copy)]
pub struct Reading<'a> {
    /// Side of the field in degrees.
    pub field: Degrees,
    /// Pixels a side of a cell.
    pub stamp: Pixels,
    /// Sign of g2 in the truth.
    pub sign: TruthSign,
    /// Columns of the catalogues: x, y and the two components.
    pub columns: [&'a str; 4],
}

/// Scores one set from a truth file and one catalogue per image.
///
/// The grid's side is the square root of the truth's number of rows.
///
/// # Errors
/// Where a file cannot be read or the truth does not fill a square grid.
pub fn score_files(
    truth: &Path,
    catalogues: &[PathBuf],
    reading: &Reading<'_>,
    options: Options,
    threads: usize,
) -> Result<(SetScore, RowCounts), PipelineError> {
    let rows = read_truth_rows(truth)?;
    let side = (rows.len() as f64).sqrt().round() as usize;
    if side * side != rows.len() {
        let message = format!(
            "{} rows; expected the square of the grid's side",
            rows.len()
        );
        return Err(FileError::new(truth, message).into());
    }
    let bad = |error: shearq_scoring::ScoringError| FileError::new(truth, error);
    let grid = Grid::new(side, reading.stamp, reading.field).map_err(bad)?;
    let shear = TrueShear::from_rows(&grid, reading.sign, rows).map_err(bad)?;
    let (images, counts) = add_up(&grid, catalogues, reading.columns, threads)?;
    if counts.used == 0 {
        if let Some(first) = catalogues.first() {
            let message = format!(
                "no row of the {} catalogue(s) falls on the {side} × {side} grid of {} px stamps",
                catalogues.len(),
                reading.stamp.0
            );
            return Err(FileError::new(first, message).into());
        }
    }
    let score = SetScorer::new(grid, shear, options)
        .and_then(|scorer| scorer.score(&images))
        .map_err(|source| PipelineError::Scoring { set: 0, source })?;
    Ok((score, counts))
}

/// Adds up the catalogues of a set's images.
fn add_up(
    grid: &Grid,
    catalogues: &[PathBuf],
    columns: [&str; 4],
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
        |(), path: PathBuf| {
            let rows: Vec<Row> = read_rows(&path, &columns)?;
            let mut sum = FieldSum::new(grid);
            let counts = sum.add_image(grid, rows);
            Ok((sum, counts))
        },
        |(sum, more)| {
            images.add(&sum);
            counts += more;
            Ok(())
        },
    )?;
    Ok((images, counts))
}

/// Scores every measured set of a results folder (or those of `sets`) against the truth of `data`.
///
/// # Errors
/// Where files are absent or damaged, or nothing was measured.
pub fn score_folder(
    data: &DataFolder,
    out: &Path,
    run: &Run,
    sets: &[u32],
    options: Options,
    threads: usize,
) -> Result<Vec<ScoredSet>, PipelineError> {
    let layout = data.layout();
    let reading = Reading {
        field: Degrees(layout.field_degrees),
        stamp: Pixels(layout.stamp as f64),
        sign: layout.truth_sign,
        columns: COLUMNS,
    };
    let mut scored = Vec::new();
    for set in 1..=99 {
        if !sets.is_empty() && !sets.contains(&set) {
            continue;
        }
        let catalogues: Vec<PathBuf> = (1..=999)
            .map(|image| run.catalogue(out, set, image))
            .take_while(|path| path.parent().is_some_and(Path::is_dir))
            .filter(|path| path.is_file())
            .collect();
        if catalogues.is_empty() {
            if sets.contains(&set) {
                let path = run.catalogue(out, set, 1);
                let message = format!("set {set} was not measured; expected this catalogue");
                return Err(FileError::new(path, message).into());
            }
            continue;
        }
        let truth = data.truth(set);
        let (score, rows) =
            score_files(&truth, &catalogues, &reading, options, threads).map_err(|error| {
                match error {
                    PipelineError::Scoring { source, .. } => PipelineError::Scoring { set, source },
                    other => other,
                }
            })?;
        scored.push(ScoredSet { set, score, rows });
    }
    if scored.is_empty() {
        return Err(FileError::new(out, "there is no catalogue here to score").into());
    }
    Ok(scored)
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
