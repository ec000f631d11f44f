//! Galaxies as sums of elliptical Sérsic components.
//!
//! Lengths are pixels, wavenumbers radians per pixel. A transform is F(k) = ∫ I(x) e^{−ik·x} d²x.

use std::f64::consts::{LN_2, PI};
use std::sync::OnceLock;

use puruspe::bessel::Kn;
use puruspe::gamma::{gamma, invgammp};
use shearq_quantities::Shear;
use shearq_quantities::radial::{QuadraticForm, RadialTable, composite_rule};
use thiserror::Error;

/// Half-light radius of an exponential profile in scale radii: the root of (1 + x) e^{−x} = 1/2.
pub const EXPONENTIAL_HALF_LIGHT: f64 = 1.678_346_990_016_660_7;

/// b of a de Vaucouleurs profile exp(−b (r/r_e)^{1/4}): half the light of Γ(8) lies below b.
pub const DE_VAUCOULEURS_B: f64 = 7.669_249_442_500_804;

/// The radial form of a galaxy component, I ∝ exp(−b (r/r_e)^{1/n}); none is truncated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sersic {
    /// n = 1/2.
    Gaussian,
    /// n = 1, a disc: I ∝ exp(−r/r_s).
    Exponential,
    /// n = 4, a bulge.
    DeVaucouleurs,
    /// Twice the index n, 3 or more.
    Steep(u8),
}

// Up to n = 6, beyond which fits to galaxies mean a sky that is too bright.
const TABLES: usize = 12;

// By twice the index, less one.
static TABULATED: [OnceLock<RadialTable>; TABLES] = [const { OnceLock::new() }; TABLES];

impl Sersic {
    /// The profile with the index nearest to `n` among 1/2, 1, 3/2, … 6.
    pub fn nearest(n: f64) -> Self {
        match (2.0 * n).round().clamp(1.0, TABLES as f64) as u8 {
            1 => Sersic::Gaussian,
            2 => Sersic::Exponential,
            8 => Sersic::DeVaucouleurs,
            twice => Sersic::Steep(twice),
        }
    }

    fn twice_index(self) -> u8 {
        match self {
            Sersic::Gaussian => 1,
            Sersic::Exponential => 2,
            Sersic::DeVaucouleurs => 8,
            Sersic::Steep(twice) => twice,
        }
    }

    /// The transform of the round profile of flux 1, at the square of k·r_e.
    ///
    /// Exponential: (1 + (k r_s)²)^(−3/2). Others: from a table, made at the first call, with errors below 1e-6.
    pub fn fourier(self, k_re2: f64) -> f64 {
        match self {
            Sersic::Exponential => exponential_fourier(k_re2),
            _ => self.table().at(k_re2),
        }
    }

    #[inline(always)]
    pub(crate) fn fourier_each(self, values: &mut [f64]) {
        if self == Sersic::Exponential {
            for value in values {
                *value = exponential_fourier(*value);
            }
        } else {
            let table = self.table();
            for value in values {
                *value = table.at(*value);
            }
        }
    }

    /// Surface brightness of the round profile of flux 1, per r_e², at `radius` in r_e.
    pub fn brightness(self, radius: f64) -> f64 {
        match self {
            Sersic::Exponential => {
                let h = EXPONENTIAL_HALF_LIGHT;
                h * h / (2.0 * PI) * (-h * radius).exp()
            }
            _ => Law::new(self.twice_index()).brightness(radius),
        }
    }

    pub(crate) fn table(self) -> &'static RadialTable {
        let twice = self.twice_index();
        TABULATED[usize::from(twice) - 1].get_or_init(|| Law::new(twice).tabulate())
    }
}

// b, n and the central surface brightness per r_e² for flux 1 of a Sérsic profile.
struct Law {
    twice: i32,
    b: f64,
    centre: f64,
}

// x^(m/2), in products where m is even.
fn half_power(x: f64, m: i32) -> f64 {
    let whole = x.powi(m / 2);
    if m % 2 == 0 { whole } else { whole * x.sqrt() }
}

