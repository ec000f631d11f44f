//! The paper's Sect. 5: submissions on simulated sets, set by set, resumable.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_scoring::quality::{quality, quality_error};
use shearq_scoring::{
    BINS, Convention, FieldSum, Grid, Noise, Options, Row, RowCounts, SetImages, SetScore,
    SetScorer, cross_spectrum,
};
use shearq_submissions::{Configuration, checked_name};

use super::response::{Regression, Response};
use shearq_files::FileError;
use shearq_pipeline::PipelineError;
use shearq_pipeline::data::run::{Claim, claim, nan_for_null, read_record, write_record};
use shearq_pipeline::engine::Progress;
use shearq_pipeline::measure::MeasuredRow;
use shearq_pipeline::run::{measurers, run_set};
use shearq_pipeline::simulate::simulator;
use shearq_pipeline::truth::SignBasis;
use shearq_results::row::SetRecord;
use shearq_results::score::{Basis, OWN, OddImages, ScoredSet};
use shearq_simulate::kinds::SetKind;
use shearq_simulate::set::SimulationSettings;

/// What a run is made from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Version of shearq.
    pub version: String,
    /// Simulated data.
    pub simulation: SimulationSettings,
    /// Images per set.
    pub images: u32,
    /// Submissions, resolved.
    pub submissions: Vec<Configuration>,
}

/// A folder of results that belongs to a plan for as long as this lives.
#[derive(Debug)]
pub struct Study<'a> {
    /// What is done.
    pub plan: &'a Plan,
    /// Where results are kept.
    pub folder: &'a Path,
    _claim: Claim,
}

impl<'a> Study<'a> {
    /// Makes `folder` that of `plan`.
    ///
    /// # Errors
    /// Where it holds results of another plan, or cannot be written to.
    pub fn open(plan: &'a Plan, folder: &'a Path) -> Result<Self, FileError> {
        Ok(Study {
            plan,
            folder,
            _claim: claim(&folder.join("plan.json"), plan)?,
        })
    }
}

/// One submission on one set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConfigurationResult {
    /// Submission's name.
    #[serde(deserialize_with = "checked_name")]
    #[serde(rename = "submission")]
    pub configuration: String,
    /// Its score in the standard convention, leaderboard definition.
    #[serde(flatten)]
    pub score: SetRecord,
    /// Number of the convention that the truth would tell.
    pub convention_matched: u8,
    /// E-mode bandpowers.
    pub ee: [f64; BINS],
    /// Their standard errors, for the truth as it is; not numbers beyond the scored bins.
    #[serde(deserialize_with = "nan_for_null")]
    pub ee_error: [f64; BINS],
    /// Q of the cross-spectrum of the images' groups, `None` for a single image.
    pub q_spectrum: Option<f64>,
    /// Its standard error, `None` where it is not known: with fewer than eight images.
    pub q_spectrum_error: Option<f64>,
    /// How ellipticities follow the true ones.
    pub response: Response,
}

/// All submissions on one set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetResult {
    /// Set number.
    pub set: u32,
    /// Images.
    pub images: u32,
    /// Multipole of each bin.
    pub l: [f64; BINS],
    /// Bandpowers of the true shear.
    pub true_ee: [f64; BINS],
    /// One per submission, in the plan's order.
    pub results: Vec<ConfigurationResult>,
}

/// Where a set's result is kept.
fn result_path(folder: &Path, set: u32) -> PathBuf {
    folder.join(format!("sets/set{set:02}.json"))
}

