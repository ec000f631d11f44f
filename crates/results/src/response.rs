//! The response to shear that ellipticities of many catalogues are divided by.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use shearq_dataset::fingerprint::{GALAXIES, verify_source};
use shearq_dataset::metadata::{
    Axes, CATALOGUE_FIRST_PIXEL, CATALOGUE_FRAME, CommonAxes, NOT_APPLIED, RESPONSE, axes_of,
};
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::ALL_CORES;
use shearq_files::FileError;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::{Metadata, frame};
use shearq_files::table::{self, FileFormat};
use shearq_measure::is_significant;
use shearq_quantities::Frame;
use shearq_quantities::linear::solve;
use shearq_quantities::statistics::RunningMean;
use shearq_submissions::Calibration;

use shearq_catalogue::own_columns::{WEIGHT, is_measured};
use shearq_catalogue::shapes::{MeasuredShapes, applied_weights, undivided_columns};

/// The mean responses R11 and R22 of the good galaxies of all `catalogues` of a set; 1 of catalogues whose ellipticities are
/// not to be divided: of networks, of other programs, and of earlier versions, which divided each image by its own response.
///
/// # Errors
/// If a catalogue cannot be read, only some are to be divided, or a mean is not positive by three standard errors.
pub fn response_of<'a>(catalogues: impl Iterator<Item = &'a Path>) -> Result<[f64; 2], FileError> {
    let mut sum = Sum::default();
    let mut first: Option<(&Path, bool)> = None;
    for path in catalogues {
        let divide = is_to_divide(path)?;
        let (before, expected) = *first.get_or_insert((path, divide));
        if divide != expected {
            let message = format!(
                "these ellipticities are {}, and those of {} are not, so that they have no common response",
                if divide {
                    "not divided by the response"
                } else {
                    "shears"
                },
                before.display()
            );
            return Err(FileError::new(path, message).hint("measure both with one version"));
        }
        if divide {
            sum.add_catalogue(path, &RESPONSES[..2])?;
        }
    }
    let [r11, r22, ..] = sum.responses;
    match first {
        Some((path, true)) if r11.count() > 0 => {
            check_significance(path, &[r11, r22])?;
            Ok([r11.mean(), r22.mean()])
        }
        _ => Ok([1.0; 2]),
    }
}

// Text has no metadata, so that a catalogue in text is taken as it is.
fn is_to_divide(path: &Path) -> Result<bool, FileError> {
    let Some(format) = FileFormat::of(path) else {
        return Ok(false);
    };
    let mut metadata = table::read_metadata(path, format, [RESPONSE])?;
    Ok(metadata.remove(RESPONSE).as_deref() == Some(NOT_APPLIED))
}

fn check_significance(path: &Path, means: &[RunningMean; 2]) -> Result<(), FileError> {
    let mut numbered = (1..).zip(means);
    let Some((k, mean)) = numbered.find(|(_, mean)| !is_significant(mean)) else {
        return Ok(());
    };
    let message = format!(
        "the mean response R{k}{k} of the {} galaxies of this and further catalogues is {:.4} ± {:.4} (expected a positive number of three standard errors), so that their ellipticities give no shear",
        mean.count(),
        mean.mean(),
        mean.deviation() / (mean.count() as f64).sqrt()
    );
    Err(FileError::new(path, message)
        .hint("more galaxies, and check that the PSF has the pixel scale of the galaxies"))
}

/// Which galaxies share a mean response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shared {
    Survey,
    Set,
    /// Galaxies of an image, whose response is noisy: with 40 galaxies at S/N 10 it biases the shears by
    /// (7 ± 2)·10⁻³.
    Image,
}

/// The response of galaxies that share one.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedResponse {
    /// `survey`, `set 02` or `set 02 image 001`.
    pub of: String,
    pub galaxies: usize,
    /// Mean R11, R22, R12 and R21.
    pub mean: [f64; 4],
    /// Their standard errors, of independent galaxies.
    pub error: [f64; 4],
}

/// The columns of a galaxy's position that TreeCorr shall read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Position {
    Sky,
    Pixel,
}

/// A shear for each galaxy of a survey.
#[derive(Debug)]
pub struct Shears {
    pub table: DataFrame,
    pub metadata: Metadata,
    pub responses: Vec<SharedResponse>,
    pub good: usize,
}

struct Image {
    path: PathBuf,
    place: (u32, u32),
    group: Group,
}

// The galaxies that share a response: all (without a set), or the galaxies of a set or of an image of a folder.
type Group = (usize, Option<u32>, Option<u32>);

// Metadata of catalogues that shears keep.
const KEPT: [&str; 5] = [
    CATALOGUE_FRAME,
    CATALOGUE_FIRST_PIXEL,
    "creator",
    "submiss",
    "elltype",
];
const RESPONSES: [&str; 4] = ["R11", "R22", "R12", "R21"];

