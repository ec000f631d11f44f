//! The arithmetic of one iteration, serial and vectorised, without allocation.
//!
//! Called from many threads at once, so nothing here is parallel. The functions are written once,
//! over [`Vector`], and compiled for each instruction set at the end of the file; which one runs is
//! found out when a network is planned. Instruction sets with fused multiply-add round differently
//! from those without, so last digits differ between machines, never between threads.
//!
//! Nearly all the time goes into two convolutions. Eight output rows are summed in registers while
//! the source rows pass once: a vector of pixels, most often across two cache lines, is loaded once
//! for all the rows it contributes to, and source rows outside the stamp are never looked at.

use super::operator::Operator;
use super::vector::{self, Portable, Vector};
use super::{Outcome, Rule, Step, Stop};

/// Rows are padded to a multiple of this, the longest vector.
pub(super) const LANES: usize = 16;
/// Output rows summed together.
pub(super) const BLOCK: usize = 8;

/// `f32` or `f64`.
pub trait Real: Copy + Default + PartialOrd + Send + Sync + std::fmt::Debug + 'static {
    /// 0.
    const ZERO: Self;
    /// Rounds an `f64`.
    fn from_f64(value: f64) -> Self;
    /// Exact.
    fn to_f64(self) -> f64;
    /// self + a·b, fused where `FMA` says the hardware can.
    fn add_product<const FMA: bool>(self, a: Self, b: Self) -> Self;
    /// self − other.
    fn minus(self, other: Self) -> Self;
    /// |self|.
    fn modulus(self) -> Self;
    /// Vectors of AVX-512.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    type Avx512: Vector<Self>;
    /// Vectors of AVX2 with fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    type Avx2: Vector<Self>;
}

