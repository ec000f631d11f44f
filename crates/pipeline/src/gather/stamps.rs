//! The stamps of a gathered image, and the table of their origins.

use std::path::{Path, PathBuf};

use ndarray::ArrayView2;
use serde::{Serialize, Serializer};
use shearq_files::fits::{ImageWriter, Value};
use shearq_files::text::formula_mark;
use shearq_files::{FileError, atomic};
use shearq_measure::{Examination, examined_rows};

use super::source::{Exposure, Files, Origin, Planes, off_middle};
use super::{Gathering, Masks, Stamps};
use crate::wcs::Wcs;
use shearq_dataset::mosaic::Mosaic;

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

// Writes a path as a cell of CSV, without formulas.
fn cell<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    let path = path.display().to_string();
    serializer.collect_str(&format_args!("{}{path}", formula_mark(&path)))
}

/// Writes stamps to the image, and examines some of them.
pub(super) struct StampWriter {
    pub(super) image: Rows,
    pub(super) examination: Examination,
    pub(super) incomplete: usize,
    examined: Vec<usize>,
    places: csv::Writer<Vec<u8>>,
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
            places: csv::Writer::from_writer(Vec::new()),
        })
    }

    pub(super) fn copy(
        &mut self,
        gathering: &Gathering<'_>,
        positions: &[(f64, f64)],
    ) -> Result<(), FileError> {
        match gathering.stamps {
            Stamps::Files(files) => self.copy_files(files, gathering.masks),
            Stamps::Cutouts { exposure, .. } => {
                self.copy_cutouts(exposure, gathering.masks, positions)
            }
        }
    }

    fn copy_files(&mut self, files: Files<'_>, masks: Option<Masks<'_>>) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let mut planes = Planes::of(files);
        let mut masks = masks.map(|masks| (Planes::of(masks.files), masks.bits));
        while let Some((origin, mut pixels)) = planes.next::<f32>()? {
            let sides = planes.sides();
            if let Some((masks, bits)) = &mut masks {
                let Some((place, mask)) = masks.next::<f64>()? else {
                    return Err(origin.fault("there is no mask for this stamp"));
                };
                if masks.sides() != sides {
                    let [columns, rows] = masks.sides();
                    let message = format!(
                        "the mask is {columns} × {rows} pixels; its stamp has {} × {}",
                        sides[0], sides[1]
                    );
                    return Err(place.fault(&message));
                }
                another(&place, &origin)?;
                lose(&mut pixels, &mask, *bits).map_err(|fault| place.fault(&fault))?;
            }
            self.add(&origin, &central(pixels, sides, side))?;
        }
        let more = masks
            .as_mut()
            .map_or(Ok(None), |(masks, _)| masks.next::<f64>())?;
        match more {
            Some((place, _)) => Err(place.fault("there is no stamp for this mask")),
            None => Ok(()),
        }
    }

    fn copy_cutouts(
        &mut self,
        exposure: Files<'_>,
        masks: Option<Masks<'_>>,
        positions: &[(f64, f64)],
    ) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let mut exposure = Exposure::open(exposure)?;
        let bits = masks.and_then(|masks| masks.bits);
        let mut masks = masks.map(|masks| Exposure::open(masks.files)).transpose()?;
        if let Some(mask) = &mut masks {
            mask.like(&mut exposure)?;
            another(&mask.origin, &exposure.origin)?;
        }
        for &(x, y) in positions {
            let mut pixels = exposure.square::<f32>((x, y), side)?;
            if let Some(mask) = &mut masks {
                let square = mask.square::<f64>((x, y), side)?;
                lose(&mut pixels, &square, bits).map_err(|fault| mask.origin.fault(&fault))?;
            }
            let origin = Origin {
                position: Some((x, y)),
                ..exposure.origin
            };
            self.add(&origin, &pixels)?;
        }
        Ok(())
    }

    fn add(&mut self, origin: &Origin<'_>, pixels: &[f32]) -> Result<(), FileError> {
        let (mosaic, next) = (self.image.mosaic, self.image.next);
        let side = mosaic.stamp;
        self.incomplete += usize::from(pixels.iter().any(|value| !value.is_finite()));
        if self.examined.contains(&(next / mosaic.columns)) {
            let place = origin.position.map_or([0.0; 2], |at| off_middle(at, side));
            let stamp = ArrayView2::from_shape((side, side), pixels);
            let stamp = stamp.map_err(|error| FileError::new(origin.file, error))?;
            let examined = self.examination.add_at(stamp, place);
            examined.map_err(|error| FileError::new(origin.file, error))?;
        }
        let (x, y) = mosaic.position(next);
        let place = Place {
            x,
            y,
            file: origin.file,
            image: origin.image,
            plane: origin.plane,
            position_x: origin.position.map(|(x, _)| x),
            position_y: origin.position.map(|(_, y)| y),
        };
        let written = self.places.serialize(place);
        written.map_err(FileError::doing(
            origin.file,
            "cannot write the table of stamps",
        ))?;
        self.image.add(pixels)
    }

    /// The table of stamps as text, for a file at `path`. Nothing can be added after it.
    pub(super) fn places(&mut self, path: &Path) -> Result<Vec<u8>, FileError> {
        let empty = csv::Writer::from_writer(Vec::new());
        let places = std::mem::replace(&mut self.places, empty).into_inner();
        places.map_err(|error| FileError::new(path, error.to_string()))
    }
}

fn another(mask: &Origin<'_>, image: &Origin<'_>) -> Result<(), FileError> {
    if (mask.file, mask.image) == (image.file, image.image) {
        let message = "the mask is the image itself; expected another (--mask-extension)";
        return Err(mask.fault(message));
    }
    Ok(())
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
pub(super) fn central(pixels: Vec<f32>, [columns, rows]: [usize; 2], side: usize) -> Vec<f32> {
    if [columns, rows] == [side; 2] {
        return pixels;
    }
    let first = |there: usize| (there as i64 - side as i64).div_euclid(2);
    let mut square = vec![f32::NAN; side * side];
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
        atomic::sweep_beside(path);
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
