//! Loops over lines of wavenumbers and of pixels: light, shifts, and what the products leave to do.

use std::ops::Range;

use multiversion::multiversion;
use shearq_quantities::Shear;
use shearq_quantities::fourier::Complex32;
use shearq_quantities::radial::{QuadraticForm, SingleTable};

use super::phases::Phases;
use crate::galaxy::{Component, EXPONENTIAL_HALF_LIGHT, Galaxy, Sersic};

/// A component in steps of wavenumbers.
#[derive(Clone, Copy)]
pub(super) struct Wave {
    profile: Sersic,
    flux: f32,
    /// The squared radius in units of the profile's formula or table.
    form: QuadraticForm,
}

impl Wave {
    pub(super) fn new(component: &Component, step: f64) -> Self {
        let form = form_in_steps(component.shape, component.half_light_radius, step);
        Wave {
            profile: component.profile,
            flux: component.flux as f32,
            form: match component.profile {
                Sersic::Exponential => form.scaled(EXPONENTIAL_HALF_LIGHT.powi(-2)),
                _ => form,
            },
        }
    }
}

/// The squared radius in units of 1/`length` at integer wavenumbers (i, j).
pub(super) fn form_in_steps(shape: Shear, length: f64, step: f64) -> QuadraticForm {
    QuadraticForm::of_wavenumbers(shape).scaled((length * step).powi(2))
}

/// A quadratic form at wavenumber `j` along y, as a polynomial of that along x: `[constant, linear, square]`.
#[inline(always)]
fn on_line(form: QuadraticForm, j: f32) -> [f32; 3] {
    let j = f64::from(j);
    [form.yy * j * j, 2.0 * form.xy * j, form.xx].map(|c| c as f32)
}

/// Light of components that share a centre, behind PSF and pixel, at wavenumber `j` along y and all from 0 along x.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn shine(
    waves: &[Option<Wave>; Galaxy::MAX_COMPONENTS],
    j: f32,
    blur: &[f32],
    line: &mut [f32],
) {
    line.fill(0.0);
    for wave in waves.iter().flatten() {
        let form = on_line(wave.form, j);
        if wave.profile == Sersic::Exponential {
            add_exponential(form, wave.flux, line);
        } else {
            add_tabulated(wave.profile.table().single(), form, wave.flux, line);
        }
    }
    for (value, blur) in line.iter_mut().zip(blur) {
        *value *= blur;
    }
}

#[inline(always)]
fn add_exponential([constant, linear, square]: [f32; 3], flux: f32, line: &mut [f32]) {
    for (i, value) in line.iter_mut().enumerate() {
        let i = i as i32 as f32;
        *value += flux * power_of_minus_three_halves(1.0 + constant + i * (linear + square * i));
    }
}

#[inline(always)]
fn add_tabulated(
    table: SingleTable<'_>,
    [constant, linear, square]: [f32; 3],
    flux: f32,
    line: &mut [f32],
) {
    for (i, value) in line.iter_mut().enumerate() {
        let i = i as i32 as f32;
        let u = constant + i * (linear + square * i);
        *value += flux * table.at(u.max(0.0));
    }
}

/// PSF × pixel on a line of wavenumbers.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn tabulate(
    table: SingleTable<'_>,
    form: QuadraticForm,
    j: f32,
    pixel_y: f32,
    pixel: &[f32],
    out: &mut [f32],
) {
    let [constant, linear, square] = on_line(form, j);
    for (i, (value, pixel)) in out.iter_mut().zip(pixel).enumerate() {
        let i = i as i32 as f32;
        let u = constant + i * (linear + square * i);
        *value = pixel_y * pixel * table.at(u.max(0.0));
    }
}

/// v^(−3/2) of a number that is neither tiny nor huge, to 7·10⁻⁷ of it. Newton's steps for 1/√v take less time
/// than a square root and a division.
#[inline(always)]
fn power_of_minus_three_halves(v: f32) -> f32 {
    // Half of the exponent with the opposite sign, and a straight line for the fraction: right to 3.5 %.
    let mut root = f32::from_bits(0x5f37_5a86 - (v.to_bits() >> 1));
    let half = 0.5 * v;
    for _ in 0..3 {
        root *= 1.5 - half * root * root;
    }
    root * root * root
}

