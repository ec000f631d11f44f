//! Shapes of PSFs by adaptive moments, for which catalogues can be tested for leakage.

use multiversion::multiversion;
use ndarray::ArrayView2;
use shearq_quantities::{Distortion, Jacobian, Shear};

use super::width::{gaussian_variance, noise_equivalent_area};
use crate::measurement::PsfShape;
use crate::pixels::contiguous;

// In σ of the weight, as GalSim's HSM takes pixels.
const RADIUS_SIGMAS: f64 = 5.0;
// Change of the moments, in units of their trace, below which they count as found. Chosen by hand: what remains is below 4·10⁻⁷
// of an ellipticity, because steps of Moffat profiles fall by factors of 4 to 6, of others faster.
const CONVERGED: f64 = 1e-6;
// Variance in px² of the Gaussian of the same noise-equivalent area, below which a PSF may be too narrow for a weight of its own size.
// Chosen by hand: such a weight sees no neighbour of the central pixel.
const NARROW_VARIANCE: f64 = 0.5;
// Variance in px² of the weight that it gets then. Chosen by hand: the neighbours count, and the noise beyond them does not.
const WIDE_VARIANCE: f64 = 1.0;
// Moffat profiles need about eight. Chosen by hand.
const MAX_ITERATIONS: usize = 100;
// A vector of AVX-512 in double precision.
const COLUMN_LANES: usize = 8;

impl PsfShape {
    /// Of the pixels of a PSF; NaN if the moments do not converge, as for a PSF that is mostly noise. A PSF that is narrower than a
    /// pixel has those under a fixed weight.
    pub(crate) fn from_psf(psf: ArrayView2<'_, f64>) -> Self {
        let round = gaussian_variance(noise_equivalent_area(psf));
        let fixed = || {
            let weight = [WIDE_VARIANCE, 0.0, WIDE_VARIANCE];
            (round < NARROW_VARIANCE).then(|| Self::under_weight(psf, weight))?
        };
        let found = Self::adaptive(psf, round).or_else(fixed);
        found.unwrap_or(PsfShape::UNKNOWN)
    }

    /// As a Gaussian would have them that has the moments under a weight.
    fn under_weight(psf: ArrayView2<'_, f64>, weight: [f64; 3]) -> Option<Self> {
        let (weighted, _) = weighted_moments(psf, weight, [0.0; 2])?;
        let (seen, own) = (inverse(weighted)?, inverse(weight)?);
        let moments = inverse([0, 1, 2].map(|k| seen[k] - own[k]))?;
        Some(PsfShape { moments })
    }

    fn adaptive(psf: ArrayView2<'_, f64>, round: f64) -> Option<Self> {
        let (mut moments, mut centre) = ([round, 0.0, round], [0.0; 2]);
        for _ in 0..MAX_ITERATIONS {
            let Some((weighted, shift)) = weighted_moments(psf, moments, centre) else {
                break;
            };
            // A Gaussian under the weight W has the inverse moments C⁻¹ + M⁻¹, so that this step is exact for one, where doubling the
            // weighted moments needs twenty.
            let (Some(seen), Some(own)) = (inverse(weighted), inverse(moments)) else {
                break;
            };
            let Some(next) = inverse([0, 1, 2].map(|k| seen[k] - own[k])) else {
                break;
            };
            let changes = [0, 1, 2].map(|k| (next[k] - moments[k]).abs());
            let change = changes.into_iter().fold(0.0, f64::max) / (next[0] + next[2]);
            moments = next;
            centre = [0, 1].map(|axis| centre[axis] + 2.0 * shift[axis]);
            if change < CONVERGED {
                return Some(PsfShape { moments });
            }
        }
        None
    }

    /// In the frame of the sky, for pixels with this Jacobian. Adaptive moments follow linear maps, so that they need not be
    /// measured again.
    pub(crate) fn on_sky(self, jacobian: &Jacobian) -> Self {
        let scale = jacobian.pixel_scale();
        let [[a, b], [c, d]] = jacobian.matrix().map(|row| row.map(|value| value / scale));
        let [xx, xy, yy] = self.moments;
        PsfShape {
            moments: [
                a * a * xx + 2.0 * a * b * xy + b * b * yy,
                a * c * xx + (a * d + b * c) * xy + b * d * yy,
                c * c * xx + 2.0 * c * d * xy + d * d * yy,
            ],
        }
    }

    /// The mean of the moments of several PSFs with weights, in pixels of the areas given.
    pub(crate) fn mean(of: impl Iterator<Item = (Self, f64, f64)>) -> Self {
        let (mut sums, mut total) = ([0.0; 3], 0.0);
        for (PsfShape { moments }, area, weight) in of {
            sums = [0, 1, 2].map(|k| sums[k] + weight * area * moments[k]);
            total += weight;
        }
        PsfShape {
            moments: sums.map(|sum| sum / total),
        }
    }

