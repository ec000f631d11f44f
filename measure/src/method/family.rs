//! The linear method for PSFs of any breadth: a member for each step of it.
//!
//! What a PSF destroys follows its width, and so do the Gaussian that the deconvolved stamp is convolved with and
//! the weight of the moments: a target much sharper than the PSF is made of noise. The window does not, which keeps
//! out noise beyond the galaxy.

use std::sync::{Arc, OnceLock};

use ndarray::ArrayView2;
use shearq_submissions::{LinearMethod, PsfCut};

use super::found::{CutWorker, Found, Images};
use super::linear::{LinearPlan, LinearWorker};
use crate::error::MeasureError;
use crate::noise::StampNoise;
use crate::psf::breadth;
use crate::sizes::check_psf;

/// Broadest target, in pixels.
const MAX_TARGET: f64 = 6.0;

/// What one submission and stamp size need.
pub(crate) struct LinearFamily {
    method: LinearMethod,
    n: usize,
    cut: PsfCut,
    first: Arc<LinearPlan>,
    /// Of further steps, planned when first needed.
    others: Vec<OnceLock<Arc<LinearPlan>>>,
}

impl LinearFamily {
    pub(super) fn new(method: &LinearMethod, n: usize, cut: PsfCut) -> Result<Self, MeasureError> {
        Ok(LinearFamily {
            method: method.clone(),
            n,
            cut,
            first: Arc::new(LinearPlan::new(method, n, cut.size)?),
            others: (1..=breadth::LAST).map(|_| OnceLock::new()).collect(),
        })
    }

    fn member(&self, step: usize) -> Result<Arc<LinearPlan>, MeasureError> {
        let Some(place) = step.checked_sub(1) else {
            return Ok(Arc::clone(&self.first));
        };
        let place = &self.others[place];
        if let Some(plan) = place.get() {
            return Ok(Arc::clone(plan));
        }
        let mut method = self.method.clone();
        let target = &mut method.deconvolution.target_sigma;
        let factor = breadth::factor(step).min(MAX_TARGET / *target).max(1.0);
        *target *= factor;
        method.shape.weight_scale *= factor;
        // An area squared.
        method.shape.softening *= factor.powi(4);
        let plan = LinearPlan::new(&method, self.n, breadth::side(self.cut, step))?;
        Ok(Arc::clone(place.get_or_init(|| Arc::new(plan))))
    }

    /// The member for a PSF of sum one.
    fn step(&self, psf: ArrayView2<'_, f64>) -> usize {
        let step = breadth::step(breadth::area(psf), self.cut.reference_area);
        // It was cut after a look at its middle alone, where it may have been a little broader.
        let fits = |&at: &usize| breadth::side(self.cut, at) >= psf.nrows();
        (step..=breadth::LAST).find(fits).unwrap_or(step)
    }
}

/// A worker for one thread.
pub(super) fn worker(family: Arc<LinearFamily>) -> Box<dyn CutWorker> {
    Box::new(FamilyWorker {
        members: vec![(0, LinearWorker::new(Arc::clone(&family.first)))],
        at: 0,
        noise: StampNoise::white(1.0),
        family,
    })
}

struct FamilyWorker {
    family: Arc<LinearFamily>,
    /// Members that were needed so far, with their steps.
    members: Vec<(usize, LinearWorker)>,
    /// The one for the PSF at hand.
    at: usize,
    noise: StampNoise,
}

impl CutWorker for FamilyWorker {
    fn set_noise(&mut self, noise: &StampNoise) {
        self.noise = noise.clone();
        for (_, member) in &mut self.members {
            member.set_noise(noise);
        }
    }

    fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        let LinearFamily { cut, .. } = &*self.family;
        if psf.nrows() < cut.size {
            check_psf(psf, cut.size)?;
        }
        let step = self.family.step(psf);
        let known = self.members.iter().position(|(of, _)| *of == step);
        self.at = if let Some(at) = known {
            at
        } else {
            let mut member = LinearWorker::new(self.family.member(step)?);
            member.set_noise(&self.noise);
            self.members.push((step, member));
            self.members.len() - 1
        };
        self.members[self.at].1.set_psf(psf)
    }

    fn measure(&mut self, cut: &[f32], noise: f64) -> Result<Option<Found>, MeasureError> {
        self.members[self.at].1.measure(cut, noise)
    }

    fn images(&mut self, cut: &[f32], psf: ArrayView2<'_, f64>) -> Images {
        self.members[self.at].1.images(cut, psf)
    }
}