// Responses and weights of the galaxies without a flag.
#[derive(Default)]
struct Sum {
    responses: [RunningMean; 4],
    weight: RunningMean,
}

/// The shears of the catalogues of `sets` (of all if empty) in the folders `measured`: g = ⟨R⟩⁻¹ e, with the mean response of the galaxies that share one.
/// Ellipticities of a selection are divided by their weights, so that the weighted mean of g is the mean shear.
///
/// The table has the columns of the catalogues that were not measured on the stamps (identifiers, positions, carried ones), the
/// numbers of set and image, `g1`, `g2`, `w` (the weight of the selection, or 1; 0 of galaxies without a shear) and `flags`.
/// For `treecorr` it has two columns of positions, g1, g2 and w of the galaxies with a shear.
///
/// # Errors
/// If a catalogue cannot be read, its ellipticities were not measured with a response, catalogues have several frames or
/// columns, or a mean response is not positive by three standard errors.
pub fn shears(
    measured: &[PathBuf],
    sets: &[u32],
    shared: Shared,
    treecorr: Option<Position>,
) -> Result<Shears, FileError> {
    let (mut images, mut sums) = (Vec::new(), BTreeMap::<_, Sum>::new());
    let mut metadata = Metadata::new();
    let mut axes = CommonAxes::default();
    let mut seen = BTreeMap::new();
    for (folder, out) in measured.iter().enumerate() {
        let run = Run::require(out)?;
        verify_source(out, &run, sets, ALL_CORES)?;
        if run.configuration.calibration() == Calibration::None {
            let message = format!(
                "the configuration {} does not measure a response, so that its ellipticities are no shears (found no response; expected a linear configuration such as 48/linear/star)",
                run.configuration.name
            );
            return Err(FileError::new(out, message));
        }
        let files = run.catalogues(out, sets)?;
        for set in files.wanted(sets) {
            for (image, path) in files.of_set(set) {
                refuse_seen(&mut seen, &run, &path, (set, image))?;
                let stated = table::read_metadata(&path, run.format, KEPT)?;
                let own = axes_of(&path, &stated)?;
                axes.add(&path, own, false)?;
                check_positions(&path, treecorr, own)?;
                if metadata.is_empty() {
                    metadata = stated;
                }
                let group = match shared {
                    Shared::Survey => (0, None, None),
                    Shared::Set => (folder, Some(set), None),
                    Shared::Image => (folder, Some(set), Some(image)),
                };
                let sum = sums.entry(group).or_default();
                sum.add_catalogue(&path, &RESPONSES)?;
                let place = (set, image);
                images.push(Image { path, place, group });
            }
        }
    }
    let Some(Image { path, .. }) = images.first() else {
        let none = measured.first().cloned().unwrap_or_default();
        return Err(FileError::new(
            none,
            "there is no catalogue; expected folders that `measure` wrote",
        ));
    };
    let mut responses = BTreeMap::new();
    for (group, sum) in &sums {
        let [r11, r22, ..] = sum.responses;
        check_significance(path, &[r11, r22])?;
        responses.insert(*group, sum.response(*group));
    }
    let (table, good) = joined(images, &responses, treecorr)?;
    let responses: Vec<SharedResponse> = responses.into_values().collect();
    let lines = responses.iter().map(|own| {
        let numbers = own.mean.iter().chain(&own.error);
        let numbers: Vec<String> = numbers.map(|value| format!("{value:.6e}")).collect();
        format!("{}: {}", own.of, numbers.join(" "))
    });
    let heading = "R11 R22 R12 R21 and their errors".to_owned();
    let lines: Vec<String> = [heading].into_iter().chain(lines).collect();
    metadata.insert(RESPONSE.into(), lines.join("\n"));
    Ok(Shears {
        table,
        metadata,
        responses,
        good,
    })
}

// The tables of all images with shears, and the number of galaxies that have one. Catalogues are read a second time, so that only
// the columns that are written stay in memory.
fn joined(
    images: Vec<Image>,
    responses: &BTreeMap<Group, SharedResponse>,
    treecorr: Option<Position>,
) -> Result<(DataFrame, usize), FileError> {
    let (mut whole, mut good) = (None::<DataFrame>, 0);
    for image in images {
        let (table, with_shear) = image.sheared(&responses[&image.group], treecorr)?;
        good += with_shear;
        match &mut whole {
            None => whole = Some(table),
            Some(whole) => {
                whole.vstack_mut_owned(table).map_err(|error| {
                    let message =
                        format!("the columns are not those of the first catalogue: {error}");
                    FileError::new(&image.path, message)
                })?;
            }
        }
    }
    let mut table = whole.unwrap_or_default();
    table.align_chunks_par();
    Ok((table, good))
}

