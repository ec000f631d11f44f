//! Pixels of either precision.

use std::borrow::Cow;

use ndarray::{ArrayView1, ArrayView2};

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

/// Copies a stamp, row by row.
pub(crate) fn copy<P: Pixel>(stamp: ArrayView2<'_, P>, to: &mut [f32]) {
    let columns = stamp.ncols().max(1);
    for (to, row) in to.chunks_exact_mut(columns).zip(stamp.into_outer_iter()) {
        copy_row(row, to);
    }
}

/// Copies a row to the beginning of another.
pub(crate) fn copy_row<P: Pixel>(row: ArrayView1<'_, P>, to: &mut [f32]) {
    // Contiguous pixels, as in an image, are converted several at a time.
    match row.as_slice() {
        Some(row) => convert(to, row.iter()),
        None => convert(to, row.iter()),
    }
}

/// The pixels of a row, copied where they are apart in memory.
pub(crate) fn contiguous<P: Pixel>(row: ArrayView1<'_, P>) -> Cow<'_, [P]> {
    row.to_slice()
        .map_or_else(|| Cow::Owned(row.to_vec()), Cow::Borrowed)
}

fn convert<'a, P: Pixel + 'a>(to: &mut [f32], from: impl Iterator<Item = &'a P>) {
    for (value, pixel) in to.iter_mut().zip(from) {
        *value = pixel.to_f32();
    }
}

mod private {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}
