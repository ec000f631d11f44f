//! Selected galaxies under a known shear: the mean is unbiased with the response of the selection, and biased without.

use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_measure::{Cut, ImageNoise, Measurement, Measurer, Observables, Quantity, Selection};
use shearq_submissions::{Configuration, Method};

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

const BATCHES: usize = 30;
const PAIRS: usize = 70;

/// Measures noisy galaxies of S/N 11 in pairs turned by 90 degrees, under opposite shears and with opposite noise. `visit` gets the
/// number of the batch, the sign of the shear, and the measurement. Returns the number of galaxies that are flagged.
fn measure_pairs(measurer: &Measurer, mut visit: impl FnMut(usize, f64, &Measurement)) -> usize {
    let mut worker = measurer.worker();
    let mut image = worker.image(ImageNoise::Level(1.0));
    let psf = gaussian(48, PSF);
    let mut worker = image.psf(psf.view()).expect("a PSF of the planned size");
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut flagged = 0;
    for batch in 0..BATCHES {
        for _ in 0..PAIRS {
            let size: f64 = rng.random_range(3.0..12.0);
            let angle = rng.random_range(0.0..std::f64::consts::TAU);
            let modulus = rng.random_range(0.0..0.5);
            let noise: Array2<f64> =
                Array2::from_shape_fn((N, N), |_| StandardNormal.sample(&mut rng));
            for turn in [1.0, -1.0] {
                let e = [turn * modulus * angle.cos(), turn * modulus * angle.sin()];
                for sign in [1.0, -1.0] {
                    let light = galaxy(size, e, sign * SHEAR);
                    let strength = gaussian(N, [size + 2.2, size + 2.2, 0.0]);
                    let strength = strength.iter().map(|v| v * v).sum::<f64>().sqrt();
                    for side in [1.0, -1.0] {
                        let stamp = &light * (11.0 / strength) + &noise * side;
                        let galaxy = measured(&mut worker, &stamp);
                        if galaxy.observables.is_some() {
                            visit(batch, sign, &galaxy);
                        } else {
                            flagged += 1;
                        }
                    }
                }
            }
        }
    }
    flagged
}

/// Mean of batches and its error.
fn mean_of(batches: [f64; BATCHES]) -> (f64, f64) {
    let mean = batches.iter().sum::<f64>() / BATCHES as f64;
    let square = batches.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
    (mean, (square / (BATCHES * (BATCHES - 1)) as f64).sqrt())
}

