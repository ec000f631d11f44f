//! Reading images and tables with cfitsio. The values of a header are checked before they are used.

use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_int};
use std::ops::Range;
use std::path::Path;
use std::ptr;

use fitsio::sys;

use super::file::{ColumnValue, Content, File, plain};
use super::selection::ImageHead;
use crate::frames::element_name;
use crate::frames::polars::{Column, DataFrame};
use crate::{FileError, MAX_ROWS, MAX_SIDE, names_of};

// Most numbers read from a table that has fewer bytes than that on disk.
const FREE_NUMBERS: u64 = 1 << 22;

// Numbers of cfitsio's interface, from its fitsio.h.
const TBIT: c_int = 1;
const TLOGICAL: c_int = 14;
const TFLOAT: c_int = 42;
const TDOUBLE: c_int = 82;
// Type codes of columns that `ffgcvd` reads as one number a row: TBYTE, TSBYTE, TUSHORT, TSHORT,
// TUINT, TINT, TULONG, TLONG, TFLOAT, TULONGLONG, TLONGLONG, TDOUBLE.
const NUMBERS: [c_int; 12] = [11, 12, 20, 21, 30, 31, 40, 41, 42, 80, 81, 82];
// Longest vector that becomes one column per number; longer ones are stamps.
const MAX_VECTOR: i64 = 8;
const TSTRING: c_int = 16;
const TLONGLONG: c_int = 81;
// The offset by which FITS stores unsigned 64-bit integers as signed ones.
const UNSIGNED: f64 = 9_223_372_036_854_775_808.0;

// Pixels that are read at a time: their bytes are swapped, and missing ones are looked for, which takes less time in the cache.
const PIXELS_AT_A_TIME: usize = 1 << 14;

// Most pixels per byte of a compressed file. A tile without noise takes a byte for a thousand; images of galaxies take one for
// less than eight.
const MAX_COMPRESSION: u64 = 1 << 11;

// BITPIX of floats of 32 bits.
const FLOAT_BITS: c_int = -32;

// Pixels of this value are missing: SExtractor writes it, in single precision.
const MISSING: f32 = -1e30;

pub trait Pixel: Copy + Default + From<f32> + Into<f64> {
    #[doc(hidden)]
    const CODE: c_int;
    #[doc(hidden)]
    const MISSING: Self;
}

impl Pixel for f32 {
    const CODE: c_int = TFLOAT;
    const MISSING: Self = f32::NAN;
}

impl Pixel for f64 {
    const CODE: c_int = TDOUBLE;
    const MISSING: Self = f64::NAN;
}

/// An image, or a cube of several of one size, open for reading.
pub struct ImageReader {
    file: File,
    width: usize,
    height: usize,
    /// Images of a cube; 1 for a plain image.
    planes: usize,
    /// Rows of the cube before the only plane that is read.
    first_row: usize,
    /// Whether this is the last image that is read, so that a gzip file must be complete after it.
    last: bool,
    next_row: usize,
    /// BITPIX of an uncompressed image: bits per pixel, negative for floats. `None` for a compressed one.
    bits: Option<c_int>,
    asinh: Option<AsinhScale>,
    /// Whether the pixels are floats of 32 bits without BSCALE and BZERO. They are read without cfitsio, in half the time.
    plain: bool,
    /// Bytes of plain pixels.
    bytes: Vec<u8>,
}

impl std::fmt::Debug for ImageReader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ImageReader").finish_non_exhaustive()
    }
}

/// Pixels that are asinh magnitudes v, as of Pan-STARRS: the flux is BOFFSET + 2 BSOFTEN sinh(0.4 ln(10) v) (Waters et al. 2020,
/// ApJS 251, 4).
#[derive(Debug, Clone, Copy)]
struct AsinhScale {
    offset: f64,
    softening: f64,
}

impl AsinhScale {
    fn here(file: &File) -> Result<Option<Self>, FileError> {
        let Some(softening) = file.number("BSOFTEN")? else {
            return Ok(None);
        };
        let offset = file.number("BOFFSET")?.unwrap_or(0.0);
        if !(softening > 0.0 && softening.is_finite() && offset.is_finite()) {
            return Err(file.fault(format!(
                "the header keys BSOFTEN and BOFFSET are {softening} and {offset}; expected finite numbers, BSOFTEN positive"
            )));
        }
        Ok(Some(AsinhScale { offset, softening }))
    }

