//! Stamps and PSFs in FITS files and on exposures, and the mosaics of them that are written.

use std::path::{Path, PathBuf};

use ndarray::{ArrayView2, ArrayView3};
use serde::{Serialize, Serializer};
use shearq_dataset::grid::{Mosaic, psfs_text, read_psfs};
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_files::fits::{ImageReader, ImageWriter, Pixel, Value};
use shearq_files::{FileError, atomic};
use shearq_measure::{
    EXAMINED_PSFS, Examination, Psfs, Star, Warning, average_stars, examined_rows,
};
use shearq_quantities::statistics::upper_median;
use shearq_submissions::PsfCut;
use shearq_submissions::limits::MIN_PSF;

use super::{Gathering, Square, Stack, Stamps};
use crate::wcs::Wcs;

// Names of images that accompany an image of the sky in one file. They are refused unless the user chooses them: a weight map
// would be measured like a galaxy.
const COMPANIONS: [&str; 15] = [
    "PSF",
    "ERR",
    "ERROR",
    "DQ",
    "MASK",
    "FLAGS",
    "SEG",
    "VAR",
    "VARIANCE",
    "IVAR",
    "WHT",
    "WEIGHT",
    "RMS",
    "BKG",
    "BACKGROUND",
];

// serde refuses paths that are not Unicode; a record may show them lossily.
pub(super) fn shown<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&path.display())
}

fn all_shown<S: Serializer>(paths: &[PathBuf], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(paths.iter().map(|path| path.display().to_string()))
}

/// FITS files and the name of the images in them.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Files<'a> {
    /// At least one.
    #[serde(serialize_with = "all_shown")]
    pub paths: &'a [PathBuf],
    /// Name of the images (EXTNAME, in any case); all images if `None`.
    pub extension: Option<&'a str>,
    #[serde(skip)]
    pub content: Content,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    Sky,
    Psf,
    /// Masks: not zero for a bad pixel.
    Mask,
    /// Variances of pixels, or their inverse: a weight.
    Variance,
    Weight,
}

impl Content {
    /// Whether an image of this name has another content.
    fn is_not(self, name: &str) -> bool {
        let companion = COMPANIONS
            .iter()
            .any(|other| name.eq_ignore_ascii_case(other));
        match self {
            Content::Sky => companion,
            Content::Psf => companion && !name.eq_ignore_ascii_case("PSF"),
            Content::Mask | Content::Variance | Content::Weight => false,
        }
    }

    fn option(self) -> &'static str {
        match self {
            Content::Sky => "--extension",
            Content::Psf => "--psf-extension",
            Content::Mask => "--mask-extension",
            Content::Variance => "--variance-extension",
            Content::Weight => "--weight-extension",
        }
    }

    fn noun(self) -> &'static str {
        match self {
            Content::Sky => "stamp",
            Content::Psf => "PSF",
            Content::Mask => "mask",
            Content::Variance => "variance map",
            Content::Weight => "weight map",
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Origin<'a> {
    pub(super) file: &'a Path,
    pub(super) image: usize,
    pub(super) plane: usize,
    pub(super) position: Option<(f64, f64)>,
}

impl Origin<'_> {
    pub(super) fn fault(&self, what: &str) -> FileError {
        let Origin { image, plane, .. } = self;
        FileError::new(self.file, format!("image {image}, plane {plane}: {what}"))
    }
}

pub(super) struct Images<'a> {
    files: Files<'a>,
    begun: usize,
    now: Option<ImageReader>,
    number: usize,
    /// Names of the images that were skipped, and whether one was not.
    others: Vec<String>,
    found: bool,
}

impl<'a> Images<'a> {
    pub(super) fn of(files: Files<'a>) -> Self {
        Images {
            files,
            begun: 0,
            now: None,
            number: 0,
            others: Vec::new(),
            found: false,
        }
    }

