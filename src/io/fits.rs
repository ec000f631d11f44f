//! FITS images by strips of rows, and FITS binary tables. The only user of cfitsio.
//!
//! cfitsio is not safe to call from several threads, so every call goes through one lock. Images
//! are read and written row by row in FITS order: the first row of the file is y = 1, row-major.
//! gzip and tile-compressed (fpack) images are read like plain ones.

mod cards;
mod file;
mod read;
mod source;
mod streams;
mod tiles;

pub use read::{ImageReader, read_table, read_table_keys};

use std::ffi::{CString, c_int};
use std::path::Path;
use std::ptr;
use std::sync::{Mutex, MutexGuard, PoisonError};

use fitsio::FitsFile;
use fitsio::hdu::FitsHdu;
use fitsio::images::{ImageDescription, ImageType};
use fitsio::tables::{ColumnDataType, ColumnDescription};
use shearq_tables::polars::{Column, DataFrame};
use shearq_tables::reals;

use super::atomic::PartFile;
use super::error::FileError;

static CFITSIO: Mutex<()> = Mutex::new(());

/// The lock around every cfitsio call. A panic elsewhere leaves cfitsio itself in order.
fn lock() -> MutexGuard<'static, ()> {
    CFITSIO.lock().unwrap_or_else(PoisonError::into_inner)
}

/// cfitsio reads `[...]`, `(...)`, a leading `!` or `-` and a trailing `+n` of a name as commands.
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
            "FITS file names must not hold brackets or `://`, start with `!` or `-`, or end in `+` and a number",
        ));
    }
    Ok(())
}

fn describe(error: fitsio::errors::Error) -> String {
    match error {
        fitsio::errors::Error::Fits(e) => file::describe(e.status),
        other => other.to_string(),
    }
}

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

/// Closes its file under the lock: closing is a cfitsio call like any other.
struct Handle(Option<FitsFile>);

impl Handle {
    /// The open file.
    fn get(&mut self) -> &mut FitsFile {
        self.0.as_mut().expect("the file is open until dropped")
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        let _guard = lock();
        self.0 = None;
    }
}

/// An image being written.
pub struct ImageWriter {
    file: Handle,
    hdu: FitsHdu,
    part: PartFile,
    width: usize,
    height: usize,
    next_row: usize,
}

impl ImageWriter {
    /// Starts an image of 32-bit floats.
    ///
    /// # Errors
    /// Where the file cannot be made.
    pub fn create(
        path: impl AsRef<Path>,
        width: usize,
        height: usize,
        header: &[(&str, Value)],
    ) -> Result<Self, FileError> {
        let path = path.as_ref();
        plain_name(path)?;
        let mut part = PartFile::new(path)?;
        let _guard = lock();
        let cannot = |e| FileError::new(path, format!("cannot write the image: {}", describe(e)));
        let description = ImageDescription {
            data_type: ImageType::Float,
            dimensions: &[height, width],
        };
        let mut file = FitsFile::create(part.path())
            .with_custom_primary(&description)
            .open()
            .map_err(cannot)?;
        part.hold();
        let hdu = file.primary_hdu().map_err(cannot)?;
        write_header(&mut file, &hdu, header).map_err(cannot)?;
        Ok(ImageWriter {
            file: Handle(Some(file)),
            hdu,
            part,
            width,
            height,
            next_row: 0,
        })
    }

