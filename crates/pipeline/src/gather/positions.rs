//! Positions of galaxies on an exposure: finding their columns in a table, and checking them.

use std::collections::HashMap;
use std::path::Path;

use shearq_files::frames::polars::{Column, DataFrame, DataType};
use shearq_files::table::{self, Columns, FileFormat, MAX_ROWS, Named, Place};
use shearq_files::{FileError, frames, names_of};
use shearq_measure::{Observables, ShearedCatalogues};

use crate::measure::COLUMNS;
use crate::stamp_table;
use crate::wcs::Wcs;

// Names of columns of positions in pixels counted from 1, the best first, in any case.
const PIXEL_NAMES: [[&str; 2]; 6] = [
    ["x", "y"],
    ["xwin_image", "ywin_image"],
    ["x_image", "y_image"],
    ["xwin_image_dbl", "ywin_image_dbl"],
    ["x_image_dbl", "y_image_dbl"],
    ["xpsf_image", "ypsf_image"],
];
// Names of columns of positions that count from 0, of photutils, in any case.
const NAMES_FROM_ZERO: [[&str; 2]; 3] = [
    ["xcentroid", "ycentroid"],
    ["x_centroid", "y_centroid"],
    ["x_fit", "y_fit"],
];
// Names of columns of identities, in any case, the best first.
const ID_NAMES: [&str; 4] = ["id", "object_id", "source_id", "number"];
// Names of columns of right ascension and declination in degrees, in any case.
const SKY_NAMES: [[&str; 2]; 8] = [
    ["ra", "dec"],
    ["ra_deg", "dec_deg"],
    ["alpha_j2000", "delta_j2000"],
    ["alphawin_j2000", "deltawin_j2000"],
    ["alpha_sky", "delta_sky"],
    ["right_ascension", "declination"],
    ["coord_ra", "coord_dec"],
    ["raj2000", "dej2000"],
];
// Distance in pixels below which two positions have the same galaxy: stamps are cut to half a pixel.
const SAME_GALAXY_PX: f64 = 0.5;

// Distance in pixels from which x, y and ra, dec are places of two galaxies. Chosen by hand: isophotal and windowed centroids differ
// by less.
const OTHER_GALAXY_PX: f64 = 3.0;

#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Table<'a> {
    /// The file, with `[TABLE]` behind its name if one of its tables is meant.
    #[serde(serialize_with = "super::files::shown")]
    pub path: &'a Path,
    /// Name or number of the table of a FITS file.
    pub table: Option<&'a str>,
    /// Names of the columns for x and y, or for right ascension and declination, or their numbers in a text table without
    /// names; without, known names.
    pub columns: Option<[&'a str; 2]>,
    /// Whether the columns are right ascension and declination in degrees, whatever their names.
    pub degrees: bool,
    /// Name of the column of identities; without, a known name.
    pub id: Option<&'a str>,
    /// Names of further columns for the catalogue.
    pub carry: &'a [String],
}

pub(super) struct Positions {
    place: Place,
    /// In FITS pixels: the centre of the first is at 1. [`ELSEWHERE`] where the WCS does not reach.
    pub(super) all: Vec<(f64, f64)>,
    /// In degrees, if the table or the WCS has them.
    pub(super) sky: Option<[Vec<f64>; 2]>,
    pub(super) id: Option<Column>,
    pub(super) carried: Vec<Column>,
    /// Whether the table has them in degrees.
    pub(super) degrees: bool,
    /// Which columns they are, if the user did not name them.
    pub(super) note: Option<String>,
}