/// Runs the submissions on `sets`, keeping each set's result as soon as it is there; results that are
/// there already are read.
///
/// # Errors
/// Where a file cannot be written, or read back.
pub fn run_sets(
    study: &Study<'_>,
    sets: &[u32],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<SetResult>, PipelineError> {
    let &Study { plan, folder, .. } = study;
    // Submissions that differ in name alone are measured once.
    let (distinct, place) = distinct(&plan.submissions);
    let measurers = measurers(&distinct)?;
    let mut results = Vec::new();
    for &set in sets {
        let path = result_path(folder, set);
        if let Some(result) = read_record::<SetResult>(&path)? {
            progress.skip(u64::from(plan.images) * (plan.simulation.grid as u64).pow(2));
            results.push(result);
            continue;
        }
        let scoring = |source| PipelineError::Scoring {
            set: Some(set),
            source,
        };
        let simulator = simulator(set, plan.simulation)?;
        let grid = simulator.grid();
        let images: Vec<u32> = (1..=plan.images).collect();
        let mut sums: Vec<(SetImages, RowCounts)> = distinct
            .iter()
            .map(|_| (SetImages::new(&grid), RowCounts::default()))
            .collect();
        let mut regressions = vec![Regression::default(); distinct.len()];
        run_set(
            &simulator,
            &images,
            &measurers,
            threads,
            progress,
            |image| {
                let each = sums.iter_mut().zip(&mut regressions).zip(image.rows);
                for (((sum, counts), regression), rows) in each {
                    let (field, used) = field_sum(&grid, rows);
                    sum.add(&field);
                    *counts += used;
                    let measured = rows.iter().flat_map(|row| &row.galaxies);
                    regression.add(image.observed.iter().copied().zip(measured));
                }
                Ok(())
            },
        )?;
        progress.note(&format!("set {set:02}"));
        let options = Options {
            noise: Noise::Measured,
            choice: OWN,
            ..Options::default()
        };
        let scorer = SetScorer::new(grid, simulator.truth(), options).map_err(scoring)?;
        let scored = |(sum, rows): &(SetImages, RowCounts)| {
            Ok(ScoredSet {
                set: Some(set),
                kind: SetKind::of(set),
                images: images.clone(),
                score: scorer.score(sum)?,
                rows: *rows,
                basis: Basis::Given,
                sign: SignBasis::Specified,
                findings: Vec::new(),
                odd_images: OddImages::default(),
            })
        };
        let scored: Vec<ScoredSet> = sums
            .iter()
            .map(scored)
            .collect::<Result<_, _>>()
            .map_err(scoring)?;
        let responses: Vec<Response> = regressions.iter().map(Regression::response).collect();
        let result = SetResult {
            set,
            images: plan.images,
            l: scored[0].score.bins.l,
            true_ee: scored[0].score.true_ee,
            results: plan
                .submissions
                .iter()
                .zip(&place)
                .map(|(configuration, &at)| {
                    let score = &scored[at].score;
                    let spectrum = spectrum_quality(score, &sums[at].0);
                    ConfigurationResult {
                        configuration: configuration.name.clone(),
                        // Of what is simulated the settings are the fingerprint: those of the plan.
                        score: SetRecord::new(set, &scored[at], String::new()),
                        convention_matched: score.matching.best().number(),
                        ee: score.spectra().ee,
                        ee_error: score.ee_error,
                        q_spectrum: spectrum.map(|(q, _)| q),
                        q_spectrum_error: spectrum.and_then(|(_, error)| error),
                        response: responses[at],
                    }
                })
                .collect(),
        };
        write_record(&path, &result)?;
        results.push(result);
    }
    Ok(results)
}

/// Q of the cross-spectrum of `images`, with its error where that is known.
fn spectrum_quality(score: &SetScore, images: &SetImages) -> Option<(f64, Option<f64>)> {
    let cross = cross_spectrum(&score.grid, images, Convention::STANDARD).ok()?;
    let truth = &score.true_ee;
    let error = cross
        .covariance
        .map(|covariance| quality_error(&cross.bins, &cross.power, truth, &covariance))
        .filter(|error| error.is_finite());
    Some((quality(&cross.bins, &cross.power, truth).q, error))
}

/// Submissions without repetition, and the place of each one given among them.
fn distinct(submissions: &[Configuration]) -> (Vec<Configuration>, Vec<usize>) {
    let mut kept: Vec<Configuration> = Vec::new();
    let mut place = Vec::new();
    for configuration in submissions {
        let same = |other: &Configuration| {
            Configuration {
                name: other.name.clone(),
                description: other.description.clone(),
                ..configuration.clone()
            } == *other
        };
        place.push(kept.iter().position(same).unwrap_or_else(|| {
            kept.push(configuration.clone());
            kept.len() - 1
        }));
    }
    (kept, place)
}

/// One image's measurements on the grid, and how they were used; flagged galaxies count as missing.
fn field_sum(grid: &Grid, rows: &[MeasuredRow]) -> (FieldSum, RowCounts) {
    let mut sum = FieldSum::new(grid);
    let galaxies = rows.iter().flat_map(|row| {
        row.galaxies.iter().enumerate().map(|(ix, galaxy)| {
            let (x, y) = row.mosaic.centre(ix, row.iy);
            Row {
                x,
                y,
                e1: galaxy.e1,
                e2: galaxy.e2,
            }
        })
    });
    let counts = sum.add_image(grid, galaxies);
    (sum, counts)
}
