//! Parquet tables, by way of the crate that holds polars.

use std::collections::BTreeMap;
use std::path::Path;

use shearq_tables as tables;

use super::atomic;
use super::error::FileError;
use super::table::{Column, Table};

/// Reads columns as real numbers.
pub(super) fn read(path: &Path, wanted: Option<&[&str]>) -> Result<Table, FileError> {
    let table = tables::read_parquet(path, wanted).map_err(|error| bare(path, &error))?;
    let mut columns = Vec::new();
    for (name, column) in table.columns() {
        match column.to_f64() {
            Some(values) => columns.push((name.clone(), Column::Real(values))),
            None if wanted.is_none() => {}
            None => {
                let message = format!("column `{name}` holds text; expected numbers");
                return Err(FileError::new(path, message));
            }
        }
    }
    Table::new(columns).map_err(|message| FileError::new(path, message))
}

/// The metadata in the footer.
pub(super) fn metadata(path: &Path) -> Result<BTreeMap<String, String>, FileError> {
    tables::parquet_metadata(path).map_err(|error| bare(path, &error))
}

/// Writes the table with its metadata in the footer.
pub(super) fn write(
    path: &Path,
    table: Table,
    metadata: &BTreeMap<String, String>,
) -> Result<(), FileError> {
    let columns = table
        .columns()
        .iter()
        .map(|(name, column)| {
            let column = match column {
                Column::Real(values) => tables::Column::F64(values.clone()),
                Column::Whole(values) => tables::Column::I64(values.clone()),
                Column::Text(values) => tables::Column::Text(values.clone()),
            };
            (name.clone(), column)
        })
        .collect();
    let table =
        tables::Table::new(columns, metadata.clone()).map_err(|error| bare(path, &error))?;
    let mut bytes = Vec::new();
    tables::write_parquet(&mut bytes, &table).map_err(|error| bare(path, &error))?;
    atomic::write(path, &bytes)
}

/// The crate's errors name the file already; keep the name once.
pub(super) fn bare(path: &Path, error: &tables::TableError) -> FileError {
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