    pub(super) fn next(&mut self) -> Result<Option<(Origin<'a>, &mut ImageReader)>, FileError> {
        loop {
            if let Some(image) = self.now.take() {
                self.now = image.next_stack()?;
                self.number += 1;
            }
            if self.now.is_none() {
                self.all_there()?;
                let Some(path) = self.files.paths.get(self.begun) else {
                    return Ok(None);
                };
                self.now = Some(ImageReader::open_stack(path)?);
                (self.begun, self.number) = (self.begun + 1, 1);
                (self.found, self.others) = (false, Vec::new());
            }
            let origin = Origin {
                file: &self.files.paths[self.begun - 1],
                image: self.number,
                plane: 1,
                position: None,
            };
            let name = self.now.as_ref().map(ImageReader::name).unwrap_or_default();
            match self.files.extension {
                Some(wanted) if !name.eq_ignore_ascii_case(wanted) => {
                    self.others.push(name);
                    continue;
                }
                None if self.files.content.is_not(&name) => {
                    return Err(origin.fault(&format!(
                        "the image is called {name}; expected an image of the sky or a PSF. Try: choose images by name with {}",
                        self.files.content.option()
                    )));
                }
                Some(_) | None => self.found = true,
            }
            return Ok(self.now.as_mut().map(|image| (origin, image)));
        }
    }

    // A file without an image of the chosen name would otherwise be skipped, and the stamps would no longer match the PSFs.
    fn all_there(&self) -> Result<(), FileError> {
        match (
            self.files.extension,
            self.files.paths.get(self.begun.wrapping_sub(1)),
        ) {
            (Some(wanted), Some(path)) if !self.found => {
                let names = self.others.iter().map(|name| format!("`{name}`"));
                let names = names.collect::<Vec<_>>().join(", ");
                let message = format!("there is no image called `{wanted}`; found {names}");
                Err(FileError::new(path, message))
            }
            _ => Ok(()),
        }
    }
}

struct Planes<'a> {
    images: Images<'a>,
    origin: Option<Origin<'a>>,
    left: usize,
}

impl<'a> Planes<'a> {
    pub(super) fn of(files: Files<'a>) -> Self {
        Planes {
            images: Images::of(files),
            origin: None,
            left: 0,
        }
    }

    pub(super) fn content(&self) -> Content {
        self.images.files.content
    }

    pub(super) fn sides(&self) -> [usize; 2] {
        let now = self.images.now.as_ref();
        now.map_or([0; 2], |image| [image.width(), image.height()])
    }

    // One plane at a time: a cube of stamps can be larger than the memory.
    pub(super) fn next<P: Pixel>(&mut self) -> Result<Option<(Origin<'a>, Vec<P>)>, FileError> {
        let origin = match self.origin {
            Some(origin) if self.left > 0 => Origin {
                plane: origin.plane + 1,
                ..origin
            },
            _ => match self.images.next()? {
                None => return Ok(None),
                Some((origin, image)) => {
                    self.left = image.planes();
                    origin
                }
            },
        };
        self.origin = Some(origin);
        self.left -= 1;
        let Some(image) = self.images.now.as_mut() else {
            return Ok(None);
        };
        let pixels = image.read_rows_as(image.height())?;
        Ok(Some((origin, pixels)))
    }
}

/// The first image of a file, to cut squares out of.
pub(super) struct Exposure<'a> {
    images: Images<'a>,
    pub(super) origin: Origin<'a>,
}

impl<'a> Exposure<'a> {
    pub(super) fn open(files: Files<'a>) -> Result<Self, FileError> {
        if let Some(more) = files.paths.get(1) {
            return Err(FileError::new(
                more,
                "this is a second file; expected one file with the exposure",
            ));
        }
        let mut images = Images::of(files);
        let (origin, planes) = match images.next()? {
            Some((origin, image)) => (origin, image.planes()),
            None => {
                return Err(FileError::new(
                    &files.paths[0],
                    "there is no image in this file",
                ));
            }
        };
        if planes != 1 {
            let message =
                format!("the image has {planes} planes; expected an exposure, which has one");
            return Err(origin.fault(&message));
        }
        Ok(Exposure { images, origin })
    }

    fn reader(&mut self) -> Result<&mut ImageReader, FileError> {
        let none = || self.origin.fault("the image is no longer there");
        self.images.now.as_mut().ok_or_else(none)
    }

    pub(super) fn content(&self) -> Content {
        self.images.files.content
    }

    pub(super) fn sides(&mut self) -> Result<[usize; 2], FileError> {
        let reader = self.reader()?;
        Ok([reader.width(), reader.height()])
    }

    pub(super) fn wcs(&mut self) -> Result<Wcs, FileError> {
        Ok(Wcs::of_header(self.reader()?))
    }

