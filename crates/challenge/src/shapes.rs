//! Compares an entry with the public images: a reference measurement of every image finds swapped and flipped components,
//! and shapes that were not measured, without the true shear.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::fingerprint::Fingerprint;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::{Progress, Quiet};
use shearq_files::FileError;
use shearq_files::atomic::Scratch;
use shearq_files::frames::polars::Column;
use shearq_files::frames::{Metadata, frame};
use shearq_files::open::is_there;
use shearq_files::table::{self, FileFormat, most_rows};
use shearq_pipeline::PipelineError;
use shearq_pipeline::measure::FolderMeasurement;
use shearq_results::catalogues::read_rows;
use shearq_results::response::response_of;
use shearq_results::submit::check::{Finding, Severity};
use shearq_results::submit::{Kind, Sent};
use shearq_scoring::ndarray::Array2;
use shearq_scoring::{Convention, FieldSum, Grid};
use shearq_submissions::Registry;

use crate::seal::Key;

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
    /// The reference measurement of images that do not change, as their fingerprint `print` states. It is kept in `folder`,
    /// a table per set, because it takes longer than to score an entry.
    ///
    /// # Errors
    /// If a kept table is not the one that was signed with the `key` when the images were measured.
    pub fn kept(
        folder: &Path,
        key: &Key,
        print: &str,
        data: &DataFolder,
        ids: &[ImageId],
        grid: Grid,
        threads: usize,
    ) -> Result<Self, PipelineError> {
        let mut references = References {
            grid,
            images: BTreeMap::new(),
        };
        for of_set in ids.chunk_by(|a, b| a.set == b.set) {
            // Hidden, so that a results store does not take it for a run. Another version may measure other shapes.
            let (version, set) = (shearq_dataset::VERSION, of_set[0].set);
            let path = folder.join(format!(".reference-{version}-{print}-set{set:02}.parquet"));
            let images = match is_there(&path) {
                true => restored(&path, key, set, &grid)?,
                false => {
                    let measured = References::measure(data, of_set, grid, threads, &mut Quiet)?;
                    write_shapes(&path, key, &measured.images)?;
                    measured.images
                }
            };
            references.images.extend(images);
        }
        Ok(references)
    }

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
                let mut sum = references.read(path)?;
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

    fn read(&self, path: &Path) -> Result<FieldSum, FileError> {
        let rows = read_rows(path, most_rows(self.grid.cells()))?;
        let mut sum = FieldSum::new(&self.grid);
        sum.add_image(&self.grid, rows);
        Ok(sum)
    }

    /// Findings about the catalogues of an entry: one for each fault and set, with the numbers of its images.
    pub fn findings(&self, sent: &Sent) -> Result<Vec<Finding>, FileError> {
        let files = sent
            .files()
            .map_err(FileError::doing(sent.path(), "cannot list the folder"))?;
        let mut sets: BTreeMap<u32, BTreeMap<u32, PathBuf>> = BTreeMap::new();
        for file in files {
            if let Some(Kind::Catalogue { set, image, .. }) = Kind::of(&file) {
                sets.entry(set).or_default().insert(image, file);
            }
        }
        let mut found = Vec::new();
        for (set, files) in sets {
            let compared = files.iter().filter_map(|(image, file)| {
                let reference = self.images.get(&(set, *image))?;
                // An unreadable file is reported by the other checks.
                let (fault, slope) = compare(reference, &self.read(file).ok()?);
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

const KEPT_COLUMNS: [&str; 3] = ["image", "e1", "e2"];

// A team whose entry is judged by shapes that somebody edited gains or loses by it, so that their content is signed.
const SIGNATURE: &str = "signature";

// The signature of the name of the file, which has version, images and set, and of all rows.
fn signed(path: &Path, key: &Key, columns: [&[f64]; 3]) -> String {
    let mut sum = Fingerprint::default();
    for column in columns {
        let bytes = column
            .iter()
            .flat_map(|value| value.to_bits().to_le_bytes());
        sum.add(bytes.collect::<Vec<u8>>());
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    key.sign("reference", &[&name, &sum.finish()])
}

// One row per cell, image by image.
fn write_shapes(path: &Path, key: &Key, images: &ShapesOfImages) -> Result<(), FileError> {
    let mut columns: [Vec<f64>; 3] = Default::default();
    for ((_, image), shapes) in images {
        for [e1, e2] in shapes {
            let values = [f64::from(*image), f64::from(*e1), f64::from(*e2)];
            columns.iter_mut().zip(values).for_each(|(c, v)| c.push(v));
        }
    }
    let signature = signed(path, key, columns.each_ref().map(Vec::as_slice));
    let columns = KEPT_COLUMNS.into_iter().zip(columns);
    let columns = columns.map(|(name, values)| Column::new(name.into(), values));
    let table = frame(columns.collect()).map_err(|error| FileError::new(path, error))?;
    let metadata = Metadata::from([(SIGNATURE.to_owned(), signature)]);
    table::write(path, FileFormat::Parquet, &table, &metadata)
}

fn restored(path: &Path, key: &Key, set: u32, grid: &Grid) -> Result<ShapesOfImages, FileError> {
    let read = table::read(path, Some(&KEPT_COLUMNS), table::MAX_ROWS)?;
    let [numbers, e1, e2] = KEPT_COLUMNS.map(|name| table::numbers(&read, name, path));
    let (numbers, e1, e2) = (numbers?, e1?, e2?);
    let name = SIGNATURE.to_owned();
    let stated = table::read_metadata(path, FileFormat::Parquet, std::iter::once(&name))?;
    if stated.get(SIGNATURE) != Some(&signed(path, key, [&numbers, &e1, &e2])) {
        let message = "the shapes were changed, or measured for another challenge or by another build of this version (found another signature or none, expected that of the private folder). Try: remove the file, and the images are measured again";
        return Err(FileError::new(path, message));
    }
    let cells = grid.cells();
    let mut images = BTreeMap::new();
    for (number, (e1, e2)) in numbers
        .chunks(cells)
        .zip(e1.chunks(cells).zip(e2.chunks(cells)))
    {
        let shapes = e1.iter().zip(e2).map(|(e1, e2)| [*e1 as f32, *e2 as f32]);
        let shapes = Array2::from_shape_vec((grid.n, grid.n), shapes.collect());
        let message = "not the shapes of whole images. Try: remove the file";
        let shapes = shapes.map_err(|_| FileError::new(path, message))?;
        images.insert((set, number[0] as u32), shapes);
    }
    Ok(images)
}

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

    #[test]
    fn a_kept_measurement_is_read_back_bit_for_bit() {
        let grid = Grid::new(16, Pixels(48.0), Degrees(10.0)).unwrap();
        let mut shapes = shapes_of(&field(|a, b| (a, b)));
        shapes[(3, 4)] = [f32::NAN; 2];
        let images =
            ShapesOfImages::from([((7, 1), shapes.clone()), ((7, 3), shapes.t().to_owned())]);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("kept.parquet");
        let key = Key::new("pilot", 1, None);
        write_shapes(&path, &key, &images).unwrap();
        let bits = |images: ShapesOfImages| -> Vec<_> {
            let all = images.into_iter();
            all.map(|(id, shapes)| (id, shapes.mapv(|shape| shape.map(f32::to_bits))))
                .collect()
        };
        assert_eq!(bits(restored(&path, &key, 7, &grid).unwrap()), bits(images));
        let other = Grid::new(15, Pixels(48.0), Degrees(10.0)).unwrap();
        assert!(restored(&path, &key, 7, &other).is_err());
        // Neither an edited table with the old signature nor one of another challenge is used.
        let refused = |key: &Key| restored(&path, key, 7, &grid).unwrap_err().message;
        assert!(refused(&Key::new("pilot", 1, None)).contains("another signature"));
        let metadata =
            table::read_metadata(&path, FileFormat::Parquet, [SIGNATURE.to_owned()].iter());
        let mut edited = table::read(&path, None, table::MAX_ROWS).unwrap();
        let e1 = table::numbers(&edited, "e1", &path).unwrap();
        let e1: Vec<f64> = e1.iter().map(|e| -e).collect();
        edited.with_column(Column::new("e1".into(), e1)).unwrap();
        table::write(&path, FileFormat::Parquet, &edited, &metadata.unwrap()).unwrap();
        assert!(refused(&key).contains("another signature"));
    }
}
