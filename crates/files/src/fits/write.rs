//! Writing FITS files. cfitsio makes headers and tables in memory. The standard library writes the bytes to disk, because
//! it reports every write that fails.

use std::ffi::{CStr, CString, c_int};
use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::ptr;

use crate::frames::polars::{Column, DataFrame};
use crate::frames::reals;
use fitsio::FitsFile;
use fitsio::hdu::FitsHdu;
use fitsio::images::{ImageDescription, ImageType};
use fitsio::sys;
use fitsio::tables::{ColumnDataType, ColumnDescription};

use super::cfitsio::{self, lock};
use crate::atomic::{self, PartFile};
use crate::error::FileError;

/// Bytes of a block: headers and data each fill whole ones.
const BLOCK: usize = 2880;
/// A file of cfitsio's that is not on disk.
const IN_MEMORY: &str = "mem://";

/// A header value to write.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Whole number.
    Int(i64),
    /// Real number.
    Real(f64),
    /// Text, at most 68 characters.
    Text(String),
}

/// An image being written.
pub struct ImageWriter {
    file: File,
    part: PartFile,
    width: usize,
    height: usize,
    next_row: usize,
    /// Rows as they stand in the file.
    bytes: Vec<u8>,
}

impl ImageWriter {
    /// Starts an image of 32-bit floats.
    ///
    /// # Errors
    /// If the file cannot be created.
    pub fn create(
        path: impl AsRef<Path>,
        width: usize,
        height: usize,
        header: &[(&str, Value)],
    ) -> Result<Self, FileError> {
        let path = path.as_ref();
        plain_name(path)?;
        let header = image_header([width, height], header).map_err(cannot(path))?;
        let (part, file) = PartFile::create(path)?;
        let mut writer = ImageWriter {
            file,
            part,
            width,
            height,
            next_row: 0,
            bytes: header,
        };
        writer.write()?;
        Ok(writer)
    }

    /// Writes the next rows.
    ///
    /// # Errors
    /// If they cannot be written, or are not whole rows of this image.
    pub fn write_rows(&mut self, pixels: &[f32]) -> Result<(), FileError> {
        let rows = pixels.len() / self.width;
        if rows * self.width != pixels.len() || self.next_row + rows > self.height {
            return Err(FileError::new(
                self.part.target(),
                format!(
                    "{} pixels are not the next rows of this image",
                    pixels.len()
                ),
            ));
        }
        self.bytes.clear();
        self.bytes
            .extend(pixels.iter().flat_map(|pixel| pixel.to_be_bytes()));
        self.write()?;
        self.next_row += rows;
        Ok(())
    }

    /// Closes the file and gives it its name.
    ///
    /// # Errors
    /// If rows are missing or the file cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        self.closed()?.finish()
    }

    /// Like [`ImageWriter::finish`], but does not replace an existing file. Returns whether the file was written.
    ///
    /// # Errors
    /// As [`ImageWriter::finish`].
    pub fn finish_if_absent(self) -> Result<bool, FileError> {
        self.closed()?.finish_if_absent()
    }

    fn closed(mut self) -> Result<PartFile, FileError> {
        let ImageWriter {
            width,
            height,
            next_row,
            ..
        } = self;
        if next_row != height {
            return Err(FileError::new(
                self.part.target(),
                format!("{next_row} of {height} rows were written"),
            ));
        }
        let data = size_of::<f32>() * width * height;
        self.bytes.clear();
        self.bytes.resize(data.next_multiple_of(BLOCK) - data, 0);
        self.write()?;
        Ok(self.part)
    }

    fn write(&mut self) -> Result<(), FileError> {
        let written = self.file.write_all(&self.bytes);
        written.map_err(FileError::doing(
            self.part.target(),
            "cannot write the image",
        ))
    }
}

/// The error for a file `path` that cannot be written.
fn cannot(path: &Path) -> impl Fn(fitsio::errors::Error) -> FileError {
    move |error| FileError::new(path, format!("cannot write the file: {}", describe(error)))
}

