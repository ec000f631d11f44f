//! Fits to galaxies: what one looks like before it has a place, an orientation and a shear.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_quantities::Shear;

use super::galaxy::{Component, Galaxy, GalaxyError, Sersic};

/// A component of a fit to a galaxy. All components of a galaxy have one position angle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitComponent {
    pub profile: Sersic,
    /// Of the circle with the area of the half-light ellipse.
    pub half_light_arcsec: f64,
    pub flux: f64,
    pub axis_ratio: f64,
}

/// A fit to a galaxy: one component, or disc and bulge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    pub main: FitComponent,
    pub bulge: Option<FitComponent>,
    /// √(Σ I²)/σ of all epochs together, behind a round PSF. `None` draws it from a distribution.
    pub snr: Option<f64>,
}

impl FitComponent {
    /// |ε| of the axis ratio.
    pub fn modulus(&self) -> f64 {
        (1.0 - self.axis_ratio) / (1.0 + self.axis_ratio)
    }
}

impl Fit {
    /// The galaxy on pixels of this size, with the ellipticity that `shape` gives each component and `flux` times the light of
    /// the fit.
    ///
    /// # Errors
    /// If a component is none that can be drawn.
    pub fn galaxy(
        &self,
        pixel_arcsec: f64,
        flux: f64,
        shape: impl Fn(&FitComponent) -> Shear,
    ) -> Result<Galaxy, GalaxyError> {
        let component = |own: &FitComponent| Component {
            profile: own.profile,
            half_light_radius: own.half_light_arcsec / pixel_arcsec,
            flux: flux * own.flux,
            dx: 0.0,
            dy: 0.0,
            shape: shape(own),
        };
        let main = component(&self.main);
        match &self.bulge {
            None => Galaxy::new(&[main]),
            Some(bulge) => Galaxy::new(&[component(bulge), main]),
        }
    }
}

/// The axis ratio of an ellipse with the modulus |ε|.
pub fn axis_ratio(modulus: f64) -> f64 {
    (1.0 - modulus) / (1.0 + modulus)
}

/// A number whose logarithm has this scatter about that of the median, within bounds.
pub fn log_normal(
    rng: &mut ChaCha8Rng,
    median: f64,
    scatter: f64,
    (least, most): (f64, f64),
) -> f64 {
    let draw: f64 = StandardNormal.sample(rng);
    (median * (scatter * draw).exp()).clamp(least, most)
}

/// A modulus of Rayleigh's distribution with the scale `sigma`, at most `most`.
pub fn rayleigh(rng: &mut ChaCha8Rng, sigma: f64, most: f64) -> f64 {
    let u: f64 = rng.random_range(f64::EPSILON..1.0);
    (sigma * (-2.0 * u.ln()).sqrt()).min(most)
}
