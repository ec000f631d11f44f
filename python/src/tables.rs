//! Tables of named columns in files, as the command line reads and writes them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::{IntoPyArray, PyReadonlyArray1};
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_dataset::fingerprint::of_image;
use shearq_files::FileError;
use shearq_files::frames::polars::Column;
use shearq_files::frames::{frame, reals};
use shearq_files::table::{self, FileFormat, MAX_ROWS, Place};

use crate::errors::chosen;

// Python's own exception for a wrong path, because scripts catch it.
fn of_file(path: &std::path::Path, error: &FileError) -> PyErr {
    if path.exists() {
        PyValueError::new_err(error.to_string())
    } else {
        PyFileNotFoundError::new_err(error.to_string())
    }
}

fn format(name: &str) -> PyResult<FileFormat> {
    chosen("format", name, r#""parquet" or "fits""#)
}

/// The fingerprint of a file, as results of the command line state it; None of anything else.
#[pyfunction]
pub(crate) fn fingerprint(path: PathBuf) -> Option<String> {
    let path = Place::of(&path).path;
    path.is_file().then(|| of_image(&path).ok())?
}

/// The columns of numbers of a table by name, and those of the metadata `keys` that it has.
#[pyfunction]
pub(crate) fn read_table<'py>(
    py: Python<'py>,
    path: PathBuf,
    format: &str,
    keys: Vec<String>,
) -> PyResult<(Bound<'py, PyDict>, BTreeMap<String, String>)> {
    let format = self::format(format)?;
    let (read, metadata) = py
        .detach(|| {
            let read = table::read(&path, None, MAX_ROWS)?;
            Ok((read, table::read_metadata(&path, format, keys.iter())?))
        })
        .map_err(|error: FileError| of_file(&path, &error))?;
    let columns = PyDict::new(py);
    for column in read.columns() {
        let (name, series) = (column.name().as_str(), column.as_materialized_series());
        // numpy has no missing integers: a column with nulls becomes floats with NaN.
        if let Ok(whole) = series.i64()
            && whole.null_count() == 0
        {
            let values: Vec<i64> = whole.iter().flatten().collect();
            columns.set_item(name, values.into_pyarray(py))?;
        } else if let Some(values) = reals(column) {
            columns.set_item(name, values.into_owned().into_pyarray(py))?;
        }
    }
    Ok((columns, metadata))
}

/// Writes columns of reals or whole numbers with text metadata: completely or not at all.
#[pyfunction]
pub(crate) fn write_table(
    py: Python<'_>,
    path: PathBuf,
    format: &str,
    columns: Vec<(String, Bound<'_, PyAny>)>,
    metadata: BTreeMap<String, String>,
) -> PyResult<()> {
    let format = self::format(format)?;
    let columns = columns.iter().map(|(name, values)| {
        let label = name.as_str().into();
        if let Ok(reals) = values.extract::<PyReadonlyArray1<'_, f64>>() {
            return Ok(Column::new(label, reals.as_slice()?));
        }
        if let Ok(whole) = values.extract::<PyReadonlyArray1<'_, i64>>() {
            return Ok(Column::new(label, whole.as_slice()?));
        }
        Err(PyTypeError::new_err(format!("{name}: expected numbers")))
    });
    let columns: Vec<Column> = columns.collect::<PyResult<_>>()?;
    let table = frame(columns).map_err(|error| PyValueError::new_err(error.to_string()))?;
    py.detach(|| table::write(&path, format, &table, &metadata))
        .map_err(|error| PyOSError::new_err(error.to_string()))
}
