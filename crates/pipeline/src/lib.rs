//! Simulating, gathering and measuring many images.
//!
//! [`engine`] starts threads for rows of images, and [`shearq_dataset::threads`] for files. The code below them is serial and uses
//! scratch of the caller. Results come back in order, so they do not depend on the number of threads.
#![forbid(unsafe_code)]

pub mod complete;
pub mod detect;
pub mod engine;
pub mod galaxy_fits;
pub mod gather;
pub mod measure;
pub mod run;
pub mod scenes;
pub mod simulate;
mod stamp_table;
mod wcs;

use shearq_dataset::images::ImageId;
use shearq_dataset::threads::ThreadError;
use shearq_files::FileError;
use shearq_measure::{MeasureError, Warning};
use shearq_simulate::kinds::SETS;
use thiserror::Error;

/// What can stop the pipeline.
#[derive(Debug, Error)]
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
    #[error("there is no set {0}; expected 1 to {SETS}")]
    NoSuchSet(u32),
    /// An image whose ellipticities would be wrong.
    #[error("set {:02} image {:03}: {warning}", id.set, id.image)]
    Fatal { id: ImageId, warning: Warning },
    #[error("the settings cannot be stored: {0}")]
    Settings(#[from] toml::ser::Error),
    /// The caller stopped the work.
    #[error("the work was interrupted")]
    Interrupted,
    #[error(transparent)]
    Threads(#[from] ThreadError),
}

impl PipelineError {
    /// What can be tried about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::File(error) => error.hint.clone(),
            Self::Measure(error) => error.hint(),
            Self::Fatal { warning, .. } => warning.hint(),
            _ => None,
        }
    }
}
