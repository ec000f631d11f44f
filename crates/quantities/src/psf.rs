//! PSFs given by a formula: Moffat and Kolmogorov profiles, made elliptical by a shear.
//!
//! Fluxes are 1, lengths are pixels, wavenumbers radians per pixel. A transform is
//! F(k) = ∫ I(x) e^{−ik·x} d²x, real and even for these profiles.
//!
//! # Pixels
//!
//! Near the centre, each pixel is integrated by a Gauss–Legendre rule whose length follows from the profile's sharpness
//! there. Pixels with the same rule are integrated side by side. Farther out the profile is so smooth that its values in the
//! middles of a pixel and its neighbours give the light in the pixel ([`SMOOTH_WEIGHTS`]).

use std::f64::consts::{LN_2, PI};
use std::sync::LazyLock;

use multiversion::multiversion;
use ndarray::{Array2, ArrayViewMut2};
use puruspe::bessel::Jn;
use puruspe::gamma::{gamma, ln_gamma};
use thiserror::Error;

use crate::Shear;
use crate::radial::{QuadraticForm, RadialTable, composite_rule, gauss_legendre};

// λ/r0 in units of the FWHM, times k0·r0/λ: the wavenumber scale k0 of a Kolmogorov profile in radians per FWHM. Both
// factors are from GalSim's `Kolmogorov`.
const KOLMOGOROV_K0: f64 = 2.992934 * 0.975_863_429_9;

/// Kolmogorov surface brightness of unit flux against (r/FWHM)², per FWHM².
static KOLMOGOROV: LazyLock<RadialTable> = LazyLock::new(|| {
    // k = t³ makes the integrand of the Hankel transform smooth at k = 0.
    let rule = composite_rule(0.0, 2.16, 64, 16)
        .into_iter()
        .map(|(t, w)| (t.powi(3), w * 3.0 * t.powi(5) * (-t.powi(5)).exp()))
        .collect::<Vec<_>>();
    RadialTable::new(0.05, |u| {
        KOLMOGOROV_K0.powi(2) * kolmogorov_brightness(&rule, KOLMOGOROV_K0 * u.sqrt())
    })
});

/// What can be wrong with the parameters of a PSF.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum ProfileError {
    /// The width is zero, negative or not a number.
    #[error("the PSF's FWHM must be a positive number of pixels, not {0}")]
    Fwhm(f64),
    /// At β ≤ 1 a Moffat profile has infinite flux.
    #[error("the Moffat exponent beta must be a number above 1, not {0}")]
    Beta(f64),
    /// An ellipticity of modulus 1 or more is not an ellipse.
    #[error("the PSF's ellipticity ({}, {}) must have a modulus below 1", .0.e1, .0.e2)]
    Ellipticity(Shear),
    /// The transform was tabulated for another profile.
    #[error("this transform is for {expected}, the PSF is {found}: make one for its profile")]
    Profile {
        /// The profile that was tabulated.
        expected: String,
        /// The profile of the PSF.
        found: String,
    },
}

/// The radial form of a round PSF.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PsfProfile {
    /// I ∝ (1 + (r/r_d)²)^(−β), not truncated (Moffat 1969).
    Moffat {
        /// Steepness of the wings, above 1.
        beta: f64,
    },
    /// Long exposure through Kolmogorov turbulence: F(k) = exp(−(k/k0)^(5/3)) (Fried 1966).
    Kolmogorov,
}

impl PsfProfile {
    fn check(self) -> Result<(), ProfileError> {
        match self {
            PsfProfile::Moffat { beta } if !(beta.is_finite() && beta > 1.0) => {
                Err(ProfileError::Beta(beta))
            }
            _ => Ok(()),
        }
    }

    /// The transform of the round profile of flux 1 against k·FWHM.
    ///
    /// Moffat: 2/Γ(β−1) · (k·r_d/2)^(β−1) · K_{β−1}(k·r_d).
    pub fn fourier(self, k_fwhm: f64) -> f64 {
        match self {
            PsfProfile::Moffat { beta } => moffat_fourier(beta, k_fwhm * moffat_scale(beta)),
            PsfProfile::Kolmogorov => (-(k_fwhm / KOLMOGOROV_K0).abs().powf(5.0 / 3.0)).exp(),
        }
    }
}

/// A PSF by its formula: a round profile of flux 1 under an area-preserving shear.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FunctionalPsf {
    /// Radial form.
    pub profile: PsfProfile,
    /// Full width at half maximum of the profile before it is sheared, in pixels.
    pub fwhm: f64,
    /// The shear that makes it elliptical, by [`Shear::matrix`].
    pub shape: Shear,
}

impl FunctionalPsf {
    /// # Errors
    /// When `fwhm` is not a positive number, a Moffat β not above 1, or |`shape`| not below 1.
    pub fn new(profile: PsfProfile, fwhm: f64, shape: Shear) -> Result<Self, ProfileError> {
        profile.check()?;
        check_size_and_shape(fwhm, shape)?;
        Ok(FunctionalPsf {
            profile,
            fwhm,
            shape,
        })
    }

    /// Surface brightness per px² at (`dx`, `dy`) pixels from the centre, before the pixels.
    pub fn value(&self, dx: f64, dy: f64) -> f64 {
        self.round_value(QuadraticForm::of_positions(self.shape).at(dx, dy).sqrt())
    }

    /// Surface brightness per px² of the round profile at `radius` pixels.
    pub fn round_value(&self, radius: f64) -> f64 {
        match self.brightness() {
            Brightness::Moffat(moffat) => moffat.at(radius * radius),
            Brightness::Kolmogorov(kolmogorov) => kolmogorov.at(radius * radius),
        }
    }

    /// The transform at (`kx`, `ky`) radians per pixel, before the pixels; 1 at the origin.
    pub fn fourier(&self, kx: f64, ky: f64) -> f64 {
        let k2 = QuadraticForm::of_wavenumbers(self.shape).at(kx, ky);
        self.profile.fourier(k2.sqrt() * self.fwhm)
    }