    /// Refuses an image of another size than `other`.
    pub(super) fn like(&mut self, other: &mut Self) -> Result<(), FileError> {
        let (own, expected) = (self.sides()?, other.sides()?);
        if own != expected {
            let message = format!(
                "the {} is {} × {} pixels; the exposure has {} × {}",
                self.images.files.content.noun(),
                own[0],
                own[1],
                expected[0],
                expected[1]
            );
            return Err(self.origin.fault(&message));
        }
        Ok(())
    }

    /// The square of `side` pixels a side whose centre is nearest to a position in FITS pixels; NaN beyond the
    /// image.
    pub(super) fn square<P: Pixel>(
        &mut self,
        (x, y): (f64, f64),
        side: usize,
    ) -> Result<Vec<P>, FileError> {
        self.reader()?
            .read_square(first_pixel(x, side), first_pixel(y, side), side)
    }
}

/// First pixel, from 0, of the `side` pixels whose middle is nearest to a position in FITS pixels.
fn first_pixel(at: f64, side: usize) -> i64 {
    (at - (side as f64 + 1.0) / 2.0).round() as i64
}

/// A position on the square that is cut around it, from the centre.
pub(crate) fn subpixel_offset((x, y): (f64, f64), side: usize) -> [f64; 2] {
    [x, y].map(|at| at - (side as f64 + 1.0) / 2.0 - first_pixel(at, side) as f64)
}

pub(super) struct StampWriter {
    pub(super) image: Rows,
    pub(super) examination: Examination,
    pub(super) incomplete: usize,
    examined: Vec<usize>,
    pub(super) origins: Origins,
    // At the galaxies, if a map gives them; NaN for stamps without pixels.
    pub(super) levels: Option<Vec<f64>>,
}

// For users who look for the file of a strange galaxy.
#[derive(Default)]
pub(super) struct Origins {
    pub(super) file: Vec<String>,
    pub(super) image: Vec<i64>,
    pub(super) plane: Vec<i64>,
}

impl StampWriter {
    pub(super) fn create(
        target: &Path,
        mosaic: Mosaic,
        noise: Option<f64>,
        wcs: &Wcs,
    ) -> Result<Self, FileError> {
        let mut keys = wcs.keys();
        keys.extend(noise.map(|sigma| ("NOISESIG", Value::Real(sigma))));
        let examined = examined_rows(mosaic.columns, mosaic.rows());
        Ok(StampWriter {
            image: Rows::create(target, mosaic, &keys)?,
            examination: Examination::new(mosaic.stamp, examined.len() * mosaic.columns),
            incomplete: 0,
            examined,
            origins: Origins::default(),
            levels: None,
        })
    }

    pub(super) fn copy(
        &mut self,
        gathering: &Gathering<'_>,
        positions: &[(f64, f64)],
    ) -> Result<(), FileError> {
        self.levels = gathering.variances.map(|_| Vec::new());
        match gathering.stamps {
            Stamps::Files(files) => self.copy_files(files, gathering),
            Stamps::Cutouts { exposure, .. } => self.copy_cutouts(exposure, gathering, positions),
        }
    }

