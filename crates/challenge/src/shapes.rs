//! Compares an entry with the public images: a reference measurement of one image per set finds swapped and flipped
//! components without the true shear.

use std::path::Path;

use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::table::{FileFormat, most_rows};
use shearq_pipeline::data::layout::{DataFolder, read_rows};
use shearq_pipeline::data::run::{Run, Source};
use shearq_pipeline::engine::Quiet;
use shearq_pipeline::images::ImageId;
use shearq_pipeline::measure::measure_folder;
use shearq_pipeline::{PipelineError, grid};
use shearq_results::score::COLUMNS;
use shearq_results::submit::challenge::Kind;
use shearq_results::submit::check::{Finding, Severity};
use shearq_results::submit::packed::Sent;
use shearq_scoring::{Convention, FieldSum, Grid};
use shearq_submissions::Registry;

/// Configuration of the reference measurement.
const REFERENCE: &str = "48/linear/star";
/// Standard deviations of chance correlations by which one order of the components must be better.
const CLEAR: f64 = 5.0;
/// Slope on the reference above which ellipticities are probably distortions, which are nearly twice as large. It is the
/// geometric mean of 1 and 2.
const SLOPE: f64 = std::f64::consts::SQRT_2;

/// What is wrong with the shapes of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// Another convention of signs and axes agrees better.
    Convention(Convention),
    /// The components are in the other order.
    Swapped,
    /// No convention agrees.
    Unrelated,
    /// Twice as large as shear-type ellipticities.
    Distortion {
        /// Slope on the reference.
        slope: f64,
    },
}

/// Compares the galaxies of an image with a reference measurement of it.
pub fn compare(reference: &FieldSum, sent: &FieldSum) -> Option<Fault> {
    let swapped = FieldSum {
        e1: sent.e2.clone(),
        e2: sent.e1.clone(),
        ..sent.clone()
    };
    let own = product(reference, sent, Convention::STANDARD);
    if own.galaxies == 0.0 {
        return None;
    }
    // Each component of each galaxy is an independent number.
    let chance = CLEAR / (2.0 * own.galaxies).sqrt();
    let others = Convention::ALL
        .into_iter()
        .filter(|k| *k != Convention::STANDARD)
        .map(|k| {
            (
                product(reference, sent, k).correlation(),
                Fault::Convention(k),
            )
        });
    let exchanged = Convention::ALL.into_iter().map(|k| {
        (
            product(reference, &swapped, k).correlation(),
            Fault::Swapped,
        )
    });
    let best = others.chain(exchanged).max_by(|a, b| a.0.total_cmp(&b.0));
    let correlation = own.correlation();
    match best {
        Some((other, fault)) if other > chance && other > correlation + chance => Some(fault),
        _ if correlation < chance => Some(Fault::Unrelated),
        _ => (own.slope() > SLOPE).then(|| Fault::Distortion { slope: own.slope() }),
    }
}

/// Sums over the galaxies of two fields.
struct Product {
    cross: f64,
    reference: f64,
    sent: f64,
    galaxies: f64,
}

impl Product {
    fn correlation(&self) -> f64 {
        match self.cross / (self.reference * self.sent).sqrt() {
            known if known.is_finite() => known,
            _ => 0.0,
        }
    }

    /// Slope of the sent ellipticities on the reference. The noise is that of one image, so it is common to both.
    fn slope(&self) -> f64 {
        self.cross / self.reference
    }
}

/// Sums over the galaxies that both have, with the sent field in a convention.
fn product(reference: &FieldSum, sent: &FieldSum, convention: Convention) -> Product {
    let (s1, s2) = convention.signs();
    let mut sums = Product {
        cross: 0.0,
        reference: 0.0,
        sent: 0.0,
        galaxies: 0.0,
    };
    for ((i, j), &count) in reference.count.indexed_iter() {
        let cell = match convention.transposes() {
            true => (j, i),
            false => (i, j),
        };
        if count == 0.0 || sent.count[cell] == 0.0 {
            continue;
        }
        let (r1, r2) = (reference.e1[(i, j)], reference.e2[(i, j)]);
        let (e1, e2) = (s1 * sent.e1[cell], s2 * sent.e2[cell]);
        sums.cross += r1 * e1 + r2 * e2;
        sums.reference += r1 * r1 + r2 * r2;
        sums.sent += e1 * e1 + e2 * e2;
        sums.galaxies += 1.0;
    }
    sums
}

