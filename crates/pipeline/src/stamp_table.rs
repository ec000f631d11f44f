//! The table of a gathered image's stamps: identity, place, noise and pixels on the sky of each, for its catalogue.
//!
//! It is Parquet, because text would lose the digits of identities and the difference between `7` and `007`.

use std::path::Path;

use shearq_dataset::great3::{BranchLayout, GalaxyCatalogue};
use shearq_dataset::grid::Mosaic;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::frames::{Metadata, frame};
use shearq_files::open::is_there;
use shearq_files::table::{MAX_ROWS, numbers};
use shearq_files::{FileError, atomic, parquet};
use shearq_quantities::{Frame, Jacobian};

pub(crate) const ID: &str = "id";
/// Columns of places: pixels of the exposure, and degrees on the sky.
pub(crate) const PLACE: [&str; 4] = ["x", "y", "ra", "dec"];
pub(crate) const NOISE: &str = "noise";
/// Derivatives of (u, v), u to the west and v to the north, by x and y in arcseconds per pixel.
pub(crate) const JACOBIAN: [&str; 4] = ["dudx", "dudy", "dvdx", "dvdy"];
/// Places of the stamps in the image of the data folder, and where they come from.
pub(crate) const ORIGIN: [&str; 5] = ["tile_x", "tile_y", "file", "image", "plane"];

const STAMP_TABLE_FRAME: &str = "frame";
const STAMP_TABLE_FIRST_PIXEL: &str = "first_pixel";
const GAIN: &str = "gain";

/// First pixel, from 0, of the `side` pixels whose middle is nearest to a position in FITS pixels.
pub(crate) fn first_pixel(at: f64, side: usize) -> i64 {
    (at - (side as f64 + 1.0) / 2.0).round() as i64
}

/// A position on the square that is cut around it, from the centre.
pub(crate) fn subpixel_offset((x, y): (f64, f64), side: usize) -> [f64; 2] {
    [x, y].map(|at| at - (side as f64 + 1.0) / 2.0 - first_pixel(at, side) as f64)
}

#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Head {
    pub(crate) frame: Frame,
    /// Coordinate of the centre of the first pixel in `x` and `y`.
    pub(crate) first_pixel: u8,
    /// Electrons per unit of the image.
    pub(crate) gain: Option<f64>,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct StampTable {
    pub(crate) head: Head,
    pub(crate) columns: DataFrame,
}

impl StampTable {
    pub(crate) fn write(&self, path: &Path) -> Result<(), FileError> {
        let Head {
            frame,
            first_pixel,
            gain,
        } = self.head;
        let mut metadata = Metadata::from([
            (STAMP_TABLE_FRAME.to_owned(), frame.to_string()),
            (STAMP_TABLE_FIRST_PIXEL.to_owned(), first_pixel.to_string()),
        ]);
        metadata.extend(gain.map(|gain| (GAIN.to_owned(), gain.to_string())));
        let bytes = parquet::encode(&self.columns, &metadata);
        atomic::write(path, &bytes.map_err(|error| FileError::new(path, error))?)
    }

    /// The table of the stamps of a mosaic; `None` if they were not gathered.
    pub(crate) fn read(path: &Path, mosaic: &Mosaic) -> Result<Option<Self>, FileError> {
        if !is_there(path) {
            return Ok(None);
        }
        let columns = parquet::read(path, None, MAX_ROWS)?;
        let (found, expected) = (columns.height(), mosaic.galaxies);
        // The image and its table are two files, and one of them may be of an earlier `gather`.
        if found != expected {
            let message = format!("{found} rows; expected {expected}, one per stamp of the image");
            return Err(FileError::new(path, message).hint("gather it again"));
        }
        let metadata = parquet::metadata(path)?;
        let wrong = |key: &str| {
            let found = metadata.get(key).map_or("nothing", String::as_str);
            let message = format!("the metadata `{key}` are wrong (found {found})");
            FileError::new(path, message).hint("gather again")
        };
        let value = |key: &str| metadata.get(key).map(String::as_str);
        let head = Head {
            frame: value(STAMP_TABLE_FRAME)
                .and_then(|text| text.parse().ok())
                .ok_or_else(|| wrong(STAMP_TABLE_FRAME))?,
            first_pixel: value(STAMP_TABLE_FIRST_PIXEL)
                .and_then(|text| text.parse().ok())
                .ok_or_else(|| wrong(STAMP_TABLE_FIRST_PIXEL))?,
            gain: value(GAIN)
                .map(|text| text.parse().map_err(|_| wrong(GAIN)))
                .transpose()?,
        };
        Ok(Some(StampTable { head, columns }))
    }

    /// The table of a subfield of GREAT3: identities alone, because each stamp is where its galaxy is.
    pub(crate) fn of_great3(
        path: &Path,
        set: u32,
        branch: BranchLayout,
        mosaic: &Mosaic,
    ) -> Result<Self, FileError> {
        let ids = GalaxyCatalogue::read(path)?.identities(set, branch, mosaic)?;
        let head = Head {
            first_pixel: 1,
            ..Head::default()
        };
        table(path, head, vec![Column::new(ID.into(), ids)])
    }

    /// One Jacobian per stamp, if shapes are measured on the sky.
    pub(crate) fn jacobians(&self, path: &Path) -> Result<Option<Vec<Jacobian>>, FileError> {
        // Ellipticities stay along the pixel axes, whatever Jacobians the table has.
        if self.head.frame == Frame::Pixel {
            return Ok(None);
        }
        let of = |name| numbers(&self.columns, name, path);
        let [a, b, c, d] = JACOBIAN.map(of);
        let (a, b, c, d) = (a?, b?, c?, d?);
        let all = (0..a.len()).map(|k| Jacobian::new([[a[k], b[k]], [c[k], d[k]]]));
        let all: Result<_, _> = all.collect();
        all.map(Some).map_err(|error| FileError::new(path, error))
    }

    /// One noise level per stamp, if a map gave them.
    pub(crate) fn noise(&self, path: &Path) -> Result<Option<Vec<f64>>, FileError> {
        // Optional: without a map, the survey of the image measures one level for all stamps.
        match self.columns.column(NOISE) {
            Ok(_) => Ok(Some(numbers(&self.columns, NOISE, path)?.into_owned())),
            Err(_) => Ok(None),
        }
    }

    // Identity and position before the measured columns of a catalogue; columns that the user carried along after them. Columns that
    // only the measurement needs are left out.
    pub(crate) fn of_catalogue(&self) -> (Vec<Column>, Vec<Column>) {
        let all = self.columns.columns();
        let first = |column: &&Column| {
            let name = column.name().as_str();
            name == ID || PLACE.contains(&name)
        };
        let own = |column: &&Column| {
            let name = column.name().as_str();
            name == NOISE || JACOBIAN.contains(&name) || ORIGIN.contains(&name)
        };
        let before: Vec<Column> = all.iter().filter(first).cloned().collect();
        let after = all.iter().filter(|column| !first(column) && !own(column));
        (before, after.cloned().collect())
    }
}

pub(crate) fn table(
    path: &Path,
    head: Head,
    columns: Vec<Column>,
) -> Result<StampTable, FileError> {
    let columns = frame(columns).map_err(|error| FileError::new(path, error))?;
    Ok(StampTable { head, columns })
}