macro_rules! real {
    ($type:ty, $avx512:ty, $avx2:ty) => {
        impl Real for $type {
            #[cfg(target_arch = "x86_64")]
            type Avx512 = $avx512;
            #[cfg(target_arch = "x86_64")]
            type Avx2 = $avx2;
            const ZERO: Self = 0.0;
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $type
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn add_product<const FMA: bool>(self, a: Self, b: Self) -> Self {
                if FMA {
                    a.mul_add(b, self)
                } else {
                    self + a * b
                }
            }
            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                self - other
            }
            #[inline(always)]
            fn modulus(self) -> Self {
                self.abs()
            }
        }
    };
}
real!(f32, vector::Sixteen, vector::Eight);
// Only tests run in f64: nothing is won by intrinsics.
real!(f64, Portable<f64, 4, true>, Portable<f64, 4, true>);

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
    fn wide(&self, y: usize) -> &[T] {
        &self.line(y)[self.before..]
    }

    #[inline(always)]
    fn wide_mut(&mut self, y: usize) -> &mut [T] {
        &mut self.data[self.skip + y * self.stride..][self.before..self.stride]
    }

    /// Takes the image of another of the same side.
    #[inline(always)]
    fn copy_from(&mut self, other: &Self) {
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

/// Buffers of one network; the frames of the padded ones stay zero, the rest may hold anything.
#[derive(Debug, Clone)]
pub(super) struct Buffers<T> {
    /// Accepted state.
    pub(super) state: Padded<T>,
    /// Candidate state.
    pub(super) next: Padded<T>,
    /// State after an accelerated update, before its momentum.
    moved: Padded<T>,
    /// The same one iteration before.
    last: Padded<T>,
    /// u₀ − Hv.
    residual: Padded<T>,
    /// Dv.
    rough: Padded<T>,
    /// u₀.
    pub(super) data: Padded<T>,
    /// Rows of H's or Hᵀ's product on their way.
    rows: Vec<T>,
    /// Rows of D's product.
    rough_rows: Vec<T>,
}

impl<T: Real> Buffers<T> {
    pub(super) fn new(n: usize, p: usize) -> Self {
        let rows = vec![T::ZERO; BLOCK * n.next_multiple_of(LANES)];
        Buffers {
            state: Padded::new(n, p, p),
            next: Padded::new(n, p, p),
            moved: Padded::new(n, 0, 0),
            last: Padded::new(n, 0, 0),
            residual: Padded::new(n, p, p),
            rough: Padded::new(n, 1, 1),
            data: Padded::new(n, 0, 0),
            rows: rows.clone(),
            rough_rows: rows,
        }
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
    pub(super) fn set(&mut self, j: usize, i: usize, weight: T) {
        let (p, height) = (self.p, Self::height(self.p));
        self.weights[i * height + BLOCK - 1 + p - 1 - j] = weight;
    }
}

/// Adds what the source row `line` contributes to the output rows `LOW..HIGH` of a block. `age` is
/// the kernel row with which it enters the first of them.
#[inline(always)]
fn add_row<
    T: Real,
    V: Vector<T>,
    const ROWS: usize,
    const COLUMNS: usize,
    const LOW: usize,
    const HIGH: usize,
>(
    sums: &mut [[V; COLUMNS]; ROWS],
    line: &[T],
    kernel: &Kernel<T>,
    age: usize,
) {
    let height = Kernel::<T>::height(kernel.p);
    // Output row k takes kernel row age − k.
    let first = BLOCK - 1 + kernel.p - 1 - age;
    for i in 0..kernel.p {
        let weights = &kernel.weights[i * height + first..][..ROWS];
        let mut pixels = [V::splat(T::ZERO); COLUMNS];
        for (c, pixel) in pixels.iter_mut().enumerate() {
            *pixel = V::load(&line[i + c * V::LANES..]);
        }
        for k in LOW..HIGH {
            let weight = V::splat(weights[k]);
            for c in 0..COLUMNS {
                sums[k][c] = sums[k][c].add_product(weight, pixels[c]);
            }
        }
    }
}

/// Slides `kernel` over `source` for `ROWS` output rows from `y` on and `COLUMNS` vectors from `x`
/// on, and writes them to `out`, rows `stride` apart.
#[inline(always)]
fn slide<T: Real, V: Vector<T>, const ROWS: usize, const COLUMNS: usize>(
    source: &Padded<T>,
    kernel: &Kernel<T>,
    y: usize,
    x: usize,
    out: &mut [T],
    stride: usize,
) {
    let (p, back) = (kernel.p, kernel.back);
    let mut sums = [[V::splat(T::ZERO); COLUMNS]; ROWS];
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
                add_row::<T, V, ROWS, COLUMNS, $low, $high>(&mut sums, line, kernel, age);
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
        for (c, sum) in sum.iter().enumerate() {
            sum.store(&mut out[k * stride + x + c * V::LANES..]);
        }
    }
}

/// Slides `kernel` over `source` for the output rows from `y` on, as many as make a block, and
/// writes them to `out`, whole vectors, `stride` apart.
#[inline(always)]
fn slide_block<T: Real, V: Vector<T>>(
    source: &Padded<T>,
    kernel: &Kernel<T>,
    y: usize,
    out: &mut [T],
    stride: usize,
) {
    let half = source.n - y <= BLOCK / 2;
    let mut x = 0;
    while x < source.n {
        let vectors = (source.n - x).div_ceil(V::LANES).min(V::COLUMNS);
        match (vectors, half) {
            (1, false) => slide::<T, V, 8, 1>(source, kernel, y, x, out, stride),
            (1, true) => slide::<T, V, 4, 1>(source, kernel, y, x, out, stride),
            (_, false) => slide::<T, V, 8, 2>(source, kernel, y, x, out, stride),
            (_, true) => slide::<T, V, 4, 2>(source, kernel, y, x, out, stride),
        }
        x += vectors * V::LANES;
    }
}

/// Residual and roughness of `state`; returns J(v) = ½‖u₀ − Hv‖² + ½λ‖Dv‖² (Eq. 4), which is the
/// energy E plus the constant ½‖u₀‖² (Eq. 9 of the paper's J) but has no cancellation in it.
#[inline(always)]
fn residual<T: Real, V: Vector<T>>(operator: &Operator<T>, b: &mut Buffers<T>) -> f64 {
    let n = operator.n;
    let stride = n.next_multiple_of(LANES);
    let regularised = operator.lambda > T::ZERO;
    let (mut misfit, mut roughness) = (V::no_squares(), V::no_squares());
    for first in (0..n).step_by(BLOCK) {
        slide_block::<T, V>(&b.next, &operator.turned, first, &mut b.rows, stride);
        if regularised {
            slide_block::<T, V>(&b.next, &operator.sun, first, &mut b.rough_rows, stride);
        }
        for y in first..n.min(first + BLOCK) {
            let (data, out) = (b.data.wide(y), b.residual.wide_mut(y));
            let rough = b.rough.wide_mut(y);
            let row = (y - first) * stride;
            for x in (0..n).step_by(V::LANES) {
                let inside = V::load(&operator.inside[x..]);
                let left = V::load(&data[x..]).minus(V::load(&b.rows[row + x..]));
                let left = left.times(inside);
                left.store(&mut out[x..]);
                misfit = left.add_squares(misfit);
                if regularised {
                    let left = V::load(&b.rough_rows[row + x..]).times(inside);
                    left.store(&mut rough[x..]);
                    roughness = left.add_squares(roughness);
                }
            }
        }
    }
    0.5 * V::sum(misfit) + 0.5 * operator.lambda.to_f64() * V::sum(roughness)
}

/// Takes f = Hᵀ(u₀ − Hv) − λD(Dv) (Eq. 11; D is symmetric), updates every neuron beyond its
/// threshold (Eq. 6) and clips at zero (Eq. 12); returns how many were beyond.
#[inline(always)]
fn update<T: Real, V: Vector<T>>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> u32 {
    let n = operator.n;
    let stride = n.next_multiple_of(LANES);
    let regularised = operator.lambda > T::ZERO;
    let zero = V::splat(T::ZERO);
    let minus_lambda = V::splat(T::ZERO.minus(operator.lambda));
    let unit = V::splat(T::from_f64(rule.unit));
    let (adaptive, step) = match rule.step {
        Step::Adaptive(c) | Step::Accelerated(c) => (true, V::splat(T::from_f64(c))),
        Step::Constant(delta) => (false, V::splat(T::from_f64(delta))),
    };
    let mut updated = 0;
    for first in (0..n).step_by(BLOCK) {
        slide_block::<T, V>(&b.residual, &operator.forward, first, &mut b.rows, stride);
        if regularised {
            slide_block::<T, V>(&b.rough, &operator.sun, first, &mut b.rough_rows, stride);
        }
        for y in first..n.min(first + BLOCK) {
            let (from, to) = (b.state.wide(y), b.next.wide_mut(y));
            let thresholds = &operator.wide_thresholds[y * stride..][..stride];
            let row = (y - first) * stride;
            for x in (0..n).step_by(V::LANES) {
                let mut f = V::load(&b.rows[row + x..]);
                if regularised {
                    f = f.add_product(minus_lambda, V::load(&b.rough_rows[row + x..]));
                }
                let from = V::load(&from[x..]);
                // Infinite behind the end of the row, where the state has to stay zero.
                let threshold = V::load(&thresholds[x..]).times(unit);
                let moved = if adaptive {
                    from.add_product(step, f)
                } else {
                    V::where_greater(f, zero, from.plus(step), from.minus(step))
                };
                let size = f.modulus();
                let value = V::where_greater(size, threshold, moved, from);
                V::where_greater(value, zero, value, zero).store(&mut to[x..]);
                updated += V::count_greater(size, threshold);
            }
        }
    }
    updated
}

/// Adds momentum to an update from `b.state` to `b.next`: `b.moved` takes the update and `b.next` goes
/// on beyond it, in the direction from the update before. `momentum` is Nesterov's t; it starts anew
/// where the direction points uphill (O'Donoghue & Candès 2015, gradient scheme). Returns whether
/// there was any momentum.
#[inline(always)]
fn extrapolate<T: Real, V: Vector<T>>(
    operator: &Operator<T>,
    b: &mut Buffers<T>,
    momentum: &mut f64,
) -> bool {
    let n = operator.n;
    let zero = V::splat(T::ZERO);
    // (from − moved)·(moved − last) > 0 by the squares of sum and difference.
    let (mut sum, mut difference) = (V::no_squares(), V::no_squares());
    b.moved.copy_from(&b.next);
    for y in 0..n {
        let (from, moved, last) = (b.state.wide(y), b.moved.wide(y), b.last.wide(y));
        for x in (0..n).step_by(V::LANES) {
            let moved = V::load(&moved[x..]);
            let back = V::load(&from[x..]).minus(moved);
            let on = moved.minus(V::load(&last[x..]));
            sum = back.plus(on).add_squares(sum);
            difference = back.minus(on).add_squares(difference);
        }
    }
    if V::sum(sum) > V::sum(difference) {
        *momentum = 1.0;
    }
    let next = 0.5 * (1.0 + (1.0 + 4.0 * *momentum * *momentum).sqrt());
    let beta = (*momentum - 1.0) / next;
    *momentum = next;
    if beta == 0.0 {
        return false;
    }
    let beta = V::splat(T::from_f64(beta));
    for y in 0..n {
        let (moved, last, to) = (b.moved.wide(y), b.last.wide(y), b.next.wide_mut(y));
        for x in (0..n).step_by(V::LANES) {
            let moved = V::load(&moved[x..]);
            let value = moved.add_product(beta, moved.minus(V::load(&last[x..])));
            V::where_greater(value, zero, value, zero).store(&mut to[x..]);
        }
    }
    true
}

/// Runs the network from `b.state` on `b.data`; the result is left in `b.state`.
#[inline(always)]
fn run<T: Real, V: Vector<T>>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Outcome {
    let mut constant = V::no_squares();
    for y in 0..operator.n {
        let row = b.data.wide(y);
        for x in (0..operator.n).step_by(V::LANES) {
            constant = V::load(&row[x..]).add_squares(constant);
        }
    }
    let constant = 0.5 * V::sum(constant);
    let mut outcome = Outcome {
        iterations: 0,
        stop: Stop::MaxIterations,
        first_energy: 0.0,
        energy: 0.0,
        updated: 0,
    };
    let accelerated = matches!(rule.step, Step::Accelerated(_));
    if accelerated {
        b.last.copy_from(&b.state);
    }
    let (mut momentum, mut extrapolated) = (1.0, false);
    let mut cost = None;
    // `residual` looks at the candidate, which the first state is too. It stands here once, because
    // it is inlined and by far the largest part of the code.
    std::mem::swap(&mut b.state, &mut b.next);
    loop {
        let next = residual::<T, V>(operator, b);
        match cost {
            None => {
                std::mem::swap(&mut b.state, &mut b.next);
                outcome.first_energy = next - constant;
            }
            Some(cost) if next < cost => {
                std::mem::swap(&mut b.state, &mut b.next);
                std::mem::swap(&mut b.last, &mut b.moved);
                outcome.iterations += 1;
            }
            Some(_) if extrapolated => {
                // Too far: the update itself is left.
                (momentum, extrapolated) = (1.0, false);
                b.next.copy_from(&b.moved);
                continue;
            }
            Some(_) => {
                outcome.stop = Stop::EnergyRise;
                break;
            }
        }
        cost = Some(next);
        outcome.energy = next - constant;
        if outcome.iterations as usize >= rule.max_iterations {
            break;
        }
        outcome.updated = update::<T, V>(operator, rule, b);
        if outcome.updated == 0 {
            outcome.stop = Stop::Stable;
            break;
        }
        extrapolated = accelerated && extrapolate::<T, V>(operator, b, &mut momentum);
    }
    outcome
}

/// Instruction sets the kernel is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Level {
    /// 512-bit vectors.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// 256-bit vectors with fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Whatever the target always has: NEON with fused multiply-add on aarch64.
    Baseline,
}

