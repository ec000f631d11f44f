//! From the transforms of a stamp, and of it times x and y, to v̂ and its changes with the components of shear.

use multiversion::multiversion;

use super::modes::sheared;
use super::parities::{four, lanes, lanes_mut, parts};
use super::plane::{Modes, Quarters};
use shearq_quantities::product::LANES;

/// What the modes of a stamp are restored with.
pub(super) struct Restoration<'a> {
    /// v̂/û.
    pub(super) restore: &'a Modes,
    /// Changes of the PSF with the components of shear, in units of it.
    pub(super) tilts: &'a [Modes; 2],
    /// k_x and k_y of each mode.
    pub(super) waves: &'a [Vec<f32>; 2],
    /// Origin of the shear, (x, y) in pixels from the middle of the stamp.
    pub(super) centre: [f32; 2],
    /// What the edges of the stamp add to the changes of û.
    pub(super) edges: Option<[&'a Modes; 2]>,
}

/// Replaces the transforms of a stamp and of it times x and y by v̂ and its changes, before the window: v̂/û times û, times
/// p·(k_x ∂_x − k_y ∂_y)(û/p), and times p·(k_y ∂_x + k_x ∂_y)(û/p).
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn restore(spectra: &mut [Quarters; 3], with: &Restoration<'_>) {
    let quarter = spectra[0].0.len() / 4;
    let mut above = [[[0.0f32; LANES]; 2]; 3];
    let mut below = above;
    for at in (0..quarter).step_by(LANES) {
        {
            let [u, x, y] = &*spectra;
            let u = four(parts(&u.0, quarter), at);
            let x = four(parts(&x.0, quarter), at);
            let y = four(parts(&y.0, quarter), at);
            restore_half(u, x, y, (at, -1.0), with, &mut above);
            restore_half(u, x, y, (quarter + at, 1.0), with, &mut below);
        }
        for k in 0..3 {
            let ([above_re, above_im], [below_re, below_im]) = (&above[k], &below[k]);
            let mut out = [[0.0f32; LANES]; 4];
            for l in 0..LANES {
                out[0][l] = 0.5 * (below_re[l] + above_re[l]);
                out[1][l] = 0.5 * (above_im[l] - below_im[l]);
                out[2][l] = 0.5 * (above_im[l] + below_im[l]);
                out[3][l] = 0.5 * (below_re[l] - above_re[l]);
            }
            for (part, out) in spectra[k].each().into_iter().zip(out) {
                *lanes_mut(part, at) = out;
            }
        }
    }
}

/// The same for modes from place `at` on of all, with the sign of ss in their real part.
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
    let [edge1, edge2] = match with.edges {
        Some([first, second]) => [complex(first, at), complex(second, at)],
        None => [[&zeros; 2]; 2],
    };
    let [tilt1, tilt2] = [complex(&with.tilts[0], at), complex(&with.tilts[1], at)];
    let (restore, [x0, y0]) = (complex(with.restore, at), with.centre);
    let (kx, ky) = (lanes(&with.waves[0], at), lanes(&with.waves[1], at));
    let [[u_re, u_im], [first_re, first_im], [second_re, second_im]] = out;
    for l in 0..LANES {
        let (ur, ui) = (u[0][l] + sign * u[3][l], u[2][l] - sign * u[1][l]);
        let (xr, xi) = (
            x[0][l] + sign * x[3][l] - x0 * ur,
            x[2][l] - sign * x[1][l] - x0 * ui,
        );
        let (yr, yi) = (
            y[0][l] + sign * y[3][l] - y0 * ur,
            y[2][l] - sign * y[1][l] - y0 * ui,
        );
        let [[plus_re, plus_im], [cross_re, cross_im]] = sheared([xr, xi], [yr, yi], kx[l], ky[l]);
        let of_psf = |tilt: [&[f32; LANES]; 2]| {
            let (re, im) = (tilt[0][l], tilt[1][l]);
            (re * ur - im * ui, re * ui + im * ur)
        };
        let (one, two) = (of_psf(tilt1), of_psf(tilt2));
        let (ar, ai) = (plus_re + edge1[0][l] - one.0, plus_im + edge1[1][l] - one.1);
        let (br, bi) = (
            cross_re + edge2[0][l] - two.0,
            cross_im + edge2[1][l] - two.1,
        );
        let (re, im) = (restore[0][l], restore[1][l]);
        (u_re[l], u_im[l]) = (ur * re - ui * im, ur * im + ui * re);
        (first_re[l], first_im[l]) = (ar * re - ai * im, ar * im + ai * re);
        (second_re[l], second_im[l]) = (br * re - bi * im, br * im + bi * re);
    }
}

#[inline(always)]
fn complex(modes: &Modes, at: usize) -> [&[f32; LANES]; 2] {
    [lanes(&modes.re, at), lanes(&modes.im, at)]
}
