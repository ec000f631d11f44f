//! The stamps of a gathered image, and the table of their origins.

use std::path::Path;

use ndarray::ArrayView2;
use serde::{Serialize, Serializer};
use shearq_files::FileError;
use shearq_files::fits::Value;
use shearq_files::text::formula_mark;
use shearq_measure::{Examination, examined_rows};

use super::rows::Rows;
use super::source::{Exposure, Files, Origin, Planes, off_middle};
use super::{Gathering, Stamps};
use crate::data::mosaic::Mosaic;

/// A row of the table of stamps.
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

/// Writes stamps to the image, and examines some of them.
pub(super) struct StampWriter {
    pub(super) image: Rows,
    pub(super) examination: Examination,
    /// Stamps with missing pixels.
    pub(super) incomplete: usize,
    /// Rows of stamps that are examined.
    examined: Vec<usize>,
    places: csv::Writer<Vec<u8>>,
}

impl StampWriter {
    /// # Errors
    /// If the image cannot be created.
    pub(super) fn create(
        target: &Path,
        mosaic: Mosaic,
        noise: Option<f64>,
    ) -> Result<Self, FileError> {
        let noise = noise.map(|sigma| ("NOISESIG", Value::Real(sigma)));
        let examined = examined_rows(mosaic.columns, mosaic.rows());
        Ok(StampWriter {
            image: Rows::create(target, mosaic, noise.as_slice())?,
            examination: Examination::new(mosaic.stamp, examined.len() * mosaic.columns),
            incomplete: 0,
            examined,
            places: csv::Writer::from_writer(Vec::new()),
        })
    }

    /// Copies all stamps from their files.
    ///
    /// # Errors
    /// If a file cannot be read, or masks do not fit the stamps.
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

    fn copy_files(&mut self, files: Files<'_>, masks: Option<Files<'_>>) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let (mut planes, mut masks) = (Planes::of(files), masks.map(Planes::of));
        while let Some((origin, mut pixels)) = planes.next()? {
            if let Some(masks) = &mut masks {
                let Some((place, mask)) = masks.next()? else {
                    return Err(origin.fault("there is no mask for this stamp"));
                };
                let sides = masks.sides();
                if sides != [side; 2] {
                    let message = format!(
                        "the mask is {} × {} pixels; its stamp has {side} × {side}",
                        sides[0], sides[1]
                    );
                    return Err(place.fault(&message));
                }
                another(&place, &origin)?;
                lose(&mut pixels, &mask);
            }
            self.add(&origin, &pixels)?;
        }
        match masks.as_mut().map_or(Ok(None), Planes::next)? {
            Some((place, _)) => Err(place.fault("there is no stamp for this mask")),
            None => Ok(()),
        }
    }

    fn copy_cutouts(
        &mut self,
        exposure: Files<'_>,
        masks: Option<Files<'_>>,
        positions: &[(f64, f64)],
    ) -> Result<(), FileError> {
        let side = self.image.mosaic.stamp;
        let mut exposure = Exposure::open(exposure)?;
        let mut masks = masks.map(Exposure::open).transpose()?;
        if let Some(mask) = &mut masks {
            mask.like(&mut exposure)?;
            another(&mask.origin, &exposure.origin)?;
        }
        for &(x, y) in positions {
            let mut pixels = exposure.square((x, y), side)?;
            if let Some(mask) = &mut masks {
                lose(&mut pixels, &mask.square((x, y), side)?);
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
    ///
    /// # Errors
    /// If it cannot be completed.
    pub(super) fn places(&mut self, path: &Path) -> Result<Vec<u8>, FileError> {
        let empty = csv::Writer::from_writer(Vec::new());
        let places = std::mem::replace(&mut self.places, empty).into_inner();
        places.map_err(|error| FileError::new(path, error.to_string()))
    }
}

/// Refuses an image that is its own mask.
fn another(mask: &Origin<'_>, image: &Origin<'_>) -> Result<(), FileError> {
    if (mask.file, mask.image) == (image.file, image.image) {
        let message = "the mask is the image itself; expected another (--mask-extension)";
        return Err(mask.fault(message));
    }
    Ok(())
}

/// Makes the pixels of a stamp missing whose `mask` is not zero.
fn lose(pixels: &mut [f32], mask: &[f32]) {
    for (pixel, mask) in pixels.iter_mut().zip(mask) {
        if *mask != 0.0 {
            *pixel = f32::NAN;
        }
    }
}