#[test]
fn cuts_on_noisy_sizes_and_fluxes_leave_the_shear_as_it_is() {
    let measurer = Measurer::named("48/linear/star", N).unwrap();
    let cut = |quantity, above, threshold, half_width| {
        Cut::new(quantity, above, threshold, half_width).unwrap()
    };
    let cuts = [
        Selection::default().with_cut(cut(Quantity::Size, true, 2.6, Some(0.4))),
        Selection::default().with_cut(cut(Quantity::Snr, true, 8.0, Some(2.0))),
        Selection::default()
            .with_cut(cut(Quantity::Flux, false, 125.0, Some(30.0)))
            .with_cut(cut(Quantity::Size, true, 2.2, None)),
        // Noise alone decides: the light of the ring has a tenth of its noise.
        Selection::default().with_cut(cut(Quantity::Neighbour, false, 0.2, Some(0.3))),
    ];
    // Of each cut: with the response of the selection, and with the responses of the galaxies alone.
    let mut sums = [[[Sums::default(); BATCHES]; 2]; 4];
    let flagged = measure_pairs(&measurer, |batch, sign, galaxy| {
        let (e, response) = ([galaxy.e1, galaxy.e2], galaxy.response.unwrap());
        for (cut, sums) in cuts.iter().zip(&mut sums) {
            let selected = cut.apply(e, response, &galaxy.observables.unwrap());
            sums[0][batch].add(
                sign,
                selected.e,
                [selected.response[0][0], selected.response[1][1]],
            );
            let w = selected.weight;
            let own = galaxy.response_diagonal().map(|r| w * r);
            sums[1][batch].add(sign, e.map(|e| w * e), own);
        }
    });
    assert!(flagged < BATCHES * PAIRS * 8 / 100, "{flagged}");
    for (cut, sums) in cuts.iter().zip(sums) {
        let [(with, error), (without, _)] =
            sums.map(|sums| mean_of(sums.map(|sums| sums.slope / sums.response - 1.0)));
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

/// Sums of ellipticities and numbers, of galaxies that are selected without shear, with plus and with minus: of both
/// components.
#[derive(Default, Clone, Copy)]
struct VersionSums {
    /// Under either sign of the true shear.
    plain: [[f64; 2]; 2],
    /// Under both.
    sheared: [[f64; 2]; 2],
    /// The same for those that are selected without shear.
    alike: [[f64; 2]; 2],
}

impl VersionSums {
    /// m, from versions that are selected each for itself, and from those that are selected without shear.
    fn bias(&self, step: f64) -> [f64; 2] {
        let means = |sums: [[f64; 2]; 2]| sums.map(|[e, count]| e / count);
        let difference = |sums: [[f64; 2]; 2]| means(sums)[0] - means(sums)[1];
        let slope = difference(self.plain) / (2.0 * SHEAR);
        [self.sheared, self.alike].map(|sums| slope / (difference(sums) / (2.0 * step)) - 1.0)
    }
}

#[test]
fn sharp_cuts_of_sheared_versions_leave_the_shear_as_it_is() {
    let step = 0.02;
    let configuration = Measurer::named("48/linear/star", N).unwrap();
    let mut configuration = configuration.configuration().clone();
    let Method::Linear(linear) = &mut configuration.method else {
        panic!("a linear configuration");
    };
    linear.shape.sheared_step = step;
    let measurer = Measurer::new(&configuration, N).unwrap();
    // Of e1, e2 (before calibration), S/N, flux and size.
    type Cut = fn([f64; 5]) -> bool;
    let cuts: [(&str, Cut); 3] = [
        ("size", |[.., size]| size > 2.4),
        ("S/N", |[_, _, snr, ..]| snr > 8.0),
        ("modulus of the ellipticity", |[e1, e2, ..]| {
            e1.hypot(e2) < 0.17
        }),
    ];
    let mut sums = [[VersionSums::default(); BATCHES]; 3];
    let (mut difference, mut scatter) = (0.0, 0.0);
    let flagged = measure_pairs(&measurer, |batch, sign, galaxy| {
        let versions = galaxy.sheared.expect("the configuration requests them");
        let own = versions.values(0);
        difference += (own[0] - galaxy.e1).powi(2);
        scatter += galaxy.e1.powi(2);
        for ((_, cut), sums) in cuts.iter().zip(&mut sums) {
            let sums = &mut sums[batch];
            for component in 0..2 {
                let add = |to: &mut [f64; 2], values: [f64; 5], is: bool| {
                    if is {
                        to[0] += values[component];
                        to[1] += 1.0;
                    }
                };
                add(&mut sums.plain[usize::from(sign < 0.0)], own, cut(own));
                for side in 0..2 {
                    let values = versions.values(1 + 2 * component + side);
                    add(&mut sums.sheared[side], values, cut(values));
                    add(&mut sums.alike[side], values, cut(own));
                }
            }
        }
    });

    assert!(flagged < BATCHES * PAIRS * 8 / 100, "{flagged}");
    // The noise that is added is a small share.
    assert!((1e-4..0.06).contains(&(difference / scatter)));
    for ((name, _), sums) in cuts.iter().zip(sums) {
        let both = sums.map(|sums| sums.bias(step));
        let [(with, error), (without, _)] = [0, 1].map(|k| mean_of(both.map(|both| both[k])));
        println!("{name}: {with:+.4} ± {error:.4}, without {without:+.4}");
        // A shear of 0.05 and steps of 0.02 add up to 3·10⁻³ of second order.
        // The number of galaxies at an edge scatters.
        assert!(error < 0.04, "{error}");
        assert!(with.abs() < 3.0 * error + 3e-3, "{name}: {with} ± {error}");
        assert!(without.abs() > 0.02, "{name}: {without}");
    }
}

#[test]
fn saturation_limits_the_measured_ellipticity() {
    let of = |configuration: &Configuration| {
        let measurer = Measurer::new(configuration, N).unwrap();
        let mut worker = measurer.worker();
        let mut image = worker.image(ImageNoise::Level(1.0));
        let psf = gaussian(48, PSF);
        let mut worker = image.psf(psf.view()).expect("a PSF of the planned size");
        let found = measured(&mut worker, &(galaxy(6.0, [0.8, 0.3], 0.0) * 1e5));
        [found.e1, found.e2]
    };
    let own = |name: &str, saturation: &str| {
        let text = format!("extends = \"{name}\"\n[shape]\n{saturation}\n");
        of(&text.parse().unwrap())
    };
    for (name, without, with, limit) in [
        ("48/linear/star", "", "saturation = 0.25", 0.25),
        ("48/linear/survey", "saturation = 0.0", "", 0.5),
    ] {
        let (plain, saturated) = (own(name, without), own(name, with));
        let factor = (1.0 + (plain[0].hypot(plain[1]) / limit).powi(2)).sqrt();
        assert!(factor > 1.2, "{name}: {plain:?}");
        for (plain, saturated) in plain.into_iter().zip(saturated) {
            let expected = plain / factor;
            assert!(
                (saturated - expected).abs() < 1e-5,
                "{name}: {saturated} {expected}"
            );
        }
    }
}

#[test]
fn steps_have_the_documented_half_widths() {
    let mut values = [0.0; 41];
    // Flux, size and error of the flux, and the light of the ring.
    values[..3].copy_from_slice(&[30.0, 2.5, 2.0]);
    let ring = Observables::COLUMNS.iter().position(|name| *name == "ring");
    values[ring.unwrap()] = 9.0;
    let galaxy = Observables::from_array(&values);
    for (quantity, value, half_width) in [
        (Quantity::Snr, 15.0, 1.5),
        (Quantity::Flux, 30.0, 3.0),
        (Quantity::Size, 2.5, 0.3),
        (Quantity::Neighbour, 0.3, 0.15),
    ] {
        let cut = |distance: f64| Cut::new(quantity, true, value - distance, None).unwrap();
        let weight = |distance: f64| {
            let selection = Selection::default().with_cut(cut(distance));
            let selected = selection.apply([0.1, 0.0], [[1.0, 0.0], [0.0, 1.0]], &galaxy);
            selected.weight
        };
        assert!(weight(0.9 * half_width) < 1.0, "{quantity:?}");
        assert_eq!(weight(1.1 * half_width), 1.0, "{quantity:?}");
        let least = cut(0.0).least_half_width(2.0) / half_width;
        assert!((least - 0.01).abs() < 1e-12, "{quantity:?} {least}");
    }
}
