//! Centroids of galaxies and stars under a Gaussian weight that follows them.

use ndarray::ArrayView2;

use crate::pixel::{Pixel, contiguous};

// Narrow, so that a centroid does not follow noise: at S/N 20 it is good to 0.2 px. Chosen by hand.
pub(crate) const WEIGHT_SIGMA: f64 = 2.0;
// Three σ.
const WEIGHT_HALF_SIDE: usize = 6;
const WEIGHT_SIDE: usize = 2 * WEIGHT_HALF_SIDE;
// The weighted centroid falls short of the centre: of a Gaussian of σ = 2 px it goes half the way. Chosen by hand.
const STEP_FACTOR: f64 = 1.5;

// Of the offset of a Gaussian of σ = 3 px, three steps leave 0.16. Chosen by hand.
const GALAXY_STEPS: usize = 3;
// A weighted centroid of one σ of the weight. Chosen by hand.
const MAX_GALAXY_STEP: f64 = 3.0;
// S/N ν under the weight at which half of a centroid is the origin of the shear. The noise of a centroid correlates with that of the
// response: whole centroids would make m about +1e-3 (20/ν)² (tests/stress --cases off1,off2,off3), with 30 it is below 0.3e-3 at any ν.
const HALF_CENTROID_SNR: f64 = 30.0;

// A star of FWHM 10 px is found to 10⁻³ px. Chosen by hand.
const MAX_STAR_STEPS: usize = 40;
// Chosen by hand.
const CONVERGED_STEP: f64 = 1e-3;
// Largest distance of a star's centroid from the start of the search, in pixels.
// Farther away it is another object. Chosen by hand.
pub(crate) const MAX_STAR_SHIFT: f64 = 3.0;

/// Offset (x, y) of the galaxy from the centre of its stamp of `n` pixels a side; zero if there is no light.
pub(crate) fn galaxy_centroid(stamp: &[f32], n: usize) -> [f32; 2] {
    galaxy_centroid_near(stamp, n, [0.0; 2])
}

/// The same of a galaxy that is expected at `start` from the centre, which it is if there is no light. Steps that fall short of the
/// centroid leave no part of an offset that was expected.
pub(crate) fn galaxy_centroid_near(stamp: &[f32], n: usize, start: [f64; 2]) -> [f32; 2] {
    centroid_and_light(stamp, n, start).0
}

/// Place (x, y) about which a shear deforms the galaxy, from the centre of its stamp of `n` pixels a side in noise of this level.
pub(crate) fn shear_origin(stamp: &[f32], n: usize, noise: f64) -> [f32; 2] {
    let (centroid, light) = centroid_and_light(stamp, n, [0.0; 2]);
    // The integral of the squared weight is πσ².
    let snr = light / (noise * WEIGHT_SIGMA * std::f64::consts::PI.sqrt());
    let share = 1.0 / (1.0 + (HALF_CENTROID_SNR / snr).powi(4));
    centroid.map(|at| at * share as f32)
}

// The centroid of `galaxy_centroid_near`, and the light under its last weight.
fn centroid_and_light(stamp: &[f32], n: usize, start: [f64; 2]) -> ([f32; 2], f64) {
    let centre = (n as f64 - 1.0) / 2.0;
    let bound = centre / 2.0;
    let (mut offset, mut light) = (start, 0.0);
    for _ in 0..GALAXY_STEPS {
        let row = |y: usize| &stamp[y * n..][..n];
        let Some((step, under_weight)) = step([n; 2], row, offset.map(|at| centre + at)) else {
            return (start.map(|at| at as f32), 0.0);
        };
        light = under_weight;
        for (at, step) in offset.iter_mut().zip(step) {
            let step = step.clamp(-MAX_GALAXY_STEP, MAX_GALAXY_STEP);
            *at = (*at + step).clamp(-bound, bound);
        }
    }
    (offset.map(|at| at as f32), light)
}

/// Centroid (x, y) of a star near `start`, in pixels from the first; `start` if the search leaves it or finds no light.
pub(crate) fn star_centroid<P: Pixel>(stamp: ArrayView2<'_, P>, start: [f64; 2]) -> [f64; 2] {
    let (rows, columns) = stamp.dim();
    let mut at = start;
    for _ in 0..MAX_STAR_STEPS {
        let row = |y: usize| contiguous(stamp.row(y));
        let Some((step, _)) = step([columns, rows], row, at) else {
            return start;
        };
        for k in 0..2 {
            at[k] += step[k];
            if (at[k] - start[k]).abs() > MAX_STAR_SHIFT {
                return start;
            }
        }
        if step.iter().all(|step| step.abs() < CONVERGED_STEP) {
            break;
        }
    }
    at
}

