//! From real even spectra to lags of autocorrelations, and back.
//!
//! Lags are [`super::plane`]'s period over its number of lags apart, closer together than the modes would need: an
//! autocorrelation is multiplied by a weight with structure of its own. Sums over places as far apart as its own modes allow
//! would depend on whether a galaxy lies along the grid or across it.

use super::plane::Plane;
use shearq_quantities::product::{LANES, Matrix, ROWS, multiply};

/// Tables for lags dy = 0…reach, dx = −reach…reach.
#[derive(Debug, Clone)]
pub(super) struct Correlation {
    reach: usize,
    count: usize,
    rows: usize,
    width: usize,
    /// Rows and columns of lags from zero, filled up.
    lag_rows: usize,
    lag_width: usize,
    /// cos and sin by lag along y and mode, and by mode and lag along x: a mode stands for its opposite.
    down: [Vec<f32>; 2],
    across: [Vec<f32>; 2],
    /// The other way: by mode and lag along y, which stands for its opposite, and by lag along x and mode.
    down_back: [Vec<f32>; 2],
    across_back: [Vec<f32>; 2],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct CorrelationScratch {
    /// Halfway between modes and lags.
    between: Vec<f32>,
    /// Lags from zero, of both parities.
    lags: [Vec<f32>; 2],
}

impl Correlation {
    pub(super) fn new(reach: usize, plane: &Plane) -> Self {
        let step = std::f64::consts::TAU / plane.lags as f64;
        let angle = |lag: usize, mode: usize| step * (lag * mode) as f64;
        let twice = |at: usize| if at == 0 { 1.0 } else { 2.0 };
        let (lag_rows, lag_width) = (
            (reach + 1).next_multiple_of(ROWS),
            (reach + 1).next_multiple_of(LANES),
        );
        // Cosines and sines by two indices. The first or the second stands for its opposite, too.
        let tables = |used: [usize; 2], stored: [usize; 2], counted: Option<usize>| {
            [f64::cos, f64::sin].map(|wave| {
                let mut table = vec![0.0; stored[0] * stored[1]];
                for a in 0..used[0] {
                    for b in 0..used[1] {
                        let count = counted.map_or(1.0, |which| twice([a, b][which]));
                        table[a * stored[1] + b] = (count * wave(angle(a, b))) as f32;
                    }
                }
                table
            })
        };
        let (modes, lags) = (plane.modes + 1, reach + 1);
        Correlation {
            reach,
            count: modes,
            rows: plane.rows,
            width: plane.width,
            lag_rows,
            lag_width,
            down: tables([lags, modes], [lag_rows, plane.width], Some(1)),
            across: tables([modes, lags], [modes, lag_width], Some(0)),
            down_back: tables([modes, lags], [plane.rows, lag_width], Some(1)),
            across_back: tables([lags, modes], [lags, plane.width], None),
        }
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> CorrelationScratch {
        let (rows, width) = (self.rows.max(self.lag_rows), self.width.max(self.lag_width));
        CorrelationScratch {
            between: vec![0.0; rows * width],
            lags: std::array::from_fn(|_| vec![0.0; self.lag_rows * self.lag_width]),
        }
    }

    /// Places in a row of lags.
    fn places(&self) -> usize {
        2 * self.reach + 1
    }

    /// The image of a real even spectrum, given as cc and ss, at the lags: a sum over modes, without a scale.
    pub(super) fn lags(&self, spectrum: &[f32], scratch: &mut CorrelationScratch, out: &mut [f32]) {
        let (width, lag_width) = (self.width, self.lag_width);
        let between = &mut scratch.between[..self.lag_rows * width];
        let quarters = spectrum.chunks_exact(self.rows * width);
        for (parity, (quarter, lags)) in quarters.zip(&mut scratch.lags).enumerate() {
            let down = Matrix::new(&self.down[parity], width);
            multiply(
                down,
                Matrix::new(quarter, width),
                self.count,
                between,
                width,
            );
            let across = Matrix::new(&self.across[parity], lag_width);
            multiply(
                Matrix::new(between, width),
                across,
                self.count,
                lags,
                lag_width,
            );
        }
        let [even, odd] = &scratch.lags;
        let lines = even
            .chunks_exact(lag_width)
            .zip(odd.chunks_exact(lag_width));
        for (out, (even, odd)) in out.chunks_exact_mut(self.places()).zip(lines) {
            let (left, right) = out.split_at_mut(self.reach);
            for (out, (even, odd)) in right.iter_mut().zip(even.iter().zip(odd)) {
                *out = even + odd;
            }
            let opposite = even[1..].iter().zip(&odd[1..]);
            for (out, (even, odd)) in left.iter_mut().rev().zip(opposite) {
                *out = even - odd;
            }
        }
    }

    /// The adjoint of [`Correlation::lags`]: cc and ss of the real even spectrum of an even function of the lags.
    pub(super) fn spectrum(
        &self,
        values: &[f32],
        scratch: &mut CorrelationScratch,
        out: &mut [f32],
    ) {
        let (reach, width, lags) = (self.reach, self.width, self.reach + 1);
        let [even, odd] = &mut scratch.lags;
        let lines = even
            .chunks_exact_mut(self.lag_width)
            .zip(odd.chunks_exact_mut(self.lag_width));
        for (from, (even, odd)) in values.chunks_exact(self.places()).zip(lines) {
            let (left, right) = from.split_at(reach);
            even[0] = right[0];
            odd[0] = 0.0;
            let pairs = right[1..].iter().zip(left.iter().rev());
            let out = even[1..].iter_mut().zip(&mut odd[1..]);
            for ((even, odd), (right, left)) in out.zip(pairs) {
                *even = right + left;
                *odd = right - left;
            }
        }
        let between = &mut scratch.between[..self.lag_rows * width];
        let quarters = out.chunks_exact_mut(self.rows * width);
        for (parity, (quarter, folded)) in quarters.zip(&scratch.lags).enumerate() {
            let across = Matrix::new(&self.across_back[parity], width);
            multiply(
                Matrix::new(folded, self.lag_width),
                across,
                lags,
                between,
                width,
            );
            let down = Matrix::new(&self.down_back[parity], self.lag_width);
            multiply(down, Matrix::new(between, width), lags, quarter, width);
        }
    }
}