impl Positions {
    /// Reads positions, whose first pixel is `first_pixel`, on an exposure with this WCS.
    pub(super) fn read(
        table: Table<'_>,
        exposure: &Path,
        wcs: &Wcs,
        first_pixel: u8,
    ) -> Result<Self, FileError> {
        let mut place = Place::with_table(table.path, table.table)?;
        let columns = table::columns(&place)?;
        let [x, y] = match table.columns {
            Some(names) => given(&place, &columns, names)?,
            None => known(&mut place, &columns, (exposure, wcs), table.degrees)?,
        };
        let names = names_in(&columns, &place, [&x, &y]);
        let degrees = table.degrees || SKY_NAMES.iter().any(|pair| is_pair(pair, [&x, &y]));
        let sky = if degrees {
            None
        } else {
            pair_of(&SKY_NAMES, names)
        };
        let id = match table.id {
            Some(id) => Some(id.to_owned()),
            None => ID_NAMES.iter().find_map(|id| find(names, id)),
        };
        if x == y {
            let message = format!("the column `{x}` is asked for twice");
            return Err(FileError::new(&place.path, message));
        }
        let mut reals: Vec<&str> = vec![&x, &y];
        reals.extend(sky.iter().flatten().map(String::as_str));
        let (wanted, texts) = selection(&place, reals, id.as_ref(), table.carry)?;
        let read = read_all(&place, &wanted, &texts)
            .map_err(|error| error.hint_of_columns("--columns X,Y names others"))?;
        let of = |name: &str, is_sky| place_numbers((&place, &columns), &read, name, is_sky);
        let (xs, ys) = (of(&x, degrees)?, of(&y, degrees)?);
        let given = xs.iter().copied().zip(ys.iter().copied());
        let (all, sky) = match degrees {
            true => {
                let at = |(row, sky)| on_exposure(&place.path, row, sky, exposure, wcs);
                let all = given.enumerate().map(at);
                (
                    all.collect::<Result<Vec<_>, _>>()?,
                    Some([xs.clone(), ys.clone()]),
                )
            }
            false => {
                // FITS pixels, counted from 1, in all that follows.
                let shift = 1.0 - f64::from(first_pixel);
                let all: Vec<_> = given.map(|(x, y)| (x + shift, y + shift)).collect();
                let sky = match &sky {
                    Some([ra, dec]) => Some([of(ra, true)?, of(dec, true)?]),
                    None => {
                        let at = all
                            .iter()
                            .map(|&(x, y)| wcs.sky([x, y]).map(|[ra, dec]| (ra, dec)));
                        let both: Option<(Vec<f64>, Vec<f64>)> = at.collect();
                        both.map(|(ra, dec)| [ra, dec])
                    }
                };
                (all, sky)
            }
        };
        if let Some([ra, dec]) = &sky {
            check_degrees(&place.path, ra, dec)?;
        }
        // Larger positions would overflow the indices of pixels.
        let most = f64::from(i32::MAX);
        let wrong = |(x, y): &(f64, f64)| !(x.abs() < most && y.abs() < most);
        if let Some(row) = all.iter().position(wrong) {
            let (x, y) = (xs[row], ys[row]);
            let message = format!(
                "row {}: the position is ({x}, {y}); expected pixels of the exposure",
                row + 1
            );
            return Err(FileError::new(&place.path, message));
        }
        let (id, carried) = id_and_carried(&place, &read, id.as_ref(), table.carry)?;
        let note = table.columns.is_none().then(|| note(&place, [&x, &y]));
        Ok(Positions {
            place,
            all,
            sky,
            id,
            carried,
            degrees,
            note: note.flatten(),
        })
    }

    /// Whether the centres are on an exposure of this size.
    pub(super) fn inside(&self, [width, height]: [usize; 2]) -> Vec<bool> {
        let within = |at: f64, side: usize| at >= 0.5 && at < side as f64 + 0.5;
        let inside = self
            .all
            .iter()
            .map(|&(x, y)| within(x, width) && within(y, height));
        inside.collect()
    }

    /// Leaves out rows that are not to be kept, and returns what is said about them. Catalogues of a field are larger than the
    /// exposure, and stamps without pixels would fill the folder.
    pub(super) fn keep(&mut self, kept: &[bool]) -> Result<Option<String>, FileError> {
        let (count, left_out) = (kept.len(), kept.iter().filter(|kept| !**kept).count());
        if left_out == 0 {
            return Ok(None);
        }
        fn chosen<T: Copy>(all: &[T], kept: &[bool]) -> Vec<T> {
            let both = all.iter().zip(kept);
            both.filter_map(|(value, kept)| kept.then_some(*value))
                .collect()
        }
        self.all = chosen(&self.all, kept);
        if let Some(sky) = &mut self.sky {
            sky.iter_mut().for_each(|axis| *axis = chosen(axis, kept));
        }
        let mask = kept.iter().copied().collect();
        let path = &self.place.path;
        for column in self.id.iter_mut().chain(&mut self.carried) {
            *column = column
                .filter(&mask)
                .map_err(|error| FileError::new(path, error))?;
        }
        let line = FileError::new(
            path,
            format!("{left_out} of {count} positions are outside the exposure and left out"),
        );
        Ok(Some(match !self.degrees && 10 * left_out > count {
            true => format!("warning: {}", line.hint("check --columns and --exposure")),
            false => format!("note: {line}"),
        }))
    }

