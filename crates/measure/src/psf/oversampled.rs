//! PSFs on finer pixels than the galaxies, which show the light that coarse pixels alias.
//!
//! An undersampled PSF image is the sum of the PSF and its aliases, which dithers of the galaxies do not change: m follows the alias of
//! 2π − 1 rad/px. On finer pixels the wave numbers are apart. The galaxies stay undersampled, but their aliases have
//! random phases, because galaxies lie anywhere on their pixels.

use std::f64::consts::PI;

use ndarray::{Array2, ArrayView2};

use crate::error::MeasureError;

// Wave number in radians per pixel up to which the transform of the PSF is kept. The narrowest target of a configuration ends at 2.2.
const KEPT: f64 = 2.4;
// Wave number from which it is zero.
const ZERO: f64 = 2.9;
// Fine pixels along a pixel of the galaxies. Chosen by hand.
const MAX_OVERSAMPLING: usize = 32;
// Pixels of the galaxies along the image. Chosen by hand.
const MAX_SIDE: usize = 512;

/// Gives the PSF on pixels of the galaxies, of a PSF whose image has `factor` × `factor` pixels for each of them, as simulators of optics
/// draw it: integrated over its fine pixels. The light is integrated over pixels of the galaxies here. Light at wave numbers that no configuration uses is
/// left out in place of being aliased, so that the result may ring around its core.
#[derive(Debug, Clone)]
pub struct Oversampling {
    of_columns: Array2<f64>,
    of_rows: Array2<f64>,
}

impl Oversampling {
    /// For images of this shape.
    ///
    /// # Errors
    /// If the factor is not 2 to 32, a side is no multiple of it, or the image is larger than 512 pixels of the galaxies.
    pub fn new((rows, columns): (usize, usize), factor: usize) -> Result<Self, MeasureError> {
        let fits =
            |side: usize| side.is_multiple_of(factor) && (2..=MAX_SIDE).contains(&(side / factor));
        if !(2..=MAX_OVERSAMPLING).contains(&factor) || !fits(rows) || !fits(columns) {
            let remedy = match factor {
                2..=MAX_OVERSAMPLING if rows == columns && rows / factor < MAX_SIDE => {
                    let even = rows / factor * factor;
                    format!(
                        ". Try: the PSF drawn on {even} × {even} or {0} × {0} pixels, centred in their middle; or scipy.ndimage.shift(psf, -0.5)[:{even}, :{even}] of a PSF on {1} × {1} pixels, which moves its centre from a pixel to a corner",
                        even + factor,
                        even + 1
                    )
                }
                _ => String::new(),
            };
            return Err(MeasureError::Shape {
                what: "an oversampled PSF",
                found: format!("{columns} × {rows} pixels for an oversampling of {factor}"),
                expected: format!(
                    "an oversampling of 2 to {MAX_OVERSAMPLING}, and sides of a multiple of it of up to {MAX_SIDE} pixels of the galaxies{remedy}"
                ),
            });
        }
        Ok(Oversampling {
            of_columns: integration(rows, factor),
            of_rows: integration(columns, factor),
        })
    }

    /// The PSF of an image of that shape.
    pub fn psf(&self, fine: ArrayView2<'_, f64>) -> Array2<f64> {
        self.of_columns.dot(&fine).dot(&self.of_rows.t())
    }
}

/// What integrates a line of `fine` pixels over pixels of the galaxies, `[pixel, fine pixel]`: the sum of its Fourier modes.
fn integration(fine: usize, factor: usize) -> Array2<f64> {
    let n = fine / factor;
    let modes: Vec<(f64, f64)> = (0..=n / 2)
        .map(|mode| 2.0 * PI * mode as f64 / n as f64)
        .filter(|k| *k < ZERO)
        .map(|k| {
            (
                k,
                if k == 0.0 {
                    1.0
                } else {
                    2.0 * kept(k) * pixel(k, factor)
                },
            )
        })
        .collect();
    Array2::from_shape_fn((n, fine), |(to, from)| {
        let to = to as f64 - 0.5 * (n as f64 - 1.0);
        let from = (from as f64 - 0.5 * (fine as f64 - 1.0)) / factor as f64;
        let sum: f64 = modes
            .iter()
            .map(|(k, share)| share * (k * (to - from)).cos())
            .sum();
        sum / n as f64
    })
}

