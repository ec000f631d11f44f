//! Stamps that people have, gathered into the image of a data folder: cubes, files of one or several images each, and
//! cut-outs of an exposure.

mod positions;
mod source;

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::{ArrayView2, ArrayView3};
use serde::{Serialize, Serializer};
use shearq_measure::{Examination, Star, Warning, average_stars, examined_rows, star};
use shearq_submissions::PsfCut;

use self::positions::Positions;
pub use self::positions::Table;
pub use self::source::{Content, Files};
use self::source::{Exposure, Images, Origin, Planes, off_middle, shown};
use super::PipelineError;
use super::images::ImageId;
use super::measure::check_strip;
use crate::data::layout::{DataFolder, MAX_STAMP};
use crate::data::mosaic::Mosaic;
use crate::data::psf_table;
use shearq_files::FileError;
use shearq_files::atomic;
use shearq_files::fits::{ImageWriter, Value};
use shearq_files::open::is_there;
use shearq_files::table;
use shearq_files::text::formula_mark;

/// Most stamps of one image: one for each galaxy of the largest grid.
const MAX_STAMPS: usize = table::MAX_ROWS;
/// Pixels a side from which on a single stamp is taken for a mosaic or an exposure: four times the default stamp.
const LARGE: usize = 192;
/// How to read a mosaic or an exposure.
const MOSAIC: &str = "--exposure with --positions, which cuts stamps out of an exposure. A mosaic is read as DATA/set01/galaxies-001.fits, with `stamp = SIDE` in DATA/layout.toml";
/// Pixels a side of a PSF that are examined: as many as configurations use.
const EXAMINED_SIDE: usize = 48;
/// Most pixels of stars that are averaged, all of which are in memory.
const MOST_AVERAGED: usize = 1 << 24;
/// Pixels by which an offset may differ from a whole pixel.
const HALF: f64 = 0.5;

/// Where stamps come from.
#[derive(Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stamps<'a> {
    /// FITS files, each with one stamp, a cube of them, or several extensions with either.
    Files(Files<'a>),
    /// Squares of an exposure around positions.
    Cutouts {
        /// The exposure: the first image of one file.
        exposure: Files<'a>,
        /// Table with the positions, in FITS pixels: the centre of the first one is at 1.
        positions: Table<'a>,
        /// Number of the first pixel's centre in the table, 0 or 1.
        first_pixel: u8,
        /// Pixels a side of a stamp.
        side: usize,
    },
}

/// What was gathered.
#[derive(Debug)]
pub struct Gathered {
    /// How the stamps lie in the image.
    pub mosaic: Mosaic,
    /// Of the stamps, those with pixels that are not finite: beyond the exposure, masked, or missing in their file.
    pub incomplete: usize,
    /// What is worth a second look.
    pub doubts: Vec<String>,
}

/// A row of the table that says which stamp is which.
#[derive(Serialize)]
struct Place<'a> {
    x: f64,
    y: f64,
    #[serde(serialize_with = "cell")]
    file: &'a Path,
    image: usize,
    plane: usize,
    position_x: Option<f64>,
    position_y: Option<f64>,
}

/// Writes a path as a cell of CSV, without formulas.
fn cell<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    let path = path.display().to_string();
    serializer.collect_str(&format_args!("{}{path}", formula_mark(&path)))
}

/// What an image is made of.
#[derive(Serialize)]
pub struct Gathering<'a> {
    /// Its stamps.
    pub stamps: Stamps<'a>,
    /// Images like those of the stamps or the exposure: pixels are missing where these are not zero.
    pub masks: Option<Files<'a>>,
    /// One PSF, or one a stamp.
    pub psfs: Files<'a>,
    /// The image's NOISESIG.
    pub noise: Option<f64>,
}

/// What made an image, kept beside it.
#[derive(Serialize)]
struct Record<'a> {
    version: &'a str,
    #[serde(flatten)]
    gathering: &'a Gathering<'a>,
}

