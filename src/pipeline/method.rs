//! The two ways from a cut stamp to a distortion: the network, and its linear closed form.

use ndarray::{Array2, ArrayView2};
use shearq_scoring::Distortion;
use shearq_submissions::{AcfWeight, Submission, Update};

use super::galaxy::flag;
use crate::deconvolve::{
    Lags, Network, NetworkScratch, OperatorError, Outcome, Rule, Spectral, SpectralPsf,
    SpectralScratch, Stop,
};
use crate::shape::{
    AcfScratch, AdaptiveMoments, AdaptiveScratch, Autocorrelation, ClippedMoments, Unmeasurable,
};

/// A method, planned.
pub(super) enum Method {
    /// The network, and moments of the clipped ACF.
    Network {
        network: Box<Network<f32>>,
        acf: Autocorrelation,
        moments: ClippedMoments,
    },
    /// The linear network, and moments under an adaptive Gaussian.
    Linear {
        spectral: Box<Spectral>,
        moments: AdaptiveMoments,
    },
}

/// One thread's buffers of a method, its PSF among them.
pub(super) enum MethodScratch {
    Network {
        network: Box<Network<f32>>,
        buffers: Box<NetworkScratch<f32>>,
        acf_buffers: AcfScratch,
        deconvolved: Vec<f32>,
        acf: Vec<f32>,
    },
    Linear {
        psf: SpectralPsf,
        buffers: Box<SpectralScratch>,
        lags: Lags,
        moments: AdaptiveScratch,
    },
}

/// What a method found on a stamp.
pub(super) struct Found {
    pub(super) outcome: Outcome,
    /// The distortion, or bits of [`flag`].
    pub(super) distortion: Result<Distortion, u32>,
    /// ∂χ_i/∂γ_j, `[i][j]`; NaN where the method does not know it.
    pub(super) response: [[f64; 2]; 2],
    pub(super) flux: f64,
    pub(super) radius: f64,
    pub(super) size: f64,
}

impl Method {
    pub(super) fn new(
        submission: &Submission,
        n: usize,
        full: usize,
    ) -> Result<Self, OperatorError> {
        let d = &submission.deconvolution;
        let p = submission.psf.size;
        Ok(match (d.update, submission.shape.weight) {
            (Update::Linear, _) | (_, AcfWeight::Gaussian) => {
                let sigma = submission.shape.weight_sigma;
                Method::Linear {
                    spectral: Box::new(Spectral::new(
                        n,
                        full,
                        p,
                        AdaptiveMoments::reach(sigma),
                        d,
                    )?),
                    moments: AdaptiveMoments::new(sigma),
                }
            }
            (Update::Adaptive | Update::Accelerated | Update::Constant, AcfWeight::Clipped) => {
                Method::Network {
                    network: Box::new(Network::plan(n, p, d.lambda)?),
                    acf: Autocorrelation::new(n),
                    moments: ClippedMoments::new(n, submission.shape.acf_share),
                }
            }
        })
    }

    /// Stamp side n.
    pub(super) fn stamp_size(&self) -> usize {
        match self {
            Method::Network { network, .. } => network.stamp_size(),
            Method::Linear { spectral, .. } => spectral.stamp_size(),
        }
    }

    pub(super) fn scratch(&self) -> MethodScratch {
        match self {
            Method::Network { network, acf, .. } => {
                let n = network.stamp_size();
                MethodScratch::Network {
                    network: network.clone(),
                    buffers: Box::new(network.scratch()),
                    acf_buffers: acf.scratch(),
                    deconvolved: vec![0.0; n * n],
                    acf: vec![0.0; acf.len()],
                }
            }
            Method::Linear { spectral, moments } => MethodScratch::Linear {
                psf: spectral.psf(),
                buffers: Box::new(spectral.scratch()),
                lags: spectral.lags(),
                moments: moments.scratch(),
            },
        }
    }

    /// Takes a PSF.
    pub(super) fn set_psf(
        &self,
        scratch: &mut MethodScratch,
        psf: ArrayView2<'_, f64>,
    ) -> Result<(), OperatorError> {
        match (self, scratch) {
            (_, MethodScratch::Network { network, .. }) => network.set_psf(psf),
            (
                Method::Linear { spectral, .. },
                MethodScratch::Linear {
                    psf: own, buffers, ..
                },
            ) => spectral.set_psf(psf, buffers, own),
            (Method::Network { .. }, MethodScratch::Linear { .. }) => Ok(()),
        }
    }