    /// Warnings about the positions on an exposure of this WCS and size.
    pub(super) fn examine(
        &self,
        exposure: &Path,
        wcs: &Wcs,
        [width, height]: [usize; 2],
    ) -> Result<Vec<String>, FileError> {
        let path = &self.place.path;
        let count = self.all.len();
        let inside = self.inside([width, height]);
        let beyond = inside.iter().filter(|inside| !**inside).count();
        let (repeated, first) = self.repeated(&inside);
        let degrees = !self.degrees
            && self
                .all
                .iter()
                .all(|(x, y)| (0.0..=360.0).contains(x) && y.abs() <= 90.0);
        // Degrees that are read as pixels all lie within a few pixels of each other, even if these are on the exposure.
        if beyond == count || degrees && count > 2 && 2 * repeated > count {
            let what = match beyond == count {
                true => format!("all {count} positions are outside the exposure"),
                false => format!(
                    "{repeated} of {count} positions are within {SAME_GALAXY_PX} px of an earlier one"
                ),
            };
            let (x, y) = self.all[0];
            let pixels = format!(
                "(found ({x}, {y}) first, expected FITS pixels of {}, 1 to {width} and 1 to {height}{})",
                exposure.display(),
                match wcs.section() {
                    Some(keys) => format!("; it is a section of a larger image, by {keys}"),
                    None => String::new(),
                }
            );
            let (message, hint) = match (&self.sky, degrees) {
                (Some([ra, dec]), _) if self.degrees => (
                    format!(
                        "{what} (found ra {}, dec {} first, expected places on {})",
                        ra[0],
                        dec[0],
                        exposure.display()
                    ),
                    "check the positions and the WCS of the exposure",
                ),
                (_, true) => (
                    format!(
                        "{what} {pixels}. Are these degrees (right ascension and declination)?"
                    ),
                    "--degrees, which uses the WCS of the exposure",
                ),
                (_, false) => (
                    format!("{what} {pixels}. Are these positions of another image?"),
                    "name the columns with --columns X,Y",
                ),
            };
            return Err(FileError::new(path, message).hint(hint));
        }
        self.check_sky(exposure, wcs, &inside)?;
        let mut doubts = Vec::new();
        if let Some(keys) = wcs.section().filter(|_| !self.degrees) {
            doubts.push(format!(
                "note: {} is a section of a larger image, by {keys}: positions count from the first pixel of the section",
                exposure.display()
            ));
        }
        if let Some((earlier, later)) = first {
            let (x, y) = self.all[later];
            let message = format!(
                "{repeated} of {count} positions are within {SAME_GALAXY_PX} px of an earlier one (the first is row {} at ({x}, {y}), like row {}). Each row counts as a galaxy",
                later + 1,
                earlier + 1
            );
            let warning = FileError::new(path, message).hint("remove duplicates");
            doubts.push(format!("warning: {warning}"));
        }
        Ok(doubts)
    }

    /// Refuses positions in pixels that differ from ra and dec on the exposure, as in a table of another exposure or of a coadd,
    /// or with rows in another order. Epochs are joined by ra and dec, and shears are averaged by them.
    fn check_sky(&self, exposure: &Path, wcs: &Wcs, inside: &[bool]) -> Result<(), FileError> {
        let Some([ra, dec]) = self.sky.as_ref().filter(|_| wcs.has_sky()) else {
            return Ok(());
        };
        let rows = self.all.iter().enumerate().filter(|(row, _)| inside[*row]);
        let apart = rows.filter_map(|(row, &(x, y))| {
            let sky = [ra[row], dec[row]];
            if sky.iter().any(|degrees| degrees.is_nan()) {
                return None;
            }
            let by_sky = wcs.pixel(sky);
            let distance =
                by_sky.map_or(f64::INFINITY, |by_sky| (x - by_sky[0]).hypot(y - by_sky[1]));
            (distance > OTHER_GALAXY_PX).then_some((row, distance))
        });
        let apart: Vec<(usize, f64)> = apart.collect();
        let Some(&(row, distance)) = apart.iter().max_by(|a, b| a.1.total_cmp(&b.1)) else {
            return Ok(());
        };
        let ((x, y), exposure) = (self.all[row], exposure.display());
        let message = format!(
            "row {}: x and y are {distance:.0} px from where the WCS of {exposure} has ra and dec (found ({x}, {y}) for ({}, {}), one of {} rows more than {OTHER_GALAXY_PX} px away; expected one place)",
            row + 1,
            ra[row],
            dec[row],
            apart.len()
        );
        Err(FileError::new(&self.place.path, message)
            .hint("--degrees, which uses ra and dec, or --columns with x and y on this exposure"))
    }

