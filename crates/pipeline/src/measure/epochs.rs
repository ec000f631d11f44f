//! The images of a set as epochs of the galaxies of its first image.

use std::collections::HashMap;
use std::path::Path;

use shearq_dataset::great3;
use shearq_dataset::grid::Mosaic;
use shearq_dataset::images::ImageId;
use shearq_dataset::layout::DataFolder;
use shearq_files::FileError;
use shearq_files::table::numbers;
use shearq_measure::{
    KnownNoise, Lazy, LazyStamps, Measurer, Psfs, Session, StampRows, StampSource, Threads, Warning,
};
use shearq_quantities::Jacobian;

use super::source::{ImageSource, squares, stamp_rows};
use crate::PipelineError;
use crate::gather::subpixel_offset;
use crate::stamp_table::{ID, PLACE, StampTable};

// Distance up to which two places on the sky are one galaxy. Chosen by hand: half of the seeing.
const SAME_GALAXY_ARCSEC: f64 = 0.5;
// Distance from which places of one identity are two galaxies. Chosen by hand.
const OTHER_GALAXY_ARCSEC: f64 = 3.0;

/// An image whose stamps are read in the order of the galaxies of the first epoch.
pub(super) struct EpochSource {
    pub(super) image: ImageSource,
    rows: StampRows,
    /// The stamp of each galaxy, if it has one.
    tiles: Vec<Option<usize>>,
    offsets: Vec<[f64; 2]>,
    is_great3: bool,
}

/// Opens the images of epochs.
pub(super) fn open(
    data: &DataFolder,
    ids: &[ImageId],
    measurer: &Measurer,
) -> Result<Vec<EpochSource>, PipelineError> {
    let mut sources: Vec<EpochSource> = Vec::new();
    let mut first: Option<(ImageId, Galaxies)> = None;
    let most = measurer.max_epoch_offset();
    for &id in ids {
        let image = ImageSource::open(data, id, measurer.configuration())?;
        let (path, mosaic) = (data.stamps(id.set, id.image), image.mosaic());
        let galaxies = Galaxies::read(&path, image.table.as_ref())?;
        let tiles = match &first {
            None => (0..mosaic.galaxies).map(Some).collect(),
            Some((of, first)) => first.find_in(*of, &galaxies, &path)?,
        };
        let offsets = match (data.layout().great3, &image.table) {
            (Some(_), _) => Some(vec![
                great3::dither(data.root(), id.set, id.image, most)?;
                mosaic.galaxies
            ]),
            (None, Some(table)) => offsets(table, &path, mosaic.stamp)?,
            (None, None) => None,
        };
        let mosaic = sources.first().map_or(mosaic, |first| first.image.mosaic());
        sources.push(EpochSource {
            rows: stamp_rows(mosaic),
            offsets: ordered(&tiles, offsets.as_deref().unwrap_or(&[])),
            tiles,
            image,
            is_great3: data.layout().great3.is_some(),
        });
        first.get_or_insert((id, galaxies));
    }
    Ok(sources)
}

/// Values of stamps in the order of galaxies; a galaxy without a stamp gets any, because its pixels are missing.
fn ordered<T: Copy + Default>(tiles: &[Option<usize>], of_stamps: &[T]) -> Vec<T> {
    let any = of_stamps.first().copied().unwrap_or_default();
    let of = |tile: &Option<usize>| tile.and_then(|tile| of_stamps.get(tile)).copied();
    tiles.iter().map(|tile| of(tile).unwrap_or(any)).collect()
}

// Of the galaxies from the centres of stamps that were cut from an exposure to whole pixels.
fn offsets(
    table: &StampTable,
    path: &Path,
    side: usize,
) -> Result<Option<Vec<[f64; 2]>>, FileError> {
    let [x, y, ..] = PLACE;
    if [x, y]
        .iter()
        .any(|name| table.columns.column(name).is_err())
    {
        return Ok(None);
    }
    let (x, y) = (
        numbers(&table.columns, x, path)?,
        numbers(&table.columns, y, path)?,
    );
    let shift = f64::from(table.head.first_pixel) - 1.0;
    let places = x.iter().zip(&*y).map(|(x, y)| (x - shift, y - shift));
    Ok(Some(
        places.map(|place| subpixel_offset(place, side)).collect(),
    ))
}

/// Identities of galaxies, which show their type, and degrees on the sky, by which epochs are joined.
struct Galaxies {
    ids: Option<Vec<String>>,
    sky: Option<[Vec<f64>; 2]>,
}

impl Galaxies {
    fn read(path: &Path, table: Option<&StampTable>) -> Result<Self, FileError> {
        let Some(StampTable { columns, .. }) = table else {
            return Ok(Galaxies {
                ids: None,
                sky: None,
            });
        };
        let ids = columns.column(ID).ok().map(|column| {
            let value = |row| column.get(row).map(|value| value.to_string());
            (0..column.len()).map(value).collect::<Result<Vec<_>, _>>()
        });
        let ids = ids.transpose();
        let [_, _, ra, dec] = PLACE;
        let sky = match columns.column(ra) {
            Ok(_) => Some([
                numbers(columns, ra, path)?.into_owned(),
                numbers(columns, dec, path)?.into_owned(),
            ]),
            Err(_) => None,
        };
        Ok(Galaxies {
            ids: ids.map_err(|error| FileError::new(path, error))?,
            sky,
        })
    }