    fn copy_files(&mut self, files: Files<'_>, gathering: &Gathering<'_>) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let mut planes = Planes::of(files);
        let mut masks = gathering.masks.map(|masks| Planes::of(masks.files));
        let mut maps = gathering.variances.map(Planes::of);
        while let Some((origin, mut pixels)) = planes.next::<f32>()? {
            let sides = planes.sides();
            let mut variances = None;
            for companion in [&mut masks, &mut maps].into_iter().flatten() {
                let content = companion.content();
                let noun = content.noun();
                let Some((place, values)) = companion.next::<f64>()? else {
                    return Err(origin.fault(&format!("there is no {noun} for this stamp")));
                };
                if companion.sides() != sides {
                    let [columns, rows] = companion.sides();
                    let message = format!(
                        "the {noun} is {columns} × {rows} pixels; its stamp has {} × {}",
                        sides[0], sides[1]
                    );
                    return Err(place.fault(&message));
                }
                another(&place, &origin, content)?;
                match content {
                    Content::Mask => {
                        let bits = gathering.masks.and_then(|masks| masks.bits);
                        lose(&mut pixels, &values, bits).map_err(|fault| place.fault(&fault))?;
                    }
                    _ => variances = Some((place, content, values)),
                }
            }
            if let Some((place, content, mut values)) = variances {
                let read = variance(&mut pixels, &mut values, content);
                read.map_err(|fault| place.fault(&fault))?;
                let values = central(values, sides, side);
                self.levels
                    .get_or_insert_default()
                    .push(level(&values, side));
            }
            self.add(&origin, &central(pixels, sides, side))?;
        }
        for companion in [&mut masks, &mut maps].into_iter().flatten() {
            if let Some((place, _)) = companion.next::<f64>()? {
                let noun = companion.content().noun();
                return Err(place.fault(&format!("there is no stamp for this {noun}")));
            }
        }
        Ok(())
    }

    fn copy_cutouts(
        &mut self,
        exposure: Files<'_>,
        gathering: &Gathering<'_>,
        positions: &[(f64, f64)],
    ) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let mut exposure = Exposure::open(exposure)?;
        let bits = gathering.masks.and_then(|masks| masks.bits);
        let masks = gathering.masks.map(|masks| Exposure::open(masks.files));
        let maps = gathering.variances.map(Exposure::open);
        let [mut masks, mut maps] = [masks.transpose()?, maps.transpose()?];
        for companion in [&mut masks, &mut maps].into_iter().flatten() {
            companion.like(&mut exposure)?;
            another(&companion.origin, &exposure.origin, companion.content())?;
        }
        let [_, height] = exposure.sides()?;
        let mut fit = MapFit::default();
        for &(x, y) in positions {
            let mut pixels = exposure.square::<f32>((x, y), side)?;
            if let Some(mask) = &mut masks {
                let square = mask.square::<f64>((x, y), side)?;
                lose(&mut pixels, &square, bits).map_err(|fault| mask.origin.fault(&fault))?;
            }
            if let Some(map) = &mut maps {
                let mut values = map.square::<f64>((x, y), side)?;
                variance(&mut pixels, &mut values, map.content()).map_err(|fault| {
                    map.origin
                        .fault(&format!("stamp at ({x:.1}, {y:.1}): {fault}"))
                })?;
                let stated = level(&values, side);
                self.levels.get_or_insert_default().push(stated);
                if fit.residuals.len() < MAX_FITTED {
                    let mut other = map.square::<f64>((x, height as f64 + 1.0 - y), side)?;
                    if map.content() == Content::Weight {
                        other.iter_mut().for_each(|value| *value = 1.0 / *value);
                    }
                    other.iter_mut().for_each(|value| {
                        if !(*value > 0.0 && value.is_finite()) {
                            *value = f64::NAN;
                        }
                    });
                    fit.add(&pixels, stated, level(&other, side), side);
                }
            }
            let origin = Origin {
                position: Some((x, y)),
                ..exposure.origin
            };
            self.add(&origin, &pixels)?;
        }
        match &maps {
            Some(map) if fit.is_upside_down() => {
                let message = format!(
                    "the {} fits the noise of the exposure upside down and not as it is (expected the rows of the exposure). Try: the map without its rows reversed",
                    map.content().noun()
                );
                Err(map.origin.fault(&message))
            }
            _ => Ok(()),
        }
    }

    fn add(&mut self, origin: &Origin<'_>, pixels: &[f32]) -> Result<(), FileError> {
        let (mosaic, next) = (self.image.mosaic, self.image.next);
        let side = mosaic.stamp;
        self.incomplete += usize::from(pixels.iter().any(|value| !value.is_finite()));
        if self.examined.contains(&(next / mosaic.columns)) {
            let place = origin
                .position
                .map_or([0.0; 2], |at| subpixel_offset(at, side));
            let stamp = ArrayView2::from_shape((side, side), pixels);
            let stamp = stamp.map_err(|error| FileError::new(origin.file, error))?;
            let examined = self.examination.add_at(stamp, place);
            examined.map_err(|error| FileError::new(origin.file, error))?;
        }
        self.origins.file.push(origin.file.display().to_string());
        self.origins.image.push(origin.image as i64);
        self.origins.plane.push(origin.plane as i64);
        self.image.add(pixels)
    }
}

// Stamps by which a map is compared with the noise. Chosen by hand: a map that halves the noise needs about ten.
const MAX_FITTED: usize = 2000;
const MIN_FITTED: usize = 20;
// Standard errors by which the map turned upside down must fit better. Chosen by hand.
const UPSIDE_DOWN_SIGNIFICANCE: f64 = 5.0;

/// Logarithms of the variance that stamps have beyond the galaxy, less those that the map states, and that it would state upside
/// down. A wrong level biases m by a third in each half of an exposure, and no other test finds it: its mean is right.
#[derive(Default)]
struct MapFit {
    residuals: Vec<[f64; 2]>,
}

