//! Ellipticities and sizes from autocorrelations.
//!
//! The autocorrelation of a stamp has the ellipticity of the stamp and is centred exactly on zero lag; its quadrupole moments
//! give the distortion. The network follows the paper: moments inside the radius that encloses a share of the light
//! ([`ClippedAcf`]). The linear method takes moments under round weights, of an ellipticity ([`RoundMoments`]) and of the size
//! before the PSF ([`SizeMoments`]).
//!
//! # Round moments
//!
//! With A₀, A₊ and A× the integrals of the autocorrelation and of it times x² − y² and 2xy under a round Moffat weight,
//!
//! ```text
//! e = (A₊, A×)/(ρ (A₀ + s)),  W = (1 + (x² + y²)/r²)^(−3/2),
//! ```
//!
//! where ρ makes the response of a round Gaussian galaxy of the typical size one, and s is a regularisation. Moments need
//! weights in proportion to how an autocorrelation changes with shear over how noisy it is; galaxies have cusps and wide
//! wings, and so has this weight.
//!
//! e is not a function of the axis ratio alone, as χ and ε are: its response to shear takes the place of a scale. It is a ratio
//! of two sums over lags, so that its derivatives are exact and short. χ under a weight of the galaxy's own ellipticity
//! (Bernstein & Jarvis 2002) has 1 % less noise for galaxies like GREAT10's, and as much for those of the COSMOS survey, but the
//! noise of its response is 1.7 times as large at S/N 20, and three times at S/N 100.
//!
//! # Sizes
//!
//! With P₀ and P₂ the integrals of the autocorrelation and of it times x² + y² under the weight exp(−(x² + y²)/2τ²),
//!
//! ```text
//! T = (P₂ + s·T₀)/(P₀ + s),
//! ```
//!
//! where s is the P₀ of a galaxy of low S/N and T₀ the T of a typical galaxy: noise alone has a typical size. For a round
//! Gaussian galaxy of standard deviation r per axis, behind a target of σ_Γ and a window of σ_W,
//!
//! ```text
//! 4/T = 2/τ² + 1/(r² + σ_Γ²) + 1/σ_W²,
//! ```
//!
//! by which T becomes r for any galaxy.

use multiversion::multiversion;
use shearq_quantities::Distortion;
use shearq_quantities::linear::LANES;
use shearq_submissions::{AcfKind, Background, ClippedShape, ShareOf};

use crate::error::{MeasureError, length};
use crate::measurement::Flag;
use crate::spectral::{Spectral, SpectralPsf};
use crate::transform::{
    HexLattice, LagsScratch, Plane, Spectrum, ToLags, ToModes, TransformScratch,
};

// Exponent of 1 + (x² + y²)/r² in the weight of an ellipticity. Among 1, 1.5 and 2.5, with three scales of each, it has the least
// scatter of GREAT10's and COSMOS galaxies at S/N 20, and the least noise of the response at equal scatter.
const EXPONENT: f64 = -1.5;

/// A ratio of two sums over lags. What was added to the divisor is part of it.
#[derive(Debug, Clone, Copy)]
pub struct Ratio {
    pub(crate) value: f32,
    divisor: f32,
}

impl Ratio {
    /// Its change with small changes of the divisor and of the dividend.
    pub(crate) fn change(self, divisor: f32, dividend: f32) -> f32 {
        (dividend - self.value * divisor) / self.divisor
    }

    /// Mean of its second derivative over changes a and b, from the mean product of its own change with a and the divisor's
    /// with b, which is the same if a and b are exchanged.
    pub(crate) fn mean_second_derivative(self, product: f32) -> f64 {
        f64::from(-2.0 * product / self.divisor)
    }
}

/// Weights of the lags for N sums, laid out as `spectral::Lags`.
#[derive(Debug, Clone)]
struct LagWeights<const N: usize> {
    /// Of both lags that each place stands for, times the area of a lag.
    weights: [Vec<f32>; N],
    width: usize,
}

impl<const N: usize> LagWeights<N> {
    /// Weights by place in px; lags beyond the circle of `lattice` have none.
    fn new(lattice: HexLattice, of: impl Fn([f64; 2]) -> [f64; N]) -> Self {
        let mut weights = [const { Vec::new() }; N];
        for place in lattice.places() {
            let area = lattice.multiplicity(place) * lattice.area();
            for (weights, weight) in weights.iter_mut().zip(of(place)) {
                weights.push((area * weight) as f32);
            }
        }
        LagWeights {
            weights,
            width: lattice.width(),
        }
    }

    fn sums(&self, lags: &[f32]) -> [f32; N] {
        sums(lags, self.weights.each_ref().map(Vec::as_slice))
    }

    /// Weights of the lags, each for itself, whose sum with a change of the autocorrelation is the change of a sum.
    fn gradients(&self) -> [Vec<f32>; N] {
        // Rows y > 0 stand for both signs.
        self.weights.each_ref().map(|weights| {
            let rows = weights.chunks_exact(self.width).enumerate();
            rows.flat_map(|(y, row)| row.iter().map(move |w| if y == 0 { *w } else { 0.5 * w }))
                .collect()
        })
    }
}

/// Round Gaussian galaxies of one size, as the autocorrelation shows them.
#[derive(Debug, Clone, Copy)]
pub struct TypicalGalaxy {
    /// Mean square per axis in px², without the PSF.
    pub variance: f64,
    /// σ in pixels of the Gaussian that the deconvolved stamp is convolved with.
    pub target: f64,
    /// σ in pixels of the window.
    pub window: f64,
}

impl TypicalGalaxy {
    /// Mean square per axis behind the target, and also behind the window.
    fn extents(self) -> [f64; 2] {
        let deconvolved = self.variance + self.target * self.target;
        let windowed = 1.0 / (1.0 / deconvolved + 1.0 / (self.window * self.window));
        [deconvolved, windowed]
    }

