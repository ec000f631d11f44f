//! The network, and moments of the clipped autocorrelation.

use std::sync::Arc;

use ndarray::ArrayView2;
use shearq_submissions::{Deconvolution, Submission};

use super::{Found, Images, Worker, flag_of, image, whole};
use crate::deconvolve::{Network, NetworkScratch, OperatorError, Rule};
use crate::shape::{AcfScratch, Autocorrelation, ClippedMoments};

/// What one submission and stamp size need.
pub(in crate::pipeline) struct NetworkPlan {
    settings: Deconvolution,
    network: Network<f32>,
    acf: Autocorrelation,
    moments: ClippedMoments,
}

impl NetworkPlan {
    pub(super) fn new(submission: &Submission, n: usize) -> Result<Self, OperatorError> {
        let settings = submission.deconvolution.clone();
        Ok(NetworkPlan {
            network: Network::plan(n, submission.psf.size, settings.lambda)?,
            acf: Autocorrelation::new(n),
            moments: ClippedMoments::new(n, submission.shape.acf_share),
            settings,
        })
    }
}

/// A worker for one thread.
pub(super) fn worker(plan: Arc<NetworkPlan>) -> Box<dyn Worker> {
    let n = plan.network.stamp_size();
    Box::new(NetworkWorker {
        network: plan.network.clone(),
        buffers: plan.network.scratch(),
        acf_buffers: plan.acf.scratch(),
        deconvolved: vec![0.0; n * n],
        lags: vec![0.0; plan.acf.len()],
        plan,
    })
}

struct NetworkWorker {
    plan: Arc<NetworkPlan>,
    /// With the PSF.
    network: Network<f32>,
    buffers: NetworkScratch<f32>,
    acf_buffers: AcfScratch,
    deconvolved: Vec<f32>,
    lags: Vec<f32>,
}

impl Worker for NetworkWorker {
    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), OperatorError> {
        self.network.set_psf(psf)
    }

    fn measure(&mut self, cut: &[f32], noise: f64) -> Option<Found> {
        let plan = &*self.plan;
        let peak = cut.iter().copied().fold(0.0f32, f32::max);
        let rule = Rule::new(&plan.settings, f64::from(peak), noise)?;
        let buffers = &mut self.buffers;
        let outcome = self
            .network
            .deconvolve(&rule, cut, buffers, &mut self.deconvolved);
        let flux = self.deconvolved.iter().map(|&v| f64::from(v)).sum();
        plan.acf
            .compute(&self.deconvolved, &mut self.acf_buffers, &mut self.lags);
        let measured = plan.moments.measure(&self.lags, flux);
        let (radius, size) = measured.map_or((f64::NAN, f64::NAN), |m| (m.radius, m.xx + m.yy));
        let distortion = measured.and_then(|moments| moments.distortion());
        Some(Found {
            outcome,
            distortion: distortion.map_err(flag_of),
            response: [[f64::NAN; 2]; 2],
            sheared_noise: None,
            flux,
            radius,
            size,
        })
    }

    fn images(&mut self, _cut: &[f32], _psf: ArrayView2<'_, f64>) -> Images {
        let n = self.network.stamp_size();
        Images {
            deconvolved: image(&self.deconvolved, n),
            acf: whole(&self.lags, n - 1),
            spacing: 1.0,
        }
    }
}