/// Gathers stamps and their PSFs into image `id` of `data`: the table of which stamp is which and the record of what
/// made it, PSFs, and last the image. What a stopped process left of the image is
/// replaced; others that gather into the same folder are waited for.
///
/// # Errors
/// Where a file cannot be read, stamps are not square or of different sizes, masks are of others, there are neither one
/// PSF nor as many as stamps, or the image is there already.
pub fn gather(
    data: &DataFolder,
    id: ImageId,
    gathering: &Gathering<'_>,
) -> Result<Gathered, PipelineError> {
    let which = data.stamps(id.set, id.image);
    let folder = which.parent().unwrap_or(Path::new("."));
    let (made, cannot) = (!folder.exists(), "cannot make the folder");
    fs::create_dir_all(folder).map_err(FileError::doing(folder, cannot))?;
    let alone = fs::File::open(folder).map_err(FileError::doing(folder, cannot))?;
    // File systems without locks have none that could be waited for.
    let _ = alone.lock();
    let gathered = gather_alone(data, id, gathering);
    if made && gathered.is_err() {
        // Unless there is something in it.
        let _ = fs::remove_dir(folder);
    }
    gathered
}

fn gather_alone(
    data: &DataFolder,
    id: ImageId,
    gathering: &Gathering<'_>,
) -> Result<Gathered, PipelineError> {
    let &Gathering {
        ref stamps,
        masks,
        psfs,
        noise,
    } = gathering;
    let target = data.galaxies(id.set, id.image);
    let which = data.stamps(id.set, id.image);
    if is_there(&target) {
        return Err(already(target).into());
    }
    let psfs_there = [
        data.psf_star(id.set, id.image),
        data.psf_functional(id.set, id.image),
    ]
    .into_iter()
    .filter(|path| is_there(path));
    // Nothing but this makes the table, and the image comes last: where there is one without the other, this was
    // stopped, and the PSF is its own.
    let stopped = is_there(&which);
    for path in psfs_there {
        if !stopped {
            return Err(already(path).into());
        }
        fs::remove_file(&path).map_err(FileError::doing(&path, "cannot remove the leftover"))?;
    }
    let record = Record {
        version: crate::VERSION,
        gathering,
    };
    let record = serde_json::to_string_pretty(&record).map_err(FileError::doing(
        &which,
        "cannot write the record of the settings",
    ))?;
    let mut doubts = Vec::new();
    let positions = match stamps {
        Stamps::Files(_) => Vec::new(),
        Stamps::Cutouts {
            positions,
            exposure,
            first_pixel,
            ..
        } => {
            // From here on the first pixel is 1.
            let shift = 1.0 - f64::from(*first_pixel);
            let mut positions = Positions::read(*positions)?;
            for (x, y) in &mut positions.all {
                (*x, *y) = (*x + shift, *y + shift);
            }
            let sides = Exposure::open(*exposure)?.sides()?;
            doubts.extend(positions.note.clone());
            doubts.extend(positions.examine(&exposure.paths[0], sides)?);
            positions.all
        }
    };
    let (count, side) = match stamps {
        Stamps::Files(files) => {
            let (count, side) = survey(*files)?;
            if count == 1 && side >= LARGE {
                doubts.push(format!(
                    "warning: {}: the only stamp is {side} × {side} px, which looks like a mosaic of stamps or an exposure. Try: {MOSAIC}",
                    files.paths[0].display()
                ));
            }
            (count, side)
        }
        Stamps::Cutouts { side, .. } => (positions.len(), *side),
    };
    let mosaic = Mosaic::of(count, side);
    check_strip(&target, mosaic.columns, side)?;
    let psf = gather_psfs(data, id, psfs, &mosaic, &mut doubts)?;
    let mut keys = Vec::new();
    keys.extend(noise.map(|sigma| ("NOISESIG", Value::Real(sigma))));
    let mut image = Rows::create(&target, mosaic, &keys)?;
    let examined = examined_rows(mosaic.columns, mosaic.rows());
    let mut examination = Examination::new(side, examined.len() * mosaic.columns);
    let mut incomplete = 0;
    let mut places = csv::Writer::from_writer(Vec::new());
    let mut take = |origin: &Origin<'_>, pixels: &[f32]| -> Result<(), FileError> {
        incomplete += usize::from(pixels.iter().any(|value| !value.is_finite()));
        if examined.contains(&(image.next / mosaic.columns)) {
            let stamp = ArrayView2::from_shape((side, side), pixels)
                .map_err(|error| FileError::new(&target, error))?;
            let place = origin.position.map_or([0.0; 2], |at| off_middle(at, side));
            examination
                .add_at(stamp, place)
                .map_err(|error| FileError::new(&target, error))?;
        }
        let (x, y) = mosaic.position(image.next);
        let place = Place {
            x,
            y,
            file: origin.file,
            image: origin.image,
            plane: origin.plane,
            position_x: origin.position.map(|(x, _)| x),
            position_y: origin.position.map(|(_, y)| y),
        };
        places
            .serialize(place)
            .map_err(FileError::doing(&target, "cannot write the list of stamps"))?;
        image.add(pixels)
    };
    match stamps {
        Stamps::Files(files) => {
            let (mut planes, mut masks) = (Planes::of(*files), masks.map(Planes::of));
            while let Some((origin, mut pixels)) = planes.next()? {
                if let Some(masks) = &mut masks {
                    let Some((place, mask)) = masks.next()? else {
                        return Err(origin.fault("there is no mask for this stamp").into());
                    };
                    let sides = masks.sides();
                    if sides != [side; 2] {
                        let message = format!(
                            "the mask is {} × {} pixels; its stamp has {side} × {side}",
                            sides[0], sides[1]
                        );
                        return Err(place.fault(&message).into());
                    }
                    another(&place, &origin)?;
                    lose(&mut pixels, &mask);
                }
                take(&origin, &pixels)?;
            }
            if let Some((place, _)) = masks.as_mut().map_or(Ok(None), Planes::next)? {
                return Err(place.fault("there is no stamp for this mask").into());
            }
        }
        Stamps::Cutouts { exposure, .. } => {
            let mut exposure = Exposure::open(*exposure)?;
            let mut masks = masks.map(Exposure::open).transpose()?;
            if let Some(mask) = &mut masks {
                mask.like(&mut exposure)?;
                another(&mask.origin, &exposure.origin)?;
            }
            for &(x, y) in &positions {
                let mut pixels = exposure.square((x, y), side)?;
                if let Some(mask) = &mut masks {
                    lose(&mut pixels, &mask.square((x, y), side)?);
                }
                let origin = Origin {
                    position: Some((x, y)),
                    ..exposure.origin
                };
                take(&origin, &pixels)?;
            }
        }
    }
    let warnings = examination.warnings();
    doubts.extend(warnings.iter().map(|warning| {
        let ImageId { set, image } = id;
        let hint = one_pixel_off(stamps, warning).unwrap_or_default();
        format!("warning: set {set:02} image {image:03}: {warning}{hint}")
    }));
    let text = places
        .into_inner()
        .map_err(|error| FileError::new(&which, error.to_string()))?;
    atomic::write(
        which.with_extension("json"),
        format!("{record}\n").as_bytes(),
    )?;
    atomic::write(&which, &text)?;
    psf.finish()?;
    image.finish()?;
    Ok(Gathered {
        mosaic,
        incomplete,
        doubts,
    })
}

