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
//! The stamp that is measured is cut from a larger one; a shear moves the galaxy and not the edges of
//! the cut, so that the change is worked out on the full stamp and then cut.

use ndarray::ArrayView2;
use rustfft::num_complex::Complex32;
use shearq_submissions::Deconvolution;

use super::operator::{MAX_PSF, MAX_STAMP, OperatorError, SUN_KERNEL};
use crate::fft::{FftScratch, StampFft};

/// Pixels by which the deconvolved stamp may spread beyond the stamp before it wraps around.
const SPREAD: usize = 8;
/// Modes with |p|² below this are left out: they are noise alone.
const LEAST_POWER: f32 = 1e-7;

/// The linear network for one stamp size.
#[derive(Clone)]
pub struct Spectral {
    n: usize,
    full: usize,
    p: usize,
    reach: usize,
    step: f32,
    iterations: i32,
    /// λ d² of each mode.
    rough: Vec<f32>,
    /// Γ of each mode.
    target: Vec<f32>,
    fft: StampFft,
    /// For full stamps.
    full_fft: StampFft,
    /// As `k`, for full stamps.
    full_k: Vec<f32>,
    /// k_x of each column and k_y of each place in it, in radians per pixel.
    k: Vec<f32>,
}

/// A PSF as the linear network uses it.
#[derive(Debug, Clone)]
pub struct SpectralPsf {
    /// Factor from |û|² to the power of the result; with the inverse transform's scale in it.
    gain: Vec<f32>,
    /// (k_x ∂_x − k_y ∂_y)p/p and (k_y ∂_x + k_x ∂_y)p/p on full stamps.
    tilts: Vec<[Complex32; 2]>,
    /// Real parts of the same as white noise on the cut stamp sees them on average: smoothed by the
    /// transform of the cut.
    noise_tilts: Vec<[f32; 2]>,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct SpectralScratch {
    u: Vec<Complex32>,
    x: Vec<Complex32>,
    y: Vec<Complex32>,
    fft: FftScratch,
    full: [Vec<Complex32>; 3],
    full_fft: FftScratch,
    /// Derivatives of the cut stamp with shear.
    changes: [Vec<f32>; 2],
    /// A kernel on the cut's plane.
    kernel: Vec<f32>,
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
    /// Plans for n×n cuts of full stamps of `full` pixels, p×p PSFs and autocorrelations up to lags of
    /// `reach` pixels.
    ///
    /// # Errors
    /// Where a size is out of range.
    pub fn new(
        n: usize,
        full: usize,
        p: usize,
        reach: usize,
        settings: &Deconvolution,
    ) -> Result<Self, OperatorError> {
        if !(3..=MAX_STAMP.min(full)).contains(&n) {
            return Err(OperatorError::StampSize { found: n });
        }
        if !(2..=MAX_PSF).contains(&p) {
            return Err(OperatorError::PsfSize {
                rows: p,
                columns: p,
            });
        }
        let fft = StampFft::new((n + reach + SPREAD).max(p).max(2 * reach + 1));
        let full_fft = StampFft::new((full + SPREAD).max(p));
        let k = frequencies(fft.size);
        let modes = || {
            let columns = k[..fft.half()].iter();
            columns.flat_map(|&kx| k.iter().map(move |&ky| (kx, ky)))
        };
        Ok(Spectral {
            n,
            full,
            p,
            reach,
            step: settings.step as f32,
            iterations: i32::try_from(settings.max_iterations).unwrap_or(i32::MAX),
            rough: modes()
                .map(|(kx, ky)| (settings.lambda * high_pass(kx, ky).powi(2)) as f32)
                .collect(),
            target: modes()
                .map(|(kx, ky)| {
                    let exponent = settings.target_sigma.powi(2) * (kx * kx + ky * ky);
                    (-0.5 * exponent).exp() as f32
                })
                .collect(),
            k: k.iter().map(|&k| k as f32).collect(),
            fft,
            full_k: frequencies(full_fft.size)
                .iter()
                .map(|&k| k as f32)
                .collect(),
            full_fft,
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
            full: std::array::from_fn(|_| self.full_fft.spectrum()),
            full_fft: self.full_fft.scratch(),
            changes: std::array::from_fn(|_| vec![0.0; self.n * self.n]),
            kernel: vec![0.0; self.fft.size * self.fft.size],
        }
    }

    /// A PSF of zeros.
    pub fn psf(&self) -> SpectralPsf {
        let modes = vec![0.0; self.fft.half() * self.fft.size];
        SpectralPsf {
            noise_tilts: vec![[0.0; 2]; modes.len()],
            gain: modes,
            tilts: vec![[Complex32::ZERO; 2]; self.full_fft.half() * self.full_fft.size],
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
        let rows = || {
            let rows = psf.rows().into_iter();
            rows.map(|row| row.into_iter().map(|&v| v as f32))
        };
        let SpectralScratch { u, fft, .. } = scratch;
        self.fft.rows(rows(), fft, u);
        self.fft.columns(fft, u);
        let scale = 1.0 / (self.fft.size * self.fft.size) as f32;
        for (at, (gain, p)) in out.gain.iter_mut().zip(&*u).enumerate() {
            let power = p.norm_sqr();
            let amplitude = self.amplitude(at, power);
            *gain = amplitude * amplitude * power * scale;
        }
        let [u, x, y] = &mut scratch.full;
        let fft = &mut scratch.full_fft;
        transforms(
            &self.full_fft,
            rows(),
            self.p,
            fft,
            [&mut *u, &mut *x, &mut *y],
        );
        let size = self.full_fft.size;
        for (at, tilt) in out.tilts.iter_mut().enumerate() {
            let (kx, ky) = (self.full_k[at / size], self.full_k[at % size]);
            *tilt = if u[at].norm_sqr() < LEAST_POWER {
                [Complex32::ZERO; 2]
            } else {
                sheared(x[at], y[at], kx, ky).map(|change| change / u[at])
            };
        }
        for component in 0..2 {
            self.smooth_tilt(component, scratch, out);
        }
        Ok(())
    }

    /// Works out the noise's tilt of a component: noise on the cut, correlated with itself through the
    /// tilt's kernel, meets only the pairs of pixels that the cut holds.
    fn smooth_tilt(&self, component: usize, scratch: &mut SpectralScratch, out: &mut SpectralPsf) {
        let spectrum = &mut scratch.full[0];
        for (value, tilt) in spectrum.iter_mut().zip(&out.tilts) {
            *value = tilt[component];
        }
        let fft = &mut scratch.full_fft;
        self.full_fft.columns_back(fft, spectrum);
        let (full, size) = (self.full_fft.size, self.fft.size);
        // Pairs that lie farther apart see nothing of the kernel.
        let far = (full.min(size) / 2 - 1).min(self.n - 1);
        let area = (full * full * self.n * self.n) as f32;
        let pairs = |d: usize| (self.n - d) as f32;
        scratch.kernel.fill(0.0);
        for y in -(far as isize)..=far as isize {
            let from = y.rem_euclid(full as isize) as usize;
            let to = y.rem_euclid(size as isize) as usize;
            let line = self.full_fft.row_back(spectrum, from, fft);
            let row = &mut scratch.kernel[to * size..][..size];
            let share = pairs(y.unsigned_abs()) / area;
            for x in 0..=far {
                row[x] = line[x] * pairs(x) * share;
            }
            for x in 1..=far {
                row[size - x] = line[full - x] * pairs(x) * share;
            }
        }
        let rows = scratch.kernel.chunks_exact(size);
        let rows = rows.map(|row| row.iter().copied());
        self.fft.rows(rows, &mut scratch.fft, &mut scratch.u);
        self.fft.columns(&mut scratch.fft, &mut scratch.u);
        for (tilt, value) in out.noise_tilts.iter_mut().zip(&scratch.u) {
            tilt[component] = value.re;
        }
    }

    /// Γ[1 − (1 − c w)^M]/w of a mode with |p|² = `power`; zero where the PSF leaves nothing.
    fn amplitude(&self, at: usize, power: f32) -> f32 {
        let w = power + self.rough[at];
        // Without signal a mode is noise alone, whatever λ makes of it.
        if power < LEAST_POWER {
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

    /// Deconvolves the middle of the row-major `full` stamp with white noise of level `noise` and writes
    /// the autocorrelation, with its derivatives if `response`.
    pub fn autocorrelate(
        &self,
        psf: &SpectralPsf,
        full: &[f32],
        noise: f32,
        response: bool,
        scratch: &mut SpectralScratch,
        out: &mut Lags,
    ) {
        if response {
            self.change(psf, full, scratch);
        }
        let SpectralScratch {
            u,
            x,
            y,
            fft,
            changes,
            ..
        } = scratch;
        let start = self.start();
        let rows = (start..start + self.n)
            .map(|row| full[row * self.full + start..][..self.n].iter().copied());
        self.fft.rows(rows, fft, u);
        self.fft.columns(fft, u);
        if response {
            for (change, spectrum) in changes.iter().zip([&mut *x, &mut *y]) {
                let rows = change.chunks_exact(self.n).map(|row| row.iter().copied());
                self.fft.rows(rows, fft, spectrum);
                self.fft.columns(fft, spectrum);
            }
        }
        let floor = noise * noise * (self.n * self.n) as f32;
        for (at, u) in u.iter_mut().enumerate() {
            let (value, gain) = (*u, psf.gain[at]);
            *u = Complex32::new(gain * (value.norm_sqr() - floor), 0.0);
            if response {
                // Re(conj(û)·δû), less what the noise adds to its mean.
                let along = |change: Complex32| value.re * change.re + value.im * change.im;
                let [first, second] = psf.noise_tilts[at];
                let first = along(x[at]) + floor * first;
                let second = along(y[at]) + floor * second;
                x[at] = Complex32::new(2.0 * gain * first, 0.0);
                y[at] = Complex32::new(2.0 * gain * second, 0.0);
            }
        }
        self.back(u, fft, &mut out.acf);
        if response {
            self.back(x, fft, &mut out.shear1);
            self.back(y, fft, &mut out.shear2);
        }
    }

    /// First row and column of the cut.
    fn start(&self) -> usize {
        (self.full - self.n) / 2
    }

    /// Changes of the cut stamp with shears of the galaxy, worked out on the full one: the transform
    /// of p·(k_x ∂_x − k_y ∂_y)(û/p), and of the other component's.
    fn change(&self, psf: &SpectralPsf, stamp: &[f32], scratch: &mut SpectralScratch) {
        let [u, x, y] = &mut scratch.full;
        let fft = &mut scratch.full_fft;
        let rows = stamp.chunks_exact(self.full).map(|row| row.iter().copied());
        transforms(
            &self.full_fft,
            rows,
            self.full,
            fft,
            [&mut *u, &mut *x, &mut *y],
        );
        let size = self.full_fft.size;
        for (i, &kx) in self.full_k[..self.full_fft.half()].iter().enumerate() {
            for (j, &ky) in self.full_k.iter().enumerate() {
                let at = i * size + j;
                let [first, second] = psf.tilts[at];
                let [along, across] = sheared(x[at], y[at], kx, ky);
                x[at] = along - first * u[at];
                y[at] = across - second * u[at];
            }
        }
        let scale = 1.0 / (size * size) as f32;
        let start = self.start();
        for (spectrum, change) in [x, y].into_iter().zip(&mut scratch.changes) {
            self.full_fft.columns_back(fft, spectrum);
            for (row, out) in change.chunks_exact_mut(self.n).enumerate() {
                let line = self.full_fft.row_back(spectrum, start + row, fft);
                for (out, value) in out.iter_mut().zip(&line[start..]) {
                    *out = value * scale;
                }
            }
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
            *u *= p.conj() * (self.amplitude(at, p.norm_sqr()) / (size * size) as f32);
        }
        self.fft.columns_back(&mut scratch.fft, &mut scratch.u);
        (0..self.n)
            .flat_map(|y| self.fft.row_back(&scratch.u, y, &mut scratch.fft)[..self.n].to_vec())
            .collect()
    }
}

/// k of each place along an axis of `size`, in radians per pixel.
fn frequencies(size: usize) -> Vec<f64> {
    let side = size as i32;
    (0..side)
        .map(|i| {
            let signed = if 2 * i > side { i - side } else { i };
            std::f64::consts::TAU * f64::from(signed) / f64::from(side)
        })
        .collect()
}

/// Transforms of an image of side `side`, and of it times x and y from its middle.
fn transforms(
    plan: &StampFft,
    rows: impl Iterator<Item = impl Iterator<Item = f32>> + Clone,
    side: usize,
    fft: &mut FftScratch,
    [u, x, y]: [&mut Vec<Complex32>; 3],
) {
    let middle = (side as f32 - 1.0) / 2.0;
    let along = rows
        .clone()
        .map(|row| row.enumerate().map(|(i, v)| v * (i as f32 - middle)));
    plan.rows(along, fft, x);
    plan.rows(rows, fft, u);
    for (from, to) in u.chunks_exact(plan.size).zip(y.chunks_exact_mut(plan.size)) {
        for (j, (value, out)) in from.iter().zip(to).enumerate() {
            *out = value * (j as f32 - middle);
        }
    }
    for spectrum in [u, x, y] {
        plan.columns(fft, spectrum);
    }
}

/// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform whose image times x and y has the
/// transforms x̂ and ŷ: ∂ of it is −i x̂.
fn sheared(x: Complex32, y: Complex32, kx: f32, ky: f32) -> [Complex32; 2] {
    let gx = Complex32::new(x.im, -x.re);
    let gy = Complex32::new(y.im, -y.re);
    [gx * kx - gy * ky, gx * ky + gy * kx]
}

/// Transform of Sun's kernel, which is real.
fn high_pass(kx: f64, ky: f64) -> f64 {
    let (cx, cy) = (kx.cos(), ky.cos());
    SUN_KERNEL[1][1]
        + 2.0 * SUN_KERNEL[1][0] * cx
        + 2.0 * SUN_KERNEL[0][1] * cy
        + 4.0 * SUN_KERNEL[0][0] * cx * cy
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::Registry;

    use super::super::reference::convolve;
    use super::*;
    use crate::shape::autocorrelation_naive;

    fn settings(iterations: usize, target: f64, lambda: f64) -> Deconvolution {
        let registry = Registry::embedded().unwrap();
        let named = registry.get("32/linear/star").unwrap().submission;
        Deconvolution {
            max_iterations: iterations,
            target_sigma: target,
            lambda,
            ..named.deconvolution
        }
    }

    /// A lopsided PSF of sum one.
    fn psf(p: usize) -> Array2<f64> {
        let centre = (p / 2) as f64;
        let psf = Array2::from_shape_fn((p, p), |(y, x)| {
            let (dy, dx) = (y as f64 - centre, x as f64 - centre);
            (-(dx * dx + 0.7 * dy * dy + 0.5 * dx * dy) / 3.0).exp()
        });
        let sum = psf.sum();
        psf / sum
    }

    /// An elliptical Gaussian galaxy under a shear, before the PSF, on a stamp large enough for all of
    /// its light.
    fn galaxy(n: usize, g1: f64, g2: f64) -> Array2<f64> {
        let centre = (n as f64 - 1.0) / 2.0 + 0.2;
        Array2::from_shape_fn((n, n), |(y, x)| {
            let (y, x) = (y as f64 - centre, x as f64 - centre + 0.5);
            // Position before the shear, whose matrix is (1 + γ₁, γ₂; γ₂, 1 − γ₁), of determinant
            // one to first order.
            let (u, v) = ((1.0 - g1) * x - g2 * y, (1.0 + g1) * y - g2 * x);
            (-(u * u / 7.0 + v * v / 4.0 + 0.3 * u * v / 5.0)).exp()
        })
    }

    fn single(image: &Array2<f64>) -> Vec<f32> {
        image.iter().map(|&v| v as f32).collect()
    }

    #[test]
    fn few_iterations_are_those_of_the_plain_linear_network() {
        // Stamp and PSF so small against the plane that its missing boundary makes no difference.
        let (n, p, reach) = (33, 7, 6);
        let (h, u0) = (psf(p), galaxy(33, 0.0, 0.0));
        let u0 = convolve(u0.view(), h.view());
        let turned = h.slice(ndarray::s![..;-1, ..;-1]).to_owned();
        let mut v = Array2::zeros((n, n));
        for _ in 0..3 {
            let residual = &u0 - &convolve(v.view(), h.view());
            v += &convolve(residual.view(), turned.view());
        }
        let plan = Spectral::new(n, n, p, reach, &settings(3, 0.0, 0.0)).unwrap();
        let (mut own, mut scratch, mut lags) = (plan.psf(), plan.scratch(), plan.lags());
        scratch.u.fill(Complex32::new(1e9, -1e9));
        plan.set_psf(h.view(), &mut scratch, &mut own).unwrap();
        plan.autocorrelate(&own, &single(&u0), 0.0, false, &mut scratch, &mut lags);
        let expected = autocorrelation_naive(&v);
        let peak = expected[(0, n - 1)];
        for dy in 0..=reach {
            for dx in 0..=2 * reach {
                let found = f64::from(lags.acf[dy * (2 * reach + 1) + dx]);
                let expected = expected[(dy, dx + n - 1 - reach)];
                // f32 transforms, and the modes below `LEAST_POWER` that are left out.
                assert!((found - expected).abs() < 2e-5 * peak, "{dx} {dy}");
            }
        }
        // The picture is the same stamp.
        let picture = plan.deconvolved(h.view(), &single(&u0), &mut scratch);
        let largest = v.iter().copied().fold(0.0, f64::max);
        for (found, expected) in picture.iter().zip(&v) {
            assert!((f64::from(*found) - expected).abs() < 2e-4 * largest);
        }
    }

    #[test]
    fn the_response_is_that_of_a_sheared_galaxy() {
        // The cut goes through the galaxy.
        let (full, n, p, reach) = (40, 14, 11, 8);
        let h = psf(p);
        let plan = Spectral::new(n, full, p, reach, &settings(1000, 2.0, 0.0)).unwrap();
        let (mut own, mut scratch) = (plan.psf(), plan.scratch());
        plan.set_psf(h.view(), &mut scratch, &mut own).unwrap();
        let mut lags_of = |g1: f64, g2: f64| {
            let mut lags = plan.lags();
            let stamp = convolve(galaxy(full, g1, g2).view(), h.view());
            plan.autocorrelate(&own, &single(&stamp), 0.0, true, &mut scratch, &mut lags);
            lags
        };
        let here = lags_of(0.0, 0.0);
        let peak = here.acf[reach];
        let step = 0.01;
        for (derivative, plus, minus) in [
            (&here.shear1, lags_of(step, 0.0), lags_of(-step, 0.0)),
            (&here.shear2, lags_of(0.0, step), lags_of(0.0, -step)),
        ] {
            for (found, (a, b)) in derivative.iter().zip(plus.acf.iter().zip(&minus.acf)) {
                let expected = (a - b) / (2.0 * step as f32);
                // f32 rounding over the step (1e-5), second order in the step (1e-4 of the size).
                assert!((found - expected).abs() < 1e-3 * peak, "{found} {expected}");
            }
        }
    }

    #[test]
    fn noise_is_subtracted_in_the_mean() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (n, p, reach) = (24, 9, 5);
        let plan = Spectral::new(n, n, p, reach, &settings(1000, 2.0, 1e-4)).unwrap();
        let (mut own, mut scratch, mut lags) = (plan.psf(), plan.scratch(), plan.lags());
        plan.set_psf(psf(p).view(), &mut scratch, &mut own).unwrap();
        let mut with = vec![0.0f64; lags.acf.len()];
        let mut without = with.clone();
        // Uniform noise of variance 1/12 · 12 = 1.
        let half = 3f32.sqrt();
        let count = 400;
        for _ in 0..count {
            let noise: Vec<f32> = (0..n * n).map(|_| rng.random_range(-half..half)).collect();
            for (level, sum) in [(1.0, &mut with), (0.0, &mut without)] {
                plan.autocorrelate(&own, &noise, level, false, &mut scratch, &mut lags);
                for (s, v) in sum.iter_mut().zip(&lags.acf) {
                    *s += f64::from(*v) / f64::from(count);
                }
            }
        }
        // A few dozen independent modes in each of 400 stamps: 1 % of the noise's own.
        let left = with.iter().map(|v| v.abs()).fold(0.0, f64::max);
        assert!(left < 0.05 * without[reach], "{left} of {}", without[reach]);
    }

    #[test]
    fn unusable_sizes_and_psfs_are_refused() {
        let settings = settings(10, 1.0, 0.0);
        assert!(Spectral::new(65, 65, 15, 8, &settings).is_err());
        assert!(Spectral::new(32, 48, 49, 8, &settings).is_err());
        let plan = Spectral::new(32, 48, 7, 8, &settings).unwrap();
        let (mut own, mut scratch) = (plan.psf(), plan.scratch());
        let mut bad = psf(7);
        assert!(plan.set_psf(psf(9).view(), &mut scratch, &mut own).is_err());
        bad[(2, 3)] = f64::NAN;
        assert_eq!(
            plan.set_psf(bad.view(), &mut scratch, &mut own),
            Err(OperatorError::PsfNotFinite { x: 4, y: 3 })
        );
    }
}