    /// The row of each of these galaxies, which are of image `first`, in the table of another epoch.
    fn find_in(
        &self,
        first: ImageId,
        other: &Galaxies,
        path: &Path,
    ) -> Result<Vec<Option<usize>>, FileError> {
        let fault = |message: String| Err(FileError::new(path, message));
        let found = match (&self.ids, &other.ids, &self.sky, &other.sky) {
            (Some(ids), Some(others), ..) => by_identity(ids, others),
            (_, _, Some(sky), Some(others)) => by_place(sky, others),
            _ => {
                return fault("epochs are joined by the columns id, or ra and dec, which the stamps of one of the images have not (expected them in all images of the set). Try: gather --positions with such columns".to_owned());
            }
        };
        let found = found.map_err(|message| FileError::new(path, message))?;
        let count = other.ids.as_ref().map_or_else(
            || other.sky.as_ref().map_or(0, |[ra, _]| ra.len()),
            Vec::len,
        );
        let mut known = vec![false; count];
        found.iter().flatten().for_each(|row| known[*row] = true);
        let missing = known.iter().filter(|known| !**known).count();
        if let Some(row) = known.iter().position(|known| !known) {
            let name = match (&other.ids, &other.sky) {
                (Some(ids), _) => format!("id {}", ids[row]),
                (None, Some([ra, dec])) => format!("ra {}, dec {}", ra[row], dec[row]),
                _ => format!("row {}", row + 1),
            };
            return fault(format!(
                "{missing} of {count} galaxies, such as {name}, are not in image {} (expected epochs of the galaxies of the first image of the set). Try: one table of positions for all exposures, or another set",
                first.image
            ));
        }
        if let (Some(sky), Some(others)) = (&self.sky, &other.sky) {
            for (galaxy, row) in found.iter().enumerate() {
                let Some(row) = row else { continue };
                let [here, there] = [at(sky, galaxy), at(others, *row)];
                let apart = arcsec(here, there);
                if apart > OTHER_GALAXY_ARCSEC {
                    let id = other.ids.as_ref().map_or("", |ids| &ids[*row]);
                    return fault(format!(
                        "the galaxy of id {id} is {apart:.1}″ from the one of image {} (expected the same galaxy). Try: identities that are the same on all exposures",
                        first.image
                    ));
                }
            }
        }
        Ok(found)
    }
}

fn by_identity(ids: &[String], others: &[String]) -> Result<Vec<Option<usize>>, String> {
    let mut rows = HashMap::new();
    for (row, id) in others.iter().enumerate() {
        if let Some(first) = rows.insert(id, row) {
            return Err(format!(
                "the id {id} is in rows {} and {} (expected one row per galaxy)",
                first + 1,
                row + 1
            ));
        }
    }
    Ok(ids.iter().map(|id| rows.get(id).copied()).collect())
}

fn at([ra, dec]: &[Vec<f64>; 2], row: usize) -> [f64; 2] {
    [ra[row], dec[row]]
}

// Between places that are near each other.
fn arcsec([ra1, dec1]: [f64; 2], [ra2, dec2]: [f64; 2]) -> f64 {
    let around = (ra1 - ra2 + 540.0).rem_euclid(360.0) - 180.0;
    let east = around * (0.5 * (dec1 + dec2)).to_radians().cos();
    3600.0 * east.hypot(dec1 - dec2)
}

fn by_place(sky: &[Vec<f64>; 2], others: &[Vec<f64>; 2]) -> Result<Vec<Option<usize>>, String> {
    let mut order: Vec<usize> = (0..others[1].len()).collect();
    order.sort_by(|a, b| others[1][*a].total_cmp(&others[1][*b]));
    let within = SAME_GALAXY_ARCSEC / 3600.0;
    let find = |galaxy: usize| {
        let place = at(sky, galaxy);
        let first = order.partition_point(|row| others[1][*row] < place[1] - within);
        let near = order[first..]
            .iter()
            .take_while(|row| others[1][**row] <= place[1] + within);
        let mut near = near.filter(|row| arcsec(place, at(others, **row)) <= SAME_GALAXY_ARCSEC);
        let found = near.next().copied();
        match near.next() {
            None => Ok(found),
            Some(_) => Err(format!(
                "two galaxies are within {SAME_GALAXY_ARCSEC}″ of ra {}, dec {} (expected one). Try: a column id",
                place[0], place[1]
            )),
        }
    };
    (0..sky[0].len()).map(find).collect()
}

