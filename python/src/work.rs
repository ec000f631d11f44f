//! Long work on behalf of Python: its progress, and what interrupts it.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use pyo3::prelude::*;
use shearq_pipeline::PipelineError;

use crate::errors::of_pipeline;

/// How often Python hears of the work. Attaching to the interpreter may have to wait for its other threads.
const PERIOD: Duration = Duration::from_millis(50);

/// Worker threads: as asked for, or one per core.
pub(crate) fn threads(asked: Option<u16>) -> usize {
    asked.map_or_else(
        || std::thread::available_parallelism().map_or(1, usize::from),
        usize::from,
    )
}

/// An exception that stops the work, from whichever thread.
#[derive(Default)]
pub(crate) struct Failure(Mutex<Option<PyErr>>);

impl Failure {
    /// Keeps an exception, and gives the error that stops the engine.
    pub(crate) fn keep(&self, error: PyErr) -> PipelineError {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
        PipelineError::Request("the work was interrupted".into())
    }

    /// The result of the work: its own, or the exception that stopped it.
    pub(crate) fn or(self, result: Result<(), PipelineError>) -> PyResult<()> {
        match self.0.into_inner().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error),
            None => result.map_err(of_pipeline),
        }
    }
}

/// Tells a callback how many more galaxies are done, and looks for signals such as Ctrl-C. For the thread
/// that called from Python.
pub(crate) struct Watch<'a> {
    callback: Option<Py<PyAny>>,
    failure: &'a Failure,
    untold: u64,
    told: Instant,
}

impl<'a> Watch<'a> {
    pub(crate) fn new(callback: Option<Py<PyAny>>, failure: &'a Failure) -> Self {
        Watch {
            callback,
            failure,
            untold: 0,
            told: Instant::now(),
        }
    }

    /// `galaxies` more are done.
    pub(crate) fn advance(&mut self, galaxies: usize) -> Result<(), PipelineError> {
        self.untold += galaxies as u64;
        if self.told.elapsed() < PERIOD {
            return Ok(());
        }
        self.tell()
    }

    /// Tells what has not been told.
    pub(crate) fn tell(&mut self) -> Result<(), PipelineError> {
        let (more, callback) = (std::mem::take(&mut self.untold), &self.callback);
        let heard = Python::attach(|py| {
            if let Some(callback) = callback
                && more > 0
            {
                callback.call1(py, (more,))?;
            }
            py.check_signals()
        });
        self.told = Instant::now();
        heard.map_err(|error| self.failure.keep(error))
    }
}