    // A galaxy that is measured twice counts twice in the mean, as if its noise were independent.
    fn repeated(&self, inside: &[bool]) -> (usize, Option<(usize, usize)>) {
        // Two positions in one cell are nearer than SAME_GALAXY_PX. So a cell has at most one that is no repetition, and others
        // of it lie at most two cells away.
        let side = SAME_GALAXY_PX / std::f64::consts::SQRT_2;
        let mut kept: HashMap<(i64, i64), usize> = HashMap::with_capacity(self.all.len());
        let (mut count, mut first) = (0, None);
        for (k, &(x, y)) in self.all.iter().enumerate().filter(|(k, _)| inside[*k]) {
            let cell = ((x / side).floor() as i64, (y / side).floor() as i64);
            let near = (-2..=2).flat_map(|dx| (-2..=2).map(move |dy| (dx, dy)));
            let mut others = near.filter_map(|(dx, dy)| kept.get(&(cell.0 + dx, cell.1 + dy)));
            let same = others.find(|&&other| {
                let (ox, oy) = self.all[other];
                (x - ox).hypot(y - oy) <= SAME_GALAXY_PX
            });
            match same.copied() {
                Some(other) => {
                    count += 1;
                    first.get_or_insert((other, k));
                }
                None => {
                    kept.insert(cell, k);
                }
            }
        }
        (count, first)
    }
}

/// Identities, places and further columns of `count` stamps that are not cut out, a row for each in their order.
pub(super) fn rows_of_stamps(table: Table<'_>, count: usize) -> Result<Vec<Column>, FileError> {
    let place = Place::with_table(table.path, table.table)?;
    let columns = table::columns(&place)?;
    let fault = |message: String| FileError::new(&place.path, message);
    // Comments of a text table may look like names. Any of several tables of a FITS file may have one row per stamp.
    let mut certain = columns.named.iter().filter(|named| !named.doubtful);
    let names = match (certain.next(), certain.next()) {
        (Some(named), None) => &named.names,
        (found, _) => {
            let found = found.map_or("no names of columns", |_| "several tables");
            return Err(
                fault(format!("found {found}; expected one table with names"))
                    .hint("--table with a name or a number"),
            );
        }
    };
    let id = match table.id {
        Some(id) => Some(id.to_owned()),
        None => ID_NAMES.iter().find_map(|id| find(names, id)),
    };
    let (pixels, sky) = (pair_of(&PIXEL_NAMES, names), pair_of(&SKY_NAMES, names));
    let places: Vec<(&str, &String)> = stamp_table::PLACE
        .into_iter()
        .zip([&pixels, &sky].into_iter().flat_map(|pair| match pair {
            Some([a, b]) => [Some(a), Some(b)],
            None => [None; 2],
        }))
        .filter_map(|(name, column)| Some((name, column?)))
        .collect();
    if id.is_none() && places.is_empty() && table.carry.is_empty() {
        return Err(fault(format!(
            "no column identifies the stamps (found {}; expected id, x and y, or ra and dec)",
            names_of(names)
        ))
        .hint("--id or --carry with a name"));
    }
    let reals = places.iter().map(|(_, column)| column.as_str()).collect();
    let (wanted, texts) = selection(&place, reals, id.as_ref(), table.carry)?;
    let read = read_all(&place, &wanted, &texts)?;
    if read.height() != count {
        return Err(fault(format!(
            "{} rows for {count} stamps; expected one row per stamp, in the same order",
            read.height()
        )));
    }
    let of = |name: &str, is_sky| place_numbers((&place, &columns), &read, name, is_sky);
    if let Some([ra, dec]) = &sky {
        check_degrees(&place.path, &of(ra, true)?, &of(dec, true)?)?;
    }
    let (id, carried) = id_and_carried(&place, &read, id.as_ref(), table.carry)?;
    let mut all: Vec<Column> = id.into_iter().collect();
    for (name, column) in places {
        let is_sky = stamp_table::PLACE[2..].contains(&name);
        all.push(Column::new(name.into(), of(column, is_sky)?));
    }
    all.extend(carried);
    Ok(all)
}

// The columns x and y of stamps that are not cut out.
pub(super) fn pixels_of_rows(rows: &[Column]) -> Option<Vec<(f64, f64)>> {
    let of = |wanted: &str| {
        let column = rows.iter().find(|column| column.name() == wanted);
        column.and_then(frames::reals)
    };
    let [x, y, ..] = stamp_table::PLACE;
    let (x, y) = (of(x)?, of(y)?);
    Some(x.iter().copied().zip(y.iter().copied()).collect())
}

