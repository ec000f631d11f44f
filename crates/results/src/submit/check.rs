//! Checks a submission before it is sent.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use shearq_scoring::{
    AddedImages, Bins, Convention, Definition, ExaminedImage, Fault, Grid, Options, Row, RowCounts,
    SCORED, ScoredImages, SetScorer, SetSession, TrueShear,
};

use super::{
    Contents, FileSum, Kind, Manifest, Sent, SpectrumLine, read_spectrum, wrong_multipoles,
};
use crate::catalogues::{OWN, galaxies_of, recognised, sum_on};
use crate::views::scores::{follows_by_less, odd_response, repeated_shapes, words};
use shearq_catalogue::foreign::Foreign;
use shearq_catalogue::galaxies::{Calibration, CalibrationSums, Galaxies};
use shearq_files::FileError;
use shearq_files::table::most_rows;

// Catalogues and true shears are read onto this grid.
const ON_GRID: &str = "one image on the expected grid";

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Probably harmless; please check.
    Warning,
    /// The submission would not be scored as intended.
    Error,
}

#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Finding {
    pub path: PathBuf,
    pub severity: Severity,
    pub check: &'static str,
    pub message: String,
}

/// Which images a set must have.
#[derive(Debug, Clone, Default)]
pub enum ExpectedImages {
    /// Those up to the last one that was sent.
    #[default]
    Unknown,
    /// So many.
    Each(u32),
    /// These numbers of each set, and of others those up to the last one that was sent.
    OfSets(BTreeMap<u32, Vec<u32>>),
}

#[derive(Debug, Clone)]
pub struct Expected {
    pub grid: Grid,
    /// Definition of the bandpowers that sets are compared in.
    pub definition: Definition,
    /// True shear by set, if known, to check conventions and type of ellipticity.
    pub truth: BTreeMap<u32, TrueShear>,
    /// True shear that findings must not reveal: only images that do not follow it as the others do are told, to `done`.
    pub secret_truth: BTreeMap<u32, TrueShear>,
    pub images: ExpectedImages,
    /// Sets that a submission must contain; it must contain no other sets. Empty if unknown.
    pub sets: Vec<u32>,
    /// Whether `sets` may be absent, with a warning.
    pub partial: bool,
}

// Largest accepted distance of a position from the centre of its cell, in cells.
// 0.48 px of the challenge's stamps, so that 0-based positions, which are off by 1 px, are found.
const POSITION_TOLERANCE: f64 = 0.01;

/// A set of catalogues, which [`AddedImages::finish`] scores.
#[derive(Debug)]
pub struct CheckedSet<'a> {
    pub set: u32,
    pub images: &'a AddedImages<'a>,
    /// Numbers of the images, in ascending order.
    pub numbers: &'a [u32],
}

impl Expected {
    fn session(&self, set: Option<u32>) -> SetSession {
        let truth = set.and_then(|set| {
            let open = self.truth.get(&set);
            open.or_else(|| self.secret_truth.get(&set)).cloned()
        });
        let options = Options {
            choice: OWN,
            definition: self.definition,
            ..Options::default()
        };
        SetSession::new(self.grid, truth, options).expect(ON_GRID)
    }
}

impl Finding {
    /// The finding about a submission that cannot be opened.
    pub fn unreadable(error: FileError) -> Self {
        Finding {
            message: error.text(),
            path: error.path,
            severity: Severity::Error,
            check: "readable",
        }
    }
}

