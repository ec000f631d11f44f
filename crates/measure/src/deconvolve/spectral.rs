//! The linear network in closed form, and the autocorrelation of what it makes of a stamp.
//!
//! Without thresholds (Eq. 9) and clipping (Eq. 12), the adaptive update v ← v + c·f (Eqs. 10 and 11)
//! from v = 0 is linear. On a plane without boundary each Fourier mode evolves alone, and after M
//! iterations
//!
//! ```text
//! v̂ = [1 − (1 − c w)^M] · conj(p)/w · û,    w = |p|² + λ d²,
//! ```
//!
//! with p and d the transforms of the PSF and of Sun's kernel. What the shape is measured on is v
//! convolved with Γ: a round Gaussian of σ that falls to zero towards |k| = [`CUT`]/σ. No mode enters that
//! the PSF has destroyed, and what remains of the PSF is round. (A sharp cut would bring noise from afar.)
//!
//! The result is multiplied by a round Gaussian window, which keeps out most of the noise, before its
//! autocorrelation is taken. (A window on the stamp itself would cut into the PSF, and what was then
//! deconvolved would have the opposite of its ellipticity.) Noise of level σ and power σ²S adds to the mean of the power of
//! each mode what the window brings there of σ²SΓ²[…]²|p|²/w², which is subtracted. So few modes are
//! left that images are sampled on a coarse grid.
//!
//! # Response to shear
//!
//! A shear γ₁ of the galaxy (before the PSF) changes the transform s = û/p of the whole stamp by
//! (k_x ∂_x − k_y ∂_y)s, γ₂ by (k_y ∂_x + k_x ∂_y)s (∂ with respect to k). ∂û is the transform of
//! −i·x times the stamp, so that the change of the autocorrelation with shear follows from the stamp
//! itself: metacalibration (Huff & Mandelbaum 2017) in the limit of a small shear. The change is
//! worked out on the whole stamp and windowed then: a shear moves the galaxy and not the window, nor the edges of the stamp
//! ([`edges`]).

mod edges;
mod modes;
mod plane;
mod products;

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_fourier::Complex32;
use shearq_submissions::LinearDeconvolution;

use self::edges::{Edges, EdgesScratch};
use self::modes::{correlate, restore, sheared};
use self::plane::{Plane, PlaneScratch};
pub(crate) use self::products::Gradients;
use super::sun::high_pass;
use crate::error::MeasureError;
use crate::fft::StampFft;
use crate::noise::StampNoise;
use crate::sizes::{check_psf, check_sizes};

/// Padding around a stamp, so that the deconvolved stamp does not wrap around. See
/// docs/constants.md.
const SPREAD: usize = 8;
/// Least power of the PSF's transform; modes below it are left out as pure noise. See
/// docs/constants.md.
const LEAST_POWER: f32 = 1e-7;
/// Largest wave number of the target Γ, times its σ. Γ is 0.09 there. See docs/constants.md.
const CUT: f64 = 2.2;
/// Value of the window at the middle of an edge above which the edge correction is applied. See
/// docs/constants.md.
const LIT: f64 = 0.02;
/// Largest lag of the autocorrelation in σ of the window. The window's autocorrelation is a fifth
/// there. See docs/constants.md.
const REACH: f64 = 2.5;

/// The linear network for one stamp size.
#[derive(Debug, Clone)]
pub struct Spectral {
    n: usize,
    p: usize,
    reach: usize,
    step: f32,
    iterations: i32,
    plane: Plane,
    /// λ d² of each mode of a half spectrum.
    rough: Vec<f32>,
    /// Γ of each mode.
    target: Vec<f32>,
    /// k_x and k_y of each mode, in radians per pixel.
    waves: Vec<[f32; 2]>,
    /// The window along an axis of the coarse grid, over the number of places.
    window: Vec<f32>,
    window_sigma: f64,
    /// The stamp's.
    edges: Edges,
    /// Power that windowed white noise brings from a mode to one so many frequencies away along an
    /// axis, either way; the product of both axes is in units of σ².
    leak: Vec<f32>,
    /// Scale of the autocorrelation for modes in the largest circle of those kept, zero outside.
    scale: Vec<f32>,
    /// Phase that moves the centre of a PSF's stamp to the origin.
    centre: Vec<Complex32>,
    /// Share of the noise under the window that the stamp contains.
    inside: f32,
}