    /// The autocorrelation of one of flux one at a lag of this square in px².
    pub(crate) fn autocorrelation(self, square: f64) -> f64 {
        let [deconvolved, windowed] = self.extents();
        let peak = windowed / (4.0 * std::f64::consts::PI * deconvolved * deconvolved);
        peak * (-square / (4.0 * windowed)).exp()
    }

    /// Derivative of its autocorrelation with respect to γ₁, in units of it.
    fn slope(self, [x, y]: [f64; 2]) -> f64 {
        let [deconvolved, _] = self.extents();
        (x * x - y * y) * self.variance / (2.0 * deconvolved * deconvolved)
    }
}

/// Weights of the ellipticity for one scale and one typical galaxy.
#[derive(Debug, Clone)]
pub struct RoundMoments {
    /// Of A₀, A₊/ρ and A×/ρ.
    lags: LagWeights<3>,
    scale: f64,
}

impl RoundMoments {
    /// For the lags of `lattice`, and a weight of `scale` px.
    pub fn new(scale: f64, galaxy: TypicalGalaxy, lattice: HexLattice) -> Self {
        let bases = |[x, y]: [f64; 2]| [1.0, x * x - y * y, 2.0 * x * y];
        let (mut light, mut response) = (0.0, 0.0);
        for place @ [x, y] in lattice.places() {
            let count = lattice.multiplicity(place);
            let square = x * x + y * y;
            let weighted = count * weight(scale, square) * galaxy.autocorrelation(square);
            light += weighted;
            response += weighted * bases(place)[1] * galaxy.slope(place);
        }
        let rho = response / light;
        let weights = |place @ [x, y]: [f64; 2]| {
            let weight = weight(scale, x * x + y * y);
            let [one, plus, cross] = bases(place);
            [weight * one, weight * plus / rho, weight * cross / rho]
        };
        RoundMoments {
            lags: LagWeights::new(lattice, weights),
            scale,
        }
    }

    /// A₀ and the dividends of e₁ and e₂, of an autocorrelation or of its change.
    pub(crate) fn sums(&self, lags: &[f32]) -> [f32; 3] {
        self.lags.sums(lags)
    }

    /// e₁ and e₂ of `acf`, laid out as `spectral::Lags`, with `regularisation` added to A₀.
    ///
    /// # Errors
    /// Where the divisor is not positive: of an autocorrelation that is all noise, A₀ is anything.
    pub fn measure(&self, acf: &[f32], regularisation: f32) -> Result<[Ratio; 2], Flag> {
        let [zero, plus, cross] = self.sums(acf);
        let divisor = zero + regularisation;
        let found = [plus, cross].map(|dividend| Ratio {
            value: dividend / divisor,
            divisor,
        });
        let finite = found.iter().all(|ratio| ratio.value.is_finite());
        match divisor > 0.0 && divisor.is_finite() && finite {
            true => Ok(found),
            false => Err(Flag::NoExtent),
        }
    }

    /// Change of e₁ and e₂ with a change of the autocorrelation.
    pub(crate) fn response(&self, found: &[Ratio; 2], change: &[f32]) -> [f64; 2] {
        let [zero, plus, cross] = self.sums(change);
        let [e1, e2] = found;
        [e1.change(zero, plus), e2.change(zero, cross)].map(f64::from)
    }

    /// Weights of the lags, each for itself, whose sum with a change of the autocorrelation is the change of A₀, or of a
    /// dividend.
    pub(crate) fn gradients(&self) -> [Vec<f32>; 3] {
        self.lags.gradients()
    }

    /// The weight W at a lag of this square in px².
    pub(crate) fn weight(&self, square: f64) -> f64 {
        weight(self.scale, square)
    }
}

fn weight(scale: f64, square: f64) -> f64 {
    (1.0 + square / (scale * scale)).powf(EXPONENT)
}

// S/N at which a size is the mean of the measured one and of the size of a typical galaxy. Chosen by hand: it shrinks sizes at S/N 20 by 6 %.
const HALF_SIZE_SNR: f32 = 5.0;

/// What is added to the divisors of the moments and of the size, so that faint galaxies respond less.
///
/// Divisors go with the square of the flux, as the square of the S/N ν does, so that a galaxy has the weight
/// ν²/(ν² + ν₀²). ν₀ is converted to a flux by PSF and noise, for galaxies of the size that the window is for, with the S/N
/// of the matched filter. Noise of the autocorrelation instead, which grows much faster with the width of the PSF, would
/// give galaxies behind broad PSFs too little weight: in sets with a PSF for each galaxy that costs 0.4 % of the scatter at
/// S/N 20, and 0.8 % for large galaxies. The galaxy is taken as deconvolved to the target, which is not exact for few
/// iterations or λ > 0.
pub(crate) struct Regularisation {
    /// Regularisation that halves the ellipticity of a galaxy of the reference size and flux one, times ν₀² (`shape.half_snr`).
    ellipticity: f32,
    /// P₀ of [`SizeMoments`] for such a galaxy of flux one, times the square of [`HALF_SIZE_SNR`].
    size: f32,
    /// Power of this galaxy in each mode, from `Spectral::light`.
    galaxy: Vec<f32>,
    /// T of [`SizeMoments`] for such a galaxy.
    pub(crate) typical_square: f32,
}

impl Regularisation {
    pub(crate) fn new(
        half_snr: f64,
        galaxy: TypicalGalaxy,
        spectral: &Spectral,
        moments: &RoundMoments,
        size_moments: &SizeMoments,
    ) -> Self {
        let lags = spectral.lattice().places();
        let acf: Vec<f32> = lags
            .map(|[x, y]| galaxy.autocorrelation(x * x + y * y) as f32)
            .collect();
        let [light, ..] = moments.sums(&acf);
        let [zero, two] = size_moments.sums(&acf);
        Regularisation {
            ellipticity: light * half_snr.powi(2) as f32,
            size: zero * HALF_SIZE_SNR * HALF_SIZE_SNR,
            galaxy: spectral.light(galaxy.variance),
            typical_square: two / zero,
        }
    }