    /// Writes the next rows.
    ///
    /// # Errors
    /// Where they cannot be written, or are not whole rows of this image.
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
        let _guard = lock();
        let start = self.next_row * self.width;
        self.hdu
            .write_section(self.file.get(), start, start + pixels.len(), pixels)
            .map_err(|e| {
                FileError::new(
                    self.part.target(),
                    format!("cannot write the image: {}", describe(e)),
                )
            })?;
        self.next_row += rows;
        Ok(())
    }

    /// Closes the file and gives it its name.
    ///
    /// # Errors
    /// Where rows are missing or the file cannot be closed.
    pub fn finish(self) -> Result<(), FileError> {
        self.closed()?.finish()
    }

    /// The same unless a file has its name by now, of which nothing changes then. Returns whether this is the file
    /// of that name.
    ///
    /// # Errors
    /// As [`ImageWriter::finish`].
    pub fn finish_if_absent(self) -> Result<bool, FileError> {
        self.closed()?.finish_if_absent()
    }

    fn closed(self) -> Result<PartFile, FileError> {
        let ImageWriter {
            file,
            part,
            height,
            next_row,
            ..
        } = self;
        if next_row != height {
            return Err(FileError::new(
                part.target(),
                format!("{next_row} of {height} rows were written"),
            ));
        }
        close(file, part.target())?;
        Ok(part)
    }
}

/// Flushes and closes; cfitsio reports a full disk here.
fn close(mut file: Handle, target: &Path) -> Result<(), FileError> {
    let _guard = lock();
    let Some(mut file) = file.0.take() else {
        return Ok(());
    };
    let mut status = 0;
    // SAFETY: the pointer is that of an open file. Dropping a `FitsFile` would write the same data
    // but ignore a failure.
    unsafe { fitsio::sys::ffflus(file.as_raw(), &mut status) };
    if status == 0 {
        Ok(())
    } else {
        Err(FileError::new(
            target,
            format!("cannot write the file: cfitsio error {status} while flushing"),
        ))
    }
}

fn write_header(
    file: &mut FitsFile,
    hdu: &FitsHdu,
    header: &[(&str, Value)],
) -> fitsio::errors::Result<()> {
    for (key, value) in header {
        match value {
            Value::Int(v) => hdu.write_key(file, key, *v)?,
            Value::Real(v) => write_real(file, key, *v)?,
            Value::Text(v) => hdu.write_key(file, key, v.as_str())?,
        }
    }
    Ok(())
}

/// Writes a real number to the header in use with all its digits; [`FitsHdu::write_key`] keeps fifteen.
fn write_real(file: &mut FitsFile, key: &str, value: f64) -> fitsio::errors::Result<()> {
    /// Significant digits that tell any two numbers apart; negative where leading zeros do not count.
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
/// Where the file cannot be written.
pub fn write_table(
    path: &Path,
    table: &DataFrame,
    header: &[(&str, Value)],
) -> Result<(), FileError> {
    plain_name(path)?;
    let part = PartFile::new(path)?;
    let file = {
        let _guard = lock();
        let cannot = |e| FileError::new(path, format!("cannot write the table: {}", describe(e)));
        let mut file = FitsFile::create(part.path()).open().map_err(cannot)?;
        let columns: Vec<(&str, Values)> = table
            .columns()
            .iter()
            .map(|column| (column.name().as_str(), Values::of(column)))
            .collect();
        let mut descriptions = Vec::new();
        for (name, values) in &columns {
            let mut description = ColumnDescription::new(*name);
            let kind = match values {
                Values::Real(_) => ColumnDataType::Double,
                Values::Whole(_) => ColumnDataType::LongLong,
                Values::Text(words) => {
                    let longest = words.iter().map(String::len).max().unwrap_or(0);
                    description.that_repeats(longest.max(1));
                    ColumnDataType::String
                }
            };
            descriptions.push(description.with_type(kind).create().map_err(cannot)?);
        }
        let hdu = file
            .create_table("CATALOGUE", &descriptions)
            .map_err(cannot)?;
        for (name, values) in &columns {
            match values {
                Values::Real(values) => hdu.write_col(&mut file, *name, values),
                Values::Whole(values) => hdu.write_col(&mut file, *name, values),
                Values::Text(values) => hdu.write_col(&mut file, *name, values),
            }
            .map_err(cannot)?;
        }
        write_header(&mut file, &hdu, header).map_err(cannot)?;
        Handle(Some(file))
    };
    close(file, path)?;
    part.finish()
}