/// The blocks of the header of an image of `sides` = [columns, rows] 32-bit floats.
fn image_header(sides: [usize; 2], header: &[(&str, Value)]) -> fitsio::errors::Result<Vec<u8>> {
    let _guard = lock();
    let description = ImageDescription {
        data_type: ImageType::Float,
        dimensions: &[sides[1], sides[0]],
    };
    let mut file = FitsFile::create(IN_MEMORY)
        .with_custom_primary(&description)
        .open()?;
    let hdu = file.primary_hdu()?;
    write_header(&mut file, &hdu, header)?;
    header_blocks(&mut file)
}

/// The blocks of the header in use.
fn header_blocks(file: &mut FitsFile) -> fitsio::errors::Result<Vec<u8>> {
    let (mut status, mut keys, mut text) = (0, 0, ptr::null_mut());
    // SAFETY: the file is open. Flushed, it counts its rows in the header. cfitsio makes the text, which ends in a zero
    // byte, and frees it on request.
    let mut cards = unsafe {
        sys::ffflus(file.as_raw(), &mut status);
        sys::ffhdr2str(
            file.as_raw(),
            0,
            ptr::null_mut(),
            0,
            &mut text,
            &mut keys,
            &mut status,
        );
        fitsio::errors::check_status(status)?;
        let cards = CStr::from_ptr(text).to_bytes().to_vec();
        sys::fffree(text.cast(), &mut status);
        cards
    };
    cards.resize(cards.len().next_multiple_of(BLOCK), b' ');
    Ok(cards)
}

/// Longest text on a single card.
const SHORT: usize = 68;

fn write_header(
    file: &mut FitsFile,
    hdu: &FitsHdu,
    header: &[(&str, Value)],
) -> fitsio::errors::Result<()> {
    for (key, value) in header {
        match value {
            Value::Int(v) => hdu.write_key(file, key, *v)?,
            Value::Real(v) => write_real(file, key, *v)?,
            Value::Text(v) if v.len() > SHORT => write_long(file, key, v)?,
            Value::Text(v) => hdu.write_key(file, key, v.as_str())?,
        }
    }
    Ok(())
}

/// Writes a text to the header in use, on as many CONTINUE cards as it takes.
fn write_long(file: &mut FitsFile, key: &str, value: &str) -> fitsio::errors::Result<()> {
    let (name, value) = (CString::new(key)?, CString::new(value)?);
    let mut status = 0;
    // SAFETY: the file is open, name and value end in a zero byte, and there is no comment.
    unsafe {
        sys::ffpkls(
            file.as_raw(),
            name.as_ptr(),
            value.as_ptr(),
            ptr::null(),
            &mut status,
        );
    }
    fitsio::errors::check_status(status)
}

/// Writes a real number to the header in use with all its digits; [`FitsHdu::write_key`] keeps fifteen.
fn write_real(file: &mut FitsFile, key: &str, value: f64) -> fitsio::errors::Result<()> {
    /// Significant digits that distinguish any two numbers; negative if leading zeros do not count.
    const DIGITS: c_int = -17;
    let name = CString::new(key)?;
    let mut status = 0;
    // SAFETY: the file is open, the name ends in a zero byte, and there is no comment.
    unsafe {
        fitsio::sys::ffpkyd(
            file.as_raw(),
            name.as_ptr(),
            value,
            DIGITS,
            ptr::null(),
            &mut status,
        );
    }
    fitsio::errors::check_status(status)
}

/// Values of a column in the types that are written.
enum Values {
    Real(Vec<f64>),
    Whole(Vec<i64>),
    Text(Vec<String>),
}

