//! Scoring catalogues: read in parallel, added up in order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_scoring::resample::mean_over_sets;
use shearq_scoring::{
    Choice, Convention, ConventionMatch, Fault, FieldSum, Grid, ImageFaults, Metrics, OddResponse,
    Options, RowCounts, SetImages, SetScore, SetScorer, TruthSign, sign_by_correlation,
};

use shearq_dataset::layout::MAX_SET;
use shearq_dataset::layout::{DataFolder, read_rows};
use shearq_dataset::run::Run;
use shearq_dataset::run::kind_of;
use shearq_dataset::truth::{ReadTruth, Reading, Sign, read_truth, reading_of};
use shearq_files::FileError;
use shearq_files::table::most_rows;
use shearq_pipeline::{PipelineError, engine, inputs};
use shearq_simulate::kinds::SetKind;

/// The scored columns of catalogues by shearq.
pub const COLUMNS: [&str; 4] = ["x", "y", "e1", "e2"];

/// The convention of catalogues by shearq, which is the standard one by construction.
pub const OWN: Choice = Choice::Insist(Convention::STANDARD);

/// The score of one set, and how the rows of its catalogues were used.
#[derive(Debug, Clone)]
pub struct ScoredSet {
    /// Set number; `None` for plain files.
    pub set: Option<u32>,
    /// Kind of set, if the data were simulated.
    pub kind: Option<SetKind>,
    /// Numbers of the scored images.
    pub images: Vec<u32>,
    /// The score.
    pub score: SetScore,
    /// Numbers of used, missing and unusable rows.
    pub rows: RowCounts,
    /// How the convention was chosen.
    pub basis: Basis,
    /// The sign of the true g2 and how it was determined; `None` in data folders, which state it.
    pub sign: Option<Sign>,
    /// Probable faults of the ellipticities or the truth.
    pub findings: Vec<Fault>,
    /// Probable faults of single images.
    pub odd_images: OddImages,
}

/// Catalogues of a set with faults that the sum over images does not show.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OddImages {
    /// Pairs of catalogues with equal ellipticities: the copy, and the first.
    pub copies: Vec<(PathBuf, PathBuf)>,
    /// Catalogues whose galaxies all have one ellipticity, and this ellipticity.
    pub constant: Vec<(PathBuf, [f64; 2])>,
    /// Catalogues that follow the true shear differently from the others of the set.
    pub responses: Vec<(PathBuf, OddResponse)>,
}

impl OddImages {
    /// Odd images by name; the images of `faults` were added in the order of `paths`.
    pub fn new(faults: &ImageFaults, paths: &[PathBuf]) -> Self {
        OddImages {
            copies: faults
                .copies
                .iter()
                .map(|(copy, first)| (paths[*copy].clone(), paths[*first].clone()))
                .collect(),
            constant: faults
                .constant
                .iter()
                .map(|(place, e)| (paths[*place].clone(), *e))
                .collect(),
            responses: faults
                .odd()
                .into_iter()
                .map(|odd| (paths[odd.place].clone(), odd))
                .collect(),
        }
    }

    /// Renames the files, for example of an unpacked archive.
    pub fn renamed(&mut self, name: impl Fn(&Path) -> PathBuf) {
        for (copy, first) in &mut self.copies {
            (*copy, *first) = (name(copy), name(first));
        }
        let constant = self.constant.iter_mut().map(|(path, _)| path);
        let responses = self.responses.iter_mut().map(|(path, _)| path);
        for path in constant.chain(responses) {
            *path = name(path);
        }
    }
}

/// The convention in which faults are looked for.
fn convention_of_faults(score: &SetScore, choice: Choice) -> Convention {
    match choice {
        // The convention with the highest Q may be wrong.
        Choice::Best => score.matching.convention(),
        Choice::Matched | Choice::Insist(_) => score.chosen,
    }
}

/// Scores the catalogues of a set with their probable faults. The convention of `scorer` may be known only afterwards;
/// images are then read again, so that each can be compared with the truth in it.
fn score_added(
    scorer: &SetScorer,
    added: &mut Added,
    files: (&[PathBuf], ReadImage<'_>),
    choice: Choice,
    threads: usize,
) -> Result<(SetScore, Vec<Fault>), PipelineError> {
    let unnumbered = |source| PipelineError::Scoring { set: None, source };
    let score = scorer.score(&added.images).map_err(unnumbered)?;
    let convention = convention_of_faults(&score, choice);
    if !added.compared && files.0.len() > 1 {
        let grid = score.grid;
        let compared = Some((scorer, convention));
        added.odd_images = add_up(&grid, files.0, files.1, compared, threads)?.odd_images;
    }
    let faults = scorer.diagnose(&added.images, &score, convention);
    Ok((score, faults.map_err(unnumbered)?))
}

/// The same error with the number of a set.
fn of_set(error: PipelineError, set: u32) -> PipelineError {
    match error {
        PipelineError::Scoring { set: None, source } => PipelineError::Scoring {
            set: Some(set),
            source,
        },
        other => other,
    }
}

/// How the convention of the metrics was chosen. It is the same for all sets of a variant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Basis {
    /// It was given, or the catalogues are by shearq.
    Given,
    /// It was matched to the truth of all sets together.
    Matched(ConventionMatch),
    /// The highest Q of each set, as on the leaderboard.
    HighestQ,
}

