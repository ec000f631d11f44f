//! Restores the modes of a stamp: what a PSF and shear did to them.

use multiversion::multiversion;
use shearq_quantities::linear::LANES;

use crate::transform::{Modes, Spectrum, four_lanes, lanes, store};

/// What the modes of a stamp are restored with.
pub(super) struct Restoration<'a> {
    /// v̂/û.
    pub(super) restore: &'a Modes,
    /// Changes of the PSF with the components of shear, in units of it.
    pub(super) tilts: &'a [Modes; 2],
    pub(super) waves: &'a [Vec<f32>; 2],
    /// Origin of the shear, (x, y) in pixels from the middle of the stamp.
    pub(super) origin: [f32; 2],
    /// What the edges of the stamp add to the changes of û.
    pub(super) edges: Option<[&'a Modes; 2]>,
}

// Replaces the transforms of a stamp and of it times x and y by v̂ and its changes, before the window: v̂/û times û, times
// p·(k_x ∂_x − k_y ∂_y)(û/p), and times p·(k_y ∂_x + k_x ∂_y)(û/p).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn restore(spectra: &mut [Spectrum; 3], with: &Restoration<'_>) {
    let quarter = spectra[0].0.len() / 4;
    let mut above = [[[0.0f32; LANES]; 2]; 3];
    let mut below = above;
    for at in (0..quarter).step_by(LANES) {
        {
            let [u, x, y] = &*spectra;
            let u = four_lanes(u.quarters(), at);
            let x = four_lanes(x.quarters(), at);
            let y = four_lanes(y.quarters(), at);
            restore_half(u, x, y, (at, -1.0), with, &mut above);
            restore_half(u, x, y, (quarter + at, 1.0), with, &mut below);
        }
        for k in 0..3 {
            let ([above_re, above_im], [below_re, below_im]) = (&above[k], &below[k]);
            let [mut cc, mut cs, mut sc, mut ss] = [[0.0f32; LANES]; 4];
            for l in 0..LANES {
                cc[l] = 0.5 * (below_re[l] + above_re[l]);
                cs[l] = 0.5 * (above_im[l] - below_im[l]);
                sc[l] = 0.5 * (above_im[l] + below_im[l]);
                ss[l] = 0.5 * (below_re[l] - above_re[l]);
            }
            store(spectra[k].quarters_mut(), at, [cc, cs, sc, ss]);
        }
    }
}

// The same for modes from place `at` on of all, with the sign of ss in their real part.
#[inline(always)]
fn restore_half(
    u: [&[f32; LANES]; 4],
    x: [&[f32; LANES]; 4],
    y: [&[f32; LANES]; 4],
    (at, sign): (usize, f32),
    with: &Restoration<'_>,
    out: &mut [[[f32; LANES]; 2]; 3],
) {
    let zeros = [0.0f32; LANES];
    let complex = |modes: &'_ Modes| [*lanes(&modes.re, at), *lanes(&modes.im, at)];
    let [edge1, edge2] = match with.edges {
        Some([first, second]) => [complex(first), complex(second)],
        None => [[zeros; 2]; 2],
    };
    let [tilt1, tilt2] = [complex(&with.tilts[0]), complex(&with.tilts[1])];
    let (restore, [x0, y0]) = (complex(with.restore), with.origin);
    let (kx, ky) = (lanes(&with.waves[0], at), lanes(&with.waves[1], at));
    let [[u_re, u_im], [first_re, first_im], [second_re, second_im]] = out;
    for l in 0..LANES {
        let [ur, ui] = mode_of(u, sign, l);
        let [xr, xi] = mode_of(x, sign, l);
        let [yr, yi] = mode_of(y, sign, l);
        let about_origin = ([xr - x0 * ur, xi - x0 * ui], [yr - y0 * ur, yi - y0 * ui]);
        let [[plus_re, plus_im], [cross_re, cross_im]] =
            sheared(about_origin.0, about_origin.1, kx[l], ky[l]);
        let of_psf = |tilt: &[[f32; LANES]; 2]| {
            let (re, im) = (tilt[0][l], tilt[1][l]);
            (re * ur - im * ui, re * ui + im * ur)
        };
        let (one, two) = (of_psf(&tilt1), of_psf(&tilt2));
        let (ar, ai) = (plus_re + edge1[0][l] - one.0, plus_im + edge1[1][l] - one.1);
        let br = cross_re + edge2[0][l] - two.0;
        let bi = cross_im + edge2[1][l] - two.1;
        let (re, im) = (restore[0][l], restore[1][l]);
        (u_re[l], u_im[l]) = (ur * re - ui * im, ur * im + ui * re);
        (first_re[l], first_im[l]) = (ar * re - ai * im, ar * im + ai * re);
        (second_re[l], second_im[l]) = (br * re - bi * im, br * im + bi * re);
    }
}

// The transform at a mode from the four parts of a spectrum, with the sign of ss in its real part.
#[inline(always)]
fn mode_of([cc, cs, sc, ss]: [&[f32; LANES]; 4], sign: f32, l: usize) -> [f32; 2] {
    [cc[l] + sign * ss[l], sc[l] - sign * cs[l]]
}

// (k_x ∂_x − k_y ∂_y) and (k_y ∂_x + k_x ∂_y) of a transform, from the transforms of its image times x and y: ∂ of it is
// −i x̂. Numbers are real and imaginary part.
#[inline(always)]
pub(super) fn sheared(x: [f32; 2], y: [f32; 2], kx: f32, ky: f32) -> [[f32; 2]; 2] {
    [
        [x[1] * kx - y[1] * ky, y[0] * ky - x[0] * kx],
        [x[1] * ky + y[1] * kx, -(x[0] * ky + y[0] * kx)],
    ]
}