/// Checks an open submission. `done` gets each set of catalogues, so that each file is read once and the sums of one set
/// are in memory at a time.
pub fn check_sent(
    sent: &Sent,
    expected: &Expected,
    done: &mut dyn FnMut(CheckedSet<'_>),
) -> Vec<Finding> {
    let path = sent.path();
    let mut report = Report::default();
    match sent.files() {
        Ok(files) => check_files(path, &files, expected, done, &mut report),
        Err(error) => report.error(path, "readable", error.text()),
    }
    let mut findings = report.findings;
    // Participants do not know the folder that their archive was unpacked to.
    for finding in &mut findings {
        finding.path = sent.as_given(&finding.path);
    }
    findings
}

fn check_files(
    path: &Path,
    files: &[PathBuf],
    expected: &Expected,
    done: &mut dyn FnMut(CheckedSet<'_>),
    report: &mut Report,
) {
    if files.is_empty() {
        report.error(path, "empty", "found no file".into());
    }
    let by_shearq = path.is_dir() && check_manifest(path, files, report);
    let mut catalogues: BTreeMap<u32, Vec<(u32, &PathBuf)>> = BTreeMap::new();
    let mut spectra = BTreeSet::new();
    let mut methods: BTreeSet<String> = BTreeSet::new();
    for file in files {
        let kind = Kind::of(file);
        if kind.is_none() {
            // A single file given by hand may have any name; in a folder it would not be scored.
            let severity = match files.len() == 1 && path.is_file() {
                true => Severity::Warning,
                false => Severity::Error,
            };
            let message = format!("the name is {}", Kind::EXPECTED);
            report.add(file, severity, "name", message);
        }
        match kind {
            Some(Kind::Catalogue { set, image, method }) => {
                methods.insert(method);
                catalogues.entry(set).or_default().push((image, file));
            }
            Some(Kind::Spectrum { set, method }) => {
                methods.insert(method);
                spectra.insert(set);
                check_spectrum(file, Some(set), expected, report);
            }
            None if looks_like_spectrum(file) => check_spectrum(file, None, expected, report),
            None => check_unnamed(file, files.len() == 1, expected, report),
        }
    }
    if methods.len() > 1 {
        let names: Vec<&str> = methods.iter().map(String::as_str).collect();
        let message = format!("the files belong to several methods: {}", names.join(", "));
        report.error(path, "method", message);
    }
    if path.is_dir() && !(catalogues.is_empty() && spectra.is_empty()) {
        let found = catalogues.keys().chain(&spectra).copied().collect();
        check_sets(path, &found, expected, report);
    }
    let numbers = catalogues.values().flatten().map(|(image, _)| *image);
    let most = numbers.max().unwrap_or(0);
    for (set, mut of_set) in catalogues {
        // In the order in which `score` adds them, whose groups of the jackknife depend on it.
        of_set.sort_by_key(|(image, _)| *image);
        let session = expected.session(Some(set));
        let mut files = SentImages::new(&session);
        let paths = of_set.iter().map(|(_, file)| file.as_path());
        let (opened, calibration) = open_catalogues(paths, session.grid(), report);
        for ((image, file), opened) in of_set.into_iter().zip(opened) {
            // An unreadable catalogue is reported, and the others of its set are checked without it.
            let examined = opened.and_then(|own| {
                let own = (own.as_ref(), by_shearq);
                check_catalogue(file, own, &calibration, &session, report)
            });
            if let Some(examined) = examined {
                files.add(&examined, image, file);
            }
        }
        if files.paths.is_empty() {
            continue;
        }
        check_each(set, &files, expected, report);
        check_images(set, &files, most, path, expected, report);
        check_against_truth(set, &files, expected, report);
        done(CheckedSet {
            set,
            images: &files.images,
            numbers: &files.numbers,
        });
    }
}

// Compares the images of a set with each other.
fn check_each(set: u32, files: &SentImages<'_>, expected: &Expected, report: &mut Report) {
    let odd = files.images.odd(Convention::STANDARD);
    for (copy, first) in odd.copies {
        let message = format!(
            "the ellipticities are copies of {}; expected an independent measurement per image",
            name_of(&files.paths[first])
        );
        report.error(&files.paths[copy], "copies", message);
    }
    // The response to a secret truth is the correlation with it.
    if expected.truth.contains_key(&set) {
        for odd in odd.responses {
            let message = format!("set {set}: the image {}", odd_response(&odd));
            // Packed galaxies of low weights follow the shear by less, in their order.
            let severity = match follows_by_less(&odd) {
                true => Severity::Warning,
                false => Severity::Error,
            };
            report.add(&files.paths[odd.place], severity, "image", message);
        }
    }
}

// Checks a catalogue whose name contains no set. A `single` file belongs to the only set.
fn check_unnamed(file: &Path, single: bool, expected: &Expected, report: &mut Report) {
    let sets: Vec<u32> = expected.truth.keys().copied().collect();
    let set = match sets[..] {
        [set] if single => Some(set),
        _ => None,
    };
    let session = expected.session(set);
    let (opened, calibration) = open_catalogues([file].into_iter(), session.grid(), report);
    let [Some(opened)] = &opened[..] else { return };
    let opened = (opened.as_ref(), false);
    let Some(examined) = check_catalogue(file, opened, &calibration, &session, report) else {
        return;
    };
    if let Some(set) = set {
        let mut entry = SentImages::new(&session);
        entry.add(&examined, 1, file);
        check_against_truth(set, &entry, expected, report);
    } else if !sets.is_empty() {
        let message = "not compared with the true shear, because the name contains no set number";
        report.warn(file, "truth", message.into());
    }
}

fn check_sets(path: &Path, found: &BTreeSet<u32>, expected: &Expected, report: &mut Report) {
    if expected.sets.is_empty() {
        for set in expected.truth.keys().filter(|set| !found.contains(set)) {
            let message = format!("found no file of set {set}, which the data contain");
            report.warn(path, "sets", message);
        }
        return;
    }
    let wanted: BTreeSet<u32> = expected.sets.iter().copied().collect();
    let absent = match expected.partial {
        true => Severity::Warning,
        false => Severity::Error,
    };
    for (sets, severity, what) in [
        (
            &wanted - found,
            absent,
            "is missing, but the challenge contains it",
        ),
        (
            found - &wanted,
            Severity::Error,
            "does not belong to the challenge",
        ),
    ] {
        for set in sets {
            report.add(path, severity, "sets", format!("set {set} {what}"));
        }
    }
}

// The readable catalogues of a set.
struct SentImages<'s> {
    images: AddedImages<'s>,
    paths: Vec<PathBuf>,
    numbers: Vec<u32>,
}

impl<'s> SentImages<'s> {
    fn new(session: &'s SetSession) -> Self {
        SentImages {
            images: session.begin(),
            paths: Vec::new(),
            numbers: Vec::new(),
        }
    }

    fn add(&mut self, examined: &ExaminedImage, image: u32, file: &Path) {
        self.images.add(examined).expect(ON_GRID);
        self.numbers.push(image);
        self.paths.push(file.to_owned());
    }
}

#[derive(Default)]
struct Report {
    findings: Vec<Finding>,
}

impl Report {
    fn error(&mut self, path: &Path, check: &'static str, message: String) {
        self.add(path, Severity::Error, check, message);
    }

    fn unreadable(&mut self, error: FileError) {
        self.findings.push(Finding::unreadable(error));
    }

    fn warn(&mut self, path: &Path, check: &'static str, message: String) {
        self.add(path, Severity::Warning, check, message);
    }

    fn add(&mut self, path: &Path, severity: Severity, check: &'static str, message: String) {
        self.findings.push(Finding {
            path: path.to_owned(),
            severity,
            check,
            message,
        });
    }
}

// Whether the manifest states a run of shearq.
fn check_manifest(folder: &Path, files: &[PathBuf], report: &mut Report) -> bool {
    let manifest = match Manifest::read(folder) {
        Ok(Some(manifest)) => manifest,
        Ok(None) => return false,
        Err(error) => {
            report.error(&error.path, "manifest", error.text());
            return false;
        }
    };
    let mut found = BTreeMap::new();
    for file in files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        match FileSum::of(file) {
            Ok(sum) => _ = found.insert(name.into_owned(), sum),
            Err(error) => report.error(file, "readable", error.text()),
        }
    }
    for (name, message) in manifest.faults(&found) {
        report.error(&folder.join(name), "manifest", message);
    }
    if manifest.contents == Contents::CrossSpectra {
        let bare = |name: &&String| !manifest.covariances.contains_key(*name);
        for name in manifest.files.keys().filter(bare) {
            let message = "scores will have no errors, because the manifest contains no covariance (found fewer than 8 images)";
            report.warn(&folder.join(name), "covariance", message.into());
        }
    }
    manifest.run.is_some()
}