    /// What is added for the ellipticity and for the size behind `psf` in noise of level one; not finite if the PSF passes no light.
    pub(crate) fn behind(&self, psf: &SpectralPsf) -> RegularisationTerms {
        let modes = self.galaxy.iter().zip(psf.clarity());
        let snr_squared = modes.map(|(light, clarity)| light * clarity).sum::<f32>();
        RegularisationTerms {
            ellipticity: self.ellipticity / snr_squared,
            size: self.size / snr_squared,
        }
    }
}

/// What is added to the divisors of ellipticity and size in noise of level one; it grows with the variance of the noise.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct RegularisationTerms {
    pub(crate) ellipticity: f32,
    pub(crate) size: f32,
}

// Scale τ of the weight in units of the window's σ. Chosen by hand: wide enough that sizes up to 10 px differ.
const SIZE_WEIGHT_SCALE: f64 = 0.6;
// Largest size that is reported, in units of the window's σ. Beyond it the window, not the galaxy, sets the size.
const LARGEST_SIZE: f64 = 2.0;
// Smallest size that is reported, in units of the target's σ. Far below the noise of a size, 0.24 px at S/N 20.
const SMALLEST_SIZE: f64 = 0.1;

/// Weights of the size for one window and target.
#[derive(Debug, Clone)]
pub(crate) struct SizeMoments {
    /// Of P₀ and P₂.
    lags: LagWeights<2>,
    target: f64,
    /// 2/τ² + 1/σ_W².
    rest: f64,
    window: f64,
}

/// A size r, and its first and second derivative with T.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Size {
    pub(crate) px: f64,
    pub(crate) slope: f64,
    pub(crate) curvature: f64,
}

impl Size {
    fn bound(px: f64) -> Self {
        Size {
            px,
            slope: 0.0,
            curvature: 0.0,
        }
    }
}

impl SizeMoments {
    /// For the lags of `lattice`, a target of `target` px and a window of `window` px.
    pub(crate) fn new(target: f64, window: f64, lattice: HexLattice) -> Self {
        let tau = SIZE_WEIGHT_SCALE * window;
        let weights = |[x, y]: [f64; 2]| {
            let square = x * x + y * y;
            let weight = (-0.5 * square / (tau * tau)).exp();
            [weight, weight * square]
        };
        SizeMoments {
            lags: LagWeights::new(lattice, weights),
            target,
            rest: 2.0 / (tau * tau) + 1.0 / (window * window),
            window,
        }
    }

    /// P₀ and P₂ of an autocorrelation or of its change.
    pub(crate) fn sums(&self, lags: &[f32]) -> [f32; 2] {
        self.lags.sums(lags)
    }

    /// T of an autocorrelation, with `regularisation` and the typical T.
    pub(crate) fn measure(&self, acf: &[f32], regularisation: f32, typical: f32) -> Ratio {
        let [zero, two] = self.sums(acf);
        let divisor = zero + regularisation;
        Ratio {
            value: (two + regularisation * typical) / divisor,
            divisor,
        }
    }

    /// Change of T with a change of the autocorrelation.
    pub(crate) fn response(&self, found: Ratio, change: &[f32]) -> f32 {
        let [zero, two] = self.sums(change);
        found.change(zero, two)
    }

    /// Weights of the lags, each for itself, whose sum with a change of the autocorrelation is the change of P₀, or of P₂.
    pub(crate) fn gradients(&self) -> [Vec<f32>; 2] {
        self.lags.gradients()
    }

    /// T of a round Gaussian galaxy of standard deviation `r` px per axis.
    pub(crate) fn square_of(&self, r: f64) -> f64 {
        4.0 / (self.rest + 1.0 / (r * r + self.target * self.target))
    }

    /// The size of a galaxy of this T; the derivatives are zero beyond the bounds.
    pub(crate) fn size(&self, square: f64) -> Size {
        let (least, most) = (SMALLEST_SIZE * self.target, LARGEST_SIZE * self.window);
        if square.is_nan() || square <= self.square_of(least) {
            return Size::bound(least);
        }
        if square >= self.square_of(most) {
            return Size::bound(most);
        }
        let compact = 4.0 / square - self.rest;
        let r = (1.0 / compact - self.target * self.target).sqrt();
        // r² = 1/κ − σ_Γ², dκ/dT = −4/T².
        let first = 4.0 / (square * square * compact * compact);
        let second = first * (2.0 * 4.0 / (square * square * compact) - 2.0 / square);
        Size {
            px: r,
            slope: first / (2.0 * r),
            curvature: (second - first * first / (2.0 * r * r)) / (2.0 * r),
        }
    }
}

// Sums of products with each of the weights, which are as many as the lags.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sums<const N: usize>(lags: &[f32], weights: [&[f32]; N]) -> [f32; N] {
    let (lags, last_lags) = lags.as_chunks::<LANES>();
    let mut sums = [0.0; N];
    // One after the other: together they would not become vector instructions.
    for (sum, weights) in sums.iter_mut().zip(weights) {
        let (weights, last_weights) = weights.as_chunks::<LANES>();
        let mut lanes = [0.0f32; LANES];
        for (lags, weights) in lags.iter().zip(weights) {
            for l in 0..LANES {
                lanes[l] += lags[l] * weights[l];
            }
        }
        *sum = lanes.iter().sum();
        for (lag, weight) in last_lags.iter().zip(last_weights) {
            *sum += lag * weight;
        }
    }
    sums
}

