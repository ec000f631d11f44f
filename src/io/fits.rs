//! FITS images by strips of rows, and FITS binary tables. The only user of cfitsio.
//!
//! cfitsio is not safe to call from several threads, so every call goes through one lock. Images
//! are read and written row by row in FITS order: the first row of the file is y = 1, row-major.
//! gzip and tile-compressed (fpack) images are read like plain ones.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use fitsio::FitsFile;
use fitsio::hdu::{FitsHdu, HduInfo};
use fitsio::images::{ImageDescription, ImageType};
use fitsio::tables::{ColumnDataType, ColumnDescription};

use super::atomic::PartFile;
use super::error::FileError;
use super::table::{Column, Table};

/// Largest image side accepted, against absurd sizes in damaged headers.
const MAX_SIDE: usize = 200_000;
/// Most rows of a table accepted.
const MAX_ROWS: usize = 200_000_000;

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
        fitsio::errors::Error::Fits(e) => format!("cfitsio error {}: {}", e.status, e.message),
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

/// An image open for reading.
pub struct ImageReader {
    file: Handle,
    hdu: FitsHdu,
    path: std::path::PathBuf,
    width: usize,
    height: usize,
    next_row: usize,
}

impl ImageReader {
    /// Opens the first image of a file: the primary one, or that of the first extension where the
    /// primary is empty (as fpack writes it).
    ///
    /// # Errors
    /// Where the file cannot be read or holds no two-dimensional image of sensible size.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, FileError> {
        let path = path.as_ref();
        plain_name(path)?;
        // cfitsio's own message for a missing file is a bare number.
        let size = std::fs::metadata(path)
            .map_err(FileError::doing(path, "cannot open the image"))?
            .len();
        if size == 0 {
            return Err(FileError::new(
                path,
                "the file is empty; expected a FITS image",
            ));
        }
        let _guard = lock();
        let cannot = |e| FileError::new(path, format!("cannot open the image: {}", describe(e)));
        let mut file = FitsFile::open(path).map_err(cannot)?;
        let mut hdu = file.primary_hdu().map_err(cannot)?;
        let mut place = "primary";
        if let HduInfo::ImageInfo { shape, .. } = &hdu.info
            && shape.is_empty()
            && file.num_hdus().map_err(cannot)? > 1
        {
            hdu = file.hdu(1).map_err(cannot)?;
            place = "first extension";
        }
        let shape = match &hdu.info {
            HduInfo::ImageInfo { shape, .. } => shape.clone(),
            _ => {
                return Err(FileError::new(
                    path,
                    format!("the {place} is a table; expected a two-dimensional image"),
                ));
            }
        };
        let &[height, width] = shape.as_slice() else {
            return Err(FileError::new(
                path,
                format!(
                    "the {place} image has {} dimensions; expected 2",
                    shape.len()
                ),
            ));
        };
        if !(1..=MAX_SIDE).contains(&width) || !(1..=MAX_SIDE).contains(&height) {
            return Err(FileError::new(
                path,
                format!("the image is {width} × {height} pixels; expected 1 to {MAX_SIDE} a side"),
            ));
        }
        Ok(ImageReader {
            file: Handle(Some(file)),
            hdu,
            path: path.to_owned(),
            width,
            height,
            next_row: 0,
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

    /// A numeric header value, `None` where absent or not a number.
    pub fn number(&mut self, key: &str) -> Option<f64> {
        let _guard = lock();
        self.hdu.read_key::<f64>(self.file.get(), key).ok()
    }

    /// The next `rows` rows, or fewer at the end of the image.
    ///
    /// # Errors
    /// Where the pixels cannot be read, as in a truncated file.
    pub fn read_rows(&mut self, rows: usize) -> Result<Vec<f32>, FileError> {
        let first = self.next_row;
        let last = (first + rows).min(self.height);
        let _guard = lock();
        let pixels = self
            .hdu
            .read_section::<Vec<f32>>(self.file.get(), first * self.width, last * self.width)
            .map_err(|e| {
                FileError::new(
                    &self.path,
                    format!(
                        "cannot read rows {} to {last} of {}: {}",
                        first + 1,
                        self.height,
                        describe(e)
                    ),
                )
            })?;
        self.next_row = last;
        Ok(pixels)
    }
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
        let part = PartFile::new(path)?;
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
        part.finish()
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
            Value::Real(v) => hdu.write_key(file, key, *v)?,
            Value::Text(v) => hdu.write_key(file, key, v.as_str())?,
        }
    }
    Ok(())
}

