//! What is done with spectra mode by mode.

use multiversion::multiversion;

use super::plane::Modes;

/// Multiplies by complex numbers.
pub(super) fn multiply(modes: &mut Modes, by: &Modes) {
    complex_product(&mut modes.re, &mut modes.im, &by.re, &by.im);
}

/// Replaces the transforms of an image times x and y by [`sheared`] of them.
pub(super) fn shear(x: &mut Modes, y: &mut Modes, waves: &[Vec<f32>; 2]) {
    shear_each([&mut x.re, &mut x.im], [&mut y.re, &mut y.im], waves);
}

/// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform, from the transforms of its image times x and y: ∂ of it is
/// −i x̂. Numbers are real and imaginary part.
#[inline(always)]
pub(super) fn sheared(x: [f32; 2], y: [f32; 2], kx: f32, ky: f32) -> [[f32; 2]; 2] {
    [
        [x[1] * kx - y[1] * ky, y[0] * ky - x[0] * kx],
        [x[1] * ky + y[1] * kx, -(x[0] * ky + y[0] * kx)],
    ]
}

/// Writes real numbers times complex ones.
pub(super) fn scale_into(out: &mut Modes, modes: &Modes, factors: &[f32]) {
    scaled(&mut out.re, &modes.re, factors);
    scaled(&mut out.im, &modes.im, factors);
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn complex_product(re: &mut [f32], im: &mut [f32], a: &[f32], b: &[f32]) {
    let factors = a.iter().zip(b);
    for ((re, im), (a, b)) in re.iter_mut().zip(im).zip(factors) {
        (*re, *im) = (*re * a - *im * b, *re * b + *im * a);
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn scaled(out: &mut [f32], values: &[f32], factors: &[f32]) {
    for (out, (value, factor)) in out.iter_mut().zip(values.iter().zip(factors)) {
        *out = value * factor;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn shear_each(x: [&mut [f32]; 2], y: [&mut [f32]; 2], waves: &[Vec<f32>; 2]) {
    let ([x_re, x_im], [y_re, y_im]) = (x, y);
    let images = x_re.iter_mut().zip(x_im).zip(y_re.iter_mut().zip(y_im));
    for (((x_re, x_im), (y_re, y_im)), (kx, ky)) in images.zip(waves[0].iter().zip(&waves[1])) {
        [[*x_re, *x_im], [*y_re, *y_im]] = sheared([*x_re, *x_im], [*y_re, *y_im], *kx, *ky);
    }
}
