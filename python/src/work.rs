//! Progress and interruption of long work.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use pyo3::prelude::*;
use shearq_pipeline::PipelineError;

use crate::errors::of_pipeline;

/// Period of calls to Python. Attaching to the interpreter may wait for its other threads.
const PERIOD: Duration = Duration::from_millis(50);

/// Worker threads: the given number, or one per core.
pub(crate) fn threads(asked: Option<u16>) -> usize {
    asked.map_or_else(
        || std::thread::available_parallelism().map_or(1, usize::from),
        usize::from,
    )
}

/// An exception of any thread that stops the work.
#[derive(Default)]
pub(crate) struct Failure(Mutex<Option<PyErr>>);

impl Failure {
    /// Keeps an exception, and returns the error that stops the engine.
    pub(crate) fn keep(&self, error: PyErr) -> PipelineError {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
        PipelineError::Interrupted
    }

    /// The result of the work, or the exception that stopped it.
    pub(crate) fn or<T>(self, result: Result<T, PipelineError>) -> PyResult<T> {
        match self.0.into_inner().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error),
            None => result.map_err(of_pipeline),
        }
    }
}

/// Calls back with the number of galaxies done since the last call, and checks signals such as Ctrl-C. For the thread
/// that called from Python.
pub(crate) struct Watch<'a> {
    callback: Option<Py<PyAny>>,
    failure: &'a Failure,
    unreported: u64,
    reported: Instant,
}

impl<'a> Watch<'a> {
    pub(crate) fn new(callback: Option<Py<PyAny>>, failure: &'a Failure) -> Self {
        Watch {
            callback,
            failure,
            unreported: 0,
            reported: Instant::now(),
        }
    }

    /// `galaxies` more are done.
    pub(crate) fn advance(&mut self, galaxies: usize) -> Result<(), PipelineError> {
        self.unreported += galaxies as u64;
        if self.reported.elapsed() < PERIOD {
            return Ok(());
        }
        self.report()
    }

    /// Calls back with the galaxies that were not reported.
    pub(crate) fn report(&mut self) -> Result<(), PipelineError> {
        let (more, callback) = (std::mem::take(&mut self.unreported), &self.callback);
        let result = Python::attach(|py| {
            if let Some(callback) = callback
                && more > 0
            {
                callback.call1(py, (more,))?;
            }
            py.check_signals()
        });
        self.reported = Instant::now();
        result.map_err(|error| self.failure.keep(error))
    }
}