    /// Fills `out` (rows are y, columns x) with the light that falls into each pixel, for a PSF
    /// centred at (`centre_x`, `centre_y`), 0-based pixel-centre coordinates.
    ///
    /// The centre of a 48 × 48 stamp is (23.5, 23.5). Nothing is
    /// renormalised: the sum falls short of 1 by the light outside. Pixels near the centre are
    /// integrated in real space by a Gauss–Legendre rule as long as the profile's sharpness there
    /// asks for. The light of the others follows from the profile in the middles of pixels. Errors
    /// are below 1e-6 of the brightest pixel (tested for FWHM of 0.3 px and more).
    pub fn draw_into(&self, centre_x: f64, centre_y: f64, out: ArrayViewMut2<f64>) {
        let centre = (centre_x, centre_y);
        match self.brightness() {
            Brightness::Moffat(profile) => self.pixels(profile).integrate(centre, out),
            Brightness::Kolmogorov(profile) => self.pixels(profile).integrate(centre, out),
        }
    }

    /// The PSF on a stamp of `size` pixels a side, centred on the pixel (odd side) or corner (even side) in
    /// the middle, normalised to a sum of one.
    pub fn stamp(&self, size: usize) -> Array2<f64> {
        self.stamp_beside(size, size)
    }

    /// The `size` × `size` central pixels of a star like this on a stamp of `side` × `side` pixels, normalised to a
    /// sum of one.
    ///
    /// If `side` is the side of the galaxies' stamps, galaxy and PSF are equally far off the centre of their cuts: half a pixel if one
    /// side is even and the other odd. That is where a star on a stamp of that side would be.
    pub fn stamp_beside(&self, size: usize, side: usize) -> Array2<f64> {
        let mut stamp = Array2::zeros((size, size));
        self.stamp_into(side, stamp.view_mut());
        stamp
    }

    /// The same, drawn over a square stamp.
    pub fn stamp_into(&self, side: usize, mut stamp: ArrayViewMut2<f64>) {
        let size = stamp.nrows();
        let off = if side % 2 == size % 2 { 0.0 } else { 0.5 };
        let centre = (size as f64 - 1.0) / 2.0 + off;
        self.draw_into(centre, centre, stamp.view_mut());
        stamp *= 1.0 / stamp.sum();
    }

    fn pixels<P: RoundProfile>(&self, profile: P) -> Pixels<P> {
        Pixels {
            form: QuadraticForm::of_positions(self.shape),
            modulus: self.shape.modulus(),
            core: self.fwhm * profile.core_in_fwhm(),
            profile,
        }
    }

    fn brightness(&self) -> Brightness {
        match self.profile {
            PsfProfile::Moffat { beta } => {
                let scale = self.fwhm * moffat_scale(beta);
                Brightness::Moffat(MoffatBrightness {
                    per_scale2: 1.0 / (scale * scale),
                    centre: (beta - 1.0) / (PI * scale * scale),
                    beta,
                    whole: (beta.fract() == 0.0 && beta <= 16.0).then_some(beta as u32),
                })
            }
            PsfProfile::Kolmogorov => Brightness::Kolmogorov(KolmogorovBrightness {
                table: &KOLMOGOROV,
                per_fwhm2: 1.0 / (self.fwhm * self.fwhm),
            }),
        }
    }
}

fn check_size_and_shape(fwhm: f64, shape: Shear) -> Result<(), ProfileError> {
    if !(fwhm.is_finite() && fwhm > 0.0) {
        return Err(ProfileError::Fwhm(fwhm));
    }
    if shape.modulus().is_nan() || shape.modulus() >= 1.0 {
        return Err(ProfileError::Ellipticity(shape));
    }
    Ok(())
}

/// Surface brightness of flux 1 against the squared circular radius in px².
trait RoundProfile {
    fn at(&self, radius2: f64) -> f64;
    /// Replaces squared radii by the brightness there.
    fn at_each(&self, radii2: &mut [f64]);
    /// Distance of the nearest complex singularity from the centre (or what acts as one), in FWHM.
    fn core_in_fwhm(&self) -> f64;
}

enum Brightness {
    Moffat(MoffatBrightness),
    Kolmogorov(KolmogorovBrightness),
}

struct MoffatBrightness {
    per_scale2: f64,
    centre: f64,
    beta: f64,
    /// β if it is a small whole number: products are faster than a power.
    whole: Option<u32>,
}

impl RoundProfile for MoffatBrightness {
    #[inline]
    fn at(&self, radius2: f64) -> f64 {
        let base = 1.0 + radius2 * self.per_scale2;
        match self.whole {
            Some(3) => self.centre / (base * base * base),
            Some(beta) => self.centre / base.powi(beta as i32),
            None => self.centre * base.powf(-self.beta),
        }
    }

    #[inline(always)]
    fn at_each(&self, radii2: &mut [f64]) {
        if self.whole == Some(3) {
            // The exponent of the simulated sets, without a decision for each value.
            for value in radii2 {
                let base = 1.0 + *value * self.per_scale2;
                *value = self.centre / (base * base * base);
            }
        } else {
            for value in radii2 {
                *value = self.at(*value);
            }
        }
    }

    fn core_in_fwhm(&self) -> f64 {
        // With β the singularity recedes, but the power of the growth towards it rises: the limit is a Gaussian, which
        // half a FWHM describes.
        moffat_scale(self.beta).min(1.0)
    }
}

struct KolmogorovBrightness {
    table: &'static RadialTable,
    per_fwhm2: f64,
}

impl RoundProfile for KolmogorovBrightness {
    #[inline]
    fn at(&self, radius2: f64) -> f64 {
        self.per_fwhm2 * self.table.at(radius2 * self.per_fwhm2)
    }

    #[inline(always)]
    fn at_each(&self, radii2: &mut [f64]) {
        for value in radii2 {
            *value = self.at(*value);
        }
    }

    fn core_in_fwhm(&self) -> f64 {
        0.6
    }
}

/// r_d/FWHM of a Moffat profile: 1 / (2 sqrt(2^{1/β} − 1)).
fn moffat_scale(beta: f64) -> f64 {
    0.5 / (LN_2 / beta).exp_m1().sqrt()
}

