//! Stamps of Python: viewed without a copy if possible, otherwise converted row by row.

use std::ops::Range;

use ndarray::{ArrayView3, Ix3};
use numpy::{PyArray3, PyArrayMethods, PyReadonlyArray3, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PySlice;
use shearq_measure::Pixels;

/// A borrowed array `(n, ny, nx)`.
pub(crate) enum Borrowed<'py> {
    Single(PyReadonlyArray3<'py, f32>),
    Double(PyReadonlyArray3<'py, f64>),
    /// Other types, another byte order, or not aligned, as in FITS files and records.
    Other(Bound<'py, PyUntypedArray>),
}

impl<'py> Borrowed<'py> {
    /// Borrows an array of three axes.
    ///
    /// # Errors
    /// If it has another number of axes.
    pub(crate) fn new(array: &Bound<'py, PyAny>) -> PyResult<Self> {
        let array = array.cast::<PyUntypedArray>()?;
        if array.ndim() != 3 {
            return Err(PyTypeError::new_err("expected an array of three axes"));
        }
        // Views of unaligned memory are undefined.
        if array.is_aligned() {
            if let Ok(single) = array.cast::<PyArray3<f32>>() {
                return Ok(Borrowed::Single(single.try_readonly()?));
            }
            if let Ok(double) = array.cast::<PyArray3<f64>>() {
                return Ok(Borrowed::Double(double.try_readonly()?));
            }
        }
        Ok(Borrowed::Other(array.clone()))
    }

    /// Number of stamps, rows and columns.
    pub(crate) fn dim(&self) -> (usize, usize, usize) {
        match self {
            Borrowed::Single(array) => array.as_array().dim(),
            Borrowed::Double(array) => array.as_array().dim(),
            Borrowed::Other(array) => {
                let shape = array.shape();
                (shape[0], shape[1], shape[2])
            }
        }
    }

    /// The form that threads without the interpreter share.
    pub(crate) fn shared(&self) -> Stamps<'_> {
        match self {
            Borrowed::Single(array) => Stamps::Single(array.as_array()),
            Borrowed::Double(array) => Stamps::Double(array.as_array()),
            Borrowed::Other(array) => Stamps::Other(array.as_any().clone().unbind()),
        }
    }
}

/// Many stamps.
pub(crate) enum Stamps<'a> {
    Single(ArrayView3<'a, f32>),
    Double(ArrayView3<'a, f64>),
    Other(Py<PyAny>),
}

impl<'a> Stamps<'a> {
    /// Some of the stamps. Converting them requires the interpreter.
    ///
    /// # Errors
    /// An exception of the conversion.
    pub(crate) fn slice(&self, range: Range<usize>) -> PyResult<Pixels<'a, Ix3>> {
        // Copies of the views live longer than this borrow.
        Ok(match self {
            Stamps::Single(all) => Pixels::from(*all).into_slice(range),
            Stamps::Double(all) => Pixels::from(*all).into_slice(range),
            Stamps::Other(all) => Python::attach(|py| {
                let range = PySlice::new(py, range.start as isize, range.end as isize, 1);
                let part = all.bind(py).get_item(range)?;
                let copy = part.call_method1("astype", ("=f8",))?;
                let copy = copy.cast::<PyArray3<f64>>()?;
                PyResult::Ok(copy.try_readonly()?.as_array().to_owned().into())
            })?,
        })
    }
}
