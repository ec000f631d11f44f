//! The result of measuring one galaxy.

use crate::deconvolve::Descent;
use crate::flag::Flags;
use crate::observables::Observables;
use crate::versions::Versions;

/// Response ∂e_i/∂γ_j of an ellipticity to shear, as `[i][j]`: R11, R12 and R21, R22.
pub type ResponseMatrix = [[f64; 2]; 2];

/// Result of measuring one galaxy.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct Measurement {
    /// First component of the ellipticity, of the configuration's type; NaN if flagged.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// Reasons why the galaxy could not be measured.
    pub flags: Flags,
    /// Response of the reported ellipticity to shear, before calibration; `None` for the network and for galaxies that
    /// could not be measured. Only means over many galaxies are unbiased: the mean contribution of sheared noise is
    /// subtracted from one galaxy in eight, for all.
    pub response: Option<ResponseMatrix>,
    /// Flux and size before the PSF, with their responses; `None` for the network and for galaxies that could not be measured.
    pub observables: Option<Observables>,
    /// The galaxy under small shears, if the configuration asks for them.
    pub versions: Option<Versions>,
    /// Mean responses of the galaxies calibrated together, by which e1 and e2 were divided; `None` before calibration.
    pub divisor: Option<[f64; 2]>,
    /// Iterations of the network; `None` if it did not run.
    pub descent: Option<Descent>,
    /// Standard deviation of the noise that was used, in image units; NaN if unknown.
    pub noise: f64,
    /// Sum of the deconvolved stamp in image units. For the linear method, the flux of [`Observables`].
    pub flux: f64,
    /// Radius of the clipped autocorrelation in pixels. For the linear method, radius of the lags that are used.
    pub radius: f64,
    /// Qxx + Qyy of the clipped autocorrelation in px². For the linear method, the size of [`Observables`] in px.
    pub size: f64,
}

impl Measurement {
    /// R11 and R22; NaN if there is no response.
    pub fn response_diagonal(&self) -> [f64; 2] {
        self.response
            .map_or([f64::NAN; 2], |[[r11, _], [_, r22]]| [r11, r22])
    }

    /// A galaxy that could not be measured.
    pub fn flagged(flag: impl Into<Flags>) -> Self {
        Measurement {
            e1: f64::NAN,
            e2: f64::NAN,
            flags: flag.into(),
            response: None,
            observables: None,
            versions: None,
            divisor: None,
            descent: None,
            noise: f64::NAN,
            flux: f64::NAN,
            radius: f64::NAN,
            size: f64::NAN,
        }
    }
}