/// Noise as the linear network uses it: of level one, and white but for its power.
#[derive(Debug, Clone)]
pub struct ModeNoise {
    /// Power S of each mode; one for white noise.
    power: Vec<f32>,
    /// ½(k_x ∂_x − k_y ∂_y) ln S and ½(k_y ∂_x + k_x ∂_y) ln S: what a shear adds to a mode of noise, in units
    /// of it and in the mean.
    tilts: Vec<[f32; 2]>,
}

/// A PSF as the linear network uses it.
#[derive(Debug, Clone)]
pub struct SpectralPsf {
    /// v̂/û.
    restore: Vec<Complex32>,
    /// What a field of noise of σ = 1 becomes of one that is white: v̂/û times √S.
    field: Vec<Complex32>,
    /// Change of a mode of the field with the components of shear, in units of it and in the mean.
    field_tilts: Vec<[f32; 2]>,
    /// What the field would be with the PSF turned by 90 degrees, less what it is, in units of it.
    turned: Vec<f32>,
    /// Mean power of windowed noise, in units of σ².
    floor: Vec<f32>,
    /// |p|²/S of each mode: the square of what a point of flux one is there, in units of the noise.
    clarity: Vec<f32>,
    /// (k_x ∂_x − k_y ∂_y)p/p and (k_y ∂_x + k_x ∂_y)p/p.
    tilts: Vec<[Complex32; 2]>,
    /// Mean of −Re(conj(v̂)·δv̂) of windowed noise, in units of σ².
    noise_tilts: Vec<[f32; 2]>,
    /// Power of noise of σ = 1 in each mode before the window and in the one it stands for, times its changes with both
    /// components of shear, and times what it lacks to be that of the PSF turned by 90 degrees.
    powers: [Vec<f32>; 3],
}

impl SpectralPsf {
    /// |p|²/S of each mode of a half spectrum, S being the power of the noise.
    pub fn clarity(&self) -> &[f32] {
        &self.clarity
    }

    /// Standard deviation of [`Lags::flux`] in noise of σ = 1.
    pub fn flux_error(&self) -> f32 {
        self.floor[0].sqrt()
    }
}

/// Buffers for one thread. Their content between calls does not matter, but for the stamp that
/// [`Spectral::noise_field`] looks at.
#[derive(Debug, Clone)]
pub struct SpectralScratch {
    plane: PlaneScratch,
    /// A stamp or PSF.
    image: Vec<f32>,
    /// The windowed stamp's transform.
    stamp: Vec<Complex32>,
    /// A real half spectrum on its way through the window.
    real: [Vec<f32>; 3],
    /// Where the window is, (x, y) in pixels from the middle of the stamp, and the window along both axes there.
    centre: [f32; 2],
    windows: [Vec<f32>; 2],
    /// The half spectrum of the window.
    window_modes: Vec<Complex32>,
    edges: EdgesScratch,
}

/// Autocorrelations on lags dy = 0…R, dx = −R…R, in steps of [`Spectral::spacing`]:
/// `[dy·(2R+1) + dx + R]`.
#[derive(Debug, Clone)]
pub struct Lags {
    /// Of the result.
    pub acf: Vec<f32>,
    /// Its derivative with respect to a shear γ₁ of the galaxy.
    pub shear1: Vec<f32>,
    /// Its derivative with respect to γ₂.
    pub shear2: Vec<f32>,
    /// Sum of the windowed result, and its derivatives with respect to γ₁ and γ₂.
    pub flux: [f32; 3],
}

