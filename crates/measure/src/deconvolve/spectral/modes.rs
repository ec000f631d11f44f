//! What is done mode by mode on a stamp's way to its autocorrelation.

use multiversion::multiversion;
use shearq_fourier::Complex32;

use super::SpectralPsf;

/// From transforms of a stamp, and of it times x and y, to v̂ and its changes with the components of shear about `centre`,
/// before the window.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn restore(
    modes: [&mut [Complex32]; 3],
    centre: [f32; 2],
    waves: &[[f32; 2]],
    psf: &SpectralPsf,
) {
    let [u, x, y] = modes;
    // The changes are v̂/û times p·(k_x ∂_x − k_y ∂_y)(û/p), and the other's.
    let behind = waves.iter().zip(&psf.tilts).zip(&psf.restore);
    for (((u, x), y), ((waves, tilts), restore)) in u.iter_mut().zip(x).zip(y).zip(behind) {
        let [first, second] = *tilts;
        // About the window's place.
        let (x0, y0) = (*x - *u * centre[0], *y - *u * centre[1]);
        let [plus, cross] = sheared(x0, y0, *waves);
        *x = restore * (plus - first * *u);
        *y = restore * (cross - second * *u);
        *u *= restore;
    }
}

/// From v̂ and its changes with the components of shear to the spectra of the autocorrelation and its changes, without what
/// noise of this variance adds in the mean: the first as real, the second as imaginary part of one, and the third.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn correlate(
    modes: [&mut [Complex32]; 3],
    scale: &[f32],
    psf: &SpectralPsf,
    variance: f32,
) {
    let [u, x, y] = modes;
    let of_noise = psf.floor.iter().zip(&psf.noise_tilts);
    let of_noise = scale.iter().zip(of_noise);
    for (((u, x), y), (scale, (floor, tilts))) in u.iter_mut().zip(x).zip(y).zip(of_noise) {
        let value = *u;
        // Re(conj(v̂)·δv̂), less what the noise adds to its mean.
        let along = |change: Complex32| value.re * change.re + value.im * change.im;
        let power = scale * (value.norm_sqr() - variance * floor);
        let first = 2.0 * scale * (along(*x) + variance * tilts[0]);
        let second = 2.0 * scale * (along(*y) + variance * tilts[1]);
        *u = Complex32::new(power, first);
        *x = Complex32::new(second, 0.0);
    }
}

/// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform whose image times x and y has the
/// transforms x̂ and ŷ: ∂ of it is −i x̂.
#[inline(always)]
pub(super) fn sheared(x: Complex32, y: Complex32, [kx, ky]: [f32; 2]) -> [Complex32; 2] {
    let gx = Complex32::new(x.im, -x.re);
    let gy = Complex32::new(y.im, -y.re);
    [gx * kx - gy * ky, gx * ky + gy * kx]
}
