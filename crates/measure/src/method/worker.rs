//! What a method offers: a PSF is set, then cut stamps are measured.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_quantities::PixelShape;

use super::found::Found;
use crate::error::{EpochError, MeasureError};
use crate::noise::StampNoise;
use crate::psf::ResidualProfiles;
use crate::spectral::EpochPixels;

/// The PSF and buffers of a method in one thread.
pub(crate) trait CutWorker: Send {
    /// Sets properties of an image: its noise in units of the level, the mean square per axis of its galaxies with the PSF
    /// in px², and the common profile of its noisy stars. Before the first image, noise is white and nothing else is known.
    fn set_image(
        &mut self,
        _noise: &StampNoise,
        _galaxy_variance: Option<f64>,
        _stars: Option<&Arc<ResidualProfiles>>,
    ) {
    }

    /// Sets the shape of the pixels of galaxies and PSFs that follow; a PSF is set after it. Results are in the coordinates
    /// of [`PixelShape::map`]. A method that ignores it measures in pixels.
    fn set_pixel_shape(&mut self, _shape: PixelShape) {}

    /// Sets the electrons per unit of the galaxies that follow, whose Poisson noise is then part of their noise. A method
    /// that ignores it takes the noise of the sky alone.
    fn set_gain(&mut self, _gain: Option<f64>) {}

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError>;

    /// Takes the PSF set last on pixels of another shape: what was adapted to it stays.
    fn retake_psf(&mut self) {}

    /// The settings that were adapted to PSF and galaxies, if the method adapts any.
    fn adapted(&self) -> Option<AdaptedSettings> {
        None
    }

    /// Measures a cut stamp of noise level `noise`. `None` if there is no unit of brightness.
    fn measure_cut(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError>;

    /// Measures a galaxy on the cut stamps of `count` epochs, which are combined before the shape is measured. Returns the
    /// result with the level of the combined noise, for a pixel of the first epoch. PSFs that were set are lost.
    fn measure_combined<'a>(
        &mut self,
        _count: usize,
        _epoch: &dyn Fn(usize) -> CutEpoch<'a>,
    ) -> Result<(Found, f64), MeasureError> {
        Err(EpochError::Network.into())
    }

    /// The deconvolved stamp and the autocorrelation of the last measurement.
    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images;
}

/// One of several stamps of a galaxy.
pub(crate) struct CutEpoch<'a> {
    pub(crate) cut: &'a [f32],
    pub(crate) psf: ArrayView2<'a, f64>,
    /// Level of white noise.
    pub(crate) noise: f64,
    /// From pixels to coordinates that all epochs have in common.
    pub(crate) pixels: EpochPixels,
    /// Of the galaxy from the middle of the stamp, in pixels.
    pub(crate) offset: [f64; 2],
    /// Mean square per axis of the image's galaxies with the PSF in px².
    pub(crate) galaxy_variance: Option<f64>,
    /// Electrons per unit of the stamp.
    pub(crate) gain: Option<f64>,
    /// The common profile of the image's noisy stars.
    pub(crate) stars: Option<&'a Arc<ResidualProfiles>>,
}

/// Lengths of the linear method after their adaptation to the PSF and to the galaxies of a survey.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct AdaptedSettings {
    /// σ in pixels of the Gaussian that the deconvolved stamp is convolved with.
    pub target_sigma: f64,
    /// σ in pixels of the window.
    pub window_sigma: f64,
    /// Scale in pixels of the weight of the moments.
    pub weight_scale: f64,
}

/// The steps of a measurement as images.
pub(crate) struct Images {
    pub(crate) deconvolved: Array2<f64>,
    /// Zero lag in the middle.
    pub(crate) acf: Array2<f64>,
    /// Weight of each lag in the moments, if it varies within the radius.
    pub(crate) weight: Option<Array2<f64>>,
    /// Pixels between lags.
    pub(crate) spacing: f64,
}

/// The whole autocorrelation from its lags dy = 0…R, dx = −R…R: the half with dy < 0 follows from
/// A(−dx, −dy) = A(dx, dy).
pub(super) fn whole_lags(lags: &[f32], reach: usize) -> Array2<f64> {
    let side = 2 * reach + 1;
    Array2::from_shape_fn((side, side), |(y, x)| {
        let (y, x) = if y < reach {
            (side - 1 - y, side - 1 - x)
        } else {
            (y, x)
        };
        f64::from(lags[(y - reach) * side + x])
    })
}

pub(super) fn image(values: &[f32], n: usize) -> Array2<f64> {
    Array2::from_shape_fn((n, n), |(y, x)| f64::from(values[y * n + x]))
}
