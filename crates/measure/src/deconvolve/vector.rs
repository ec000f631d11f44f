//! A few neighbouring pixels as one value, for each instruction set.
//!
//! The vectors with intrinsics are only made in functions compiled for their instruction set: their
//! operations are inlined into those, and would be wrong to call anywhere else.

use super::real::Real;

/// `LANES` numbers that are multiplied and added together.
pub trait Lanes<T>: Copy {
    /// Single-precision lanes of AVX-512. See docs/constants.md.
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
    /// Single-precision lanes of AVX-512. See docs/constants.md.
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
    /// Single-precision lanes of AVX-512. See docs/constants.md.
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
    fn sum(mut sums: Self::Squares) -> f64 {
        // Eight are added in pairs first, so that AVX2 rounds as its instructions do.
        let mut width = N;
        while width > 4 {
            width /= 2;
            for k in 0..width {
                sums[k] += sums[k + width];
            }
        }
        sums[..width].iter().sum()
    }
}

#[cfg(target_arch = "x86_64")]
pub use x86::Sixteen;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::{Lanes, Vector};

    /// Sixteen f32 of AVX-512.
    #[derive(Debug, Clone, Copy)]
    pub struct Sixteen(__m512);

    // SAFETY of the unsafe blocks below: the module's `Level` uses this type only in a function
    // compiled for AVX-512F, entered where the machine has it; loads and stores are of slices of
    // sixteen numbers.
    impl Lanes<f32> for Sixteen {
        /// Single-precision lanes of AVX-512. See docs/constants.md.
        const LANES: usize = 16;

        #[inline(always)]
        fn splat(value: f32) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_set1_ps(value) })
        }
        #[inline(always)]
        fn load(from: &[f32]) -> Self {
            let from = &from[..16];
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_loadu_ps(from.as_ptr()) })
        }
        #[inline(always)]
        fn store(self, to: &mut [f32]) {
            let to = &mut to[..16];
            // SAFETY: see above the implementation.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn add_product(self, a: Self, b: Self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_fmadd_ps(a.0, b.0, self.0) })
        }
    }

    impl Vector<f32> for Sixteen {
        type Squares = [__m512d; 2];

        #[inline(always)]
        fn plus(self, other: Self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_add_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn minus(self, other: Self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_sub_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn times(self, other: Self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_mul_ps(self.0, other.0) })
        }
        #[inline(always)]
        fn modulus(self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe { _mm512_abs_ps(self.0) })
        }
        #[inline(always)]
        fn where_greater(a: Self, b: Self, yes: Self, no: Self) -> Self {
            // SAFETY: see above the implementation.
            Sixteen(unsafe {
                let greater = _mm512_cmp_ps_mask::<_CMP_GT_OQ>(a.0, b.0);
                _mm512_mask_blend_ps(greater, no.0, yes.0)
            })
        }
        #[inline(always)]
        fn count_greater(a: Self, b: Self) -> u32 {
            // SAFETY: see above the implementation.
            unsafe { _mm512_cmp_ps_mask::<_CMP_GT_OQ>(a.0, b.0) }.count_ones()
        }
        #[inline(always)]
        fn no_squares() -> Self::Squares {
            // SAFETY: see above the implementation.
            [unsafe { _mm512_setzero_pd() }; 2]
        }
        #[inline(always)]
        fn add_squares(self, sums: Self::Squares) -> Self::Squares {
            // SAFETY: see above the implementation.
            unsafe {
                let bits = _mm512_castps_pd(self.0);
                let low = _mm512_cvtps_pd(_mm512_castps512_ps256(self.0));
                let high = _mm512_cvtps_pd(_mm256_castpd_ps(_mm512_extractf64x4_pd::<1>(bits)));
                [
                    _mm512_fmadd_pd(low, low, sums[0]),
                    _mm512_fmadd_pd(high, high, sums[1]),
                ]
            }
        }
        #[inline(always)]
        fn sum(sums: Self::Squares) -> f64 {
            // SAFETY: see above the implementation.
            unsafe { _mm512_reduce_add_pd(_mm512_add_pd(sums[0], sums[1])) }
        }
    }
}