impl Spectral {
    /// Plans for n×n stamps and p×p PSFs.
    ///
    /// # Errors
    /// Where a size is out of range.
    pub fn new(n: usize, p: usize, settings: &LinearDeconvolution) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        let sigma = settings.target_sigma;
        // Below the stamp's own Nyquist frequency, π.
        let cut = (CUT / sigma).min(3.0);
        let plane = Plane::new((n + SPREAD).max(p), cut);
        let side = plane.side;
        let waves: Vec<[f64; 2]> = (0..plane.columns())
            .flat_map(|x| (0..side).map(move |y| (x, y)))
            .map(|(x, y)| [plane.wave(x), plane.wave(y)])
            .collect();
        let target = waves.iter().map(|&[kx, ky]| {
            let square = kx * kx + ky * ky;
            (taper(square.sqrt() / cut) * (-0.5 * sigma * sigma * square).exp()) as f32
        });
        let window: Vec<f64> = (0..side)
            .map(|at| {
                let period = plane.size as f64;
                let x = at as f64 * plane.spacing() - (n as f64 - 1.0) / 2.0;
                let x = x - period * (x / period).round();
                (-0.5 * (x / settings.window_sigma).powi(2)).exp() / side as f64
            })
            .collect();
        let mut leak = window_power(&window, plane.size);
        let inside = inside(n, settings.window_sigma) as f32;
        leak.iter_mut().for_each(|power| *power *= inside);
        let reach = (REACH * settings.window_sigma / plane.lag_spacing()) as usize;
        let least = plane.wave(plane.modes);
        let scale = |&[kx, ky]: &[f64; 2]| {
            let area = (plane.size * plane.size) as f32;
            if kx.hypot(ky) <= least {
                1.0 / area
            } else {
                0.0
            }
        };
        let centre = |&[kx, ky]: &[f64; 2]| {
            let phase = (p as f64 - 1.0) / 2.0 * (kx + ky);
            Complex32::new(phase.cos() as f32, phase.sin() as f32)
        };
        Ok(Spectral {
            n,
            p,
            reach: reach.clamp(1, plane.lags / 2 - 1),
            step: settings.step as f32,
            iterations: i32::try_from(settings.max_iterations).unwrap_or(i32::MAX),
            rough: waves
                .iter()
                .map(|&[kx, ky]| (settings.lambda * high_pass(kx, ky).powi(2)) as f32)
                .collect(),
            target: target.collect(),
            waves: waves.iter().map(|k| k.map(|k| k as f32)).collect(),
            window: window.iter().map(|w| *w as f32).collect(),
            window_sigma: settings.window_sigma,
            edges: Edges::new(n, &plane),
            scale: waves.iter().map(scale).collect(),
            centre: waves.iter().map(centre).collect(),
            inside: inside * inside,
            leak,
            plane,
        })
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.n
    }

    /// Period of the plane in pixels, places of the coarse grid along an axis, and largest index of a
    /// mode.
    #[cfg(test)]
    fn grid(&self) -> (usize, usize, usize) {
        (self.plane.size, self.plane.side, self.plane.modes)
    }

    /// Largest lag, in steps of [`Spectral::spacing`].
    pub fn reach(&self) -> usize {
        self.reach
    }

    /// Pixels between lags.
    pub fn spacing(&self) -> f64 {
        self.plane.lag_spacing()
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> SpectralScratch {
        let most = self.n.max(self.p);
        SpectralScratch {
            window_modes: self.plane.spectrum(),
            plane: self.plane.scratch(most),
            image: vec![0.0; most * most],
            stamp: self.plane.spectrum(),
            real: std::array::from_fn(|_| vec![0.0; self.waves.len()]),
            centre: [0.0; 2],
            windows: [self.window.clone(), self.window.clone()],
            edges: self.edges.scratch(&self.plane),
        }
    }

    /// Puts the window at `centre`, (x, y) in pixels from the middle of the stamp, for the stamps that follow.
    /// Their shear is about this place: the window is where the galaxy is, sheared or not.
    pub fn place_window(&self, centre: [f32; 2], scratch: &mut SpectralScratch) {
        for (k, window) in scratch.windows.iter_mut().enumerate() {
            if scratch.centre[k] == centre[k] {
                continue;
            }
            scratch.centre[k] = centre[k];
            if centre[k] == 0.0 {
                window.copy_from_slice(&self.window);
                continue;
            }
            let (middle, period) = ((self.n as f32 - 1.0) / 2.0, self.plane.size as f32);
            let (spacing, side) = (self.plane.spacing() as f32, self.plane.side as f32);
            let sigma = self.window_sigma as f32;
            for (at, value) in window.iter_mut().enumerate() {
                let x = at as f32 * spacing - middle - centre[k];
                let x = (x - period * (x / period).round()) / sigma;
                *value = (-0.5 * x * x).exp() / side;
            }
        }
    }

    /// A PSF of zeros.
    pub fn psf(&self) -> SpectralPsf {
        let modes = self.waves.len();
        SpectralPsf {
            restore: vec![Complex32::ZERO; modes],
            field: vec![Complex32::ZERO; modes],
            field_tilts: vec![[0.0; 2]; modes],
            turned: vec![0.0; modes],
            floor: vec![0.0; modes],
            clarity: vec![0.0; modes],
            tilts: vec![[Complex32::ZERO; 2]; modes],
            noise_tilts: vec![[0.0; 2]; modes],
            powers: std::array::from_fn(|_| vec![0.0; modes]),
        }
    }

    /// Noise of level one with the correlation of `noise`.
    pub fn noise(&self, noise: &StampNoise) -> ModeNoise {
        let modes = self.waves.iter().map(|k| {
            let (power, slopes) = noise.power(k.map(f64::from));
            (
                power as f32,
                slopes.map(|slope| (0.5 * slope / power) as f32),
            )
        });
        let (power, tilts) = modes.unzip();
        ModeNoise { power, tilts }
    }

    /// |g|² of each mode of a half spectrum over the plane's area in px², of a round Gaussian galaxy of flux one with a
    /// mean square of `extent` px² per axis; twice where the mode stands for its opposite too. The sum of this times |p|²
    /// is that of the squared pixels of the galaxy behind p.
    pub fn light(&self, extent: f64) -> Vec<f32> {
        let area = (self.plane.size * self.plane.size) as f64;
        let modes = self.waves.iter().enumerate();
        modes
            .map(|(at, k)| {
                // Columns with k_x > 0 stand for those with k_x < 0 too.
                let twice = if at < self.plane.side { 1.0 } else { 2.0 };
                let square = k.iter().map(|&k| f64::from(k).powi(2)).sum::<f64>();
                (twice / area * (-square * extent).exp()) as f32
            })
            .collect()
    }

    /// Room for the lags.
    pub fn lags(&self) -> Lags {
        let lags = vec![0.0; (self.reach + 1) * (2 * self.reach + 1)];
        Lags {
            acf: lags.clone(),
            shear1: lags.clone(),
            shear2: lags,
            flux: [0.0; 3],
        }
    }

    /// Takes a PSF, for images with `noise`; it is used as it is, so it should sum to one and be centred on the middle of its
    /// stamp, (p − 1)/2 on both axes: the window is where the galaxy is left by deconvolution.
    ///
    /// # Errors
    /// Where its size is not the planned one or a pixel is not finite.
    pub fn set_psf(
        &self,
        psf: ArrayView2<'_, f64>,
        noise: &ModeNoise,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) -> Result<(), MeasureError> {
        let side = psf.nrows();
        // Zero around a smaller one.
        let fits = side < self.p && (self.p - side).is_multiple_of(2);
        check_psf(psf, if fits { side } else { self.p })?;
        let first = (self.p - side) / 2;
        let SpectralScratch {
            plane, image, real, ..
        } = scratch;
        let image = &mut image[..self.p * self.p];
        image.fill(0.0);
        let rows = image.chunks_exact_mut(self.p).skip(first);
        for (row, from) in rows.zip(psf.rows()) {
            for (out, value) in row[first..].iter_mut().zip(from) {
                *out = *value as f32;
            }
        }
        self.plane.transform(image, self.p, plane);
        let [u, x, y] = &plane.half;
        for at in 0..self.waves.len() {
            let power = u[at].norm_sqr();
            out.clarity[at] = power / noise.power[at];
            let centred = u[at] * self.centre[at];
            out.restore[at] = centred.conj() * self.amplitude(at, power);
            out.tilts[at] = if power < LEAST_POWER {
                [Complex32::ZERO; 2]
            } else {
                sheared(x[at], y[at], self.waves[at]).map(|change| change * u[at].conj() / power)
            };
        }
        let [tilt, along, smooth] = real;
        for (at, value) in tilt.iter_mut().enumerate() {
            out.field[at] = out.restore[at] * noise.power[at].sqrt();
            let tilts = [0, 1].map(|k| noise.tilts[at][k] - out.tilts[at][k].re);
            out.field_tilts[at] = tilts;
            *value = out.field[at].norm_sqr();
        }
        for (at, value) in out.turned.iter_mut().enumerate() {
            let power = tilt[at];
            *value = if power > 0.0 {
                (tilt[self.plane.turned(at)] / power).sqrt() - 1.0
            } else {
                0.0
            };
        }
        spread(self.plane.side, &self.leak, tilt, along, &mut out.floor);
        let area = (self.plane.size * self.plane.size) as f32 * self.inside;
        for at in 0..tilt.len() {
            // Columns with k_x > 0 stand for those with k_x < 0 too.
            let twice = if at < self.plane.side { 1.0 } else { 2.0 };
            let power = twice * area * tilt[at];
            let [first, second] = out.field_tilts[at];
            for (powers, kind) in out.powers.iter_mut().zip([first, second, out.turned[at]]) {
                powers[at] = power * kind;
            }
        }
        for component in 0..2 {
            let modes = out.field_tilts.iter().zip(&out.field);
            for (value, (tilts, field)) in tilt.iter_mut().zip(modes) {
                *value = -tilts[component] * field.norm_sqr();
            }
            spread(self.plane.side, &self.leak, tilt, along, smooth);
            for (out, value) in out.noise_tilts.iter_mut().zip(&*smooth) {
                out[component] = *value;
            }
        }
        Ok(())
    }

    /// Γ[1 − (1 − c w)^M]/w of a mode with |p|² = `power`; zero where the PSF leaves nothing.
    fn amplitude(&self, at: usize, power: f32) -> f32 {
        let w = power + self.rough[at];
        // Without signal a mode is noise alone, whatever λ makes of it.
        if power < LEAST_POWER || self.target[at] == 0.0 {
            return 0.0;
        }
        let left = f64::from(1.0 - self.step * w);
        // A positive one below exp(−40) is nothing in single precision.
        let left = if left > 0.0 && (1.0 - left) * f64::from(self.iterations) > 40.0 {
            0.0
        } else {
            left.powi(self.iterations)
        };
        self.target[at] * (1.0 - left) as f32 / w
    }

    /// Deconvolves a row-major `stamp` with noise of level `noise` and writes the
    /// autocorrelation with its derivatives.
    pub fn autocorrelate(
        &self,
        psf: &SpectralPsf,
        stamp: &[f32],
        noise: f32,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        self.deconvolve(psf, stamp, scratch);
        let plane = &mut scratch.plane;
        let [u, x, y] = &mut plane.half;
        scratch.stamp.copy_from_slice(u);
        out.flux = [u[0].re, x[0].re, y[0].re];
        correlate([u, x, y], &self.scale, psf, noise * noise);
        self.lags_of(plane, out);
    }

    /// v̂ of a stamp and its changes with the components of shear, windowed, to `plane.half`.
    fn deconvolve(&self, psf: &SpectralPsf, stamp: &[f32], scratch: &mut SpectralScratch) {
        let SpectralScratch {
            plane,
            centre,
            windows: [across, down],
            edges: at_edges,
            ..
        } = scratch;
        self.plane.transform(stamp, self.n, plane);
        let [u, x, y] = &mut plane.half;
        restore([u, x, y], *centre, &self.waves, psf);
        if self.sees_edges(*centre) {
            self.edges
                .take(stamp, *centre, &self.plane, plane, at_edges);
            let [_, x, y] = &mut plane.half;
            self.edges.add(at_edges, &psf.restore, x, y);
        }
        self.plane.window(across, down, plane);
    }

    /// Whether a window at `centre` sees light at the edges.
    fn sees_edges(&self, centre: [f32; 2]) -> bool {
        let off = centre.into_iter().map(f32::abs).fold(0.0, f32::max);
        let away = (self.n as f64 / 2.0 - f64::from(off)) / self.window_sigma;
        (-0.5 * away * away).exp() > LIT
    }

    /// Writes how the autocorrelation of the stamp last given changes with a field of noise of σ = 1
    /// that is added to it, and with what a shear makes of that field: in `acf` the one, in `shear1` and
    /// `shear2` the other.
    ///
    /// Of the change of noise under shear only the symmetric part is taken, −Re(tilt) of each mode (and what
    /// the slope of its own power adds): of
    /// the rest, which moves pixels about, the mean is zero. Modes have random signs.
    pub fn noise_field(
        &self,
        psf: &SpectralPsf,
        seed: u64,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        self.field_of(seed, scratch, out, |at, sign| {
            let field = sign * psf.field[at];
            let [first, second] = psf.field_tilts[at];
            [field, field * first, field * second]
        });
    }

    /// Writes to `acf` how the autocorrelation of the stamp last given would change further, were the PSF behind the field
    /// of noise of [`Spectral::noise_field`] turned by 90 degrees.
    pub fn turned_field(
        &self,
        psf: &SpectralPsf,
        seed: u64,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        self.field_of(seed, scratch, out, |at, sign| {
            let lack = sign * (psf.field[at] * psf.turned[at]);
            [lack, Complex32::ZERO, Complex32::ZERO]
        });
    }

    /// Writes how the autocorrelation of the stamp last given changes with three changes of v̂, before the window: what
    /// `modes` makes of each mode of a field of noise.
    fn field_of(
        &self,
        seed: u64,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
        modes: impl Fn(usize, Complex32) -> [Complex32; 3],
    ) {
        let SpectralScratch {
            plane,
            stamp,
            windows: [across, down],
            ..
        } = scratch;
        self.signs(seed, &mut plane.half[0]);
        let [u, x, y] = &mut plane.half;
        for (at, value) in u.iter_mut().enumerate() {
            [*value, x[at], y[at]] = modes(at, *value);
        }
        self.plane.window(across, down, plane);
        self.changes(stamp, plane, out);
    }

    /// Writes how the autocorrelation of v̂ changes with each of the three changes of v̂ in `plane.half`.
    fn changes(&self, v: &[Complex32], plane: &mut PlaneScratch, out: &mut Lags) {
        let [u, x, y] = &mut plane.half;
        for (at, u) in u.iter_mut().enumerate() {
            let (value, scale) = (v[at], self.scale[at]);
            let along =
                |change: Complex32| 2.0 * scale * (value.re * change.re + value.im * change.im);
            *u = Complex32::new(along(*u), along(x[at]));
            x[at] = Complex32::new(along(y[at]), 0.0);
        }
        self.lags_of(plane, out);
    }

    /// The half spectrum of a real field with the power of white noise of σ = 1 in each mode and random
    /// signs of real and imaginary parts.
    fn signs(&self, seed: u64, out: &mut [Complex32]) {
        let side = self.plane.side;
        let size = self.plane.size as f32 * std::f32::consts::FRAC_1_SQRT_2;
        let mut state = seed;
        for line in out.chunks_exact_mut(side) {
            // The next number of the SplitMix64 sequence; two bits for each mode.
            let mut bits = [0u64; 2];
            for (at, value) in line.iter_mut().enumerate() {
                if at % 64 == 0 {
                    bits = [(); 2].map(|()| split_mix(&mut state));
                }
                let sign = |bits: u64| {
                    if bits >> (at % 64) & 1 == 0 {
                        size
                    } else {
                        -size
                    }
                };
                *value = Complex32::new(sign(bits[0]), sign(bits[1]));
            }
            line[side / 2] = Complex32::ZERO;
        }
        // The column k_x = 0 is that of a real field.
        for at in 1..side / 2 {
            out[side - at] = out[at].conj();
        }
        out[0] = Complex32::new(out[0].re * std::f32::consts::SQRT_2, 0.0);
    }

    /// Takes the lags of real even spectra: the first, plus i times the second, and the third.
    fn lags_of(&self, plane: &mut PlaneScratch, out: &mut Lags) {
        let Lags {
            acf,
            shear1,
            shear2,
            ..
        } = out;
        self.plane.lags(0, self.reach, plane, |at, value| {
            (acf[at], shear1[at]) = (value.re, value.im);
        });
        self.plane
            .lags(1, self.reach, plane, |at, value| shear2[at] = value.re);
    }

    /// The deconvolved stamp itself, convolved with Γ and windowed, for pictures.
    pub fn deconvolved(&self, psf: ArrayView2<'_, f64>, stamp: &[f32]) -> Vec<f32> {
        let plan = StampFft::new(self.plane.size);
        let (mut u, mut h, mut fft) = (plan.spectrum(), plan.spectrum(), plan.scratch());
        let rows = psf.rows().into_iter();
        let rows = rows.map(|row| row.into_iter().map(|&v| v as f32));
        plan.rows(rows, &mut fft, &mut h);
        plan.columns(&mut fft, &mut h);
        let rows = stamp.chunks_exact(self.n);
        plan.rows(rows.map(|row| row.iter().copied()), &mut fft, &mut u);
        plan.columns(&mut fft, &mut u);
        let centre = (psf.nrows() / 2) as f32;
        let (size, side) = (self.plane.size, self.plane.side);
        for (at, u) in u.iter_mut().enumerate() {
            let (x, y) = (at / size, at % size);
            let modes = self.plane.modes;
            if x > modes || (y > modes && y + modes < size) {
                *u = Complex32::ZERO;
                continue;
            }
            let mode = x * side + if y > modes { y + side - size } else { y };
            let [kx, ky] = self.waves[mode];
            // The PSF's transform about the pixel that a convolution takes for its centre.
            let p = h[at] * Complex32::from_polar(1.0, centre * (kx + ky));
            *u *= p.conj() * (self.amplitude(mode, p.norm_sqr()) / (size * size) as f32);
        }
        plan.columns_back(&mut fft, &mut u);
        let window = |at: usize| {
            let x = (at as f64 - (self.n as f64 - 1.0) / 2.0) / self.window_sigma;
            (-0.5 * x * x).exp() as f32
        };
        let mut image = Vec::with_capacity(self.n * self.n);
        for y in 0..self.n {
            let row = &plan.row_back(&u, y, &mut fft)[..self.n];
            image.extend(
                row.iter()
                    .enumerate()
                    .map(|(x, v)| v * window(x) * window(y)),
            );
        }
        image
    }
}