/// 2/Γ(ν) · (x/2)^ν · K_ν(x) with ν = β − 1.
///
/// Evaluated as the mean of e^{−x²/4t} over a gamma distribution of t, which is the same integral
/// and neither overflows nor cancels for any β; in ln t the trapezoidal rule converges
/// exponentially.
fn moffat_fourier(beta: f64, x: f64) -> f64 {
    let (nu, quarter) = (beta - 1.0, 0.25 * x * x);
    if quarter == 0.0 {
        return 1.0;
    }
    let curvature = nu.hypot(x);
    let top = (0.5 * (nu + curvature)).ln();
    let step = f64::min(0.25, 0.6 / curvature.sqrt());
    let log_norm = ln_gamma(nu);
    let term = |s: f64| {
        let t = s.exp();
        (nu * s - t - quarter / t - log_norm).exp()
    };
    let peak = term(top);
    let mut sum = peak;
    for direction in [-1.0, 1.0] {
        for i in 1..100_000 {
            let now = term(top + direction * step * f64::from(i));
            sum += now;
            // Where all terms have underflowed the transform is 0 to any precision.
            if now <= 1e-17 * peak {
                break;
            }
        }
    }
    sum * step
}

/// Kolmogorov surface brightness at `s` = k0·r, in units of k0², of flux 1.
///
/// `rule` holds wavenumbers in k0 and the weights of ∫ k e^{−k^{5/3}} … dk. Far out the
/// oscillating integral loses to the transform's expansion in powers of k^{5/3}, whose terms
/// transform one by one: the first gives the wings ∝ r^(−11/3).
fn kolmogorov_brightness(rule: &[(f64, f64)], s: f64) -> f64 {
    if s < 30.0 {
        let sum: f64 = rule.iter().map(|&(k, w)| w * Jn(0, k * s)).sum();
        return sum / (2.0 * PI);
    }
    let mut sum = 0.0;
    let mut factorial = 1.0;
    for n in 1..=7 {
        let power = 5.0 / 3.0 * f64::from(n);
        factorial *= f64::from(-n);
        let g = gamma(1.0 + 0.5 * power);
        sum -= g * g * (0.5 * PI * power).sin() / (PI * factorial)
            * 2f64.powf(power + 1.0)
            * s.powf(-power - 2.0);
    }
    sum / (2.0 * PI)
}

/// The circular aperture of a telescope with a circular obscuration in its middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pupil {
    /// Wavelength over diameter, in units of the FWHM of the profile that it blurs.
    pub lambda_over_diameter: f64,
    /// Ratio of the diameters of obscuration and aperture, 0 or more and below 1.
    pub obscuration: f64,
}

impl Pupil {
    /// The transform of its diffraction pattern of flux 1 against k·FWHM: the area that two apertures share, over the area of one
    /// (O'Neill 1956, J. Opt. Soc. Am. 46, 285). Zero beyond 2π/(λ/D).
    pub fn fourier(self, k_fwhm: f64) -> f64 {
        let shift = k_fwhm.abs() * self.lambda_over_diameter / PI;
        let inner = self.obscuration;
        let shared = shared_area(1.0, 1.0, shift) + shared_area(inner, inner, shift)
            - 2.0 * shared_area(1.0, inner, shift);
        (shared / (PI * (1.0 - inner * inner))).max(0.0)
    }

    // The brightest rings at `radius` FWHM, per FWHM². Amplitudes of both edges add up where they are in phase; that of the
    // inner one is √ε of the outer one.
    fn rings(self, radius: f64) -> f64 {
        let e = self.obscuration;
        let in_phase = (1.0 + e.sqrt()).powi(2) / (1.0 - e * e);
        2.0 / PI.powi(3) * self.lambda_over_diameter * in_phase / radius.powi(3)
    }

    // The square of the radius in FWHM of a disc with the flux and the central brightness of the pattern, π/4 (1 − ε²) (D/λ)².
    fn disc2(self) -> f64 {
        4.0 / (PI * PI) * self.lambda_over_diameter.powi(2) / (1.0 - self.obscuration.powi(2))
    }
}

/// The area that discs of radii `a` ≥ `b` share whose centres are `d` apart.
fn shared_area(a: f64, b: f64, d: f64) -> f64 {
    if d >= a + b {
        return 0.0;
    }
    if d <= a - b {
        return PI * b * b;
    }
    let (a2, b2, d2) = (a * a, b * b, d * d);
    let kite = ((a + b - d) * (d + b - a) * (d + a - b) * (a + b + d)).sqrt();
    b2 * ((d2 + b2 - a2) / (2.0 * d * b)).acos() + a2 * ((d2 + a2 - b2) / (2.0 * d * a)).acos()
        - 0.5 * kite
}

/// The transform of one round profile, tabulated against (k·FWHM)²; make one for each profile and
/// use it for PSFs of every width and shape.
#[derive(Debug, Clone)]
pub struct PsfTransform {
    profile: PsfProfile,
    pupil: Option<Pupil>,
    table: RadialTable,
}

impl PsfTransform {
    /// Tabulates the transform of `profile`, in some milliseconds. For β ≥ 1.5
    /// and k·FWHM above 2e-3 table errors are below 1e-6; the value at 0 is exact.
    ///
    /// # Errors
    /// When a Moffat β is not above 1.
    pub fn new(profile: PsfProfile) -> Result<Self, ProfileError> {
        Self::through(profile, None)
    }

    /// Tabulates the transform of `profile` convolved with the diffraction pattern of `pupil`. The FWHM of a PSF remains
    /// the FWHM of the profile alone.
    ///
    /// # Errors
    /// As [`PsfTransform::new`].
    pub fn behind(profile: PsfProfile, pupil: Pupil) -> Result<Self, ProfileError> {
        Self::through(profile, Some(pupil))
    }

    fn through(profile: PsfProfile, pupil: Option<Pupil>) -> Result<Self, ProfileError> {
        profile.check()?;
        // Neither transform is smooth at k = 0 (k^{5/3}, and |k|^{2β−2}): a small unit confines
        // that to wavenumbers that no stamp resolves.
        let table = RadialTable::new(1e-6, |u| {
            let k = u.sqrt();
            profile.fourier(k) * pupil.map_or(1.0, |pupil| pupil.fourier(k))
        });
        Ok(PsfTransform {
            profile,
            pupil,
            table,
        })
    }

    /// The transform at the square of k·FWHM.
    pub fn at(&self, k_fwhm2: f64) -> f64 {
        self.table.at(k_fwhm2)
    }

