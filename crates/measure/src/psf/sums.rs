//! Sums and maxima over the pixels of a PSF. Their order is the same wherever the pixels are in memory.

use multiversion::multiversion;
use ndarray::ArrayView2;

use crate::pixel::{Pixel, contiguous};

/// Partial sums, so that an addition does not wait for the one before.
const LANES: usize = 16;

/// The sum of all pixels.
pub(super) fn sum<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of::<P, false>(pixels)
}

/// The sum of the squares of all pixels.
pub(super) fn sum_of_squares<P: Pixel>(pixels: ArrayView2<'_, P>) -> f64 {
    sum_of::<P, true>(pixels)
}

/// The sum of all pixels, or of their squares.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_of<P: Pixel, const SQUARES: bool>(pixels: ArrayView2<'_, P>) -> f64 {
    let term = |value: &P| -> f64 {
        let value: f64 = (*value).into();
        if SQUARES { value * value } else { value }
    };
    let mut sums = [0.0; LANES];
    for row in pixels.into_outer_iter() {
        let row = contiguous(row);
        let (whole, rest) = row.as_chunks::<LANES>();
        for values in whole {
            for lane in 0..LANES {
                sums[lane] += term(&values[lane]);
            }
        }
        for (sum, value) in sums.iter_mut().zip(rest) {
            *sum += term(value);
        }
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

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn largest<P: Pixel>(values: &[P]) -> Option<f64> {
    let (mut most, mut zero) = ([f64::NEG_INFINITY; LANES], [0.0; LANES]);
    let (whole, rest) = values.as_chunks::<LANES>();
    for values in whole {
        for lane in 0..LANES {
            let value: f64 = values[lane].into();
            most[lane] = if value > most[lane] {
                value
            } else {
                most[lane]
            };
            // NaN unless the value is finite.
            zero[lane] += 0.0 * value;
        }
    }
    for (lane, value) in rest.iter().enumerate() {
        let value: f64 = (*value).into();
        most[lane] = if value > most[lane] {
            value
        } else {
            most[lane]
        };
        zero[lane] += 0.0 * value;
    }
    let finite = zero.iter().sum::<f64>() == 0.0;
    let larger = |a: f64, b: f64| if b > a { b } else { a };
    finite.then(|| most.into_iter().fold(f64::NEG_INFINITY, larger))
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
