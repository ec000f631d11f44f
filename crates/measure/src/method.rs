//! A method measures a cut stamp: the network, or the linear method.

mod found;
mod linear;
mod network;
mod plan;
mod worker;

pub(crate) use self::found::Saturation;
pub(crate) use self::plan::MethodPlan;
pub use self::worker::AdaptedSettings;
pub(crate) use self::worker::{CutEpoch, CutWorker, Images};
