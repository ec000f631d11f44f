//! The two ways from a cut stamp to a distortion: the network, and its linear closed form.

mod found;
mod linear;
mod network;
mod surroundings;

use std::sync::Arc;

use shearq_submissions::{Method, Submission};

pub(crate) use self::found::{CutWorker, Found, Images, ResponseMatrix};
use self::linear::LinearPlan;
use self::network::NetworkPlan;
use crate::error::MeasureError;

/// A method, planned for one size of cut stamps.
pub(crate) enum MethodPlan {
    /// The network, and moments of the clipped ACF.
    Network(Arc<NetworkPlan>),
    /// The linear network, and moments under an adaptive weight.
    Linear(Arc<LinearPlan>),
}

impl MethodPlan {
    pub(crate) fn new(submission: &Submission, n: usize) -> Result<Self, MeasureError> {
        let p = submission.psf.size;
        Ok(match &submission.method {
            Method::Network(network) => {
                MethodPlan::Network(Arc::new(NetworkPlan::new(network, n, p)?))
            }
            Method::Linear(linear) => MethodPlan::Linear(Arc::new(LinearPlan::new(linear, n, p)?)),
        })
    }

    /// A worker for one thread.
    pub(crate) fn worker(&self) -> Box<dyn CutWorker> {
        match self {
            MethodPlan::Network(plan) => network::worker(Arc::clone(plan)),
            MethodPlan::Linear(plan) => linear::worker(Arc::clone(plan)),
        }
    }
}
