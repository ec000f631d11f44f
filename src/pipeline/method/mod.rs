//! The two ways from a cut stamp to a distortion: the network, and its linear closed form.

mod linear;
mod network;

use std::sync::Arc;

use ndarray::{Array2, ArrayView2};
use shearq_scoring::Distortion;
use shearq_submissions::{AcfWeight, Submission, Update};

use self::linear::LinearPlan;
use self::network::NetworkPlan;
use super::galaxy::flag;
use crate::deconvolve::{OperatorError, Outcome};
use crate::shape::Unmeasurable;

/// A method, planned.
pub(super) enum Method {
    /// The network, and moments of the clipped ACF.
    Network(Arc<NetworkPlan>),
    /// The linear network, and moments under an adaptive weight.
    Linear(Arc<LinearPlan>),
}

/// One thread's part in a method: its plan, PSF and buffers.
pub(super) trait Worker {
    /// Takes a PSF.
    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), OperatorError>;

    /// Measures a cut stamp of noise level `noise`. `None` where there is no scale to work in.
    fn measure(&mut self, cut: &[f32], noise: f64) -> Option<Found>;

    /// The deconvolved stamp and the autocorrelation behind the last measurement. For pictures.
    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images;
}

/// What a method found on a stamp.
pub(super) struct Found {
    pub(super) outcome: Outcome,
    /// The distortion, or bits of [`flag`].
    pub(super) distortion: Result<Distortion, u32>,
    /// Response of the distortion; NaN where the method does not know it.
    pub(super) response: Response,
    /// Sheared noise, where the method has looked at it.
    pub(super) sheared_noise: Option<Sheared>,
    pub(super) flux: f64,
    pub(super) radius: f64,
    pub(super) size: f64,
}

/// ∂χ_i/∂γ_j, `[i][j]`.
pub(super) type Response = [[f64; 2]; 2];

/// How the response of a galaxy differs with a field of noise added and taken away, to a shear of
/// that field alone.
pub(super) struct Sheared {
    /// With the field added, and taken away.
    pub(super) sides: [(Distortion, Response); 2],
    /// Factor from the difference of responses to what sheared noise adds to the mean response.
    pub(super) weight: f64,
}

/// The steps of a measurement as images.
pub(super) struct Images {
    pub(super) deconvolved: Array2<f64>,
    /// Zero lag in the middle.
    pub(super) acf: Array2<f64>,
    /// Pixels between lags.
    pub(super) spacing: f64,
}

impl Method {
    pub(super) fn new(submission: &Submission, n: usize) -> Result<Self, OperatorError> {
        let update = submission.deconvolution.update;
        Ok(match (update, submission.shape.weight) {
            (Update::Linear, _) | (_, AcfWeight::Moffat) => {
                Method::Linear(Arc::new(LinearPlan::new(submission, n)?))
            }
            (Update::Adaptive | Update::Accelerated | Update::Constant, AcfWeight::Clipped) => {
                Method::Network(Arc::new(NetworkPlan::new(submission, n)?))
            }
        })
    }

    /// A worker for one thread.
    pub(super) fn worker(&self) -> Box<dyn Worker> {
        match self {
            Method::Network(plan) => network::worker(Arc::clone(plan)),
            Method::Linear(plan) => linear::worker(Arc::clone(plan)),
        }
    }
}

/// The whole autocorrelation from its lags dy = 0…R, dx = −R…R: the half with dy < 0 follows from
/// A(−dx, −dy) = A(dx, dy).
fn whole(lags: &[f32], reach: usize) -> Array2<f64> {
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

fn image(values: &[f32], n: usize) -> Array2<f64> {
    Array2::from_shape_fn((n, n), |(y, x)| f64::from(values[y * n + x]))
}

fn flag_of(error: Unmeasurable) -> u32 {
    match error {
        Unmeasurable::NoLight => flag::NO_LIGHT,
        Unmeasurable::NoExtent => flag::NO_EXTENT,
    }
}
