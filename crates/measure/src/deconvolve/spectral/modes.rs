//! What is done mode by mode on a stamp's way to its autocorrelation.

use multiversion::multiversion;

use super::plane::Modes;

/// Multiplies by complex numbers.
pub(super) fn multiply(modes: &mut Modes, by: &Modes) {
    complex_product(&mut modes.re, &mut modes.im, &by.re, &by.im);
}

/// Subtracts products of complex numbers.
pub(super) fn subtract_product(modes: &mut Modes, a: &Modes, b: &Modes) {
    complex_less(&mut modes.re, &mut modes.im, [&a.re, &a.im], [&b.re, &b.im]);
}

/// Moves the origin along one axis by `shift`, for the transforms of an image times the distance from it.
pub(super) fn recentre(modes: &mut Modes, image: &Modes, shift: f32) {
    less_scaled(&mut modes.re, &image.re, shift);
    less_scaled(&mut modes.im, &image.im, shift);
}

/// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform, from those of its image times x and y: ∂ of it is −i x̂.
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
fn complex_less(re: &mut [f32], im: &mut [f32], a: [&[f32]; 2], b: [&[f32]; 2]) {
    let factors = a[0].iter().zip(a[1]).zip(b[0].iter().zip(b[1]));
    for ((re, im), ((ar, ai), (br, bi))) in re.iter_mut().zip(im).zip(factors) {
        *re -= ar * br - ai * bi;
        *im -= ar * bi + ai * br;
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn less_scaled(out: &mut [f32], values: &[f32], factor: f32) {
    for (out, value) in out.iter_mut().zip(values) {
        *out -= value * factor;
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
