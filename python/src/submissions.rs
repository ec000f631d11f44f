//! Configurations of the measurement, by name, file or settings.

use std::path::Path;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use shearq_submissions::{EllipticityType, Entry, NoiseSource, PsfForm, Published, Registry};

use crate::errors::of_configuration;

// The name of settings that state none.
const OWN: &str = "own";

// Settings as JSON, what they extend, and the published Q, M/2 and √A·10⁴. Plain types, which pickle stores for processes of dask
// or multiprocessing.
type Parts = (String, Option<String>, Option<(f64, f64, f64)>);

/// Settings of a configuration, resolved.
#[pyclass(frozen)]
pub(crate) struct Configuration {
    pub(crate) entry: Entry,
}

#[pymethods]
impl Configuration {
    /// The configuration of a name or a file.
    #[staticmethod]
    fn named(name: &str) -> PyResult<Self> {
        let entry = Registry::embedded().and_then(|registry| registry.get(name));
        Ok(Configuration {
            entry: entry.map_err(of_configuration)?,
        })
    }

    /// The configuration of settings as TOML.
    #[staticmethod]
    fn text(text: &str) -> PyResult<Self> {
        let entry =
            Registry::embedded().and_then(|registry| registry.get_text(Path::new(OWN), text));
        Ok(Configuration {
            entry: entry.map_err(of_configuration)?,
        })
    }

    /// The configuration of settings as JSON.
    #[staticmethod]
    fn json(text: &str) -> PyResult<Self> {
        let wrong = |error: String| {
            PyValueError::new_err(format!("submission: not valid settings: {error}"))
        };
        let value: toml::Table =
            serde_json::from_str(text).map_err(|error| wrong(error.to_string()))?;
        // By way of TOML, so that JSON may have `extends` and gets the same checks and messages.
        let text = toml::to_string(&value).map_err(|error| wrong(error.to_string()))?;
        Self::text(&text)
    }

    /// The configuration with these `parts`.
    #[staticmethod]
    fn restored(parts: Parts) -> PyResult<Self> {
        let (settings, extends, published) = parts;
        let configuration: shearq_submissions::Configuration = serde_json::from_str(&settings)
            .map_err(|error| PyValueError::new_err(format!("submission: {error}")))?;
        let published = published.map(|(q, m_half, sqrt_a)| Published { q, m_half, sqrt_a });
        Ok(Configuration {
            entry: Entry {
                configuration,
                published,
                extends,
            },
        })
    }

    /// Its state, for pickle.
    #[getter]
    fn parts(&self) -> PyResult<Parts> {
        Ok((
            self.settings()?,
            self.entry.extends.clone(),
            self.published(),
        ))
    }

    #[getter]
    fn name(&self) -> &str {
        &self.entry.configuration.name
    }

    #[getter]
    fn description(&self) -> &str {
        &self.entry.configuration.description
    }

    #[getter]
    fn extends(&self) -> Option<&str> {
        self.entry.extends.as_deref()
    }

    /// Q, M/2 and √A·10⁴ as published.
    #[getter]
    fn published(&self) -> Option<(f64, f64, f64)> {
        self.entry
            .published
            .map(|Published { q, m_half, sqrt_a }| (q, m_half, sqrt_a))
    }

    /// All settings as JSON.
    #[getter]
    fn settings(&self) -> PyResult<String> {
        serde_json::to_string(&self.entry.configuration)
            .map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// All settings as TOML.
    #[getter]
    fn toml(&self) -> PyResult<String> {
        toml::to_string(&self.entry.configuration)
            .map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Pixels a side of the piece of a stamp, and of a PSF stamp, that are used.
    #[getter]
    fn sizes(&self) -> (usize, usize) {
        let configuration = &self.entry.configuration;
        (configuration.stamp.size, configuration.psf.size)
    }

    /// Whether it takes PSFs by their formula.
    #[getter]
    fn functional(&self) -> bool {
        self.entry.configuration.psf.form == PsfForm::Functional
    }

    /// Whether the noise level has to be given.
    #[getter]
    fn needs_noise(&self) -> bool {
        self.entry.configuration.noise == NoiseSource::Header
    }

    /// `shear` or `distortion`.
    #[getter]
    fn ellipticity(&self) -> &'static str {
        match self.entry.configuration.ellipticity() {
            EllipticityType::Shear => "shear",
            EllipticityType::Distortion => "distortion",
        }
    }
}

/// Names of the embedded configurations.
#[pyfunction]
pub(crate) fn names() -> PyResult<Vec<String>> {
    let registry = Registry::embedded().map_err(of_configuration)?;
    Ok(registry.names().to_vec())
}