/// The transform of `factor` fine pixels side by side, which make a pixel.
fn pixel(k: f64, factor: usize) -> f64 {
    let factor = factor as f64;
    (0.5 * k).sin() / (factor * (0.5 * k / factor).sin())
}

fn kept(k: f64) -> f64 {
    let place = ((k - KEPT) / (ZERO - KEPT)).clamp(0.0, 1.0);
    0.5 + 0.5 * (PI * place).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::close;

    /// A Gaussian of σ px along each axis, integrated over pixels of the galaxies if `factor` is 1, over fine ones otherwise.
    fn gaussian(sigma: f64, side: usize, factor: usize, offset: f64) -> Array2<f64> {
        let edge = |at: f64| puruspe::erf((at - offset) / (sigma * 2f64.sqrt()));
        let share = |at: usize| {
            let first = (at as f64 - 0.5 * (side * factor) as f64) / factor as f64;
            0.5 * (edge(first + 1.0 / factor as f64) - edge(first))
        };
        Array2::from_shape_fn((side * factor, side * factor), |(y, x)| share(y) * share(x))
    }

    fn from_oversampled(fine: &Array2<f64>, factor: usize) -> Result<Array2<f64>, MeasureError> {
        Ok(Oversampling::new(fine.dim(), factor)?.psf(fine.view()))
    }

    #[test]
    fn a_sampled_psf_is_the_same_from_finer_pixels() {
        for (side, factor, offset) in [(48, 2, 0.0), (33, 3, 0.3), (32, 4, -0.2)] {
            let fine = gaussian(1.6, side, factor, offset);
            let found = from_oversampled(&fine, factor).unwrap();
            let expected = gaussian(1.6, side, 1, offset);
            // Its transform is exp(−7.4) at 2.4 rad/px.
            let worst = (&found - &expected).mapv(f64::abs);
            assert!(worst.iter().all(|apart| *apart < 1e-4), "{side} {factor}");
            close(found.sum(), 1.0, 1e-6);
        }
    }

    #[test]
    fn an_undersampled_psf_keeps_its_transform_below_the_aliases() {
        let sigma = 0.4;
        for (side, offset) in [(48, 0.0), (47, 0.2)] {
            let found = from_oversampled(&gaussian(sigma, side, 4, offset), 4).unwrap();
            for k in [0.5, 1.0, 1.5, 2.0, 2.3] {
                let (mut cos, mut sin) = (0.0, 0.0);
                for ((_, x), light) in found.indexed_iter() {
                    let at = x as f64 - 0.5 * (side as f64 - 1.0) - offset;
                    cos += light * (k * at).cos();
                    sin += light * (k * at).sin();
                }
                let expected = (-0.5 * k * k * sigma * sigma).exp() * (0.5 * k).sin() / (0.5 * k);
                // The stamp ends the ringing of what is left out.
                assert!(
                    (cos - expected).abs() < 2e-3 && sin.abs() < 2e-3,
                    "{k} {cos} {sin}"
                );
            }
            // The alias of 1 rad/px alone would change it by 0.01.
        }
    }

    #[test]
    fn images_of_other_sides_are_refused() {
        for (rows, columns, factor) in [(48, 48, 1), (48, 50, 4), (4, 48, 4), (2048, 2048, 3)] {
            let fine = Array2::zeros((rows, columns));
            assert!(
                from_oversampled(&fine, factor).is_err(),
                "{rows} {columns} {factor}"
            );
        }
    }
}
