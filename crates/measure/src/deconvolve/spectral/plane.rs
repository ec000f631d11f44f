//! The transforms behind the linear network: from a stamp to its low modes, from these to images on a
//! coarse grid and back, and from real even spectra to lags.
//!
//! The plane is periodic with a period of `size` pixels. Of its modes only those with indices
//! |j| ≤ `modes` along each axis are kept; images of them are sampled without loss at `side` < `size`
//! places an axis, `size/side` pixels apart, the first at the stamp's first pixel. Half spectra have
//! `modes + 1` columns (frequencies along x) of `side` frequencies along y, in the order of the
//! transform. Lags are [`FINER`] times closer together: an autocorrelation is multiplied by a weight with
//! structure of its own, and sums over places as far apart as its own modes allow would depend on
//! whether a galaxy lies along the grid or across it.

use multiversion::multiversion;
use shearq_fourier::{Complex32, Plan32, Planner32};

use crate::fft::transform_size;

/// Least number of lags per pixel of the coarse grid, along an axis. See docs/constants.md.
const FINER: f64 = 1.5;

/// Plans for one size.
#[derive(Clone)]
pub(super) struct Plane {
    /// Period in pixels.
    pub(super) size: usize,
    /// Places along an axis of the coarse grid.
    pub(super) side: usize,
    /// Largest index of a mode.
    pub(super) modes: usize,
    /// Lags along an axis.
    pub(super) lags: usize,
    wide: Plan32,
    forward: Plan32,
    backward: Plan32,
    fine: Plan32,
}

impl std::fmt::Debug for Plane {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Plane")
            .field("size", &self.size)
            .field("side", &self.side)
            .field("modes", &self.modes)
            .finish_non_exhaustive()
    }
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct PlaneScratch {
    /// Rows of an image, and of it times x.
    rows: Vec<Complex32>,
    /// Columns of the transforms of an image, and of it times x and y: the low modes along x and all
    /// along y.
    wide: [Vec<Complex32>; 3],
    /// Half spectra of three images.
    pub(super) half: [Vec<Complex32>; 3],
    /// Two rows of an image as real and imaginary part of one.
    pairs: Vec<Complex32>,
    /// Columns of an autocorrelation's spectrum, and its rows.
    fine: [Vec<Complex32>; 2],
    fft: Vec<Complex32>,
}

impl Plane {
    /// A plane of at least `least` pixels (a power of two, which transforms fastest) that keeps wave
    /// numbers up to `cut` radians per pixel.
    pub(super) fn new(least: usize, cut: f64) -> Self {
        let size = least.next_power_of_two();
        let places = cut * size as f64 / std::f64::consts::PI;
        let side = transform_size(places.ceil() as usize + 2).min(size);
        let lags = transform_size((FINER * side as f64).ceil() as usize);
        let mut planner = Planner32::new();
        Plane {
            size,
            side,
            modes: side / 2 - 1,
            lags,
            wide: planner.forward(size),
            forward: planner.forward(side),
            backward: planner.inverse(side),
            fine: planner.inverse(lags),
        }
    }

    /// Place in a half spectrum of the mode at `at` turned by 90 degrees, or of its opposite.
    pub(super) fn turned(&self, at: usize) -> usize {
        let (x, y) = (at / self.side, at % self.side);
        // (k_x, k_y) becomes (k_y, −k_x).
        if y <= self.modes {
            y * self.side + (self.side - x) % self.side
        } else if y < self.side - self.modes {
            // No mode is kept here.
            at
        } else {
            (self.side - y) * self.side + x
        }
    }

    /// Buffers for images of up to `n` rows.
    pub(super) fn scratch(&self, n: usize) -> PlaneScratch {
        let zeros = |count| vec![Complex32::ZERO; count];
        let plans = [&self.wide, &self.forward, &self.backward, &self.fine];
        let fft = plans.map(|plan| plan.get_inplace_scratch_len());
        PlaneScratch {
            rows: zeros(n * self.size),
            wide: std::array::from_fn(|_| zeros((self.modes + 1) * self.size)),
            half: std::array::from_fn(|_| self.spectrum()),
            pairs: zeros(self.side * self.side),
            fine: [self.columns(), self.lags].map(|lines| zeros(lines * self.lags)),
            fft: zeros(fft.into_iter().max().unwrap_or(0)),
        }
    }