fn already(path: PathBuf) -> FileError {
    let message =
        "this is there already; expected an image with a number of its own (--set and --image)";
    FileError::new(path, message)
}

/// Whether a file was `named`, as none had the name of `path`.
fn first(named: bool, path: PathBuf) -> Result<(), FileError> {
    match named {
        true => Ok(()),
        false => Err(already(path)),
    }
}

/// Advice if positions are counted from another first pixel than specified.
fn one_pixel_off(stamps: &Stamps<'_>, warning: &Warning) -> Option<String> {
    let (Stamps::Cutouts { first_pixel, .. }, Warning::OffCentre { offset, .. }) =
        (stamps, warning)
    else {
        return None;
    };
    let other = 1 - first_pixel.min(&1);
    let expected = f64::from(*first_pixel) - f64::from(other);
    let off = offset.iter().all(|found| (found - expected).abs() < HALF);
    off.then(|| format!(". Are the positions counted from {other}? Try: --first-pixel {other}"))
}

/// Refuses an image that is its own mask.
fn another(mask: &Origin<'_>, image: &Origin<'_>) -> Result<(), FileError> {
    if (mask.file, mask.image) == (image.file, image.image) {
        let message = "the mask is the image itself; expected another (--mask-extension)";
        return Err(mask.fault(message));
    }
    Ok(())
}