// Most lines of a file that is taken for a spectrum: catalogues have thousands. Chosen by hand.
const MAX_SPECTRUM_LINES: usize = 20;

// Whether a file with an unknown name is a spectrum: its lines have three numbers.
fn looks_like_spectrum(path: &Path) -> bool {
    read_spectrum(path).is_ok_and(|lines| !lines.is_empty() && lines.len() <= MAX_SPECTRUM_LINES)
}

// The catalogues of a set with recognised columns, `Some(None)` without names of columns and `None` if they cannot be read; and what
// their ellipticities are divided by.
fn open_catalogues<'p>(
    paths: impl Iterator<Item = &'p Path>,
    grid: &Grid,
    report: &mut Report,
) -> (Vec<Option<Option<Galaxies>>>, Calibration) {
    let mut mean = CalibrationSums::default();
    let mut open = |path| {
        let opened = recognised(&Foreign::default(), path, most_rows(grid.cells()))?;
        opened.iter().try_for_each(|own| mean.add(own))?;
        Ok(opened)
    };
    let opened = paths.map(|path| open(path).map_err(|error| report.unreadable(error)).ok());
    let opened = opened.collect();
    let calibration = mean.calibration();
    let calibration =
        calibration.map_err(|error| report.error(&error.path, "response", error.text()));
    (opened, calibration.unwrap_or(Calibration::NONE))
}