/// The sum of two lines of wavenumbers and i times their difference, shifted by phases.
///
/// With a and b at ±ky, and e^{−iky} = c + iq, the sum is (a + b)c + i(a − b)q, and i times the difference is
/// −(a + b)q + i(a − b)c.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn shift(
    above: &[f32],
    below: &[f32],
    phases: &Phases,
    phase_y: Complex32,
    [sum, difference]: [&mut [f32]; 2],
) {
    let count = above.len();
    let below = &below[..count];
    let x_re = &phases.x_re[..count];
    let x_im = &phases.x_im[..count];
    let (sum_re, sum_im) = sum.split_at_mut(count);
    let (difference_re, difference_im) = difference.split_at_mut(count);
    let (sum_im, difference_im) = (&mut sum_im[..count], &mut difference_im[..count]);
    let (c, q) = (phase_y.re, phase_y.im);
    for i in 0..count {
        let (a, b) = (above[i], below[i]);
        let (sum, difference) = (a + b, a - b);
        let (re, im) = (sum * c, difference * q);
        sum_re[i] = re * x_re[i] - im * x_im[i];
        sum_im[i] = re * x_im[i] + im * x_re[i];
        let (re, im) = (-sum * q, difference * c);
        difference_re[i] = re * x_re[i] - im * x_im[i];
        difference_im[i] = re * x_im[i] + im * x_re[i];
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn add_times(values: &[f32], factor: f32, to: &mut [f32]) {
    for (to, value) in to.iter_mut().zip(values) {
        *to += factor * value;
    }
}

pub(super) fn add_reversed(values: &[f32], factor: f32, to: &mut [f32]) {
    for (to, value) in to.iter_mut().rev().zip(values) {
        *to += factor * value;
    }
}

/// Lines on both sides of the middle, from `columns` of the even and odd parts, whose lines have `width` numbers.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn unfold_rows(
    even: &[f32],
    odd: &[f32],
    (width, columns): (usize, Range<usize>),
    out: &mut [f32],
) {
    let wide = columns.len();
    let count = out.len() / wide;
    let parts = even.chunks_exact(width).zip(odd.chunks_exact(width));
    for (row, (even, odd)) in parts.enumerate().take(count.div_ceil(2)) {
        let (even, odd) = (&even[columns.clone()], &odd[columns.clone()]);
        let above = &mut out[(count / 2 + row) * wide..][..wide];
        for (value, (even, odd)) in above.iter_mut().zip(even.iter().zip(odd)) {
            *value = even + odd;
        }
        let below = &mut out[((count - 1) / 2 - row) * wide..][..wide];
        for (value, (even, odd)) in below.iter_mut().zip(even.iter().zip(odd)) {
            *value = even - odd;
        }
    }
}

/// Pixels on both sides of the middle, from even and odd parts of `width` numbers for each line of `stamp` pixels.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn unfold_pixels(
    even: &[f32],
    odd: &[f32],
    (width, stamp): (usize, usize),
    out: &mut [f32],
) {
    let parts = even.chunks_exact(width).zip(odd.chunks_exact(width));
    for (line, (even, odd)) in out.chunks_exact_mut(stamp).zip(parts) {
        let right = line[stamp / 2..].iter_mut();
        for (value, (even, odd)) in right.zip(even.iter().zip(odd)) {
            *value = even + odd;
        }
        let left = line[..=(stamp - 1) / 2].iter_mut().rev();
        for (value, (even, odd)) in left.zip(even.iter().zip(odd)) {
            *value = even - odd;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_power_is_right_to_a_few_roundings() {
        for i in 0..10_000 {
            let v = (i as f32 * 2e-3).exp();
            let exact = f64::from(v).powf(-1.5);
            let found = f64::from(power_of_minus_three_halves(v));
            // Three times the roundings of the root, three of 6e-8, and two more.
            assert!(
                (found / exact - 1.0).abs() < 11.0 * 6e-8,
                "{v}: {found} {exact}"
            );
        }
    }
}