// Chosen by hand.
const BORDER_PX: usize = 3;

/// Quadrupole moments of the clipped autocorrelation (Eq. 16), in px² relative to its light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moments {
    /// Qxx.
    pub xx: f64,
    /// Qyy.
    pub yy: f64,
    /// Qxy.
    pub xy: f64,
    /// Radius of the clipping in pixels.
    pub radius: f64,
}

impl Moments {
    /// (Qxx − Qyy)/(Qxx + Qyy) and 2Qxy/(Qxx + Qyy) (Eq. 15): a distortion χ.
    ///
    /// # Errors
    /// Where Qxx + Qyy is not positive.
    pub fn distortion(&self) -> Result<Distortion, Flag> {
        let size = self.xx + self.yy;
        if !(size > 0.0 && size.is_finite()) {
            return Err(Flag::NoExtent);
        }
        Ok(Distortion::new(
            (self.xx - self.yy) / size,
            2.0 * self.xy / size,
        ))
    }
}

/// One lag of the half plane kept.
#[derive(Debug, Clone, Copy)]
struct Lag {
    at: u32,
    dx: i32,
    dy: i32,
    square: i32,
    /// 2 for a lag that stands for its opposite too, 1 for zero lag; half of it for each component of n/2
    /// where lags wrap around and −n/2 is the same lag.
    weight: f32,
}

/// Autocorrelation A(dx, dy) = Σ v(x, y)·v(x + dx, y + dy) of n×n stamps, zero outside the stamp or the stamp again, and its
/// moments inside the radius that encloses a share of its light.
///
/// Lags are kept for dy = 0…R, dx = −R…R, as `[dy·(2R+1) + dx + R]`; the other half follows from A(−dx, −dy) = A(dx, dy).
/// R is n − 1, or n/2 where the stamp goes on beyond its edges as it begins: what a transform without padding gives.
#[derive(Debug, Clone)]
pub struct ClippedAcf {
    n: usize,
    settings: ClippedShape,
    plane: Plane,
    to_modes: ToModes,
    to_lags: ToLags,
    reach: usize,
    /// By distance. Lags of equal distance are taken or left together, so that the clipped region is as round as the
    /// pixel grid allows and has no preferred direction.
    lags: Vec<Lag>,
    /// Number of lags, of both half planes.
    count: f64,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct ClippedAcfScratch {
    stamp: Vec<f32>,
    transform: TransformScratch,
    spectrum: Spectrum,
    power: Vec<f32>,
    lags: LagsScratch,
    acf: Vec<f32>,
}

impl ClippedAcfScratch {
    /// The autocorrelation last measured, laid out as [`ClippedAcf`] has it.
    pub fn acf(&self) -> &[f32] {
        &self.acf
    }
}

impl ClippedAcf {
    /// Plans for n×n stamps.
    pub fn new(n: usize, settings: &ClippedShape) -> Self {
        let circular = settings.acf == AcfKind::Circular;
        // At 2n − 1 pixels no lag wraps onto another.
        let (period, reach) = if circular {
            (n, n / 2)
        } else {
            (2 * n - 1, n - 1)
        };
        let plane = Plane::with_all_modes(period);
        let side = reach as i32;
        // −n/2 and n/2 are one lag of a circular autocorrelation, which both components share.
        let half = |d: i32| {
            if circular && 2 * d.unsigned_abs() as usize == n {
                0.5
            } else {
                1.0
            }
        };
        let places = (0..=side).flat_map(|dy| (-side..=side).map(move |dx| (dy, dx)));
        let mut lags: Vec<Lag> = places
            .enumerate()
            .filter(|(_, (dy, dx))| *dy > 0 || *dx >= 0)
            .map(|(at, (dy, dx))| {
                let both = if dx == 0 && dy == 0 { 1.0 } else { 2.0 };
                Lag {
                    at: at as u32,
                    dx,
                    dy,
                    square: dx * dx + dy * dy,
                    weight: both * half(dx) * half(dy),
                }
            })
            .collect();
        lags.sort_by_key(|lag| (lag.square, lag.dy, lag.dx));
        ClippedAcf {
            n,
            settings: settings.clone(),
            to_modes: ToModes::new(n, &plane, false),
            to_lags: ToLags::new(reach, period, &plane, 1.0 / (period * period) as f64),
            plane,
            reach,
            count: lags.iter().map(|lag| f64::from(lag.weight)).sum(),
            lags,
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> ClippedAcfScratch {
        ClippedAcfScratch {
            stamp: vec![0.0; self.n * self.n],
            transform: self.to_modes.scratch(),
            spectrum: self.plane.spectrum(),
            power: vec![0.0; 2 * self.plane.quarter()],
            lags: self.to_lags.scratch(),
            acf: vec![0.0; self.to_lags.len()],
        }
    }

    /// Largest component R of a lag in pixels.
    pub fn reach(&self) -> usize {
        self.reach
    }

    /// Moments of the autocorrelation of `stamp`, whose pixels sum to `light`, or why there are none.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn measure(
        &self,
        stamp: &[f32],
        light: f64,
        scratch: &mut ClippedAcfScratch,
    ) -> Result<Result<Moments, Flag>, MeasureError> {
        let level = self.autocorrelate(stamp, scratch)?;
        let light = light - level * (self.n * self.n) as f64;
        Ok(self.moments(&scratch.acf, light))
    }

    /// Writes the autocorrelation of `stamp` less the level of its background to [`ClippedAcfScratch::acf`]; returns the level.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn autocorrelate(
        &self,
        stamp: &[f32],
        scratch: &mut ClippedAcfScratch,
    ) -> Result<f64, MeasureError> {
        length("a stamp", stamp.len(), self.n * self.n)?;
        let what = "buffers for an autocorrelation";
        length(what, scratch.acf.len(), self.to_lags.len())?;
        length(what, scratch.stamp.len(), stamp.len())?;
        let level = match self.settings.background {
            Background::StampFrame => frame_mean(stamp, self.n),
            Background::None | Background::AcfEdge => 0.0,
        };
        let ClippedAcfScratch {
            stamp: above,
            transform,
            spectrum,
            power,
            lags,
            acf,
        } = scratch;
        for (above, value) in above.iter_mut().zip(stamp) {
            *above = value - level as f32;
        }
        self.to_modes.transform(above, transform, spectrum);
        spectrum.power(power);
        self.to_lags.lags(power, lags, acf);
        Ok(level)
    }

