//! Images of files, and what headers state of their pixels.

use std::collections::BTreeMap;
use std::path::PathBuf;

use numpy::{IntoPyArray, PyArray3, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use shearq_pipeline::gather::{
    Content, GatheredPixels, HeaderPixels, PixelSize, is_aligned, pixel_difference,
    scale_difference,
};

type Matrix2 = [[f64; 2]; 2];
// Arcseconds per pixel, pixels of a PSF along a pixel of the galaxies, electrons per unit, and the level of saturation.
type Size = (Option<f64>, Option<f64>, Option<f64>, Option<f64>);
// Pixels (n, ny, nx), Jacobians (n, 2, 2) if the headers have them, why they are not those of a cube's stamps, the size of pixels, and
// messages.
type Images<'py> = (
    Bound<'py, PyArray3<f32>>,
    Option<Bound<'py, PyArray3<f64>>>,
    Option<String>,
    Size,
    Vec<String>,
);

// The same of one header, without pixels.
type Header = (Option<Matrix2>, Option<String>, Size, Vec<String>);

fn stacked<'py>(py: Python<'py>, matrices: Vec<Matrix2>) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let count = matrices.len();
    let all: Vec<f64> = matrices.into_iter().flatten().flatten().collect();
    let array = ndarray::Array3::from_shape_vec((count, 2, 2), all);
    let array = array.map_err(|error| PyValueError::new_err(error.to_string()))?;
    Ok(array.into_pyarray(py))
}

fn size_of(size: PixelSize) -> Size {
    let PixelSize {
        scale,
        oversampling,
        detector,
    } = size;
    (scale, oversampling, detector.gain, detector.saturation)
}

fn matrices(array: &PyReadonlyArray3<'_, f64>) -> Vec<Matrix2> {
    let rows = array.as_array();
    let of = |m: ndarray::ArrayView2<'_, f64>| [[m[(0, 0)], m[(0, 1)]], [m[(1, 0)], m[(1, 1)]]];
    rows.outer_iter().map(of).collect()
}

/// The images of a file, as `gather` reads stamps, or PSFs.
#[pyfunction]
pub(crate) fn read_images<'py>(
    py: Python<'py>,
    path: PathBuf,
    psfs: bool,
) -> PyResult<Images<'py>> {
    let content = if psfs { Content::Psf } else { Content::Sky };
    let found = py
        .detach(|| GatheredPixels::read(&path, content))
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    let GatheredPixels {
        pixels,
        side,
        jacobians,
        fault_of_cube,
        pixel_size,
        messages,
    } = found;
    let count = pixels.len() / (side * side);
    let pixels = ndarray::Array3::from_shape_vec((count, side, side), pixels);
    let pixels = pixels.map_err(|error| PyValueError::new_err(error.to_string()))?;
    let jacobians = jacobians.map(|all| stacked(py, all)).transpose()?;
    let size = size_of(pixel_size);
    let pixels = pixels.into_pyarray(py);
    Ok((pixels, jacobians, fault_of_cube, size, messages))
}

/// The Jacobian in the middle of images with a header of these cards, if it states one, why it is not that of a cube's, and what of
/// the header is not used.
#[pyfunction]
pub(crate) fn header_pixels(
    cards: BTreeMap<String, String>,
    width: usize,
    height: usize,
    planes: usize,
) -> PyResult<Header> {
    let HeaderPixels {
        jacobian,
        fault_of_cube,
        pixel_size,
        doubts,
    } = HeaderPixels::from_cards(cards, [width, height], planes).map_err(PyValueError::new_err)?;
    let size = size_of(pixel_size);
    Ok((jacobian, fault_of_cube, size, doubts))
}

/// The pixels of PSFs along a pixel of galaxies by the sizes that their headers state, and what is wrong with these.
#[pyfunction]
pub(crate) fn stated_oversampling(psf: Size, galaxies: Size) -> (Option<usize>, Option<String>) {
    let (scale, oversampling, ..) = psf;
    let size = PixelSize {
        scale,
        oversampling,
        ..PixelSize::default()
    };
    let stated = size.oversampling_of(galaxies.0);
    let scales = scale.zip(galaxies.0).filter(|_| stated.is_none());
    let found = scales.and_then(|(psf, galaxies)| scale_difference(psf, galaxies));
    let found = found.map(|warning| warning.to_string());
    (stated, found.or_else(|| size.unused(galaxies.0)))
}

/// What is wrong with PSFs of these Jacobians for stamps of those.
#[pyfunction]
#[pyo3(name = "pixel_difference")]
pub(crate) fn pixel_difference_of(
    psfs: PyReadonlyArray3<'_, f64>,
    stamps: PyReadonlyArray3<'_, f64>,
) -> Option<String> {
    let found = pixel_difference(&matrices(&psfs), &matrices(&stamps));
    found.map(|warning| warning.to_string())
}

/// Whether pixels of all these Jacobians are along the axes of the sky.
#[pyfunction]
pub(crate) fn are_aligned(jacobians: PyReadonlyArray3<'_, f64>) -> bool {
    matrices(&jacobians).iter().all(is_aligned)
}