/// Makes those pixels of a stamp missing whose `mask` is not zero.
fn lose(pixels: &mut [f32], mask: &[f32]) {
    for (pixel, mask) in pixels.iter_mut().zip(mask) {
        if *mask != 0.0 {
            *pixel = f32::NAN;
        }
    }
}

/// Number of stamps in files, and the pixels a side that all of them have.
fn survey(files: Files<'_>) -> Result<(usize, usize), FileError> {
    let (mut count, mut first) = (0usize, None);
    let mut images = Images::of(files);
    while let Some((origin, image)) = images.next()? {
        let (width, height) = (image.width(), image.height());
        if width != height || width > MAX_STAMP {
            let advice = match files.content {
                Content::Sky => format!(". Try: {MOSAIC}"),
                Content::Psf | Content::Mask => String::new(),
            };
            let message = format!(
                "the stamp is {width} × {height} pixels; expected a square of at most {MAX_STAMP}{advice}"
            );
            return Err(origin.fault(&message));
        }
        let side = *first.get_or_insert(width);
        if width != side {
            let message =
                format!("the stamp is {width} × {height} pixels; the first has {side} × {side}");
            return Err(origin.fault(&message));
        }
        count += image.planes();
        if count > MAX_STAMPS {
            return Err(origin.fault(&format!("there are more than {MAX_STAMPS} stamps")));
        }
    }
    // No list of files is empty.
    Ok((count, first.unwrap_or(1)))
}

/// Writes the PSFs of an image: functional ones of a table, or stars.
fn gather_psfs(
    data: &DataFolder,
    id: ImageId,
    files: Files<'_>,
    mosaic: &Mosaic,
    doubts: &mut Vec<String>,
) -> Result<PsfFile, FileError> {
    let check = |path: &Path, found: usize| {
        if found == 1 || found == mosaic.galaxies {
            return Ok(());
        }
        let message = format!(
            "there are {found} PSFs; expected one, or one for each of the {} stamps",
            mosaic.galaxies
        );
        Err(FileError::new(path, message))
    };
    if let [table] = files.paths
        && table
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
    {
        let mut rows = psf_table::read_all(table)?;
        check(table, rows.len())?;
        for (place, (position, _)) in rows.iter_mut().enumerate() {
            *position = mosaic.position(place);
        }
        let path = data.psf_functional(id.set, id.image);
        return Ok(PsfFile::Table(path, psf_table::text(&rows)));
    }
    let (count, side) = survey(files)?;
    // Stars of a field, not one that is missing of as many as there are galaxies.
    let average = count > 1 && 2 * count <= mosaic.galaxies;
    if !average {
        // No list of files is empty.
        check(&files.paths[0], count)?;
    }
    // One, or as many as galaxies, which lie as these do.
    let stars = Mosaic::of(count, side);
    let size = side - side.saturating_sub(EXAMINED_SIDE).next_multiple_of(2);
    let cut = PsfCut {
        size,
        // So that a star off the centre can be cut around itself.
        least: size - (size / 3).next_multiple_of(2),
    };
    let path = data.psf_star(id.set, id.image);
    if average {
        return averaged(&path, files, (count, side), cut, doubts);
    }
    let mut image = Rows::create(&path, stars, &[])?;
    let mut planes = Planes::of(files);
    let mut examination = Examination::new(side, 0);
    let mut dark = 0;
    while let Some((origin, pixels)) = planes.next()? {
        let light: f64 = pixels.iter().map(|&value| f64::from(value)).sum();
        if !(light > 0.0 && light.is_finite()) {
            if count == 1 {
                let message =
                    format!("the pixels of the PSF add up to {light}; expected a positive sum");
                return Err(origin.fault(&message));
            }
            dark += 1;
        }
        if let Ok(stamp) = ArrayView2::from_shape((side, side), &pixels)
            && let Ok(Star { psf, moved }) = star(stamp, cut)
        {
            examination.add_psf(psf.view(), moved);
        }
        image.add(&pixels)?;
    }
    doubts.extend(named(&examination, &files.paths[0]));
    if dark > 0 {
        doubts.push(format!(
            "warning: the pixels of {dark} of {count} PSFs add up to nothing, less or no number: galaxies with them will be flagged"
        ));
    }
    Ok(PsfFile::Stars(Box::new(image)))
}

