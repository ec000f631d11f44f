//! Checks of a submission before it is sent.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use shearq_scoring::{
    Bins, Choice, Convention, Definition, Fault, FieldSum, Grid, ImageFaults, Options, Row, SCORED,
    SetImages, SetScorer, TrueShear,
};

use super::challenge::{Kind, SpectrumLine, read_spectrum, wrong_multipoles};
use super::manifest::{Contents, FileSum, Manifest};
use super::packed::Sent;
use crate::score::COLUMNS;
use crate::views::diagnosis::words;
use crate::views::rows::fault as odd_rows;
use shearq_files::table::most_rows;
use shearq_pipeline::data::layout::read_rows;

/// Each catalogue is read as one image on the expected grid.
const ONE_IMAGE: &str = "one image on the expected grid";

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth a look.
    Warning,
    /// The submission would not be scored as meant.
    Error,
}

/// One thing found.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Finding {
    /// File or folder.
    pub path: PathBuf,
    /// How bad.
    pub severity: Severity,
    /// Short name of the check.
    pub check: &'static str,
    /// What was found and what was expected.
    pub message: String,
}

/// What the files are checked against.
pub struct Expected {
    /// The grid.
    pub grid: Grid,
    /// True shear by set, where known: then conventions and the type of ellipticity are checked.
    pub truth: BTreeMap<u32, TrueShear>,
    /// Images that every set must have, where known.
    pub images: Option<u32>,
}

/// Largest share of a cell by which positions may be off its centre.
const POSITION_TOLERANCE: f64 = 0.01;

/// Checks a file, or all files of a folder or an archive.
pub fn check(path: &Path, expected: &Expected) -> Vec<Finding> {
    match Sent::open(path) {
        Err(error) => {
            let mut report = Report::default();
            report.error(&error.path, "readable", error.message);
            report.findings
        }
        Ok(sent) => {
            let mut findings = check_files(&sent, expected);
            for finding in &mut findings {
                finding.path = sent.as_given(&finding.path);
            }
            findings
        }
    }
}

fn check_files(sent: &Sent, expected: &Expected) -> Vec<Finding> {
    let path = sent.path();
    let mut report = Report::default();
    let files = match sent.files() {
        Ok(files) => files,
        Err(error) => {
            report.error(path, "readable", error.to_string());
            return report.findings;
        }
    };
    if files.is_empty() {
        report.error(path, "empty", "there is no file here".into());
    }
    if path.is_dir() {
        check_manifest(path, &files, &mut report);
    }
    let mut sets: BTreeMap<u32, SetFiles> = BTreeMap::new();
    let mut spectra = BTreeSet::new();
    let mut methods: BTreeMap<String, PathBuf> = BTreeMap::new();
    for file in &files {
        let kind = Kind::of(file);
        match &kind {
            None => {
                let single = files.len() == 1 && path.is_file();
                let message = format!("the name is {}", Kind::EXPECTED);
                if single {
                    report.warn(file, "name", message);
                } else {
                    report.error(file, "name", message);
                }
            }
            Some(Kind::Catalogue { method, .. } | Kind::Spectrum { method, .. }) => {
                methods
                    .entry(method.clone())
                    .or_insert_with(|| file.clone());
            }
        }
        let spectrum = match &kind {
            Some(kind) => matches!(kind, Kind::Spectrum { .. }),
            None => looks_like_spectrum(file),
        };
        if spectrum {
            spectra.extend(kind.as_ref().map(Kind::set));
            check_spectrum(file, kind.as_ref(), expected, &mut report);
            continue;
        }
        let Some(sum) = check_catalogue(file, expected, &mut report) else {
            continue;
        };
        match &kind {
            Some(Kind::Catalogue { set, image, .. }) => {
                let entry = sets.entry(*set).or_insert_with(|| SetFiles {
                    images: SetImages::new(&expected.grid),
                    faults: ImageFaults::default(),
                    paths: Vec::new(),
                    numbers: Vec::new(),
                    first: file.clone(),
                });
                entry.faults.add(&sum);
                entry.images.add(&sum).expect(ONE_IMAGE);
                entry.numbers.push(*image);
                entry.paths.push(file.clone());
            }
            // A lone file of another name can only belong to the only set there is.
            _ if files.len() == 1 && expected.truth.len() == 1 => {
                let mut images = SetImages::new(&expected.grid);
                let mut faults = ImageFaults::default();
                faults.add(&sum);
                images.add(&sum).expect(ONE_IMAGE);
                for set in expected.truth.keys() {
                    check_against_truth(*set, &images, &faults, file, expected, &mut report);
                }
            }
            _ if !expected.truth.is_empty() => {
                let message = "its name does not say of which set it is; it is not compared with the true shear";
                report.warn(file, "truth", message.into());
            }
            _ => {}
        }
    }
    if methods.len() > 1 {
        let names: Vec<&str> = methods.keys().map(String::as_str).collect();
        report.error(
            path,
            "method",
            format!("files of several methods: {}", names.join(", ")),
        );
    }
    if path.is_dir() && !(sets.is_empty() && spectra.is_empty()) {
        for set in expected.truth.keys() {
            if !sets.contains_key(set) && !spectra.contains(set) {
                let message = format!("there is no file for set {set}, of which there are data");
                report.warn(path, "sets", message);
            }
        }
    }
    let most = sets.values().flat_map(|files| &files.numbers).max();
    let most = most.copied().unwrap_or(0).max(expected.images.unwrap_or(0));
    for (set, files) in &mut sets {
        check_copies(files, &mut report);
        check_images(*set, files, most, path, expected, &mut report);
        let faults = &files.faults;
        check_against_truth(
            *set,
            &files.images,
            faults,
            &files.first,
            expected,
            &mut report,
        );
    }
    report.findings
}