impl Basis {
    /// Whether the convention is certain, so that differences from other variants are meaningful.
    pub fn is_known(&self) -> bool {
        match self {
            Basis::Given => true,
            Basis::Matched(matching) => matching.is_clear(),
            Basis::HighestQ => false,
        }
    }
}

/// Reads one catalogue onto the grid.
pub type ReadImage<'a> =
    &'a (dyn Fn(&Grid, &Path) -> Result<(FieldSum, RowCounts), FileError> + Sync);

/// A [`ReadImage`] for catalogues by shearq.
///
/// # Errors
/// If the catalogue cannot be read.
pub fn own_catalogue(grid: &Grid, path: &Path) -> Result<(FieldSum, RowCounts), FileError> {
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, read_rows(path, &COLUMNS, most_rows(grid.cells()))?);
    Ok((sum, counts))
}

/// Scores one set from a truth file and one catalogue per image.
///
/// # Errors
/// If a file cannot be read, the truth does not fill a square grid, or no row is on the grid.
pub fn score_files(
    truth: &Path,
    catalogues: &[PathBuf],
    reading: &Reading,
    read: ReadImage<'_>,
    options: Options,
    threads: usize,
) -> Result<ScoredSet, PipelineError> {
    let ReadTruth {
        grid,
        mut shear,
        sign,
    } = read_truth(truth, reading)?;
    let scoring = |source| PipelineError::Scoring { set: None, source };
    let mut added = add_up(&grid, catalogues, read, None, threads)?;
    let sign = match sign {
        Some(sign) => sign,
        None => {
            let found = sign_by_correlation(&shear, added.images.total()).map_err(scoring)?;
            let sign = Sign::of_catalogues(found).map_err(|fault| FileError::new(truth, fault))?;
            if sign.of == TruthSign::Challenge {
                shear = shear.flipped();
            }
            sign
        }
    };
    let scorer = SetScorer::new(grid, shear, options).map_err(scoring)?;
    let files = (catalogues, read);
    let (score, findings) = score_added(&scorer, &mut added, files, options.choice, threads)?;
    Ok(ScoredSet {
        set: None,
        kind: None,
        findings,
        odd_images: added.odd_images,
        sign: Some(sign),
        images: (1..=catalogues.len() as u32).collect(),
        basis: match options.choice {
            Choice::Matched => Basis::Matched(score.matching),
            Choice::Best => Basis::HighestQ,
            Choice::Insist(_) => Basis::Given,
        },
        score,
        rows: added.rows,
    })
}

/// Sum of the catalogues of a set.
struct Added {
    images: SetImages,
    rows: RowCounts,
    odd_images: OddImages,
    /// Whether each image was compared with the true shear.
    compared: bool,
}

/// Reads catalogues in parallel and sums them in order. Each is compared with the true shear of `compared` in its
/// convention.
fn add_up(
    grid: &Grid,
    catalogues: &[PathBuf],
    read: ReadImage<'_>,
    compared: Option<(&SetScorer, Convention)>,
    threads: usize,
) -> Result<Added, PipelineError> {
    let mut faults = ImageFaults::default();
    let mut images = SetImages::new(grid);
    let mut counts = RowCounts::default();
    engine::ordered(
        // More threads than catalogues have nothing to do.
        threads.min(catalogues.len()).max(1),
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
            let (sum, counts) = read(grid, &path)?;
            let response = compared.and_then(|(scorer, own)| scorer.response(&sum, own));
            Ok((sum, counts, response))
        },
        |(sum, more, response)| {
            faults.add(&sum);
            faults.add_response(response);
            images
                .add(&sum)
                .map_err(|source| PipelineError::Scoring { set: None, source })?;
            counts += more;
            Ok(())
        },
    )?;
    if counts.used == 0
        && let Some(first) = catalogues.first()
    {
        return Err(FileError::new(first, nothing_used(&counts, catalogues.len(), grid)).into());
    }
    Ok(Added {
        images,
        rows: counts,
        odd_images: OddImages::new(&faults, catalogues),
        compared: compared.is_some(),
    })
}

