//! Simulating, gathering and measuring many images.
//!
//! Only [`engine`] starts threads. The code below it is serial and uses scratch of the caller. Results come back in
//! order, so they do not depend on the number of threads.
#![forbid(unsafe_code)]

pub mod complete;
pub mod engine;
pub mod gather;
pub mod inputs;
pub mod measure;
pub mod run;
pub mod simulate;
mod wcs;

pub use engine::{Progress, Quiet};

use shearq_measure::MeasureError;
use thiserror::Error;

use shearq_files::FileError;

/// What can stop the pipeline.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// A file that cannot be used.
    #[error(transparent)]
    File(#[from] FileError),
    /// Stamps, PSFs or settings that cannot be measured.
    #[error(transparent)]
    Measure(#[from] MeasureError),
    /// Data that cannot be scored.
    #[error("{}", set.map_or_else(|| "this set cannot be scored".into(), |set| format!("set {set}")))]
    Scoring {
        /// Number of the set, if it has one.
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
