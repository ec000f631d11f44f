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
//! convolved with a round Gaussian Γ, so that no mode enters that the PSF has destroyed, and what
//! remains of the PSF is round. Its autocorrelation has the spectrum Γ²[…]²|p|²/w²·|û|². White noise
//! of level σ adds n²σ² to the mean of |û|², which is subtracted.
//!
//! # Response to shear
//!
//! A shear γ₁ of the galaxy (before the PSF) changes its transform s = û/p by
//! (k_x ∂_x − k_y ∂_y)s, γ₂ by (k_y ∂_x + k_x ∂_y)s (∂ with respect to k). ∂û is the transform of
//! −i·x times the stamp, so that the change of the autocorrelation with shear follows from the stamp
//! itself: metacalibration (Huff & Mandelbaum 2017) in the limit of a small shear.

use ndarray::ArrayView2;
use rustfft::num_complex::Complex32;
use shearq_submissions::Deconvolution;

use super::operator::{MAX_PSF, MAX_STAMP, OperatorError, SUN_KERNEL};
use crate::fft::{FftScratch, StampFft};

/// Pixels by which the deconvolved stamp may spread beyond the stamp before it wraps around.
const SPREAD: usize = 8;
/// Modes with w below this are left out: they are noise alone.
const LEAST_WEIGHT: f64 = 1e-7;

/// The linear network for one stamp size.
#[derive(Clone)]
pub struct Spectral {
    n: usize,
    p: usize,
    reach: usize,
    step: f64,
    iterations: i32,
    lambda: f64,
    target: f64,
    fft: StampFft,
    /// k_x of each column and k_y of each place in it, in radians per pixel.
    k: Vec<f32>,
}

/// A PSF as the linear network uses it.
#[derive(Debug, Clone)]
pub struct SpectralPsf {
    /// Factor from |û|² to the power of the result; with the inverse transform's scale in it.
    gain: Vec<f32>,
    /// Re[(k_x ∂_x − k_y ∂_y)p / p].
    tilt1: Vec<f32>,
    /// Re[(k_y ∂_x + k_x ∂_y)p / p].
    tilt2: Vec<f32>,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct SpectralScratch {
    u: Vec<Complex32>,
    x: Vec<Complex32>,
    y: Vec<Complex32>,
    fft: FftScratch,
}

/// Autocorrelations on lags dy = 0…R, dx = −R…R: `[dy·(2R+1) + dx + R]`.
#[derive(Debug, Clone)]
pub struct Lags {
    /// Of the result.
    pub acf: Vec<f32>,
    /// Its derivative with respect to a shear γ₁ of the galaxy.
    pub shear1: Vec<f32>,
    /// Its derivative with respect to γ₂.
    pub shear2: Vec<f32>,
}

impl Spectral {
    /// Plans for n×n stamps, p×p PSFs and autocorrelations up to lags of `reach` pixels.
    ///
    /// # Errors
    /// Where a size is out of range.
    pub fn new(
        n: usize,
        p: usize,
        reach: usize,
        settings: &Deconvolution,
    ) -> Result<Self, OperatorError> {
        if !(3..=MAX_STAMP).contains(&n) {
            return Err(OperatorError::StampSize { found: n });
        }
        if !(2..=MAX_PSF).contains(&p) {
            return Err(OperatorError::PsfSize {
                rows: p,
                columns: p,
            });
        }
        let fft = StampFft::new((n + reach + SPREAD).max(p).max(2 * reach + 1));
        let size = fft.size as i32;
        let k = (0..size)
            .map(|i| {
                let signed = if 2 * i > size { i - size } else { i };
                (std::f64::consts::TAU * f64::from(signed) / f64::from(size)) as f32
            })
            .collect();
        Ok(Spectral {
            n,
            p,
            reach,
            step: settings.step,
            iterations: i32::try_from(settings.max_iterations).unwrap_or(i32::MAX),
            lambda: settings.lambda,
            target: settings.target_sigma,
            fft,
            k,
        })
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.n
    }

