//! Stamps in numpy arrays, which are viewed without a copy if possible. Others are converted one row of the image at a time, so
//! that a memory-mapped FITS file, whose bytes are big-endian, is never in memory as a whole.

use std::ops::Range;

use ndarray::{ArrayView3, Ix3};
use numpy::{PyArray3, PyArrayMethods, PyReadonlyArray3, PyUntypedArray, PyUntypedArrayMethods};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PySlice;
use shearq_measure::Pixels;

// Of shape `(n, ny, nx)`.
pub(crate) enum Borrowed<'py> {
    Single(PyReadonlyArray3<'py, f32>),
    Double(PyReadonlyArray3<'py, f64>),
    /// Other types, another byte order, or not aligned, as in FITS files and records.
    Other(Bound<'py, PyUntypedArray>),
}

impl<'py> Borrowed<'py> {
    pub(crate) fn new(array: &Bound<'py, PyAny>) -> PyResult<Self> {
        let array = array.cast::<PyUntypedArray>()?;
        if array.ndim() != 3 {
            return Err(PyTypeError::new_err("expected an array of three axes"));
        }
        // Rust references to unaligned floats are undefined behaviour.
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

    // Without references to the interpreter, so that threads can use it while the interpreter is released.
    pub(crate) fn shared(&self) -> Stamps<'_> {
        match self {
            Borrowed::Single(array) => Stamps::Single(array.as_array()),
            Borrowed::Double(array) => Stamps::Double(array.as_array()),
            Borrowed::Other(array) => Stamps::Other(array.as_any().clone().unbind()),
        }
    }
}

pub(crate) enum Stamps<'a> {
    Single(ArrayView3<'a, f32>),
    Double(ArrayView3<'a, f64>),
    Other(Py<PyAny>),
}

impl<'a> Stamps<'a> {
    // Only `Other` needs the interpreter, for numpy's `astype`, which knows all of its types.
    pub(crate) fn slice(&self, range: Range<usize>) -> PyResult<Pixels<'a, Ix3>> {
        // Views are copied (not their pixels), because the result outlives this borrow.
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