/// Writes `table` as the only binary table of a file, with `header` keys of at most eight characters.
///
/// # Errors
/// Where the file cannot be written.
pub fn write_table(path: &Path, table: &Table, header: &[(&str, Value)]) -> Result<(), FileError> {
    plain_name(path)?;
    let part = PartFile::new(path)?;
    let file = {
        let _guard = lock();
        let cannot = |e| FileError::new(path, format!("cannot write the table: {}", describe(e)));
        let mut file = FitsFile::create(part.path()).open().map_err(cannot)?;
        let mut descriptions = Vec::new();
        for (name, column) in table.columns() {
            let kind = match column {
                Column::Real(_) => ColumnDataType::Double,
                Column::Whole(_) => ColumnDataType::LongLong,
                Column::Text(_) => ColumnDataType::String,
            };
            let mut description = ColumnDescription::new(name.as_str());
            if let Column::Text(words) = column {
                let longest = words.iter().map(String::len).max().unwrap_or(0);
                description.that_repeats(longest.max(1));
            }
            descriptions.push(description.with_type(kind).create().map_err(cannot)?);
        }
        let hdu = file
            .create_table("CATALOGUE", &descriptions)
            .map_err(cannot)?;
        for (name, column) in table.columns() {
            match column {
                Column::Real(values) => hdu.write_col(&mut file, name.as_str(), values),
                Column::Whole(values) => hdu.write_col(&mut file, name.as_str(), values),
                Column::Text(values) => hdu.write_col(&mut file, name.as_str(), values),
            }
            .map_err(cannot)?;
        }
        write_header(&mut file, &hdu, header).map_err(cannot)?;
        Handle(Some(file))
    };
    close(file, path)?;
    part.finish()
}

/// Text values of the header of a table that [`write_table`] wrote, of those of `keys` that are there.
///
/// # Errors
/// Where the file cannot be read.
pub fn read_table_keys<'a>(
    path: &Path,
    keys: impl Iterator<Item = &'a String>,
) -> Result<BTreeMap<String, String>, FileError> {
    plain_name(path)?;
    let _guard = lock();
    let cannot = |e| FileError::new(path, format!("cannot read the table: {}", describe(e)));
    let mut file = FitsFile::open(path).map_err(cannot)?;
    let hdu = file.hdu(1).map_err(cannot)?;
    let mut value = |key: &String| {
        let value = hdu.read_key(&mut file, &key.to_ascii_uppercase()).ok()?;
        Some((key.clone(), value))
    };
    Ok(keys.filter_map(&mut value).collect())
}

/// Columns of the first binary table of a file: those of `wanted`, or all that are numbers.
///
/// # Errors
/// Where the file cannot be read, holds no table, or lacks a column.
pub fn read_table(path: &Path, wanted: Option<&[&str]>) -> Result<Table, FileError> {
    plain_name(path)?;
    std::fs::metadata(path).map_err(FileError::doing(path, "cannot open the table"))?;
    let _guard = lock();
    let cannot = |e| FileError::new(path, format!("cannot read the table: {}", describe(e)));
    let mut file = FitsFile::open(path).map_err(cannot)?;
    let count = file.num_hdus().map_err(cannot)?;
    for index in 0..count {
        let hdu = file.hdu(index).map_err(cannot)?;
        let HduInfo::TableInfo {
            column_descriptions,
            num_rows,
        } = &hdu.info
        else {
            continue;
        };
        if *num_rows > MAX_ROWS {
            return Err(FileError::new(
                path,
                format!("the table says it has {num_rows} rows; expected at most {MAX_ROWS}"),
            ));
        }
        let known: Vec<&str> = column_descriptions
            .iter()
            .map(|c| c.name.as_str())
            .collect();
        let mut columns = Vec::new();
        for description in column_descriptions {
            let name = description.name.as_str();
            let asked = wanted.is_none_or(|w| w.contains(&name));
            let text = matches!(description.data_type.typ, ColumnDataType::String);
            if !asked || (text && wanted.is_none()) {
                continue;
            }
            if text || description.data_type.repeat != 1 {
                return Err(FileError::new(
                    path,
                    format!("column `{name}` does not hold one number per row"),
                ));
            }
            let values: Vec<f64> = hdu.read_col(&mut file, name).map_err(cannot)?;
            columns.push((name.to_owned(), Column::Real(values)));
        }
        if let Some(missing) = wanted.and_then(|w| w.iter().find(|name| !known.contains(name))) {
            return Err(FileError::new(
                path,
                format!(
                    "there is no column `{missing}`; columns found: {}",
                    known.join(", ")
                ),
            ));
        }
        return Table::new(columns).map_err(|message| FileError::new(path, message));
    }
    Err(FileError::new(path, "there is no table in this file"))
}
