//! The mean response to shear, and the mean shear with an error that includes the error of the response.

use shearq_quantities::linear::{determinant, inverse, solve};
use shearq_quantities::statistics::{MIN_RESPONSE_SIGNIFICANCE, RunningMean};
use thiserror::Error;

use crate::measurement::{Measurement, ResponseMatrix};

pub(crate) struct DiagonalResponse {
    pub(crate) diagonal: [f64; 2],
    /// Whether each is positive by three standard errors. The response of a single galaxy has no error, and must only be
    /// positive.
    pub(crate) is_significant: bool,
}

/// The mean responses R11 and R22 of the good galaxies.
///
/// One galaxy's response is far too noisy to divide by, and correlated with its ellipticity. The mean over one image of 40
/// to 400 galaxies at S/N 10 is too: ⟨1/R̂⟩ exceeds 1/⟨R⟩ by 17 to 1 in a thousand. So ellipticities stay as they are, and
/// who averages them divides by the response of what is averaged.
pub(crate) fn mean_response(galaxies: &[Measurement]) -> DiagonalResponse {
    let mut responses = [RunningMean::default(); 2];
    for galaxy in galaxies.iter().filter(|galaxy| galaxy.flags.is_empty()) {
        for (mean, response) in responses.iter_mut().zip(galaxy.response_diagonal()) {
            mean.add(response);
        }
    }
    DiagonalResponse {
        diagonal: responses.map(|own| own.mean()),
        is_significant: responses.iter().all(is_significant),
    }
}

/// Whether a mean response can be divided by: positive by three standard errors. Otherwise the quotient is dominated by the
/// noise of its divisor, for example because there are no galaxies on the stamps.
pub fn is_significant(response: &RunningMean) -> bool {
    let (mean, count) = (response.mean(), response.count());
    let error = response.deviation() / (count as f64).sqrt();
    mean.is_finite() && mean > 0.0 && (count == 1 || mean >= MIN_RESPONSE_SIGNIFICANCE * error)
}

/// The mean shear of many galaxies.
///
/// For weights w, ellipticities e = (e1, e2) and 2 × 2 responses R,
///
/// ```text
/// g   = (Σ w R)⁻¹ Σ w e
/// cov = n/(n − 1) · (Σ w R)⁻¹ [Σ w² (e − R g)(e − R g)ᵀ] (Σ w R)⁻ᵀ
/// ```
///
/// This is the covariance of a ratio of two means to first order (Cochran 1977, Sampling Techniques, §6.3). The
/// residual e − R g contains the scatter of the responses, so the error includes the error of the mean response. A
/// common factor on ellipticities and responses changes nothing. The galaxies must be independent: pairs that are
/// rotated by 90° make the error too large, and copies make it too small.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub struct MeanShear {
    /// g1 and g2.
    pub shear: [f64; 2],
    /// Covariance of g1 and g2; NaN for a single galaxy.
    pub covariance: [[f64; 2]; 2],
    /// Weighted mean responses R11 and R22.
    pub response: [f64; 2],
    /// Weighted mean responses R12 of e1 to g2 and R21 of e2 to g1.
    pub cross_response: [f64; 2],
    /// Galaxies with a positive weight.
    pub galaxies: usize,
}

impl MeanShear {
    /// Standard errors of g1 and g2.
    pub fn error(&self) -> [f64; 2] {
        [0, 1].map(|k| self.covariance[k][k].sqrt())
    }
}

/// Why there is no mean shear.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
#[non_exhaustive]
pub enum MeanShearError {
    /// No galaxy has a positive weight and no flag.
    #[error("no galaxy without a flag has a positive weight (expected one or more)")]
    NoGalaxies,
    /// The mean response is not positive.
    #[error("the mean response R{component}{component} is {found} (expected a positive number)")]
    Response {
        /// Component, 1 or 2.
        component: usize,
        /// The mean response.
        found: f64,
    },
    /// The mean response matrix has no positive determinant.
    #[error("the determinant of the mean response is {found} (expected a positive number)")]
    Singular {
        /// R11 R22 − R12 R21 of the mean responses.
        found: f64,
    },
}

