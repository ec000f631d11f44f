//! Checks a submission before it is sent.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use shearq_scoring::{
    Bins, Convention, Definition, Fault, FieldSum, Grid, ImageFaults, Options, Row, RowCounts,
    SCORED, SetImages, SetScorer, TrueShear,
};

use super::{
    Contents, FileSum, Kind, Manifest, Sent, SpectrumLine, read_spectrum, wrong_multipoles,
};
use crate::catalogues::{OWN, read_rows};
use crate::views::scores::{odd_response, repeated_shapes, words};
use shearq_catalogue::foreign::{ADVICE_ON_SENTINELS, fault_of_rows};
use shearq_files::FileError;
use shearq_files::table::most_rows;

// Each catalogue is read as one image on the expected grid.
const ONE_IMAGE: &str = "one image on the expected grid";

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

#[derive(Debug, Clone)]
pub struct Expected {
    pub grid: Grid,
    /// True shear by set, if known, to check conventions and type of ellipticity.
    pub truth: BTreeMap<u32, TrueShear>,
    /// True shear that findings must not reveal: only images that do not follow it as the others do are told, to `done`.
    pub secret_truth: BTreeMap<u32, TrueShear>,
    pub images: Option<u32>,
    /// Sets that a submission must contain; it must contain no other sets. Empty if unknown.
    pub sets: Vec<u32>,
    /// Whether `sets` may be absent, with a warning.
    pub partial: bool,
}

// Largest accepted distance of a position from the centre of its cell, in cells.
// 0.48 px of the challenge's stamps, so that 0-based positions, which are off by 1 px, are found.
const POSITION_TOLERANCE: f64 = 0.01;

#[derive(Debug)]
pub struct CheckedSet<'a> {
    pub set: u32,
    pub images: &'a SetImages,
    pub numbers: &'a [u32],
    pub rows: RowCounts,
    /// Image numbers of those that follow the true shear differently from the others.
    pub odd: Vec<u32>,
}

