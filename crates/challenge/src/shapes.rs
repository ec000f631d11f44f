//! Compares an entry with the public images: a reference measurement of every image finds swapped and flipped components,
//! and shapes that were not measured, without the true shear.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::Progress;
use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::table::{FileFormat, most_rows};
use shearq_pipeline::PipelineError;
use shearq_pipeline::measure::FolderMeasurement;
use shearq_results::catalogues::{read_rows, sent_galaxies};
use shearq_results::response::response_of;
use shearq_results::submit::check::{Finding, Severity};
use shearq_results::submit::{Kind, Sent};
use shearq_scoring::ndarray::Array2;
use shearq_scoring::{Convention, FieldSum, Grid};
use shearq_submissions::Registry;

const REFERENCE: &str = "48/linear/star";
// Required difference of two correlations, in standard deviations of chance correlations.
const MIN_CORRELATION_SIGNIFICANCE: f64 = 5.0;
// Slope on the reference above which ellipticities are probably distortions, which are nearly twice as large. It is the
// geometric mean of 1 and 2.
const MIN_DISTORTION_SLOPE: f64 = std::f64::consts::SQRT_2;
// Largest ratio of an image's slope to the median slope of its set, or inverse. A method has one response for all images of
// a set; the noise of the slope is 1/√(2·64) = 9 % on the smallest grid.
const SLOPE_RATIO: f64 = 2.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    Convention(Convention),
    Swapped,
    /// No convention agrees.
    Unrelated,
    /// Twice as large as shear-type ellipticities.
    Distortion {
        // Slope on the reference.
        slope: f64,
    },
    /// Larger or smaller than the shapes of the other images.
    Scale {
        // Ratio to the median of the set.
        ratio: f64,
    },
}

impl Fault {
    // Whether both are reported in one line.
    fn is_like(&self, other: &Self) -> bool {
        match (self, other) {
            (Fault::Convention(a), Fault::Convention(b)) => a == b,
            _ => std::mem::discriminant(self) == std::mem::discriminant(other),
        }
    }
}

// Ellipticities of one image by cell, in single precision because all images are in memory; NaN for none.
pub(crate) type Shapes = Array2<[f32; 2]>;

fn shapes_of(sum: &FieldSum) -> Shapes {
    Array2::from_shape_fn(sum.count.dim(), |at| match sum.count[at] > 0.0 {
        true => [sum.e1[at] as f32, sum.e2[at] as f32],
        false => [f32::NAN; 2],
    })
}

// Compares the galaxies of an image with a reference measurement of it. Returns the slope on the reference, too.
fn compare(reference: &Shapes, sent: &FieldSum) -> (Option<Fault>, f64) {
    let swapped = FieldSum {
        e1: sent.e2.clone(),
        e2: sent.e1.clone(),
        ..sent.clone()
    };
    let correlation =
        |sent: &FieldSum, convention| product(reference, sent, convention).correlation();
    let own = product(reference, sent, Convention::STANDARD);
    if own.galaxies == 0.0 {
        return (None, f64::NAN);
    }
    // Each component of each galaxy is an independent number.
    let chance = MIN_CORRELATION_SIGNIFICANCE / (2.0 * own.galaxies).sqrt();
    let others = Convention::ALL
        .into_iter()
        .filter(|k| *k != Convention::STANDARD)
        .map(|k| (correlation(sent, k), Fault::Convention(k)));
    let all = Convention::ALL.into_iter();
    let exchanged = all.map(|k| (correlation(&swapped, k), Fault::Swapped));
    let best = others.chain(exchanged).max_by(|a, b| a.0.total_cmp(&b.0));
    let of_own = own.correlation();
    let fault = match best {
        Some((other, fault)) if other > chance && other > of_own + chance => Some(fault),
        _ if of_own < chance => Some(Fault::Unrelated),
        _ => (own.slope() > MIN_DISTORTION_SLOPE).then(|| Fault::Distortion { slope: own.slope() }),
    };
    (fault, own.slope())
}

#[derive(Default)]
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

    // Slope of the sent ellipticities on the reference. Both have the noise of one image.
    fn slope(&self) -> f64 {
        self.cross / self.reference
    }
}

// Sums over the galaxies that both have, with the sent field in a convention.
fn product(reference: &Shapes, sent: &FieldSum, convention: Convention) -> Product {
    let (s1, s2) = convention.signs();
    let mut sums = Product::default();
    for ((i, j), own) in reference.indexed_iter() {
        let cell = match convention.transposes() {
            true => (j, i),
            false => (i, j),
        };
        if own[0].is_nan() || sent.count[cell] == 0.0 {
            continue;
        }
        let [r1, r2] = own.map(f64::from);
        let (e1, e2) = (s1 * sent.e1[cell], s2 * sent.e2[cell]);
        sums.cross += r1 * e1 + r2 * e2;
        sums.reference += r1 * r1 + r2 * r2;
        sums.sent += e1 * e1 + e2 * e2;
        sums.galaxies += 1.0;
    }
    sums
}

#[derive(Debug)]
pub struct References {
    grid: Grid,
    images: ShapesOfImages,
}

