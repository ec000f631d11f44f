//! Mosaics of stamps that are written.

use std::path::{Path, PathBuf};

use ndarray::ArrayView2;
use shearq_dataset::grid::Mosaic;
use shearq_files::FileError;
use shearq_files::fits::{ImageWriter, Pixel, Value};
use shearq_measure::{Examination, examined_rows};

use super::exposure::Exposure;
use super::files::{Content, Files, Origin, PlaneReader};
use super::maps::{another, level, lose, variance};
use super::request::{Gathering, Stamps};
use crate::stamp_table::subpixel_offset;
use crate::wcs::Wcs;

pub(super) struct StampWriter {
    pub(super) image: Rows,
    pub(super) examination: Examination,
    pub(super) incomplete: usize,
    /// Pixels that masks made missing.
    masked: usize,
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
        psfs: &Examination,
    ) -> Result<Self, FileError> {
        let mut keys = wcs.keys();
        keys.extend(noise.map(|sigma| ("NOISESIG", Value::Real(sigma))));
        let examined = examined_rows(mosaic.columns, mosaic.rows());
        Ok(StampWriter {
            image: Rows::create(target, mosaic, &keys)?,
            examination: Examination::new(mosaic.stamp, examined.len() * mosaic.columns)
                .behind(psfs),
            incomplete: 0,
            masked: 0,
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
        let mut planes = PlaneReader::of(files);
        let mut masks = gathering.masks.map(|masks| PlaneReader::of(masks.files));
        let mut maps = gathering.variances.map(PlaneReader::of);
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
                        self.masked += lose(&mut pixels, &values, bits, &place)?;
                    }
                    _ => variances = Some((place, content, values)),
                }
            }
            if let Some((place, content, mut values)) = variances {
                variance(&mut pixels, &mut values, content, |what| place.fault(what))?;
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
        for &(x, y) in positions {
            let mut pixels = exposure.square::<f32>((x, y), side)?;
            if let Some(mask) = &mut masks {
                let square = mask.square::<f64>((x, y), side)?;
                self.masked += lose(&mut pixels, &square, bits, &mask.origin)?;
            }
            if let Some(map) = &mut maps {
                let mut values = map.square::<f64>((x, y), side)?;
                variance(&mut pixels, &mut values, map.content(), |what| {
                    map.origin
                        .fault(&format!("stamp at ({x:.1}, {y:.1}): {what}"))
                })?;
                self.levels
                    .get_or_insert_default()
                    .push(level(&values, side));
            }
            let origin = Origin {
                position: Some((x, y)),
                ..exposure.origin
            };
            self.add(&origin, &pixels)?;
        }
        Ok(())
    }

    /// A warning if masks leave less than half of the pixels, as those that are one for good pixels.
    pub(super) fn masked_line(&self, gathering: &Gathering<'_>) -> Option<String> {
        let pixels = self.image.next * self.image.mosaic.stamp.pow(2);
        let masks = gathering.masks.filter(|_| 2 * self.masked > pixels)?;
        let share = 100.0 * self.masked as f64 / pixels as f64;
        let remedy = match masks.bits {
            Some(_) => "check --mask-bits",
            None => "invert the mask if it is one for good pixels, or choose bits with --mask-bits",
        };
        let message = format!(
            "the mask has bad pixels on {share:.1} % of the stamps (not zero; expected few)"
        );
        let warning = FileError::new(&masks.files.paths[0], message).hint(remedy);
        Some(format!("warning: {warning}"))
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
    FileError::new(path, "the file is there already").hint("another number with --set and --image")
}

/// An error if the file was not `named`, because there is one at `path`.
pub(super) fn first(named: bool, path: PathBuf) -> Result<(), FileError> {
    if named { Ok(()) } else { Err(already(path)) }
}
