//! Sums and products over modes.

use multiversion::multiversion;
use shearq_quantities::linear::LANES;

use crate::transform::Modes;

// Least power of the PSF's transform; modes below it are left out as pure noise. Below 10⁻³, the least power in the
// simulated sets, and within single precision.
pub(super) const MIN_PSF_POWER: f32 = 1e-7;

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn add_squares(modes: &Modes, weight: f32, sum: &mut [f32]) {
    for (sum, (re, im)) in sum.iter_mut().zip(modes.re.iter().zip(&modes.im)) {
        *sum += weight * (re * re + im * im);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn amplitudes(
    [powers, rough, target]: [&[f32]; 3],
    step: f32,
    iterations: i32,
    out: &mut [f32],
) {
    let modes = powers
        .chunks(LANES)
        .zip(rough.chunks(LANES))
        .zip(target.chunks(LANES));
    for (out, ((powers, rough), target)) in out.chunks_mut(LANES).zip(modes) {
        let mut base = [0.0f64; LANES];
        let mut power_of_base = [1.0f64; LANES];
        for (base, (power, rough)) in base.iter_mut().zip(powers.iter().zip(rough)) {
            *base = f64::from(1.0 - step * (power + rough));
        }
        for base in &mut base {
            // A positive (1 − c w)^M below exp(−40) is nothing in single precision, and would make denormal numbers on the way.
            let nothing = *base > 0.0 && (1.0 - *base) * f64::from(iterations) > 40.0;
            *base = if nothing { 0.0 } else { *base };
        }
        // By repeated squares, for all lanes at a time.
        let mut exponent = iterations;
        while exponent > 0 {
            if exponent & 1 == 1 {
                for (power, base) in power_of_base.iter_mut().zip(&base) {
                    *power *= base;
                }
            }
            for base in &mut base {
                *base *= *base;
            }
            exponent >>= 1;
        }
        let modes = powers.iter().zip(rough).zip(target).zip(power_of_base);
        for (out, (((power, rough), target), power_of_base)) in out.iter_mut().zip(modes) {
            // A mode without signal is noise alone, for any λ.
            *out = if *power < MIN_PSF_POWER || *target == 0.0 {
                0.0
            } else {
                target * (1.0 - power_of_base) as f32 / (power + rough)
            };
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn roots(values: &[f32], out: &mut [f32]) {
    for (out, value) in out.iter_mut().zip(values) {
        *out = value.sqrt();
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn negative_products(a: &[f32], b: &[f32], out: &mut [f32]) {
    for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = -a * b;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn weighted(kind: &[f32], power: &[f32], counts: &[f32], area: f32, out: &mut [f32]) {
    let modes = kind.iter().zip(power).zip(counts);
    for (out, ((kind, power), count)) in out.iter_mut().zip(modes) {
        *out = count * area * power * kind;
    }
}

// Multiplies complex modes.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn multiply_modes(modes: &mut Modes, by: &Modes) {
    let modes = modes.re.iter_mut().zip(&mut modes.im);
    for ((re, im), (a, b)) in modes.zip(by.re.iter().zip(&by.im)) {
        (*re, *im) = (*re * a - *im * b, *re * b + *im * a);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for l in 0..LANES {
            sums[l] += a[l] * b[l];
        }
    }
    sums.iter().sum()
}
