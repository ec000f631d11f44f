//! Cuts and weights on the columns of a catalogue.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::Path;

use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use shearq_catalogue::expression::Operand;
use shearq_catalogue::select::smooth_selection;
use shearq_catalogue::shapes::MeasuredShapes;
use shearq_files::FileError;

// e1, e2, R11, R22, R12 and R21 before calibration, and the weight.
type Selected<'py> = [Bound<'py, PyArray1<f64>>; 7];

/// Applies cuts and a weight to the columns of a catalogue.
#[pyfunction]
pub(crate) fn select<'py>(
    py: Python<'py>,
    columns: HashMap<String, PyReadonlyArray1<'py, f64>>,
    condition: Option<&str>,
    weight: Option<&str>,
) -> PyResult<Selected<'py>> {
    let fault = |error: &dyn std::fmt::Display| PyValueError::new_err(error.to_string());
    let selection = smooth_selection(condition, weight, &[]).map_err(|error| fault(&error))?;
    // Stands for the file in messages.
    let path = Path::new("catalogue");
    let column = |name: &str| {
        let found = columns.get(name).and_then(|values| values.as_slice().ok());
        let lacks = || {
            FileError::new(
                path,
                format!("no column {name} (expected the columns of a linear configuration)"),
            )
        };
        found.map(Cow::Borrowed).ok_or_else(lacks)
    };
    let stated = selection.unwrap_or_default();
    let weights = stated.weights.clone().unwrap_or_default();
    let operand = |own: &Operand| match own.texts {
        None => Ok(own.of_numbers(column(&own.column)?)),
        Some(_) => {
            let name = &own.column;
            let message = format!("column {name} is compared with a text (expected numbers)");
            Err(FileError::new(path, message))
        }
    };
    let selected = || -> Result<_, FileError> {
        let mut shapes = MeasuredShapes::of(column, true)?;
        shapes.weigh(path, 0, &weights, column)?;
        if let Some(condition) = &stated.rows {
            shapes.keep(path, condition, operand)?;
        }
        Ok(shapes)
    };
    let shapes = selected().map_err(|error| fault(&error))?;
    Ok(shapes.columns().map(|values| values.into_pyarray(py)))
}
