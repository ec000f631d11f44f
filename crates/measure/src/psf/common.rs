//! What the noisy stars of an image have in common beyond the profiles that fit them.
//!
//! The profile of a noisy star rests on what is expected of stars in general: noise hides its wings. What the fits leave tells, in
//! the mean over many stars, how the stars of this image differ from that expectation. It is a function of the profile's own
//! radius √s in units of its amplitude, so that stars of any width and ellipticity can share it.

use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;

use super::moffat::Moffat;

/// Steps per unit of √s between radii, between which the function is linear. See docs/constants.md.
const FINE: usize = 2;
/// Number of these radii, up to √s = 18; beyond the last one it is constant. See docs/constants.md.
const COUNT: usize = 37;
/// Relative addition to the diagonal of the normal equations, for radii that no pixel has. See docs/constants.md.
const RIDGE: f64 = 1e-9;

/// What the noisy stars of an image have in common: [`StarSurvey::common`](crate::StarSurvey::common).
#[derive(Debug, Clone, PartialEq)]
pub struct CommonProfile {
    /// For each range of S/N its lower end, and the function. The first is for all stars below as well.
    pub(super) ranges: Vec<(f64, Common)>,
}

/// A function of the radius √s of profiles, in units of their amplitudes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Common {
    /// Values at the radii.
    values: [f64; COUNT],
}

/// Sums of the normal equations for the values at the radii. Only radii next to each other have products.
#[derive(Debug, Clone)]
pub(super) struct Sums {
    /// Mean square of what is left, in units of the noise.
    pub(super) left: f64,
    squares: [f64; COUNT],
    /// Products with the radius before.
    products: [f64; COUNT],
    right: [f64; COUNT],
}

impl Default for Sums {
    fn default() -> Self {
        Sums {
            left: 0.0,
            squares: [0.0; COUNT],
            products: [0.0; COUNT],
            right: [0.0; COUNT],
        }
    }
}

impl Sums {
    /// Those of a star with noise `sigma`, and the profile that fits it, which is drawn in `model`.
    pub(super) fn of(
        star: ArrayView2<'_, f64>,
        model: ArrayView2<'_, f64>,
        profile: &Moffat,
        sigma: f64,
    ) -> Self {
        let mut sums = Sums::default();
        let amplitude = profile.amplitude();
        let weight = (amplitude / sigma).powi(2);
        let square = profile.square();
        for (((y, x), value), model) in star.indexed_iter().zip(model) {
            let left = (value - model) / amplitude;
            let (at, far) = place(square(x as f64, y as f64).sqrt());
            let near = 1.0 - far;
            sums.squares[at] += weight * near * near;
            sums.squares[at + 1] += weight * far * far;
            sums.products[at + 1] += weight * near * far;
            sums.right[at] += weight * near * left;
            sums.right[at + 1] += weight * far * left;
            sums.left += weight * left * left;
        }
        sums.left /= star.len() as f64;
        sums
    }

    /// Adds those of another star with a weight.
    pub(super) fn add(&mut self, more: &Sums, weight: f64) {
        for (sums, more) in [
            (&mut self.squares, &more.squares),
            (&mut self.products, &more.products),
            (&mut self.right, &more.right),
        ] {
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += weight * more;
            }
        }
    }

    /// The function that fits best. It is not reduced for its noise: that is small beside the noise of each star, and what is
    /// missing of the mean would bias all images alike.
    pub(super) fn common(&self) -> Option<Common> {
        let most = self.squares.iter().copied().fold(0.0, f64::max);
        let mut matrix = [[0.0; COUNT]; COUNT];
        for (k, row) in matrix.iter_mut().enumerate() {
            row[k] = self.squares[k] + RIDGE * most;
            if k > 0 {
                row[k - 1] = self.products[k];
            }
        }
        let mut values = self.right;
        let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
        cholesky(&mut matrix, &mut values, COUNT, positive)?;
        Some(Common { values })
    }
}

impl CommonProfile {
    /// The function for stars of an S/N.
    pub(super) fn of(&self, snr: f64) -> &Common {
        let above = self.ranges.partition_point(|(from, _)| *from <= snr);
        &self.ranges[above.saturating_sub(1)].1
    }
}

impl Common {
    /// Largest difference to another one, in units of the largest value of that one.
    #[cfg(test)]
    pub(super) fn unlike(&self, other: &Self) -> f64 {
        let pairs = self.values.iter().zip(&other.values);
        let most = |sum: f64, value: f64| sum.max(value.abs());
        let off = pairs.map(|(a, b)| a - b).fold(0.0, most);
        off / other.values.iter().copied().fold(0.0, most)
    }

    /// Adds it to a profile that was drawn.
    pub(super) fn add(&self, profile: &Moffat, mut star: ArrayViewMut2<'_, f64>) {
        let (amplitude, square) = (profile.amplitude(), profile.square());
        for (y, mut row) in star.rows_mut().into_iter().enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let (at, share) = place(square(x as f64, y as f64).sqrt());
                let [near, far] = [self.values[at], self.values[at + 1]];
                *value += amplitude * (near + share * (far - near));
            }
        }
    }
}

/// The last radius that is not beyond this one, but for the last of all, and the share of the next.
#[inline(always)]
fn place(radius: f64) -> (usize, f64) {
    let steps = FINE as f64 * radius;
    let at = (steps as usize).min(COUNT - 2);
    (at, (steps - at as f64).min(1.0))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::breadth;
    use super::*;

    const N: usize = 48;

    #[test]
    fn radii_have_the_means_of_what_profiles_leave() {
        let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::new(0.04, -0.03));
        let star = psf.unwrap().stamp(N);
        let area = breadth::area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        // Any function that is linear between the radii is found again.
        let values = std::array::from_fn(|k| 0.01 * (k as f64).sin());
        let common = Common { values };
        let mut model = Array2::zeros((N, N));
        profile.draw(model.view_mut());
        let mut star = model.clone();
        common.add(&profile, star.view_mut());
        let sums = Sums::of(star.view(), model.view(), &profile, 1e-7);
        let found = sums.common().unwrap();
        let reach = profile.square()(0.0, 0.0).sqrt() * FINE as f64;
        let seen = (reach as usize).min(COUNT - 1);
        assert!(seen > 20, "{seen}");
        for (k, (found, value)) in found.values.iter().zip(&values).enumerate().take(seen) {
            // The relative addition to the equations, and radii with few pixels.
            assert!((found - value).abs() < 1e-5, "{k} {found} {value}");
        }
        assert_eq!(place(0.75), (1, 0.5));
        assert_eq!(place(17.75), (35, 0.5));
        assert_eq!(place(40.0), (35, 1.0));
    }
}