// Checks the rows of a catalogue. `None` if the file is not readable.
fn check_catalogue(
    path: &Path,
    (recognised, by_shearq): (Option<&Galaxies>, bool),
    calibration: &Calibration,
    session: &SetSession,
    report: &mut Report,
) -> Option<ExaminedImage> {
    let grid = session.grid();
    let galaxies = galaxies_of(recognised, path, most_rows(grid.cells()));
    let galaxies = galaxies.map_err(|error| report.unreadable(error)).ok()?;
    let (mut sum, mut counts, fault) = sum_on(grid, galaxies.iter().copied(), by_shearq);
    calibration.apply(&mut sum);
    if recognised.is_some() {
        // Its flags, weights and missing numbers state which galaxies were not measured.
        counts.missing += std::mem::take(&mut counts.not_finite);
    }
    if let Some(fault) = fault {
        report.error(path, "values", fault);
    }
    let rows: Vec<Row> = galaxies.into_iter().map(|(row, _)| row).collect();
    for (count, severity, check, message) in row_findings(&counts, &rows, grid) {
        if count > 0 {
            report.add(path, severity, check, message);
        }
    }
    let examined = session.examine(sum, counts).expect(ON_GRID);
    if let Some(found) = examined.repeated() {
        // Such galaxies are as good as missing, and are limited like these.
        let severity = more_than(found.rows, 10, found.of);
        let message = format!(
            "{}; expected measured values, which do not repeat, and no row for a galaxy that was not measured",
            repeated_shapes(found)
        );
        report.add(path, severity, "constant", message);
    }
    Some(examined)
}

// Severity of a fault of `count` galaxies of `of`. Chosen by hand: a few galaxies fail in any measurement.
fn more_than(count: usize, share: usize, of: usize) -> Severity {
    match count * share > of {
        true => Severity::Error,
        false => Severity::Warning,
    }
}

