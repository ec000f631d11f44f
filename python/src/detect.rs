//! Detections on an exposure.

use ndarray::s;
use numpy::{IntoPyArray, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_dataset::threads::Quiet;
use shearq_detection::Detector;
use shearq_measure::{DetectionMethod, Jacobian, StampNoise};
use shearq_pipeline::detect::{
    COLUMNS, PLACE, SkyLevel, WHOLE, detect_rows, doubts, unlit_in_words,
};

use crate::errors::{of_measuring, of_pipeline};
use crate::work::threads;

/// The columns of the detections on an image (ny, nx), NaN where pixels are missing, and what is doubtful about it.
#[pyfunction]
pub(crate) fn detect<'py>(
    py: Python<'py>,
    image: PyReadonlyArray2<'py, f32>,
    star: PyReadonlyArray2<'py, f64>,
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
    let star = star.as_array();
    let detector = Detector::new(
        star,
        &StampNoise::white(noise),
        jacobian.as_ref(),
        &settings,
    )
    .map_err(of_measuring)?;
    let image = image.as_array();
    let (height, width) = image.dim();
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
        detect_rows(threads, &detector, [width, height], open, &mut Quiet)
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
    let mut doubts = doubts(star, sky, noise, None);
    doubts.extend(unlit_in_words(unlit));
    Ok((columns, doubts))
}