    /// A PSF of this profile with `psf`'s width and shape, ready for rendering.
    ///
    /// # Errors
    /// When `psf` has another profile, or was assembled with values that
    /// [`FunctionalPsf::new`] refuses.
    pub fn of(&self, psf: &FunctionalPsf) -> Result<TransformedPsf<'_>, ProfileError> {
        if psf.profile != self.profile {
            return Err(ProfileError::Profile {
                expected: format!("{:?}", self.profile),
                found: format!("{:?}", psf.profile),
            });
        }
        check_size_and_shape(psf.fwhm, psf.shape)?;
        Ok(TransformedPsf {
            transform: self,
            fwhm: psf.fwhm,
            shape: psf.shape,
        })
    }

    /// The table itself.
    pub fn table(&self) -> &RadialTable {
        &self.table
    }
}

/// A functional PSF whose transform is looked up rather than computed.
#[derive(Debug, Clone, Copy)]
pub struct TransformedPsf<'a> {
    /// The transform of its profile.
    pub transform: &'a PsfTransform,
    /// As [`FunctionalPsf::fwhm`].
    pub fwhm: f64,
    /// As [`FunctionalPsf::shape`].
    pub shape: Shear,
}

impl TransformedPsf<'_> {
    /// The PSF by its formula, without the pupil.
    pub fn functional(&self) -> FunctionalPsf {
        FunctionalPsf {
            profile: self.transform.profile,
            fwhm: self.fwhm,
            shape: self.shape,
        }
    }

    /// The pupil that its profile is convolved with.
    pub fn pupil(&self) -> Option<Pupil> {
        self.transform.pupil
    }

    /// About the largest surface brightness per px² of the round PSF at `radius` pixels, far from its centre.
    pub fn wings(&self, radius: f64) -> f64 {
        let rings = |pupil: Pupil| pupil.rings(radius / self.fwhm) / (self.fwhm * self.fwhm);
        self.functional().round_value(radius) + self.pupil().map_or(0.0, rings)
    }

    /// The radius in pixels of a disc about as bright as its core, rather too small than too large.
    pub fn core(&self) -> f64 {
        let disc2 = self.pupil().map_or(0.0, Pupil::disc2);
        self.fwhm * (0.36 + disc2).sqrt()
    }
}

// Error of a pixel integral, relative to the brightest pixel. Its estimate is coarse, so that it is below the 1e-6 of
// `FunctionalPsf::draw_into`.
const PIXEL_TOLERANCE: f64 = 1e-7;

// Nodes of a Gauss–Legendre rule; sharper profiles divide the pixel instead.
const MAX_NODES: usize = 12;
// Parts of a pixel along an axis, by halving.
const MAX_DIVISIONS: usize = 64;
// The numbers of nodes times those of divisions.
const MAX_RULES: usize = MAX_NODES * (MAX_DIVISIONS.ilog2() as usize + 1);

// Weights of the values in the middles of a pixel and of its first to third neighbours along an axis: the integral over the
// pixel, Σ f⁽²ᵏ⁾/(4ᵏ (2k + 1)!), up to the sixth derivative by central differences.
const SMOOTH_WEIGHTS: [f64; NEIGHBOURS + 1] = [
    862_564.0 / 967_680.0,
    57_249.0 / 967_680.0,
    -5_058.0 / 967_680.0,
    367.0 / 967_680.0,
];
const NEIGHBOURS: usize = 3;
// Modulus of the factor of the eighth derivative in the integral, which the weights lack: (387/160 − 1/2304)/8!.
const EIGHTH_FACTOR: f64 = 6.0e-5;

// In pixels, in the circular coordinates in which pixels are widest: values in the middles would miss narrower cores.
const MIN_SMOOTH_CORE: f64 = 1.5;

// Pixels whose rules are chosen side by side: two vectors of AVX-512.
const LANES: usize = 16;
// Pixels that are integrated side by side.
const BATCH: usize = 48;

// Of the radius between two rules, in pixels; up to it the longer rule is used.
const BOUND_ERROR: f64 = 1.0 / 32.0;

static NODES: LazyLock<Vec<Vec<(f64, f64)>>> =
    LazyLock::new(|| (0..=MAX_NODES).map(gauss_legendre).collect());

/// A profile on pixels.
struct Pixels<P> {
    pub profile: P,
    pub form: QuadraticForm,
    /// Modulus of the shear that made the profile elliptical.
    pub modulus: f64,
    /// Distance in pixels within which the profile is not smooth.
    pub core: f64,
}

/// Gauss–Legendre nodes on each axis of the parts of a pixel, and parts on each axis.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Rule {
    divisions: usize,
    nodes: usize,
}

/// Rules from the centre outwards, and the squared circular radius up to which each is used.
struct Rules {
    count: usize,
    bounds: [f64; MAX_RULES],
    rules: [Rule; MAX_RULES],
    /// The circular radius beyond which values in the middles of pixels suffice.
    smooth_from: f64,
}

/// Pixels that wait for others with the same rule.
#[derive(Clone, Copy)]
struct Waiting {
    count: usize,
    /// Places in the stamp, and distances from the centre.
    at: [u32; BATCH],
    dx: [f64; BATCH],
    dy: [f64; BATCH],
}

impl Default for Waiting {
    fn default() -> Self {
        Waiting {
            count: 0,
            at: [0; BATCH],
            dx: [0.0; BATCH],
            dy: [0.0; BATCH],
        }
    }
}

impl Waiting {
    /// Adds pixels side by side, from the one at `at` in the stamp on.
    fn push(&mut self, at: usize, dx: &[f64], dy: &[f64]) {
        let from = self.count;
        self.count += dx.len();
        self.dx[from..self.count].copy_from_slice(dx);
        self.dy[from..self.count].copy_from_slice(dy);
        for (place, at) in self.at[from..self.count].iter_mut().zip(at as u32..) {
            *place = at;
        }
    }
}

impl<P: RoundProfile> Pixels<P> {
    /// Fills `out` (rows are y) with the light in each pixel, the profile's centre being at `centre` (x, y).
    fn integrate(&self, centre: (f64, f64), mut out: ArrayViewMut2<f64>) {
        let (rows, columns) = out.dim();
        match out.as_slice_mut() {
            Some(pixels) => self.integrate_rows(centre, (rows, columns), pixels),
            None => {
                let mut pixels = Array2::zeros((rows, columns));
                let lines = pixels.as_slice_mut().expect("an array is made in rows");
                self.integrate_rows(centre, (rows, columns), lines);
                out.assign(&pixels);
            }
        }
    }

