//! Reading, by cfitsio's own functions: what a header says is checked before it is believed.

use std::collections::BTreeMap;
use std::ffi::{c_char, c_int};
use std::path::Path;
use std::ptr;

use fitsio::sys;
use shearq_scoring::Grid;

use super::file::File;
use super::tiles::Tiles;
use crate::io::error::FileError;
use shearq_tables::polars::{Column, DataFrame};

/// Largest image side accepted, against absurd sizes in damaged headers.
pub const MAX_SIDE: usize = 200_000;
/// Most rows of a table accepted, one for each galaxy of the largest grid.
const MAX_ROWS: usize = Grid::MAX_SIDE * Grid::MAX_SIDE;
/// Most numbers read from a table that has fewer bytes than that on disk.
const FREE_NUMBERS: u64 = 1 << 22;

// Numbers of cfitsio's interface, from its fitsio.h.
const TLOGICAL: c_int = 14;
const TFLOAT: c_int = 42;
/// Type codes of columns that `ffgcvd` reads as one number a row: TBYTE, TSBYTE, TUSHORT, TSHORT,
/// TUINT, TINT, TULONG, TLONG, TFLOAT, TULONGLONG, TLONGLONG, TDOUBLE.
const NUMBERS: [c_int; 12] = [11, 12, 20, 21, 30, 31, 40, 41, 42, 80, 81, 82];

/// An image open for reading.
pub struct ImageReader {
    file: File,
    width: usize,
    height: usize,
    next_row: usize,
    pixels: Pixels,
}

/// How the pixels of an image are stored.
enum Pixels {
    /// As they are, in so many bytes each.
    Plain(u64),
    /// By tiles.
    Tiles(Tiles),
}

impl ImageReader {
    /// Opens the first image of a file: the primary one, or that of the first extension where the
    /// primary is empty (as fpack writes it).
    ///
    /// # Errors
    /// Where the file cannot be read or holds no two-dimensional image of sensible size, or not all
    /// of it.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let mut file = File::open(path.as_ref(), "image")?;
        let mut place = "primary";
        if file.sides()?.is_empty() && file.next()? {
            place = "first extension";
            if !file.is_image()? {
                return Err(file.fault(format!(
                    "the {place} is a table; expected a two-dimensional image"
                )));
            }
        }
        let sides = file.sides()?;
        let &[x, y] = sides.as_slice() else {
            return Err(file.fault(format!(
                "the {place} image has {} dimensions; expected 2",
                sides.len()
            )));
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
        let pixels = match file.take_tiling()? {
            Some(tiling) => Pixels::Tiles(Tiles::open(&file, tiling)?),
            None => Pixels::Plain(file.pixel_bytes()?),
        };
        if let Pixels::Plain(bytes) = pixels {
            file.expect(width as u64 * height as u64 * bytes)?;
        }
        Ok(ImageReader {
            file,
            width,
            height,
            next_row: 0,
            pixels,
        })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// A numeric header value, `None` where absent.
    ///
    /// # Errors
    /// Where it is there and not a number.
    pub fn number(&self, key: &str) -> Result<Option<f64>, FileError> {
        self.file.number(key)
    }

    /// Leaves the next `rows` rows out.
    pub fn skip_rows(&mut self, rows: usize) {
        self.next_row = (self.next_row + rows).min(self.height);
    }

    /// The next `rows` rows, or fewer at the end of the image. Pixels that are not finite or, in an
    /// image of integers, have the value of its key BLANK, are NaN.
    ///
    /// # Errors
    /// Where the pixels cannot be read, as in a damaged file.
    pub fn read_rows(&mut self, rows: usize) -> Result<Vec<f32>, FileError> {
        let first = self.next_row;
        let last = (first + rows).min(self.height);
        match &mut self.pixels {
            Pixels::Plain(bytes) => self.file.need((last * self.width) as u64 * *bytes)?,
            Pixels::Tiles(tiles) => tiles.check(&mut self.file, last)?,
        }
        let mut pixels = vec![0f32; (last - first) * self.width];
        // cfitsio writes to the second unasked.
        let (mut blank, mut some_blank) = (f32::NAN, 0);
        let start = (first * self.width + 1) as i64;
        self.file.call(
            || {
                let height = self.height;
                format!("cannot read rows {} to {last} of {height}", first + 1)
            },
            // SAFETY: the file is open, and there is room for all the pixels asked for.
            |raw, status| unsafe {
                sys::ffgpv(
                    raw,
                    TFLOAT,
                    start,
                    pixels.len() as i64,
                    ptr::from_mut(&mut blank).cast(),
                    pixels.as_mut_ptr().cast(),
                    &mut some_blank,
                    status,
                );
            },
        )?;
        self.next_row = last;
        if last == self.height {
            self.file.check_end()?;
        }
        Ok(pixels)
    }
}

/// A column of a table, by its number from 1.
struct Description {
    number: c_int,
    name: String,
    kind: c_int,
    repeat: i64,
}

/// Columns of the first table of a file: those of `wanted`, or all that are numbers.
///
/// # Errors
/// Where the file cannot be read, holds no table, or lacks a column.
pub fn read_table(path: &Path, wanted: Option<&[&str]>) -> Result<DataFrame, FileError> {
    let mut file = File::open(path, "table")?;
    while file.is_image()? {
        if !file.next()? {
            return Err(file.fault("there is no table in this file".into()));
        }
    }
    let rows = table_rows(&mut file)?;
    let descriptions = describe_columns(&file)?;
    if let Some(missing) = wanted
        .into_iter()
        .flatten()
        .find(|name| !descriptions.iter().any(|d| d.name == **name))
    {
        let names: Vec<&str> = descriptions.iter().map(|d| d.name.as_str()).collect();
        return Err(FileError::no_column(path, missing, &names));
    }
    let mut chosen = Vec::new();
    for description in &descriptions {
        let name = description.name.as_str();
        let number = description.repeat == 1
            && (NUMBERS.contains(&description.kind) || description.kind == TLOGICAL);
        match wanted {
            Some(wanted) if !wanted.contains(&name) => continue,
            None if !number => continue,
            _ => {}
        }
        if !number {
            return Err(file.fault(format!("column `{name}` does not hold one number per row")));
        }
        chosen.push(description);
    }
    let numbers = rows as u64 * chosen.len() as u64;
    let most = FREE_NUMBERS.max(file.disk_size());
    if numbers > most {
        return Err(file.fault(format!(
            "its {rows} rows of {} columns are {numbers} numbers; expected at most {most} in a file of this size",
            chosen.len()
        )));
    }
    let columns = chosen
        .into_iter()
        .map(|column| read_column(&file, column, rows))
        .collect::<Result<_, FileError>>()?;
    file.check_end()?;
    shearq_tables::frame(columns).map_err(|error| file.fault(error.to_string()))
}

/// Text values of the header of a file's first extension, of those of `keys` that are there.
///
/// # Errors
/// Where the file cannot be read or has no extension.
pub fn read_table_keys<'a>(
    path: &Path,
    keys: impl Iterator<Item = &'a String>,
) -> Result<BTreeMap<String, String>, FileError> {
    let mut file = File::open(path, "table")?;
    if !file.next()? {
        return Err(file.fault("there is no table in this file".into()));
    }
    let value = |key: &String| (key.clone(), file.text(&key.to_ascii_uppercase()));
    Ok(keys.map(value).filter(|(_, v)| !v.is_empty()).collect())
}