// Right ascensions may count from −180.
fn check_degrees(path: &Path, ra: &[f64], dec: &[f64]) -> Result<(), FileError> {
    let is_wrong = |(ra, dec): (&f64, &f64)| {
        !(-180.0..=360.0).contains(ra) && !ra.is_nan() || dec.abs() > 90.0
    };
    match ra.iter().zip(dec).position(is_wrong) {
        None => Ok(()),
        Some(row) => {
            let message = format!(
                "row {}: ra and dec are ({}, {}); expected degrees, −180 to 360 and −90 to 90",
                row + 1,
                ra[row],
                dec[row]
            );
            Err(FileError::new(path, message)
                .hint("correct the table, or rename columns of other quantities"))
        }
    }
}

/// Names of all columns to read, each once, and of those among them that keep texts and all digits of integers.
fn selection<'n>(
    place: &Place,
    reals: Vec<&'n str>,
    id: Option<&'n String>,
    carry: &'n [String],
) -> Result<(Vec<&'n str>, Vec<&'n str>), FileError> {
    if let Some(name) = carry.iter().find(|name| is_taken(name)) {
        let message = format!(
            "the column `{name}` cannot be carried, because catalogues have one of this name"
        );
        return Err(FileError::new(&place.path, message).hint("rename it in the table"));
    }
    if let Some(name) = carry
        .iter()
        .enumerate()
        .find_map(|(k, name)| carry[..k].contains(name).then_some(name))
    {
        let message = format!("--carry names the column `{name}` twice; expected every name once");
        return Err(FileError::new(&place.path, message));
    }
    let mut wanted = reals;
    let mut texts = Vec::new();
    // A column may be the identity and carried, too, and must be read once.
    for name in id.into_iter().chain(carry).map(String::as_str) {
        if !wanted.contains(&name) {
            wanted.push(name);
            texts.push(name);
        }
    }
    Ok((wanted, texts))
}

fn id_and_carried(
    place: &Place,
    read: &DataFrame,
    id: Option<&String>,
    carry: &[String],
) -> Result<(Option<Column>, Vec<Column>), FileError> {
    let column = |name: &String| {
        let column = read.column(name).cloned();
        column.map_err(|error| FileError::new(&place.path, error))
    };
    let id = id.map(|id| identities(&place.path, column(id)?));
    let carried = carry.iter().map(column).collect::<Result<_, _>>()?;
    Ok((id.transpose()?, carried))
}

// Users must be able to see which of several columns of positions was taken.
fn note(place: &Place, names: [&String; 2]) -> Option<String> {
    let [x, y] = names.map(String::as_str);
    let shown = place.path.display();
    let shown = format!("{shown}: positions from the columns {x} and {y}");
    match place.table.as_deref() {
        None => ((x, y) != ("x", "y")).then_some(shown),
        Some(table) => Some(format!("{shown} of table {table}")),
    }
}

// An error if positions on the sky have no WCS.
fn no_sky<T>(path: &Path, exposure: &Path, wcs: &Wcs) -> Result<T, FileError> {
    let found = match wcs.fault() {
        Some(fault) => format!("{}: {fault}", exposure.display()),
        None => format!(
            "the header of {} has no WCS (expected TAN, TAN-SIP, TPV, SIN, STG or CAR)",
            exposure.display()
        ),
    };
    let message = format!("the positions are right ascensions and declinations; {found}");
    Err(FileError::new(path, message).hint("columns in pixels, --columns X,Y"))
}

fn on_exposure(
    path: &Path,
    row: usize,
    (ra, dec): (f64, f64),
    exposure: &Path,
    wcs: &Wcs,
) -> Result<(f64, f64), FileError> {
    if !wcs.has_sky() {
        return no_sky(path, exposure, wcs);
    }
    if !(ra.is_finite() && dec.abs() <= 90.0) {
        let row = row + 1;
        let message = format!(
            "row {row}: the position is ({ra}, {dec}); expected right ascension and declination in degrees"
        );
        return Err(FileError::new(path, message));
    }
    // Far from the exposure the projection ends.
    let most = f64::from(i32::MAX);
    let pixel = wcs
        .pixel([ra, dec])
        .filter(|at| at.iter().all(|at| at.abs() < most));
    Ok(pixel.map_or(ELSEWHERE, |[x, y]| (x, y)))
}

