//! The two number types.

/// `f32` or `f64`.
pub trait Real: Copy + Default + PartialOrd + Send + Sync + std::fmt::Debug + 'static {
    /// 0.
    const ZERO: Self;
    /// Rounds an `f64`.
    fn from_f64(value: f64) -> Self;
    /// Exact.
    fn to_f64(self) -> f64;
    /// self + a·b, fused if `FMA`.
    fn add_product<const FMA: bool>(self, a: Self, b: Self) -> Self;
    /// self + other.
    fn plus(self, other: Self) -> Self;
    /// self · other.
    fn times(self, other: Self) -> Self;
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
            fn plus(self, other: Self) -> Self {
                self + other
            }
            #[inline(always)]
            fn times(self, other: Self) -> Self {
                self * other
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
