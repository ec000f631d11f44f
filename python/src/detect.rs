//! Detections on an exposure.

use ndarray::{Array2, ArrayView1, ArrayView2, s};
use numpy::{IntoPyArray, PyArray1, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use shearq_dataset::threads::Quiet;
use shearq_detection::{Cells, Detection, Epoch, EpochCells, MAX_EPOCHS, Patch};
use shearq_measure::{DetectionMethod, Jacobian, MeasureError, StampNoise};
use shearq_pipeline::detect::{
    COLUMNS, PLACE, SkyLevel, WHOLE, detect_rows, doubts, noise_in, noise_of_level, square_of,
    unlit_in_words,
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
    let (settings, jacobian) = (settings(threshold)?, axes(jacobian)?);
    let image = image.as_array();
    let (height, width) = image.dim();
    let (measured, jacobian) = (noise_in(image), jacobian.as_ref());
    let noise_level = noise_of_level(noise, measured.as_ref());
    let cells = match psf.extract::<PyReadonlyArray2<'_, f64>>() {
        Ok(star) => {
            let star = star.as_array().to_owned();
            Cells::constant(star, &noise_level, jacobian, &settings).map_err(Fault::from)
        }
        Err(_) => Cells::varying(
            [width, height],
            &noise_level,
            jacobian,
            &settings,
            |places| drawn(&psf, places).map_err(Fault),
        ),
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
    let mut doubts = doubts(
        cells.stars(),
        sky_of(&image),
        &noise_level,
        measured.as_ref(),
    );
    doubts.extend(unlit_in_words(unlit));
    Ok((columns(py, &found)?, doubts))
}

/// The stars that a function draws at places in FITS pixels.
fn drawn(psf: &Bound<'_, PyAny>, places: &[(f64, f64)]) -> PyResult<Vec<Array2<f64>>> {
    let drawn = psf.call1((places.to_vec(),))?;
    let drawn = drawn.extract::<PyReadonlyArray3<'_, f64>>()?;
    let stars = drawn.as_array();
    Ok(stars.outer_iter().map(|star| star.to_owned()).collect())
}

fn settings(threshold: f64) -> PyResult<DetectionMethod> {
    let settings = DetectionMethod {
        threshold,
        ..DetectionMethod::default()
    };
    settings.validate().map_err(|error| {
        let (found, expected) = (error.found, error.expected);
        PyValueError::new_err(format!("threshold: found {found}; expected {expected}"))
    })?;
    Ok(settings)
}

fn axes(jacobian: Option<[[f64; 2]; 2]>) -> PyResult<Option<Jacobian>> {
    let jacobian = jacobian.map(Jacobian::new).transpose();
    jacobian.map_err(|error| PyValueError::new_err(format!("wcs: {error}")))
}

fn columns<'py>(py: Python<'py>, found: &[Detection]) -> PyResult<Bound<'py, PyDict>> {
    let columns = PyDict::new(py);
    for (name, of) in PLACE.iter().chain(&COLUMNS) {
        let values: Vec<f64> = found.iter().map(of).collect();
        columns.set_item(name, values.into_pyarray(py))?;
    }
    for (name, of) in WHOLE {
        let values: Vec<i32> = found.iter().map(|own| of(own) as i32).collect();
        columns.set_item(name, values.into_pyarray(py))?;
    }
    Ok(columns)
}

fn sky_of(image: &ArrayView2<'_, f32>) -> Option<SkyLevel> {
    let (height, width) = image.dim();
    SkyLevel::of(width * height, |at| {
        let (x, y) = (at % width, at / width);
        let place = [x as f64 / width as f64, y as f64 / height as f64];
        (place, image[[y, x]])
    })
}

/// An image, its PSF and noise, and a function from an array of places (n, 2) on the first image, in FITS pixels, to those on this one, NaN
/// where there are none.
type Exposure<'py> = (
    PyReadonlyArray2<'py, f32>,
    Bound<'py, PyAny>,
    f64,
    Bound<'py, PyAny>,
);

/// The same of several images of one sky.
#[pyfunction]
pub(crate) fn detect_epochs<'py>(
    py: Python<'py>,
    exposures: Vec<Exposure<'py>>,
    threshold: f64,
    jacobian: Option<[[f64; 2]; 2]>,
    threads_asked: Option<u16>,
) -> PyResult<(Bound<'py, PyDict>, Vec<String>)> {
    let (settings, jacobian) = (settings(threshold)?, axes(jacobian)?);
    let images: Vec<ArrayView2<'_, f32>> = exposures.iter().map(|own| own.0.as_array()).collect();
    if !(1..=MAX_EPOCHS).contains(&images.len()) {
        let found = images.len();
        let message = format!("image: found {found} exposures; expected 1 to {MAX_EPOCHS}");
        return Err(PyValueError::new_err(message));
    }
    let sides = |at: usize| [images[at].ncols(), images[at].nrows()];
    let measured: Vec<Option<StampNoise>> = images.iter().map(|image| noise_in(*image)).collect();
    let stated = exposures.iter().map(|own| own.2).zip(&measured);
    let levels: Vec<StampNoise> = stated
        .map(|(sigma, measured)| noise_of_level(sigma, measured.as_ref()))
        .collect();
    let mut epochs = Vec::new();
    for (at, (_, psf, _, places)) in exposures.iter().enumerate() {
        let star = psf.extract::<PyReadonlyArray2<'_, f64>>().ok();
        let star = star.map(|star| star.as_array().to_owned());
        epochs.push(Epoch {
            sides: sides(at),
            noise: levels[at].clone(),
            is_constant: star.is_some(),
            stars: Box::new(move |places| match &star {
                Some(star) => Ok(vec![star.clone(); places.len()]),
                None => drawn(psf, places),
            }),
            places: Box::new(move |on_first| {
                let given: Vec<f64> = on_first.iter().flatten().copied().collect();
                let given = PyArray1::from_vec(py, given).reshape([on_first.len(), 2])?;
                let found = places.call1((given,))?;
                let found = found.extract::<PyReadonlyArray2<'_, f64>>()?;
                let place = |row: ArrayView1<'_, f64>| {
                    (row[0].is_finite() && row[1].is_finite()).then_some([row[0], row[1]])
                };
                Ok(found.as_array().outer_iter().map(place).collect())
            }),
            fault: Box::new(move |error| {
                let error = of_measuring(error);
                PyValueError::new_err(format!("{} (exposure {})", error.value(py), at + 1))
            }),
        });
    }
    let cells = EpochCells::new(epochs, jacobian.as_ref(), &settings)?;
    let found = py.detach(|| {
        let open =
            || Ok(|patch: &Patch| Ok(square_of(images[patch.epoch], patch.origin, patch.side)));
        let threads = threads(threads_asked);
        shearq_pipeline::detect::detect_epochs(threads, &cells, sides(0), open, &mut Quiet)
    });
    let (found, [_, unlit]) = found.map_err(of_pipeline)?;
    let mut all = Vec::new();
    for (at, image) in images.iter().enumerate() {
        let stars = cells.stars(at);
        let own = doubts(stars, sky_of(image), &levels[at], measured[at].as_ref());
        all.extend(
            own.into_iter()
                .map(|doubt| format!("exposure {}: {doubt}", at + 1)),
        );
    }
    all.extend(unlit_in_words(unlit));
    Ok((columns(py, &found)?, all))
}