/// Fall of Γ towards its largest wave number, at 1: a quarter of a cosine, squared.
fn taper(k: f64) -> f64 {
    /// Share of the largest wave number at which the taper of Γ begins. See docs/constants.md.
    const FROM: f64 = 0.75;
    if k >= 1.0 {
        // The cosine would be 10⁻¹⁶, which makes modes of denormal numbers, and these take long.
        return 0.0;
    }
    let place = ((k - FROM) / (1.0 - FROM)).max(0.0);
    (std::f64::consts::FRAC_PI_2 * place).cos().powi(2)
}

/// Share of a squared window along an axis that n pixels hold: beyond is no noise.
fn inside(n: usize, sigma: f64) -> f64 {
    let share = |from: i32, to: i32| {
        let middle = (n as f64 - 1.0) / 2.0;
        let squares = (from..to).map(|at| (-((f64::from(at) - middle) / sigma).powi(2)).exp());
        squares.sum::<f64>()
    };
    let side = n as i32;
    share(0, side) / share(-side, 2 * side)
}

/// Power of the transform of a window along an axis, times the period, at frequencies 0, 1, …: as many
/// as hold all but a millionth.
fn window_power(window: &[f64], period: usize) -> Vec<f32> {
    let side = window.len();
    let power = |mode: usize| {
        let (mut re, mut im) = (0.0, 0.0);
        for (at, w) in window.iter().enumerate() {
            let phase = std::f64::consts::TAU * ((mode * at) % side) as f64 / side as f64;
            re += w * phase.cos();
            im += w * phase.sin();
        }
        (re * re + im * im) * period as f64
    };
    let powers: Vec<f64> = (0..side / 2).map(power).collect();
    let beyond = |count: usize| 2.0 * powers[count..].iter().sum::<f64>();
    let least = 1e-6 * (powers[0] + beyond(1));
    let enough = (1..powers.len()).find(|&count| beyond(count) < least);
    let kept = &powers[..enough.unwrap_or(powers.len())];
    kept.iter().map(|&power| power as f32).collect()
}