struct SetFiles {
    images: SetImages,
    faults: ImageFaults,
    paths: Vec<PathBuf>,
    numbers: Vec<u32>,
    first: PathBuf,
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

/// Compares the files of a folder with its manifest, if it has one.
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
            let message = "the manifest has no covariance of its bandpowers, so that scores have no errors; expected one, which takes eight images";
            report.warn(&folder.join(name), "covariance", message.into());
        }
    }
}

/// A file of an unknown name is a spectrum if its lines have three numbers.
fn looks_like_spectrum(path: &Path) -> bool {
    read_spectrum(path).is_ok_and(|lines| !lines.is_empty() && lines.len() <= 20)
}

fn check_catalogue(path: &Path, expected: &Expected, report: &mut Report) -> Option<FieldSum> {
    let rows = match read_rows(path, &COLUMNS, most_rows(expected.grid.cells())) {
        Ok(rows) => rows,
        Err(error) => {
            report.error(path, "readable", error.message);
            return None;
        }
    };
    let grid = &expected.grid;
    let cells = grid.cells();
    let mut sum = FieldSum::new(grid);
    let counts = sum.add_image(grid, rows.iter().copied());
    let (mut off_centre, mut offset) = (0, (0.0, 0.0));
    for Row { x, y, .. } in &rows {
        let Some((ix, iy)) = grid.cell(*x, *y) else {
            continue;
        };
        let centre = grid.centre(ix, iy);
        let (dx, dy) = (x - centre.0, y - centre.1);
        if dx.abs().max(dy.abs()) > POSITION_TOLERANCE * grid.stamp.0 {
            off_centre += 1;
            offset = (offset.0 + dx, offset.1 + dy);
        }
    }
    if let Some(fault) = odd_rows(&counts, grid) {
        report.error(path, "values", fault);
    }
    if counts.excess > 0 {
        let message = format!(
            "{} rows; the {cells} cells take no more, the rest is ignored",
            rows.len()
        );
        report.error(path, "excess", message);
    }
    if counts.outside > 0 {
        report.error(
            path,
            "outside",
            format!(
                "{} rows lie outside the {1} × {1} grid",
                counts.outside, grid.n
            ),
        );
    }
    if counts.missing == cells {
        report.error(path, "missing", "no galaxy of the grid is there".into());
    } else if counts.missing > 0 {
        let message = format!(
            "{} of {cells} galaxies are missing; each counts as zero",
            counts.missing
        );
        if counts.missing * 10 > cells {
            report.error(path, "missing", message);
        } else {
            report.warn(path, "missing", message);
        }
    }
    if counts.repeated > 0 {
        let message = format!(
            "{} rows are of galaxies that have one already; their ellipticities add up",
            counts.repeated
        );
        report.error(path, "duplicates", message);
    }
    if off_centre > 0 {
        let (dx, dy) = (
            offset.0 / f64::from(off_centre),
            offset.1 / f64::from(off_centre),
        );
        let message = format!(
            "{off_centre} positions are off the centres of their cells, on average by ({dx:+.2}, {dy:+.2}) px; positions are 1-based FITS pixels of the stamp centre"
        );
        report.warn(path, "positions", message);
    }
    if counts.not_finite > 0 {
        report.error(
            path,
            "not-finite",
            format!("{} ellipticities are not finite numbers", counts.not_finite),
        );
    }
    if counts.above_one > 0 {
        let message = format!("{} galaxies have |e| > 1", counts.above_one);
        if counts.above_one * 20 > rows.len() {
            report.error(path, "range", message);
        } else {
            report.warn(path, "range", message);
        }
    }
    if counts.used > 0 && sum.e1.iter().chain(&sum.e2).all(|e| *e == 0.0) {
        report.error(path, "constant", "all ellipticities are zero".into());
    } else if counts.used > 1 {
        let first = rows.iter().find(|r| r.e1.is_finite());
        if first.is_some_and(|f| rows.iter().all(|r| r.e1 == f.e1 && r.e2 == f.e2)) {
            report.error(
                path,
                "constant",
                "all galaxies have the same ellipticity".into(),
            );
        }
    }
    Some(sum)
}