// The place of a galaxy that is not on the pixels of an exposure, or its projection.
// Finite, because stamps are cut there, too, if another exposure has the galaxy.
const ELSEWHERE: (f64, f64) = (-1e9, -1e9);

fn given(place: &Place, columns: &Columns, names: [&str; 2]) -> Result<[String; 2], FileError> {
    let owned = names.map(str::to_owned);
    let numbers = names.iter().all(|name| name.parse::<usize>().is_ok());
    let has = |named: &Named| {
        names
            .iter()
            .all(|name| named.names.iter().any(|n| n == name))
    };
    if columns.unnamed.is_empty() || numbers || columns.named.iter().any(has) {
        return Ok(owned);
    }
    Err(FileError::new(
        &place.path,
        format!(
            "the columns have no names (found the first row `{}`, expected names such as `{}`)",
            names_of(&columns.unnamed),
            names.join(",")
        ),
    )
    .hint("--columns with the numbers of two columns, as in `1,2`"))
}

/// The columns with known names, or the only two columns: of pixels unless they are `degrees`, or else of the sky. Sets the table
/// that has them.
fn known(
    place: &mut Place,
    columns: &Columns,
    (exposure, wcs): (&Path, &Wcs),
    degrees: bool,
) -> Result<[String; 2], FileError> {
    let pairs = |known: &[[&str; 2]]| -> Vec<(&Named, [String; 2])> {
        let named = columns.named.iter();
        let found = named.filter_map(|named| Some((named, pair_of(known, &named.names)?)));
        found.collect()
    };
    let mut found = match degrees {
        true => Vec::new(),
        false => pairs(&PIXEL_NAMES),
    };
    if found.is_empty() {
        found = pairs(&SKY_NAMES);
        // Of columns that may be the sky's, the WCS is at fault.
        if !found.is_empty() && !wcs.has_sky() {
            return no_sky(&place.path, exposure, wcs);
        }
    }
    match found.as_slice() {
        [(named, pair), others @ ..] if others.is_empty() || named.doubtful => {
            if let Some(head) = &named.table {
                place.table.get_or_insert_with(|| head.number.to_string());
            }
            return Ok(pair.clone());
        }
        [] => {}
        several => {
            let tables: Vec<String> = several
                .iter()
                .filter_map(|(named, _)| Some(named.table.as_ref()?.shown()))
                .collect();
            let message = format!(
                "{} tables have positions (found {}, expected one)",
                several.len(),
                names_of(&tables)
            );
            return Err(FileError::new(&place.path, message).hint("--table with a number"));
        }
    }
    let certain: Vec<&String> = columns
        .named
        .iter()
        .filter(|named| !named.doubtful)
        .flat_map(|named| &named.names)
        .collect();
    if columns.unnamed.len() == 2 {
        return Ok(["1".into(), "2".into()]);
    }
    // Of pixels, two unknown names may be anything.
    if let (true, [first, second]) = (degrees, certain.as_slice()) {
        if !wcs.has_sky() {
            return no_sky(&place.path, exposure, wcs);
        }
        return Ok([first, second].map(|name| (*name).clone()));
    }
    let from_zero = certain.iter().map(|name| (*name).clone());
    let from_zero = pair_of(&NAMES_FROM_ZERO, &from_zero.collect::<Vec<_>>());
    if let Some([x, y]) = from_zero.filter(|_| !degrees) {
        let message = format!(
            "the columns {x} and {y} of photutils count pixels from 0 (expected x and y, which count from 1)"
        );
        let hint = format!("--columns {x},{y} --first-pixel 0");
        return Err(FileError::new(&place.path, message).hint(hint));
    }
    let (found, example) = match certain.as_slice() {
        [] if columns.unnamed.is_empty() => ("no column".into(), "X,Y"),
        [] => {
            let row = names_of(&columns.unnamed);
            (format!("no names and the first row `{row}`"), "2,3")
        }
        names => (names_of(names), "X,Y"),
    };
    Err(FileError::new(
        &place.path,
        format!(
            "cannot determine the columns of the positions (found {found}; expected {})",
            match degrees {
                true => "ra and dec, ALPHA_J2000 and DELTA_J2000, or two columns",
                false => "x and y, X_IMAGE and Y_IMAGE, ra and dec, or two columns without names",
            }
        ),
    )
    .hint(format!("--columns {example}")))
}

/// The first of the `known` pairs of names that a table has.
fn pair_of(known: &[[&str; 2]], names: &[String]) -> Option<[String; 2]> {
    known
        .iter()
        .find_map(|[x, y]| Some([find(names, x)?, find(names, y)?]))
}