/// The next number of the SplitMix64 sequence.
fn split_mix(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// What a real even half spectrum becomes when each mode's power leaks into its neighbours, `leak`
/// frequencies away along each axis of the torus of the coarse grid of `side` places. `along` is room
/// for as many values.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn spread(side: usize, leak: &[f32], spectrum: &[f32], along: &mut [f32], out: &mut [f32]) {
    let lines = spectrum.chunks_exact(side);
    for (line, to) in lines.zip(along.chunks_exact_mut(side)) {
        scaled(to, line, leak[0]);
        for (distance, &share) in leak.iter().enumerate().skip(1) {
            let (head, tail) = line.split_at(distance);
            add_scaled(&mut to[..side - distance], tail, share);
            add_scaled(&mut to[side - distance..], head, share);
            let (head, tail) = line.split_at(side - distance);
            add_scaled(&mut to[distance..], head, share);
            add_scaled(&mut to[..distance], tail, share);
        }
    }
    let columns = along.len() / side;
    for (x, to) in out.chunks_exact_mut(side).enumerate() {
        scaled(to, &along[x * side..][..side], leak[0]);
        for (distance, &share) in leak.iter().enumerate().skip(1) {
            for from in [x + distance, x + side - distance].map(|x| x % side) {
                if from < columns {
                    add_scaled(to, &along[from * side..][..side], share);
                } else if side - from < columns {
                    // A column of negative k_x: what that of −k_x holds at −k_y.
                    let line = &along[(side - from) * side..][..side];
                    to[0] += share * line[0];
                    for (to, value) in to[1..].iter_mut().zip(line[1..].iter().rev()) {
                        *to += share * value;
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn scaled(to: &mut [f32], from: &[f32], share: f32) {
    for (to, value) in to.iter_mut().zip(from) {
        *to = share * value;
    }
}

#[inline(always)]
fn add_scaled(to: &mut [f32], from: &[f32], share: f32) {
    for (to, value) in to.iter_mut().zip(from) {
        *to += share * value;
    }
}

#[cfg(test)]
mod tests;