/// Weighted sums over galaxies, from which [`MeanShear`] follows. Galaxies are added one by one.
#[derive(Debug, Clone, Copy, Default)]
pub struct ShearSum {
    weight: f64,
    e: [f64; 2],
    response: ResponseMatrix,
    /// Sums of squared weights times products of (e1, e2, R11, R22, R12, R21).
    products: [[f64; 6]; 6],
    galaxies: usize,
}

impl ShearSum {
    /// Adds a galaxy without a flag, with its response and a weight.
    ///
    /// The response is the unit matrix for
    /// ellipticities without calibration. A weight of zero adds nothing. The weight must not depend on the measured
    /// ellipticity.
    pub fn add(&mut self, e: [f64; 2], response: ResponseMatrix, weight: f64) {
        if weight == 0.0 {
            return;
        }
        self.galaxies += 1;
        self.weight += weight;
        let [[r11, r12], [r21, r22]] = response;
        let values = [e[0], e[1], r11, r22, r12, r21];
        for k in 0..2 {
            self.e[k] += weight * e[k];
            for (sum, response) in self.response[k].iter_mut().zip(response[k]) {
                *sum += weight * response;
            }
        }
        for (row, a) in self.products.iter_mut().zip(values) {
            for (sum, b) in row.iter_mut().zip(values) {
                *sum += weight * weight * a * b;
            }
        }
    }

