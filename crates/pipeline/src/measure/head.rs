//! An image and its rows of stamps, as workers get them.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use shearq_files::FileError;
use shearq_measure::{CommonProfile, ImageNoise, ImageWorker, Psfs, Survey, Warning, Worker};

use crate::data::mosaic::Mosaic;
use crate::images::ImageId;

/// Most pixels of a row of stamps. Several rows are in memory at a time.
const MAX_STRIP: usize = 1 << 24;

/// What all rows of stamps of an image share.
#[derive(Debug, Clone)]
pub struct ImageHead {
    /// The image.
    pub id: ImageId,
    /// How its stamps lie.
    pub mosaic: Mosaic,
    /// Noise level used without a survey, in image units.
    pub noise: Option<f64>,
    /// NOISESIG if the configuration uses it, for comparison with the stamps.
    pub stated_noise: Option<f64>,
    /// Noise and galaxy sizes measured on the stamps, if the configuration requires them.
    pub survey: Option<Arc<Survey>>,
    /// What the stars have in common, if there is a noisy star for each galaxy.
    pub stars: Option<Arc<CommonProfile>>,
    /// Warnings about this image.
    pub warnings: Vec<Warning>,
    /// Warnings about all images of the run, which were examined on this image.
    pub run_warnings: Vec<Warning>,
    /// Fingerprints of the files that the image is measured from.
    pub prints: BTreeMap<String, String>,
}

impl ImageHead {
    /// Prepares a worker for the galaxies of the image.
    pub fn prepare<'w>(&self, worker: &'w mut Worker) -> ImageWorker<'w> {
        let noise = ImageNoise::of(self.survey.as_ref(), self.noise);
        worker.image_with_stars(noise, self.stars.as_ref())
    }
}

/// One row of stamps of an image.
#[derive(Debug, Clone)]
pub struct StampRow {
    /// The image.
    pub head: Arc<ImageHead>,
    /// Row of the mosaic, from 0.
    pub iy: usize,
    /// The rows of pixels that contain the stamps.
    pub pixels: Vec<f32>,
    /// PSFs of the galaxies of the row.
    pub psfs: Psfs<'static>,
}

/// Checks that a row of `n` stamps of `side` pixels a side fits into memory.
pub(crate) fn check_strip(path: &Path, n: usize, side: usize) -> Result<(), FileError> {
    let pixels = n * side * side;
    if pixels <= MAX_STRIP {
        return Ok(());
    }
    let message = format!(
        "a row of {n} stamps of {side} pixels a side has {pixels} pixels; expected at most {MAX_STRIP}"
    );
    Err(FileError::new(path, message))
}
