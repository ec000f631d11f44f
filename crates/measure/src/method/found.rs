//! The common interface of the methods.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_quantities::Distortion;

use crate::deconvolve::Descent;
use crate::error::MeasureError;
use crate::flag::Flag;
use crate::measurement::ResponseMatrix;
use crate::noise::StampNoise;
use crate::psf::CommonProfile;
use crate::versions::VersionSettings;

/// The plan, PSF and buffers of a method in one thread.
pub(crate) trait CutWorker: Send {
    /// Sets what an image is known by: its noise in units of the level, the mean square radius per axis of its galaxies
    /// with the PSF in px², and what its noisy stars have in common. At first the noise is white and nothing else is known.
    fn set_image(
        &mut self,
        _noise: &StampNoise,
        _extent: Option<f64>,
        _stars: Option<&Arc<CommonProfile>>,
    ) {
    }

    /// Sets a PSF of the image.
    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError>;

    /// The settings that were adapted to PSF and galaxies, if the method adapts any.
    fn adapted(&self) -> Option<AdaptedSettings> {
        None
    }

    /// Measures a cut stamp of noise level `noise`. `None` if there is no unit of brightness.
    fn measure(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError>;

    /// The deconvolved stamp and the autocorrelation behind the last measurement. For pictures.
    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images;
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

/// Results of a method on a stamp.
pub(crate) struct Found {
    pub(crate) descent: Descent,
    /// The distortion, or why there is none.
    pub(crate) distortion: Result<Distortion, Flag>,
    /// Response of the distortion, if the method determines it.
    pub(crate) response: Option<ResponseMatrix>,
    /// Effect of sheared noise, on the galaxies on which it is estimated.
    pub(crate) sheared_noise: Option<Sheared>,
    /// Flux and size before the PSF, if the method determines them.
    pub(crate) observed: Option<FoundObservables>,
    pub(crate) flux: f64,
    pub(crate) radius: f64,
    pub(crate) size: f64,
}

/// Flux and size of a galaxy before the PSF.
pub(crate) struct FoundObservables {
    pub(crate) flux: f64,
    pub(crate) flux_error: f64,
    pub(crate) flux_response: [f64; 2],
    /// Response of T, from which the size follows.
    pub(crate) square_response: [f64; 2],
    /// The size, and its first and second derivative with T.
    pub(crate) size: [f64; 3],
    /// Mean products of changes with noise of χ₁, χ₂, T and the flux, in the order 00, 01, 02, 03, 11, …, for noise changed
    /// by γ₁, by γ₂, turned, and as it is, on the galaxies on which they are determined.
    pub(crate) products: Option<[[f64; 4]; 10]>,
    /// What sheared versions are made with, if they are asked for.
    pub(crate) versions: Option<VersionSettings>,
}

/// How the response of a galaxy differs with a field of noise added and taken away, to a shear of
/// that field alone.
pub(crate) struct Sheared {
    /// With the field added, and taken away.
    pub(crate) sides: [(Distortion, ResponseMatrix); 2],
    /// Change of the distortion on either side with what that field lacks to be one of a PSF turned by 90 degrees.
    pub(crate) turned: [[f64; 2]; 2],
    /// Change of the size's T on either side with what γ₁ and γ₂ make of the field, and with what it lacks to be one of a
    /// turned PSF.
    pub(crate) breadth: [[f64; 3]; 2],
    /// Factor from the difference of responses to what sheared noise adds to the mean response.
    pub(crate) weight: f64,
}

/// The steps of a measurement as images.
pub(crate) struct Images {
    pub(crate) deconvolved: Array2<f64>,
    /// Zero lag in the middle.
    pub(crate) acf: Array2<f64>,
    /// Weight of each lag in the moments, where it is not the same within the radius.
    pub(crate) weight: Option<Array2<f64>>,
    /// Pixels between lags.
    pub(crate) spacing: f64,
}

/// The whole autocorrelation from its lags dy = 0…R, dx = −R…R: the half with dy < 0 follows from
/// A(−dx, −dy) = A(dx, dy).
pub(super) fn whole(lags: &[f32], reach: usize) -> Array2<f64> {
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
