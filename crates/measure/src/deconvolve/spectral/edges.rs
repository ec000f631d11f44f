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
use shearq_fourier::Complex32;

use super::plane::{Plane, PlaneScratch, parts};

/// Pairs of real lines: the edges, and the edges times the position along them. See
/// docs/constants.md.
const PAIRS: usize = 4;

/// The edges of stamps of one size.
#[derive(Debug, Clone)]
pub(super) struct Edges {
    n: usize,
    /// Phase of each frequency of the coarse grid at the first and the last edge of an axis.
    phases: Vec<[Complex32; 2]>,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct EdgesScratch {
    /// Left and right edge, the same times y, lower and upper edge, and the same times x.
    lines: Vec<Complex32>,
    /// Of each frequency along an edge, what the pairs add: first edge and last one.
    terms: [Vec<[Complex32; 2]>; PAIRS],
}

impl Edges {
    /// Of stamps of n×n pixels.
    pub(super) fn new(n: usize, plane: &Plane) -> Self {
        let phases = (0..plane.side).map(|at| {
            let k = plane.wave(at);
            let at_edge = |x: f64| Complex32::from_polar(1.0, (-k * x) as f32);
            [at_edge(-0.5), at_edge(n as f64 - 0.5)]
        });
        Edges {
            n,
            phases: phases.collect(),
        }
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self, plane: &Plane) -> EdgesScratch {
        EdgesScratch {
            lines: vec![Complex32::ZERO; PAIRS * plane.size],
            terms: std::array::from_fn(|_| vec![[Complex32::ZERO; 2]; plane.side]),
        }
    }

    /// Writes to `scratch` what edges of `stamp` add to its changes under shears about `centre`, (x, y) in pixels from the middle.
    pub(super) fn take(
        &self,
        stamp: &[f32],
        [x0, y0]: [f32; 2],
        plane: &Plane,
        fft: &mut PlaneScratch,
        scratch: &mut EdgesScratch,
    ) {
        let (n, size) = (self.n, plane.size);
        let middle = (n as f32 - 1.0) / 2.0;
        let EdgesScratch { lines, terms } = scratch;
        lines.fill(Complex32::ZERO);
        for at in 0..n {
            // Half a pixel outwards, along a straight line.
            let edge = |first: usize, step: usize| {
                let beyond = |a: usize, b: usize| 1.5 * stamp[a] - 0.5 * stamp[b];
                let last = first + (n - 1) * step;
                Complex32::new(beyond(first, first + step), beyond(last, last - step))
            };
            let (side, level) = (edge(at * n, 1), edge(at, n));
            let place = at as f32 - middle;
            lines[at] = side;
            lines[size + at] = side * (place - y0);
            lines[2 * size + at] = level;
            lines[3 * size + at] = level * (place - x0);
        }
        plane.along(lines, fft);
        // What v·∇T is on either edge, beside the place along it.
        let half = n as f32 / 2.0;
        let factors = [
            [-(half + x0), -(half - x0)],
            [1.0, -1.0],
            [half + y0, half - y0],
            [1.0, -1.0],
        ];
        let pairs = lines.chunks_exact(size).zip(terms).zip(factors);
        for ((line, terms), [first, last]) in pairs {
            for (at, out) in terms.iter_mut().enumerate() {
                let here = if 2 * at > plane.side {
                    size + at - plane.side
                } else {
                    at
                };
                let opposite = if here == 0 { 0 } else { size - here };
                let [one, other] = parts(line[here], line[opposite]);
                *out = [one * first, other * last];
            }
        }
    }

    /// Adds what was taken, times `restore`, to the half spectra of the changes with γ₁ and γ₂.
    pub(super) fn add(
        &self,
        scratch: &EdgesScratch,
        restore: &[Complex32],
        first: &mut [Complex32],
        second: &mut [Complex32],
    ) {
        let side = self.phases.len();
        let [sides, sides_y, levels, levels_x] = &scratch.terms;
        let columns = first
            .chunks_exact_mut(side)
            .zip(second.chunks_exact_mut(side));
        for (x, ((first, second), restore)) in columns.zip(restore.chunks_exact(side)).enumerate() {
            add_column(
                first,
                restore,
                self.phases[x],
                sides,
                levels[x],
                &self.phases,
            );
            add_column(
                second,
                restore,
                self.phases[x],
                sides_y,
                levels_x[x],
                &self.phases,
            );
        }
    }
}

/// Adds to a column of modes what the left and right edge have of them, and what the lower and upper edge have of the column.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_column(
    to: &mut [Complex32],
    restore: &[Complex32],
    across: [Complex32; 2],
    sides: &[[Complex32; 2]],
    level: [Complex32; 2],
    down: &[[Complex32; 2]],
) {
    let edges = sides.iter().zip(down);
    for ((to, restore), (side, down)) in to.iter_mut().zip(restore).zip(edges) {
        let sum =
            side[0] * across[0] + side[1] * across[1] + level[0] * down[0] + level[1] * down[1];
        *to += restore * sum;
    }
}
