//! Configurations of the measurement, by name, file or settings.

use std::path::Path;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use shearq_submissions::{Entry, Published, Registry};

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

    /// Its state, from which the package takes its properties.
    #[getter]
    fn parts(&self) -> PyResult<Parts> {
        let Entry {
            configuration,
            published,
            extends,
        } = &self.entry;
        let settings = serde_json::to_string(configuration)
            .map_err(|error| PyValueError::new_err(error.to_string()))?;
        let published = published.map(|Published { q, m_half, sqrt_a }| (q, m_half, sqrt_a));
        Ok((settings, extends.clone(), published))
    }

    /// All settings as TOML.
    #[getter]
    fn toml(&self) -> PyResult<String> {
        toml::to_string(&self.entry.configuration)
            .map_err(|error| PyValueError::new_err(error.to_string()))
    }
}

/// Names of the embedded configurations.
#[pyfunction]
pub(crate) fn names() -> PyResult<Vec<String>> {
    let registry = Registry::embedded().map_err(of_configuration)?;
    Ok(registry.names().to_vec())
}