impl Level {
    /// The best that this machine has.
    pub(super) fn detect() -> Self {
        Self::available().next().unwrap_or(Level::Baseline)
    }

    /// All that this machine has, the best first.
    pub(super) fn available() -> impl Iterator<Item = Self> {
        #[cfg(target_arch = "x86_64")]
        let wide = {
            let fused = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            let avx512 = fused && is_x86_feature_detected!("avx512f");
            [(avx512, Level::Avx512), (fused, Level::Avx2)]
        };
        #[cfg(not(target_arch = "x86_64"))]
        let wide: [(bool, Level); 0] = [];
        let wide = wide.into_iter().filter(|(here, _)| *here);
        wide.map(|(_, level)| level)
            .chain(std::iter::once(Level::Baseline))
    }

    /// Runs the kernel compiled for this level.
    pub(super) fn run<T: Real>(
        self,
        operator: &Operator<T>,
        rule: &Rule,
        b: &mut Buffers<T>,
    ) -> Outcome {
        match self {
            // SAFETY: `available` yields these only where the machine has the features.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { run_avx512(operator, rule, b) },
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { run_avx2(operator, rule, b) },
            Level::Baseline => {
                run::<T, Portable<T, 4, { cfg!(target_arch = "aarch64") }>>(operator, rule, b)
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn run_avx512<T: Real>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Outcome {
    run::<T, T::Avx512>(operator, rule, b)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<T: Real>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Outcome {
    run::<T, T::Avx2>(operator, rule, b)
}
