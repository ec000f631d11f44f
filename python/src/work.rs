//! Progress and interruption of long work.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use pyo3::prelude::*;
use shearq_pipeline::PipelineError;

use crate::errors::of_pipeline;

// Between calls to Python. Attaching to the interpreter may wait for its other threads, which would slow the measurement. Chosen
// by hand: Ctrl-C still seems immediate.
const PERIOD: Duration = Duration::from_millis(50);

pub(crate) fn threads(asked: Option<u16>) -> usize {
    asked.map_or_else(
        || std::thread::available_parallelism().map_or(1, usize::from),
        usize::from,
    )
}

// The first exception of a callback or a conversion, in any thread. The engine's errors cannot contain it, because the crates
// below do not depend on Python.
#[derive(Default)]
pub(crate) struct Failure(Mutex<Option<PyErr>>);

impl Failure {
    pub(crate) fn keep(&self, error: PyErr) -> PipelineError {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
        PipelineError::Interrupted
    }

    // The exception first: the engine reports only that it was interrupted.
    pub(crate) fn or<T>(self, result: Result<T, PipelineError>) -> PyResult<T> {
        match self.0.into_inner().unwrap_or_else(PoisonError::into_inner) {
            Some(error) => Err(error),
            None => result.map_err(of_pipeline),
        }
    }
}

// Calls back with the number of galaxies since the last call, and checks signals such as Ctrl-C, which Python handles only in
// the thread that called.
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

    pub(crate) fn advance(&mut self, galaxies: usize) -> Result<(), PipelineError> {
        self.unreported += galaxies as u64;
        if self.reported.elapsed() < PERIOD {
            return Ok(());
        }
        self.report()
    }

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