impl Law {
    fn new(twice: u8) -> Self {
        let twice = i32::from(twice);
        let b = match twice {
            // To more digits than the inverse has, which iterates to 1e-8.
            8 => DE_VAUCOULEURS_B,
            2 => EXPONENTIAL_HALF_LIGHT,
            1 => LN_2,
            _ => invgammp(0.5, f64::from(twice)),
        };
        // b^(2n) / (2πn Γ(2n)).
        let centre = b.powi(twice) / (f64::from(twice) * PI * gamma(f64::from(twice)).round());
        Law { twice, b, centre }
    }

    fn brightness(&self, radius: f64) -> f64 {
        let root = match self.twice {
            8 => radius.sqrt().sqrt(),
            twice => radius.powf(2.0 / f64::from(twice)),
        };
        self.centre * (-self.b * root).exp()
    }

    fn tabulate(&self) -> RadialTable {
        let rule = composite_rule(0.0, 1.0, 16, 16);
        RadialTable::new(1e-3, |u| match self.twice {
            1 => (-u / (4.0 * LN_2)).exp(),
            2 => exponential_fourier(u),
            _ => self.fourier(&rule, u.sqrt()),
        })
    }

    /// F(k r_e) for n of 3/2 and more; `rule` integrates over (0, 1).
    ///
    /// The Hankel integral ∫ r I(r) J0(kr) dr oscillates under wings that hardly fall. J0 is the real
    /// part of a Hankel function, and r may turn onto the imaginary axis, where that becomes K0 and
    /// r^{1/n} only turns by π/2n. With r = i tⁿ (in r_e) and b e^{iπ/2n} = p + iq,
    ///
    ///   F(k) = 4 n I(0) · ∫ t^(2n−1) e^{−pt} sin(qt) K0(k tⁿ) dt,
    ///
    /// which decays on both counts and keeps its relative accuracy from k → 0 to k → ∞. For n = 1 the exponential no longer falls.
    fn fourier(&self, rule: &[(f64, f64)], k: f64) -> f64 {
        // Here F is 1 to 1e-10 (for n = 4, 1 − 5.4 k²).
        if k < 1e-6 {
            return 1.0;
        }
        let twice = self.twice;
        let (q, p) = (PI / f64::from(twice)).sin_cos();
        let (p, q) = (p * self.b, q * self.b);
        // Past the first bound e^{−pt} t^(2n−1), past the second K0, leaves less than 1e-17.
        let last = match twice {
            8 => (50.0 / k).sqrt().sqrt(),
            _ => (50.0 / k).powf(2.0 / f64::from(twice)),
        };
        let end = f64::min(67.3 / p, last);
        let sum: f64 = rule
            .iter()
            .map(|&(x, weight)| {
                let t = x * end;
                let light = t.powi(twice - 1) * (-p * t).exp() * (q * t).sin();
                weight * light * Kn(0, k * half_power(t, twice))
            })
            .sum();
        2.0 * f64::from(twice) * self.centre * sum * end
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum GalaxyError {
    #[error("a half-light radius must be a positive number of pixels, not {0}")]
    Radius(f64),
    #[error("a component's flux must be a number, zero or more, not {0}")]
    Flux(f64),
    #[error("the bulge's share of the flux must lie between 0 and 1, not {0}")]
    BulgeFraction(f64),
    #[error("a component's offset must be finite, not ({0}, {1})")]
    Offset(f64, f64),
    #[error("a component's ellipticity ({}, {}) must have a modulus below 1", .0.e1, .0.e2)]
    Shape(Shear),
    #[error("a galaxy has 1 or 2 components, not {0}")]
    Count(usize),
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Component {
    pub profile: Sersic,
    /// Radius of the circle that holds half the light before the shear, in pixels. The shear keeps
    /// areas, so this is the circularised half-light radius.
    pub half_light_radius: f64,
    pub flux: f64,
    /// Offset from the galaxy's centre along x, in pixels.
    pub dx: f64,
    /// Offset from the galaxy's centre along y, in pixels.
    pub dy: f64,
    /// The shear that makes it elliptical, by [`Shear::matrix`].
    pub shape: Shear,
}

impl Component {
    fn check(&self) -> Result<(), GalaxyError> {
        if !(self.half_light_radius.is_finite() && self.half_light_radius > 0.0) {
            return Err(GalaxyError::Radius(self.half_light_radius));
        }
        if !(self.flux.is_finite() && self.flux >= 0.0) {
            return Err(GalaxyError::Flux(self.flux));
        }
        if !(self.dx.is_finite() && self.dy.is_finite()) {
            return Err(GalaxyError::Offset(self.dx, self.dy));
        }
        if self.shape.modulus().is_nan() || self.shape.modulus() >= 1.0 {
            return Err(GalaxyError::Shape(self.shape));
        }
        Ok(())
    }

    /// Surface brightness per px² at (`x`, `y`) pixels from the galaxy's centre, before PSF and
    /// pixels.
    pub fn value(&self, x: f64, y: f64) -> f64 {
        let radius2 = QuadraticForm::of_positions(self.shape).at(x - self.dx, y - self.dy);
        let re = self.half_light_radius;
        self.flux * self.profile.brightness(radius2.sqrt() / re) / (re * re)
    }

    /// The squared wavenumber in units of the half-light radius.
    pub(crate) fn form(&self) -> QuadraticForm {
        let re = self.half_light_radius;
        QuadraticForm::of_wavenumbers(self.shape).scaled(re * re)
    }

    /// The transform at (`kx`, `ky`) radians per pixel about the component's own centre: real, and
    /// equal to the flux at the origin. The offset is not in it.
    pub fn fourier(&self, kx: f64, ky: f64) -> f64 {
        self.flux * self.profile.fourier(self.form().at(kx, ky))
    }
}

/// (1 + (k r_s)²)^(−3/2) of a squared wavenumber in units of the half-light radius.
#[inline(always)]
fn exponential_fourier(k_re2: f64) -> f64 {
    let v = 1.0 + k_re2 / (EXPONENTIAL_HALF_LIGHT * EXPONENTIAL_HALF_LIGHT);
    1.0 / (v * v.sqrt())
}

/// A galaxy of one or two components; it lives without heap memory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Galaxy {
    components: [Component; Self::MAX_COMPONENTS],
    count: usize,
}

impl Galaxy {
    pub const MAX_COMPONENTS: usize = 2;

    pub fn new(components: &[Component]) -> Result<Self, GalaxyError> {
        let count = components.len();
        if count == 0 || count > Self::MAX_COMPONENTS {
            return Err(GalaxyError::Count(count));
        }
        for component in components {
            component.check()?;
        }
        let mut places = [components[0]; Self::MAX_COMPONENTS];
        places[..count].copy_from_slice(components);
        Ok(Galaxy {
            components: places,
            count,
        })
    }

    /// A star of this flux.
    ///
    /// # Errors
    /// If the flux is not a number of zero or more.
    pub fn point(flux: f64) -> Result<Self, GalaxyError> {
        Galaxy::new(&[Component {
            profile: Sersic::Gaussian,
            // A point to 1e-6 of the light at the largest wavenumber.
            half_light_radius: 1e-4,
            flux,
            dx: 0.0,
            dy: 0.0,
            shape: Shear::ZERO,
        }])
    }

    /// A de Vaucouleurs bulge and an exponential disc with one centre and one ellipticity.
    ///
    /// The bulge holds `bulge_fraction` of `flux`; a share of 0 or 1 leaves out the other
    /// component. Radii are circularised half-light radii in pixels.
    pub fn bulge_and_disc(
        flux: f64,
        bulge_fraction: f64,
        bulge_radius: f64,
        disc_radius: f64,
        shape: Shear,
    ) -> Result<Self, GalaxyError> {
        if !(0.0..=1.0).contains(&bulge_fraction) {
            return Err(GalaxyError::BulgeFraction(bulge_fraction));
        }
        let component = |profile, half_light_radius, share| Component {
            profile,
            half_light_radius,
            flux: flux * share,
            dx: 0.0,
            dy: 0.0,
            shape,
        };
        let bulge = component(Sersic::DeVaucouleurs, bulge_radius, bulge_fraction);
        let disc = component(Sersic::Exponential, disc_radius, 1.0 - bulge_fraction);
        if bulge_fraction == 0.0 {
            Galaxy::new(&[disc])
        } else if bulge_fraction == 1.0 {
            Galaxy::new(&[bulge])
        } else {
            Galaxy::new(&[bulge, disc])
        }
    }

    pub fn with_bulge_offset(mut self, dx: f64, dy: f64) -> Result<Self, GalaxyError> {
        for component in &mut self.components[..self.count] {
            if component.profile == Sersic::DeVaucouleurs {
                component.dx += dx;
                component.dy += dy;
            }
            component.check()?;
        }
        Ok(self)
    }

    /// The galaxy turned about the origin by an angle from +x to +y.
    pub fn turned(mut self, radians: f64) -> Self {
        let (sin, cos) = radians.sin_cos();
        let (sin_2, cos_2) = (2.0 * radians).sin_cos();
        for own in &mut self.components[..self.count] {
            let (dx, dy) = (own.dx, own.dy);
            (own.dx, own.dy) = (cos * dx - sin * dy, sin * dx + cos * dy);
            let Shear { e1, e2 } = own.shape;
            own.shape = Shear::new(cos_2 * e1 - sin_2 * e2, sin_2 * e1 + cos_2 * e2);
        }
        self
    }

    pub fn components(&self) -> &[Component] {
        &self.components[..self.count]
    }

    pub fn flux(&self) -> f64 {
        self.components().iter().map(|c| c.flux).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use puruspe::bessel::Jn;
    use shearq_quantities::radial::gauss_legendre;

    fn table(k: f64) -> f64 {
        Sersic::DeVaucouleurs.fourier(k * k)
    }

    fn de_vaucouleurs_centre() -> f64 {
        Law::new(8).centre
    }

    /// The Hankel integral of index n along the real axis, r = tⁿ, panels short against the oscillation.
    fn by_real_axis(twice: i32, k: f64) -> f64 {
        let (law, rule) = (Law::new(twice as u8), gauss_legendre(12));
        let n = 0.5 * f64::from(twice);
        let (mut sum, mut t) = (0.0, 0.0);
        while t < 60.0 / law.b {
            let rate = k * n * f64::powf(t + 0.02, n - 1.0);
            let width = f64::min(0.05, 3.0 / rate.max(1e-9));
            for &(x, w) in &rule {
                let t = t + 0.5 * width * (1.0 + x);
                let light = t.powi(twice - 1) * (-law.b * t).exp();
                sum += 0.5 * width * w * light * Jn(0, k * t.powf(n));
            }
            t += width;
        }
        2.0 * PI * n * law.centre * sum
    }

    #[test]
    fn transforms_of_all_indices_agree_with_the_real_axis() {
        for twice in 1..=TABLES as i32 {
            let profile = Sersic::nearest(0.5 * f64::from(twice));
            for k in [1e-3, 0.01, 0.1, 0.5, 1.0, 2.0, 5.0] {
                let (found, slow) = (profile.fourier(k * k), by_real_axis(twice, k));
                assert!((found - slow).abs() < 2e-6, "{twice} {k}: {found} {slow}");
            }
            // ∫₀¹ 2πr I dr with r = t⁶.
            let half = composite_rule(0.0, 1.0, 16, 12).into_iter().map(|(t, w)| {
                let r = t.powi(6);
                w * 6.0 * t.powi(5) * 2.0 * PI * r * profile.brightness(r)
            });
            let half: f64 = half.sum();
            assert!((half - 0.5).abs() < 1e-7, "{twice}: {half}");
        }
    }

    /// exp(−b r^{1/4}) expanded in powers of r^{1/4} and transformed term by term: converges for
    /// every k, and cancels little where k is large.
    fn by_power_series(k: f64) -> f64 {
        let mut sum = 0.0;
        let mut coefficient = 1.0;
        for n in 1..100 {
            coefficient *= -DE_VAUCOULEURS_B / f64::from(n);
            let s = 0.25 * f64::from(n);
            let g = gamma(1.0 + 0.5 * s);
            sum -= coefficient * g * g * (0.5 * PI * s).sin() / PI * (2.0 / k).powf(s);
        }
        2.0 * PI * de_vaucouleurs_centre() * sum * 2.0 / (k * k)
    }

    #[test]
    fn de_vaucouleurs_transform_agrees_with_its_series() {
        for k in [2.0, 5.0, 12.0, 30.0, 100.0, 1000.0] {
            let (found, slow) = (table(k), by_power_series(k));
            assert!((found / slow - 1.0).abs() < 1e-6, "k = {k}: {found} {slow}");
        }
    }

    #[test]
    fn de_vaucouleurs_table_is_faithful_between_its_nodes() {
        let rule = composite_rule(0.0, 1.0, 40, 20);
        for i in 0..400 {
            let k = 1e-4 * (0.04 * f64::from(i)).exp();
            let exact = Law::new(8).fourier(&rule, k);
            assert!((table(k) - exact).abs() < 2e-7 * exact.max(1e-3), "k = {k}");
        }
    }

    #[test]
    fn transforms_start_at_one_and_follow_the_second_moment() {
        assert_eq!(table(0.0), 1.0);
        assert_eq!(Sersic::Exponential.fourier(0.0), 1.0);
        // <r²> = Γ(16)/(Γ(8) b⁸) r_e²; 1 − F = k² <r²> / 4.
        let r2 = gamma(16.0) / gamma(8.0) / DE_VAUCOULEURS_B.powi(8);
        let k = 2e-3;
        assert!(((1.0 - table(k)) / (0.25 * r2 * k * k) - 1.0).abs() < 1e-3);
        // Far out the cusp rules: only the first term of the power series is left, ∝ k^(−9/4).
        let k: f64 = 1e12;
        let g = gamma(1.125);
        let cusp = 4.0
            * de_vaucouleurs_centre()
            * DE_VAUCOULEURS_B
            * g
            * g
            * (PI / 8.0).sin()
            * (2.0 / k).powf(0.25)
            / (k * k);
        let exact = Law::new(8).fourier(&composite_rule(0.0, 1.0, 16, 16), k);
        assert!((exact / cusp - 1.0).abs() < 0.02, "{exact} {cusp}");
    }

    #[test]
    fn half_of_the_light_lies_within_the_half_light_radius() {
        // Of ∫ x^(n−1) e^(−x) dx, e^(−b) Σ bⁱ/i! over i < n lies above b.
        let above = |n: u32, b: f64| {
            let (mut sum, mut term) = (0.0, (-b).exp());
            for i in 1..=n {
                sum += term;
                term *= b / f64::from(i);
            }
            sum
        };
        assert!((above(8, DE_VAUCOULEURS_B) - 0.5).abs() < 1e-14);
        assert!((above(2, EXPONENTIAL_HALF_LIGHT) - 0.5).abs() < 1e-14);
    }

    #[test]
    fn galaxies_turn_from_x_to_y() {
        let galaxy = Galaxy::bulge_and_disc(1.0, 0.5, 1.0, 2.0, Shear::new(0.3, 0.0)).unwrap();
        let galaxy = galaxy.with_bulge_offset(2.0, 0.0).unwrap();
        let turned = galaxy.turned(std::f64::consts::FRAC_PI_4);
        let [bulge, disc] = turned.components() else {
            panic!("{turned:?}")
        };
        for (found, expected) in [
            (bulge.dx, 2f64.sqrt()),
            (bulge.dy, 2f64.sqrt()),
            (bulge.shape.e1, 0.0),
            (disc.shape.e2, 0.3),
        ] {
            assert!((found - expected).abs() < 1e-12, "{turned:?}");
        }
    }

    #[test]
    fn impossible_galaxies_are_refused() {
        let make = |flux, share, re| Galaxy::bulge_and_disc(flux, share, re, 4.8, Shear::ZERO);
        assert_eq!(make(1.0, 0.5, 0.0), Err(GalaxyError::Radius(0.0)));
        assert_eq!(make(-1.0, 0.5, 2.0), Err(GalaxyError::Flux(-0.5)));
        assert_eq!(make(1.0, 1.5, 2.0), Err(GalaxyError::BulgeFraction(1.5)));
        assert!(matches!(
            make(1.0, f64::NAN, 2.0),
            Err(GalaxyError::BulgeFraction(_))
        ));
        assert_eq!(Galaxy::new(&[]), Err(GalaxyError::Count(0)));
        let round = make(1.0, 0.5, 2.3).unwrap();
        assert!(round.with_bulge_offset(f64::INFINITY, 0.0).is_err());
        let shape = Shear::new(0.8, 0.6);
        let result = Galaxy::bulge_and_disc(1.0, 0.5, 2.3, 4.8, shape);
        assert_eq!(result, Err(GalaxyError::Shape(shape)));
        let alone = |share| make(1.0, share, 2.3).unwrap().components().to_vec();
        let (disc, bulge) = (alone(0.0), alone(1.0));
        assert_eq!((disc.len(), bulge[0].profile), (1, Sersic::DeVaucouleurs));
        assert_eq!(round.flux(), 1.0);
    }
}
