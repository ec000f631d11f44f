//! Parquet tables of numbers.

use std::path::Path;

use crate::frames::polars::DataFrame;
use crate::frames::{self as tables, Metadata};

use crate::atomic;
use crate::error::FileError;

/// Reads columns of numbers, at most `most_rows` rows: the columns `wanted`, or all.
pub(super) fn read(
    path: &Path,
    wanted: Option<&[&str]>,
    most_rows: usize,
) -> Result<DataFrame, FileError> {
    let mut table =
        tables::read_parquet(path, wanted, most_rows).map_err(|error| bare(path, &error))?;
    let texts: Vec<String> = table
        .columns()
        .iter()
        .filter(|column| column.dtype().is_string())
        .map(|column| column.name().to_string())
        .collect();
    if let (Some(name), Some(_)) = (texts.first(), wanted) {
        let message = format!("column `{name}` holds text; expected numbers");
        return Err(FileError::new(path, message));
    }
    table = table.drop_many(texts);
    Ok(table)
}

/// Reads columns of numbers or text by row groups.
pub(super) fn read_groups(
    path: &Path,
    wanted: &[&str],
    most_rows: usize,
    mut take: impl FnMut(DataFrame) -> Result<(), FileError>,
) -> Result<(), FileError> {
    enum Failure {
        Read(tables::TableError),
        Taken(FileError),
    }
    impl From<tables::TableError> for Failure {
        fn from(error: tables::TableError) -> Self {
            Failure::Read(error)
        }
    }
    let take = |group| take(group).map_err(Failure::Taken);
    tables::read_parquet_groups(path, wanted, most_rows, take).map_err(|failure| match failure {
        Failure::Read(error) => bare(path, &error),
        Failure::Taken(error) => error,
    })
}

/// The names of the columns.
pub(super) fn columns(path: &Path) -> Result<Vec<String>, FileError> {
    tables::parquet_columns(path).map_err(|error| bare(path, &error))
}

/// The metadata in the footer.
pub(super) fn metadata(path: &Path) -> Result<Metadata, FileError> {
    tables::parquet_metadata(path).map_err(|error| bare(path, &error))
}

/// Writes the table with its metadata in the footer.
pub(super) fn write(path: &Path, table: &DataFrame, metadata: &Metadata) -> Result<(), FileError> {
    let mut bytes = Vec::new();
    tables::write_parquet(&mut bytes, table, metadata).map_err(|error| bare(path, &error))?;
    atomic::write(path, &bytes)
}

/// The crate's errors name the file already; keep the name once.
pub fn bare(path: &Path, error: &tables::TableError) -> FileError {
    if let tables::TableError::MissingColumn {
        wanted, present, ..
    } = error
    {
        return FileError::no_column(path, wanted, present);
    }
    let message = error.to_string();
    let prefix = format!("{}: ", path.display());
    FileError::new(path, message.strip_prefix(&prefix).unwrap_or(&message))
}