    /// The same for pixels one row after the other.
    fn integrate_rows(&self, centre: (f64, f64), size: (usize, usize), pixels: &mut [f64]) {
        if pixels.is_empty() {
            return;
        }
        // About the centre of the stamp the profile is the same on opposite sides: half of the pixels are copied.
        let middle = |at: f64, side: usize| 2.0 * at == side as f64 - 1.0;
        let halved = middle(centre.0, size.1) && middle(centre.1, size.0);
        let count = if halved { size.0.div_ceil(2) } else { size.0 };
        let rules = self.rules(centre, size);
        if rules.smooth_from.is_finite() {
            self.fill_smooth(centre, (count, size.1), pixels);
        }
        // The widest that the ellipse of a circular radius is.
        let reach = rules.smooth_from * 2.0 * half_pixel(self.modulus);
        let mut waiting = vec![Waiting::default(); rules.count];
        for row in 0..count {
            let dy = [row as f64 - centre.1; LANES];
            if dy[0].abs() > reach {
                continue;
            }
            for first in (0..size.1).step_by(LANES) {
                let dx: [f64; LANES] = std::array::from_fn(|lane| (first + lane) as f64 - centre.0);
                if dx[0] > reach || dx[LANES - 1] < -reach {
                    continue;
                }
                let chosen = choose_lanes(self.form, rules.bounds(), &dx, &dy);
                let inside = LANES.min(size.1 - first);
                let mut lane = 0;
                while lane < inside {
                    // Neighbours with the same rule.
                    let rule = chosen[lane];
                    let same = chosen[lane..].iter().take_while(|other| **other == rule);
                    let lanes = lane..inside.min(lane + same.count());
                    lane = lanes.end;
                    if rule as usize == rules.count {
                        continue;
                    }
                    let waiting = &mut waiting[rule as usize];
                    waiting.push(
                        row * size.1 + first + lanes.start,
                        &dx[lanes.clone()],
                        &dy[lanes],
                    );
                    if waiting.count > BATCH - LANES {
                        self.integrate_waiting(waiting, rules.rules[rule as usize], pixels);
                    }
                }
            }
        }
        for (waiting, rule) in waiting.iter_mut().zip(rules.rules) {
            self.integrate_waiting(waiting, rule, pixels);
        }
        if halved {
            let (first, rest) = pixels.split_at_mut(pixels.len() / 2);
            for (pixel, opposite) in rest.iter_mut().rev().zip(&*first) {
                *pixel = *opposite;
            }
        }
    }

    /// Fills rows of pixels as if the profile were smooth in all of them.
    fn fill_smooth(&self, centre: (f64, f64), (rows, columns): (usize, usize), pixels: &mut [f64]) {
        let width = columns + 2 * NEIGHBOURS;
        let mut values = vec![0.0; (rows + 2 * NEIGHBOURS) * width];
        let mut y = -(NEIGHBOURS as f64) - centre.1;
        for line in values.chunks_exact_mut(width) {
            values_along(self, -(NEIGHBOURS as f64) - centre.0, y, line);
            y += 1.0;
        }
        let mut line = vec![0.0; width];
        for (row, out) in pixels.chunks_exact_mut(columns).enumerate().take(rows) {
            smooth(&values[row * width..], &mut line, out);
        }
    }

    fn integrate_waiting(&self, waiting: &mut Waiting, rule: Rule, pixels: &mut [f64]) {
        // Whole vectors: the places beyond hold finite numbers of earlier pixels, which are not used.
        let count = waiting.count.next_multiple_of(8);
        let mut light = [0.0; BATCH];
        integrals(
            self,
            rule,
            (&waiting.dx[..count], &waiting.dy[..count]),
            &mut light[..count],
        );
        for (at, light) in waiting.at.iter().zip(light).take(waiting.count) {
            pixels[*at as usize] = light;
        }
        waiting.count = 0;
    }

    fn rules(&self, centre: (f64, f64), (rows, columns): (usize, usize)) -> Rules {
        let plan = RulePlan {
            half_pixel: half_pixel(self.modulus),
            core: self.core,
            // The brightest pixel of a PSF narrower than a pixel holds a flux near 1.
            peak: self.profile.at(0.0).min(1.0),
        };
        let corners = [0.0, columns as f64].map(|x| {
            let squared = [0.0, rows as f64].map(|y| self.form.at(x - centre.0, y - centre.1));
            squared[0].max(squared[1])
        });
        let farthest = corners[0].max(corners[1]).sqrt();
        let smooth_from = plan.smooth_from(&self.profile, farthest);
        let outermost = farthest.min(smooth_from);
        let first = plan.choose(&self.profile, 0.0);
        let last = plan.choose(&self.profile, outermost);
        let mut rules = Rules {
            count: 0,
            bounds: [0.0; MAX_RULES],
            rules: [last; MAX_RULES],
            smooth_from,
        };
        self.divide(&plan, (0.0, first), (outermost, last), &mut rules);
        rules.add(smooth_from * smooth_from, last);
        rules
    }

    /// Adds the rules of radii between two, by bisection: rules become shorter outwards.
    fn divide(&self, plan: &RulePlan, inner: (f64, Rule), outer: (f64, Rule), rules: &mut Rules) {
        if inner.1 == outer.1 {
            return;
        }
        if outer.0 - inner.0 < BOUND_ERROR {
            rules.add(outer.0 * outer.0, inner.1);
            return;
        }
        let radius = 0.5 * (inner.0 + outer.0);
        let middle = (radius, plan.choose(&self.profile, radius));
        self.divide(plan, inner, middle, rules);
        self.divide(plan, middle, outer, rules);
    }
}

impl Rules {
    fn add(&mut self, bound: f64, rule: Rule) {
        self.bounds[self.count] = bound;
        self.rules[self.count] = rule;
        self.count += 1;
    }

    fn bounds(&self) -> &[f64] {
        &self.bounds[..self.count]
    }
}

/// Half a pixel, in the circular coordinates in which it is widest.
fn half_pixel(modulus: f64) -> f64 {
    0.5 * ((1.0 + modulus) / (1.0 - modulus)).sqrt()
}

/// The profile at (x, y) from the centre and at the next pixels along x.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn values_along<P: RoundProfile>(pixels: &Pixels<P>, x: f64, y: f64, line: &mut [f64]) {
    let QuadraticForm { xx, xy, yy } = pixels.form;
    let (constant, linear) = (yy * y * y, 2.0 * xy * y);
    for (at, value) in line.iter_mut().enumerate() {
        let x = x + at as i32 as f64;
        *value = constant + x * (linear + xx * x);
    }
    pixels.profile.at_each(line);
}