/// Findings about the catalogues of an entry. The first image of each set is measured from the public folder `data`.
///
/// # Errors
/// If an image cannot be measured.
pub fn findings(
    sent: &Sent,
    data: &DataFolder,
    threads: usize,
) -> Result<Vec<Finding>, PipelineError> {
    let files = sent
        .files()
        .map_err(FileError::doing(sent.path(), "cannot list the folder"))?;
    let mut first = std::collections::BTreeMap::new();
    for file in files {
        if let Some(Kind::Catalogue { set, image, .. }) = Kind::of(&file) {
            let best = first.entry(set).or_insert_with(|| (image, file.clone()));
            if image < best.0 {
                *best = (image, file);
            }
        }
    }
    let there = data.images(&[])?;
    first.retain(|set, (image, _)| there.of_set(*set).iter().any(|(own, _)| own == image));
    let ids: Vec<ImageId> = first
        .iter()
        .map(|(&set, &(image, _))| ImageId { set, image })
        .collect();
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let folder = Scratch::new()?;
    let configuration = Registry::embedded()
        .and_then(|registry| registry.get(REFERENCE))
        .map_err(|error| PipelineError::Request(error.to_string()))?
        .configuration;
    let source = Source::folder(data, folder.path())?;
    let run = Run::new(source, configuration, FileFormat::Parquet);
    measure_folder(&run, data, folder.path(), &ids, threads, &mut Quiet)?;
    let mut found = Vec::new();
    for (&set, (image, file)) in &first {
        let path = run.catalogue(folder.path(), set, *image);
        let rows = read_rows(&path, &COLUMNS, shearq_files::table::MAX_ROWS)?;
        let n = grid::side(&path, rows.len())?;
        let stamp = rows.first().map_or(1.0, |row| 2.0 * row.x - 1.0);
        let grid = Grid::new(
            n,
            shearq_quantities::units::Pixels(stamp),
            shearq_quantities::units::Degrees(data.layout().field_degrees),
        )
        .map_err(|error| FileError::new(&path, error))?;
        let mut reference = FieldSum::new(&grid);
        reference.add_image(&grid, rows);
        let mut own = FieldSum::new(&grid);
        // An unreadable file is reported by the other checks.
        let Ok(rows) = read_rows(file, &COLUMNS, most_rows(grid.cells())) else {
            continue;
        };
        own.add_image(&grid, rows);
        found.extend(compare(&reference, &own).map(|fault| finding(fault, sent, file)));
    }
    Ok(found)
}

/// A fault in words.
fn finding(fault: Fault, sent: &Sent, file: &Path) -> Finding {
    let (severity, check, message) = match fault {
        Fault::Convention(convention) => (
            Severity::Error,
            "convention",
            format!(
                "the shapes agree with the image only after a change of signs or axes (found convention {}, {}; expected 5, standard)",
                convention.number(),
                convention.describe()
            ),
        ),
        Fault::Swapped => (
            Severity::Error,
            "convention",
            "e1 and e2 are swapped: the shapes agree with the image in the other order".into(),
        ),
        Fault::Unrelated => (
            Severity::Error,
            "shapes",
            "the shapes do not agree with the image; were the rows or images exchanged?".into(),
        ),
        Fault::Distortion { slope } => (
            Severity::Warning,
            "type",
            format!(
                "the ellipticities are {slope:.1} times as large as shear-type ellipticities; are they distortions, (a² − b²)/(a² + b²)?"
            ),
        ),
    };
    Finding {
        path: sent.as_given(file),
        severity,
        check,
        message: format!("{message} [reference: {REFERENCE}]"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;
    use shearq_quantities::units::{Degrees, Pixels};

    /// Ellipticities that are neither symmetric nor of one sign, in the order that `edit` gives them.
    fn field(edit: impl Fn(f64, f64) -> (f64, f64)) -> FieldSum {
        let n = 16;
        let grid = Grid::new(n, Pixels(48.0), Degrees(10.0)).unwrap();
        let mut sum = FieldSum::new(&grid);
        sum.images = 1;
        sum.count = Array2::from_elem((n, n), 1.0);
        for ((i, j), e1) in sum.e1.indexed_iter_mut() {
            let phase = (i * 37 + j * 101) as f64;
            let (a, b) = (0.2 * (phase * 1.7).sin(), 0.2 * (phase * 0.9 + 1.0).cos());
            let (first, second) = edit(a, b);
            *e1 = first;
            sum.e2[(i, j)] = second;
        }
        sum
    }

    #[test]
    fn swapped_flipped_and_larger_shapes_are_found() {
        let right = field(|a, b| (a, b));
        assert_eq!(compare(&right, &right), None);
        assert_eq!(compare(&right, &field(|a, b| (0.7 * a, 0.7 * b))), None);
        let fault = |edit: fn(f64, f64) -> (f64, f64)| compare(&right, &field(edit));
        let convention = |number: u8| Some(Fault::Convention(number.try_into().unwrap()));
        assert_eq!(fault(|a, b| (a, -b)), convention(6));
        assert_eq!(fault(|a, b| (-a, b)), convention(8));
        assert_eq!(fault(|a, b| (-a, -b)), convention(7));
        assert_eq!(fault(|a, b| (b, a)), Some(Fault::Swapped));
        assert_eq!(fault(|_, _| (0.0, 0.0)), Some(Fault::Unrelated));
        assert!(matches!(
            fault(|a, b| (2.0 * a, 2.0 * b)),
            Some(Fault::Distortion { slope }) if (slope - 2.0).abs() < 1e-12
        ));
        let mut turned = right.clone();
        turned.e1 = right.e1.t().to_owned();
        turned.e2 = right.e2.t().to_owned();
        assert_eq!(compare(&right, &turned), convention(1));
    }
}