impl References {
    pub fn measure(
        data: &DataFolder,
        ids: &[ImageId],
        grid: Grid,
        threads: usize,
        progress: &mut dyn Progress,
    ) -> Result<Self, PipelineError> {
        let mut references = References {
            grid,
            images: BTreeMap::new(),
        };
        if ids.is_empty() {
            return Ok(references);
        }
        let folder = Scratch::new()?;
        let configuration = Registry::embedded()
            .and_then(|registry| registry.get(REFERENCE))
            .expect("a test reads all configurations of the program")
            .configuration;
        let source = Source::folder(data, folder.path())?;
        let run = Run::new(source, configuration, FileFormat::Parquet);
        FolderMeasurement::open(&run, data, folder.path(), ids)?
            .write_catalogues(threads, progress)?;
        let path = |id: &ImageId| run.catalogue(folder.path(), id.set, id.image);
        let most = most_rows(grid.cells());
        let mut sets: BTreeMap<u32, Vec<ImageId>> = BTreeMap::new();
        for id in ids {
            sets.entry(id.set).or_default().push(*id);
        }
        for ids in sets.into_values() {
            let paths: Vec<PathBuf> = ids.iter().map(path).collect();
            // Images of noise have no response, and shapes of them are no reference.
            let Ok([r1, r2]) = response_of(paths.iter().map(PathBuf::as_path)) else {
                continue;
            };
            for (ImageId { set, image }, path) in ids.into_iter().zip(&paths) {
                let mut sum = FieldSum::new(&references.grid);
                sum.add_image(&references.grid, read_rows(path, most)?);
                sum.e1 /= r1;
                sum.e2 /= r2;
                references.images.insert((set, image), shapes_of(&sum));
            }
        }
        Ok(references)
    }

    pub fn ids(data: &DataFolder, sets: &[u32]) -> Result<Vec<ImageId>, FileError> {
        let files = data.images(sets)?;
        let of_set = |set: &u32| {
            let set = *set;
            let images = files.of_set(set).into_iter();
            images.map(move |(image, _)| ImageId { set, image })
        };
        let mut ids: Vec<ImageId> = sets.iter().flat_map(of_set).collect();
        // All images of a subfield of GREAT3 are epochs, which are measured together.
        if data.layout().great3.is_some() {
            ids.dedup_by_key(|id| id.set);
        }
        Ok(ids)
    }

    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    pub(crate) fn of(&self, set: u32, image: u32) -> Option<FieldSum> {
        let shapes = self.images.get(&(set, image))?;
        let mut sum = FieldSum::new(&self.grid);
        sum.images = 1;
        for (at, shape) in shapes
            .indexed_iter()
            .filter(|(_, shape)| !shape[0].is_nan())
        {
            sum.count[at] = 1.0;
            [sum.e1[at], sum.e2[at]] = shape.map(f64::from);
        }
        Some(sum)
    }

    /// Findings about the catalogues of an entry: one for each fault and set, with the numbers of its images.
    pub fn findings(&self, sent: &Sent) -> Result<Vec<Finding>, FileError> {
        let files = sent.files()?;
        let mut sets: BTreeMap<u32, BTreeMap<u32, PathBuf>> = BTreeMap::new();
        for file in files {
            if let Some(Kind::Catalogue { set, image, .. }) = Kind::of(&file) {
                sets.entry(set).or_default().insert(image, file);
            }
        }
        let mut found = Vec::new();
        let sum = |file: &Path| {
            let mut sum = FieldSum::new(&self.grid);
            sum.add_weighted(
                &self.grid,
                sent_galaxies(file, most_rows(self.grid.cells()))?,
            );
            Ok::<_, FileError>(sum)
        };
        for (set, files) in sets {
            let compared = files.iter().filter_map(|(image, file)| {
                let reference = self.images.get(&(set, *image))?;
                // An unreadable file is reported by the other checks.
                let (fault, slope) = compare(reference, &sum(file).ok()?);
                Some((*image, fault, slope))
            });
            for (fault, images) in faults(compared.collect()) {
                let Some(file) = images.first().and_then(|image| files.get(image)) else {
                    continue;
                };
                found.push(finding(fault, &images, sent, file));
            }
        }
        Ok(found)
    }
}

type ShapesOfImages = BTreeMap<(u32, u32), Shapes>;

// What is wrong in a set, each with the numbers of the images.
fn faults(mut compared: Vec<(u32, Option<Fault>, f64)>) -> Vec<(Fault, Vec<u32>)> {
    // Only images that agree with the reference have a slope to compare with.
    let sound = |fault: &Option<Fault>| matches!(fault, None | Some(Fault::Distortion { .. }));
    let slopes = compared.iter().filter(|(_, fault, _)| sound(fault));
    let mut slopes: Vec<f64> = slopes.map(|(.., slope)| *slope).collect();
    slopes.retain(|slope| slope.is_finite());
    slopes.sort_by(f64::total_cmp);
    if let Some(&median) = slopes.get(slopes.len() / 2) {
        for (_, fault, slope) in &mut compared {
            let ratio = *slope / median;
            if sound(fault) && !(1.0 / SLOPE_RATIO..=SLOPE_RATIO).contains(&ratio) {
                *fault = ratio.is_finite().then_some(Fault::Scale { ratio });
            }
        }
    }
    let mut found: Vec<(Fault, Vec<u32>)> = Vec::new();
    for (image, fault, _) in compared {
        let Some(fault) = fault else { continue };
        match found.iter_mut().find(|(known, _)| known.is_like(&fault)) {
            Some((_, images)) => images.push(image),
            None => found.push((fault, vec![image])),
        }
    }
    found
}