/// The step from `at` towards the centroid, and the light under the weight; `None` without light.
fn step<P: Pixel, R: AsRef<[P]>>(
    [columns, rows]: [usize; 2],
    row: impl Fn(usize) -> R,
    at: [f64; 2],
) -> Option<([f64; 2], f64)> {
    let [first_x, first_y] = at.map(|at| at.floor() as isize + 1 - WEIGHT_HALF_SIDE as isize);
    let weights_x = weights(first_x as f64 - at[0]);
    let weights_y = weights(first_y as f64 - at[1]);
    let on_stamp = |first: isize, side: usize| {
        let start = first.min(0).unsigned_abs().min(WEIGHT_SIDE);
        start..(side as isize - first).clamp(start as isize, WEIGHT_SIDE as isize) as usize
    };
    let (xs, ys) = (on_stamp(first_x, columns), on_stamp(first_y, rows));
    let (mut light, mut first) = (0.0, [0.0; 2]);
    for y in ys {
        let row = row((first_y + y as isize) as usize);
        let pixels = &row.as_ref()[(first_x + xs.start as isize) as usize..];
        let (mut of_row, mut along_row) = (0.0, 0.0);
        for (x, pixel) in xs.clone().zip(pixels) {
            let weighted = weights_x[x] * Into::<f64>::into(*pixel);
            of_row += weighted;
            along_row += weighted * ((first_x + x as isize) as f64 - at[0]);
        }
        let dy = (first_y + y as isize) as f64 - at[1];
        light += weights_y[y] * of_row;
        first[0] += weights_y[y] * along_row;
        first[1] += weights_y[y] * of_row * dy;
    }
    // Not of a stamp with pixels that are NaN, which the caller sees in the result.
    if light <= 0.0 {
        return None;
    }
    Some((first.map(|sum| STEP_FACTOR * sum / light), light))
}

/// The weight at places one pixel apart, the first of which is `first` pixels from its centre.
fn weights(first: f64) -> [f64; WEIGHT_SIDE] {
    // exp(−(x + 1)²/2σ²) is exp(−x²/2σ²) times exp(−(2x + 1)/2σ²), whose ratio from place to place is exp(−1/σ²): three
    // exponentials in place of twelve.
    let square = WEIGHT_SIGMA * WEIGHT_SIGMA;
    let mut value = (-0.5 * first * first / square).exp();
    let mut factor = (-(first + 0.5) / square).exp();
    let ratio = (-1.0 / square).exp();
    std::array::from_fn(|_| {
        let here = value;
        value *= factor;
        factor *= ratio;
        here
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 48;

    #[test]
    fn centroids_of_galaxies_are_found() {
        for (x, y) in [(0.0, 0.0), (1.0, -0.5), (-3.0, 1.5), (0.3, 4.0)] {
            let stamp: Vec<f32> = (0..N * N)
                .map(|at| {
                    let (dx, dy) = ((at % N) as f32 - 23.5 - x, (at / N) as f32 - 23.5 - y);
                    10.0 * (-(dx * dx + dy * dy) / 18.0).exp()
                })
                .collect();
            let found = galaxy_centroid(&stamp, N);
            // For a Gaussian of 3 px a step goes 1.5 · 4/(4 + 9) of the way; three of them leave 0.16 of it.
            let rest = (found[0] - x).hypot(found[1] - y);
            assert!(rest < 0.16 * x.hypot(y) + 0.01, "{found:?} {x} {y}");
        }
        assert_eq!(galaxy_centroid(&[-1.0; N * N], N), [0.0; 2]);
        assert_eq!(shear_origin(&[-1.0; N * N], N, 1.0), [0.0; 2]);
    }

    #[test]
    fn noisy_centroids_are_no_origins_of_shear() {
        let stamp: Vec<f32> = (0..N * N)
            .map(|at| 1.0 + 0.01 * ((at % N) as f32 - 23.5))
            .collect();
        let centroid = galaxy_centroid(&stamp, N)[0];
        assert!(centroid > 0.05);
        // About one per pixel has a light of 2πσ² under the weight.
        let noise = |snr: f64| 2.0 * std::f64::consts::PI.sqrt() * WEIGHT_SIGMA / snr;
        for (snr, share) in [
            (f64::INFINITY, 1.0),
            (HALF_CENTROID_SNR, 0.5),
            (10.0, 1.0 / 82.0),
        ] {
            let found = shear_origin(&stamp, N, noise(snr))[0] / centroid;
            // The stamp is a little brighter about the centroid.
            assert!((found / share - 1.0).abs() < 0.06, "{snr}: {found}");
        }
    }
}
