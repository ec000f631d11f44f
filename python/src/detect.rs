//! Detections on an exposure.

use ndarray::s;
use numpy::{IntoPyArray, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_dataset::threads::Quiet;
use shearq_detection::Cells;
use shearq_measure::{DetectionMethod, Jacobian, MeasureError, StampNoise};
use shearq_pipeline::detect::{
    COLUMNS, PLACE, SkyLevel, WHOLE, detect_rows, doubts, measured_level, unlit_in_words,
};

use crate::errors::{of_measuring, of_pipeline};
use crate::work::threads;

struct Fault(PyErr);

impl From<MeasureError> for Fault {
    fn from(error: MeasureError) -> Self {
        Fault(of_measuring(error))
    }
}

/// The columns of the detections on an image (ny, nx), NaN where pixels are missing, and what is doubtful about it. `psf` is a stamp, or a
/// function that returns an array of stamps at places in FITS pixels.
#[pyfunction]
pub(crate) fn detect<'py>(
    py: Python<'py>,
    image: PyReadonlyArray2<'py, f32>,
    psf: Bound<'py, PyAny>,
    noise: f64,
    threshold: f64,
    jacobian: Option<[[f64; 2]; 2]>,
    threads_asked: Option<u16>,
) -> PyResult<(Bound<'py, PyDict>, Vec<String>)> {
    let settings = DetectionMethod {
        threshold,
        ..DetectionMethod::default()
    };
    settings.validate().map_err(|error| {
        let (found, expected) = (error.found, error.expected);
        PyValueError::new_err(format!("threshold: found {found}; expected {expected}"))
    })?;
    let jacobian = jacobian.map(Jacobian::new).transpose();
    let jacobian = jacobian.map_err(|error| PyValueError::new_err(format!("wcs: {error}")))?;
    let image = image.as_array();
    let (height, width) = image.dim();
    let (noise_level, axes) = (StampNoise::white(noise), jacobian.as_ref());
    let cells = match psf.extract::<PyReadonlyArray2<'_, f64>>() {
        Ok(star) => {
            let star = star.as_array().to_owned();
            Cells::constant(star, &noise_level, axes, &settings).map_err(Fault::from)
        }
        Err(_) => Cells::varying([width, height], &noise_level, axes, &settings, |places| {
            let drawn = psf.call1((places.to_vec(),)).map_err(Fault)?;
            let drawn = drawn.extract::<PyReadonlyArray3<'_, f64>>();
            let drawn = drawn.map_err(Fault)?;
            let stars = drawn.as_array();
            Ok(stars.outer_iter().map(|star| star.to_owned()).collect())
        }),
    };
    let cells = cells.map_err(|Fault(error)| error)?;
    let found = py.detach(|| {
        let open = || {
            let mut next = 0;
            Ok(move |rows: usize| {
                let part = image.slice(s![next..next + rows, ..]);
                next += rows;
                Ok(part.iter().copied().collect())
            })
        };
        let threads = threads(threads_asked);
        detect_rows(threads, &cells, [width, height], open, &mut Quiet)
    });
    let (found, unlit) = found.map_err(of_pipeline)?;
    let columns = PyDict::new(py);
    for (name, of) in PLACE.iter().chain(&COLUMNS) {
        let values: Vec<f64> = found.iter().map(of).collect();
        columns.set_item(name, values.into_pyarray(py))?;
    }
    for (name, of) in WHOLE {
        let values: Vec<i32> = found.iter().map(|own| of(own) as i32).collect();
        columns.set_item(name, values.into_pyarray(py))?;
    }
    let sky = SkyLevel::of(width * height, |at| {
        let (x, y) = (at % width, at / width);
        let place = [x as f64 / width as f64, y as f64 / height as f64];
        (place, image[[y, x]])
    });
    let mut doubts = doubts(cells.stars(), sky, noise, measured_level(image));
    doubts.extend(unlit_in_words(unlit));
    Ok((columns, doubts))
}
