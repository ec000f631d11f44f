//! PSFs and noise as the linear network uses them.

use multiversion::multiversion;
use ndarray::ArrayView2;

use super::modes::{multiply, scale_into, shear};
use super::plane::{Modes, even_quarters};
use super::{Spectral, SpectralScratch};
use crate::error::MeasureError;
use crate::noise::StampNoise;
use crate::pixel::check_psf;
use crate::pixel::copy_row;

/// Least power of the PSF's transform; modes below it are left out as pure noise. See
/// docs/constants.md.
const LEAST_POWER: f32 = 1e-7;

/// Noise as the linear network uses it: of level one, and white but for its power.
#[derive(Debug, Clone)]
pub struct ModeNoise {
    /// Power S of each mode; one for white noise.
    pub(super) power: Vec<f32>,
    /// ½(k_x ∂_x − k_y ∂_y) ln S and ½(k_y ∂_x + k_x ∂_y) ln S: what a shear adds to a mode of noise, in units
    /// of it and in the mean.
    tilts: [Vec<f32>; 2],
}

/// A PSF as the linear network uses it.
#[derive(Debug, Clone)]
pub struct SpectralPsf {
    /// v̂/û.
    pub(super) restore: Modes,
    /// What a field of noise of σ = 1 becomes of one that is white: v̂/û times √S.
    pub(super) field: Modes,
    /// Change of a mode of the field with the components of shear, in units of it and in the mean.
    pub(super) field_tilts: [Vec<f32>; 2],
    /// What the field would be with the PSF turned by 90 degrees, less what it is, in units of it.
    pub(super) turned: Vec<f32>,
    /// Mean power of windowed noise, in units of σ², by parity.
    pub(super) floor: Vec<f32>,
    /// |p|²/S of each mode: the square of what a point of flux one is there, in units of the noise.
    clarity: Vec<f32>,
    /// (k_x ∂_x − k_y ∂_y)p/p and (k_y ∂_x + k_x ∂_y)p/p.
    pub(super) tilts: [Modes; 2],
    /// Mean of −Re(conj(v̂)·δv̂) of windowed noise, in units of σ², by parity.
    pub(super) noise_tilts: [Vec<f32>; 2],
    /// Power of noise of σ = 1 before the window, of each mode and the modes that it stands for. It is multiplied by the change
    /// with γ₁, by the change with γ₂, by the difference to noise behind the PSF turned by 90 degrees, and by one; by parity.
    pub(super) powers: [Vec<f32>; 4],
}

impl SpectralPsf {
    /// |p|²/S of each mode, S being the power of the noise.
    pub fn clarity(&self) -> &[f32] {
        &self.clarity
    }

    /// Standard deviation of [`super::Lags::flux`] in noise of σ = 1.
    pub fn flux_error(&self) -> f32 {
        self.floor[0].sqrt()
    }
}

impl Spectral {
    /// A PSF of zeros.
    pub fn psf(&self) -> SpectralPsf {
        let modes = self.target.len();
        SpectralPsf {
            restore: self.plane.spectrum(),
            field: self.plane.spectrum(),
            field_tilts: std::array::from_fn(|_| vec![0.0; modes]),
            turned: vec![0.0; modes],
            floor: vec![0.0; modes],
            clarity: vec![0.0; modes],
            tilts: std::array::from_fn(|_| self.plane.spectrum()),
            noise_tilts: std::array::from_fn(|_| vec![0.0; modes]),
            powers: std::array::from_fn(|_| vec![0.0; modes]),
        }
    }