    /// Measures a stamp of noise level `noise`, given as it is and cut. `None` where there is no scale to work in.
    pub(super) fn measure(
        &self,
        submission: &Submission,
        full: &[f32],
        cut: &[f32],
        noise: f64,
        scratch: &mut MethodScratch,
    ) -> Option<Found> {
        match (self, scratch) {
            (
                Method::Network { acf, moments, .. },
                MethodScratch::Network {
                    network,
                    buffers,
                    acf_buffers,
                    deconvolved,
                    acf: lags,
                },
            ) => {
                let peak = cut.iter().copied().fold(0.0f32, f32::max);
                let rule = Rule::new(&submission.deconvolution, f64::from(peak), noise)?;
                let outcome = network.deconvolve(&rule, cut, buffers, deconvolved);
                let flux = sum(deconvolved);
                acf.compute(deconvolved, acf_buffers, lags);
                let measured = moments.measure(lags, flux);
                let (radius, size) =
                    measured.map_or((f64::NAN, f64::NAN), |m| (m.radius, m.xx + m.yy));
                let distortion = measured.and_then(|moments| moments.distortion());
                Some(Found {
                    outcome,
                    distortion: distortion.map_err(flag_of),
                    response: [[f64::NAN; 2]; 2],
                    flux,
                    radius,
                    size,
                })
            }
            (
                Method::Linear { spectral, moments },
                MethodScratch::Linear {
                    psf,
                    buffers,
                    lags,
                    moments: own,
                },
            ) => {
                if !(noise >= 0.0 && noise.is_finite()) {
                    return None;
                }
                spectral.autocorrelate(psf, full, noise as f32, true, buffers, lags);
                let shape = moments.measure(&lags.acf, own);
                let mut response = [[f64::NAN; 2]; 2];
                if let Ok(shape) = &shape {
                    let first = moments.response(shape, &lags.shear1, own);
                    let second = moments.response(shape, &lags.shear2, own);
                    response = [[first[0], second[0]], [first[1], second[1]]];
                }
                Some(Found {
                    outcome: Outcome {
                        iterations: submission.deconvolution.max_iterations as u32,
                        stop: Stop::MaxIterations,
                        first_energy: f64::NAN,
                        energy: f64::NAN,
                        updated: cut.len() as u32,
                    },
                    distortion: shape.map(|s| s.distortion).map_err(flag_of),
                    response,
                    flux: sum(cut),
                    radius: spectral.reach() as f64,
                    size: shape.map_or(f64::NAN, |s| s.size),
                })
            }
            // A scratch of another method: not of this measurer.
            (Method::Network { .. }, MethodScratch::Linear { .. })
            | (Method::Linear { .. }, MethodScratch::Network { .. }) => None,
        }
    }

    /// The deconvolved stamp and the full autocorrelation, zero lag in the middle and NaN where it
    /// was not computed, behind the last measurement with this scratch. For pictures.
    pub(super) fn images(
        &self,
        cut: &[f32],
        psf: ArrayView2<'_, f64>,
        scratch: &mut MethodScratch,
    ) -> (Array2<f64>, Array2<f64>) {
        let n = self.stamp_size();
        let (deconvolved, lags, reach) = match (self, scratch) {
            (
                _,
                MethodScratch::Network {
                    deconvolved, acf, ..
                },
            ) => (deconvolved.clone(), &*acf, n - 1),
            (Method::Linear { spectral, .. }, MethodScratch::Linear { buffers, lags, .. }) => (
                spectral.deconvolved(psf, cut, buffers),
                &lags.acf,
                spectral.reach(),
            ),
            (Method::Network { .. }, MethodScratch::Linear { lags, .. }) => {
                (cut.to_vec(), &lags.acf, 0)
            }
        };
        let image = Array2::from_shape_fn((n, n), |(y, x)| f64::from(deconvolved[y * n + x]));
        let side = 2 * reach + 1;
        let acf = Array2::from_shape_fn((side, side), |(y, x)| {
            // The half with dy < 0 follows from A(−dx, −dy) = A(dx, dy).
            let (y, x) = if y < reach {
                (side - 1 - y, side - 1 - x)
            } else {
                (y, x)
            };
            f64::from(lags[(y - reach) * side + x])
        });
        (image, acf)
    }
}

fn sum(values: &[f32]) -> f64 {
    values.iter().map(|&v| f64::from(v)).sum()
}

fn flag_of(error: Unmeasurable) -> u32 {
    match error {
        Unmeasurable::NoLight => flag::NO_LIGHT,
        Unmeasurable::NoExtent => flag::NO_EXTENT,
    }
}
