//! Noise mode by mode: its power, and loops over modes that subtract it or sum products with it.

use std::ops::Add;

use multiversion::multiversion;
use shearq_quantities::linear::LANES;

use crate::transform::{Spectrum, four_lanes, lanes, store};

/// Noise as the linear network uses it: of level one, and white but for its power.
#[derive(Debug, Clone)]
pub struct ModeNoise {
    /// Power S of each mode; one for white noise.
    pub(super) power: Vec<f32>,
    /// ½(k_x ∂_x − k_y ∂_y) ln S and ½(k_y ∂_x + k_x ∂_y) ln S: what a shear adds to a mode of noise, in units
    /// of it and in the mean.
    pub(super) tilts: [Vec<f32>; 2],
}

/// One value for each of four changes of noise n, whose mean products a′(n)·b′(tn) are needed: t(k) multiplies each mode of
/// the noise.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct NoiseChanges<T> {
    /// The mean changes of a mode with γ₁ and with γ₂.
    pub(crate) sheared: [T; 2],
    /// t = √(P⊥/P) − 1, with P the power behind the PSF and P⊥ that behind the PSF turned by 90 degrees.
    pub(crate) turned: T,
    /// t = 1.
    pub(crate) plain: T,
}

impl<T> NoiseChanges<T> {
    pub(crate) fn map<U>(&self, of: impl Fn(&T) -> U) -> NoiseChanges<U> {
        NoiseChanges {
            sheared: self.sheared.each_ref().map(&of),
            turned: of(&self.turned),
            plain: of(&self.plain),
        }
    }
}

impl Add for NoiseChanges<f32> {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let [first, second] = self.sheared;
        NoiseChanges {
            sheared: [first + other.sheared[0], second + other.sheared[1]],
            turned: self.turned + other.turned,
            plain: self.plain + other.plain,
        }
    }
}

// Replaces |v̂|² by scale·(|v̂|² − variance·floor).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn subtract_noise(power: &mut [f32], scale: &[f32], floor: &[f32], variance: f32) {
    let halves = power.chunks_exact_mut(scale.len());
    for (power, floor) in halves.zip(floor.chunks_exact(scale.len())) {
        for (power, (scale, floor)) in power.iter_mut().zip(scale.iter().zip(floor)) {
            *power = scale * (*power - variance * floor);
        }
    }
}

// Writes 2·scale·(Re(conj(v̂)·δv̂) + variance·mean).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn change_of_power(
    v: &Spectrum,
    change: &Spectrum,
    scale: &[f32],
    mean: &[f32],
    variance: f32,
    out: &mut [f32],
) {
    let quarter = scale.len();
    let (v, change) = (v.quarters(), change.quarters());
    let (mean_even, mean_odd) = mean.split_at(quarter);
    let (even, odd) = out.split_at_mut(quarter);
    for at in (0..quarter).step_by(LANES) {
        let (v, change) = (four_lanes(v, at), four_lanes(change, at));
        let (mean_even, mean_odd) = (lanes(mean_even, at), lanes(mean_odd, at));
        let scale = lanes(scale, at);
        let mut out = [[0.0f32; LANES]; 2];
        for l in 0..LANES {
            let twice = 2.0 * scale[l];
            out[0][l] = twice * (even_of_product(v, change, l) + variance * mean_even[l]);
            out[1][l] = twice * (odd_of_product(v, change, l) + variance * mean_odd[l]);
        }
        store([&mut *even, &mut *odd], at, out);
    }
}

// Writes v̂ times 2·scale and a real even spectrum.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn twice_scaled(v: &Spectrum, real: &[f32], scale: &[f32], out: &mut Spectrum) {
    let (even, odd) = real.split_at(scale.len());
    for at in (0..scale.len()).step_by(LANES) {
        let [cc, cs, sc, ss] = four_lanes(v.quarters(), at);
        let (even, odd, scale) = (lanes(even, at), lanes(odd, at), lanes(scale, at));
        let [mut out_cc, mut out_cs, mut out_sc, mut out_ss] = [[0.0f32; LANES]; 4];
        for l in 0..LANES {
            let (even, odd) = (2.0 * scale[l] * even[l], 2.0 * scale[l] * odd[l]);
            out_cc[l] = cc[l] * even + ss[l] * odd;
            out_cs[l] = cs[l] * even - sc[l] * odd;
            out_sc[l] = sc[l] * even - cs[l] * odd;
            out_ss[l] = cc[l] * odd + ss[l] * even;
        }
        store(out.quarters_mut(), at, [out_cc, out_cs, out_sc, out_ss]);
    }
}

// Sums over the plane of Re(conj(a)·b) times a real even spectrum for each change of noise.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn sums_of_products(
    a: &Spectrum,
    b: &Spectrum,
    powers: &NoiseChanges<Vec<f32>>,
) -> NoiseChanges<f32> {
    let (a, b) = (a.quarters(), b.quarters());
    let quarter = a[0].len();
    let [mut first, mut second, mut turned, mut plain] = [[0.0f32; LANES]; 4];
    for at in (0..quarter).step_by(LANES) {
        let (a, b) = (four_lanes(a, at), four_lanes(b, at));
        // A closure in `map` would be called for each, without vector instructions.
        let [of_first, of_second] = &powers.sheared;
        let (by_first, by_second) = (parities(of_first, at), parities(of_second, at));
        let (by_turned, by_plain) = (parities(&powers.turned, at), parities(&powers.plain, at));
        for l in 0..LANES {
            let (even, odd) = (even_of_product(a, b, l), odd_of_product(a, b, l));
            first[l] += even * by_first.0[l] + odd * by_first.1[l];
            second[l] += even * by_second.0[l] + odd * by_second.1[l];
            turned[l] += even * by_turned.0[l] + odd * by_turned.1[l];
            plain[l] += even * by_plain.0[l] + odd * by_plain.1[l];
        }
    }
    // Of modes above and below: (e − o)(E − O) + (e + o)(E + O).
    let [first, second, turned, plain] =
        [first, second, turned, plain].map(|lanes| 2.0 * lanes.iter().sum::<f32>());
    NoiseChanges {
        sheared: [first, second],
        turned,
        plain,
    }
}

// The parts cc and ss of a real even spectrum.
#[inline(always)]
fn parities(spectrum: &[f32], at: usize) -> (&[f32; LANES], &[f32; LANES]) {
    (
        lanes(spectrum, at),
        lanes(spectrum, spectrum.len() / 2 + at),
    )
}

// The part cc of Re(conj(a)·b) of modes.
#[inline(always)]
fn even_of_product(a: [&[f32; LANES]; 4], b: [&[f32; LANES]; 4], l: usize) -> f32 {
    let ([acc, acs, asc, ass], [bcc, bcs, bsc, bss]) = (a, b);
    (acc[l] * bcc[l] + ass[l] * bss[l]) + (asc[l] * bsc[l] + acs[l] * bcs[l])
}

// The part ss of it.
#[inline(always)]
fn odd_of_product(a: [&[f32; LANES]; 4], b: [&[f32; LANES]; 4], l: usize) -> f32 {
    let ([acc, acs, asc, ass], [bcc, bcs, bsc, bss]) = (a, b);
    (acc[l] * bss[l] + ass[l] * bcc[l]) - (asc[l] * bcs[l] + acs[l] * bsc[l])
}
