//! The two ways from a cut stamp to a distortion: the network, and its linear closed form.

mod family;
mod found;
mod linear;
mod network;
mod softening;
mod window;

use std::sync::Arc;

use shearq_submissions::{Configuration, Method};

use self::family::LinearFamily;
pub use self::found::AdaptedSettings;
pub(crate) use self::found::{CutWorker, Found, FoundObservables, Images, Sheared};
use self::network::NetworkPlan;
use crate::error::MeasureError;

/// A method, planned for one size of cut stamps.
pub(crate) enum MethodPlan {
    /// The network, and moments of the clipped ACF.
    Network(Arc<NetworkPlan>),
    /// The linear network, and moments under an adaptive weight.
    Linear(Arc<LinearFamily>),
}

impl MethodPlan {
    pub(crate) fn new(configuration: &Configuration, n: usize) -> Result<Self, MeasureError> {
        Ok(match &configuration.method {
            Method::Network(network) => MethodPlan::Network(Arc::new(NetworkPlan::new(
                network,
                n,
                configuration.psf.size,
            )?)),
            Method::Linear(linear) => {
                let family = LinearFamily::new(linear, n, configuration.psf_cut())?;
                MethodPlan::Linear(Arc::new(family))
            }
        })
    }

    /// A worker for one thread.
    pub(crate) fn worker(&self) -> Box<dyn CutWorker> {
        match self {
            MethodPlan::Network(plan) => network::worker(Arc::clone(plan)),
            MethodPlan::Linear(family) => family::worker(Arc::clone(family)),
        }
    }
}