impl EpochSource {
    /// The session of the image, for a measurer of the configuration that it was opened for.
    pub(super) fn session(
        &mut self,
        measurer: &Measurer,
        threads: &impl Threads,
    ) -> Result<Session<'static>, PipelineError> {
        let noise = match std::mem::take(&mut self.image.noise) {
            KnownNoise::StatedEach(levels) => {
                KnownNoise::StatedEach(ordered(&self.tiles, &levels).into())
            }
            other => other,
        };
        let session = Session::open(measurer, self, noise, threads);
        session.map_err(|error| self.image.named(error))
    }

    fn tiles(&self, row: usize) -> &[Option<usize>] {
        &self.tiles[self.rows.stamps(row)]
    }

    /// Whether a row of galaxies is the same row of the image.
    fn is_whole(&self, row: usize) -> bool {
        let Mosaic { columns, .. } = self.image.mosaic();
        let first = row * columns;
        let mut here = self.tiles(row).iter().enumerate();
        columns == self.rows.columns && here.all(|(k, tile)| *tile == Some(first + k))
    }
}

impl StampSource<'static> for EpochSource {
    type Error = PipelineError;

    fn rows(&self) -> StampRows {
        self.rows
    }

    fn warnings(&self) -> Vec<Warning> {
        self.image.warnings()
    }

    fn stamps(&mut self, row: usize) -> Result<LazyStamps<'static>, PipelineError> {
        if self.is_whole(row) {
            return self.image.stamps(row);
        }
        let Mosaic { columns, stamp, .. } = self.image.mosaic();
        let tiles = self.tiles[self.rows.stamps(row)].to_vec();
        Ok(squares(&mut self.image.image, (columns, stamp), &tiles, f64::NAN)?.into())
    }

    fn psfs(&mut self, row: usize) -> Result<Lazy<'static, Psfs<'static>>, PipelineError> {
        if self.is_whole(row) {
            return self.image.psfs(row);
        }
        let columns = self.image.mosaic().columns;
        let tiles = self.tiles[self.rows.stamps(row)].to_vec();
        Ok(self.image.psfs.of_tiles(columns, &tiles)?.into())
    }

    fn jacobians(&mut self, row: usize) -> Result<Option<Vec<Jacobian>>, PipelineError> {
        let tiles = self.tiles(row);
        let all = self.image.jacobians.as_ref();
        Ok(all.map(|all| {
            let of = |tile: &Option<usize>| all[tile.unwrap_or(0)];
            tiles.iter().map(of).collect()
        }))
    }

    fn offsets(&mut self, row: usize) -> Result<Option<Vec<[f64; 2]>>, PipelineError> {
        Ok(Some(self.offsets[self.rows.stamps(row)].to_vec()))
    }

    fn gain(&self) -> Option<f64> {
        self.image.gain()
    }

    // Exposures of a survey may have a zero point each.
    fn has_common_flux(&self) -> bool {
        self.is_great3
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn galaxies(ids: Option<&[&str]>, sky: &[[f64; 2]]) -> Galaxies {
        let own = |id: &&str| (*id).to_owned();
        let axis = |axis: usize| sky.iter().map(|place| place[axis]).collect();
        Galaxies {
            ids: ids.map(|ids| ids.iter().map(own).collect()),
            sky: (!sky.is_empty()).then(|| [axis(0), axis(1)]),
        }
    }

    fn find(first: &Galaxies, other: &Galaxies) -> Result<Vec<Option<usize>>, String> {
        let id = ImageId { set: 1, image: 1 };
        let found = first.find_in(id, other, Path::new("stamps-002.parquet"));
        found.map_err(|error| error.to_string())
    }

    #[test]
    fn epochs_are_joined_by_identity_or_place() {
        let first = galaxies(Some(&["7", "8", "9"]), &[]);
        let found = find(&first, &galaxies(Some(&["9", "7"]), &[]));
        assert_eq!(found, Ok(vec![Some(1), None, Some(0)]));
        // Across the meridian, and 0.1″ apart.
        let first = galaxies(None, &[[359.999_99, 60.0], [12.0, -5.0]]);
        let other = galaxies(None, &[[12.0, -5.0], [0.000_02, 60.0]]);
        assert_eq!(find(&first, &other), Ok(vec![Some(1), Some(0)]));
    }

    #[test]
    fn epochs_of_other_galaxies_are_refused() {
        let first = galaxies(Some(&["7", "8"]), &[[12.0, 1.0], [12.1, 1.0]]);
        let message = |other: &Galaxies| find(&first, other).unwrap_err();
        let text = message(&galaxies(Some(&["\"7\""]), &[]));
        assert!(
            text.contains("1 of 1 galaxies, such as id \"7\", are not in image 1"),
            "{text}"
        );
        let text = message(&galaxies(Some(&["7"]), &[[12.1, 1.0]]));
        assert!(
            text.contains("id 7 is 359.9″ from the one of image 1"),
            "{text}"
        );
        let text = message(&galaxies(Some(&["7", "7"]), &[]));
        assert!(text.contains("the id 7 is in rows 1 and 2"), "{text}");
        let text = message(&galaxies(None, &[]));
        assert!(
            text.contains("joined by the columns id, or ra and dec"),
            "{text}"
        );
        let twice = galaxies(None, &[[12.0, 1.0], [12.0, 1.000_05]]);
        let text = find(&galaxies(None, &[[12.0, 1.0]]), &twice).unwrap_err();
        assert!(text.contains("two galaxies are within 0.5″"), "{text}");
    }
}