impl MapFit {
    fn add(&mut self, pixels: &[f32], stated: f64, turned: f64, side: usize) {
        // Differences of neighbours are free of the sky and of the smooth wings of galaxies.
        let differences = (0..pixels.len())
            .filter(|at| at % side > 0 && is_outside(*at, side))
            .map(|at| f64::from(pixels[at] - pixels[at - 1]).abs());
        let mut differences: Vec<f64> = differences.filter(|value| value.is_finite()).collect();
        let Some(spread) = upper_median(&mut differences) else {
            return;
        };
        let residuals = [stated, turned].map(|level| 2.0 * (spread / level).ln());
        if residuals.iter().all(|value| value.is_finite()) {
            self.residuals.push(residuals);
        }
    }

    fn is_upside_down(&self) -> bool {
        let count = self.residuals.len() as f64;
        if self.residuals.len() < MIN_FITTED {
            return false;
        }
        let means = [0, 1].map(|k| self.residuals.iter().map(|of| of[k]).sum::<f64>() / count);
        let gains = self.residuals.iter().map(|of| {
            let [stated, turned] = [0, 1].map(|k| (of[k] - means[k]).powi(2));
            stated - turned
        });
        let gains: Vec<f64> = gains.collect();
        let mean = gains.iter().sum::<f64>() / count;
        let squares = gains.iter().map(|gain| (gain - mean).powi(2)).sum::<f64>();
        mean > UPSIDE_DOWN_SIGNIFICANCE * squares.sqrt() / count
    }
}

// Without --mask-extension, the image itself would be read as its mask, and all bright pixels would be missing.
fn another(map: &Origin<'_>, image: &Origin<'_>, content: Content) -> Result<(), FileError> {
    if (map.file, map.image) == (image.file, image.image) {
        let (noun, option) = (content.noun(), content.option());
        let message = format!("the {noun} is the image itself; expected another ({option})");
        return Err(map.fault(&message));
    }
    Ok(())
}

// Maps may have any value where the pixel is missing already.
fn variance(pixels: &mut [f32], values: &mut [f64], content: Content) -> Result<(), String> {
    for (pixel, value) in pixels.iter_mut().zip(values) {
        let stated = *value;
        if content == Content::Weight {
            *value = 1.0 / stated;
        }
        // The weight 0, or an infinite variance, marks bad pixels in the maps of most surveys.
        if *value == f64::INFINITY {
            *pixel = f32::NAN;
        }
        if pixel.is_finite() && (value.is_nan() || *value <= 0.0) {
            let what = match content {
                Content::Weight => {
                    "the weight is {stated}; expected a positive number, or 0 for a bad pixel"
                }
                _ => {
                    "the variance is {stated}; expected a positive number, or infinity for a bad pixel"
                }
            };
            return Err(what.replace("{stated}", &stated.to_string()));
        }
        if !pixel.is_finite() {
            *value = f64::NAN;
        }
    }
    Ok(())
}

// The median over the pixels outside a circle around the galaxy.
//
// Variance maps of many surveys contain the Poisson noise of the counts themselves. A level from pixels of the galaxy would be
// high where its noise is positive, and the subtracted noise power would correlate with the data. If two depths meet on the
// stamp, the galaxy in the centre lies on the larger part, whose level the median takes; a gradient cancels. The galaxy's own
// Poisson noise is added by `gain`.
fn level(variances: &[f64], side: usize) -> f64 {
    let finite = |at: &usize| variances[*at].is_finite();
    let chosen = (0..variances.len())
        .filter(finite)
        .filter(|&at| is_outside(at, side));
    let mut chosen: Vec<f64> = chosen.map(|at| variances[at]).collect();
    if chosen.is_empty() {
        chosen = variances
            .iter()
            .copied()
            .filter(|v| v.is_finite())
            .collect();
    }
    upper_median(&mut chosen).map_or(f64::NAN, f64::sqrt)
}

// Whether a pixel of a stamp is beyond the galaxy.
fn is_outside(at: usize, side: usize) -> bool {
    let middle = (side as f64 - 1.0) / 2.0;
    // Chosen by hand: 12 px of 48, where most galaxies of a stamp of this size have no light.
    let radius = side as f64 / 4.0;
    let [x, y] = [at % side, at / side].map(|k| k as f64 - middle);
    x.hypot(y) > radius
}

