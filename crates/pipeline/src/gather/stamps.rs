//! The stamps of a gathered image, with their masks and noise.

use std::path::{Path, PathBuf};

use ndarray::ArrayView2;
use shearq_files::FileError;
use shearq_files::fits::{ImageWriter, Pixel, Value};
use shearq_measure::{Examination, examined_rows};
use shearq_quantities::statistics::upper_median;

use super::source::{Content, Exposure, Files, Origin, Planes, subpixel_offset};
use super::{Gathering, Stamps};
use crate::wcs::Wcs;
use shearq_dataset::grid::Mosaic;

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
                if fit.residuals.len() < MOST_FITTED {
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
const MOST_FITTED: usize = 2000;
const LEAST_FITTED: usize = 20;
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
        if self.residuals.len() < LEAST_FITTED {
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

    pub(super) fn add(&mut self, stamp: &[f32]) -> Result<(), FileError> {
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
