//! Small kernels slid over images, several rows and a vector of pixels at a time.
//!
//! Nearly all of the network's time goes into two convolutions. Eight output rows are summed in registers
//! while the source rows pass once: a vector of pixels, most often across two cache lines, is loaded once
//! for all the rows it contributes to, and source rows outside the stamp are never looked at.

use super::real::Real;
use super::vector::{Lanes, Pair, Vector};

/// Multiple to which rows are padded: the longest vector. See docs/constants.md.
pub(super) const LANES: usize = 16;
/// Output rows that are summed together. See docs/constants.md.
pub(super) const BLOCK: usize = 8;

/// An n×n image with zeros left and right of it, so that whole vectors can be read anywhere.
#[derive(Debug, Clone)]
pub(super) struct Padded<T> {
    data: Vec<T>,
    /// Elements before the first row, which put every row on a cache line.
    skip: usize,
    stride: usize,
    /// Zeros before the image.
    before: usize,
    n: usize,
}

impl<T: Real> Padded<T> {
    /// Room for kernels that reach up to `before` and `after` pixels beyond the image.
    pub(super) fn new(n: usize, before: usize, after: usize) -> Self {
        let before = before.next_multiple_of(LANES);
        let stride = (before + n.next_multiple_of(LANES) + after).next_multiple_of(LANES);
        let data = vec![T::ZERO; stride * n + LANES];
        let skip = data.as_ptr().align_offset(64).min(LANES);
        Padded {
            data,
            skip,
            stride,
            before,
            n,
        }
    }

    /// Row `y` with its zeros.
    #[inline(always)]
    fn line(&self, y: usize) -> &[T] {
        &self.data[self.skip + y * self.stride..][..self.stride]
    }

    /// Row `y` and the zeros after it.
    #[inline(always)]
    pub(super) fn wide(&self, y: usize) -> &[T] {
        &self.line(y)[self.before..]
    }

    #[inline(always)]
    pub(super) fn wide_mut(&mut self, y: usize) -> &mut [T] {
        &mut self.data[self.skip + y * self.stride..][self.before..self.stride]
    }

    /// Takes the image of another of the same side.
    #[inline(always)]
    pub(super) fn copy_from(&mut self, other: &Self) {
        let width = self.n.next_multiple_of(LANES);
        for y in 0..self.n {
            self.wide_mut(y)[..width].copy_from_slice(&other.wide(y)[..width]);
        }
    }

    #[inline(always)]
    pub(super) fn row(&self, y: usize) -> &[T] {
        &self.wide(y)[..self.n]
    }

    #[inline(always)]
    pub(super) fn row_mut(&mut self, y: usize) -> &mut [T] {
        let n = self.n;
        &mut self.wide_mut(y)[..n]
    }
}

/// A small kernel as [`slide`] wants it: column by column, each between zeros, upside down, so that
/// the weights with which one pixel enters the rows of a block lie side by side.
#[derive(Debug, Clone)]
pub(super) struct Kernel<T> {
    p: usize,
    /// How far the kernel reaches before the output pixel.
    back: usize,
    weights: Vec<T>,
}

impl<T: Real> Kernel<T> {
    pub(super) fn new(p: usize, back: usize) -> Self {
        Kernel {
            p,
            back,
            weights: vec![T::ZERO; p * Self::height(p)],
        }
    }

    fn height(p: usize) -> usize {
        p + 2 * (BLOCK - 1)
    }

    /// Sets the weight of row `j`, column `i`.
    #[inline]
    pub(super) fn set(&mut self, j: usize, i: usize, weight: T) {
        let (p, height) = (self.p, Self::height(self.p));
        self.weights[i * height + BLOCK - 1 + p - 1 - j] = weight;
    }
}

/// Adds what the source row `line` contributes to the output rows `LOW..HIGH` of a block. `age` is
/// the kernel row with which it enters the first of them.
#[inline(always)]
fn add_row<T: Real, L: Lanes<T>, const ROWS: usize, const LOW: usize, const HIGH: usize>(
    sums: &mut [L; ROWS],
    line: &[T],
    kernel: &Kernel<T>,
    age: usize,
) {
    let height = Kernel::<T>::height(kernel.p);
    // Output row k takes kernel row age − k.
    let first = BLOCK - 1 + kernel.p - 1 - age;
    for i in 0..kernel.p {
        let weights = &kernel.weights[i * height + first..][..ROWS];
        let pixels = L::load(&line[i..]);
        for k in LOW..HIGH {
            sums[k] = sums[k].add_product(L::splat(weights[k]), pixels);
        }
    }
}

/// Slides `kernel` over `source` for `ROWS` output rows from `y` on and `COLUMNS` vectors from `x`
/// on, and writes them to `out`, rows `stride` apart.
#[inline(always)]
fn slide<T: Real, L: Lanes<T>, const ROWS: usize>(
    source: &Padded<T>,
    kernel: &Kernel<T>,
    y: usize,
    x: usize,
    out: &mut [T],
    stride: usize,
) {
    let (p, back) = (kernel.p, kernel.back);
    let mut sums = [L::splat(T::ZERO); ROWS];
    // Source row y + age − back enters output row y + k with kernel row age − k. The rows inside
    // the stamp:
    let from = back.saturating_sub(y);
    let to = (ROWS + p - 1).min(source.n + back - y);
    let at = source.before + x - back;
    // While the kernel's first row has not reached the block's last row yet, the later rows take
    // nothing; neither do the earlier ones once its last row has left them behind.
    macro_rules! add {
        ($low:literal, $high:literal, $age:expr) => {{
            let age = $age;
            if $low < $high && $high <= ROWS && from <= age && age < to {
                let line = &source.line(y + age - back)[at..];
                add_row::<T, L, ROWS, $low, $high>(&mut sums, line, kernel, age);
            }
        }};
    }
    macro_rules! add_all {
        ($rows:literal, [$($young:literal)*], [$($old:literal)*]) => {{
            $( add!(0, $young, $young - 1); )*
            for age in from.max($rows - 1)..to.min(p) {
                add!(0, $rows, age);
            }
            $( if p + $old > $rows - 1 { add!($old, $rows, p + $old - 1); } )*
        }};
    }
    if ROWS == 8 {
        add_all!(8, [1 2 3 4 5 6 7], [1 2 3 4 5 6 7]);
    } else {
        add_all!(4, [1 2 3], [1 2 3]);
    }
    for (k, sum) in sums.iter().enumerate() {
        sum.store(&mut out[k * stride + x..]);
    }
}

/// Slides `kernel` over `source` for the output rows from `y` on, as many as make a block, and
/// writes them to `out`, whole vectors, `stride` apart.
#[inline(always)]
pub(super) fn slide_block<T: Real, V: Vector<T>>(
    source: &Padded<T>,
    kernel: &Kernel<T>,
    y: usize,
    out: &mut [T],
    stride: usize,
) {
    let half = source.n - y <= BLOCK / 2;
    let mut x = 0;
    while x < source.n {
        let long = source.n - x > V::LANES;
        match (long, half) {
            (false, false) => slide::<T, V, 8>(source, kernel, y, x, out, stride),
            (false, true) => slide::<T, V, 4>(source, kernel, y, x, out, stride),
            (true, false) => slide::<T, Pair<V>, 8>(source, kernel, y, x, out, stride),
            (true, true) => slide::<T, Pair<V>, 4>(source, kernel, y, x, out, stride),
        }
        x += if long { 2 * V::LANES } else { V::LANES };
    }
}
