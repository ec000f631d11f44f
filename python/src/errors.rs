//! Errors of the crates as exceptions that name the argument.

use pyo3::exceptions::{PyKeyError, PyMemoryError, PyRuntimeError, PyValueError};
use pyo3::{PyErr, PyResult};
use serde::de::DeserializeOwned;
use shearq_measure::{MeasureError, Warning};
use shearq_pipeline::PipelineError;
use shearq_scoring::ScoringError;
use shearq_submissions::ConfigurationError;

// The argument that the user can change comes first. Errors of a method are about its PSF unless they state something else.
pub(crate) fn of_measuring(error: MeasureError) -> PyErr {
    let argument = match error {
        MeasureError::Configuration(error) => return of_configuration(error),
        MeasureError::Memory(_) => return PyMemoryError::new_err(error.to_string()),
        MeasureError::Noise(_) | MeasureError::NoBorders { .. } => "noise",
        MeasureError::Data(Warning::Brightness { .. }) => "stamps",
        MeasureError::Shape { what, .. } | MeasureError::NotFinite { what, .. }
            if !what.contains("PSF") =>
        {
            "stamps"
        }
        _ => "psf",
    };
    PyValueError::new_err(format!("{argument}: {error}"))
}

// An unknown name is a KeyError, as for a dictionary.
pub(crate) fn of_configuration(error: ConfigurationError) -> PyErr {
    let message = format!("submission: {error}");
    match error {
        ConfigurationError::Unknown { .. } => PyKeyError::new_err(message),
        _ => PyValueError::new_err(message),
    }
}

pub(crate) fn of_scoring(error: ScoringError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

// What is not a fault of an argument, such as threads that cannot start, is a RuntimeError.
pub(crate) fn of_pipeline(error: PipelineError) -> PyErr {
    match error {
        PipelineError::Measure(error) => of_measuring(error),
        PipelineError::Scoring { source, .. } => of_scoring(source),
        error @ PipelineError::NoSuchSet(_) => PyValueError::new_err(error.to_string()),
        other => PyRuntimeError::new_err(other.to_string()),
    }
}

// Messages of the crates advise with options of the command line; these have other names or values in Python. Longer options
// come first, because they contain shorter ones.
const OPTIONS: [(&str, &str); 5] = [
    ("--drop-missing", "drop_missing=True"),
    ("--truth-sign standard", "truth_sign=\"standard\""),
    ("--truth-sign challenge", "truth_sign=\"challenge\""),
    ("--truth-sign", "truth_sign"),
    // Arguments of the same name. Paths may contain hyphens.
    (" --", " "),
];

pub(crate) fn in_python(message: &str) -> String {
    let options = OPTIONS.iter();
    options.fold(message.to_owned(), |text, (option, argument)| {
        text.replace(option, argument)
    })
}

// Reserving the largest arrays first turns an absurd number of images into an exception instead of an abort of the interpreter.
pub(crate) fn no_memory(what: &str) -> PyErr {
    PyMemoryError::new_err(format!("there is no memory for {what}"))
}

// A value by the name that records give it.
pub(crate) fn chosen<T: DeserializeOwned>(
    argument: &str,
    name: &str,
    expected: &str,
) -> PyResult<T> {
    let found = serde_json::from_value(name.into());
    found.map_err(|_| PyValueError::new_err(format!("{argument}: {name:?}; expected {expected}")))
}