/// The average of `count` stars of `side` pixels a side, as the PSF of all galaxies.
fn averaged(
    path: &Path,
    files: Files<'_>,
    (count, side): (usize, usize),
    cut: PsfCut,
    doubts: &mut Vec<String>,
) -> Result<PsfFile, FileError> {
    let first = &files.paths[0];
    let pixels = count * side * side;
    if pixels > MOST_AVERAGED {
        let message = format!(
            "there are {count} stars of {side} × {side} pixels to average ({pixels} pixels, expected at most {MOST_AVERAGED}). Try: fewer stars"
        );
        return Err(FileError::new(first, message));
    }
    let mut all = Vec::with_capacity(pixels);
    let mut planes = Planes::of(files);
    while let Some((_, pixels)) = planes.next()? {
        all.extend(pixels.iter().map(|&value| f64::from(value)));
    }
    let stars = ArrayView3::from_shape((count, side, side), &all)
        .map_err(|error| FileError::new(first, error))?;
    let psf = average_stars(stars, cut)
        .map_err(|(k, error)| FileError::new(first, format!("star {k}: {error}")))?;
    let shown = first.display();
    doubts.push(format!(
        "note: {shown}: {count} stars were averaged to one PSF for all galaxies"
    ));
    let mut examination = Examination::new(side, 0);
    examination.add_psf(psf.view(), None);
    doubts.extend(named(&examination, first));
    let mut image = Rows::create(path, Mosaic::of(1, psf.nrows()), &[])?;
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    image.add(&pixels)?;
    Ok(PsfFile::Stars(Box::new(image)))
}

/// The warnings of an examination, with the file that they are about.
fn named(examination: &Examination, path: &Path) -> Vec<String> {
    let found = examination.warnings();
    let line = |warning: &Warning| format!("warning: {}: {warning}", path.display());
    found.iter().map(line).collect()
}

/// PSFs that are about to be written.
enum PsfFile {
    Stars(Box<Rows>),
    Table(PathBuf, String),
}

impl PsfFile {
    fn finish(self) -> Result<(), FileError> {
        match self {
            PsfFile::Stars(image) => image.finish(),
            PsfFile::Table(path, text) => {
                first(atomic::write_if_absent(&path, text.as_bytes())?, path)
            }
        }
    }
}

/// A mosaic that is written a row of stamps at a time.
struct Rows {
    path: PathBuf,
    writer: ImageWriter,
    mosaic: Mosaic,
    /// Number of stamps that are there.
    next: usize,
    /// The row at hand.
    pixels: Vec<f32>,
}

impl Rows {
    fn create(path: &Path, mosaic: Mosaic, more: &[(&str, Value)]) -> Result<Self, FileError> {
        let Mosaic {
            columns,
            galaxies,
            stamp,
        } = mosaic;
        let mut keys = vec![
            ("STAMP", Value::Int(stamp as i64)),
            ("NSTAMPS", Value::Int(galaxies as i64)),
        ];
        keys.extend_from_slice(more);
        atomic::sweep_beside(path);
        Ok(Rows {
            path: path.to_owned(),
            writer: ImageWriter::create(path, columns * stamp, mosaic.rows() * stamp, &keys)?,
            pixels: vec![0.0; columns * stamp * stamp],
            mosaic,
            next: 0,
        })
    }

    fn add(&mut self, stamp: &[f32]) -> Result<(), FileError> {
        let Mosaic {
            columns,
            stamp: side,
            galaxies,
        } = self.mosaic;
        let start = self.next % columns * side;
        let lines = self.pixels.chunks_exact_mut(columns * side);
        for (line, from) in lines.zip(stamp.chunks_exact(side)) {
            line[start..start + side].copy_from_slice(from);
        }
        self.next += 1;
        if self.next.is_multiple_of(columns) || self.next == galaxies {
            self.writer.write_rows(&self.pixels)?;
            self.pixels.fill(0.0);
        }
        Ok(())
    }

    fn finish(self) -> Result<(), FileError> {
        first(self.writer.finish_if_absent()?, self.path)
    }
}
