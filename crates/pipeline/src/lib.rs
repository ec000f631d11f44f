//! The chain over many galaxies: read or simulate, measure, write.
//!
//! [`engine`] is the only place that starts threads. Everything below it is serial and takes its
//! scratch from the caller; everything in it is in order, so that results do not depend on the
//! number of threads.

pub mod complete;
pub mod data;
pub mod engine;
pub mod gather;
pub mod grid;
pub mod images;
pub mod inputs;
pub mod measure;
mod pixel_scale;
pub mod run;
pub mod simulate;
pub mod truth;
mod warned;

pub use engine::{Progress, Quiet};

/// Version of this package, as outputs carry it.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

use shearq_measure::MeasureError;
use thiserror::Error;

use shearq_files::FileError;

/// What can stop the pipeline.
#[derive(Debug, Error)]
pub enum PipelineError {
    /// A file.
    #[error(transparent)]
    File(#[from] FileError),
    /// Sizes or PSFs that cannot be measured with.
    #[error(transparent)]
    Measure(#[from] MeasureError),
    /// Scores.
    #[error("{}", set.map_or_else(|| "this set cannot be scored".into(), |set| format!("set {set}")))]
    Scoring {
        /// The set's number, where it has one.
        set: Option<u32>,
        /// Why it cannot be scored.
        source: shearq_scoring::ScoringError,
    },
    /// A setting or request that cannot be met.
    #[error("{0}")]
    Request(String),
    /// Threads that cannot be started.
    #[error("cannot start the worker threads: {0}")]
    Threads(#[from] rayon::ThreadPoolBuildError),
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
