//! Compares an entry with the public images: a reference measurement of one image per set finds swapped and flipped
//! components without the true shear.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::table::{FileFormat, most_rows};
use shearq_pipeline::PipelineError;
use shearq_pipeline::data::layout::{DataFolder, read_rows};
use shearq_pipeline::data::run::{Run, Source};
use shearq_pipeline::engine::Quiet;
use shearq_pipeline::images::ImageId;
use shearq_pipeline::measure::measure_folder;
use shearq_results::score::COLUMNS;
use shearq_results::submit::challenge::Kind;
use shearq_results::submit::check::{Finding, Severity};
use shearq_results::submit::packed::Sent;
use shearq_scoring::{Convention, FieldSum, Grid};
use shearq_submissions::Registry;

/// Configuration of the reference measurement.
const REFERENCE: &str = "48/linear/star";
/// Required difference of two correlations, in standard deviations of chance correlations.
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

    /// Slope of the sent ellipticities on the reference. Both have the noise of one image.
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

/// Reference measurements of the first image of each set.
#[derive(Debug)]
pub struct References {
    grid: Grid,
    sets: BTreeMap<u32, FieldSum>,
}

/// Number of the image that is measured.
const IMAGE: u32 = 1;

impl References {
    /// Measures the first image of `sets` in the public folder `data`. Sets without this image are left out.
    ///
    /// # Errors
    /// If an image cannot be measured.
    pub fn measure(
        data: &DataFolder,
        sets: &[u32],
        grid: Grid,
        threads: usize,
    ) -> Result<Self, PipelineError> {
        let files = data.images(sets)?;
        let has = |set: &u32| files.of_set(*set).iter().any(|(image, _)| *image == IMAGE);
        let ids: Vec<ImageId> = sets
            .iter()
            .copied()
            .filter(has)
            .map(|set| ImageId { set, image: IMAGE })
            .collect();
        let mut references = References {
            grid,
            sets: BTreeMap::new(),
        };
        if ids.is_empty() {
            return Ok(references);
        }
        let folder = Scratch::new()?;
        let configuration = Registry::embedded()
            .and_then(|registry| registry.get(REFERENCE))
            .map_err(|error| PipelineError::Request(error.to_string()))?
            .configuration;
        let source = Source::folder(data, folder.path())?;
        let run = Run::new(source, configuration, FileFormat::Parquet);
        measure_folder(&run, data, folder.path(), &ids, threads, &mut Quiet)?;
        for ImageId { set, image } in ids {
            let path = run.catalogue(folder.path(), set, image);
            references.sets.insert(set, references.read(&path)?);
        }
        Ok(references)
    }

    /// Whether there was no image to measure.
    pub fn is_empty(&self) -> bool {
        self.sets.is_empty()
    }

    /// A catalogue on the grid.
    fn read(&self, path: &Path) -> Result<FieldSum, FileError> {
        let rows = read_rows(path, &COLUMNS, most_rows(self.grid.cells()))?;
        let mut sum = FieldSum::new(&self.grid);
        sum.add_image(&self.grid, rows);
        Ok(sum)
    }

    /// Findings about the catalogues of an entry.
    ///
    /// # Errors
    /// If the files of the entry cannot be listed.
    pub fn findings(&self, sent: &Sent) -> Result<Vec<Finding>, FileError> {
        let files = sent
            .files()
            .map_err(FileError::doing(sent.path(), "cannot list the folder"))?;
        let mut found = Vec::new();
        for file in files {
            let Some(Kind::Catalogue { set, image, .. }) = Kind::of(&file) else {
                continue;
            };
            let Some(reference) = self.sets.get(&set).filter(|_| image == IMAGE) else {
                continue;
            };
            // An unreadable file is reported by the other checks.
            if let Ok(own) = self.read(&file) {
                found.extend(compare(reference, &own).map(|fault| finding(fault, sent, &file)));
            }
        }
        Ok(found)
    }
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
