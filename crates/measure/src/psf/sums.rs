//! Sums and maxima over the pixels of a PSF. Their order is the same wherever the pixels are in memory.

use std::borrow::Cow;

use ndarray::{ArrayView1, ArrayView2};

use crate::pixel::Pixel;

/// Partial sums, so that an addition does not wait for the one before.
const LANES: usize = 16;

/// The sum of all pixels.
pub(super) fn sum<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of(pixels, |value| value)
}

/// The sum of the squares of all pixels.
pub(super) fn sum_of_squares<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of(pixels, |value| value * value)
}

#[inline(always)]
fn sum_of<P: Pixel>(pixels: ArrayView2<'_, P>, of: impl Fn(f64) -> f64) -> f64 {
    let mut sums = [0.0; LANES];
    for row in pixels.into_outer_iter() {
        add(&contiguous(row), &of, &mut sums);
    }
    sums.iter().sum()
}

/// The largest pixel of each row, from the first row on; `None` for rows with pixels that are not finite.
pub(super) fn largest_of_rows<P: Pixel>(
    pixels: ArrayView2<'_, P>,
) -> impl Iterator<Item = Option<f64>> {
    pixels
        .into_outer_iter()
        .map(|row| largest(&contiguous(row)))
}

/// The pixels of a row, copied where they are apart in memory.
fn contiguous<P: Pixel>(row: ArrayView1<'_, P>) -> Cow<'_, [P]> {
    row.to_slice()
        .map_or_else(|| Cow::Owned(row.to_vec()), Cow::Borrowed)
}

fn largest<P: Pixel>(values: &[P]) -> Option<f64> {
    let (mut most, mut zero) = ([f64::NEG_INFINITY; LANES], [0.0; LANES]);
    let mut take = |values: &[P]| {
        for ((most, zero), value) in most.iter_mut().zip(&mut zero).zip(values) {
            let value: f64 = (*value).into();
            *most = if value > *most { value } else { *most };
            // NaN unless the value is finite.
            *zero += 0.0 * value;
        }
    };
    let (whole, rest) = values.as_chunks::<LANES>();
    whole.iter().for_each(|values| take(values));
    take(rest);
    let finite = zero.iter().all(|zero| *zero == 0.0);
    finite.then(|| most.into_iter().fold(f64::NEG_INFINITY, f64::max))
}

#[inline(always)]
fn add<P: Pixel>(values: &[P], of: impl Fn(f64) -> f64, sums: &mut [f64; LANES]) {
    let (whole, rest) = values.as_chunks::<LANES>();
    for values in whole {
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += of((*value).into());
        }
    }
    for (sum, value) in sums.iter_mut().zip(rest) {
        *sum += of((*value).into());
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, s};

    use super::*;

    #[test]
    fn the_largest_of_a_row_is_known_unless_a_pixel_is_not_finite() {
        for columns in [1, 16, 23] {
            for at in 0..columns {
                let mut pixels = Array2::from_elem((2, columns), -3.0f32);
                pixels[(0, at)] = -2.0;
                let found: Vec<_> = largest_of_rows(pixels.view()).collect();
                assert_eq!(found, [Some(-2.0), Some(-3.0)]);
                for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    pixels[(1, at)] = bad;
                    let found: Vec<_> = largest_of_rows(pixels.view()).collect();
                    assert_eq!(found, [Some(-2.0), None]);
                }
            }
        }
    }

    #[test]
    fn sums_are_those_of_one_pixel_after_the_other_wherever_the_pixels_are() {
        for (rows, columns) in [(1, 1), (3, 16), (7, 23), (48, 40)] {
            let wide = Array2::from_shape_fn((rows + 2, 2 * columns), |(y, x)| {
                ((31 * y + 17 * x) % 101) as f64 - 20.0
            });
            let views = [
                wide.slice(s![1..=rows, 1..=columns]),
                wide.slice(s![1..=rows, ..;2]),
                wide.slice(s![1..=rows, ..columns]),
            ];
            for view in views {
                // Whole numbers: exact in any order.
                assert_eq!(sum(view), view.iter().sum::<f64>());
                let squares: f64 = view.iter().map(|value| value * value).sum();
                assert_eq!(sum_of_squares(view), squares);
            }
            let thirds = wide.mapv(|value| value / 3.0);
            let apart = thirds.slice(s![1..=rows, ..;2]);
            assert_eq!(sum(apart), sum(apart.to_owned().view()));
            let turned = apart.reversed_axes().as_standard_layout().into_owned();
            assert_eq!(sum(apart), sum(turned.view().reversed_axes()));
        }
    }
}