fn is_pair(known: &[&str; 2], names: [&String; 2]) -> bool {
    let mut both = known.iter().zip(names);
    both.all(|(known, name)| name.eq_ignore_ascii_case(known))
}

/// The name as the table spells it.
fn find(names: &[String], wanted: &str) -> Option<String> {
    let same = |name: &&String| name.eq_ignore_ascii_case(wanted);
    names.iter().find(same).cloned()
}

/// The names of the table that has these columns.
fn names_in<'c>(columns: &'c Columns, place: &Place, both: [&String; 2]) -> &'c [String] {
    let both = both.map(String::as_str);
    table_with(columns, place, &both).map_or(&[], |named| &named.names)
}

fn table_with<'c>(columns: &'c Columns, place: &Place, all: &[&str]) -> Option<&'c Named> {
    let meant = |named: &&Named| {
        let table = named.table.as_ref().map(|head| head.number.to_string());
        let has = all
            .iter()
            .all(|name| named.names.iter().any(|own| own == name));
        has && (place.table.is_none() || columns.named.len() == 1 || place.table == table)
    };
    columns.named.iter().find(meant)
}

/// Numbers of a column of places, in degrees if they are of the sky and in pixels otherwise.
fn place_numbers(
    (place, columns): (&Place, &Columns),
    read: &DataFrame,
    name: &str,
    is_sky: bool,
) -> Result<Vec<f64>, FileError> {
    let factor = unit_factor(place, columns, name, is_sky)?;
    let values = table::numbers(read, name, &place.path)?;
    Ok(values.iter().map(|own| own * factor).collect())
}

// Units of lengths and angles, in lower case, that are neither degrees nor pixels.
const OTHER_UNITS: [&str; 8] = ["mm", "cm", "m", "um", "arcsec", "arcmin", "mas", "uas"];

/// What makes a column degrees if it is of the sky. A column of another unit than degrees, radians, hours or pixels is refused.
fn unit_factor(
    place: &Place,
    columns: &Columns,
    name: &str,
    is_sky: bool,
) -> Result<f64, FileError> {
    let head = table_with(columns, place, &[name]).and_then(|named| {
        let at = named.names.iter().position(|own| own == name)?;
        named.table.as_ref()?.units.get(at)
    });
    let stated = head.map_or("", |unit| unit.trim());
    let unit = stated.to_ascii_lowercase();
    let (is_angle, factor) = match unit.as_str() {
        "rad" | "radian" | "radians" => (true, 1_f64.to_degrees()),
        "h" | "hr" | "hour" | "hours" | "hourangle" => (true, 15.0),
        unit => (unit.starts_with("deg"), 1.0),
    };
    let is_pixel = unit.starts_with("pix");
    if OTHER_UNITS.contains(&unit.as_str()) || is_angle && !is_sky || is_pixel && is_sky {
        let expected = if is_sky { "deg, rad or h" } else { "pixels" };
        let message = format!("the column `{name}` has the unit {stated} (expected {expected})");
        let hint = match is_angle {
            true => "--degrees, for right ascension and declination",
            false => "convert it, or --columns with others",
        };
        return Err(FileError::new(&place.path, message).hint(hint));
    }
    Ok(factor)
}

/// Whether catalogues or the table of stamps have a column of this name; FITS does not distinguish cases.
fn is_taken(name: &str) -> bool {
    let measured = COLUMNS.iter().map(|(name, _)| *name);
    let own = stamp_table::PLACE.into_iter().chain(stamp_table::JACOBIAN);
    let own = own
        .chain(stamp_table::ORIGIN)
        .chain([stamp_table::ID, "snr", "neighbour"]);
    let mut taken = measured.chain(Observables::COLUMNS).chain(own);
    taken.any(|other| name.eq_ignore_ascii_case(other))
        || ShearedCatalogues::columns().any(|other| name.eq_ignore_ascii_case(&other))
}

/// The columns `wanted`, of which `texts` keep texts and all digits of integers.
fn read_all(place: &Place, wanted: &[&str], texts: &[&str]) -> Result<DataFrame, FileError> {
    let mut all: Option<DataFrame> = None;
    let mut rows = 0;
    table::read_parts(place, wanted, texts, |part| {
        rows += part.height();
        if rows > MAX_ROWS {
            let message = format!("there are {rows} rows or more; expected at most {MAX_ROWS}");
            return Err(FileError::new(&place.path, message));
        }
        match &mut all {
            None => all = Some(part),
            Some(all) => {
                let joined = all.vstack_mut_owned(part).map(drop);
                joined.map_err(|error| FileError::new(&place.path, error))?;
            }
        }
        Ok(())
    })?;
    all.filter(|all| all.height() > 0).ok_or_else(|| {
        let message = "there is no position; expected one per row";
        FileError::new(&place.path, message)
    })
}

