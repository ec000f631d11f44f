//! A few neighbouring pixels as one value, for each instruction set.
//!
//! They are arrays whose loops the compiler turns into instructions of the function that they are inlined into. A
//! vector of another length, or fused products without the instruction, would be slow there but not wrong.

use super::real::Real;

/// `LANES` numbers that are multiplied and added together.
pub trait Lanes<T>: Copy {
    /// How many numbers.
    const LANES: usize;

    /// The same number in all lanes.
    fn splat(value: T) -> Self;
    /// The first numbers of `from`.
    fn load(from: &[T]) -> Self;
    /// Writes the first numbers of `to`.
    fn store(self, to: &mut [T]);
    /// self + a·b, fused if the hardware can.
    fn add_product(self, a: Self, b: Self) -> Self;
}

/// Two vectors of neighbouring pixels.
#[derive(Clone, Copy)]
pub struct Pair<V>(V, V);

impl<T, V: Lanes<T>> Lanes<T> for Pair<V>
where
    T: Copy,
{
    const LANES: usize = 2 * V::LANES;

    #[inline(always)]
    fn splat(value: T) -> Self {
        let value = V::splat(value);
        Pair(value, value)
    }
    #[inline(always)]
    fn load(from: &[T]) -> Self {
        Pair(V::load(from), V::load(&from[V::LANES..]))
    }
    #[inline(always)]
    fn store(self, to: &mut [T]) {
        self.0.store(to);
        self.1.store(&mut to[V::LANES..]);
    }
    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        Pair(self.0.add_product(a.0, b.0), self.1.add_product(a.1, b.1))
    }
}

/// `LANES` numbers with all operations of the network.
pub trait Vector<T>: Lanes<T> {
    /// Sums of squares on their way.
    type Squares: Copy;

    /// self + other.
    fn plus(self, other: Self) -> Self;
    /// self − other.
    fn minus(self, other: Self) -> Self;
    /// self · other.
    fn times(self, other: Self) -> Self;
    /// |self|.
    fn modulus(self) -> Self;
    /// `yes` where a > b, else `no`.
    fn where_greater(a: Self, b: Self, yes: Self, no: Self) -> Self;
    /// How often a > b.
    fn count_greater(a: Self, b: Self) -> u32;
    /// A sum of nothing.
    fn no_squares() -> Self::Squares;
    /// Adds the squares, in f64.
    fn add_squares(self, sums: Self::Squares) -> Self::Squares;
    /// The sum of all squares added.
    fn sum(sums: Self::Squares) -> f64;
}

/// `N` numbers in the hands of the compiler.
#[derive(Debug, Clone, Copy)]
pub struct Portable<T, const N: usize, const FMA: bool>([T; N]);

impl<T: Real, const N: usize, const FMA: bool> Portable<T, N, FMA> {
    #[inline(always)]
    fn map(self, other: Self, f: impl Fn(T, T) -> T) -> Self {
        let mut out = self;
        for k in 0..N {
            out.0[k] = f(self.0[k], other.0[k]);
        }
        out
    }
}

impl<T: Real, const N: usize, const FMA: bool> Lanes<T> for Portable<T, N, FMA> {
    const LANES: usize = N;

    #[inline(always)]
    fn splat(value: T) -> Self {
        Portable([value; N])
    }
    #[inline(always)]
    fn load(from: &[T]) -> Self {
        let mut out = [T::ZERO; N];
        out.copy_from_slice(&from[..N]);
        Portable(out)
    }
    #[inline(always)]
    fn store(self, to: &mut [T]) {
        to[..N].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn add_product(self, a: Self, b: Self) -> Self {
        let mut out = self;
        for k in 0..N {
            out.0[k] = self.0[k].add_product::<FMA>(a.0[k], b.0[k]);
        }
        out
    }
}

impl<T: Real, const N: usize, const FMA: bool> Vector<T> for Portable<T, N, FMA> {
    type Squares = [f64; N];

    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        self.map(other, T::plus)
    }
    #[inline(always)]
    fn minus(self, other: Self) -> Self {
        self.map(other, T::minus)
    }
    #[inline(always)]
    fn times(self, other: Self) -> Self {
        self.map(other, T::times)
    }
    #[inline(always)]
    fn modulus(self) -> Self {
        self.map(self, |a, _| a.modulus())
    }
    #[inline(always)]
    fn where_greater(a: Self, b: Self, yes: Self, no: Self) -> Self {
        let mut out = no;
        for k in 0..N {
            out.0[k] = if a.0[k] > b.0[k] { yes.0[k] } else { no.0[k] };
        }
        out
    }
    #[inline(always)]
    fn count_greater(a: Self, b: Self) -> u32 {
        let mut count = 0;
        for k in 0..N {
            count += u32::from(a.0[k] > b.0[k]);
        }
        count
    }
    #[inline(always)]
    fn no_squares() -> Self::Squares {
        [0.0; N]
    }
    #[inline(always)]
    fn add_squares(self, mut sums: Self::Squares) -> Self::Squares {
        for (sum, value) in sums.iter_mut().zip(self.0) {
            let value = value.to_f64();
            *sum += value * value;
        }
        sums
    }
    #[inline(always)]
    fn sum(sums: Self::Squares) -> f64 {
        total(&sums)
    }
}

/// The sum of a vector's sums. As a call that reads memory it keeps them in whole vectors before; inlined, the
/// compiler divides them into pairs.
#[inline(never)]
fn total<const N: usize>(sums: &[f64; N]) -> f64 {
    // Eight are added in pairs first and sixteen in pairs only, as the instructions of AVX2 and AVX-512 do.
    let mut sums = *sums;
    let mut width = N;
    let last = if N == 16 { 1 } else { 4 };
    while width > last {
        width /= 2;
        for k in 0..width {
            sums[k] += sums[k + width];
        }
    }
    sums[..width].iter().sum()
}