    /// Moments of an autocorrelation; `light` is the sum of the stamp, whose square is the sum of the autocorrelation.
    ///
    /// # Errors
    /// Where there is no light.
    pub fn moments(&self, acf: &[f32], light: f64) -> Result<Moments, Flag> {
        if !(light > 0.0 && light.is_finite()) {
            return Err(Flag::NoLight);
        }
        // The squared light less the background of every lag is the sum of the lags.
        let background = self.background(acf);
        let wanted = self.settings.acf_share
            * match self.settings.share_of {
                ShareOf::Total => light * light - background * self.count,
                ShareOf::Maximum => self.most_enclosed(acf, background),
            };
        let (mut sum, mut square) = (0.0, 0);
        let mut q = [0.0f64; 3];
        // Whether the share is reached is decided where a ring of equal distance is complete. Less the background, some of its lags
        // are negative: a part of a ring may pass what the whole ring does not reach, and which part depends on the axes.
        for ring in self.rings() {
            for lag in ring {
                let value = light_of(lag, acf, background);
                sum += value;
                q[0] += value * f64::from(lag.dx * lag.dx);
                q[1] += value * f64::from(lag.dy * lag.dy);
                q[2] += value * f64::from(lag.dx * lag.dy);
                square = lag.square;
            }
            if sum >= wanted {
                break;
            }
        }
        if sum.is_nan() || sum <= 0.0 {
            return Err(Flag::NoLight);
        }
        Ok(Moments {
            xx: q[0] / sum,
            yy: q[1] / sum,
            xy: q[2] / sum,
            // Of the last ring where rounding misses a share of 1.
            radius: f64::from(square).sqrt(),
        })
    }