/// The light in a row of pixels from seven rows of `values` in the middles of pixels, about this row. `line` is a buffer of
/// the length of a row of values.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn smooth(values: &[f64], line: &mut [f64], out: &mut [f64]) {
    let width = line.len();
    let [a, b, c, d, e, f, g] = std::array::from_fn(|row| &values[row * width..][..width]);
    let [w0, w1, w2, w3] = SMOOTH_WEIGHTS;
    for (x, light) in line.iter_mut().enumerate() {
        *light = w0 * d[x] + w1 * (c[x] + e[x]) + w2 * (b[x] + f[x]) + w3 * (a[x] + g[x]);
    }
    let count = out.len();
    let [a, b, c, d, e, f, g] = std::array::from_fn(|first| &line[first..][..count]);
    for (x, light) in out.iter_mut().enumerate() {
        *light = w0 * d[x] + w1 * (c[x] + e[x]) + w2 * (b[x] + f[x]) + w3 * (a[x] + g[x]);
    }
}

/// The place of the rule of pixels at (`dx`, `dy`) from the centre: the number of bounds that they exceed.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn choose_lanes(
    form: QuadraticForm,
    bounds: &[f64],
    dx: &[f64; LANES],
    dy: &[f64; LANES],
) -> [u64; LANES] {
    let mut squared = [0.0; LANES];
    for lane in 0..LANES {
        squared[lane] = form.at(dx[lane], dy[lane]);
    }
    let mut chosen = [0; LANES];
    for bound in bounds {
        for lane in 0..LANES {
            chosen[lane] += u64::from(squared[lane] > *bound);
        }
    }
    chosen
}

/// The light in pixels at (`dx`, `dy`) from the centre, at most [`BATCH`] of them.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn integrals<P: RoundProfile>(
    pixels: &Pixels<P>,
    rule: Rule,
    (dx, dy): (&[f64], &[f64]),
    light: &mut [f64],
) {
    let QuadraticForm { xx, xy, yy } = pixels.form;
    let half = 0.5 / rule.divisions as f64;
    let nodes = &NODES[rule.nodes];
    let count = light.len();
    let (mut constant, mut linear) = ([0.0; BATCH], [0.0; BATCH]);
    let (mut line, mut value) = ([0.0; BATCH], [0.0; BATCH]);
    let (constant, linear) = (&mut constant[..count], &mut linear[..count]);
    let (line, value) = (&mut line[..count], &mut value[..count]);
    light.fill(0.0);
    for part_y in 0..rule.divisions {
        let part_y = half * (2 * part_y + 1) as f64 - 0.5;
        for part_x in 0..rule.divisions {
            let part_x = half * (2 * part_x + 1) as f64 - 0.5;
            for &(node_y, weight_y) in nodes {
                let below = part_y + half * node_y;
                for ((constant, linear), dy) in constant.iter_mut().zip(&mut *linear).zip(dy) {
                    let y = dy + below;
                    *constant = yy * y * y;
                    *linear = 2.0 * xy * y;
                }
                line.fill(0.0);
                for &(node_x, weight_x) in nodes {
                    let beside = part_x + half * node_x;
                    let forms = constant.iter().zip(&*linear);
                    for ((value, dx), (constant, linear)) in value.iter_mut().zip(dx).zip(forms) {
                        let x = dx + beside;
                        *value = constant + x * (linear + xx * x);
                    }
                    pixels.profile.at_each(value);
                    for (line, value) in line.iter_mut().zip(&*value) {
                        *line += weight_x * value;
                    }
                }
                for (light, line) in light.iter_mut().zip(&*line) {
                    *light += weight_y * line;
                }
            }
        }
    }
    for light in light {
        *light *= half * half;
    }
}

/// Chooses the quadrature inside a pixel.
struct RulePlan {
    half_pixel: f64,
    core: f64,
    peak: f64,
}

impl RulePlan {
    /// The circular radius beyond which [`SMOOTH_WEIGHTS`] err by less than the tolerance: infinite beyond `farthest`.
    ///
    /// This is an estimate: a derivative of order 8 at distance d from a singularity is about 8! (2/d)⁸ times the value at
    /// half the radius. Both axes contribute.
    fn smooth_from(&self, profile: &impl RoundProfile, farthest: f64) -> f64 {
        let error = |radius: f64| {
            let distance = (radius * radius + self.core * self.core).sqrt();
            let steps = 2.0 * (2.0 * self.half_pixel) / distance;
            2.0 * EIGHTH_FACTOR * 40_320.0 * steps.powi(8) * profile.at(0.25 * radius * radius)
        };
        let most = self.peak * PIXEL_TOLERANCE;
        if self.core < MIN_SMOOTH_CORE * 2.0 * self.half_pixel || error(farthest) > most {
            return f64::INFINITY;
        }
        let (mut inside, mut outside) = (0.0, farthest);
        while outside - inside > BOUND_ERROR {
            let radius = 0.5 * (inside + outside);
            if error(radius) > most {
                inside = radius;
            } else {
                outside = radius;
            }
        }
        outside
    }

