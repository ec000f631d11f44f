//! Errors of the crates as exceptions that name the argument.

use pyo3::PyErr;
use pyo3::exceptions::{PyKeyError, PyMemoryError, PyRuntimeError, PyValueError};
use shearq_measure::{MeasureError, Warning};
use shearq_pipeline::PipelineError;
use shearq_scoring::ScoringError;
use shearq_submissions::ConfigurationError;

/// Errors about stamps, PSFs, the noise or the configuration.
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

/// Errors about the name or the settings of a configuration.
pub(crate) fn of_configuration(error: ConfigurationError) -> PyErr {
    let message = format!("submission: {error}");
    match error {
        ConfigurationError::Unknown { .. } => PyKeyError::new_err(message),
        _ => PyValueError::new_err(message),
    }
}

/// Errors of scoring.
pub(crate) fn of_scoring(error: ScoringError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Errors of the engine.
pub(crate) fn of_pipeline(error: PipelineError) -> PyErr {
    match error {
        PipelineError::Measure(error) => of_measuring(error),
        PipelineError::Scoring { source, .. } => of_scoring(source),
        error @ PipelineError::NoSuchSet(_) => PyValueError::new_err(error.to_string()),
        other => PyRuntimeError::new_err(other.to_string()),
    }
}

/// Options of the command line whose arguments in Python have other names or values.
const OPTIONS: [(&str, &str); 5] = [
    ("--drop-missing", "drop_missing=True"),
    ("--truth-sign standard", "truth_sign=\"standard\""),
    ("--truth-sign challenge", "truth_sign=\"challenge\""),
    ("--truth-sign", "truth_sign"),
    // Arguments of the same name. Paths may contain hyphens.
    (" --", " "),
];

/// A message of the command line with the arguments of Python for its options.
pub(crate) fn in_python(message: &str) -> String {
    let options = OPTIONS.iter();
    options.fold(message.to_owned(), |text, (option, argument)| {
        text.replace(option, argument)
    })
}

/// A failed allocation.
pub(crate) fn no_memory(what: &str) -> PyErr {
    PyMemoryError::new_err(format!("there is no memory for {what}"))
}
