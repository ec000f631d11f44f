//! Scoring catalogues: read in parallel, added up in order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::fingerprint;
use shearq_dataset::layout::{DataFolder, MAX_SET};
use shearq_dataset::run::kind_of;
use shearq_dataset::threads::{Pool, ThreadError};
use shearq_dataset::truth::{ReadTruth, Reading, Sign, read_truth, reading_of};
use shearq_files::FileError;
use shearq_quantities::{Frame, hints, tried};
use shearq_scoring::{
    AddedImages, Choice, ConventionMatch, Fault, FieldSum, Grid, OddImages, Options, RowCounts,
    ScoredImages, ScoringError, SetScore, SetSession, TruthSign, sign_by_correlation,
};
use shearq_submissions::ConfigurationError;
use thiserror::Error;

use crate::catalogues::{Catalogues, OWN, PLAIN_SET};
use crate::record::SetRecord;
use shearq_catalogue::galaxies::Calibration;

/// Why catalogues cannot be scored or compared.
#[derive(Debug, Error)]
pub enum ScoreError {
    #[error(transparent)]
    File(#[from] FileError),
    #[error("{}", set.map_or_else(|| "this set cannot be scored".into(), |set| format!("set {set}")))]
    Scoring {
        /// Number of the set, if it has one.
        set: Option<u32>,
        source: ScoringError,
    },
    #[error("found no catalogue{} to score", set.map(|set| format!(" of set {set}")).unwrap_or_default())]
    NoCatalogue { set: Option<u32> },
    #[error("{0}: there is no catalogue to score")]
    NoCatalogueOf(String),
    #[error("the catalogues have no set in common")]
    NoCommonSet,
    #[error("cannot determine the sets, because no `catalogues` contains {{set}}{}", tried(self.hint()))]
    NoSetNumber,
    #[error("--foreign needs the true shear{}", tried(self.hint()))]
    NoTruth,
    #[error(transparent)]
    Configuration(#[from] ConfigurationError),
    #[error(transparent)]
    Threads(#[from] ThreadError),
}

impl ScoreError {
    hints! {
        Self::File(error) => return error.hint.clone(),
        Self::NoSetNumber => "add {set} to the pattern",
        Self::NoTruth => "--data DIR",
    }
}

/// A scored set: its record, and what only its notes and plots need.
#[derive(Debug, Clone)]
pub struct ScoredSet {
    pub record: SetRecord,
    pub score: SetScore,
    pub rows: RowCounts,
    pub basis: Basis,
    /// The sign of the true g2 and how it was determined; `None` in data folders, which state it.
    pub sign: Option<Sign>,
    pub findings: Vec<Fault>,
    pub odd_images: OddImages,
    /// Names of the catalogues, in the order of their images.
    pub names: Vec<PathBuf>,
    /// Relative scatter of the weights of galaxies in the mean over the images; `None` without weights.
    pub weight_scatter: Option<f64>,
}

impl ScoredSet {
    /// `None` for plain files.
    pub fn number(&self) -> Option<u32> {
        (self.record.set != PLAIN_SET).then_some(self.record.set)
    }
}

/// How the convention of the metrics was chosen. It is the same for all sets of a method.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Basis {
    /// By the user, or because the catalogues are by shearq.
    Given,
    /// By the truth of all sets together.
    Matched(ConventionMatch),
    /// By the highest Q of each set, as on the leaderboard.
    HighestQ,
}

impl Basis {
    /// Whether the convention is certain, so that differences from other methods are meaningful.
    pub fn is_certain(&self) -> bool {
        match self {
            Basis::Given => true,
            Basis::Matched(matching) => matching.is_clear(),
            Basis::HighestQ => false,
        }
    }
}

struct SetFiles<'a> {
    // `None` for plain files.
    set: Option<u32>,
    simulated: bool,
    catalogues: &'a Catalogues,
    images: Vec<u32>,
    paths: Vec<PathBuf>,
    // Of the whole set: that of one image of few galaxies is noisy, and ⟨1/R̂⟩ exceeds 1/⟨R⟩.
    calibration: Calibration,
    pool: &'a Pool,
}

impl<'a> SetFiles<'a> {
    fn new(
        catalogues: &'a Catalogues,
        number: u32,
        simulated: bool,
        pool: &'a Pool,
    ) -> Result<Self, FileError> {
        let (images, paths) = catalogues.files.of_set(number).into_iter().unzip();
        Ok(SetFiles {
            set: (number != PLAIN_SET).then_some(number),
            simulated,
            catalogues,
            images,
            paths,
            calibration: catalogues.calibration(number)?,
            pool,
        })
    }

    // Members of an archive, not of the folder that it was unpacked to.
    fn names(&self) -> Vec<PathBuf> {
        let names = self.paths.iter().map(|path| self.catalogues.as_given(path));
        names.collect()
    }

    fn wrong(&self) -> impl Fn(ScoringError) -> ScoreError + use<> {
        let set = self.set;
        move |source| ScoreError::Scoring { set, source }
    }

