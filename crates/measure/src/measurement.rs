//! What was measured on one galaxy.

use crate::deconvolve::Descent;
use crate::flag::{Flag, Flags};

/// What was measured on one galaxy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Reported ellipticity, of the submission's type; NaN if flagged.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// Why the galaxy could not be measured.
    pub flags: Flags,
    /// The galaxy's own response of e1 to γ1 and of e2 to γ2, before any calibration; NaN where it is not
    /// measured. Fit for means over many galaxies: what sheared noise adds to the mean is subtracted from a
    /// few of them, for all.
    pub response: [f64; 2],
    /// How the network ran; `None` if it did not.
    pub descent: Option<Descent>,
    /// Noise level used, in image units; NaN if unknown.
    pub noise: f64,
    /// Sum of the deconvolved stamp, in image units; of the stamp itself under the linear method.
    pub flux: f64,
    /// Radius of the clipped ACF in pixels; of the lags used under the linear method.
    pub radius: f64,
    /// Qxx + Qyy of the clipped, or weighted, ACF in px².
    pub size: f64,
}

impl Measurement {
    /// A galaxy with nothing measured.
    pub(crate) fn flagged(flag: Flag) -> Self {
        Measurement {
            e1: f64::NAN,
            e2: f64::NAN,
            flags: flag.into(),
            response: [f64::NAN; 2],
            descent: None,
            noise: f64::NAN,
            flux: f64::NAN,
            radius: f64::NAN,
            size: f64::NAN,
        }
    }
}