    /// Largest lag.
    pub fn reach(&self) -> usize {
        self.reach
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> SpectralScratch {
        SpectralScratch {
            u: self.fft.spectrum(),
            x: self.fft.spectrum(),
            y: self.fft.spectrum(),
            fft: self.fft.scratch(),
        }
    }

    /// A PSF of zeros.
    pub fn psf(&self) -> SpectralPsf {
        let modes = vec![0.0; self.fft.half() * self.fft.size];
        SpectralPsf {
            gain: modes.clone(),
            tilt1: modes.clone(),
            tilt2: modes,
        }
    }

    /// Room for the lags.
    pub fn lags(&self) -> Lags {
        let lags = vec![0.0; (self.reach + 1) * (2 * self.reach + 1)];
        Lags {
            acf: lags.clone(),
            shear1: lags.clone(),
            shear2: lags,
        }
    }

    /// Takes a PSF; it is used as it is, so it should sum to one. Where it is centred is of no
    /// matter.
    ///
    /// # Errors
    /// Where its size is not the planned one or a pixel is not finite.
    pub fn set_psf(
        &self,
        psf: ArrayView2<'_, f64>,
        scratch: &mut SpectralScratch,
        out: &mut SpectralPsf,
    ) -> Result<(), OperatorError> {
        if psf.dim() != (self.p, self.p) {
            return Err(OperatorError::PsfSize {
                rows: psf.nrows(),
                columns: psf.ncols(),
            });
        }
        if let Some(((y, x), _)) = psf.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(OperatorError::PsfNotFinite { x: x + 1, y: y + 1 });
        }
        let rows = psf.rows().into_iter();
        let rows = rows.map(|row| row.into_iter().map(|&v| v as f32));
        self.transforms(rows, self.p, scratch);
        let size = self.fft.size;
        let scale = 1.0 / (size * size) as f64;
        for at in 0..out.gain.len() {
            let (kx, ky) = (self.k[at / size], self.k[at % size]);
            let p = scratch.u[at];
            let power = f64::from(p.norm_sqr());
            let d = self.high_pass(kx, ky);
            let w = power + self.lambda * d * d;
            if w < LEAST_WEIGHT {
                (out.gain[at], out.tilt1[at], out.tilt2[at]) = (0.0, 0.0, 0.0);
                continue;
            }
            let reached = 1.0 - (1.0 - self.step * w).powi(self.iterations);
            let square = f64::from(kx * kx + ky * ky);
            let gamma = (-0.5 * self.target * self.target * square).exp();
            let amplitude = gamma * reached / w;
            out.gain[at] = (amplitude * amplitude * power * scale) as f32;
            // Re(∂p/p) = Im(conj(p)·x̂)/|p|², for ∂p = −i·x̂.
            let gx = (p.conj() * scratch.x[at]).im / p.norm_sqr();
            let gy = (p.conj() * scratch.y[at]).im / p.norm_sqr();
            out.tilt1[at] = kx * gx - ky * gy;
            out.tilt2[at] = ky * gx + kx * gy;
        }
        Ok(())
    }

    /// Transform of Sun's kernel, which is real.
    fn high_pass(&self, kx: f32, ky: f32) -> f64 {
        let (cx, cy) = (f64::from(kx).cos(), f64::from(ky).cos());
        SUN_KERNEL[1][1]
            + 2.0 * SUN_KERNEL[1][0] * cx
            + 2.0 * SUN_KERNEL[0][1] * cy
            + 4.0 * SUN_KERNEL[0][0] * cx * cy
    }

    /// Transforms of an image of side `side`, and of it times x and y from its middle.
    fn transforms(
        &self,
        rows: impl Iterator<Item = impl Iterator<Item = f32>> + Clone,
        side: usize,
        scratch: &mut SpectralScratch,
    ) {
        let SpectralScratch { u, x, y, fft } = scratch;
        let middle = (side as f32 - 1.0) / 2.0;
        let along = rows
            .clone()
            .map(|row| row.enumerate().map(|(i, v)| v * (i as f32 - middle)));
        self.fft.rows(along, fft, x);
        self.fft.rows(rows, fft, u);
        let columns = u
            .chunks_exact(self.fft.size)
            .zip(y.chunks_exact_mut(self.fft.size));
        for (from, to) in columns {
            for (j, (value, out)) in from.iter().zip(to).enumerate() {
                *out = value * (j as f32 - middle);
            }
        }
        self.fft.columns(fft, u);
        self.fft.columns(fft, x);
        self.fft.columns(fft, y);
    }

