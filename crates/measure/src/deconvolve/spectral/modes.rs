//! What is done with spectra mode by mode.

use multiversion::multiversion;

use super::plane::Modes;

/// Multiplies by complex numbers.
pub(super) fn multiply(modes: &mut Modes, by: &Modes) {
    complex_product(&mut modes.re, &mut modes.im, &by.re, &by.im);
}

/// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform, from the transforms of its image times x and y: ∂ of it is −i x̂.
pub(super) fn shear(x: &mut Modes, y: &mut Modes, waves: &[Vec<f32>; 2]) {
    let [kx, ky] = waves;
    // −i(a + ib) = b − ia.
    sheared(&mut x.re, &mut y.re, kx, ky);
    sheared(&mut x.im, &mut y.im, kx, ky);
    turn(&mut x.re, &mut x.im);
    turn(&mut y.re, &mut y.im);
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
fn sheared(x: &mut [f32], y: &mut [f32], kx: &[f32], ky: &[f32]) {
    for ((x, y), (kx, ky)) in x.iter_mut().zip(y).zip(kx.iter().zip(ky)) {
        (*x, *y) = (*x * kx - *y * ky, *x * ky + *y * kx);
    }
}

/// Times −i.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn turn(re: &mut [f32], im: &mut [f32]) {
    for (re, im) in re.iter_mut().zip(im) {
        (*re, *im) = (*im, -*re);
    }
}