    /// The rule of a pixel at circular radius `radius`.
    ///
    /// An n-point rule on an interval of half-width h errs by about B^(−2n), where for a
    /// singularity at distance d the Bernstein ellipse has B = d/h + sqrt(1 + (d/h)²).
    fn choose(&self, profile: &impl RoundProfile, radius: f64) -> Rule {
        let nearest = (radius - self.half_pixel).max(0.0);
        let excess = 10.0 * profile.at(nearest * nearest) / (self.peak * PIXEL_TOLERANCE);
        let mut divisions = 1;
        loop {
            let half = self.half_pixel / divisions as f64;
            let ratio = (nearest * nearest + self.core * self.core).sqrt() / half;
            let bernstein = ratio + (1.0 + ratio * ratio).sqrt();
            let shrink = bernstein * bernstein;
            let mut nodes = 1;
            let mut error = excess / shrink;
            while error > 1.0 && nodes <= MAX_NODES {
                error /= shrink;
                nodes += 1;
            }
            if nodes <= MAX_NODES {
                return Rule { divisions, nodes };
            }
            if divisions >= MAX_DIVISIONS {
                return Rule {
                    divisions,
                    nodes: MAX_NODES,
                };
            }
            divisions *= 2;
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::s;
    use puruspe::bessel::Inu_Knu;

    use super::*;

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn draw(psf: &FunctionalPsf, centre: (f64, f64), size: usize) -> Array2<f64> {
        let mut stamp = Array2::zeros((size, size));
        psf.draw_into(centre.0, centre.1, stamp.view_mut());
        stamp
    }

    #[test]
    fn pupils_have_the_transform_of_their_diffraction_pattern() {
        // ∫ I J0(kr) 2πr dr of I = π/4 / (1 − ε²) · [2J1(x)/x − ε² 2J1(εx)/(εx)]², x = πr, at λ/D = 1.
        let rule = composite_rule(0.0, 400.0, 1600, 12);
        for obscuration in [0.0, 0.3] {
            let pupil = Pupil {
                lambda_over_diameter: 1.0,
                obscuration,
            };
            let somb = |x: f64| if x == 0.0 { 1.0 } else { 2.0 * Jn(1, x) / x };
            let brightness = |r: f64| {
                let e2 = obscuration * obscuration;
                let amplitude = somb(PI * r) - e2 * somb(PI * r * obscuration);
                PI / 4.0 / (1.0 - e2) * amplitude * amplitude
            };
            for k in [0.5, 2.0, 4.0, 6.0, 7.0] {
                let sum: f64 = rule
                    .iter()
                    .map(|(r, w)| w * 2.0 * PI * r * brightness(*r) * Jn(0, k * r))
                    .sum();
                let found = pupil.fourier(k);
                assert!(
                    (found - sum).abs() < 1e-4,
                    "{obscuration} {k}: {found} {sum}"
                );
            }
            assert!((pupil.fourier(0.0) - 1.0).abs() < 1e-15);
            // The envelope of the rings, over some of them.
            let rings = (0..40).map(|i| brightness(20.0 + 0.1 * f64::from(i)));
            let ratio = rings.fold(0.0, f64::max) / pupil.rings(20.0);
            assert!((0.5..1.05).contains(&ratio), "{obscuration}: {ratio}");
            assert!((brightness(0.0) * PI * pupil.disc2() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn pixels_agree_with_a_finer_quadrature() {
        let rule = composite_rule(-0.5, 0.5, 12, 16);
        let profiles = [
            MOFFAT,
            PsfProfile::Moffat { beta: 1.2 },
            PsfProfile::Moffat { beta: 2.5 },
            PsfProfile::Moffat { beta: 40.0 },
            PsfProfile::Kolmogorov,
        ];
        for profile in profiles {
            for fwhm in [0.3, 1.0, 2.85, 3.4, 6.0] {
                for shape in [Shear::ZERO, Shear::new(0.05, -0.02), Shear::new(-0.3, 0.4)] {
                    let psf = FunctionalPsf::new(profile, fwhm, shape).unwrap();
                    let (cx, cy) = (6.3, 7.1);
                    let stamp = draw(&psf, (cx, cy), 15);
                    let central = psf.value(0.0, 0.0).min(1.0);
                    for (row, column) in [(7, 6), (7, 7), (8, 6), (6, 5), (9, 9), (3, 5), (14, 0)] {
                        let exact: f64 = rule
                            .iter()
                            .flat_map(|&(y, wy)| rule.iter().map(move |&(x, wx)| (x, y, wx * wy)))
                            .map(|(x, y, w)| {
                                w * psf.value(column as f64 + x - cx, row as f64 + y - cy)
                            })
                            .sum();
                        let error = (stamp[(row, column)] - exact).abs() / central;
                        assert!(error < 1e-6, "{psf:?} at {row}, {column}: {error:e}");
                    }
                }
            }
        }
    }

    #[test]
    fn profiles_have_their_width_flux_and_orientation() {
        for profile in [
            MOFFAT,
            PsfProfile::Moffat { beta: 2.2 },
            PsfProfile::Kolmogorov,
        ] {
            let round = FunctionalPsf::new(profile, 3.4, Shear::ZERO).unwrap();
            let half = round.value(1.7, 0.0) / round.value(0.0, 0.0);
            // GalSim's two constants for Kolmogorov have seven digits.
            assert!((half - 0.5).abs() < 3e-6, "{profile:?}: {half}");
            // 2πr dr out to 1e5 px with r = e^s.
            let flux: f64 = composite_rule(-12.0, 11.5, 60, 8)
                .into_iter()
                .map(|(s, w)| w * 2.0 * PI * (2.0 * s).exp() * round.value(s.exp(), 0.0))
                .sum();
            assert!((flux - 1.0).abs() < 1e-5, "{profile:?}: {flux}");

            let along_x = FunctionalPsf::new(profile, 3.4, Shear::new(0.2, 0.0)).unwrap();
            assert!(along_x.value(3.0, 0.0) > along_x.value(0.0, 3.0));
            assert!(along_x.fourier(1.0, 0.0) < along_x.fourier(0.0, 1.0));
            let diagonal = FunctionalPsf::new(profile, 3.4, Shear::new(0.0, 0.2)).unwrap();
            assert!(diagonal.value(2.0, 2.0) > diagonal.value(2.0, -2.0));
            assert!(diagonal.fourier(0.5, 0.5) < diagonal.fourier(0.5, -0.5));
        }
    }

    #[test]
    fn moffat_transform_is_the_bessel_function() {
        for beta in [1.3, 2.0, 2.5, 3.0, 4.765, 9.0] {
            let nu = beta - 1.0;
            for x in [0.01, 0.3, 1.0, 4.0, 12.0] {
                let bessel = 2.0 / gamma(nu) * f64::powf(0.5 * x, nu) * Inu_Knu(nu, x).1;
                assert!(
                    (moffat_fourier(beta, x) / bessel - 1.0).abs() < 1e-8,
                    "{beta} {x}"
                );
            }
        }
        // β → ∞ is a Gaussian of the same FWHM: exp(−(k·FWHM)² / (16 ln 2)).
        let wide = PsfProfile::Moffat { beta: 1e6 }.fourier(2.0);
        assert!((wide - (-4.0 / (16.0 * LN_2)).exp()).abs() < 1e-5);
        assert_eq!(MOFFAT.fourier(0.0), 1.0);
        assert_eq!(MOFFAT.fourier(1e4), 0.0);
    }

    #[test]
    fn kolmogorov_brightness_joins_its_wings() {
        let rule = composite_rule(0.0, 2.16, 64, 16)
            .into_iter()
            .map(|(t, w)| (t.powi(3), w * 3.0 * t.powi(5) * (-t.powi(5)).exp()))
            .collect::<Vec<_>>();
        let (inside, outside) = (
            kolmogorov_brightness(&rule, 29.999_999),
            kolmogorov_brightness(&rule, 30.0),
        );
        assert!((inside / outside - 1.0).abs() < 3e-6, "{inside} {outside}");
        // The transform from the table in real space, far enough out that the wings are minor.
        for k in [1.0, 2.0, 4.0] {
            let sum: f64 = composite_rule(0.0, 200.0, 1200, 8)
                .into_iter()
                .map(|(r, w)| w * 2.0 * PI * r * KOLMOGOROV.at(r * r) * Jn(0, k * r))
                .sum();
            let exact = PsfProfile::Kolmogorov.fourier(k);
            assert!((sum - exact).abs() < 1e-4, "{k}: {sum} {exact}");
        }
    }

    #[test]
    fn tabulated_transform_follows_the_formula() {
        for profile in [
            MOFFAT,
            PsfProfile::Moffat { beta: 1.5 },
            PsfProfile::Moffat { beta: 2.4 },
            PsfProfile::Kolmogorov,
        ] {
            let transform = PsfTransform::new(profile).unwrap();
            for i in 0..400 {
                let k = 2e-3 * (0.028 * f64::from(i)).exp();
                let error = (transform.at(k * k) - profile.fourier(k)).abs();
                assert!(error < 1e-6, "{profile:?} at {k}: {error:e}");
            }
        }
    }

    #[test]
    fn impossible_psfs_are_refused() {
        let make = |beta, fwhm, e1| {
            FunctionalPsf::new(PsfProfile::Moffat { beta }, fwhm, Shear::new(e1, 0.0))
        };
        assert!(matches!(make(1.0, 3.4, 0.0), Err(ProfileError::Beta(1.0))));
        assert!(make(f64::NAN, 3.4, 0.0).is_err());
        assert!(matches!(make(3.0, 0.0, 0.0), Err(ProfileError::Fwhm(0.0))));
        assert!(make(3.0, f64::INFINITY, 0.0).is_err());
        assert!(make(3.0, 3.4, 1.0).is_err());
        assert!(make(3.0, 3.4, f64::NAN).is_err());
        let transform = PsfTransform::new(PsfProfile::Kolmogorov).unwrap();
        let moffat = make(3.0, 3.4, 0.0).unwrap();
        assert!(matches!(
            transform.of(&moffat),
            Err(ProfileError::Profile { .. })
        ));
    }

    #[test]
    fn every_pixel_of_any_stamp_has_its_integral() {
        // Sides that lanes divide and that they do not, and centres on, between and beside pixels.
        let stamps = [
            ((48, 48), (23.5, 23.5)),
            ((33, 70), (60.5, 4.0)),
            ((15, 9), (4.0, 7.0)),
            ((11, 13), (6.3, 4.9)),
            ((3, 5), (-2.0, 1.0)),
        ];
        let rule = composite_rule(-0.5, 0.5, 6, 6);
        for (fwhm, profile, shape) in [
            (3.4, MOFFAT, Shear::new(0.05, -0.02)),
            (0.6, PsfProfile::Moffat { beta: 2.5 }, Shear::new(-0.3, 0.4)),
            (6.0, PsfProfile::Kolmogorov, Shear::new(0.05, -0.02)),
        ] {
            let psf = FunctionalPsf::new(profile, fwhm, shape).unwrap();
            for ((rows, columns), (cx, cy)) in stamps {
                let mut stamp = Array2::from_elem((rows, columns), f64::NAN);
                psf.draw_into(cx, cy, stamp.view_mut());
                for ((row, column), light) in stamp.indexed_iter() {
                    let nodes = rule.iter().flat_map(|y| rule.iter().map(move |x| (x, y)));
                    let terms = nodes.map(|((x, wx), (y, wy))| {
                        wx * wy * psf.value(column as f64 + x - cx, row as f64 + y - cy)
                    });
                    let error = (light - terms.sum::<f64>()).abs();
                    let central = psf.value(0.0, 0.0).min(1.0);
                    assert!(error < 1e-6 * central, "{psf:?} {row} {column}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn pixels_may_be_anywhere_in_memory() {
        let profile = PsfProfile::Moffat { beta: 3.0 };
        let psf = FunctionalPsf::new(profile, 2.5, Shear::new(0.1, 0.2)).unwrap();
        let mut one = Array2::zeros((9, 11));
        psf.draw_into(4.3, 5.1, one.view_mut());
        let mut apart = Array2::zeros((9, 22));
        psf.draw_into(4.3, 5.1, apart.slice_mut(s![.., ..;2]));
        assert_eq!(apart.slice(s![.., ..;2]), one);
        assert!(apart.slice(s![.., 1..;2]).iter().all(|light| *light == 0.0));
    }

    #[test]
    fn no_rule_is_shorter_than_its_pixel_requires() {
        for fwhm in [0.3, 1.0, 3.4] {
            let psf =
                FunctionalPsf::new(PsfProfile::Moffat { beta: 3.0 }, fwhm, Shear::ZERO).unwrap();
            let Brightness::Moffat(profile) = psf.brightness() else {
                unreachable!("a Moffat profile");
            };
            let pixels = psf.pixels(profile);
            let rules = pixels.rules((23.5, 23.5), (48, 48));
            assert!(rules.bounds().is_sorted());
            let plan = RulePlan {
                half_pixel: 0.5,
                core: pixels.core,
                peak: pixels.profile.at(0.0).min(1.0),
            };
            for step in 0..3000 {
                let radius = 0.01 * f64::from(step);
                let asked = plan.choose(&pixels.profile, radius);
                let inside = |bound: &f64| radius * radius <= *bound;
                let at = rules.bounds().iter().position(inside);
                let rule = &rules.rules[at.unwrap_or(rules.count - 1)];
                let length = |rule: &Rule| (rule.divisions, rule.nodes);
                assert!(
                    length(rule) >= length(&asked),
                    "{fwhm} {radius}: {rule:?} {asked:?}"
                );
            }
        }
    }
}