    /// A half spectrum of zeros.
    pub(super) fn spectrum(&self) -> Vec<Complex32> {
        vec![Complex32::ZERO; self.columns() * self.side]
    }

    /// Frequencies along x.
    pub(super) fn columns(&self) -> usize {
        self.modes + 1
    }

    /// Pixels between places of the coarse grid.
    pub(super) fn spacing(&self) -> f64 {
        self.size as f64 / self.side as f64
    }

    /// Pixels between lags.
    pub(super) fn lag_spacing(&self) -> f64 {
        self.size as f64 / self.lags as f64
    }

    /// Wave number of frequency `at` of the coarse grid, in radians per pixel.
    pub(super) fn wave(&self, at: usize) -> f64 {
        let signed = if 2 * at > self.side {
            at as f64 - self.side as f64
        } else {
            at as f64
        };
        std::f64::consts::TAU * signed / self.size as f64
    }

    /// Kept modes of an image of n×n pixels, and of it times x and y from its middle, to
    /// `scratch.half`.
    pub(super) fn transform(&self, image: &[f32], n: usize, scratch: &mut PlaneScratch) {
        let PlaneScratch {
            rows,
            wide: [u, x, y],
            half,
            fft,
            ..
        } = scratch;
        let size = self.size;
        let middle = (n as f32 - 1.0) / 2.0;
        let rows = &mut rows[..n * size];
        weigh(image, n, middle, rows, size);
        self.wide.process_with_scratch(rows, fft);
        for column in 0..self.columns() {
            let at = column * size..(column + 1) * size;
            let (u, x, y) = (&mut u[at.clone()], &mut x[at.clone()], &mut y[at]);
            split(rows, size, column, u, x);
            for (j, (out, value)) in y[..n].iter_mut().zip(&u[..n]).enumerate() {
                *out = value * (j as f32 - middle);
            }
            for line in [u, x, y] {
                line[n..].fill(Complex32::ZERO);
            }
        }
        for (wide, half) in [u, x, y].into_iter().zip(half) {
            self.wide.process_with_scratch(wide, fft);
            let columns = wide.chunks_exact(size);
            for (from, to) in columns.zip(half.chunks_exact_mut(self.side)) {
                self.take_modes(from, to);
            }
        }
    }

    /// Copies the kept modes of a line of frequencies to a line of another length, whose other modes are zero.
    #[inline]
    fn take_modes(&self, from: &[Complex32], to: &mut [Complex32]) {
        let (low, count) = (self.modes + 1, to.len());
        to[..low].copy_from_slice(&from[..low]);
        to[low..count - self.modes].fill(Complex32::ZERO);
        to[count - self.modes..].copy_from_slice(&from[from.len() - self.modes..]);
    }

    /// Transforms lines of `size` pixels in place.
    pub(super) fn along(&self, lines: &mut [Complex32], scratch: &mut PlaneScratch) {
        self.wide.process_with_scratch(lines, &mut scratch.fft);
    }

    /// Multiplies the images of the half spectra by `along` x and `down` y, and transforms again:
    /// `side²` times too large.
    pub(super) fn window(&self, along: &[f32], down: &[f32], scratch: &mut PlaneScratch) {
        let PlaneScratch {
            half, pairs, fft, ..
        } = scratch;
        let side = self.side;
        let lower = side / 2;
        let pairs = &mut pairs[..lower * side];
        for half in half {
            self.backward.process_with_scratch(half, fft);
            join_rows(half, side, self.modes, pairs);
            self.backward.process_with_scratch(pairs, fft);
            multiply(pairs, along, down);
            self.forward.process_with_scratch(pairs, fft);
            split_rows(pairs, side, half);
            self.forward.process_with_scratch(half, fft);
        }
    }

