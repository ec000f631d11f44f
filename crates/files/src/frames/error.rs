//! Errors of tables. Messages contain the file, the place, the found and the expected value.

use std::path::PathBuf;

/// Why a table could not be built, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TableError {
    /// The file could not be opened or read.
    #[error("{}: cannot read the file: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: std::io::Error,
    },
    /// The file is no Parquet file, or a damaged or truncated one.
    #[error("{}: not a readable Parquet file, or damaged: {detail}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The fault.
        detail: String,
    },
    /// The file has more rows than the caller can use.
    #[error("{}: found {found} rows, expected at most {most}", path.display())]
    TooManyRows {
        /// The file.
        path: PathBuf,
        /// Its number of rows.
        found: usize,
        /// The largest number of rows that is read.
        most: usize,
    },
    /// A wanted column is not in the file.
    #[error(
        "{}: no column `{wanted}`; the file has {}",
        path.display(),
        name_list(present)
    )]
    MissingColumn {
        /// The file.
        path: PathBuf,
        /// The requested name.
        wanted: String,
        /// The names in the file, in file order.
        present: Vec<String>,
    },
    /// A column is neither of numbers nor of text.
    #[error(
        "{}: column `{column}` has type {found}; expected integers of at most 64 bits, \
         32- or 64-bit floats, booleans or text",
        path.display()
    )]
    UnsupportedType {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
        /// The type found.
        found: String,
    },
    /// A column that is not of floats has missing values.
    #[error(
        "{}: column `{column}` has {count} missing value(s); only float columns may have any \
         (they become NaN)",
        path.display()
    )]
    MissingValues {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
        /// How many of its values are missing.
        count: usize,
    },
    /// Two columns of a table have one name, or one column was requested twice.
    #[error("column `{name}` is named twice; expected every name once")]
    DuplicateColumn {
        /// The name.
        name: String,
    },
    /// The columns of a table have different lengths.
    #[error(
        "column `{column}` has {found} rows; expected {expected}, as in the first column `{first}`"
    )]
    UnequalLengths {
        /// The column that differs.
        column: String,
        /// Its number of rows.
        found: usize,
        /// The first column.
        first: String,
        /// The first column's number of rows.
        expected: usize,
    },
    /// Columns that make no frame for another reason.
    #[error("cannot make a table: {detail}")]
    Invalid {
        /// The message of polars.
        detail: String,
    },
    /// A metadata key is one that the file format uses for itself.
    #[error("metadata key `{key}` is reserved for the file's own schema; use another")]
    ReservedKey {
        /// The key.
        key: String,
    },
    /// Writing failed, in the encoder or in the writer behind it.
    #[error("cannot write the Parquet table: {detail}")]
    Write {
        /// The fault.
        detail: String,
    },
}

/// The names, quoted and separated by commas, or that there are none.
fn name_list(names: &[String]) -> String {
    if names.is_empty() {
        return "no columns".into();
    }
    let quoted: Vec<String> = names.iter().map(|name| format!("`{name}`")).collect();
    quoted.join(", ")
}