impl Values {
    fn of(column: &Column) -> Self {
        let series = column.as_materialized_series();
        if let Ok(whole) = series.i64() {
            return Values::Whole(whole.iter().flatten().collect());
        }
        match reals(column) {
            Some(values) => Values::Real(values.into_owned()),
            None => {
                let words = series.str().into_iter().flat_map(|words| words.iter());
                Values::Text(words.map(|word| word.unwrap_or("").to_owned()).collect())
            }
        }
    }
}

/// Writes `table` as the only binary table of a file, with `header` keys of at most eight characters.
///
/// # Errors
/// If the file cannot be written.
pub fn write_table(
    path: &Path,
    table: &DataFrame,
    header: &[(&str, Value)],
) -> Result<(), FileError> {
    plain_name(path)?;
    let bytes = table_bytes(table, header).map_err(cannot(path))?;
    atomic::write(path, &bytes)
}

fn table_bytes(table: &DataFrame, header: &[(&str, Value)]) -> fitsio::errors::Result<Vec<u8>> {
    let _guard = lock();
    let mut file = FitsFile::create(IN_MEMORY).open()?;
    let mut bytes = header_blocks(&mut file)?;
    let columns: Vec<(&str, Values)> = table
        .columns()
        .iter()
        .map(|column| (column.name().as_str(), Values::of(column)))
        .collect();
    let mut descriptions = Vec::new();
    let mut width = 0;
    for (name, values) in &columns {
        let mut description = ColumnDescription::new(*name);
        let (kind, each) = match values {
            Values::Real(_) => (ColumnDataType::Double, size_of::<f64>()),
            Values::Whole(_) => (ColumnDataType::LongLong, size_of::<i64>()),
            Values::Text(words) => {
                let longest = words.iter().map(String::len).max().unwrap_or(0).max(1);
                description.that_repeats(longest);
                (ColumnDataType::String, longest)
            }
        };
        width += each;
        descriptions.push(description.with_type(kind).create()?);
    }
    let hdu = file.create_table("CATALOGUE", &descriptions)?;
    for (name, values) in &columns {
        match values {
            Values::Real(values) => hdu.write_col(&mut file, *name, values),
            Values::Whole(values) => hdu.write_col(&mut file, *name, values),
            Values::Text(values) => hdu.write_col(&mut file, *name, values),
        }?;
    }
    write_header(&mut file, &hdu, header)?;
    bytes.extend(header_blocks(&mut file)?);
    let mut data = vec![0; width * table.height()];
    let mut status = 0;
    // SAFETY: the file is open at the table, of whose rows `data` has room for all bytes.
    unsafe {
        sys::ffgtbb(
            file.as_raw(),
            1,
            1,
            i64::try_from(data.len()).unwrap_or(i64::MAX),
            data.as_mut_ptr(),
            &mut status,
        );
    }
    fitsio::errors::check_status(status)?;
    data.resize(data.len().next_multiple_of(BLOCK), 0);
    bytes.extend(data);
    Ok(bytes)
}

/// Refuses names that cfitsio does not treat as plain: those with `[...]`, `(...)`, a leading `!` or `-`, or a trailing `+n`.
fn plain_name(path: &Path) -> Result<(), FileError> {
    let Some(name) = path.to_str() else {
        return Err(FileError::new(path, "FITS file names must be UTF-8"));
    };
    let plus = name
        .rsplit_once('+')
        .is_some_and(|(_, end)| !end.is_empty() && end.bytes().all(|b| b.is_ascii_digit()));
    if name.contains(['[', ']', '(', ')'])
        || name.starts_with(['!', '-'])
        || name.contains("://")
        || plus
    {
        return Err(FileError::new(
            path,
            "FITS file names must not contain brackets or `://`, start with `!` or `-`, or end in `+` and a number",
        ));
    }
    Ok(())
}

/// The text of an error of the crate `fitsio`.
fn describe(error: fitsio::errors::Error) -> String {
    match error {
        fitsio::errors::Error::Fits(e) => cfitsio::describe(e.status),
        other => other.to_string(),
    }
}
