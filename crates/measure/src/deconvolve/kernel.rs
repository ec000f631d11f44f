//! The arithmetic of one iteration, serial and vectorised, without allocation.
//!
//! Called from many threads at once, so nothing here is parallel. The functions are written once,
//! over [`Vector`], and compiled for each instruction set at the end of the file; which one runs is
//! found out when a network is planned. Instruction sets with fused multiply-add round differently
//! from those without, so last digits differ between machines, never between threads.

use shearq_submissions::{Clipping, Kept};

use super::descent::{Descent, Stop};
use super::operator::Operator;
use super::real::Real;
use super::rule::{Rule, Step};
use super::slide::{BLOCK, LANES, Padded, slide_block};
#[cfg(target_arch = "x86_64")]
use super::vector::Sixteen;
use super::vector::{Portable, Vector};

/// Buffers of one network; the frames of the padded ones stay zero, the rest may hold anything.
#[derive(Debug, Clone)]
pub struct Buffers<T> {
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
/// threshold (Eq. 6) and clips at zero (Eq. 12) where that comes first; returns how many were beyond.
#[inline(always)]
fn update<T: Real, V: Vector<T>>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> u32 {
    let n = operator.n;
    let stride = n.next_multiple_of(LANES);
    let regularised = operator.lambda > T::ZERO;
    let zero = V::splat(T::ZERO);
    let minus_lambda = V::splat(T::ZERO.minus(operator.lambda));
    let unit = V::splat(T::from_f64(rule.unit));
    let floor = V::splat(floor::<T>(rule));
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
                V::where_greater(value, floor, value, floor).store(&mut to[x..]);
                updated += V::count_greater(size, threshold);
            }
        }
    }
    updated
}

/// What an update clips at.
#[inline(always)]
fn floor<T: Real>(rule: &Rule) -> T {
    match rule.clipping {
        Clipping::BeforeTest => T::ZERO,
        Clipping::AfterTest | Clipping::Never => T::from_f64(f64::NEG_INFINITY),
    }
}

/// Sets negative neurons of the candidate to zero (Eq. 12); returns whether there were any.
#[inline(always)]
fn clip<T: Real, V: Vector<T>>(n: usize, b: &mut Buffers<T>) -> bool {
    let zero = V::splat(T::ZERO);
    let mut negative = 0;
    for y in 0..n {
        let row = b.next.wide_mut(y);
        for x in (0..n).step_by(V::LANES) {
            let value = V::load(&row[x..]);
            negative += V::count_greater(zero, value);
            V::where_greater(value, zero, value, zero).store(&mut row[x..]);
        }
    }
    negative > 0
}

/// Adds momentum to an update from `b.state` to `b.next`: `b.moved` takes the update and `b.next` goes
/// on beyond it, in the direction from the update before. `momentum` is Nesterov's t; it starts anew
/// where the direction points uphill (O'Donoghue & Candès 2015, gradient scheme). Returns whether
/// there was any momentum.
#[inline(always)]
fn extrapolate<T: Real, V: Vector<T>>(
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
    momentum: &mut f64,
) -> bool {
    let n = operator.n;
    let floor = V::splat(floor::<T>(rule));
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
            V::where_greater(value, floor, value, floor).store(&mut to[x..]);
        }
    }
    true
}

/// Runs the network from `b.state` on `b.data`; the result is left in `b.state`.
#[inline(always)]
fn run<T: Real, V: Vector<T>>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Descent {
    let mut constant = V::no_squares();
    for y in 0..operator.n {
        let row = b.data.wide(y);
        for x in (0..operator.n).step_by(V::LANES) {
            constant = V::load(&row[x..]).add_squares(constant);
        }
    }
    let constant = 0.5 * V::sum(constant);
    let mut descent = Descent {
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
    // Whether the candidate has passed the test and been clipped since.
    let mut clipped = false;
    // `residual` looks at the candidate, which the first state is too. It stands here once, because
    // it is inlined and by far the largest part of the code.
    std::mem::swap(&mut b.state, &mut b.next);
    loop {
        let next = residual::<T, V>(operator, b);
        match cost {
            None => {
                std::mem::swap(&mut b.state, &mut b.next);
                descent.first_energy = next - constant;
            }
            Some(cost) if clipped || next < cost => {
                if !clipped && rule.clipping == Clipping::AfterTest && clip::<T, V>(operator.n, b) {
                    clipped = true;
                    continue;
                }
                clipped = false;
                std::mem::swap(&mut b.state, &mut b.next);
                std::mem::swap(&mut b.last, &mut b.moved);
                descent.iterations += 1;
            }
            Some(_) if extrapolated => {
                // Too far: the update itself is left.
                (momentum, extrapolated) = (1.0, false);
                b.next.copy_from(&b.moved);
                continue;
            }
            Some(_) => {
                descent.stop = Stop::EnergyRise;
                if rule.kept == Kept::Last {
                    std::mem::swap(&mut b.state, &mut b.next);
                    descent.energy = next - constant;
                    descent.iterations += 1;
                }
                break;
            }
        }
        cost = Some(next);
        descent.energy = next - constant;
        if descent.iterations as usize >= rule.max_iterations {
            break;
        }
        descent.updated = update::<T, V>(operator, rule, b);
        if descent.updated == 0 {
            descent.stop = Stop::Stable;
            break;
        }
        extrapolated = accelerated && extrapolate::<T, V>(operator, rule, b, &mut momentum);
    }
    descent
}

/// A number type with its vectors.
pub trait Wide: Real {
    /// Vectors of AVX-512.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    type Avx512: Vector<Self>;
    /// Vectors of AVX2 with fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    #[doc(hidden)]
    type Avx2: Vector<Self>;

    /// Runs the network's kernel. Each number type has its own function, so that the kernel is compiled once and not
    /// again in every crate that uses it.
    #[doc(hidden)]
    fn descend(
        level: Level,
        operator: &Operator<Self>,
        rule: &Rule,
        b: &mut Buffers<Self>,
    ) -> Descent;
}

impl Wide for f32 {
    #[cfg(target_arch = "x86_64")]
    type Avx512 = Sixteen;
    #[cfg(target_arch = "x86_64")]
    type Avx2 = Portable<f32, 8, true>;

    fn descend(
        level: Level,
        operator: &Operator<Self>,
        rule: &Rule,
        b: &mut Buffers<Self>,
    ) -> Descent {
        run_at(level, operator, rule, b)
    }
}

// Only tests run in f64.
#[cfg(test)]
impl Wide for f64 {
    #[cfg(target_arch = "x86_64")]
    type Avx512 = Portable<f64, 4, true>;
    #[cfg(target_arch = "x86_64")]
    type Avx2 = Portable<f64, 4, true>;

    fn descend(
        level: Level,
        operator: &Operator<Self>,
        rule: &Rule,
        b: &mut Buffers<Self>,
    ) -> Descent {
        run_at(level, operator, rule, b)
    }
}

/// Instruction sets the kernel is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
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
}

/// Runs the kernel compiled for `level`.
pub(super) fn run_at<T: Wide>(
    level: Level,
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
) -> Descent {
    match level {
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

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn run_avx512<T: Wide>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Descent {
    run::<T, T::Avx512>(operator, rule, b)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<T: Wide>(operator: &Operator<T>, rule: &Rule, b: &mut Buffers<T>) -> Descent {
    run::<T, T::Avx2>(operator, rule, b)
}