/// Rows of the table here, which the file must be able to hold.
fn table_rows(file: &mut File) -> Result<usize, FileError> {
    let mut count = 0;
    // SAFETY: the file is open, and the pointers are to live variables.
    file.call(
        || "cannot tell the number of rows".into(),
        |raw, status| unsafe {
            sys::ffgnrwll(raw, &mut count, status);
        },
    )?;
    let rows = usize::try_from(count)
        .ok()
        .filter(|rows| *rows <= MAX_ROWS)
        .ok_or_else(|| {
            file.fault(format!(
                "the table says it has {count} rows; expected at most {MAX_ROWS}"
            ))
        })?;
    let bytes = file.number("NAXIS1")?.unwrap_or(0.0);
    file.need((bytes * rows as f64) as u64)?;
    Ok(rows)
}

fn describe_columns(file: &File) -> Result<Vec<Description>, FileError> {
    let mut count = 0;
    // SAFETY: the file is open, and the pointers are to live variables.
    file.call(
        || "cannot tell the number of columns".into(),
        |raw, status| unsafe {
            sys::ffgncl(raw, &mut count, status);
        },
    )?;
    (1..=count)
        .map(|number| {
            let name = file.text(&format!("TTYPE{number}"));
            let (kind, repeat) = file.column_type(number)?;
            Ok(Description {
                number,
                name,
                kind,
                repeat,
            })
        })
        .collect()
}

/// A column as real numbers; missing ones are NaN, true is 1 and false 0.
fn read_column(file: &File, description: &Description, rows: usize) -> Result<Column, FileError> {
    let doing = || format!("cannot read column `{}`", description.name);
    let mut some_missing = 0;
    if description.kind == TLOGICAL {
        // Neither true nor false is missing.
        let missing = 2;
        let mut values = vec![0 as c_char; rows];
        // SAFETY: the file is open, and there is room for all the rows.
        file.call(doing, |raw, status| unsafe {
            sys::ffgcvl(
                raw,
                description.number,
                1,
                1,
                rows as i64,
                missing,
                values.as_mut_ptr(),
                &mut some_missing,
                status,
            );
        })?;
        let real = |value: c_char| {
            if value == missing {
                f64::NAN
            } else {
                f64::from(value)
            }
        };
        let values: Vec<f64> = values.into_iter().map(real).collect();
        return Ok(Column::new(description.name.as_str().into(), values));
    }
    let mut values = vec![0.0; rows];
    // SAFETY: the file is open, and there is room for all the rows.
    file.call(doing, |raw, status| unsafe {
        sys::ffgcvd(
            raw,
            description.number,
            1,
            1,
            rows as i64,
            f64::NAN,
            values.as_mut_ptr(),
            &mut some_missing,
            status,
        );
    })?;
    Ok(Column::new(description.name.as_str().into(), values))
}
