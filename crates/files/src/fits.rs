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
mod write;

pub use read::{ImageReader, TableHead, read_table, read_table_keys, read_table_parts, tables};
pub use write::{ImageWriter, Value, write_table};

use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::error::FileError;

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
