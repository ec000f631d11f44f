//! A method measures a cut stamp: the network, or the linear method.

mod found;
mod linear;
mod network;
mod worker;

use std::sync::Arc;

use shearq_submissions::{Configuration, Method};

use self::linear::LinearFamily;
use self::network::{NetworkPlan, NetworkWorker};
use crate::error::MeasureError;

pub(crate) use self::found::Saturation;
pub use self::worker::AdaptedSettings;
pub(crate) use self::worker::{CutEpoch, CutWorker, Images};

/// A method, planned for one size of cut stamps.
pub(crate) enum MethodPlan {
    /// The network, and moments of the clipped autocorrelation.
    Network(Arc<NetworkPlan>),
    /// The closed form of the network, and moments under a round weight.
    Linear(Arc<LinearFamily>),
}

impl MethodPlan {
    pub(crate) fn new(configuration: &Configuration, n: usize) -> Result<Self, MeasureError> {
        let cut = configuration.psf_cut();
        Ok(match &configuration.method {
            Method::Network(network) => {
                MethodPlan::Network(Arc::new(NetworkPlan::new(network, n, cut.size)?))
            }
            Method::Linear(linear) => {
                MethodPlan::Linear(Arc::new(LinearFamily::new(linear, n, cut)?))
            }
            Method::Detection { .. } => return Err(MeasureError::NoStamps),
        })
    }

    /// A worker for one thread.
    pub(crate) fn worker(&self) -> Box<dyn CutWorker> {
        match self {
            MethodPlan::Network(plan) => Box::new(NetworkWorker::new(Arc::clone(plan))),
            MethodPlan::Linear(family) => Box::new(family.worker()),
        }
    }
}
