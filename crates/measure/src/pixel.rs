//! Pixels of either precision.

/// `f32` or `f64`.
pub trait Pixel: Copy + Into<f64> + private::Sealed {
    /// Rounded to single precision, in which stamps are measured.
    fn to_f32(self) -> f32;
}

impl Pixel for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
}

impl Pixel for f64 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self as f32
    }
}

mod private {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}