    /// Noise of level one with the correlation of `noise`.
    pub fn noise(&self, noise: &StampNoise) -> ModeNoise {
        let [kx, ky] = &self.waves;
        let modes: Vec<[f32; 3]> = kx
            .iter()
            .zip(ky)
            .map(|(&kx, &ky)| {
                let (power, slopes) = noise.power([kx, ky].map(f64::from));
                let [first, second] = slopes.map(|slope| (0.5 * slope / power) as f32);
                [power as f32, first, second]
            })
            .collect();
        let column = |k: usize| modes.iter().map(|mode| mode[k]).collect();
        ModeNoise {
            power: column(0),
            tilts: [column(1), column(2)],
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
        let (p, side) = (self.psf.side(), psf.nrows());
        // Zero around a smaller one.
        let fits = side < p && (p - side).is_multiple_of(2);
        check_psf(psf, if fits { side } else { p })?;
        let first = (p - side) / 2;
        let SpectralScratch {
            fft: [_, fft],
            windowed: quarters,
            changes: [u, x, y],
            image,
            real: [power, root],
            even,
            smooth,
            ..
        } = scratch;
        image.fill(0.0);
        let rows = image.chunks_exact_mut(p).skip(first);
        for (row, from) in rows.zip(psf.into_outer_iter()) {
            copy_row(from, &mut row[first..]);
        }
        self.psf.transform(image, fft, quarters);
        for (modes, quarters) in [&mut *u, x, y].into_iter().zip(&*quarters) {
            modes.take(quarters);
        }
        shear(x, y, &self.waves);
        conjugate_with_power(&mut u.re, &mut u.im, power);
        ratios(power, &noise.power, &mut out.clarity);
        inverses(power, root);
        for (tilts, change) in out.tilts.iter_mut().zip([x, y]) {
            multiply(change, u);
            scale_into(tilts, change, root);
        }
        let modes = [&power[..], &self.rough, &self.target];
        amplitudes(modes, self.step, self.iterations, root);
        scale_into(&mut out.restore, u, root);
        roots(&noise.power, root);
        scale_into(&mut out.field, &out.restore, root);
        for ((out, noise), tilts) in out.field_tilts.iter_mut().zip(&noise.tilts).zip(&out.tilts) {
            differences(noise, &tilts.re, out);
        }
        powers_of(&out.field, power);
        roots(power, root);
        for ((out, &at), root_here) in out.turned.iter_mut().zip(&self.turned).zip(&*root) {
            let there = root[at as usize];
            *out = if *root_here > 0.0 {
                there / root_here - 1.0
            } else {
                0.0
            };
        }
        let mut spread = |modes: &[f32], out: &mut [f32]| {
            even_quarters(modes, out);
            self.leak.apply_even(out, smooth);
        };
        spread(power, &mut out.floor);
        for (out, tilts) in out.noise_tilts.iter_mut().zip(&out.field_tilts) {
            negative_products(tilts, power, root);
            spread(root, out);
        }
        let area = (self.plane.size * self.plane.size) as f32 * self.inside;
        root.fill(1.0);
        let kinds = [&out.field_tilts[0], &out.field_tilts[1], &out.turned, root];
        for (out, kind) in out.powers.iter_mut().zip(kinds) {
            weighted(kind, power, &self.counts, area, even);
            even_quarters(even, out);
        }
        Ok(())
    }

    /// Γ[1 − (1 − c w)^M]/w of a mode with |p|² = `power`; zero where the PSF leaves nothing.
    pub(super) fn amplitude(&self, at: usize, power: f32) -> f32 {
        let mut out = [0.0];
        let modes = [&[power][..], &self.rough[at..=at], &self.target[at..=at]];
        amplitudes(modes, self.step, self.iterations, &mut out);
        out[0]
    }
}

/// Γ[1 − (1 − c w)^M]/w of modes with |p|² = `powers`; zero where the PSF leaves nothing.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn amplitudes([powers, rough, target]: [&[f32]; 3], step: f32, iterations: i32, out: &mut [f32]) {
    /// Modes side by side. See docs/constants.md.
    const LANES: usize = 16;
    let modes = powers
        .chunks(LANES)
        .zip(rough.chunks(LANES))
        .zip(target.chunks(LANES));
    for (out, ((powers, rough), target)) in out.chunks_mut(LANES).zip(modes) {
        let mut left = [0.0f64; LANES];
        let mut rest = [1.0f64; LANES];
        for (left, (power, rough)) in left.iter_mut().zip(powers.iter().zip(rough)) {
            *left = f64::from(1.0 - step * (power + rough));
        }
        // (1 − c w)^M by repeated squares. A positive one below exp(−40) is nothing in single precision, and would make
        // denormal numbers on the way.
        for left in &mut left {
            let nothing = *left > 0.0 && (1.0 - *left) * f64::from(iterations) > 40.0;
            *left = if nothing { 0.0 } else { *left };
        }
        let mut exponent = iterations;
        while exponent > 0 {
            if exponent & 1 == 1 {
                for (rest, left) in rest.iter_mut().zip(&left) {
                    *rest *= left;
                }
            }
            for left in &mut left {
                *left *= *left;
            }
            exponent >>= 1;
        }
        let modes = powers.iter().zip(rough).zip(target);
        for ((out, ((power, rough), target)), rest) in out.iter_mut().zip(modes).zip(rest) {
            // Without signal a mode is noise alone, whatever λ makes of it.
            *out = if *power < LEAST_POWER || *target == 0.0 {
                0.0
            } else {
                target * (1.0 - rest) as f32 / (power + rough)
            };
        }
    }
}

/// The conjugate, and the square of the modulus.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn conjugate_with_power(re: &mut [f32], im: &mut [f32], power: &mut [f32]) {
    for ((re, im), power) in re.iter().zip(im).zip(power) {
        *power = re * re + *im * *im;
        *im = -*im;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn ratios(a: &[f32], b: &[f32], out: &mut [f32]) {
    for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = a / b;
    }
}

/// 1/|p|²; zero where the PSF leaves nothing.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn inverses(powers: &[f32], out: &mut [f32]) {
    for (out, power) in out.iter_mut().zip(powers) {
        *out = if *power < LEAST_POWER {
            0.0
        } else {
            1.0 / power
        };
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn roots(values: &[f32], out: &mut [f32]) {
    for (out, value) in out.iter_mut().zip(values) {
        *out = value.sqrt();
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn differences(a: &[f32], b: &[f32], out: &mut [f32]) {
    for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = a - b;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn powers_of(modes: &Modes, out: &mut [f32]) {
    for (out, (re, im)) in out.iter_mut().zip(modes.re.iter().zip(&modes.im)) {
        *out = re * re + im * im;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn negative_products(a: &[f32], b: &[f32], out: &mut [f32]) {
    for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = -a * b;
    }
}

/// kind · power · count · area.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weighted(kind: &[f32], power: &[f32], counts: &[f32], area: f32, out: &mut [f32]) {
    let modes = kind.iter().zip(power).zip(counts);
    for (out, ((kind, power), count)) in out.iter_mut().zip(modes) {
        *out = count * area * power * kind;
    }
}