    // Mean of the outermost lags, where it is to be subtracted: a pedestal of the deconvolved stamp, which clipping at zero
    // makes of noise, would enter the circle of 90 % of the light and make the shape rounder.
    fn background(&self, acf: &[f32]) -> f64 {
        if self.settings.background != Background::AcfEdge {
            return 0.0;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        for lag in &self.lags {
            if lag.dx.abs().max(lag.dy) == self.reach as i32 {
                sum += light_of(lag, acf, 0.0);
                count += f64::from(lag.weight);
            }
        }
        sum / count
    }

    fn most_enclosed(&self, acf: &[f32], background: f64) -> f64 {
        let (mut sum, mut most) = (0.0, 0.0f64);
        for ring in self.rings() {
            for lag in ring {
                sum += light_of(lag, acf, background);
            }
            most = most.max(sum);
        }
        most
    }

    fn rings(&self) -> impl Iterator<Item = &[Lag]> {
        self.lags.chunk_by(|a, b| a.square == b.square)
    }
}

fn light_of(lag: &Lag, acf: &[f32], background: f64) -> f64 {
    f64::from(acf[lag.at as usize] * lag.weight) - background * f64::from(lag.weight)
}

// Mean of the frame of an n×n stamp; of all its pixels where it is too small to have an inside.
fn frame_mean(stamp: &[f32], n: usize) -> f64 {
    let inside = BORDER_PX..n.saturating_sub(BORDER_PX);
    let (mut sum, mut count) = (0.0, 0);
    for (at, &value) in stamp.iter().enumerate() {
        if !(inside.contains(&(at / n)) && inside.contains(&(at % n))) {
            sum += f64::from(value);
            count += 1;
        }
    }
    sum / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::EllipticityType;

    use super::*;
    use crate::testing::close;

    const REACH: usize = 16;

    fn lattice(row_spacing: f64) -> HexLattice {
        HexLattice {
            row_spacing,
            reach: REACH,
        }
    }

    const TYPICAL: TypicalGalaxy = TypicalGalaxy {
        variance: 8.8,
        target: TARGET,
        window: WINDOW,
    };

    fn moments(scale: f64) -> RoundMoments {
        RoundMoments::new(scale, TYPICAL, lattice(1.0))
    }

    fn values(found: [Ratio; 2]) -> [f32; 2] {
        found.map(|ratio| ratio.value)
    }

    /// Sum over all lags of weights of each: those below the first row stand for two.
    fn sum(weights: &[f32], lags: &[f32]) -> f32 {
        let width = lattice(1.0).width();
        let terms = weights.iter().zip(lags).enumerate();
        terms
            .map(|(at, (w, v))| w * v * if at < width { 1.0 } else { 2.0 })
            .sum()
    }

    /// Autocorrelation of a Gaussian galaxy of distortion (e1, e2) and Qxx + Qyy = size, on rows of lags `spacing` apart.
    fn gaussian(spacing: f64, size: f64, e1: f64, e2: f64) -> Vec<f32> {
        let (qxx, qyy, qxy) = (
            0.5 * size * (1.0 + e1),
            0.5 * size * (1.0 - e1),
            0.5 * size * e2,
        );
        let det = qxx * qyy - qxy * qxy;
        let acf = lattice(spacing).places().map(|[x, y]| {
            let q = (x * x * qyy + y * y * qxx - 2.0 * x * y * qxy) / det;
            (-0.5 * q).exp() as f32
        });
        acf.collect()
    }

    #[test]
    fn the_typical_galaxy_responds_by_one() {
        let TypicalGalaxy {
            variance,
            target,
            window,
        } = TYPICAL;
        let windowed = |extent: f64| 1.0 / (1.0 / (extent + target * target) + window.powi(-2));
        for scale in [1.5, 3.0] {
            let moments = moments(scale);
            let round = TypicalGalaxy::autocorrelation;
            let lags = lattice(1.0).places();
            let acf: Vec<f32> = lags
                .map(|[x, y]| round(TYPICAL, x * x + y * y) as f32)
                .collect();
            // Single precision.
            let round = values(moments.measure(&acf, 0.0).unwrap());
            assert!(round.iter().all(|e| e.abs() < 1e-6), "{round:?}");
            // A shear γ along an axis, and between axes, changes the mean squares along and across it by e^(±2γ).
            let gamma = 0.005;
            let [along, across] =
                [2.0 * gamma, -2.0 * gamma].map(|by: f64| windowed(variance * by.exp()));
            let distortion = (along - across) / (along + across);
            for k in 0..2 {
                let chi = [[distortion, 0.0], [0.0, distortion]][k];
                let acf = gaussian(1.0, 2.0 * (along + across), chi[0], chi[1]);
                let e = values(moments.measure(&acf, 0.0).unwrap());
                // γ², and light beyond 16 px.
                assert!((e[k] / gamma as f32 - 1.0).abs() < 5e-3, "{scale}: {e:?}");
                assert!(e[1 - k].abs() < 1e-6, "{e:?}");
            }
        }
    }

    #[test]
    fn round_moments_are_sums_over_all_lags_in_the_circle() {
        let (scale, lattice) = (2.5, lattice(4.0 / 3.0));
        let mut rng = ChaCha8Rng::seed_from_u64(16);
        let acf: Vec<f32> = lattice
            .places()
            .map(|_| rng.random_range(0.1..1.0))
            .collect();
        // A₀, A₊, A×, and for ρ the light and the response of the typical galaxy.
        let mut sums = [0.0f64; 5];
        for (place, value) in lattice.places().zip(&acf) {
            // Rows y > 0 stand for the half plane below them.
            let signs: &[f64] = if place[1] > 0.0 { &[1.0, -1.0] } else { &[1.0] };
            for [x, y] in signs.iter().map(|sign| place.map(|at| sign * at)) {
                if lattice.contains([x, y]) {
                    let square = x * x + y * y;
                    let weight = (1.0 + square / (scale * scale)).powf(-1.5);
                    let typical = weight * TYPICAL.autocorrelation(square);
                    let lag = weight * f64::from(*value);
                    let plus = x * x - y * y;
                    let response = typical * plus * TYPICAL.slope([x, y]);
                    let terms = [lag, lag * plus, lag * 2.0 * x * y, typical, response];
                    for (sum, term) in sums.iter_mut().zip(terms) {
                        *sum += term;
                    }
                }
            }
        }
        let [zero, plus, cross, light, response] = sums;
        let found = values(
            RoundMoments::new(scale, TYPICAL, lattice)
                .measure(&acf, 0.0)
                .unwrap(),
        );
        for (found, moment) in found.into_iter().zip([plus, cross]) {
            // Single precision, over sums of terms of both signs.
            let expected = moment * light / (response * zero);
            assert!(
                (f64::from(found) - expected).abs() < 1e-5,
                "{found} {expected}"
            );
        }
    }

    #[test]
    fn ellipticities_along_an_axis_and_between_axes_are_the_same() {
        // As far apart for the weight as in the submissions, and farther.
        for spacing in [4.0 / 3.0, 2.0] {
            let moments = RoundMoments::new(1.5, TYPICAL, lattice(spacing));
            // Six axes prefer one of two opposite distortions, to second order.
            let response = |chi1, chi2| {
                let [plus, minus] = [1.0, -1.0].map(|sign| {
                    let acf = gaussian(spacing, 16.0, sign * chi1, sign * chi2);
                    values(moments.measure(&acf, 0.0).unwrap())
                        .iter()
                        .sum::<f32>()
                });
                plus - minus
            };
            let apart = response(0.01, 0.0) / response(0.0, 0.01) - 1.0;
            // The resolution of single precision.
            assert!(apart.abs() < 5e-4, "{spacing}: {apart}");
        }
    }

    #[test]
    fn derivatives_of_ellipticities_are_differences() {
        let moments = moments(1.5);
        let (acf, other) = (
            gaussian(1.0, 20.0, 0.3, -0.2),
            gaussian(1.0, 14.0, -0.1, 0.4),
        );
        for regularisation in [0.0, 20.0] {
            let found = moments.measure(&acf, regularisation).unwrap();
            let response = moments.response(&found, &other);
            let moved =
                |h: f32| -> Vec<f32> { acf.iter().zip(&other).map(|(a, o)| a + h * o).collect() };
            let at = |h: f32| moments.measure(&moved(h), regularisation).unwrap();
            let (plus, minus) = (at(0.01), at(-0.01));
            let [light, divided @ ..] = moments.gradients().map(|weights| sum(&weights, &other));
            for k in 0..2 {
                let slope = f64::from(plus[k].value - minus[k].value) / 0.02;
                // f32 resolves e to 10⁻⁶, divided by 0.02; the third derivative is smaller.
                assert!((response[k] - slope).abs() < 1e-4, "{response:?} {slope}");
                let change = found[k].change(light, divided[k]);
                assert!((f64::from(change) - response[k]).abs() < 1e-5 * (1.0 + slope.abs()));
                let bent = [plus, minus].map(|found| moments.response(&found, &other)[k]);
                let expected = (bent[0] - bent[1]) / 0.02;
                let curvature = found[k].mean_second_derivative(change * light);
                assert!(
                    (curvature - expected).abs() < 2e-3 * (1.0 + expected.abs()),
                    "{curvature} {expected}"
                );
            }
        }
    }

    #[test]
    fn an_autocorrelation_without_light_is_refused() {
        let moments = moments(1.5);
        let lags = lattice(1.0).count();
        for acf in [vec![0.0; lags], vec![-1.0; lags], vec![f32::NAN; lags]] {
            assert!(moments.measure(&acf, 0.0).is_err());
        }
    }

    const LATTICE: HexLattice = HexLattice {
        row_spacing: 4.0 / 3.0,
        reach: 15,
    };
    const TARGET: f64 = 1.5;
    const WINDOW: f64 = 8.0;

    /// Autocorrelation of a windowed round Gaussian galaxy of standard deviation `r` and flux one.
    fn acf(r: f64) -> Vec<f32> {
        let variance = 1.0 / (1.0 / (r * r + TARGET * TARGET) + 1.0 / (WINDOW * WINDOW));
        let lags = LATTICE.places().map(|[x, y]| {
            let square = x * x + y * y;
            (-square / (4.0 * variance)).exp() as f32
        });
        lags.collect()
    }

    #[test]
    fn the_size_of_a_gaussian_is_its_standard_deviation() {
        let moments = SizeMoments::new(TARGET, WINDOW, LATTICE);
        for r in [1.0, 2.0, 3.0, 5.0, 8.0] {
            let found = moments.measure(&acf(r), 0.0, 0.0);
            let Size {
                px: size,
                slope: first,
                curvature: second,
            } = moments.size(f64::from(found.value));
            // The lags end at 20 px, four standard deviations of the weight.
            assert!((size / r - 1.0).abs() < 0.01, "{r}: {size}");
            assert!((moments.square_of(size) / f64::from(found.value) - 1.0).abs() < 1e-9);
            let step = 1e-4 * f64::from(found.value);
            let side = |by: f64| moments.size(f64::from(found.value) + by).px;
            let (plus, minus) = (side(step), side(-step));
            // Truncation and rounding of differences of 10⁻⁴.
            assert!(((plus - minus) / (2.0 * step) / first - 1.0).abs() < 1e-5);
            let curved = (plus - 2.0 * size + minus) / (step * step);
            assert!(
                (curved - second).abs() < 1e-3 * (second.abs() + first),
                "{r}"
            );
        }
        // A tenth of the target's width at least, and two window widths at most.
        for (square, bound) in [
            (0.0, 0.1 * TARGET),
            (f64::NAN, 0.1 * TARGET),
            (1e9, 2.0 * WINDOW),
        ] {
            assert_eq!(moments.size(square), Size::bound(bound));
        }
    }

    #[test]
    fn responses_are_differences_and_noise_has_the_typical_size() {
        let moments = SizeMoments::new(TARGET, WINDOW, LATTICE);
        let (galaxy, other) = (acf(2.0), acf(4.0));
        let found = moments.measure(&galaxy, 3.0, 20.0);
        let step = 1e-3;
        let moved: Vec<f32> = galaxy
            .iter()
            .zip(&other)
            .map(|(a, b)| a + step * b)
            .collect();
        let change = (moments.measure(&moved, 3.0, 20.0).value - found.value) / step;
        let response = moments.response(found, &other);
        // Single precision over a step of 10⁻³.
        close(change / response, 1.0, 0.02);
        let nothing = vec![0.0; galaxy.len()];
        assert_eq!(moments.measure(&nothing, 3.0, 20.0).value, 20.0);
    }

    fn settings(acf: AcfKind, background: Background, acf_share: f64) -> ClippedShape {
        ClippedShape {
            acf,
            background,
            acf_share,
            share_of: ShareOf::Total,
            ellipticity: EllipticityType::Distortion,
        }
    }

    /// Every lag (dx, dy) with its value and how often it counts, by plain sums: a lag of n/2 of a circular one is its own
    /// opposite.
    fn lags_naive(kind: AcfKind, stamp: &Array2<f64>) -> Vec<(i64, i64, f64, f64)> {
        let n = stamp.nrows() as i64;
        let mut lags = Vec::new();
        let reach = match kind {
            AcfKind::Full => n - 1,
            AcfKind::Circular => n / 2,
        };
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let mut sum = 0.0;
                for ((y, x), value) in stamp.indexed_iter() {
                    let (mut y, mut x) = (y as i64 + dy, x as i64 + dx);
                    if kind == AcfKind::Circular {
                        (y, x) = (y.rem_euclid(n), x.rem_euclid(n));
                    }
                    let other = stamp.get((y as usize, x as usize));
                    sum += value * other.copied().unwrap_or(0.0);
                }
                let twice = |d: i64| kind == AcfKind::Circular && 2 * d.abs() == n;
                let weight = [dx, dy].map(|d| if twice(d) { 0.5 } else { 1.0 });
                lags.push((dx, dy, sum, weight[0] * weight[1]));
            }
        }
        lags
    }