// Numbers of rows with a fault, its severity, the name of the check and the message.
fn row_findings(
    counts: &RowCounts,
    rows: &[Row],
    grid: &Grid,
) -> [(usize, Severity, &'static str, String); 7] {
    let cells = grid.cells();
    let error = Severity::Error;
    let (off_centre, [dx, dy]) = off_centre(rows, grid);
    [
        (
            counts.excess,
            error,
            "excess",
            format!(
                "too many rows (found {}, expected at most {cells}); the rest is ignored",
                rows.len()
            ),
        ),
        (
            counts.outside,
            error,
            "outside",
            format!(
                "{} rows are outside the {1} × {1} grid",
                counts.outside, grid.n
            ),
        ),
        (
            counts.missing,
            more_than(counts.missing, 10, cells),
            "missing",
            match counts.missing == cells {
                true => "no galaxy is on the grid".into(),
                false => format!(
                    "{} of {cells} galaxies are missing; each counts as zero",
                    counts.missing
                ),
            },
        ),
        (
            counts.repeated,
            error,
            "duplicates",
            format!(
                "{} rows repeat a galaxy; the scoring adds their ellipticities",
                counts.repeated
            ),
        ),
        (
            off_centre,
            Severity::Warning,
            "positions",
            format!(
                "{off_centre} positions are not at the centres of their cells (mean offset {dx:+.2}, {dy:+.2} px); expected 1-based FITS pixels of the stamp centre"
            ),
        ),
        (
            counts.not_finite,
            error,
            "not-finite",
            format!("{} ellipticities are not finite numbers", counts.not_finite),
        ),
        (
            counts.above_one,
            more_than(counts.above_one, 20, rows.len()),
            "range",
            format!("{} galaxies have |e| > 1", counts.above_one),
        ),
    ]
}

// Number of positions that are not at the centres of their cells, and their mean offset.
fn off_centre(rows: &[Row], grid: &Grid) -> (usize, [f64; 2]) {
    let (mut count, mut offset) = (0, [0.0; 2]);
    for Row { x, y, .. } in rows {
        let Some((ix, iy)) = grid.cell(*x, *y) else {
            continue;
        };
        let centre = grid.centre(ix, iy);
        let (dx, dy) = (x - centre.0, y - centre.1);
        if dx.abs().max(dy.abs()) > POSITION_TOLERANCE * grid.stamp.0 {
            count += 1;
            offset = [offset[0] + dx, offset[1] + dy];
        }
    }
    (count, offset.map(|sum| sum / count as f64))
}

// The name of a file without its folder, which may be temporary.
fn name_of(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

// `most` is the largest number of all sets.
fn check_images(
    set: u32,
    files: &SentImages<'_>,
    most: u32,
    path: &Path,
    expected: &Expected,
    report: &mut Report,
) {
    let last = files.numbers.last().copied().unwrap_or(0);
    let known = match &expected.images {
        ExpectedImages::Unknown => None,
        ExpectedImages::Each(count) => Some((1..=*count).collect()),
        ExpectedImages::OfSets(sets) => sets.get(&set).cloned(),
    };
    let is_known = known.is_some();
    let wanted: Vec<u32> = known.unwrap_or_else(|| (1..=last).collect());
    let listed = |from: &[u32], there: &[u32]| -> Vec<String> {
        let other = from.iter().filter(|image| !there.contains(image));
        other.map(u32::to_string).collect()
    };
    let missing = listed(&wanted, &files.numbers);
    if !missing.is_empty() {
        let message = format!(
            "set {set} lacks {} of {} images: {}{}",
            missing.len(),
            wanted.len(),
            missing[..missing.len().min(10)].join(", "),
            if missing.len() > 10 { ", …" } else { "" }
        );
        report.error(path, "images", message);
    }
    let more = listed(&files.numbers, &wanted);
    if let Some(image) = more.last() {
        let count = wanted.len();
        let message =
            format!("set {set}: too many images (found image {image}, expected {count} images)");
        // The data may be a part of those that were measured.
        let severity = match expected.images {
            ExpectedImages::OfSets(_) => Severity::Warning,
            ExpectedImages::Each(_) | ExpectedImages::Unknown => Severity::Error,
        };
        report.add(path, severity, "images", message);
    }
    if !is_known && last < most {
        let message = format!("set {set} has {last} images, and another set {most}");
        report.add(path, Severity::Warning, "images", message);
    }
}

fn check_against_truth(set: u32, files: &SentImages<'_>, expected: &Expected, report: &mut Report) {
    let Some(path) = files.paths.first() else {
        return;
    };
    // Without galaxies each catalogue has its finding already.
    if files.images.rows().used == 0 || !expected.truth.contains_key(&set) {
        return;
    }
    let before = report.findings.len();
    let Ok(ScoredImages {
        score, findings, ..
    }) = files.images.finish()
    else {
        return;
    };
    for finding in findings {
        let (check, severity) = match finding {
            Fault::StrongTruth { .. } => ("truth", Severity::Warning),
            Fault::Convention { .. } | Fault::Swapped { .. } => ("convention", Severity::Error),
            Fault::Shifted { .. } => ("order", Severity::Error),
            Fault::Uncorrelated { .. } => ("correlation", Severity::Warning),
            Fault::Distortion { .. } => ("type", Severity::Warning),
            Fault::Biased { .. } => ("bias", Severity::Warning),
        };
        let message = format!("set {set}: {}", words(&finding));
        report.add(path, severity, check, message);
    }
    // A fault that is named explains a low correlation.
    let clear = report.findings.len() == before;
    let matched = &score.conventions[score.matching.best().index()];
    if clear && score.constant.is_none() && matched.correlation < score.matching.least_clear() {
        let message = format!(
            "set {set}: no convention correlates with the true shear (best {:.2})",
            matched.correlation
        );
        report.warn(path, "correlation", message);
    }
}

fn check_spectrum(path: &Path, set: Option<u32>, expected: &Expected, report: &mut Report) {
    let lines = match read_spectrum(path) {
        Ok(lines) => lines,
        Err(error) => {
            report.error(path, "readable", error.text());
            return;
        }
    };
    let found: Vec<u32> = lines.iter().map(|line| line.index).collect();
    let wanted: Vec<u32> = SCORED.map(|b| b as u32 + 1).collect();
    if found != wanted {
        report.error(
            path,
            "bins",
            format!("the bins are {found:?}; expected {wanted:?}"),
        );
    }
    let bins = Bins::new(&expected.grid, Definition::Leaderboard);
    if let Some((SpectrumLine { index, l, .. }, centre, wrong)) = wrong_multipoles(&lines, &bins) {
        let message = format!(
            "{wrong} of {} multipoles do not belong to {n} × {n} galaxies (found l = {l} in bin {index}, expected {centre:.1}). Try: --grid N",
            lines.len(),
            n = expected.grid.n
        );
        report.error(path, "multipole", message);
    }
    for SpectrumLine { index, power, .. } in &lines {
        if !power.is_finite() {
            report.error(
                path,
                "not-finite",
                format!("the power of bin {index} is not a finite number"),
            );
        } else if *power < 0.0 {
            report.warn(
                path,
                "negative",
                format!("the power of bin {index} is negative: {power:e} (possible for noisy cross-spectra)"),
            );
        }
    }
    let truth = set.and_then(|set| expected.truth.get(&set));
    if let Some(truth) = truth
        && found == wanted
        && let Ok(scorer) = SetScorer::new(expected.grid, truth.clone(), Options::default())
    {
        let true_power = scorer.true_bandpowers();
        let (sum, true_sum) = lines.iter().fold((0.0, 0.0), |sums, line| {
            (
                sums.0 + line.power,
                sums.1 + true_power[line.index as usize - 1],
            )
        });
        // A cross-spectrum of noise can be negative.
        let ratio = (sum / true_sum).abs();
        // A power C_ℓ without the factor ℓ²/2π is smaller by 200 at the lowest multipole of a field of 10°.
        if !(0.01..100.0).contains(&ratio) {
            let message = format!(
                "the power is {ratio:.1e} times the true power; expected the unit ℓ²C_ℓ/2π. Noise also raises the power"
            );
            report.warn(path, "unit", message);
        }
    }
}
