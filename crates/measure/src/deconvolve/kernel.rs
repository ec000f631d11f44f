//! The arithmetic of one iteration, serial and vectorised, without allocation.
//!
//! Called from many threads at once, so nothing here is parallel. The functions are written once, over plain arrays, and
//! compiled for each instruction set at the end of the file. Instruction sets with fused multiply-add round differently
//! from those without, so last digits differ between machines, never between threads.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_submissions::{Clipping, Kept};

use super::convolution::Scratch;
use super::descent::{Descent, Stop};
use super::operator::{Operator, padded};
use super::rule::{Rule, Step};
use super::sun::roughen;
use shearq_quantities::product::{LANES, ROWS};
use shearq_quantities::real::Real;

/// Buffers of one network. Images are row-major, with zeros behind them that fill the last lanes. The zeros around
/// `lines` and behind the parts of folded images stay, too. All else may have any value between runs.
#[derive(Debug, Clone)]
pub struct Buffers<T> {
    /// Accepted state.
    pub(super) state: Vec<T>,
    /// Candidate state.
    pub(super) next: Vec<T>,
    /// State after an accelerated update, before its momentum.
    moved: Vec<T>,
    /// The same one iteration before.
    last: Vec<T>,
    /// u₀ − Hv, folded.
    residual: Vec<T>,
    /// Dv.
    rough: Vec<T>,
    /// u₀.
    pub(super) data: Vec<T>,
    /// The same, folded.
    folded: Vec<T>,
    /// Hv, folded.
    convolved: Vec<T>,
    /// What squares of a folded image add to the sum of squares of its pixels.
    weights: Vec<f64>,
    /// Product of Hᵀ.
    product: Vec<T>,
    /// Product of D with Dv.
    rough_product: Vec<T>,
    /// Sums along x for D, with a row of zeros before and after.
    lines: Vec<T>,
    convolution: Scratch<T>,
}

impl<T: Real> Buffers<T> {
    pub(super) fn new(operator: &Operator<T>) -> Self {
        let n = operator.n;
        let image = vec![T::ZERO; padded(n)];
        let folded = vec![T::ZERO; operator.convolution.folded_len()];
        Buffers {
            state: image.clone(),
            next: image.clone(),
            moved: image.clone(),
            last: image.clone(),
            residual: folded.clone(),
            rough: image.clone(),
            data: image.clone(),
            folded: folded.clone(),
            convolved: folded,
            weights: operator.convolution.weights(),
            product: image.clone(),
            rough_product: image,
            lines: vec![T::ZERO; n * (n + 2)],
            convolution: operator.convolution.scratch(),
        }
    }
}

/// Sums of squares, each place of the lanes for itself.
#[derive(Clone, Copy)]
struct Squares([f64; LANES]);

impl Squares {
    const NONE: Self = Squares([0.0; LANES]);

    #[inline(always)]
    fn add<T: Real>(&mut self, values: [T; LANES]) {
        self.add_weighted(values, &[1.0; LANES]);
    }

    #[inline(always)]
    fn add_weighted<T: Real>(&mut self, values: [T; LANES], weights: &[f64; LANES]) {
        for l in 0..LANES {
            let value = values[l].to_f64();
            self.0[l] += weights[l] * (value * value);
        }
    }

    #[inline(always)]
    fn sum(self) -> f64 {
        self.0.iter().sum()
    }
}

/// The lanes of an image.
#[inline(always)]
fn lanes<T: Copy>(image: &[T]) -> impl Iterator<Item = &[T; LANES]> {
    image.as_chunks().0.iter()
}

#[inline(always)]
fn lanes_mut<T: Copy>(image: &mut [T]) -> impl Iterator<Item = &mut [T; LANES]> {
    image.as_chunks_mut().0.iter_mut()
}

/// Residual and roughness of the candidate; returns J(v) = ½‖u₀ − Hv‖² + ½λ‖Dv‖² (Eq. 4), which is the
/// energy E plus the constant ½‖u₀‖² but has no cancellation in it.
#[inline(always)]
fn residual<T: Real, const R: usize, const FUSED: bool>(
    operator: &Operator<T>,
    b: &mut Buffers<T>,
) -> f64 {
    let convolution = &operator.convolution;
    convolution.apply::<R, FUSED>(&b.next, &mut b.convolution, &mut b.convolved);
    let mut misfit = Squares::NONE;
    let values = lanes(&b.folded).zip(lanes(&b.convolved));
    let out = lanes_mut(&mut b.residual).zip(lanes(&b.weights));
    for ((left, weights), (data, product)) in out.zip(values) {
        // Results are stored together: the compiler does not know that they are apart from what they are made of.
        let mut out = [T::ZERO; LANES];
        for l in 0..LANES {
            out[l] = data[l].minus(product[l]);
        }
        misfit.add_weighted(out, weights);
        *left = out;
    }
    let mut roughness = Squares::NONE;
    if operator.lambda > T::ZERO {
        roughen::<T, FUSED>(&b.next, operator.n, &mut b.lines, &mut b.rough);
        for rough in lanes(&b.rough) {
            roughness.add(*rough);
        }
    }
    0.5 * misfit.sum() + 0.5 * operator.lambda.to_f64() * roughness.sum()
}