fn ranges(numbers: &[u32]) -> String {
    let texts = numbers.chunk_by(|a, b| a + 1 == *b).map(|run| match run {
        [one] => one.to_string(),
        run => format!("{}-{}", run[0], run[run.len() - 1]),
    });
    texts.collect::<Vec<_>>().join(",")
}

// What is wrong with `images`, in words. `file` is the first of them.
fn finding(fault: Fault, images: &[u32], sent: &Sent, file: &Path) -> Finding {
    let (check, message) = match fault {
        Fault::Convention(convention) => (
            "convention",
            format!(
                "the shapes agree with the image only after a change of signs or axes (found convention {}, {}; expected 5, standard)",
                convention.number(),
                convention.describe()
            ),
        ),
        Fault::Swapped => (
            "convention",
            "e1 and e2 are swapped: the shapes agree with the image in the other order".into(),
        ),
        Fault::Unrelated => (
            "shapes",
            "the shapes do not agree with the image; were the rows or images exchanged?".into(),
        ),
        Fault::Distortion { slope } => (
            "type",
            format!(
                "the ellipticities are {slope:.1} times as large as shear-type ellipticities; are they distortions, (a² − b²)/(a² + b²)?"
            ),
        ),
        Fault::Scale { ratio } => (
            "shapes",
            format!(
                "the ellipticities are {ratio:.1e} times as large as in the other images of the set (expected 0.5 to 2)"
            ),
        ),
    };
    // Shapes that are too large agree with the image: only their type is in doubt.
    let severity = match fault {
        Fault::Distortion { .. } => Severity::Warning,
        _ => Severity::Error,
    };
    let more = match images {
        [] | [_] => String::new(),
        [_, more @ ..] => format!("; also image {}", ranges(more)),
    };
    Finding {
        path: sent.as_given(file),
        severity,
        check,
        message: format!("{message}{more} [reference: {REFERENCE}]"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shearq_quantities::units::{Degrees, Pixels};

    // Ellipticities that are neither symmetric nor of one sign, in the order that `edit` gives them.
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
        let reference = shapes_of(&right);
        let compare = |sent: &FieldSum| compare(&reference, sent).0;
        assert_eq!(compare(&right), None);
        assert_eq!(compare(&field(|a, b| (0.7 * a, 0.7 * b))), None);
        let fault = |edit: fn(f64, f64) -> (f64, f64)| compare(&field(edit));
        let convention = |number: u8| Some(Fault::Convention(number.try_into().unwrap()));
        assert_eq!(fault(|a, b| (a, -b)), convention(6));
        assert_eq!(fault(|a, b| (-a, b)), convention(8));
        assert_eq!(fault(|a, b| (-a, -b)), convention(7));
        assert_eq!(fault(|a, b| (b, a)), Some(Fault::Swapped));
        assert_eq!(fault(|_, _| (0.0, 0.0)), Some(Fault::Unrelated));
        // The reference has single precision.
        assert!(matches!(
            fault(|a, b| (2.0 * a, 2.0 * b)),
            Some(Fault::Distortion { slope }) if (slope - 2.0).abs() < 1e-6
        ));
        let mut turned = right.clone();
        turned.e1 = right.e1.t().to_owned();
        turned.e2 = right.e2.t().to_owned();
        assert_eq!(compare(&turned), convention(1));
    }

    #[test]
    fn faulty_images_are_named_by_set() {
        let unrelated = Some(Fault::Unrelated);
        let distortion = |slope| (Some(Fault::Distortion { slope }), slope);
        let set = |images: &[(Option<Fault>, f64)]| {
            let compared = (1..)
                .zip(images)
                .map(|(k, (fault, slope))| (k, *fault, *slope));
            faults(compared.collect())
        };
        assert_eq!(set(&[(None, 0.9), (None, 1.1)]), []);
        // Shapes in one image and noise in the others.
        let noise = (unrelated, 1e-8);
        assert_eq!(
            set(&[(None, 0.9), noise, noise, noise]),
            [(Fault::Unrelated, vec![2, 3, 4])]
        );
        // Measured shapes, but shrunk in most images: the median is theirs.
        let shrunk = (None, 1e-6);
        let found = set(&[(None, 1.0), shrunk, shrunk, shrunk]);
        assert!(
            matches!(&found[..], [(Fault::Scale { ratio }, images)] if *ratio > 9e5 && images == &[1])
        );
        assert_eq!(set(&[distortion(1.9), distortion(1.8)])[0].1, [1, 2]);
        assert_eq!(ranges(&[1, 2, 3, 7, 9, 10]), "1-3,7,9-10");
    }
}