// Makes the pixels of a stamp missing whose `mask` is not zero, or has one of these bits.
fn lose(pixels: &mut [f32], mask: &[f64], bits: Option<u64>) -> Result<(), String> {
    for (pixel, mask) in pixels.iter_mut().zip(mask) {
        let bad = match bits {
            Some(bits) if mask.is_finite() => {
                if mask.fract() != 0.0 {
                    return Err(format!(
                        "the mask has the value {mask}; expected whole numbers, of which --mask-bits takes bits"
                    ));
                }
                // Negative numbers are in two's complement, as in the file.
                (*mask as i64) as u64 & bits != 0
            }
            _ => *mask != 0.0,
        };
        if bad {
            *pixel = f32::NAN;
        }
    }
    Ok(())
}

/// The central `side` × `side` pixels of an image of some columns and rows; those beyond it are missing. Where the parities
/// differ, the centre moves by half a pixel.
pub(super) fn central<P: Pixel>(
    pixels: Vec<P>,
    [columns, rows]: [usize; 2],
    side: usize,
) -> Vec<P> {
    if [columns, rows] == [side; 2] {
        return pixels;
    }
    let first = |there: usize| (there as i64 - side as i64).div_euclid(2);
    let mut square = vec![P::MISSING; side * side];
    for (at, pixel) in square.iter_mut().enumerate() {
        let x = usize::try_from(first(columns) + (at % side) as i64);
        let y = usize::try_from(first(rows) + (at / side) as i64);
        if let (Ok(x), Ok(y)) = (x, y)
            && x < columns
            && y < rows
        {
            *pixel = pixels[y * columns + x];
        }
    }
    square
}

/// A mosaic that is written a row of stamps at a time.
pub(super) struct Rows {
    path: PathBuf,
    writer: ImageWriter,
    pub(super) mosaic: Mosaic,
    pub(super) next: usize,
    pixels: Vec<f32>,
}

impl Rows {
    pub(super) fn create(
        path: &Path,
        mosaic: Mosaic,
        more: &[(&str, Value)],
    ) -> Result<Self, FileError> {
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

    pub(super) fn finish(self) -> Result<(), FileError> {
        first(self.writer.finish_if_absent()?, self.path)
    }
}

pub(super) fn already(path: PathBuf) -> FileError {
    let message = "the file is there already. Try: another number with --set and --image";
    FileError::new(path, message)
}

/// An error if the file was not `named`, because there is one at `path`.
pub(super) fn first(named: bool, path: PathBuf) -> Result<(), FileError> {
    match named {
        true => Ok(()),
        false => Err(already(path)),
    }
}

// Central pixels of a PSF that are examined, along each axis: those that configurations use.
const EXAMINED_SIDE_PX: usize = 48;
// Largest side of a grid of stars that is looked for in a PSF image. GREAT3 has 3 × 3 stars. Chosen by hand.
const MAX_GRID_STARS: usize = 10;
// Smallest side of the square of a star in such a grid. Chosen by hand.
const MIN_STAR_CELL_PX: usize = 16;
// Peak of each star in units of the brightest one: noise and wings around a single star are fainter. Chosen by hand.
const MIN_PEAK_RATIO: f32 = 0.5;
// Fewest galaxies per star whose stars are averaged: with fewer, some of one PSF per galaxy are missing. Chosen by hand.
const MIN_GALAXIES_PER_STAR: usize = 2;
// Averaged stars are in memory together: 128 MB in double precision. Chosen by hand.
const MAX_AVERAGED_PIXELS: usize = 1 << 24;

pub(super) struct GatheredPsfs {
    pub(super) file: PsfFile,
    pub(super) examination: Examination,
    pub(super) messages: Vec<String>,
    pub(super) wcs: Wcs,
    pub(super) first: PathBuf,
}

pub(super) fn gather_psfs(
    data: &DataFolder,
    id: ImageId,
    files: Files<'_>,
    square: Option<Square>,
    mosaic: &Mosaic,
) -> Result<GatheredPsfs, FileError> {
    if let [table] = files.paths
        && table
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("csv"))
    {
        return functional(data.psf_functional(id.set, id.image), table, mosaic);
    }
    let (stack, mut messages) = Stack::of(files, square)?;
    let &Stack {
        count,
        side,
        ref wcs,
        ..
    } = &stack;
    messages.extend(stack.differs.clone());
    messages.extend(small(&files.paths[0], side));
    let path = data.psf_star(id.set, id.image);
    if count > 1 && MIN_GALAXIES_PER_STAR * count <= mosaic.galaxies {
        return averaged(&path, files, &stack, messages);
    }
    check_count(&files.paths[0], count, mosaic)?;
    // One, or one per galaxy in the same places.
    let mut image = Rows::create(&path, Mosaic::of(count, side), &wcs.keys())?;
    let mut planes = Planes::of(files);
    let mut examination = Examination::new(side, 0);
    if count > 1 {
        examination = examination.with_psf_of_each();
    }
    let mut dark = 0;
    while let Some((origin, pixels)) = planes.next()? {
        let pixels = central(pixels, planes.sides(), side);
        if count == 1 {
            messages.extend(several_stars(&files.paths[0], &pixels, side));
        }
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
            && let Ok(Star { psf, moved }) = Star::cut(stamp, examined_cut(side))
        {
            examination.add_psf(psf.view(), moved);
        }
        image.add(&pixels)?;
    }
    messages.extend(named(&examination, &files.paths[0]));
    if dark > 0 {
        messages.push(format!(
            "warning: {dark} of {count} PSFs have no positive sum of pixels. Their galaxies will be flagged"
        ));
    }
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        wcs: wcs.clone(),
        first: files.paths[0].clone(),
    })
}