    /// The moments by plain sums over all pairs of pixels, in f64, with the autocorrelation as an image of its
    /// own. `None` where there is no light.
    fn moments_naive(settings: &ClippedShape, stamp: &Array2<f64>) -> Option<Moments> {
        let n = stamp.nrows() as i64;
        let mut stamp = stamp.clone();
        if settings.background == Background::StampFrame {
            let frame = |y: usize, x: usize| {
                let edge = |k: usize| k < BORDER_PX || k + BORDER_PX >= n as usize;
                edge(y) || edge(x)
            };
            let all: Vec<f64> = stamp
                .indexed_iter()
                .filter(|((y, x), _)| frame(*y, *x))
                .map(|(_, v)| *v)
                .collect();
            stamp -= all.iter().sum::<f64>() / all.len() as f64;
        }
        if stamp.sum() <= 0.0 {
            return None;
        }
        let mut lags = lags_naive(settings.acf, &stamp);
        let reach = lags.iter().map(|lag| lag.0).max()?;
        if settings.background == Background::AcfEdge {
            let outermost = |l: &&mut (i64, i64, f64, f64)| l.0.abs().max(l.1.abs()) == reach;
            let (mut sum, mut count) = (0.0, 0.0);
            for lag in lags.iter_mut().filter(outermost) {
                sum += lag.2 * lag.3;
                count += lag.3;
            }
            lags.iter_mut().for_each(|lag| lag.2 -= sum / count);
        }
        let square = |lag: &(i64, i64, f64, f64)| lag.0 * lag.0 + lag.1 * lag.1;
        let mut squares: Vec<i64> = lags.iter().map(square).collect();
        squares.sort_unstable();
        squares.dedup();
        let inside = |of: i64, what: fn(&(i64, i64, f64, f64)) -> f64| -> f64 {
            let lags = lags.iter().filter(|lag| square(lag) <= of);
            lags.map(|lag| what(lag) * lag.2 * lag.3).sum()
        };
        let enclosed: Vec<f64> = squares.iter().map(|s| inside(*s, |_| 1.0)).collect();
        let whole = match settings.share_of {
            ShareOf::Total => *enclosed.last()?,
            ShareOf::Maximum => enclosed.iter().copied().fold(0.0, f64::max),
        };
        let at = enclosed
            .iter()
            .position(|e| *e >= settings.acf_share * whole)?;
        let of = squares[at];
        let moment = |what| inside(of, what) / enclosed[at];
        Some(Moments {
            xx: moment(|lag| (lag.0 * lag.0) as f64),
            yy: moment(|lag| (lag.1 * lag.1) as f64),
            xy: moment(|lag| (lag.0 * lag.1) as f64),
            radius: (of as f64).sqrt(),
        })
    }