    /// The ellipticity, of shear type (1 − q)/(1 + q) in either kind of catalogue; NaN if unknown.
    pub fn ellipticity(&self) -> [f64; 2] {
        let [xx, xy, yy] = self.moments;
        let trace = xx + yy;
        let shear = Distortion::new((xx - yy) / trace, 2.0 * xy / trace).to_shear();
        shear.map_or([f64::NAN; 2], |Shear { e1, e2 }| [e1, e2])
    }

    /// (det M)^¼ in pixels: σ of the round Gaussian of the same area; NaN if unknown.
    pub fn sigma(&self) -> f64 {
        let [xx, xy, yy] = self.moments;
        (xx * yy - xy * xy).sqrt().sqrt()
    }
}

/// Inverse of a symmetric matrix; `None` unless it is positive definite.
fn inverse([xx, xy, yy]: [f64; 3]) -> Option<[f64; 3]> {
    let determinant = xx * yy - xy * xy;
    (xx > 0.0 && determinant > 0.0 && determinant.is_finite())
        .then(|| [yy, -xy, xx].map(|value| value / determinant))
}

/// Second moments about the centroid under a Gaussian weight of these `moments` about `centre`, and that centroid from `centre`.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weighted_moments(
    psf: ArrayView2<'_, f64>,
    moments: [f64; 3],
    centre: [f64; 2],
) -> Option<([f64; 3], [f64; 2])> {
    let [a, b, c] = inverse(moments)?;
    let (rows, columns) = psf.dim();
    let middle = [columns, rows].map(|side| (side as f64 - 1.0) / 2.0);
    let at = [0, 1].map(|axis| middle[axis] + centre[axis]);
    let within = |axis: usize, side: usize| {
        let reach = RADIUS_SIGMAS * moments[2 * axis].sqrt();
        let first = (at[axis] - reach).ceil().max(0.0) as usize;
        first..(((at[axis] + reach).floor() + 1.0).max(0.0) as usize).min(side)
    };
    let (across, down) = (within(0, columns), within(1, rows));
    let [x0, y0] = [across.start as f64 - at[0], down.start as f64 - at[1]];
    // The weight is exp(−½(a x² + 2 b x y + c y²)): its values in the first row, and what takes them to the next row, follow by
    // steps along x, so that no pixel needs an exponential.
    let mut weight = (-0.5 * (a * x0 * x0 + 2.0 * b * x0 * y0 + c * y0 * y0)).exp();
    let mut step = (-0.5 * a * (2.0 * x0 + 1.0) - b * y0).exp();
    let mut down_step = (-0.5 * c * (2.0 * y0 + 1.0) - b * x0).exp();
    let [of_step, of_down_step, from_row_to_row] = [a, b, c].map(|value| (-value).exp());
    let mut sums = [0.0; 6];
    for first in across.clone().step_by(COLUMN_LANES) {
        let [mut weights, mut steps] = [[0.0; COLUMN_LANES]; 2];
        for lane in 0..COLUMN_LANES.min(across.end - first) {
            (weights[lane], steps[lane]) = (weight, down_step);
            weight *= step;
            step *= of_step;
            down_step *= of_down_step;
        }
        let [mut light, mut of_y, mut of_yy] = [[0.0; COLUMN_LANES]; 3];
        let mut y = y0;
        for row in psf.outer_iter().skip(down.start).take(down.len()) {
            let row = contiguous(row);
            let pixels: [f64; COLUMN_LANES] =
                row[first..].first_chunk().copied().unwrap_or_else(|| {
                    std::array::from_fn(|lane| row.get(first + lane).copied().unwrap_or(0.0))
                });
            for lane in 0..COLUMN_LANES {
                let value = weights[lane] * pixels[lane];
                light[lane] += value;
                of_y[lane] += value * y;
                of_yy[lane] += value * (y * y);
                weights[lane] *= steps[lane];
                steps[lane] *= from_row_to_row;
            }
            y += 1.0;
        }
        for lane in 0..COLUMN_LANES {
            let x = (first + lane) as f64 - at[0];
            let [light, of_y, of_yy] = [light[lane], of_y[lane], of_yy[lane]];
            let more = [light, light * x, of_y, light * x * x, of_y * x, of_yy];
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += more;
            }
        }
    }
    let [light, x, y, xx, xy, yy] = sums;
    if light <= 0.0 || !light.is_finite() {
        return None;
    }
    let [x, y, xx, xy, yy] = [x, y, xx, xy, yy].map(|sum| sum / light);
    Some(([xx - x * x, xy - x * y, yy - y * y], [x, y]))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{Jacobian, PsfProfile, Shear};

    use super::*;
    use crate::psf::testing::{drawn, noisy};

    fn gaussian(moments: [f64; 3], centre: [f64; 2]) -> Array2<f64> {
        let [a, b, c] = inverse(moments).unwrap();
        Array2::from_shape_fn((32, 32), |(y, x)| {
            let (x, y) = (x as f64 - 15.5 - centre[0], y as f64 - 15.5 - centre[1]);
            (-0.5 * (a * x * x + 2.0 * b * x * y + c * y * y)).exp()
        })
    }

    #[test]
    fn gaussians_have_their_own_moments() {
        let moments = [3.1, 0.4, 2.2];
        for centre in [[0.0; 2], [0.4, -0.8]] {
            let psf = gaussian(moments, centre);
            let found = PsfShape::from_psf((&psf / psf.sum()).view());
            for (found, expected) in found.moments.iter().zip(moments) {
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
        // Pixels do not matter to a wide PSF, so that the shear-type ellipticity is the formula's.
        let wide = drawn(
            PsfProfile::Moffat { beta: 3.0 },
            6.0,
            Shear::new(0.05, -0.03),
            64,
        );
        let found = PsfShape::from_psf(wide.view());
        let [e1, e2] = found.ellipticity();
        assert!(
            (e1 - 0.05).abs() < 1e-3 && (e2 + 0.03).abs() < 1e-3,
            "{e1} {e2}"
        );
        let noise = noisy(&wide, 0.02, &mut ChaCha8Rng::seed_from_u64(4));
        let sigma = PsfShape::from_psf(noise.view()).sigma();
        assert!(sigma.is_nan() || sigma > 0.0);
    }

    #[test]
    fn psfs_narrower_than_a_pixel_have_a_shape() {
        for fwhm in [0.3, 0.5, 0.8, 1.2] {
            let psf = drawn(
                PsfProfile::Moffat { beta: 3.0 },
                fwhm,
                Shear::new(0.1, 0.0),
                32,
            );
            let found = PsfShape::from_psf(psf.view());
            let [e1, e2] = found.ellipticity();
            assert!(e1.abs() < 0.2 && e2.abs() < 1e-6, "{fwhm}: {e1} {e2}");
            assert!(
                (0.05..1.2).contains(&found.sigma()),
                "{fwhm}: {}",
                found.sigma()
            );
        }
    }

    #[test]
    fn adaptive_moments_are_those_of_galsim() {
        // galsim.Moffat(3, fwhm=3.4).shear(g1=0.06, g2=-0.04).drawImage(nx=32, ny=32, scale=1), FindAdaptiveMom of version 2.8.
        let psf = drawn(
            PsfProfile::Moffat { beta: 3.0 },
            3.4,
            Shear::new(0.06, -0.04),
            32,
        );
        let found = PsfShape::from_psf(psf.view());
        let [e1, e2] = found.ellipticity();
        let expected = [0.057_834, -0.038_571, 1.668_405];
        for (found, expected) in [e1, e2, found.sigma()].into_iter().zip(expected) {
            assert!((found - expected).abs() < 2e-4, "{found} {expected}");
        }
    }

    #[test]
    fn jacobians_turn_and_shear_the_moments() {
        let psf = gaussian([3.1, 0.4, 2.2], [0.0; 2]);
        let psf = PsfShape::from_psf((&psf / psf.sum()).view());
        // Columns to the north and rows to the east: u = −y and v = x.
        let turned = psf.on_sky(&Jacobian::new([[0.0, -0.2], [0.2, 0.0]]).unwrap());
        let ([e1, e2], [t1, t2]) = (psf.ellipticity(), turned.ellipticity());
        assert!((t1 + e1).abs() < 1e-12 && (t2 + e2).abs() < 1e-12);
        assert!((turned.sigma() - psf.sigma()).abs() < 1e-12);
        // By 30 degrees, and so ellipticities by 60.
        let (cos, sin) = (0.2 * 0.75f64.sqrt(), 0.1);
        let [t1, t2] = psf
            .on_sky(&Jacobian::new([[cos, -sin], [sin, cos]]).unwrap())
            .ellipticity();
        let (cos, sin) = (0.5, 0.75f64.sqrt());
        assert!(
            (t1 - cos * e1 + sin * e2).abs() < 1e-12 && (t2 - sin * e1 - cos * e2).abs() < 1e-12
        );
        let sheared = psf.on_sky(&Jacobian::new([[0.22, 0.0], [0.0, 0.2]]).unwrap());
        assert!(sheared.ellipticity()[0] > e1 + 0.04);
        let mean = PsfShape::mean([(psf, 1.0, 1.0), (turned, 1.0, 1.0)].into_iter());
        assert!(mean.ellipticity().iter().all(|e| e.abs() < 1e-12));
    }
}