// Refuses a second catalogue of an image: its galaxies would count twice, and errors would be too small by √2. An image is known by its
// fingerprint, which survives a copy of the folder and is the same for another configuration, or by the settings of its simulation.
fn refuse_seen(
    seen: &mut BTreeMap<String, PathBuf>,
    run: &Run,
    path: &Path,
    (set, image): (u32, u32),
) -> Result<(), FileError> {
    let print = table::read_metadata(path, run.format, [GALAXIES])?.remove(GALAXIES);
    let identity = match (print, &run.source) {
        (Some(print), _) => print,
        (None, Source::Simulated(settings)) => format!("{settings:?} {set} {image}"),
        (None, Source::Folder { .. }) => path
            .canonicalize()
            .as_deref()
            .unwrap_or(path)
            .display()
            .to_string(),
    };
    match seen.insert(identity, path.to_owned()) {
        None => Ok(()),
        Some(first) => {
            let message = format!(
                "its image was measured for {}, too, so that its galaxies would count twice (expected each image once)",
                first.display()
            );
            Err(FileError::new(path, message).hint("--measured with one of the folders"))
        }
    }
}

// TreeCorr takes right ascension and declination on the sky, where our signs are its own, or x and y of the pixels' axes.
fn check_positions(path: &Path, treecorr: Option<Position>, axes: Axes) -> Result<(), FileError> {
    let (message, hint) = match treecorr {
        Some(Position::Sky) if axes == Axes::Pixel => (
            "the ellipticities are along pixel axes whose orientation on the sky no WCS states (found no WCS; expected `sky`)",
            "--treecorr x,y",
        ),
        // Pixel axes that a WCS states to be the sky's are as good as `mean` takes them.
        Some(Position::Sky) if !axes.agree(Axes::Sky) => (
            "the ellipticities are in the frame of the pixels, so that they have no direction on the sky (found `pixel`; expected `sky`)",
            "gather --frame sky, or --treecorr x,y",
        ),
        Some(Position::Pixel) if axes.frame() == Frame::Sky => (
            "the ellipticities are in the frame of the sky, so that they have no direction along x and y (found `sky`; expected `pixel`)",
            "--treecorr ra,dec",
        ),
        _ => return Ok(()),
    };
    Err(FileError::new(path, message).hint(hint))
}

impl Image {
    // The table with shears, and the number of galaxies that have one.
    fn sheared(
        &self,
        response: &SharedResponse,
        treecorr: Option<Position>,
    ) -> Result<(DataFrame, usize), FileError> {
        let path = &self.path;
        let names = undivided_columns(path)?;
        let positions: &[&str] = match treecorr {
            None => &[],
            Some(Position::Sky) => &["ra", "dec"],
            Some(Position::Pixel) => &["x", "y"],
        };
        let absent = |name: &&&str| !names.iter().any(|own| own == **name);
        if let Some(name) = positions.iter().find(absent) {
            return Err(FileError::no_column(path, name, &names));
        }
        // Columns that were not measured on the stamps are copied.
        let copied = |name: &str| match treecorr {
            None => name == "flags" || !is_measured(name),
            Some(_) => positions.contains(&name),
        };
        let wanted = names.iter().map(String::as_str);
        let wanted =
            wanted.filter(|name| ["e1", "e2", "flags", WEIGHT].contains(name) || copied(name));
        let table = table::read(path, Some(&wanted.collect::<Vec<_>>()), table::MAX_ROWS)?;
        let MeasuredShapes { e, weight, .. } = MeasuredShapes::of_table(path, &table, false)?;
        let [r11, r22, r12, r21] = response.mean;
        let counts: Vec<bool> = weight.iter().map(|weight| *weight > 0.0).collect();
        let g = e
            .iter()
            .zip(&weight)
            .map(|(e, weight)| match *weight > 0.0 {
                true => solve([[r11, r12], [r21, r22]], e.map(|e| e / weight)),
                false => [f64::NAN; 2],
            });
        let g: Vec<[f64; 2]> = g.collect();
        let number =
            |name: &str, value: u32| Column::new(name.into(), vec![i64::from(value); counts.len()]);
        let measured = [
            Column::new("g1".into(), g.iter().map(|g| g[0]).collect::<Vec<_>>()),
            Column::new("g2".into(), g.iter().map(|g| g[1]).collect::<Vec<_>>()),
            Column::new("w".into(), weight),
        ];
        let wrong = |error: &dyn std::fmt::Display| FileError::new(&self.path, error.to_string());
        let all = table.columns().iter();
        let mut columns: Vec<Column> = all.filter(|own| copied(own.name())).cloned().collect();
        match treecorr {
            None => {
                // After the position, as in catalogues.
                let after = columns
                    .iter()
                    .take_while(|own| own.name() != "flags")
                    .count();
                let (set, image) = self.place;
                let new = [number("set", set), number("image", image)];
                columns.splice(after..after, new.into_iter().chain(measured));
            }
            Some(_) => {
                columns.sort_by_key(|own| positions.iter().position(|name| own.name() == name));
                columns.extend(measured);
            }
        }
        let mut table = frame(columns).map_err(|error| wrong(&error))?;
        if treecorr.is_some() {
            let mask = counts.iter().copied().collect();
            table = table.filter(&mask).map_err(|error| wrong(&error))?;
        }
        Ok((table, counts.iter().filter(|counts| **counts).count()))
    }
}

