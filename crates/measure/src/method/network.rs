//! The network, and moments of the clipped autocorrelation.

use std::sync::Arc;

use ndarray::ArrayView2;
use shearq_submissions::{EllipticityType, NetworkDeconvolution, NetworkMethod};

use super::found::{Found, components};
use super::worker::{CutWorker, Images, image, whole_lags};
use crate::error::MeasureError;
use crate::network::{Network, NetworkScratch, Rule};
use crate::shape::{ClippedAcf, ClippedAcfScratch};

pub(crate) struct NetworkPlan {
    settings: NetworkDeconvolution,
    network: Network,
    acf: ClippedAcf,
    ellipticity: EllipticityType,
}

impl NetworkPlan {
    pub(super) fn new(method: &NetworkMethod, n: usize, p: usize) -> Result<Self, MeasureError> {
        let settings = method.deconvolution.clone();
        Ok(NetworkPlan {
            network: Network::plan(n, p, settings.printed_lambda(settings.lambda))?,
            acf: ClippedAcf::new(n, &method.shape),
            ellipticity: method.shape.ellipticity,
            settings,
        })
    }
}

pub(super) struct NetworkWorker {
    plan: Arc<NetworkPlan>,
    network: Network,
    buffers: NetworkScratch,
    /// Flux of a state per sum of its pixels: a scaled PSF does not have a sum of one.
    light: f64,
    acf_buffers: ClippedAcfScratch,
    deconvolved: Vec<f32>,
}

impl NetworkWorker {
    pub(super) fn new(plan: Arc<NetworkPlan>) -> Self {
        let n = plan.network.stamp_size();
        NetworkWorker {
            network: plan.network.clone(),
            buffers: plan.network.scratch(),
            light: 1.0,
            acf_buffers: plan.acf.scratch(),
            deconvolved: vec![0.0; n * n],
            plan,
        }
    }
}

impl CutWorker for NetworkWorker {
    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let scale = self.plan.settings.psf_scale;
        self.light = self.network.set_psf(psf, scale)?;
        Ok(())
    }

    fn measure_cut(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError> {
        let plan = &*self.plan;
        let peak = cut.iter().copied().fold(0.0f32, f32::max);
        let Some(rule) = Rule::new(&plan.settings, f64::from(peak), noise) else {
            return Ok(None);
        };
        let buffers = &mut self.buffers;
        let descent = self
            .network
            .deconvolve(&rule, cut, buffers, &mut self.deconvolved)?;
        let sum: f64 = self.deconvolved.iter().map(|&v| f64::from(v)).sum();
        let flux = sum * self.light;
        let measured = plan
            .acf
            .measure(&self.deconvolved, sum, &mut self.acf_buffers)?;
        let (radius, size) = measured.map_or((f64::NAN, f64::NAN), |m| (m.radius, m.xx + m.yy));
        let distortion = measured.and_then(|moments| moments.distortion());
        Ok(Some(Found {
            descent,
            ellipticity: distortion.and_then(|chi| components(chi, plan.ellipticity)),
            response: None,
            noise_moments: None,
            observables: None,
            flux,
            radius,
            size,
        }))
    }

    fn images(&mut self, _cut: &[f32], _psf: ArrayView2<'_, f64>) -> Images {
        let n = self.network.stamp_size();
        Images {
            deconvolved: image(&self.deconvolved, n),
            acf: whole_lags(self.acf_buffers.acf(), self.plan.acf.reach()),
            weight: None,
            spacing: 1.0,
        }
    }
}