    /// The half spectrum of the window that is `along` x and `down` y.
    pub(super) fn window_modes(
        &self,
        along: &[f32],
        down: &[f32],
        scratch: &mut PlaneScratch,
        out: &mut [Complex32],
    ) {
        let side = self.side;
        let (both, rest) = scratch.pairs.split_at_mut(side);
        for (value, (x, y)) in both.iter_mut().zip(along.iter().zip(down)) {
            *value = Complex32::new(*x, *y);
        }
        self.forward.process_with_scratch(both, &mut scratch.fft);
        let modes = |k: usize| parts(both[k], both[(side - k) % side]);
        let down = &mut rest[..side];
        for (k, value) in down.iter_mut().enumerate() {
            *value = modes(k)[1];
        }
        for (column, line) in out.chunks_exact_mut(side).enumerate() {
            let [along, _] = modes(column);
            for (value, down) in line.iter_mut().zip(&*down) {
                *value = along * down;
            }
        }
    }

    /// The adjoint of [`Plane::lags`]: the real even spectra, as real and imaginary part of `half[which]`, of two even
    /// functions of the lags that `values` gives as real and imaginary part.
    pub(super) fn spectra_of_lags(
        &self,
        which: usize,
        reach: usize,
        scratch: &mut PlaneScratch,
        values: &[Complex32],
    ) {
        let PlaneScratch {
            half,
            fine: [columns, rows],
            fft,
            ..
        } = scratch;
        let (side, lags) = (self.side, self.lags);
        let width = 2 * reach + 1;
        let rows = &mut rows[..(reach + 1) * lags];
        for (line, from) in rows.chunks_exact_mut(lags).zip(values.chunks_exact(width)) {
            line[..=reach].copy_from_slice(&from[reach..]);
            line[reach + 1..lags - reach].fill(Complex32::ZERO);
            line[lags - reach..].copy_from_slice(&from[..reach]);
        }
        // The transforms of even functions are the same in both directions.
        self.fine.process_with_scratch(rows, fft);
        let columns = &mut columns[..self.columns() * lags];
        for (column, line) in columns.chunks_exact_mut(lags).enumerate() {
            line.fill(Complex32::ZERO);
            let opposite = (lags - column) % lags;
            for (y, row) in rows.chunks_exact(lags).enumerate() {
                line[y] = row[column];
                if y > 0 {
                    // The function is even: row −y is row y from right to left.
                    line[lags - y] = row[opposite];
                }
            }
        }
        self.fine.process_with_scratch(columns, fft);
        let lines = columns.chunks_exact(lags);
        for (from, to) in lines.zip(half[which].chunks_exact_mut(side)) {
            self.take_modes(from, to);
        }
    }

    /// Images of the real even spectra that are real and imaginary part of `half[which]`, at lags
    /// dy = 0…reach, dx = −reach…reach; a sum over modes, without a scale.
    pub(super) fn lags(
        &self,
        which: usize,
        reach: usize,
        scratch: &mut PlaneScratch,
        mut out: impl FnMut(usize, Complex32),
    ) {
        let PlaneScratch {
            half,
            fine: [columns, rows],
            fft,
            ..
        } = scratch;
        let (side, lags) = (self.side, self.lags);
        let lines = half[which].chunks_exact(side);
        for (from, to) in lines.zip(columns.chunks_exact_mut(lags)) {
            self.take_modes(from, to);
        }
        self.fine.process_with_scratch(columns, fft);
        let rows = &mut rows[..(reach + 1) * lags];
        for (y, line) in rows.chunks_exact_mut(lags).enumerate() {
            // The spectrum is even: what column −kx holds at y, column kx holds at −y.
            let opposite = (lags - y) % lags;
            line[0] = columns[y];
            line[self.modes + 1..lags - self.modes].fill(Complex32::ZERO);
            for column in 1..=self.modes {
                line[column] = columns[column * lags + y];
                line[lags - column] = columns[column * lags + opposite];
            }
        }
        self.fine.process_with_scratch(rows, fft);
        let width = 2 * reach + 1;
        for (y, line) in rows.chunks_exact(lags).enumerate() {
            for (x, value) in line[..=reach].iter().enumerate() {
                out(y * width + reach + x, *value);
            }
            for (x, value) in line[lags - reach..].iter().enumerate() {
                out(y * width + x, *value);
            }
        }
    }
}