/// Takes f = Hᵀ(u₀ − Hv) − λD(Dv) (Eq. 11; D is symmetric), updates every neuron beyond its
/// threshold (Eq. 6) and clips at zero (Eq. 12) where that comes first; returns how many were beyond.
#[inline(always)]
fn update<T: Real, const R: usize, const FUSED: bool>(
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
) -> u32 {
    let convolution = &operator.convolution;
    convolution.apply_transposed::<R, FUSED>(&b.residual, &mut b.convolution, &mut b.product);
    if operator.lambda > T::ZERO {
        let minus_lambda = T::ZERO.minus(operator.lambda);
        roughen::<T, FUSED>(&b.rough, operator.n, &mut b.lines, &mut b.rough_product);
        for (f, rough) in b.product.iter_mut().zip(&b.rough_product) {
            *f = f.add_product::<FUSED>(minus_lambda, *rough);
        }
    }
    let unit = T::from_f64(rule.unit);
    let floor = floor::<T>(rule);
    let (adaptive, step) = match rule.step {
        Step::Adaptive(c) | Step::Accelerated(c) => (true, T::from_f64(c)),
        Step::Constant(delta) => (false, T::from_f64(delta)),
    };
    let mut updated = [0; LANES];
    let values = lanes(&b.state).zip(lanes(&b.product));
    let values = values.zip(lanes(&operator.thresholds));
    for (to, ((from, f), thresholds)) in lanes_mut(&mut b.next).zip(values) {
        let mut out = [T::ZERO; LANES];
        for l in 0..LANES {
            let (from, f) = (from[l], f[l]);
            // Infinite behind the image, where the state has to stay zero.
            let beyond = f.modulus() > thresholds[l].times(unit);
            let moved = if adaptive {
                from.add_product::<FUSED>(step, f)
            } else if f > T::ZERO {
                from.plus(step)
            } else {
                from.minus(step)
            };
            let value = if beyond { moved } else { from };
            out[l] = if value > floor { value } else { floor };
            updated[l] += u32::from(beyond);
        }
        *to = out;
    }
    updated.iter().sum()
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
fn clip<T: Real>(next: &mut [T]) -> bool {
    let mut negative = false;
    for value in next {
        let below = *value < T::ZERO;
        negative |= below;
        *value = if below { T::ZERO } else { *value };
    }
    negative
}

/// Adds momentum to an update from `b.state` to `b.next`: `b.moved` takes the update and `b.next` goes
/// on beyond it, in the direction from the update before. `momentum` is Nesterov's t; it starts anew
/// where the direction points uphill (O'Donoghue & Candès 2015, gradient scheme). Returns whether
/// there was any momentum.
#[inline(always)]
fn extrapolate<T: Real, const FUSED: bool>(
    rule: &Rule,
    b: &mut Buffers<T>,
    momentum: &mut f64,
) -> bool {
    let floor = floor::<T>(rule);
    // (from − moved)·(moved − last) > 0 by the squares of sum and difference.
    let (mut sum, mut difference) = (Squares::NONE, Squares::NONE);
    b.moved.copy_from_slice(&b.next);
    let values = lanes(&b.state).zip(lanes(&b.moved)).zip(lanes(&b.last));
    for ((from, moved), last) in values {
        let (mut forth, mut apart) = ([T::ZERO; LANES], [T::ZERO; LANES]);
        for l in 0..LANES {
            let (back, on) = (from[l].minus(moved[l]), moved[l].minus(last[l]));
            (forth[l], apart[l]) = (back.plus(on), back.minus(on));
        }
        sum.add(forth);
        difference.add(apart);
    }
    if sum.sum() > difference.sum() {
        *momentum = 1.0;
    }
    let next = 0.5 * (1.0 + (1.0 + 4.0 * *momentum * *momentum).sqrt());
    let beta = (*momentum - 1.0) / next;
    *momentum = next;
    if beta == 0.0 {
        return false;
    }
    let beta = T::from_f64(beta);
    for ((to, moved), last) in b.next.iter_mut().zip(&b.moved).zip(&b.last) {
        let value = moved.add_product::<FUSED>(beta, moved.minus(*last));
        *to = if value > floor { value } else { floor };
    }
    true
}

/// Runs the network from `b.state` on `b.data`; the result is left in `b.state`.
#[inline(always)]
pub(super) fn run<T: Real, const R: usize, const FUSED: bool>(
    operator: &Operator<T>,
    rule: &Rule,
    b: &mut Buffers<T>,
) -> Descent {
    let mut constant = Squares::NONE;
    for data in lanes(&b.data) {
        constant.add(*data);
    }
    let constant = 0.5 * constant.sum();
    operator.convolution.fold(&b.data, &mut b.folded);
    let mut descent = Descent {
        iterations: 0,
        stop: Stop::MaxIterations,
        first_energy: 0.0,
        energy: 0.0,
        updated: 0,
    };
    let accelerated = matches!(rule.step, Step::Accelerated(_));
    if accelerated {
        b.last.copy_from_slice(&b.state);
    }
    let (mut momentum, mut extrapolated) = (1.0, false);
    let mut cost = None;
    // Whether the candidate has passed the test and been clipped since.
    let mut clipped = false;
    // `residual` looks at the candidate, which the first state is too. It stands here once, because
    // it is inlined and by far the largest part of the code.
    std::mem::swap(&mut b.state, &mut b.next);
    loop {
        let next = residual::<T, R, FUSED>(operator, b);
        match cost {
            None => {
                std::mem::swap(&mut b.state, &mut b.next);
                descent.first_energy = next - constant;
            }
            Some(cost) if clipped || next < cost => {
                if !clipped && rule.clipping == Clipping::AfterTest && clip(&mut b.next) {
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
                b.next.copy_from_slice(&b.moved);
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
        descent.updated = update::<T, R, FUSED>(operator, rule, b);
        if descent.updated == 0 {
            descent.stop = Stop::Stable;
            break;
        }
        extrapolated = accelerated && extrapolate::<T, FUSED>(rule, b, &mut momentum);
    }
    descent
}

/// A number type that the network runs in.
pub trait Wide: Real {
    /// Runs the network. Each number type has its own function, so that it is compiled once and not again in every crate
    /// that uses it.
    #[doc(hidden)]
    fn descend(operator: &Operator<Self>, rule: &Rule, b: &mut Buffers<Self>) -> Descent;

    /// Takes `factor` times a PSF of the planned size.
    #[doc(hidden)]
    fn set_psf(operator: &mut Operator<Self>, psf: ArrayView2<'_, f64>, factor: f64);
}

/// Compiles the network in one number type for each instruction set, with as many rows of a product at a time as there
/// are registers for.
macro_rules! wide {
    ($number:ty, $descend:ident, $set_psf:ident) => {
        #[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
        fn $descend(
            operator: &Operator<$number>,
            rule: &Rule,
            b: &mut Buffers<$number>,
        ) -> Descent {
            multiversion::target::match_target! {
                "x86_64+avx512f" => run::<_, ROWS, true>(operator, rule, b),
                "x86_64+fma" => run::<_, 4, true>(operator, rule, b),
                "aarch64" => run::<_, 4, true>(operator, rule, b),
                _ => run::<_, 4, false>(operator, rule, b),
            }
        }

        #[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
        fn $set_psf(operator: &mut Operator<$number>, psf: ArrayView2<'_, f64>, factor: f64) {
            multiversion::target::match_target! {
                "x86_64+avx512f" => operator.set_psf::<ROWS, true>(psf, factor),
                "x86_64+fma" => operator.set_psf::<4, true>(psf, factor),
                "aarch64" => operator.set_psf::<4, true>(psf, factor),
                _ => operator.set_psf::<4, false>(psf, factor),
            }
        }

        impl Wide for $number {
            fn descend(operator: &Operator<Self>, rule: &Rule, b: &mut Buffers<Self>) -> Descent {
                $descend(operator, rule, b)
            }

            fn set_psf(operator: &mut Operator<Self>, psf: ArrayView2<'_, f64>, factor: f64) {
                $set_psf(operator, psf, factor);
            }
        }
    };
}

wide!(f32, descend_f32, set_psf_f32);
// Only tests run in f64.
#[cfg(test)]
wide!(f64, descend_f64, set_psf_f64);
