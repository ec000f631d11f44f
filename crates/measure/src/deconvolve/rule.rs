//! A submission's settings turned into the numbers that one stamp needs.

use shearq_submissions::{
    BrightnessUnit, Clipping, Kept, NetworkDeconvolution, Start, StepScale, Update,
};

/// How far an updated neuron moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Step {
    /// Δv_i = c·|f_i| (Eq. 10), c without unit.
    Adaptive(f64),
    /// The same with momentum.
    Accelerated(f64),
    /// Δv_i in image units (Eq. 6).
    Constant(f64),
}

/// The updating rule for one stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rule {
    /// Size of an update.
    pub step: Step,
    /// One unit of brightness in image units: thresholds are TH_i times this.
    pub unit: f64,
    /// M.
    pub max_iterations: usize,
    /// First state.
    pub start: Start,
    /// When negative neurons are set to zero.
    pub clipping: Clipping,
    /// Which state is kept where the energy rises.
    pub kept: Kept,
}

impl Rule {
    /// The rule for a stamp whose brightest pixel is `peak` and whose noise is `sigma`, both in
    /// image units. `None` where the unit of brightness would not be positive, so that the stamp
    /// cannot be measured with these settings.
    pub fn new(settings: &NetworkDeconvolution, peak: f64, sigma: f64) -> Option<Self> {
        let unit = match settings.brightness_unit {
            BrightnessUnit::Image => 1.0,
            BrightnessUnit::Noise => sigma,
            BrightnessUnit::Peak => peak,
        } / settings.unit_divisor;
        if !(unit.is_finite() && unit > 0.0) {
            return None;
        }
        let c = match settings.step_scale {
            StepScale::Fixed => settings.step,
            StepScale::Peak => settings.step * peak / unit,
        };
        let step = match settings.update {
            Update::Adaptive => Step::Adaptive(c),
            Update::Accelerated => Step::Accelerated(c),
            Update::Constant => Step::Constant(settings.constant_step * unit),
        };
        Some(Rule {
            step,
            unit,
            max_iterations: settings.max_iterations,
            start: settings.start,
            clipping: settings.clipping,
            kept: settings.kept,
        })
    }
}