    /// Deconvolves the row-major n×n `stamp` with white noise of level `noise` and writes the
    /// autocorrelation, with its derivatives if `response`.
    pub fn autocorrelate(
        &self,
        psf: &SpectralPsf,
        stamp: &[f32],
        noise: f32,
        response: bool,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        let rows = stamp.chunks_exact(self.n).map(|row| row.iter().copied());
        if response {
            self.transforms(rows, self.n, scratch);
        } else {
            self.fft.rows(rows, &mut scratch.fft, &mut scratch.u);
            self.fft.columns(&mut scratch.fft, &mut scratch.u);
        }
        let floor = noise * noise * (self.n * self.n) as f32;
        let size = self.fft.size;
        for (i, &kx) in self.k[..self.fft.half()].iter().enumerate() {
            let column = i * size..(i + 1) * size;
            let u = &mut scratch.u[column.clone()];
            let gain = &psf.gain[column.clone()];
            if !response {
                for (u, &gain) in u.iter_mut().zip(gain) {
                    *u = Complex32::new(gain * (u.norm_sqr() - floor), 0.0);
                }
                continue;
            }
            let x = &mut scratch.x[column.clone()];
            let y = &mut scratch.y[column.clone()];
            let (tilt1, tilt2) = (&psf.tilt1[column.clone()], &psf.tilt2[column]);
            for j in 0..size {
                let ky = self.k[j];
                let value = u[j];
                let power = value.norm_sqr() - floor;
                // Re(conj(û)·∂û); the noise adds nothing to its mean.
                let gx = value.re * x[j].im - value.im * x[j].re;
                let gy = value.re * y[j].im - value.im * y[j].re;
                let first = kx * gx - ky * gy - power * tilt1[j];
                let second = ky * gx + kx * gy - power * tilt2[j];
                u[j] = Complex32::new(gain[j] * power, 0.0);
                x[j] = Complex32::new(2.0 * gain[j] * first, 0.0);
                y[j] = Complex32::new(2.0 * gain[j] * second, 0.0);
            }
        }
        let SpectralScratch { u, x, y, fft } = scratch;
        self.back(u, fft, &mut out.acf);
        if response {
            self.back(x, fft, &mut out.shear1);
            self.back(y, fft, &mut out.shear2);
        }
    }

    /// Transforms a real spectrum back and takes the lags.
    fn back(&self, spectrum: &mut [Complex32], fft: &mut FftScratch, out: &mut [f32]) {
        let reach = self.reach;
        self.fft.columns_back(fft, spectrum);
        for (dy, lags) in out.chunks_exact_mut(2 * reach + 1).enumerate() {
            let line = self.fft.row_back(spectrum, dy, fft);
            lags[..reach].copy_from_slice(&line[self.fft.size - reach..]);
            lags[reach..].copy_from_slice(&line[..=reach]);
        }
    }

    /// The deconvolved stamp itself, convolved with Γ, for pictures.
    pub fn deconvolved(
        &self,
        psf: ArrayView2<'_, f64>,
        stamp: &[f32],
        scratch: &mut SpectralScratch,
    ) -> Vec<f32> {
        let size = self.fft.size;
        let rows = psf.rows().into_iter();
        let rows = rows.map(|row| row.into_iter().map(|&v| v as f32));
        self.fft.rows(rows, &mut scratch.fft, &mut scratch.x);
        self.fft.columns(&mut scratch.fft, &mut scratch.x);
        let rows = stamp.chunks_exact(self.n).map(|row| row.iter().copied());
        self.fft.rows(rows, &mut scratch.fft, &mut scratch.u);
        self.fft.columns(&mut scratch.fft, &mut scratch.u);
        let centre = (self.p / 2) as f32;
        for (at, u) in scratch.u.iter_mut().enumerate() {
            let (kx, ky) = (self.k[at / size], self.k[at % size]);
            // The PSF's transform about its central pixel.
            let p = scratch.x[at] * Complex32::from_polar(1.0, centre * (kx + ky));
            let d = self.high_pass(kx, ky);
            let w = f64::from(p.norm_sqr()) + self.lambda * d * d;
            let square = f64::from(kx * kx + ky * ky);
            let gamma = (-0.5 * self.target * self.target * square).exp();
            let factor = if w < LEAST_WEIGHT {
                0.0
            } else {
                gamma * (1.0 - (1.0 - self.step * w).powi(self.iterations)) / w
            };
            *u *= p.conj() * (factor / (size * size) as f64) as f32;
        }
        self.fft.columns_back(&mut scratch.fft, &mut scratch.u);
        (0..self.n)
            .flat_map(|y| self.fft.row_back(&scratch.u, y, &mut scratch.fft)[..self.n].to_vec())
            .collect()
    }
}