    // Reads catalogues in parallel and adds them in order, so that results do not depend on threads.
    fn add_up<'s>(&self, session: &'s SetSession) -> Result<AddedImages<'s>, ScoreError> {
        let grid = session.grid();
        let mut images = session.begin();
        let examined = self.pool.in_order(&self.paths, |path| {
            let (mut sum, rows) = self.catalogues.sum(grid, path)?;
            self.calibration.apply(&mut sum);
            session.examine(sum, rows).map_err(self.wrong())
        });
        for image in examined {
            images.add(&image?).map_err(self.wrong())?;
        }
        // Without galaxies, the score would be the score of a method that measures no shear.
        let names = self.names();
        if let (0, Some(first)) = (images.rows().used, names.first()) {
            let message = nothing_used(images.rows(), names.len(), grid);
            return Err(FileError::new(first, message).into());
        }
        Ok(images)
    }

    // Scores the catalogues and looks for probable faults. `matched` has the convention of all sets together, if it was
    // matched.
    fn score(
        &self,
        session: &SetSession,
        choice: Choice,
        matched: Option<ConventionMatch>,
    ) -> Result<ScoredSet, ScoreError> {
        let added = self.add_up(session)?;
        let weight_scatter = weight_scatter(added.images().total());
        let ScoredImages {
            score,
            rows,
            findings,
            odd: odd_images,
            ..
        } = added.finish().map_err(self.wrong())?;
        let basis = match (matched, choice) {
            (Some(matching), _) => Basis::Matched(matching),
            (None, Choice::Matched) => Basis::Matched(score.matching),
            (None, Choice::Best) => Basis::HighestQ,
            (None, Choice::Insist(_)) => Basis::Given,
        };
        let (set, images) = (self.set.unwrap_or(PLAIN_SET), self.images.clone());
        let known = basis.is_certain();
        let record = SetRecord::new(set, self.simulated, images, &score, &rows, known);
        Ok(ScoredSet {
            record,
            findings,
            score,
            rows,
            basis,
            sign: None,
            odd_images,
            names: self.names(),
            weight_scatter,
        })
    }
}

// Without weights, each galaxy of an image counts 1.
fn weight_scatter(sum: &FieldSum) -> Option<f64> {
    let mean = sum.count.mean()?;
    let has_weights = sum.count.iter().any(|count| count.fract() != 0.0);
    has_weights.then(|| sum.count.std(0.0) / mean)
}

/// Scores plain files of one set against a truth file.
pub fn score_files(
    truth: &Path,
    catalogues: &Catalogues,
    reading: &Reading,
    options: Options,
    threads: usize,
) -> Result<ScoredSet, ScoreError> {
    let ReadTruth {
        grid,
        mut shear,
        sign,
    } = read_truth(truth, reading)?;
    let pool = Pool::new(threads)?;
    let files = SetFiles::new(catalogues, PLAIN_SET, false, &pool)?;
    let wrong = files.wrong();
    let sign = match sign {
        Some(sign) => sign,
        None => {
            let session = SetSession::new(grid, None, options).map_err(&wrong)?;
            let added = files.add_up(&session)?;
            let found = sign_by_correlation(&shear, added.images().total()).map_err(&wrong)?;
            let sign = Sign::of_catalogues(found).map_err(|fault| FileError::new(truth, fault))?;
            if sign.of == TruthSign::Challenge {
                shear = shear.flipped();
            }
            sign
        }
    };
    let session = SetSession::new(grid, Some(shear), options).map_err(&wrong)?;
    let mut scored = files.score(&session, options.choice, None)?;
    scored.record.frame = catalogues.frame(PLAIN_SET)?;
    scored.sign = Some(sign);
    Ok(scored)
}

fn nothing_used(counts: &RowCounts, files: usize, grid: &Grid) -> String {
    let (n, stamp) = (grid.n, grid.stamp.0);
    // The more frequent reason is the probable cause.
    if counts.outside > counts.not_finite {
        return format!(
            "no row of the {files} catalogue(s) is on the {n} × {n} grid of {stamp} px stamps; expected x and y in pixels from 0.5 to {}. Are they sky coordinates in degrees?",
            n as f64 * stamp + 0.5
        );
    }
    if counts.not_finite > 0 {
        return format!(
            "none of the {} galaxies in {files} catalogue(s) has an ellipticity: all values are NaN, flagged or marked as missing. Check the column names, the flags, and the PSF of the measurement",
            counts.not_finite
        );
    }
    format!("found no galaxy in {files} catalogue(s); expected a row per galaxy")
}

/// Scores several methods on sets of a data folder: on `sets`, or if it is empty, on all sets with catalogues of every
/// method. Each is scored in its own choice of a convention. [`Choice::Matched`] uses one convention for all sets.
pub fn score_variants(
    data: &DataFolder,
    variants: &[(&Catalogues, Choice)],
    sets: &[u32],
    options: Options,
    threads: usize,
) -> Result<Vec<Vec<ScoredSet>>, ScoreError> {
    let sets = sets_to_score(variants, sets)?;
    let pool = Pool::new(threads)?;
    let score = |&(catalogues, choice): &(&Catalogues, Choice)| {
        score_sets(data, catalogues, choice, &sets, options, &pool)
    };
    variants.iter().map(score).collect()
}