    fn flux(self, magnitude: f64) -> f64 {
        let angle = 0.4 * std::f64::consts::LN_10 * magnitude;
        self.offset + 2.0 * self.softening * angle.sinh()
    }
}

fn bytes_of(bits: c_int) -> u64 {
    u64::from(bits.unsigned_abs()) / 8
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Dimensions {
    Two,
    TwoOrThree,
}

impl ImageReader {
    /// Opens the first image of a file: the primary image, or the first extension if the primary header has no
    /// image (as fpack writes it).
    pub fn open(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let mut file = File::open(path.as_ref(), Content::Image)?;
        let mut place = "primary";
        if file.sides()?.is_empty() && file.next()? {
            place = "first extension";
            if !file.is_image()? {
                return Err(file.fault(format!(
                    "the {place} is a table; expected a two-dimensional image"
                )));
            }
        }
        ImageReader::here(file, place, Dimensions::Two)
    }

    /// Opens the first image or cube of a file. [`ImageReader::next_stack`] opens the others. The rows of all planes
    /// of a cube follow each other, as in one image.
    pub fn open_stack(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref();
        let file = File::open(path, Content::Image)?;
        if !file.sides()?.is_empty() {
            return ImageReader::here(file, "primary", Dimensions::TwoOrThree);
        }
        ImageReader::after(file)?
            .ok_or_else(|| FileError::new(path, "there is no image in this file"))
    }

    /// The next image or cube of the file, `None` after the last. Tables are passed over.
    pub fn next_stack(self) -> Result<Option<Self>, FileError> {
        ImageReader::after(self.file)
    }

    fn after(mut file: File) -> Result<Option<Self>, FileError> {
        while file.next()? {
            if file.is_image()? && !file.sides()?.is_empty() {
                return ImageReader::here(file, "next", Dimensions::TwoOrThree).map(Some);
            }
        }
        Ok(None)
    }

    fn here(mut file: File, place: &str, dimensions: Dimensions) -> Result<Self, FileError> {
        // cfitsio leaves out those that are no numbers.
        let mut plain = true;
        for (key, neutral) in [("BSCALE", 1.0), ("BZERO", 0.0)] {
            let value = file.number(key)?;
            plain &= value.is_none_or(|value| value == neutral);
            if let Some(value) = value.filter(|v| !v.is_finite() || key == "BSCALE" && *v == 0.0) {
                return Err(file.fault(format!(
                    "the header key {key} is {value}; expected a finite number (for BSCALE not zero)"
                )));
            }
        }
        let mut sides = file.sides()?;
        // Radio images have axes of one frequency and one polarization.
        let most = match dimensions {
            Dimensions::Two => 2,
            Dimensions::TwoOrThree => 3,
        };
        while sides.len() > most && sides.last() == Some(&1) {
            sides.pop();
        }
        let (x, y, z) = match (sides.as_slice(), dimensions) {
            (&[x, y], _) => (x, y, 1),
            (&[x, y, z], Dimensions::TwoOrThree) => (x, y, z),
            (sides, _) => {
                let or_cube = match dimensions {
                    Dimensions::Two => "",
                    Dimensions::TwoOrThree => ", or 3 for a cube",
                };
                return Err(file.fault(format!(
                    "the {place} image has {} dimensions; expected 2{or_cube}",
                    sides.len()
                )));
            }
        };
        let side = |found: i64| {
            usize::try_from(found)
                .ok()
                .filter(|side| (1..=MAX_SIDE).contains(side))
        };
        let (Some(width), Some(height)) = (side(x), side(y)) else {
            return Err(file.fault(format!(
                "the image is {x} × {y} pixels; expected 1 to {MAX_SIDE} a side"
            )));
        };
        let planes = usize::try_from(z).ok();
        let Some(planes) = planes.filter(|planes| (1..=MAX_ROWS).contains(planes)) else {
            return Err(file.fault(format!("the cube has {z} planes; expected 1 to {MAX_ROWS}")));
        };
        let asinh = AsinhScale::here(&file)?;
        let pixels = (width as u64 * height as u64).saturating_mul(planes as u64);
        let bits = match file.is_compressed()? {
            true => {
                // Also the guard against memory for pixels that a damaged header claims and a file cannot have.
                file.need_all()?;
                file.check_sums()?;
                let most = file.disk_size().saturating_mul(MAX_COMPRESSION);
                if pixels > most {
                    return Err(file.fault(format!(
                        "the compressed image claims {pixels} pixels; expected at most {most} in a file of this size"
                    )));
                }
                None
            }
            false => {
                let bits = file.bits_per_pixel()?;
                file.expect(pixels.saturating_mul(bytes_of(bits)))?;
                Some(bits)
            }
        };
        Ok(ImageReader {
            file,
            width,
            height,
            planes,
            first_row: 0,
            last: dimensions == Dimensions::Two,
            next_row: 0,
            plain: plain && bits == Some(FLOAT_BITS) && asinh.is_none(),
            asinh,
            bits,
            bytes: Vec::new(),
        })
    }

    /// Its name and its place in the file.
    pub fn head(&self) -> Result<ImageHead, FileError> {
        ImageHead::here(&self.file)
    }

    /// Reads only the plane of this number, from 1, as an image.
    pub fn only_plane(&mut self, number: usize) -> Result<(), FileError> {
        if number > self.planes {
            return Err(self.file.fault(format!(
                "there is no plane {number} (found {} planes)",
                self.planes
            )));
        }
        self.first_row = (number - 1) * self.height;
        self.planes = 1;
        Ok(())
    }

    /// Whether the pixels of the file are asinh magnitudes, which are read as fluxes.
    pub fn is_asinh(&self) -> bool {
        self.asinh.is_some()
    }

    /// Whether the pixels of a plain image differ from the DATASUM of the header. Compressed ones are refused when they are opened.
    pub fn differs_from_datasum(&mut self) -> Result<bool, FileError> {
        self.file.differs_from_datasum()
    }

    pub fn width(&self) -> usize {
        self.width
    }

    pub fn height(&self) -> usize {
        self.height
    }

    /// Planes of a cube; 1 for an image.
    pub fn planes(&self) -> usize {
        self.planes
    }

    fn rows(&self) -> usize {
        self.height * self.planes
    }

    /// Keys and values of the header. Texts keep their quotes; of keys that repeat, the last one counts.
    pub fn cards(&mut self) -> Result<BTreeMap<String, String>, FileError> {
        self.file.cards_with_inherited()
    }

    /// A numeric header value; `None` if absent.
    pub fn number(&self, key: &str) -> Result<Option<f64>, FileError> {
        self.file.number(key)
    }

    /// A header value as text; empty if absent.
    pub fn text(&self, key: &str) -> String {
        self.file.text(key)
    }

    pub fn rewind(&mut self) {
        self.next_row = 0;
    }

    pub fn skip_rows(&mut self, rows: usize) {
        self.next_row = (self.next_row + rows).min(self.rows());
    }

    /// The next `rows` rows, or fewer at the end of the image. Pixels that are not finite, −1e30, or, in an
    /// image of integers, have the value of its key BLANK, are NaN.
    pub fn read_rows(&mut self, rows: usize) -> Result<Vec<f32>, FileError> {
        self.read_rows_as(rows)
    }

    /// The same in another precision: masks of more than 24 bits do not fit into `f32`.
    pub fn read_rows_as<P: Pixel>(&mut self, rows: usize) -> Result<Vec<P>, FileError> {
        let first = self.next_row;
        let last = (first + rows).min(self.rows());
        self.need(last)?;
        let (start, count) = (first * self.width, (last - first) * self.width);
        let at_a_time = match self.bits {
            Some(_) => PIXELS_AT_A_TIME.min(count),
            // A part of a tile takes as long as the tile.
            None => count,
        };
        let mut pixels = Vec::with_capacity(count);
        while pixels.len() < count {
            let first = pixels.len();
            pixels.resize(count.min(first + at_a_time), P::default());
            self.fill(start + first, &mut pixels[first..])?;
        }
        self.next_row = last;
        if self.last && last == self.rows() {
            self.file.check_end()?;
        }
        Ok(pixels)
    }

    /// A square of `side` × `side` pixels, row-major. Its lower left pixel is at column `x` and row `y` of the image, both
    /// from 0. Pixels outside the image are NaN.
    pub fn read_square<P: Pixel>(
        &mut self,
        x: i64,
        y: i64,
        side: usize,
    ) -> Result<Vec<P>, FileError> {
        let mut pixels = vec![P::MISSING; side * side];
        let inside = |at: i64, most: usize| at.clamp(0, most as i64) as usize;
        let across = |first: i64, most| inside(first, most)..inside(first + side as i64, most);
        let (columns, rows) = (across(x, self.width), across(y, self.height));
        if columns.is_empty() || rows.is_empty() {
            return Ok(pixels);
        }
        self.need(rows.end)?;
        let skipped = (columns.start as i64 - x) as usize;
        for row in rows {
            let line = &mut pixels[(row as i64 - y) as usize * side..][..side];
            let first = row * self.width + columns.start;
            self.fill(first, &mut line[skipped..skipped + columns.len()])?;
        }
        Ok(pixels)
    }

    /// Makes sure that the first `rows` rows are there.
    fn need(&mut self, rows: usize) -> Result<(), FileError> {
        match self.bits {
            Some(bits) => {
                let pixels = (self.first_row + rows) * self.width;
                self.file.need(pixels as u64 * bytes_of(bits))
            }
            None => Ok(()),
        }
    }

    // Fills `pixels` from the image's pixel `first` on, counted from 0.
    fn fill<P: Pixel>(&mut self, first: usize, pixels: &mut [P]) -> Result<(), FileError> {
        let first = self.first_row * self.width + first;
        if self.plain {
            self.bytes.resize(4 * pixels.len(), 0);
            self.file.read_data(4 * first as u64, &mut self.bytes)?;
            let (values, _) = self.bytes.as_chunks();
            for (pixel, bytes) in pixels.iter_mut().zip(values) {
                let value = f32::from_be_bytes(*bytes);
                let missing = value == MISSING || !value.is_finite();
                *pixel = if missing { P::MISSING } else { value.into() };
            }
            return Ok(());
        }
        // cfitsio always writes to the second.
        let (mut blank, mut some_blank) = (P::MISSING, 0);
        if self.bits.is_some_and(|bits| bits < 0) {
            // cfitsio would test the bits of one pixel at a time. Those that are not finite are found below.
            blank = P::default();
        }
        let start = (first + 1) as i64;
        let (width, rows) = (self.width, self.first_row + self.rows());
        let last = (first + pixels.len()).div_ceil(width);
        self.file.call(
            || format!("cannot read rows {} to {last} of {rows}", first / width + 1),
            // SAFETY: the file is open, and there is room for all requested pixels.
            |raw, status| unsafe {
                sys::ffgpv(
                    raw,
                    P::CODE,
                    start,
                    pixels.len() as i64,
                    ptr::from_mut(&mut blank).cast(),
                    pixels.as_mut_ptr().cast(),
                    &mut some_blank,
                    status,
                );
            },
        )?;
        if let Some(asinh) = self.asinh {
            for pixel in pixels.iter_mut() {
                let flux = asinh.flux((*pixel).into()) as f32;
                if flux.is_infinite() {
                    let magnitude: f64 = (*pixel).into();
                    let message = format!(
                        "a pixel is {magnitude}, and the header has BSOFTEN (expected asinh magnitudes, as of Pan-STARRS)"
                    );
                    return Err(self
                        .file
                        .fault(message)
                        .hint("remove BSOFTEN if the pixels are fluxes already"));
                }
                *pixel = flux.into();
            }
        }
        for pixel in pixels {
            let value: f64 = (*pixel).into();
            *pixel = if value as f32 == MISSING || !value.is_finite() {
                P::MISSING
            } else {
                *pixel
            };
        }
        Ok(())
    }
}

#[derive(Clone)]
struct Description {
    number: c_int,
    name: String,
    kind: c_int,
    repeat: i64,
    /// Place of a number in the vector that each row has.
    element: i64,
    unit: String,
}

impl Description {
    fn is_number(&self) -> bool {
        NUMBERS.contains(&self.kind) || self.kind == TLOGICAL
    }

    /// The names under which its numbers are read: `g[0]` and `g[1]` of a vector of two.
    fn names(&self) -> Vec<String> {
        match self.is_number() && (2..=MAX_VECTOR).contains(&self.repeat) {
            true => (0..self.repeat)
                .map(|k| element_name(&self.name, k))
                .collect(),
            false => vec![self.name.clone()],
        }
    }

    fn named(&self, name: &str) -> Option<Self> {
        let element = self.names().iter().position(|own| own == name)?;
        Some(Description {
            name: name.to_owned(),
            element: element as i64,
            ..self.clone()
        })
    }
}

#[derive(Debug, Clone)]
pub struct TableHead {
    pub number: usize,
    /// Its name, EXTNAME; empty if it has none.
    pub name: String,
    pub columns: Vec<String>,
    /// Of each column, its TUNIT; empty if it has none.
    pub units: Vec<String>,
}

impl TableHead {
    fn here(file: &File) -> Result<Self, FileError> {
        let (mut columns, mut units) = (Vec::new(), Vec::new());
        for number in 1..=file.columns()? {
            let column = describe_column(file, number)?;
            columns.extend(column.names());
            units.resize(columns.len(), column.unit);
        }
        Ok(TableHead {
            number: file.number_of_extension(),
            name: file.text("EXTNAME"),
            columns,
            units,
        })
    }

    pub fn shown(&self) -> String {
        match self.name.as_str() {
            "" => self.number.to_string(),
            name => format!("{} `{name}`", self.number),
        }
    }

    pub fn is_called(&self, name: &str) -> bool {
        match name.parse::<usize>() {
            Ok(number) => self.number == number,
            Err(_) => self.name.eq_ignore_ascii_case(name),
        }
    }

    // Whether it contains the header of an image, as in FITS_LDAC.
    fn is_image_head(&self) -> bool {
        self.name.eq_ignore_ascii_case("LDAC_IMHEAD")
    }
}

fn list_of(tables: &[TableHead]) -> String {
    let shown: Vec<String> = tables.iter().map(TableHead::shown).collect();
    names_of(&shown)
}

/// The tables of a file, in order; if `table` is a name or a number, those that have it.
pub fn tables(path: &Path, table: Option<&str>) -> Result<Vec<TableHead>, FileError> {
    let mut file = File::open(path, Content::Table)?;
    let all = all_tables(&mut file)?;
    let Some(table) = table else {
        return Ok(all);
    };
    let list = list_of(&all);
    let called: Vec<_> = all
        .into_iter()
        .filter(|head| head.is_called(table))
        .collect();
    match called.is_empty() {
        true => Err(no_table(&file, table, &list)),
        false => Ok(called),
    }
}

fn no_table(file: &File, table: &str, found: &str) -> FileError {
    file.fault(format!(
        "there is no table `{table}` in this file; tables found: {found}"
    ))
}

fn all_tables(file: &mut File) -> Result<Vec<TableHead>, FileError> {
    let mut found = Vec::new();
    while file.next()? {
        if !file.is_image()? {
            found.push(TableHead::here(file)?);
        }
    }
    if found.is_empty() {
        return Err(file.fault("there is no table in this file".into()));
    }
    Ok(found)
}

// Goes to the table of a file that is meant: the one that `table` names or numbers; otherwise the one that has all of
// the columns `wanted`; otherwise the first.
fn go_to_table(
    file: &mut File,
    wanted: Option<&[&str]>,
    table: Option<&str>,
) -> Result<(), FileError> {
    let tables = all_tables(file)?;
    let has = |head: &&TableHead| {
        let all = |wanted: &[&str]| wanted.iter().all(|w| head.columns.iter().any(|c| c == w));
        wanted.is_none_or(all)
    };
    let chosen: Vec<&TableHead> = match (table, wanted) {
        (Some(table), _) => tables.iter().filter(|head| head.is_called(table)).collect(),
        (None, Some(_)) => tables.iter().filter(has).collect(),
        (None, None) => {
            let first = tables.iter().find(|head| !head.is_image_head());
            first.into_iter().collect()
        }
    };
    let number = match (chosen.as_slice(), table) {
        ([one], _) => one.number,
        // Which columns there are is reported by the caller.
        ([], None) => {
            let first = tables.iter().find(|head| !head.is_image_head());
            first.unwrap_or(&tables[0]).number
        }
        ([], Some(table)) => {
            return Err(no_table(file, table, &list_of(&tables)));
        }
        (_, _) => {
            let what = match table {
                Some(table) => format!("tables are called `{table}`"),
                None => "tables have these columns".into(),
            };
            let chosen: Vec<TableHead> = chosen.iter().map(|head| (*head).clone()).collect();
            return Err(file
                .fault(format!(
                    "{} {what} ({}); expected one",
                    chosen.len(),
                    list_of(&chosen)
                ))
                .hint(format!("{}[{}]", file.path().display(), chosen[0].number)));
        }
    };
    file.go_to(number)
}

/// Columns of a table of a file: the columns `wanted`, or all columns of numbers. `table` is the name (EXTNAME) or number
/// (the first extension is 1) of the table. Without it, the table with the wanted columns is read, or else the first.
pub fn read_table(
    path: &Path,
    wanted: Option<&[&str]>,
    table: Option<&str>,
) -> Result<DataFrame, FileError> {
    let mut file = File::open(path, Content::Table)?;
    go_to_table(&mut file, wanted, table)?;
    let rows = table_rows(&mut file, MAX_ROWS)?;
    let chosen = choose_columns(&file, path, wanted, false)?;
    let numbers = rows as u64 * chosen.len() as u64;
    let most = FREE_NUMBERS.max(file.disk_size());
    if numbers > most {
        return Err(file.fault(format!(
            "its {rows} rows of {} columns are {numbers} numbers; expected at most {most} in a file of this size",
            chosen.len()
        )));
    }
    let table = read_part(&file, &chosen, 0..rows, false)?;
    file.check_end()?;
    Ok(table)
}

/// Reads the columns `wanted` of a table, as [`read_table`], in parts of at most `most_rows`, and gives each to `take`.
/// Columns of text are read too, and 64-bit integers as such.
pub fn read_table_parts(
    path: &Path,
    wanted: &[&str],
    table: Option<&str>,
    most_rows: usize,
    mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    let mut file = File::open(path, Content::Table)?;
    go_to_table(&mut file, Some(wanted), table)?;
    let rows = table_rows(&mut file, usize::MAX)?;
    let chosen = choose_columns(&file, path, Some(wanted), true)?;
    for first in (0..rows).step_by(most_rows) {
        let last = rows.min(first + most_rows);
        take(read_part(&file, &chosen, first..last, true)?)?;
    }
    file.check_end()
}

/// The first value of each column of text of a table.
pub fn first_texts(path: &Path, table: Option<&str>) -> Result<Vec<(String, String)>, FileError> {
    let mut file = File::open(path, Content::Table)?;
    go_to_table(&mut file, None, table)?;
    let mut texts = describe_columns(&file)?;
    texts.retain(|own| own.kind == TSTRING);
    if table_rows(&mut file, usize::MAX)? == 0 {
        return Ok(Vec::new());
    }
    let first = read_part(&file, &texts, 0..1, true)?;
    let text = |own: &Column| {
        let text = own.str().ok()?.get(0)?;
        Some((own.name().to_string(), text.to_owned()))
    };
    Ok(first.columns().iter().filter_map(text).collect())
}

/// The descriptions of the columns `wanted`, or of all that are numbers. Wanted columns may be `texts`.
fn choose_columns(
    file: &File,
    path: &Path,
    wanted: Option<&[&str]>,
    texts: bool,
) -> Result<Vec<Description>, FileError> {
    let descriptions = describe_columns(file)?;
    let Some(wanted) = wanted else {
        let scalar = |own: &Description| own.is_number() && own.repeat == 1;
        return Ok(descriptions.into_iter().filter(scalar).collect());
    };
    let mut chosen = Vec::new();
    for name in wanted {
        let found = descriptions.iter().find_map(|own| own.named(name));
        // A vector by its name alone has no single number.
        let whole = || descriptions.iter().find(|own| own.name == *name).cloned();
        let Some(found) = found.or_else(whole) else {
            let names: Vec<String> = descriptions.iter().flat_map(Description::names).collect();
            return Err(FileError::no_column(path, name, &names));
        };
        let text = texts && found.kind == TSTRING;
        let number = found.is_number() && (found.repeat == 1 || found.name.ends_with(']'));
        if !(number || text) {
            let by_column = found.repeat > MAX_VECTOR && file.rows()? == 1;
            return Err(match by_column {
                true => file
                    .fault(format!(
                        "column `{name}` holds all its values in one row, as in colfits, which is not read (expected one number per row)"
                    ))
                    .hint(format!("stilts tcopy in={} out=table.fits ofmt=fits", path.display())),
                false if found.kind == TBIT => file
                    .fault(format!(
                        "column `{name}` holds bits (TFORM `X`, expected one number per row)"
                    ))
                    .hint("a column of integers, such as numpy.packbits gives, or --columns flag=none"),
                false => file.fault(format!("column `{name}` does not hold one number per row")),
            });
        }
        chosen.push(found);
    }
    Ok(chosen)
}

// Some rows of columns, counted from 0. If `exact`, 64-bit integers stay such.
fn read_part(
    file: &File,
    columns: &[Description],
    rows: Range<usize>,
    exact: bool,
) -> Result<DataFrame, FileError> {
    let columns = columns
        .iter()
        .map(|column| match column.kind {
            TSTRING => read_texts(file, column, &rows),
            TLONGLONG if exact && column.repeat == 1 => read_integers(file, column, &rows),
            _ => read_column(file, column, &rows),
        })
        .collect::<Result<_, FileError>>()?;
    crate::frames::frame(columns).map_err(|error| file.fault(error.to_string()))
}

/// Text values of `keys` in the header of a file's first extension. Absent keys are left out.
pub fn read_table_keys(
    path: &Path,
    keys: impl IntoIterator<Item = impl AsRef<str>>,
) -> Result<BTreeMap<String, String>, FileError> {
    let mut file = File::open(path, Content::Table)?;
    if !file.next()? {
        return Err(file.fault("there is no table in this file".into()));
    }
    let mut found = BTreeMap::new();
    for key in keys {
        let key = key.as_ref();
        found.insert(key.to_owned(), file.text(&key.to_ascii_uppercase()));
    }
    found.retain(|_, value| !value.is_empty());
    Ok(found)
}

/// The vector in the first row of a column, and the cards of the header: texts keep their quotes. `table` is a number as in
/// [`TableHead`].
pub fn read_vector(
    path: &Path,
    table: usize,
    column: &str,
) -> Result<(Vec<f64>, BTreeMap<String, String>), FileError> {
    let mut file = File::open(path, Content::Table)?;
    file.go_to(table)?;
    let found = describe_columns(&file)?;
    let Some(found) = found.into_iter().find(|own| own.name == column) else {
        return Err(file.fault(format!("table {table} has no column `{column}`")));
    };
    // The vector must fit into the file before there is memory for it.
    if table_rows(&mut file, MAX_ROWS)? == 0 || !found.is_number() {
        return Err(file.fault(format!(
            "column `{column}` of table {table} has no numbers; expected a vector of them"
        )));
    }
    let doing = || format!("cannot read column `{column}`");
    let values = file.values(doing, found.number, 1, found.repeat as usize, f64::NAN)?;
    let cards = file.cards()?;
    file.check_end()?;
    Ok((values, cards))
}

/// Number of rows of the current table, at most `most`, which must fit into the file.
fn table_rows(file: &mut File, most: usize) -> Result<usize, FileError> {
    let count = file.rows()?;
    let rows = usize::try_from(count)
        .ok()
        .filter(|rows| *rows <= most)
        .ok_or_else(|| {
            file.fault(format!(
                "the table says it has {count} rows; expected at most {most}"
            ))
        })?;
    let bytes = file.number("NAXIS1")?.unwrap_or(0.0);
    file.need((bytes * rows as f64) as u64)?;
    Ok(rows)
}

fn describe_columns(file: &File) -> Result<Vec<Description>, FileError> {
    (1..=file.columns()?)
        .map(|number| {
            let found = describe_column(file, number)?;
            check_scale(file, number, &found.name)?;
            Ok(found)
        })
        .collect()
}

fn describe_column(file: &File, number: c_int) -> Result<Description, FileError> {
    let (kind, repeat) = file.column_type(number)?;
    Ok(Description {
        number,
        name: file.text(&format!("TTYPE{number}")),
        unit: file.text(&format!("TUNIT{number}")),
        kind,
        repeat,
        element: 0,
    })
}

// Refuses a column if its scale is zero, or if its scale or offset is not finite.
fn check_scale(file: &File, number: c_int, name: &str) -> Result<(), FileError> {
    for (key, zero) in [("TSCAL", false), ("TZERO", true)] {
        let key = format!("{key}{number}");
        if let Some(value) = file.number(&key)?
            && (!value.is_finite() || value == 0.0 && !zero)
        {
            return Err(file.fault(format!(
                "column `{name}`: the header key {key} is {value}; expected a finite number other than 0"
            )));
        }
    }
    Ok(())
}

// All values of some rows of a column, with the repeat count of the column for each row.
fn values_of<T: ColumnValue>(
    file: &File,
    description: &Description,
    rows: &Range<usize>,
    missing: T,
) -> Result<Vec<T>, FileError> {
    let count = rows.len() * description.repeat.max(1) as usize;
    let doing = || format!("cannot read column `{}`", description.name);
    file.values(doing, description.number, rows.start + 1, count, missing)
}

// Rows of a column as real numbers; missing ones are NaN, true is 1 and false 0. Of a vector, the numbers of one place.
fn read_column(
    file: &File,
    description: &Description,
    rows: &Range<usize>,
) -> Result<Column, FileError> {
    let repeat = description.repeat.max(1);
    let values = if description.kind == TLOGICAL {
        // Neither true nor false is missing.
        const MISSING: c_char = 2;
        let real = |value: c_char| match value {
            MISSING => f64::NAN,
            value => f64::from(value),
        };
        let values = values_of(file, description, rows, MISSING)?;
        values.into_iter().map(real).collect()
    } else {
        let values = values_of(file, description, rows, f64::NAN);
        values.or_else(|error| values_with_nan(file, description, rows).ok_or(error))?
    };
    let own: Vec<f64> = match repeat {
        1 => values,
        _ => {
            let own = values.into_iter().skip(description.element as usize);
            own.step_by(repeat as usize).collect()
        }
    };
    Ok(Column::new(description.name.as_str().into(), own))
}

// Words for NaN in ASCII tables, which cfitsio does not read: astropy's first.
const NAN_WORDS: [&str; 3] = ["NAN", "nan", "NaN"];

// The numbers of a column of an ASCII table that has a word for NaN: cfitsio compares a field with the text for missing values
// from its first character, so that the word is stated with the blanks before it.
fn values_with_nan(
    file: &File,
    description: &Description,
    rows: &Range<usize>,
) -> Option<Vec<f64>> {
    if file.text("XTENSION").trim() != "TABLE" {
        return None;
    }
    let format = file.text(&format!("TFORM{}", description.number));
    let width = format
        .trim()
        .trim_start_matches(|c: char| !c.is_ascii_digit());
    let width: usize = width.split('.').next()?.parse().ok()?;
    let aligned = |word: &&str| [format!("{word:>width$}"), (*word).to_owned()];
    NAN_WORDS.iter().flat_map(aligned).find_map(|word| {
        let word = CString::new(word).ok()?;
        let doing = || format!("cannot read column `{}`", description.name);
        // SAFETY: the file is open, and the word, which cfitsio copies, ends in a zero byte.
        let stated = file.call(doing, |raw, status| unsafe {
            sys::ffsnul(raw, description.number, word.as_ptr().cast_mut(), status);
        });
        stated.ok()?;
        values_of(file, description, rows, f64::NAN).ok()
    })
}

// Rows of a column of 64-bit integers as such, if it has neither a scale nor missing values.
fn read_integers(
    file: &File,
    description: &Description,
    rows: &Range<usize>,
) -> Result<Column, FileError> {
    let number = description.number;
    let key = |name: &str| file.number(&format!("{name}{number}"));
    let (scale, zero) = (key("TSCAL")?.unwrap_or(1.0), key("TZERO")?.unwrap_or(0.0));
    let plain = scale == 1.0 && (zero == 0.0 || zero == UNSIGNED) && key("TNULL")?.is_none();
    if !plain {
        return read_column(file, description, rows);
    }
    let name = description.name.as_str().into();
    Ok(match zero == UNSIGNED {
        true => Column::new(name, values_of(file, description, rows, 0_u64)?),
        false => Column::new(name, values_of(file, description, rows, 0_i64)?),
    })
}

// Most bytes of a text.
const MAX_TEXT: i64 = 1 << 10;

// Rows of a column of text, without blanks at the end.
fn read_texts(
    file: &File,
    description: &Description,
    rows: &Range<usize>,
) -> Result<Column, FileError> {
    let width = description.repeat;
    if !(1..=MAX_TEXT).contains(&width) {
        return Err(file.fault(format!(
            "column `{}` has texts of {width} bytes; expected 1 to {MAX_TEXT}",
            description.name
        )));
    }
    let stride = width as usize + 1;
    let mut bytes = vec![0 as c_char; stride * rows.len()];
    let mut places: Vec<*mut c_char> = bytes
        .chunks_mut(stride)
        .map(<[c_char]>::as_mut_ptr)
        .collect();
    let mut some_missing = 0;
    file.call(
        || format!("cannot read column `{}`", description.name),
        // SAFETY: the file is open, and each place has room for the width of the column and a zero.
        |raw, status| unsafe {
            sys::ffgcvs(
                raw,
                description.number,
                rows.start as i64 + 1,
                1,
                rows.len() as i64,
                ptr::null_mut(),
                places.as_mut_ptr(),
                &mut some_missing,
                status,
            );
        },
    )?;
    let texts: Vec<String> = bytes.chunks(stride).map(plain).collect();
    Ok(Column::new(description.name.as_str().into(), texts))
}