/// Identities as 64-bit integers or texts, each of one galaxy.
fn identities(path: &Path, column: Column) -> Result<Column, FileError> {
    let fault = |row: usize, what: String| {
        let message = format!("row {}: {what}; expected one id per galaxy", row + 1);
        FileError::new(path, message).hint("--id with another column, or remove duplicates")
    };
    let column = match column.dtype() {
        // Of text tables, integers beyond 2⁵³ are texts.
        DataType::String if FileFormat::of(path).is_none() => {
            let texts = column.str().map_err(|error| FileError::new(path, error))?;
            let whole = |text: Option<&str>| {
                let number: i64 = text?.parse().ok()?;
                (number.to_string() == text?).then_some(number)
            };
            let all: Option<Vec<i64>> = texts.iter().map(whole).collect();
            all.map_or(column, |all| Column::new("id".into(), all))
        }
        DataType::String => column,
        // Text tables have numbers.
        _ => {
            let whole = column.cast(&DataType::Int64);
            let whole = whole.map_err(|error| FileError::new(path, error))?;
            let (before, after) = (frames::reals(&column), frames::reals(&whole));
            let (Some(before), Some(after)) = (before, after) else {
                return Err(fault(0, format!("the id is a {}", column.dtype())));
            };
            let differs = |(a, b): (&f64, &f64)| a != b && !a.is_nan();
            if let Some(row) = before.iter().zip(&*after).position(differs) {
                let what = format!("the id {} is no 64-bit integer", before[row]);
                return Err(fault(row, what));
            }
            whole
        }
    };
    let mut seen = HashMap::new();
    for row in 0..column.len() {
        let value = column
            .get(row)
            .map_err(|error| FileError::new(path, error))?;
        if value.is_null() {
            return Err(fault(row, "the id is missing".to_owned()));
        }
        let value = value.str_value();
        if let Some(earlier) = seen.insert(value.clone(), row) {
            let what = format!("the id {value} is the one of row {} too", earlier + 1);
            return Err(fault(row, what));
        }
    }
    Ok(column.with_name("id".into()))
}

#[cfg(test)]
mod tests {
    use shearq_files::fits::TableHead;

    use super::*;

    #[test]
    fn units_of_places_are_converted_or_refused() {
        let factor = |unit: &str, is_sky: bool| {
            let head = TableHead {
                number: 2,
                name: String::new(),
                columns: vec!["a".into()],
                units: vec![unit.into()],
            };
            let columns = Columns {
                named: vec![Named {
                    names: head.columns.clone(),
                    table: Some(head),
                    doubtful: false,
                }],
                ..Columns::default()
            };
            unit_factor(&Place::of(Path::new("t.fits")), &columns, "a", is_sky)
        };
        for (unit, is_sky, expected) in [
            ("", true, 1.0),
            ("deg", true, 1.0),
            ("rad", true, 57.295_779_513_082_32),
            ("h", true, 15.0),
            ("", false, 1.0),
            ("pixel", false, 1.0),
        ] {
            assert_eq!(factor(unit, is_sky).unwrap(), expected, "{unit}");
        }
        for (unit, is_sky) in [
            ("arcsec", true),
            ("pixel", true),
            ("mm", false),
            ("rad", false),
        ] {
            let error = factor(unit, is_sky).unwrap_err().to_string();
            let expected = format!("the column `a` has the unit {unit} (expected");
            assert!(error.contains(&expected), "{error}");
        }
    }

    fn positions(all: &[(f64, f64)]) -> Positions {
        Positions {
            place: Place::of(Path::new("p.csv")),
            all: all.to_vec(),
            sky: None,
            id: None,
            carried: Vec::new(),
            degrees: false,
            note: None,
        }
    }

    #[test]
    fn positions_within_half_a_pixel_of_an_earlier_one_are_counted() {
        let of = |all: &[(f64, f64)]| positions(all).repeated(&vec![true; all.len()]);
        assert_eq!(of(&[(1.0, 1.0), (1.6, 1.0), (-3.0, 2.0)]), (0, None));
        let found = of(&[(1.0, 1.0), (9.0, 1.0), (1.35, 1.35), (1.0, 1.0), (9.0, 0.5)]);
        assert_eq!(found, (3, Some((0, 2))));
    }
}