/// The error if no row of `files` catalogues can be scored.
fn nothing_used(counts: &RowCounts, files: usize, grid: &Grid) -> String {
    let (n, stamp) = (grid.n, grid.stamp.0);
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

/// Catalogues of one variant.
pub struct Catalogues<'a> {
    /// The existing catalogues of a set, with their image numbers.
    pub of_set: &'a dyn Fn(u32) -> Vec<(u32, PathBuf)>,
    /// Reads one catalogue.
    pub read: ReadImage<'a>,
    /// Convention to score in; [`Choice::Matched`] uses one convention for all sets.
    pub choice: Choice,
}

impl std::fmt::Debug for Catalogues<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Catalogues").finish_non_exhaustive()
    }
}

/// A set to score, and its catalogues of every variant.
type SetFiles = (u32, Vec<Vec<(u32, PathBuf)>>);

/// Scores several variants on sets of a data folder: on `sets`, or if it is empty, on all sets with catalogues of every
/// variant. The convention of `options` is replaced by the choice of each variant.
///
/// # Errors
/// If files are absent or damaged, or a set of `sets` has no catalogues.
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
            Choice::Insist(_) => Basis::Given,
        };
        let options = Options {
            choice: match basis {
                Basis::Matched(matching) => Choice::Insist(matching.convention()),
                Basis::Given | Basis::HighestQ => variant.choice,
            },
            ..options
        };
        let mut own = Vec::new();
        for (set, files) in &sets {
            let paths: Vec<PathBuf> = files[k].iter().map(|file| file.1.clone()).collect();
            let (scorer, mut added) = prepare(data, *set, &paths, variant.read, options, threads)?;
            let files_of_set = (paths.as_slice(), variant.read);
            let (score, findings) =
                score_added(&scorer, &mut added, files_of_set, options.choice, threads)
                    .map_err(|error| of_set(error, *set))?;
            own.push(ScoredSet {
                set: Some(*set),
                kind: kind_of(data, *set),
                images: files[k].iter().map(|file| file.0).collect(),
                findings,
                odd_images: added.odd_images,
                score,
                rows: added.rows,
                basis,
                sign: None,
            });
        }
        scored.push(own);
    }
    Ok(scored)
}

/// The sets with catalogues of every variant.
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
            let message = format!("found no catalogue of set {set} to score");
            return Err(PipelineError::Request(message));
        }
    }
    if sets.is_empty() {
        let message = "found no catalogue to score".into();
        return Err(PipelineError::Request(message));
    }
    Ok(sets)
}

/// How well each convention of the `k`-th variant agrees with the truth of all sets.
fn match_over_sets(
    data: &DataFolder,
    sets: &[SetFiles],
    k: usize,
    variant: &Catalogues<'_>,
    threads: usize,
) -> Result<ConventionMatch, PipelineError> {
    let mut all = ConventionMatch::default();
    for (set, files) in sets {
        let paths: Vec<PathBuf> = files[k].iter().map(|file| file.1.clone()).collect();
        let options = Options::default();
        let (scorer, added) = prepare(data, *set, &paths, variant.read, options, threads)?;
        let found = scorer.match_convention(&added.images);
        all.merge(&found.map_err(|source| PipelineError::Scoring {
            set: Some(*set),
            source,
        })?);
    }
    Ok(all)
}

/// Scorer and summed catalogues of a set.
fn prepare(
    data: &DataFolder,
    set: u32,
    files: &[PathBuf],
    read: ReadImage<'_>,
    options: Options,
    threads: usize,
) -> Result<(SetScorer, Added), PipelineError> {
    let ReadTruth { grid, shear, .. } = read_truth(&data.truth(set), &reading_of(data, set)?)?;
    let scorer = SetScorer::new(grid, shear, options).map_err(|source| PipelineError::Scoring {
        set: Some(set),
        source,
    })?;
    let compared = match options.choice {
        Choice::Insist(convention) => Some((&scorer, convention)),
        Choice::Matched | Choice::Best => None,
    };
    let added = add_up(&grid, files, read, compared, threads)?;
    Ok((scorer, added))
}

/// Scores sets of a data folder from catalogues found by `catalogues`: `sets`, or if it is empty, all sets with
/// catalogues.
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

/// Scores `sets` of a results folder, or all if it is empty, against the truth of `data`.
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

/// Warnings about images of `data` that were not scored, in `sets` (in all if empty).
///
/// # Errors
/// If the folders of the data cannot be listed.
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

/// Warnings about images without a catalogue; `used` has the images with a catalogue by set.
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

/// Means of the metrics over sets, and their errors.
pub fn means(scored: &[ScoredSet]) -> (Metrics, Metrics) {
    let columns: [(f64, f64); Metrics::ALL.len()] = std::array::from_fn(|k| {
        let pairs: Vec<(f64, f64)> = scored
            .iter()
            .map(|s| (s.score.metrics.values()[k], s.score.errors.values()[k]))
            .collect();
        mean_over_sets(&pairs)
    });
    (
        Metrics::from_values(columns.map(|c| c.0)),
        Metrics::from_values(columns.map(|c| c.1)),
    )
}