// Named configurations refuse such PSF stamps. Users should learn it before they have gathered all images.
fn small(path: &Path, side: usize) -> Option<String> {
    let shown = path.display();
    (side < MIN_PSF).then(|| {
        format!(
            "warning: {shown}: the PSF stamps are {side} × {side} px (expected {MIN_PSF} × {MIN_PSF} or more, which configurations of 48 px require). Try: larger PSF stamps; or, if no light is beyond them, --submission own.toml with the file own.toml of these lines:\n  extends = \"48/linear/star\"\n  psf.size = {side}"
        )
    })
}

// A warning about an image that is a grid of stars, as in GREAT3.
fn several_stars(path: &Path, pixels: &[f32], side: usize) -> Option<String> {
    let brightest = |n: usize| {
        let cell = side / n;
        let square = move |k: usize| {
            let places = (0..cell * cell).map(move |at| {
                let (x, y) = (k % n * cell + at % cell, k / n * cell + at / cell);
                (at, pixels[y * side + x])
            });
            places.max_by(|a, b| a.1.total_cmp(&b.1))
        };
        (0..n * n).filter_map(square).collect::<Vec<_>>()
    };
    let is_grid = |n: &usize| {
        let cell = side / n;
        let found = brightest(*n);
        let most = found.iter().map(|(_, value)| *value).fold(0.0, f32::max);
        let middle = |at: usize| (cell / 4..cell - cell / 4).contains(&at);
        let star = |&(at, value): &(usize, f32)| {
            value > MIN_PEAK_RATIO * most && middle(at % cell) && middle(at / cell)
        };
        found.iter().all(star)
    };
    let mut grids =
        (2..=MAX_GRID_STARS).filter(|n| side.is_multiple_of(*n) && side / n >= MIN_STAR_CELL_PX);
    let n = grids.find(is_grid)?;
    let (shown, cell, stars) = (path.display(), side / n, n * n);
    Some(format!(
        "warning: {shown}: the image has {n} × {n} stars (found a peak in each square of {cell} × {cell} px; expected one star). The brightest is used. Try: a cube of {stars} stamps of {cell} × {cell} px, which are averaged to one PSF"
    ))
}

fn check_count(path: &Path, found: usize, mosaic: &Mosaic) -> Result<(), FileError> {
    if found == 1 || found == mosaic.galaxies {
        return Ok(());
    }
    let message = format!(
        "there are {found} PSFs; expected one, or one for each of the {} stamps. Several stars are averaged if there are at least twice as many stamps",
        mosaic.galaxies
    );
    Err(FileError::new(path, message))
}

fn examined_cut(side: usize) -> PsfCut {
    let size = side - side.saturating_sub(EXAMINED_SIDE_PX).next_multiple_of(2);
    PsfCut {
        size,
        // So that a star off the centre can be cut around itself.
        least: size - (size / 3).next_multiple_of(2),
        centred: false,
    }
}

