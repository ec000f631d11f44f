//! The pixels of stamps in either precision: their range, and loops over them.

use std::borrow::Cow;
use std::ops::{Range, RangeInclusive};

use multiversion::multiversion;
use ndarray::{
    Array, Array3, ArrayView, ArrayView1, ArrayView2, ArrayView3, Axis, CowArray, Dimension, Ix3,
    RemoveAxis, Slice,
};
use shearq_submissions::limits::{MAX_CUT, MAX_PSF};

use crate::error::{MeasureError, length};

// Brightest pixels, in image units, whose autocorrelation keeps single precision: the squares of its values neither vanish
// nor overflow.
pub(crate) const PEAK_RANGE: RangeInclusive<f32> = 1e-18..=1e17;
// Noise levels other than zero, in image units, whose squares keep single precision like the squares of [`PEAK_RANGE`].
const NOISE_LEVEL_RANGE: RangeInclusive<f64> = 1e-30..=1e18;

/// Whether a noise level can be used.
pub(crate) fn is_level(sigma: f64) -> bool {
    sigma == 0.0 || NOISE_LEVEL_RANGE.contains(&sigma)
}

/// `f32` or `f64`.
pub trait Pixel: Copy + Send + Sync + Into<f64> + private::Sealed {
    /// Rounded to single precision, in which stamps are measured.
    fn to_f32(self) -> f32;

    /// Stamps of this precision.
    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3>;
}

impl Pixel for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }

    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3> {
        stamps.into()
    }
}

impl Pixel for f64 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self as f32
    }

    fn pixels(stamps: ArrayView3<'_, Self>) -> Pixels<'_, Ix3> {
        stamps.into()
    }
}

/// Pixels of stamps in single or double precision, borrowed or owned.
#[derive(Debug, Clone)]
pub enum Pixels<'a, D: Dimension> {
    /// `f32`.
    Single(CowArray<'a, f32, D>),
    /// `f64`.
    Double(CowArray<'a, f64, D>),
}

impl<'a, D: Dimension> From<ArrayView<'a, f32, D>> for Pixels<'a, D> {
    fn from(pixels: ArrayView<'a, f32, D>) -> Self {
        Pixels::Single(pixels.into())
    }
}

impl<'a, D: Dimension> From<ArrayView<'a, f64, D>> for Pixels<'a, D> {
    fn from(pixels: ArrayView<'a, f64, D>) -> Self {
        Pixels::Double(pixels.into())
    }
}

impl<D: Dimension> From<Array<f32, D>> for Pixels<'_, D> {
    fn from(pixels: Array<f32, D>) -> Self {
        Pixels::Single(pixels.into())
    }
}

impl<D: Dimension> From<Array<f64, D>> for Pixels<'_, D> {
    fn from(pixels: Array<f64, D>) -> Self {
        Pixels::Double(pixels.into())
    }
}

impl<D: Dimension> Pixels<'_, D> {
    /// Lengths of the axes.
    pub fn dim(&self) -> D::Pattern {
        match self {
            Pixels::Single(pixels) => pixels.dim(),
            Pixels::Double(pixels) => pixels.dim(),
        }
    }

    /// A view of the same pixels.
    pub fn view(&self) -> Pixels<'_, D> {
        match self {
            Pixels::Single(pixels) => pixels.view().into(),
            Pixels::Double(pixels) => pixels.view().into(),
        }
    }
}

impl<D: RemoveAxis> Pixels<'_, D> {
    /// Some of the stamps along the first axis, without a copy.
    #[must_use]
    pub fn into_slice(mut self, range: Range<usize>) -> Self {
        match &mut self {
            Pixels::Single(stamps) => stamps.slice_axis_inplace(Axis(0), Slice::from(range)),
            Pixels::Double(stamps) => stamps.slice_axis_inplace(Axis(0), Slice::from(range)),
        }
        self
    }
}

impl Pixels<'_, Ix3> {
    /// Stamps of an image of `count` stamps of `side` pixels next to each other, row-major.
    ///
    /// # Errors
    /// If the image has another number of pixels.
    pub fn strip(pixels: Vec<f32>, count: usize, side: usize) -> Result<Self, MeasureError> {
        length("a strip of stamps", pixels.len(), count * side * side)?;
        let rows = Array3::from_shape_vec((side, count, side), pixels);
        let rows = rows.map_err(|error| MeasureError::Shape {
            what: "a strip of stamps",
            found: format!("{count} stamps of {side} × {side} pixels"),
            expected: error.to_string(),
        })?;
        Ok(rows.permuted_axes([1, 0, 2]).into())
    }
}

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

/// The largest pixel, or zero if none is positive. 64 running maxima let vector instructions take several at a time.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn highest(pixels: &[f32]) -> f32 {
    // Four vectors of AVX-512, so that comparisons overlap.
    const LANES: usize = 64;
    let mut lanes = [0.0f32; LANES];
    let chunks = pixels.chunks_exact(LANES);
    let rest = chunks.remainder().iter().copied().fold(0.0, f32::max);
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            // Not a number is not larger.
            *lane = if *value > *lane { *value } else { *lane };
        }
    }
    lanes.into_iter().fold(rest, f32::max)
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn all_finite(pixels: &[f32]) -> bool {
    // No early exit, so that several pixels are tested at a time.
    let largest = pixels
        .iter()
        .fold(0, |most: u32, value| most.max(value.abs().to_bits()));
    largest < f32::INFINITY.to_bits()
}

pub(crate) fn check_sizes(n: usize, p: usize) -> Result<(), MeasureError> {
    if !(3..=MAX_CUT).contains(&n) {
        let expected = format!("a side of 3 to {MAX_CUT} pixels");
        return Err(MeasureError::square("a stamp", (n, n), expected));
    }
    if !(2..=MAX_PSF).contains(&p) {
        let expected = format!("a side of 2 to {MAX_PSF} pixels");
        return Err(MeasureError::square("a PSF stamp", (p, p), expected));
    }
    Ok(())
}

pub(crate) fn check_psf(psf: ArrayView2<'_, f64>, p: usize) -> Result<(), MeasureError> {
    if psf.dim() != (p, p) {
        let expected = format!("{p} × {p}");
        return Err(MeasureError::square("a PSF stamp", psf.dim(), expected));
    }
    // Without the places of its pixels, which only a bad one needs, and without an early exit.
    if !psf.fold(false, |bad, value| bad | !value.is_finite()) {
        return Ok(());
    }
    match psf.indexed_iter().find(|(_, value)| !value.is_finite()) {
        None => Ok(()),
        Some(((y, x), _)) => Err(MeasureError::NotFinite {
            what: "PSF stamp",
            x: x + 1,
            y: y + 1,
        }),
    }
}

mod private {
    pub trait Sealed {}
    impl Sealed for f32 {}
    impl Sealed for f64 {}
}

/// The pixels of an n × n stamp within `width` of its edges, in pieces, row by row.
pub fn frame(stamp: &[f32], n: usize, width: usize) -> impl Iterator<Item = &[f32]> {
    let width = width.min(n);
    let rows = stamp.chunks_exact(n).enumerate();
    rows.flat_map(move |(y, row)| match y < width || y >= n - width {
        true => [row, &[]],
        false => [&row[..width], &row[n - width..]],
    })
}