impl Finding {
    /// The finding about a submission that cannot be opened.
    pub fn unreadable(error: FileError) -> Self {
        Finding {
            path: error.path,
            severity: Severity::Error,
            check: "readable",
            message: error.message,
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
        Err(error) => report.error(path, "readable", error.to_string()),
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
    if path.is_dir() {
        check_manifest(path, files, report);
    }
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
    let most = numbers.max().unwrap_or(0).max(expected.images.unwrap_or(0));
    for (set, of_set) in catalogues {
        let Some((mut files, odd)) = sum_set(set, of_set, expected, report) else {
            continue;
        };
        check_images(set, &mut files, most, path, expected, report);
        check_against_truth(set, &files, expected, report);
        done(CheckedSet {
            set,
            images: &files.images,
            numbers: &files.numbers,
            rows: files.rows,
            odd,
        });
    }
}

// The readable catalogues of a set, with the numbers of the images that follow the truth differently.
fn sum_set(
    set: u32,
    of_set: Vec<(u32, &PathBuf)>,
    expected: &Expected,
    report: &mut Report,
) -> Option<(SummedSet, Vec<u32>)> {
    let mut files: Option<SummedSet> = None;
    for (image, file) in of_set {
        // An unreadable catalogue is reported, and the others of its set are checked without it.
        let Some((sum, counts)) = check_catalogue(file, expected, report) else {
            continue;
        };
        let files = files.get_or_insert_with(|| SummedSet::new(expected, set));
        files.add(&sum, counts, image, file);
    }
    let files = files?;
    for (copy, first) in &files.faults.copies {
        let message = format!(
            "the ellipticities are copies of {}; expected an independent measurement per image",
            name_of(&files.paths[*first])
        );
        report.error(&files.paths[*copy], "copies", message);
    }
    let odd = files.faults.odd();
    // Of a secret truth, only `done` gets the numbers of such images: their response is the correlation with it.
    if expected.truth.contains_key(&set) {
        for odd in &odd {
            let message = format!("set {set}: the image {}", odd_response(odd));
            report.error(&files.paths[odd.place], "image", message);
        }
    }
    let odd = odd.iter().map(|odd| files.numbers[odd.place]).collect();
    Some((files, odd))
}

// Checks a catalogue whose name contains no set. A `single` file belongs to the only set.
fn check_unnamed(file: &Path, single: bool, expected: &Expected, report: &mut Report) {
    let Some((sum, counts)) = check_catalogue(file, expected, report) else {
        return;
    };
    if single && expected.truth.len() == 1 {
        for set in expected.truth.keys() {
            let mut entry = SummedSet::new(expected, *set);
            entry.add(&sum, counts, 1, file);
            check_against_truth(*set, &entry, expected, report);
        }
    } else if !expected.truth.is_empty() {
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

struct SummedSet {
    scorer: Option<SetScorer>,
    images: SetImages,
    faults: ImageFaults,
    paths: Vec<PathBuf>,
    numbers: Vec<u32>,
    rows: RowCounts,
}

impl SummedSet {
    fn new(expected: &Expected, set: u32) -> Self {
        let open = expected.truth.get(&set);
        let truth = open.or_else(|| expected.secret_truth.get(&set));
        let options = Options {
            choice: OWN,
            ..Options::default()
        };
        let scorer = |truth: &TrueShear| SetScorer::new(expected.grid, truth.clone(), options).ok();
        SummedSet {
            scorer: truth.and_then(scorer),
            images: SetImages::new(&expected.grid),
            faults: ImageFaults::default(),
            paths: Vec::new(),
            numbers: Vec::new(),
            rows: RowCounts::default(),
        }
    }

    fn add(&mut self, sum: &FieldSum, rows: RowCounts, image: u32, file: &Path) {
        self.rows += rows;
        self.faults.add(sum);
        let scorer = self.scorer.as_ref();
        let response = scorer.and_then(|scorer| scorer.response(sum, Convention::STANDARD));
        self.faults.add_response(response);
        self.images.add(sum).expect(ONE_IMAGE);
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

fn check_manifest(folder: &Path, files: &[PathBuf], report: &mut Report) {
    let manifest = match Manifest::read(folder) {
        Ok(Some(manifest)) => manifest,
        Ok(None) => return,
        Err(error) => return report.error(&error.path, "manifest", error.message),
    };
    let mut found = BTreeMap::new();
    for file in files {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        match FileSum::of(file) {
            Ok(sum) => _ = found.insert(name.into_owned(), sum),
            Err(error) => report.error(file, "readable", error.message),
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
}

// Most lines of a file that is taken for a spectrum: catalogues have thousands. Chosen by hand.
const MAX_SPECTRUM_LINES: usize = 20;

// Whether a file with an unknown name is a spectrum: its lines have three numbers.
fn looks_like_spectrum(path: &Path) -> bool {
    read_spectrum(path).is_ok_and(|lines| !lines.is_empty() && lines.len() <= MAX_SPECTRUM_LINES)
}

// Checks the rows of a catalogue. Returns their sum on the grid and how they were used, or `None` if the file is not
// readable.
fn check_catalogue(
    path: &Path,
    expected: &Expected,
    report: &mut Report,
) -> Option<(FieldSum, RowCounts)> {
    let rows = match read_rows(path, most_rows(expected.grid.cells())) {
        Ok(rows) => rows,
        Err(error) => {
            report.error(path, "readable", error.message);
            return None;
        }
    };
    let grid = &expected.grid;
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, rows.iter().copied());
    if let Some(fault) = fault_of_rows(&counts, grid, ADVICE_ON_SENTINELS) {
        report.error(path, "values", fault);
    }
    for (count, severity, check, message) in row_findings(&counts, &rows, grid) {
        if count > 0 {
            report.add(path, severity, check, message);
        }
    }
    let mut faults = ImageFaults::default();
    faults.add(&sum);
    if let Some((_, found)) = faults.repeated.first() {
        // Such galaxies are as good as missing, and are limited like these.
        let severity = more_than(found.rows, 10, found.of);
        let message = format!(
            "{}; expected measured values, which do not repeat, and no row for a galaxy that was not measured",
            repeated_shapes(found)
        );
        report.add(path, severity, "constant", message);
    }
    Some((sum, counts))
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

fn check_images(
    set: u32,
    files: &mut SummedSet,
    last: u32,
    path: &Path,
    expected: &Expected,
    report: &mut Report,
) {
    files.numbers.sort_unstable();
    let missing: Vec<String> = (1..=last)
        .filter(|image| files.numbers.binary_search(image).is_err())
        .map(|image| image.to_string())
        .collect();
    if !missing.is_empty() {
        let shown = missing
            .iter()
            .take(10)
            .cloned()
            .collect::<Vec<_>>()
            .join(", ");
        let more = if missing.len() > 10 { ", …" } else { "" };
        let message = format!(
            "set {set} lacks {} of {last} images: {shown}{more}",
            missing.len()
        );
        report.error(path, "images", message);
    }
    let last = files.numbers.last().copied().unwrap_or(0);
    if let Some(images) = expected.images.filter(|images| last > *images) {
        let message =
            format!("set {set}: too many images (found image {last}, expected {images} images)");
        report.error(path, "images", message);
    }
}

fn check_against_truth(set: u32, files: &SummedSet, expected: &Expected, report: &mut Report) {
    let SummedSet {
        scorer: Some(scorer),
        images,
        faults,
        paths,
        ..
    } = files
    else {
        return;
    };
    let Some(path) = paths.first() else {
        return;
    };
    // Without galaxies each catalogue has its finding already.
    let absent = images.total().count.iter().all(|count| *count == 0.0);
    if absent || !expected.truth.contains_key(&set) {
        return;
    }
    let before = report.findings.len();
    let Ok(score) = scorer.score(images) else {
        return;
    };
    // Copies appear to have no noise, and repeated ellipticities no response. Both are reported already.
    let explained = |fault: &Fault| match fault {
        Fault::Uncorrelated { .. } => !faults.copies.is_empty(),
        Fault::Biased { .. } => faults.repeated.iter().any(|(_, found)| found.is_constant()),
        _ => false,
    };
    let Ok(found) = scorer.diagnose(images, &score, Convention::STANDARD) else {
        return;
    };
    for finding in found.into_iter().filter(|fault| !explained(fault)) {
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
            report.error(path, "readable", error.message);
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
