//! Selected galaxies under a known shear: the mean is unbiased with the response of the selection, and biased without.

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{ImageNoise, Measurement, Measurer, Selection};

const N: usize = 48;
const SHEAR: f64 = 0.05;
/// Covariance (xx, yy, xy) of the PSF in px².
const PSF: [f64; 3] = [2.4, 2.0, 0.15];

/// A Gaussian of covariance `c` in px² about the middle of the stamp, of sum one.
fn gaussian(n: usize, c: [f64; 3]) -> Array2<f64> {
    let middle = (n as f64 - 1.0) / 2.0;
    let [xx, yy, xy] = c;
    let determinant = xx * yy - xy * xy;
    let image = Array2::from_shape_fn((n, n), |(y, x)| {
        let (x, y) = (x as f64 - middle, y as f64 - middle);
        (-0.5 * (x * x * yy + y * y * xx - 2.0 * x * y * xy) / determinant).exp()
    });
    let sum = image.sum();
    image / sum
}

/// A galaxy of distortion `e` and mean square `size` px² per axis under the shear (γ, γ), behind the PSF.
fn galaxy(size: f64, e: [f64; 2], gamma: f64) -> Array2<f64> {
    let (xx, yy, xy) = (size * (1.0 + e[0]), size * (1.0 - e[0]), size * e[1]);
    // A = [[1 + γ, γ], [γ, 1 − γ]] to first order in γ, of determinant one: A C Aᵀ.
    let (a, b, d) = (1.0 + gamma, gamma, 1.0 - gamma);
    let scale = a * d - b * b;
    let sheared = [
        (a * a * xx + 2.0 * a * b * xy + b * b * yy) / scale,
        (b * b * xx + 2.0 * b * d * xy + d * d * yy) / scale,
        (a * b * xx + (a * d + b * b) * xy + b * d * yy) / scale,
    ];
    gaussian(N, [0, 1, 2].map(|k| sheared[k] + PSF[k]))
}

/// Sums of the estimate and of its response over galaxies, of both components together.
#[derive(Default, Clone, Copy)]
struct Sums {
    slope: f64,
    response: f64,
}

impl Sums {
    fn add(&mut self, sign: f64, e: [f64; 2], response: [f64; 2]) {
        self.slope += sign * (e[0] + e[1]) / (2.0 * SHEAR);
        self.response += 0.5 * (response[0] + response[1]);
    }
}

fn measured(worker: &mut shearq_measure::PsfWorker<'_>, stamp: &Array2<f64>) -> Measurement {
    worker
        .measure(stamp.view())
        .expect("a stamp of the planned size")
}

#[test]
fn cuts_on_noisy_sizes_and_fluxes_leave_the_shear_as_it_is() {
    const BATCHES: usize = 30;
    const PAIRS: usize = 70;
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(1.0));
    let psf = gaussian(48, PSF);
    let mut worker = image.psf(psf.view()).unwrap();
    let cuts: [Selection; 3] = [
        "size > 2.6 +- 0.4",
        "snr > 8 +- 2",
        "flux < 125 +- 30, size > 2.2",
    ]
    .map(|text| text.parse().unwrap());
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    // Of each batch: with the response of the selection, and with the responses of the galaxies alone.
    let mut found = [[[0.0; BATCHES]; 2]; 3];
    let mut flagged = 0;
    for batch in 0..BATCHES {
        let mut sums = [[Sums::default(); 2]; 3];
        for _ in 0..PAIRS {
            let size: f64 = rng.random_range(3.0..12.0);
            let angle = rng.random_range(0.0..std::f64::consts::TAU);
            let modulus = rng.random_range(0.0..0.5);
            let noise: Array2<f64> =
                Array2::from_shape_fn((N, N), |_| StandardNormal.sample(&mut rng));
            // A pair turned by 90 degrees, opposite shears, and opposite noise.
            for turn in [1.0, -1.0] {
                let e = [turn * modulus * angle.cos(), turn * modulus * angle.sin()];
                for sign in [1.0, -1.0] {
                    let light = galaxy(size, e, sign * SHEAR);
                    let strength = gaussian(N, [size + 2.2, size + 2.2, 0.0]);
                    let strength = strength.iter().map(|v| v * v).sum::<f64>().sqrt();
                    for side in [1.0, -1.0] {
                        // S/N 11.
                        let stamp = &light * (11.0 / strength) + &noise * side;
                        let galaxy = measured(&mut worker, &stamp);
                        let Some(observables) = galaxy.observables else {
                            flagged += 1;
                            continue;
                        };
                        let (e, response) = ([galaxy.e1, galaxy.e2], galaxy.response.unwrap());
                        for (cut, sums) in cuts.iter().zip(&mut sums) {
                            let selected = cut.apply(e, response, &observables);
                            sums[0].add(sign, selected.e, selected.response);
                            let w = selected.weight;
                            let own = galaxy.response_diagonal().map(|r| w * r);
                            sums[1].add(sign, e.map(|e| w * e), own);
                        }
                    }
                }
            }
        }
        for (found, sums) in found.iter_mut().zip(sums) {
            for (found, sums) in found.iter_mut().zip(sums) {
                found[batch] = sums.slope / sums.response - 1.0;
            }
        }
    }
    assert!(flagged < BATCHES * PAIRS * 8 / 100, "{flagged}");
    for (cut, found) in cuts.iter().zip(found) {
        let [(with, error), (without, _)] = found.map(|values| {
            let mean = values.iter().sum::<f64>() / BATCHES as f64;
            let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
            (mean, (square / (BATCHES * (BATCHES - 1)) as f64).sqrt())
        });
        println!(
            "{:?}: {with:+.4} ± {error:.4}, without {without:+.4}",
            cut.cuts()
        );
        // A shear of 0.05 adds up to 2.5·10⁻³ of second order.
        assert!(error < 0.012, "{error}");
        assert!(
            with.abs() < 3.0 * error + 2.5e-3,
            "{cut:?}: {with} ± {error}"
        );
        assert!(without.abs() > 0.02, "{cut:?}: {without}");
    }
}