    /// The mean shear of the galaxies that were added.
    ///
    /// # Errors
    /// If no galaxy was added, or a mean response is not positive.
    pub fn mean(&self) -> Result<MeanShear, MeanShearError> {
        if self.galaxies == 0 {
            return Err(MeanShearError::NoGalaxies);
        }
        let [[r11, r12], [r21, r22]] = self.response;
        let response = [r11, r22].map(|sum| sum / self.weight);
        for (k, &found) in response.iter().enumerate() {
            if !(found > 0.0 && found.is_finite()) {
                let component = k + 1;
                return Err(MeanShearError::Response { component, found });
            }
        }
        let determinant = determinant(self.response);
        if determinant <= 0.0 {
            return Err(MeanShearError::Singular {
                found: determinant / (self.weight * self.weight),
            });
        }
        // A quotient has fewer roundings than an inverse.
        let diagonal = r12 == 0.0 && r21 == 0.0;
        let [e1, e2] = self.e;
        let shear = match diagonal {
            true => [e1 / r11, e2 / r22],
            false => solve(self.response, self.e),
        };
        let n = self.galaxies as f64;
        let squares = [0, 1].map(|k| {
            [0, 1].map(|l| {
                // e_k − g_k R_kk − g_j R_kj as coefficients of (e1, e2, R11, R22, R12, R21).
                let [ee, er] = [self.products[k][l], self.products[k][2 + l]];
                let [re, rr] = [self.products[2 + k][l], self.products[2 + k][2 + l]];
                let (k_other, l_other) = (shear[1 - k], shear[1 - l]);
                let mut residuals = ee - shear[l] * er - shear[k] * re + shear[k] * shear[l] * rr;
                if !diagonal {
                    let [ex, rx] = [self.products[k][4 + l], self.products[2 + k][4 + l]];
                    let [xe, xr] = [self.products[4 + k][l], self.products[4 + k][2 + l]];
                    residuals -= l_other * (ex - shear[k] * rx) + k_other * (xe - shear[l] * xr);
                    residuals += k_other * l_other * self.products[4 + k][4 + l];
                }
                // Rounding may leave a sum of squares below zero.
                let residuals = if k == l {
                    residuals.max(0.0)
                } else {
                    residuals
                };
                n / (n - 1.0) * residuals
            })
        });
        let covariance = match diagonal {
            true => [0, 1].map(|k| {
                [0, 1].map(|l| squares[k][l] / (self.response[k][k] * self.response[l][l]))
            }),
            false => {
                let inverse = inverse(self.response);
                [0, 1].map(|k| {
                    [0, 1].map(|l| {
                        let row = [0, 1]
                            .map(|j| inverse[k][0] * squares[0][j] + inverse[k][1] * squares[1][j]);
                        row[0] * inverse[l][0] + row[1] * inverse[l][1]
                    })
                })
            }
        };
        Ok(MeanShear {
            shear,
            covariance,
            response,
            cross_response: [r12, r21].map(|sum| sum / self.weight),
            galaxies: self.galaxies,
        })
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::measurement::{Flag, Flags};

    fn row(responses: &[f64]) -> Vec<Measurement> {
        let galaxies = responses.iter().map(|&r| match r.is_nan() {
            true => Measurement::flagged(Flag::NoLight),
            false => Measurement {
                response: Some([[r, 0.0], [0.0, 2.0 * r]]),
                ..Measurement::flagged(Flags::NONE)
            },
        });
        galaxies.collect()
    }

    #[test]
    fn mean_responses_are_those_of_good_galaxies() {
        let mean = mean_response(&row(&[0.4, 0.8, f64::NAN, 0.3]));
        let [first, second] = mean.diagonal;
        assert!((first - 0.5).abs() < 1e-12 && (second - 1.0).abs() < 1e-12);
        assert!(mean.is_significant);
        // 0.1 ± 0.1 and, of others, 0.1 ± 0.03.
        let scatter = [0.19, 0.01, 0.17, 0.03];
        for (responses, significant) in [
            (&[0.3, -0.1, 0.25, -0.05][..], false),
            (&[scatter, scatter].concat(), true),
            (&[-0.1, f64::NAN], false),
            (&[0.1], true),
            (&[f64::NAN], false),
        ] {
            assert_eq!(
                mean_response(&row(responses)).is_significant,
                significant,
                "{responses:?}"
            );
        }
    }

    const TRUE_SHEAR: [f64; 2] = [0.08, -0.05];

    fn diagonal([r11, r22]: [f64; 2]) -> ResponseMatrix {
        [[r11, 0.0], [0.0, r22]]
    }

    #[test]
    fn response_matrices_in_other_axes_give_the_same_shear() {
        // Axes that make every response diagonal give the values of two quotients.
        let (cos, sin) = (0.8, 0.6);
        let turned = |[a, b]: [f64; 2]| [cos * a - sin * b, sin * a + cos * b];
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let [mut plain, mut other] = [ShearSum::default(); 2];
        for _ in 0..50 {
            let (e, [r1, r2], weight) = galaxy(&mut rng, true);
            plain.add(e, diagonal([r1, r2]), weight);
            let mixed = cos * sin * (r1 - r2);
            let response = [
                [cos * cos * r1 + sin * sin * r2, mixed],
                [mixed, sin * sin * r1 + cos * cos * r2],
            ];
            other.add(turned(e), response, weight);
        }
        let (plain, other) = (plain.mean().unwrap(), other.mean().unwrap());
        let [[a, b], [_, d]] = plain.covariance;
        let covariance = [
            cos * cos * a - 2.0 * cos * sin * b + sin * sin * d,
            sin * sin * a + 2.0 * cos * sin * b + cos * cos * d,
        ];
        for (k, expected) in turned(plain.shear).into_iter().enumerate() {
            assert!((other.shear[k] - expected).abs() < 1e-13);
            assert!((other.covariance[k][k] - covariance[k]).abs() < 1e-13);
        }
        let b = cos * sin * (a - d) + (cos * cos - sin * sin) * b;
        assert!((other.covariance[0][1] - b).abs() < 1e-13 && b != 0.0);
        let r = cos * sin * (plain.response[0] - plain.response[1]);
        assert!(other.cross_response.iter().all(|x| (x - r).abs() < 1e-13));
    }

    #[test]
    fn equal_shears_need_the_responses_to_the_other_component() {
        let mut sum = ShearSum::default();
        for _ in 0..2 {
            sum.add([0.9 * 0.02, 0.8 * 0.02], [[0.8, 0.1], [0.1, 0.7]], 1.5);
        }
        let mean = sum.mean().unwrap();
        assert!(mean.shear.iter().all(|g| (g - 0.02).abs() < 1e-15));
        assert!(mean.error().iter().all(|error| *error < 1e-8));
        let mut singular = ShearSum::default();
        singular.add([0.1; 2], [[0.5; 2]; 2], 1.0);
        assert_eq!(
            singular.mean(),
            Err(MeanShearError::Singular { found: 0.0 })
        );
    }

    /// A galaxy whose ellipticity responds to shear by its response, or by the mean response only.
    fn galaxy(rng: &mut ChaCha8Rng, own_response: bool) -> ([f64; 2], [f64; 2], f64) {
        let mut normal = || -> f64 { StandardNormal.sample(rng) };
        let response = [0.5 + 1.2 * normal(), 0.5 + 1.2 * normal()];
        let common = 0.05 * normal();
        let e = [0, 1].map(|k| {
            let slope = if own_response { response[k] } else { 0.5 };
            TRUE_SHEAR[k] * slope + 0.04 * normal() + common
        });
        (e, response, rng.random_range(0.5..1.5))
    }

    /// Draws many samples of galaxies. Returns mean pulls, their standard deviations, the correlation of the two
    /// components minus the stated one, and the standard deviation in units of the error without the response.
    fn draws(own_response: bool) -> ([f64; 2], [f64; 2], f64, f64) {
        const DRAWS: usize = 4000;
        const GALAXIES: usize = 1500;
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let (mut sums, mut squares, mut cross, mut stated, mut naive) =
            ([0.0; 2], [0.0; 2], 0.0, 0.0, 0.0);
        for _ in 0..DRAWS {
            let mut sum = ShearSum::default();
            let mut moments = [0.0; 3];
            for _ in 0..GALAXIES {
                let (e, response, weight) = galaxy(&mut rng, own_response);
                sum.add(e, diagonal(response), weight);
                for (moment, power) in moments.iter_mut().zip(0..) {
                    *moment += e[0].powi(power);
                }
            }
            let mean = sum.mean().unwrap();
            let error = mean.error();
            let pull = [0, 1].map(|k| (mean.shear[k] - TRUE_SHEAR[k]) / error[k]);
            for k in 0..2 {
                sums[k] += pull[k];
                squares[k] += pull[k] * pull[k];
            }
            cross += pull[0] * pull[1];
            stated += mean.covariance[0][1] / (error[0] * error[1]);
            let [n, first, second] = moments;
            let scatter = (second / n - (first / n).powi(2)).sqrt();
            let without = scatter / n.sqrt() / mean.response[0];
            naive += ((mean.shear[0] - TRUE_SHEAR[0]) / without).powi(2);
        }
        let count = DRAWS as f64;
        (
            sums.map(|sum| sum / count),
            squares.map(|square| (square / count).sqrt()),
            (cross - stated) / count,
            (naive / count).sqrt(),
        )
    }

    #[test]
    fn errors_cover_the_scatter_of_repeated_draws() {
        for own_response in [true, false] {
            let (mean, deviation, correlation, naive) = draws(own_response);
            for k in 0..2 {
                // The mean pull has an error of 4000^-1/2 = 0.016. A ratio is biased by about its relative error
                // squared, here 0.004 of the shear or 0.07 of the error.
                assert!(mean[k].abs() < 0.12, "{own_response}: {mean:?}");
                // The deviation has an error of 8000^-1/2 = 0.011. Terms of second order add about 0.01.
                assert!(
                    (deviation[k] - 1.0).abs() < 0.05,
                    "{own_response}: {deviation:?}"
                );
            }
            // Of the same origin.
            assert!(correlation.abs() < 0.06, "{own_response}: {correlation}");
            // The error without the response is wrong in either case: too large or too small.
            let wrong = if own_response {
                naive < 0.9
            } else {
                naive > 1.2
            };
            assert!(wrong, "{own_response}: {naive}");
        }
    }

    #[test]
    fn weights_of_zero_do_not_count() {
        let mut sum = ShearSum::default();
        assert_eq!(sum.mean(), Err(MeanShearError::NoGalaxies));
        sum.add([f64::MAX; 2], diagonal([1.0; 2]), 0.0);
        assert_eq!(sum.mean(), Err(MeanShearError::NoGalaxies));
        sum.add([0.1, 0.2], diagonal([0.5, 2.0]), 3.0);
        let mean = sum.mean().unwrap();
        assert_eq!(mean.galaxies, 1);
        assert!((mean.shear[0] - 0.2).abs() < 1e-15 && (mean.shear[1] - 0.1).abs() < 1e-15);
        assert!(mean.error()[0].is_nan());
        sum.add([0.1, 0.2], diagonal([-5.0, 2.0]), 3.0);
        let error = sum.mean().unwrap_err();
        assert!(
            matches!(error, MeanShearError::Response { component: 1, .. }),
            "{error}"
        );
    }
}
