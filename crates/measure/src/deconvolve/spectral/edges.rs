//! The light that a shear takes across the edges of a stamp.
//!
//! A shear γ moves light by v per γ, v = (x, −y) for γ₁ and (y, x) for γ₂, so that an image I changes by −v·∇I = −∇·(vI). What
//! the transform of the stamp tells is the change of TI, T being one on the stamp and zero beyond: −∇·(vTI), as if
//! the edges went with the light. They stay:
//!
//! ```text
//! −T ∇·(vI) = −∇·(vTI) + I v·∇T.
//! ```
//!
//! The last term is on the edges alone, half a pixel beyond the middles of the last pixels. It matters where a wide window
//! sees a large galaxy's light there.

use multiversion::multiversion;

use super::pixels::{Pixels, PixelsScratch};
use super::plane::{Modes, Plane};
use shearq_quantities::product::ROWS;

/// The edges of stamps of one size.
#[derive(Debug, Clone)]
pub(super) struct Edges {
    n: usize,
    rows: usize,
    /// cos and sin of half a stamp for each frequency along an axis: the phase at the first edge. That at the last is its
    /// conjugate.
    phase: [Vec<f32>; 2],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct EdgesScratch {
    /// Left and right edge, the same times y, lower and upper edge, and the same times x.
    lines: Vec<f32>,
    /// Of each of them and each frequency along it, real and imaginary part.
    re: Vec<f32>,
    im: Vec<f32>,
}

impl Edges {
    /// Of stamps of n×n pixels.
    pub(super) fn new(n: usize, plane: &Plane) -> Self {
        let phase = [f64::cos, f64::sin].map(|wave| {
            let mut table = vec![0.0; plane.width];
            for (k, value) in table.iter_mut().enumerate().take(plane.modes + 1) {
                *value = wave(plane.wave(k) * n as f64 / 2.0) as f32;
            }
            table
        });
        Edges {
            n,
            rows: plane.rows,
            phase,
        }
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> EdgesScratch {
        let width = self.phase[0].len();
        EdgesScratch {
            lines: vec![0.0; ROWS * self.n],
            re: vec![0.0; ROWS * width],
            im: vec![0.0; ROWS * width],
        }
    }

    /// Writes what edges of `stamp` add to its changes with γ₁ and γ₂ about `centre`, (x, y) in pixels from the middle.
    pub(super) fn take(
        &self,
        stamp: &[f32],
        [x0, y0]: [f32; 2],
        (pixels, fft): (&Pixels, &mut PixelsScratch),
        scratch: &mut EdgesScratch,
        changes: [&mut Modes; 2],
    ) {
        let n = self.n;
        let middle = (n as f32 - 1.0) / 2.0;
        // What v·∇T is on either edge, beside the place along it.
        let half = n as f32 / 2.0;
        let factors = [
            [-(half + x0), -(half - x0)],
            [1.0, -1.0],
            [half + y0, half - y0],
            [1.0, -1.0],
        ];
        let EdgesScratch { lines, re, im } = scratch;
        for at in 0..n {
            // Half a pixel outwards, along a straight line.
            let edge = |first: usize, step: usize| {
                let beyond = |a: usize, b: usize| 1.5 * stamp[a] - 0.5 * stamp[b];
                let last = first + (n - 1) * step;
                [beyond(first, first + step), beyond(last, last - step)]
            };
            let (side, level) = (edge(at * n, 1), edge(at, n));
            let place = at as f32 - middle;
            let values = [
                side,
                side.map(|value| value * (place - y0)),
                level,
                level.map(|value| value * (place - x0)),
            ];
            for (line, (values, factors)) in values.iter().zip(factors).enumerate() {
                for edge in 0..2 {
                    lines[(2 * line + edge) * n + at] = values[edge] * factors[edge];
                }
            }
        }
        pixels.transform_lines(lines, fft, [re, im]);
        let width = pixels.columns();
        let line = |k: usize| [&re[k * width..][..width], &im[k * width..][..width]];
        for (which, change) in changes.into_iter().enumerate() {
            let sides = [line(2 * which), line(2 * which + 1)];
            let levels = [line(2 * which + 4), line(2 * which + 5)];
            change.re.fill(0.0);
            change.im.fill(0.0);
            let halves = change.re.len() / 2;
            for (below, start) in [(false, 0), (true, halves)] {
                let (re, im) = (&mut change.re[start..], &mut change.im[start..]);
                let lines = re.chunks_exact_mut(width).zip(im.chunks_exact_mut(width));
                for (y, (re, im)) in lines.take(self.rows).enumerate() {
                    // Real lines have conjugate transforms at opposite frequencies.
                    let sign = if below { -1.0 } else { 1.0 };
                    let at = |line: [&[f32]; 2]| [line[0][y], sign * line[1][y]];
                    let phase = [self.phase[0][y], sign * self.phase[1][y]];
                    let [cos, sin] = &self.phase;
                    add_line([re, im], sides.map(at), [cos, sin], levels, phase);
                }
            }
        }
    }
}

/// Adds the edges to a row of modes: the first and the last edge across, of phases `across`, and the first and the last edge
/// along it, of phase `down`. The last edge has the conjugate phase of the first one.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_line(
    to: [&mut [f32]; 2],
    sides: [[f32; 2]; 2],
    across: [&[f32]; 2],
    levels: [[&[f32]; 2]; 2],
    down: [f32; 2],
) {
    let [re, im] = to;
    let [first, last] = sides;
    let [[first_re, first_im], [last_re, last_im]] = levels;
    // a·exp(iφ) + b·exp(−iφ) = (a + b) cos φ + i(a − b) sin φ.
    let (sum, difference) = (
        [first[0] + last[0], first[1] + last[1]],
        [first[0] - last[0], first[1] - last[1]],
    );
    for x in 0..re.len() {
        let (cos, sin) = (across[0][x], across[1][x]);
        let levels_sum = [first_re[x] + last_re[x], first_im[x] + last_im[x]];
        let levels_difference = [first_re[x] - last_re[x], first_im[x] - last_im[x]];
        re[x] += sum[0] * cos - difference[1] * sin + levels_sum[0] * down[0]
            - levels_difference[1] * down[1];
        im[x] += sum[1] * cos
            + difference[0] * sin
            + levels_sum[1] * down[0]
            + levels_difference[0] * down[1];
    }
}