/// Writes rows of `n` pixels, and times their distance from the middle along x as imaginary part, padded to `size`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weigh(image: &[f32], n: usize, middle: f32, rows: &mut [Complex32], size: usize) {
    for (line, row) in rows.chunks_exact_mut(size).zip(image.chunks_exact(n)) {
        for (i, (out, &value)) in line.iter_mut().zip(row).enumerate() {
            *out = Complex32::new(value, value * (i as f32 - middle));
        }
        line[n..].fill(Complex32::ZERO);
    }
}

/// Multiplies two rows of an image in one, of which the second is as far below the first as there are such pairs.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn multiply(pairs: &mut [Complex32], along: &[f32], down: &[f32]) {
    let (upper, lower) = down.split_at(down.len() / 2);
    let lines = pairs.chunks_exact_mut(along.len());
    for (line, (first, second)) in lines.zip(upper.iter().zip(lower)) {
        for (value, x) in line.iter_mut().zip(along) {
            *value = Complex32::new(value.re * (first * x), value.im * (second * x));
        }
    }
}

/// The half spectrum along x of an image, from transforms of two of its rows in one.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn split_rows(pairs: &[Complex32], side: usize, half: &mut [Complex32]) {
    for (column, out) in half.chunks_exact_mut(side).enumerate() {
        let (first, second) = out.split_at_mut(side / 2);
        split(pairs, side, column, first, second);
    }
}

/// Spectra of two rows of an image in one, from its half spectrum whose columns were transformed back.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn join_rows(half: &[Complex32], side: usize, modes: usize, pairs: &mut [Complex32]) {
    for (y, line) in pairs.chunks_exact_mut(side).enumerate() {
        join(half, side, modes, (y, y + side / 2), line);
    }
}

/// One column of the transforms of two real images, from rows (of `size`) of the transform of the one
/// plus i times the other.
#[inline(always)]
fn split(
    rows: &[Complex32],
    size: usize,
    column: usize,
    first: &mut [Complex32],
    second: &mut [Complex32],
) {
    let opposite = (size - column) % size;
    let lines = rows.chunks_exact(size);
    for (line, (first, second)) in lines.zip(first.iter_mut().zip(second)) {
        [*first, *second] = parts(line[column], line[opposite]);
    }
}

/// Transforms of two real images at one frequency, from those of the one plus i times the other there and at the opposite
/// frequency.
#[inline(always)]
pub(super) fn parts(here: Complex32, opposite: Complex32) -> [Complex32; 2] {
    let (a, b) = (here, opposite.conj());
    // (a − b)/2i is the second.
    let d = (a - b) * 0.5;
    [(a + b) * 0.5, Complex32::new(d.im, -d.re)]
}

/// The spectrum of row `first` plus i times row `second` of a real image, whose columns were
/// transformed back.
#[inline(always)]
fn join(
    half: &[Complex32],
    side: usize,
    modes: usize,
    (first, second): (usize, usize),
    line: &mut [Complex32],
) {
    line.fill(Complex32::ZERO);
    line[0] = Complex32::new(half[first].re, half[second].re);
    for column in 1..=modes {
        let (a, b) = (half[column * side + first], half[column * side + second]);
        line[column] = Complex32::new(a.re - b.im, a.im + b.re);
        // conj(a) + i·conj(b).
        line[side - column] = Complex32::new(a.re + b.im, b.re - a.im);
    }
}