    /// A galaxy with noise, of which a part below zero stays: less its background, rings then have lags of both signs.
    fn noisy_stamp(rng: &mut ChaCha8Rng, n: usize, floor: f64) -> Array2<f64> {
        let centre = (n as f64 - 1.0) / 2.0 + 0.3;
        Array2::from_shape_fn((n, n), |(y, x)| {
            let (dy, dx) = (y as f64 - centre, x as f64 - centre);
            let noise: f64 = rng.random_range(-0.5..1.0);
            let light = 4.0 * (-(dx * dx + dy * dy - 0.6 * dx * dy) / 7.0).exp();
            // Of single precision, as the kernel takes it.
            f64::from((noise.max(floor) + light) as f32)
        })
    }

    #[test]
    fn every_reading_equals_plain_sums_on_dirty_scratch() {
        let mut rng = ChaCha8Rng::seed_from_u64(15);
        for n in [8, 11, 16, 19, 23, 32] {
            for (acf, background, share_of, acf_share) in readings() {
                let settings = ClippedShape {
                    share_of,
                    ..settings(acf, background, acf_share)
                };
                let plan = ClippedAcf::new(n, &settings);
                let mut scratch = plan.scratch();
                scratch.acf.fill(f32::NAN);
                scratch.power.fill(f32::NAN);
                for floor in [0.0, 0.0, -0.5, -0.5, -0.5] {
                    let stamp = noisy_stamp(&mut rng, n, floor);
                    let single: Vec<f32> = stamp.iter().map(|v| *v as f32).collect();
                    let dirt: Vec<f32> = single.iter().rev().map(|v| 9.0 * v).collect();
                    plan.measure(&dirt, 1.0, &mut scratch).unwrap().ok();
                    let found = plan.measure(&single, stamp.sum(), &mut scratch).unwrap();
                    let expected = moments_naive(&settings, &stamp);
                    let (Ok(found), Some(expected)) = (found, expected) else {
                        panic!("{settings:?}: no light");
                    };
                    // f32 transforms: 1e-6 of the peak in each of up to 10³ lags, whose r² are up to
                    // 10², over a sum of some ten peaks.
                    let label = format!("n {n}, {settings:?}: {found:?} {expected:?}");
                    assert!((found.radius - expected.radius).abs() < 1e-12, "{label}");
                    for (a, b) in [
                        (found.xx, expected.xx),
                        (found.yy, expected.yy),
                        (found.xy, expected.xy),
                    ] {
                        assert!((a - b).abs() <= 1e-4 * expected.xx.abs(), "{label}");
                    }
                }
            }
        }
    }

    fn readings() -> Vec<(AcfKind, Background, ShareOf, f64)> {
        let mut readings = Vec::new();
        for acf in [AcfKind::Full, AcfKind::Circular] {
            for background in [
                Background::None,
                Background::AcfEdge,
                Background::StampFrame,
            ] {
                for share_of in [ShareOf::Total, ShareOf::Maximum] {
                    for acf_share in [0.5, 0.89] {
                        readings.push((acf, background, share_of, acf_share));
                    }
                }
            }
        }
        readings
    }

    #[test]
    fn moments_without_light_have_no_distortion() {
        let plan = ClippedAcf::new(5, &settings(AcfKind::Full, Background::None, 0.9));
        assert_eq!(plan.moments(&[0.0; 45], 0.0), Err(Flag::NoLight));
        assert_eq!(plan.moments(&[0.0; 45], f64::NAN), Err(Flag::NoLight));
        let mut acf = [0.0; 45];
        acf[4] = 1.0;
        let point = plan.moments(&acf, 1.0).unwrap();
        assert_eq!(point.distortion(), Err(Flag::NoExtent));
        let elongated = Moments {
            xx: 5.0,
            yy: 3.0,
            xy: -1.0,
            radius: 4.0,
        };
        assert_eq!(elongated.distortion(), Ok(Distortion::new(0.25, -0.25)));
    }
}