/// Catalogues with the ellipticities of another image of their set.
fn check_copies(files: &SetFiles, report: &mut Report) {
    for (copy, first) in &files.faults.copies {
        let message = format!(
            "the ellipticities are those of {}; expected an independent measurement per image",
            name_of(&files.paths[*first])
        );
        report.error(&files.paths[*copy], "copies", message);
    }
}

/// The name of a file without its folder, which may be a temporary one.
fn name_of(path: &Path) -> String {
    path.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

fn check_images(
    set: u32,
    files: &mut SetFiles,
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
        let message = format!("set {set} has an image {last}; expected {images} images");
        report.error(path, "images", message);
    }
}

/// Conventions and type of ellipticity, where the truth is known.
fn check_against_truth(
    set: u32,
    images: &SetImages,
    faults: &ImageFaults,
    path: &Path,
    expected: &Expected,
    report: &mut Report,
) {
    if images.total().count.iter().all(|count| *count == 0.0) {
        return;
    }
    let Some(truth) = expected.truth.get(&set) else {
        return;
    };
    let before = report.findings.len();
    let options = Options {
        choice: Choice::Insist(Convention::STANDARD),
        ..Options::default()
    };
    let Ok(scorer) = SetScorer::new(expected.grid, truth.clone(), options) else {
        return;
    };
    let Ok(score) = scorer.score(images) else {
        return;
    };
    // Copies seem to have no noise, and constant ellipticities no response; both are reported already.
    let explained = |fault: &Fault| match fault {
        Fault::Uncorrelated { .. } => !faults.copies.is_empty(),
        Fault::Biased { .. } => !faults.constant.is_empty(),
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

fn check_spectrum(path: &Path, kind: Option<&Kind>, expected: &Expected, report: &mut Report) {
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
            "{wrong} of {} multipoles are not those of {n} × {n} galaxies (--grid): bin {index} has l = {l}, expected {centre:.1}",
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
                format!("the power of bin {index} is negative: {power:e} (noise can do that to cross-spectra)"),
            );
        }
    }
    let truth = kind.and_then(|kind| expected.truth.get(&kind.set()));
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
        // Noise alone makes a cross-spectrum negative.
        let ratio = (sum / true_sum).abs();
        if !(0.01..100.0).contains(&ratio) {
            let message = format!(
                "the power is {ratio:.1e} times the true one; the unit is ℓ²C_ℓ/2π (noise raises it, too)"
            );
            report.warn(path, "unit", message);
        }
    }
}
