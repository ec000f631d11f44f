//! What all threads share in a measurement.

use shearq_submissions::Configuration;

use crate::denoise::WaveletWiener;
use crate::method::MethodPlan;
use crate::noise::{NoisePlan, Survey};
use crate::sky::Subtraction;

/// The plan of a measurement, for one configuration and one size of stamps.
pub(crate) struct Plan {
    pub(crate) configuration: Configuration,
    pub(crate) full: usize,
    pub(crate) n: usize,
    pub(crate) denoise: Option<WaveletWiener>,
    pub(crate) method: MethodPlan,
    pub(crate) noise: Option<NoisePlan>,
}

impl Plan {
    /// What is subtracted from stamps of an image with this survey.
    pub(crate) fn subtraction(&self, survey: Option<&Survey>) -> Subtraction {
        let sky = survey.and_then(|survey| survey.sky);
        Subtraction::of(self.configuration.noise.sky(), sky)
    }
}