// In the order of the galaxies, like stars. Positions in the mosaic replace the positions of the table, which are on another image.
fn functional(path: PathBuf, table: &Path, mosaic: &Mosaic) -> Result<GatheredPsfs, FileError> {
    let mut rows = read_psfs(table)?;
    check_count(table, rows.len(), mosaic)?;
    for (place, (position, _)) in rows.iter_mut().enumerate() {
        *position = mosaic.position(place);
    }
    let mut examination = Examination::new(mosaic.stamp, 0);
    let psfs: Vec<_> = rows.iter().map(|(_, psf)| *psf).collect();
    let cut = examined_cut(mosaic.stamp);
    examination.add_psfs(&Psfs::functional(psfs), cut, EXAMINED_PSFS);
    Ok(GatheredPsfs {
        file: PsfFile::Table(path, psfs_text(&rows)),
        examination,
        messages: Vec::new(),
        wcs: Wcs::default(),
        first: table.to_owned(),
    })
}

// The average of several stars, as the PSF of all galaxies.
fn averaged(
    path: &Path,
    files: Files<'_>,
    &Stack {
        count,
        side,
        ref wcs,
        ..
    }: &Stack,
    mut messages: Vec<String>,
) -> Result<GatheredPsfs, FileError> {
    let first = &files.paths[0];
    let pixels = count * side * side;
    if pixels > MAX_AVERAGED_PIXELS {
        let message = format!(
            "there are {count} stars of {side} × {side} pixels to average ({pixels} pixels, expected at most {MAX_AVERAGED_PIXELS}). Try: fewer stars"
        );
        return Err(FileError::new(first, message));
    }
    let mut all = Vec::with_capacity(pixels);
    let mut planes = Planes::of(files);
    while let Some((_, pixels)) = planes.next::<f32>()? {
        let pixels = central(pixels, planes.sides(), side);
        all.extend(pixels.iter().map(|&value| f64::from(value)));
    }
    let stars = ArrayView3::from_shape((count, side, side), &all)
        .map_err(|error| FileError::new(first, error))?;
    let psf = average_stars(stars, examined_cut(side))
        .map_err(|(k, error)| FileError::new(first, format!("star {k}: {error}")))?;
    let shown = first.display();
    messages.push(format!(
        "note: {shown}: {count} stars were averaged to one PSF for all galaxies"
    ));
    let mut examination = Examination::new(side, 0);
    examination.add_psf(psf.view(), None);
    messages.extend(named(&examination, first));
    let mut image = Rows::create(path, Mosaic::of(1, psf.nrows()), &wcs.keys())?;
    let pixels: Vec<f32> = psf.iter().map(|&value| value as f32).collect();
    image.add(&pixels)?;
    Ok(GatheredPsfs {
        file: PsfFile::Stars(Box::new(image)),
        examination,
        messages,
        wcs: wcs.clone(),
        first: first.clone(),
    })
}

/// The warnings of an examination, with the file that they are about.
fn named(examination: &Examination, path: &Path) -> Vec<String> {
    let found = examination.warnings();
    let line = |warning: &Warning| format!("warning: {}: {warning}", path.display());
    found.iter().map(line).collect()
}

pub(super) enum PsfFile {
    Stars(Box<Rows>),
    Table(PathBuf, String),
}

impl PsfFile {
    pub(super) fn finish(self) -> Result<(), FileError> {
        match self {
            PsfFile::Stars(image) => image.finish(),
            PsfFile::Table(path, text) => {
                first(atomic::write_if_absent(&path, text.as_bytes())?, path)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_upside_down_are_recognised() {
        const SIDE: usize = 32;
        let mut state = 3u64;
        let (mut right, mut wrong, mut flat) =
            (MapFit::default(), MapFit::default(), MapFit::default());
        for k in 0..60 {
            // The lower half of the exposure has 1.3 times the noise of the upper one.
            let (own, other) = if k % 2 == 0 { (1.3, 1.0) } else { (1.0, 1.3) };
            let noise = |_| {
                // The generator of Knuth's MMIX; uniform noise will do.
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                (own * (state >> 11) as f64 / (1u64 << 53) as f64) as f32
            };
            let pixels: Vec<f32> = (0..SIDE * SIDE).map(noise).collect();
            right.add(&pixels, own, other, SIDE);
            wrong.add(&pixels, other, own, SIDE);
            flat.add(&pixels, 1.0, 1.0, SIDE);
        }
        let found = [right, wrong, flat].map(|fit| fit.is_upside_down());
        assert_eq!(found, [false, true, false]);
    }
}