fn score_sets(
    data: &DataFolder,
    catalogues: &Catalogues,
    choice: Choice,
    sets: &[u32],
    options: Options,
    pool: &Pool,
) -> Result<Vec<ScoredSet>, ScoreError> {
    let frames = sets.iter().map(|&set| catalogues.frame(set));
    let frames: Vec<Frame> = frames.collect::<Result<_, _>>()?;
    let files = |set| {
        let simulated = kind_of(data, set)?.is_some();
        SetFiles::new(catalogues, set, simulated, pool)
    };
    let session = |files: &SetFiles<'_>, set: u32, options| -> Result<_, ScoreError> {
        let ReadTruth { grid, shear, .. } = read_truth(&data.truth(set), &reading_of(data, set)?)?;
        SetSession::new(grid, Some(shear), options).map_err(files.wrong())
    };
    let mut options = Options { choice, ..options };
    let mut matched = None;
    if choice == Choice::Matched {
        let mut all = ConventionMatch::default();
        for &set in sets {
            let files = files(set)?;
            // Only summed in this pass, whose convention does not matter.
            let summing = Options {
                choice: OWN,
                ..Options::default()
            };
            let session = session(&files, set, summing)?;
            let added = files.add_up(&session)?;
            all.merge(&added.match_convention().map_err(files.wrong())?);
        }
        // One convention for all sets: noisy sets would choose others by chance.
        matched = Some(all);
        options.choice = Choice::Insist(all.convention());
    }
    let mut scored = Vec::new();
    for (&set, frame) in sets.iter().zip(frames) {
        let files = files(set)?;
        let session = session(&files, set, options)?;
        let mut one = files.score(&session, options.choice, matched)?;
        one.record.frame = frame;
        scored.push(one);
    }
    Ok(scored)
}

fn sets_to_score(
    variants: &[(&Catalogues, Choice)],
    wanted: &[u32],
) -> Result<Vec<u32>, ScoreError> {
    // Sets differ in Q by more than methods do, so that methods are compared on their common sets.
    let complete = |set: &u32| variants.iter().all(|v| !v.0.files.of_set(*set).is_empty());
    if let Some(set) = wanted.iter().find(|set| !complete(set)) {
        return Err(ScoreError::NoCatalogue { set: Some(*set) });
    }
    let asked = |set: &u32| wanted.is_empty() || wanted.contains(set);
    let sets: Vec<u32> = (0..=MAX_SET).filter(asked).filter(complete).collect();
    match sets.is_empty() {
        true => Err(ScoreError::NoCatalogue { set: None }),
        false => Ok(sets),
    }
}

/// Scores `sets` of one method, or all sets with catalogues if it is empty.
pub fn score_catalogues(
    data: &DataFolder,
    catalogues: &Catalogues,
    sets: &[u32],
    options: Options,
    threads: usize,
) -> Result<Vec<ScoredSet>, ScoreError> {
    if let Some(run) = &catalogues.run {
        fingerprint::verify(data, &catalogues.path, run, sets, &Pool::new(threads)?)?;
    }
    let variant = [(catalogues, options.choice)];
    let scored = score_variants(data, &variant, sets, options, threads);
    let scored = scored.map_err(|error| match error {
        ScoreError::NoCatalogue { .. } if catalogues.run.is_some() => {
            FileError::new(&catalogues.path, error).into()
        }
        other => other,
    })?;
    Ok(scored.into_iter().flatten().collect())
}

/// Warnings about images of `data` that were not scored, in `sets` (in all if empty).
pub fn unscored(
    data: &DataFolder,
    scored: &[ScoredSet],
    sets: &[u32],
) -> Result<Vec<String>, FileError> {
    let records = scored.iter().map(|scored| &scored.record);
    let images = records.map(|record| (record.set, record.images.as_slice()));
    without_catalogue(data, &images.collect(), sets)
}

/// Warnings about images without a catalogue; `used` has the images with a catalogue by set.
pub fn without_catalogue(
    data: &DataFolder,
    used: &BTreeMap<u32, &[u32]>,
    sets: &[u32],
) -> Result<Vec<String>, FileError> {
    let images = data.images(sets)?;
    let mut absent = Vec::new();
    let unread = images.unread().into_iter();
    let mut lines: Vec<String> = unread.map(|line| format!("warning: {line}.")).collect();
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
                "warning: {count} of the {} images of set {set} have no catalogue; metrics depend on the number of images.",
                there.len()
            )),
        }
    }
    if !absent.is_empty() {
        let absent = absent.join(", ");
        lines.push(format!(
            "warning: no catalogue of set {absent}, which the data contain."
        ));
    }
    Ok(lines)
}
