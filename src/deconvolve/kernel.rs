//! The arithmetic of one iteration, serial and vectorised, without allocation.
//!
//! Called from many threads at once, so nothing here is parallel. The functions are written once,
//! generically, and compiled for each instruction set at the end of the file; which one runs is
//! found out when a network is planned. Instruction sets with fused multiply-add round differently
//! from those without, so last digits differ between machines, never between threads.

use super::operator::{Operator, SUN_KERNEL};
use super::{Outcome, Rule, Step, Stop};

/// Pixels worked on together along a row. Rows are padded to a multiple of it.
pub(super) const LANES: usize = 16;
/// Rows worked on together.
const BLOCK: usize = 4;

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
}

macro_rules! real {
    ($type:ty) => {
        impl Real for $type {
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
real!(f32);
real!(f64);

/// An n×n image inside a frame of zeros, rows padded so that whole vectors can be read anywhere.
#[derive(Debug, Clone)]
pub(super) struct Padded<T> {
    data: Vec<T>,
    stride: usize,
    /// Zeros before the image on both axes.
    before: usize,
    n: usize,
}

impl<T: Real> Padded<T> {
    pub(super) fn new(n: usize, before: usize, after: usize) -> Self {
        let stride = before + n.next_multiple_of(LANES) + after;
        Padded {
            // The last vectors of the last row reach past its end.
            data: vec![T::ZERO; stride * (n + before + after) + LANES],
            stride,
            before,
            n,
        }
    }

    #[inline(always)]
    pub(super) fn row(&self, y: usize) -> &[T] {
        let start = (y + self.before) * self.stride + self.before;
        &self.data[start..start + self.n]
    }

    #[inline(always)]
    pub(super) fn row_mut(&mut self, y: usize) -> &mut [T] {
        let start = (y + self.before) * self.stride + self.before;
        &mut self.data[start..start + self.n]
    }
}

/// Buffers of one network; the frames of the padded ones stay zero, the rest may hold anything.
#[derive(Debug, Clone)]
pub(super) struct Buffers<T> {
    /// Accepted state, in the frame that H needs.
    pub(super) state: Padded<T>,
    /// Candidate state, likewise.
    pub(super) next: Padded<T>,
    /// u₀ − Hv, in the frame that Hᵀ needs.
    residual: Padded<T>,
    /// Dv, in the frame that D needs.
    rough: Padded<T>,
    /// f = Hᵀ(u₀ − Hv) − λDDv, n×n.
    gradient: Vec<T>,
    /// u₀, n×n.
    pub(super) data: Vec<T>,
    /// Rows of a product on their way.
    rows: Vec<T>,
}

impl<T: Real> Buffers<T> {
    pub(super) fn new(n: usize, p: usize) -> Self {
        let c = p / 2;
        // H looks p − 1 − c pixels back and c ahead; Hᵀ the other way round; D one each way.
        let state = || Padded::new(n, (p - 1 - c).max(1), c.max(1));
        Buffers {
            state: state(),
            next: state(),
            residual: Padded::new(n, c, p - 1 - c),
            rough: Padded::new(n, 1, 1),
            gradient: vec![T::ZERO; n * n],
            data: vec![T::ZERO; n * n],
            rows: vec![T::ZERO; BLOCK * n.next_multiple_of(LANES)],
        }
    }
}

/// Slides the p×p `kernel` over `ROWS` rows of `source` from output row `y` on; `back` is how far
/// the kernel reaches before the output pixel. Writes whole vectors to `out`, `stride` apart.
#[inline(always)]
fn slide<T: Real, const FMA: bool, const ROWS: usize>(
    source: &Padded<T>,
    kernel: &[T],
    p: usize,
    back: usize,
    y: usize,
    out: &mut [T],
) {
    let wide = source.n.next_multiple_of(LANES);
    let shift = source.before - back;
    for x in (0..wide).step_by(LANES) {
        let mut sums = [[T::ZERO; LANES]; ROWS];
        for j in 0..p {
            let weights = &kernel[j * p..j * p + p];
            let start = (y + j + shift) * source.stride + x + shift;
            // One bounds check for all that is read below.
            let rows = &source.data[start..start + (ROWS - 1) * source.stride + p - 1 + LANES];
            for (i, &weight) in weights.iter().enumerate() {
                for (k, sum) in sums.iter_mut().enumerate() {
                    let at = k * source.stride + i;
                    let pixels = &rows[at..at + LANES];
                    for l in 0..LANES {
                        sum[l] = sum[l].add_product::<FMA>(weight, pixels[l]);
                    }
                }
            }
        }
        for (k, sum) in sums.iter().enumerate() {
            out[k * wide + x..k * wide + x + LANES].copy_from_slice(sum);
        }
    }
}

/// Calls [`slide`] over all rows and hands each finished row to `$use`.
macro_rules! for_each_row {
    ($fma:expr, $source:expr, $kernel:expr, $p:expr, $back:expr, $rows:expr, |$y:ident, $row:ident| $use:block) => {{
        let n = $source.n;
        let wide = n.next_multiple_of(LANES);
        let mut first = 0;
        while first < n {
            let count = if n - first >= BLOCK {
                slide::<T, $fma, BLOCK>($source, $kernel, $p, $back, first, $rows);
                BLOCK
            } else {
                slide::<T, $fma, 1>($source, $kernel, $p, $back, first, $rows);
                1
            };
            for k in 0..count {
                let $y = first + k;
                let $row = &$rows[k * wide..k * wide + n];
                $use
            }
            first += count;
        }
    }};
}

/// Residual and roughness of `state`; returns J(v) = ½‖u₀ − Hv‖² + ½λ‖Dv‖² (Eq. 4), which is the
/// energy E plus the constant ½‖u₀‖² (Eq. 9 of the paper's J) but has no cancellation in it.
#[inline(always)]
fn residual<T: Real, const FMA: bool>(
    operator: &Operator<T>,
    state: &Padded<T>,
    data: &[T],
    residual: &mut Padded<T>,
    rough: &mut Padded<T>,
    rows: &mut [T],
) -> f64 {
    let (n, p) = (operator.n, operator.p);
    let back = p - 1 - p / 2;
    let mut misfit = [0.0f64; LANES];
    for_each_row!(FMA, state, &operator.turned, p, back, rows, |y, row| {
        let out = residual.row_mut(y);
        for x in 0..n {
            out[x] = data[y * n + x].minus(row[x]);
        }
        add_squares(&mut misfit, out);
    });
    let mut roughness = [0.0f64; LANES];
    if operator.lambda > T::ZERO {
        let kernel: [T; 9] = std::array::from_fn(|k| T::from_f64(SUN_KERNEL[k / 3][k % 3]));
        for_each_row!(FMA, state, &kernel, 3, 1, rows, |y, row| {
            rough.row_mut(y).copy_from_slice(row);
            add_squares(&mut roughness, row);
        });
    }
    0.5 * misfit.iter().sum::<f64>()
        + 0.5 * operator.lambda.to_f64() * roughness.iter().sum::<f64>()
}

/// Σ x² of a row in f64, in lanes of its own so that it vectorises.
#[inline(always)]
fn add_squares<T: Real>(sums: &mut [f64; LANES], row: &[T]) {
    for chunk in row.chunks(LANES) {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            let value = value.to_f64();
            *sum += value * value;
        }
    }
}

/// f = Hᵀ(u₀ − Hv) − λD(Dv) (Eq. 11; D is symmetric).
#[inline(always)]
fn gradient<T: Real, const FMA: bool>(operator: &Operator<T>, b: &mut Buffers<T>) {
    let (n, p) = (operator.n, operator.p);
    let gradient = &mut b.gradient;
    for_each_row!(
        FMA,
        &b.residual,
        &operator.forward,
        p,
        p / 2,
        &mut b.rows,
        |y, row| {
            gradient[y * n..y * n + n].copy_from_slice(row);
        }
    );
    if operator.lambda > T::ZERO {
        let minus_lambda = T::ZERO.minus(operator.lambda);
        let kernel: [T; 9] = std::array::from_fn(|k| T::from_f64(SUN_KERNEL[k / 3][k % 3]));
        for_each_row!(FMA, &b.rough, &kernel, 3, 1, &mut b.rows, |y, row| {
            for (f, &g) in gradient[y * n..y * n + n].iter_mut().zip(row) {
                *f = f.add_product::<FMA>(minus_lambda, g);
            }
        });
    }
}

/// Updates every neuron beyond its threshold (Eq. 6) and clips at zero (Eq. 12); returns how many
/// were beyond.
#[inline(always)]
fn update<T: Real, const FMA: bool>(
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
) -> u32 {
    let n = operator.n;
    let unit = T::from_f64(rule.unit);
    let (adaptive, c, delta) = match rule.step {
        Step::Adaptive(c) => (true, T::from_f64(c), T::ZERO),
        Step::Constant(delta) => (false, T::ZERO, T::from_f64(delta)),
    };
    let mut updated = 0;
    for y in 0..n {
        let (from, to) = (b.state.row(y), b.next.row_mut(y));
        let f = &b.gradient[y * n..y * n + n];
        let thresholds = &operator.thresholds[y * n..y * n + n];
        let mut count = 0u32;
        for x in 0..n {
            let threshold = T::ZERO.add_product::<FMA>(thresholds[x], unit);
            let beyond = f[x].modulus() > threshold;
            let signed_delta = if f[x] > T::ZERO {
                delta
            } else {
                T::ZERO.minus(delta)
            };
            let moved = if adaptive {
                from[x].add_product::<FMA>(c, f[x])
            } else {
                from[x].minus(T::ZERO.minus(signed_delta))
            };
            let value = if beyond { moved } else { from[x] };
            to[x] = if value > T::ZERO { value } else { T::ZERO };
            count += u32::from(beyond);
        }
        updated += count;
    }
    updated
}

/// Runs the network from `b.state` on `b.data`; the result is left in `b.state`.
#[inline(always)]
fn run<T: Real, const FMA: bool>(
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
) -> Outcome {
    let mut constant = [0.0f64; LANES];
    add_squares(&mut constant, &b.data);
    let constant = 0.5 * constant.iter().sum::<f64>();
    let mut cost = residual::<T, FMA>(
        operator,
        &b.state,
        &b.data,
        &mut b.residual,
        &mut b.rough,
        &mut b.rows,
    );
    let mut outcome = Outcome {
        iterations: 0,
        stop: Stop::MaxIterations,
        first_energy: cost - constant,
        energy: cost - constant,
        updated: 0,
    };
    for _ in 0..rule.max_iterations {
        gradient::<T, FMA>(operator, b);
        outcome.updated = update::<T, FMA>(operator, rule, b);
        if outcome.updated == 0 {
            outcome.stop = Stop::Stable;
            break;
        }
        let next = residual::<T, FMA>(
            operator,
            &b.next,
            &b.data,
            &mut b.residual,
            &mut b.rough,
            &mut b.rows,
        );
        if next.is_nan() || next >= cost {
            outcome.stop = Stop::EnergyRise;
            break;
        }
        std::mem::swap(&mut b.state, &mut b.next);
        cost = next;
        outcome.energy = cost - constant;
        outcome.iterations += 1;
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
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl") {
                return Level::Avx512;
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Level::Avx2;
            }
        }
        Level::Baseline
    }

    /// Runs the kernel compiled for this level.
    pub(super) fn run<T: Real>(
        self,
        operator: &Operator<T>,
        rule: &Rule,
        b: &mut Buffers<T>,
    ) -> Outcome {
        match self {
            // SAFETY: `detect` returns these only where the machine has the features.
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { run_avx512(operator, rule, b) },
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { run_avx2(operator, rule, b) },
            Level::Baseline => run::<T, { cfg!(target_arch = "aarch64") }>(operator, rule, b),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx2,fma")]
fn run_avx512<T: Real>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Outcome {
    run::<T, true>(operator, rule, b)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<T: Real>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Outcome {
    run::<T, true>(operator, rule, b)
}