impl Sum {
    // Adds columns of `RESPONSES`; scores, which divide by the diagonal only, read nothing else.
    fn add_catalogue(&mut self, path: &Path, responses: &[&'static str]) -> Result<(), FileError> {
        let names = undivided_columns(path)?;
        let mut wanted = [responses, &["flags"][..]].concat();
        wanted.extend(names.iter().any(|name| name == WEIGHT).then_some(WEIGHT));
        let table = table::read(path, Some(&wanted), table::MAX_ROWS)?;
        let flags = table::numbers(&table, "flags", path)?;
        let weights = applied_weights(path, &table)?;
        let add = |mean: &mut RunningMean, values: &[f64]| {
            let good = values.iter().zip(&*flags).filter(|(_, flag)| **flag == 0.0);
            good.for_each(|(value, _)| mean.add(*value));
        };
        for (mean, name) in self.responses.iter_mut().zip(responses) {
            add(mean, &table::numbers(&table, name, path)?);
        }
        add(&mut self.weight, &weights);
        Ok(())
    }

    fn response(&self, (folder, set, image): Group) -> SharedResponse {
        // Responses of a selection contain its weights.
        let (weight, count) = (self.weight.mean(), self.weight.count());
        let folder = match folder {
            0 => String::new(),
            more => format!("folder {} ", more + 1),
        };
        SharedResponse {
            of: match (set, image) {
                (None, _) => "survey".into(),
                (Some(set), None) => format!("{folder}set {set:02}"),
                (Some(set), Some(image)) => format!("{folder}set {set:02} image {image:03}"),
            },
            galaxies: count,
            mean: self.responses.map(|own| own.mean() / weight),
            error: self
                .responses
                .map(|own| own.deviation() / (count as f64).sqrt() / weight),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn catalogue(path: &Path, responses: &[f64], metadata: &[(&str, &str)]) {
        let column = |name: &str, of: fn(&f64) -> f64| {
            let values: Vec<f64> = responses.iter().map(of).collect();
            Column::new(name.into(), values)
        };
        let table = frame(vec![
            column("R11", |r| *r),
            column("R22", |r| 2.0 * r),
            column("flags", |r| f64::from(r.is_nan())),
        ]);
        let metadata = metadata.iter();
        let metadata = metadata.map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
        let (table, metadata) = (table.unwrap(), metadata.collect());
        table::write(path, FileFormat::Parquet, &table, &metadata).unwrap();
    }

    #[test]
    fn a_set_has_one_response_of_all_good_galaxies() {
        let folder = tempfile::tempdir().unwrap();
        let paths = ["1", "2", "3"].map(|name| folder.path().join(format!("{name}.parquet")));
        let to_divide = [(RESPONSE, NOT_APPLIED)];
        let of = |paths: &[PathBuf]| response_of(paths.iter().map(PathBuf::as_path));
        catalogue(&paths[0], &[0.3, 0.5, f64::NAN], &to_divide);
        catalogue(&paths[1], &[0.4], &to_divide);
        let [r1, r2] = of(&paths[..2]).unwrap();
        assert!((r1 - 0.4).abs() < 1e-15 && (r2 - 0.8).abs() < 1e-15);
        // One that was divided already.
        catalogue(&paths[2], &[0.1], &[]);
        assert_eq!(of(&paths[2..]).unwrap(), [1.0; 2]);
        let error = of(&paths).unwrap_err().to_string();
        assert!(error.contains("have no common response"), "{error}");
        catalogue(&paths[2], &[-0.5, -0.4, -0.6], &to_divide);
        let error = of(&paths[1..]).unwrap_err().to_string();
        assert!(
            error.contains("the mean response R11 of the 4 galaxies"),
            "{error}"
        );
        catalogue(&paths[2], &[f64::NAN], &to_divide);
        assert_eq!(of(&paths[2..]).unwrap(), [1.0; 2]);
    }
}
