//! Bins, powers, fits and errors against direct evaluation of their definitions.

use std::f64::consts::PI;

use ndarray::Array2;
use shearq_scoring::modes::Decomposer;
use shearq_scoring::quality::{bias_fits, quality, quality_error};
use shearq_scoring::resample::{PairedDifference, PairedSet, mean_over_sets, paired_difference};
use shearq_scoring::{
    BINS, Bins, Choice, Complex64, Convention, Definition, FieldSum, Grid, Noise, Options, Row,
    SCORED, SetImages, SetScorer, TrueShear, measured_bandpowers,
};

use crate::common::{Content, Normal, close, field, rows, sum_of, truth};

/// One mode: its place in FFT order, |ℓ|, and whether it is on a Nyquist row.
struct Mode {
    at: (usize, usize),
    l: f64,
    nyquist: bool,
}

/// All modes but the zero mode, in the order in which the original visits them.
fn modes(n: usize) -> Vec<Mode> {
    let frequency = |i: usize| i as i64 - (n / 2) as i64;
    let mut all = Vec::new();
    for i in 0..n {
        for j in 0..n {
            let (fx, fy) = (frequency(i), frequency(j));
            if (fx, fy) != (0, 0) {
                let fft = |f: i64| f.rem_euclid(n as i64) as usize;
                let wave = |f: i64| 36.0 * f as f64 + 1e-10;
                all.push(Mode {
                    at: (fft(fx), fft(fy)),
                    l: wave(fx).hypot(wave(fy)),
                    nyquist: n.is_multiple_of(2) && (i == 0 || j == 0),
                });
            }
        }
    }
    all
}

/// The modes of each bin by the two definitions.
fn binned(n: usize, definition: Definition) -> Vec<Vec<Mode>> {
    let width = 36.0 * (n as f64 - 1.0) / 19.0;
    let mut bins: Vec<Vec<Mode>> = (0..BINS).map(|_| Vec::new()).collect();
    for mode in modes(n) {
        let bin = match definition {
            Definition::Leaderboard if mode.l < 36.0 || mode.l > 36.0 * n as f64 => continue,
            Definition::Leaderboard => ((mode.l + 1.0 - 36.0) / width).round(),
            Definition::Corrected if mode.nyquist => continue,
            Definition::Corrected => ((mode.l - 36.0) / width).round(),
        };
        bins[bin as usize].push(mode);
    }
    bins
}

#[test]
fn bins_and_powers_agree_with_their_definitions() {
    for (n, seed) in [(24, 1), (25, 2), (40, 3)] {
        let grid = Grid::great10(n).unwrap();
        let side = 10.0 * PI / 180.0;
        let width = 36.0 * (n as f64 - 1.0) / 19.0;
        let decomposer = Decomposer::new(grid);
        let a = decomposer
            .decompose(field(&grid, Content::Mixed, seed))
            .unwrap()
            .e;
        let b = decomposer
            .decompose(field(&grid, Content::Mixed, seed + 50))
            .unwrap()
            .b;
        for definition in [Definition::Leaderboard, Definition::Corrected] {
            let bins = Bins::new(&grid, definition);
            let (power, white) = (bins.power(&a, &b).unwrap(), bins.white_noise(0.09));
            close(bins.width, width, "width");
            let all = binned(n, definition);
            // The multipole that stands for a bin.
            let l: Vec<f64> = all
                .iter()
                .map(|modes| match definition {
                    Definition::Leaderboard => modes.last().map_or(0.0, |mode| mode.l),
                    Definition::Corrected if modes.is_empty() => 0.0,
                    Definition::Corrected => {
                        modes.iter().map(|m| m.l).sum::<f64>() / modes.len() as f64
                    }
                })
                .collect();
            for (k, modes) in all.iter().enumerate() {
                let what = |name: &str| format!("{name} of bin {k}, n {n}, {definition:?}");
                let sum = |f: &dyn Fn(&Mode) -> f64| modes.iter().map(f).sum::<f64>();
                let cross = |m: &Mode| (a[m.at] * b[m.at].conj()).re / (n as f64).powi(4);
                let count = modes.len() as f64;
                assert_eq!(bins.modes[k], modes.len(), "{}", what("modes"));
                close(bins.sum_l[k], sum(&|m| m.l), &what("sum of l"));
                close(bins.mode_weight(k), sum(&|m| m.l) / width, &what("weight"));
                close(bins.l[k], l[k], &what("multipole"));
                if modes.is_empty() {
                    assert_eq!((power[k], white[k], bins.to_c_l(k)), (0.0, 0.0, 0.0));
                    continue;
                }
                // A mode of noise has the variance per cell over the cells.
                let mode_power = 0.09 / (n * n) as f64;
                match definition {
                    Definition::Leaderboard => {
                        close(power[k], sum(&|m| m.l * cross(m)) / width, &what("power"));
                        close(white[k], sum(&|m| m.l) / width * mode_power, &what("noise"));
                        let c_l = side * side / (sum(&|m| m.l) / width);
                        close(bins.to_c_l(k), c_l, &what("to C_l"));
                        if k + 1 < BINS && l[k + 1] > 0.0 {
                            close(bins.dln_l[k], (l[k + 1] / l[k]).ln(), &what("dln l"));
                        } else {
                            assert_eq!(bins.dln_l[k], 0.0);
                        }
                    }
                    Definition::Corrected => {
                        let unit = side * side / (2.0 * PI);
                        let mean = |f: &dyn Fn(&Mode) -> f64| sum(f) / count;
                        close(
                            power[k],
                            unit * mean(&|m| m.l * m.l * cross(m)),
                            &what("power"),
                        );
                        let square = mean(&|m| m.l * m.l);
                        close(white[k], unit * square * mode_power, &what("noise"));
                        // Noise of 0.09 per cell has C_l = 0.09 times the cell's solid angle.
                        close(
                            white[k] * bins.to_c_l(k),
                            0.09 * side * side / (n * n) as f64,
                            &what("C_l"),
                        );
                        let edge = |k: f64| (36.0 + k * width).max(36.0);
                        let (low, high) = (edge(k as f64 - 0.5), edge(k as f64 + 0.5));
                        close(bins.dln_l[k], (high / low).ln(), &what("dln l"));
                    }
                }
            }
        }
    }
}

#[test]
fn q_and_its_error_agree_with_their_definitions() {
    let grid = Grid::great10(32).unwrap();
    let bins = Bins::new(&grid, Definition::Leaderboard);
    let power = |seed: u64, amplitude: f64| -> [f64; BINS] {
        let mut normal = Normal(seed);
        std::array::from_fn(|b| amplitude * (b as f64 + 2.0 + normal.uniform()))
    };
    let (measured, truth) = (power(1, 3e-5), power(2, 2e-5));
    let found = quality(&bins, &measured, &truth);
    let sigma: f64 = SCORED
        .map(|b| (measured[b] - truth[b]).abs() * bins.dln_l[b])
        .sum();
    close(found.sigma_sys, sigma, "sigma_sys");
    close(found.q, 0.005 / sigma, "Q");
    // Its error where all deviations have one sign, and where one has the other.
    let mut covariance = [[0.0; BINS]; BINS];
    for b in SCORED {
        covariance[b][b] = (b as f64 * 1e-6).powi(2);
    }
    covariance[2][5] = 4e-12;
    covariance[5][2] = 4e-12;
    let mut mixed = measured;
    mixed[5] = truth[5] - 1e-5;
    for (measured, sign) in [(&measured, 1.0), (&mixed, -1.0)] {
        let variance = SCORED
            .map(|b| covariance[b][b] * bins.dln_l[b].powi(2))
            .sum::<f64>()
            + sign * 2.0 * 4e-12 * bins.dln_l[2] * bins.dln_l[5];
        let own = quality(&bins, measured, &truth);
        let expected = own.q * variance.sqrt() / own.sigma_sys;
        close(
            quality_error(&bins, measured, &truth, &covariance),
            expected,
            "error of Q",
        );
    }
}

#[test]
fn spectra_are_scored_with_the_errors_of_their_covariance() {
    let grid = Grid::great10(32).unwrap();
    let shear = field(&grid, Content::E, 3);
    let scorer = SetScorer::new(grid, truth(&shear), Options::default()).unwrap();
    let (bins, true_power) = (scorer.bins(), scorer.true_bandpowers());
    let powers: Vec<f64> = SCORED
        .map(|b| true_power[b] * (1.3 + 0.02 * b as f64))
        .collect();
    let mut covariance = [[0.0; 8]; 8];
    for (i, row) in covariance.iter_mut().enumerate() {
        for (j, value) in row.iter_mut().enumerate() {
            let shared = if i == j { 1.0 } else { 0.2 };
            *value = shared * 1e-4 * powers[i] * powers[j];
        }
    }
    let found = scorer.score_spectrum(&powers, Some(&covariance)).unwrap();
    let mut measured = [0.0; BINS];
    measured[SCORED].copy_from_slice(&powers);
    close(
        found.metrics.q,
        quality(bins, &measured, &true_power).q,
        "Q",
    );
    let fit = |measured: &[f64; BINS]| bias_fits(bins, grid.side().0, measured, &true_power).cl;
    close(found.metrics.m_half, fit(&measured).M / 2.0, "M/2");
    close(found.metrics.sqrt_a, fit(&measured).sqrtA * 1e4, "sqrt A");
    // M, A and (all deviations being positive) σ_sys are linear: their gradients by differences of 1.
    let gradient = |of: &dyn Fn(&[f64; BINS]) -> f64| -> Vec<f64> {
        let step = |b: usize| {
            let mut moved = measured;
            moved[b] += 1.0;
            of(&moved) - of(&measured)
        };
        SCORED.map(step).collect()
    };
    let error = |gradient: &[f64]| {
        let pairs = (0..8).flat_map(|i| (0..8).map(move |j| (i, j)));
        let variance: f64 = pairs
            .map(|(i, j)| gradient[i] * covariance[i][j] * gradient[j])
            .sum();
        variance.sqrt()
    };
    let (of_m, of_a) = (gradient(&|p| fit(p).M), gradient(&|p| fit(p).A));
    let near = |found: f64, expected: f64| {
        assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
    };
    near(found.errors.m_half, error(&of_m) / 2.0);
    let a = fit(&measured).A;
    if a.abs() >= 2.0 * error(&of_a) {
        near(
            found.errors.sqrt_a,
            error(&of_a) / (2.0 * a.abs().sqrt()) * 1e4,
        );
    } else {
        assert!(found.errors.sqrt_a.is_nan());
    }
    let of_sigma = gradient(&|p| quality(bins, p, &true_power).sigma_sys);
    near(
        found.errors.q,
        found.metrics.q * error(&of_sigma) / (1e-4 * found.metrics.sigma_sys_1e4),
    );
    let unknown = scorer.score_spectrum(&powers, None).unwrap();
    assert!(unknown.errors.q.is_nan() && unknown.errors.m_half.is_nan());
    assert!(scorer.score_spectrum(&powers[1..], None).is_err());
}

#[test]
fn biases_of_galaxies_are_least_squares() {
    let grid = Grid::great10(12).unwrap();
    let shear = field(&grid, Content::E, 4);
    let mut images = SetImages::new(&grid);
    let mut normal = Normal(8);
    // (g, e) of all galaxies, of which some are missing.
    let mut pairs: [Vec<(f64, f64)>; 2] = [Vec::new(), Vec::new()];
    for image in 0..3 {
        let mut kept = Vec::new();
        for (k, row) in rows(&grid, &shear).into_iter().enumerate() {
            let (e1, e2) = (
                1.1 * row.e1 + 0.003 + 0.01 * normal.draw(),
                0.9 * row.e2 - 0.002 + 0.01 * normal.draw(),
            );
            if (k + image) % 5 != 0 {
                pairs[0].push((row.e1, e1));
                pairs[1].push((row.e2, e2));
                kept.push(Row { e1, e2, ..row });
            }
        }
        images.add(&sum_of(&grid, &kept).0).unwrap();
    }
    let options = Options {
        choice: Choice::Insist(Convention::STANDARD),
        noise: Noise::Given(1e-4),
        ..Options::default()
    };
    let scorer = SetScorer::new(grid, truth(&shear), options).unwrap();
    let score = scorer.score(&images).unwrap();
    let f = score.metrics;
    for (pairs, m, c) in [(&pairs[0], f.m1, f.c1), (&pairs[1], f.m2, f.c2)] {
        let count = pairs.len() as f64;
        let mean = |of: &dyn Fn(&(f64, f64)) -> f64| pairs.iter().map(of).sum::<f64>() / count;
        let (g, e) = (mean(&|p| p.0), mean(&|p| p.1));
        let response = mean(&|p| (p.0 - g) * (p.1 - e)) / mean(&|p| (p.0 - g).powi(2));
        assert!((m - (response - 1.0)).abs() < 1e-12, "{m} {response}");
        assert!((c - (e - response * g)).abs() < 1e-14, "{c}");
    }
    close(score.noise_variance.unwrap(), 1e-4, "noise as given");
    // The submission's spectrum, without truth.
    let (bins, power) = measured_bandpowers(&grid, images.total(), Convention::STANDARD).unwrap();
    assert_eq!(bins.definition, Definition::Leaderboard);
    for b in SCORED {
        close(power[b], score.spectra().ee[b], "bandpower");
    }
    assert!(measured_bandpowers(&grid, &FieldSum::new(&grid), Convention::STANDARD).is_err());
    // Null tests are means over the scored bins.
    let mean = |p: &[f64; BINS]| SCORED.map(|b| p[b] * bins.to_c_l(b)).sum::<f64>() / 8.0 * 1e9;
    close(f.b_power, mean(&score.spectra().bb), "B");
    close(f.eb_power, mean(&score.spectra().eb), "EB");
    close(f.sigma_sys_1e4 * f.q, 5e-3 * 1e4, "σ_sys");
    // Half of the power read with the other sign of g2 is B.
    assert!(score.true_b_share() < 1e-12);
    let flipped = TrueShear {
        g2: -truth(&shear).g2,
        ..truth(&shear)
    };
    let flipped = SetScorer::new(grid, flipped, options)
        .unwrap()
        .score(&images)
        .unwrap();
    assert!((0.2..0.8).contains(&flipped.true_b_share()));
}

#[test]
fn means_and_paired_differences_of_sets() {
    let (mean, error) = mean_over_sets(&[(1.0, 0.3), (5.0, 0.4)]);
    close(mean, 3.0, "mean");
    close(error, 0.25, "error");
    assert!(mean_over_sets(&[(1.0, 0.3), (5.0, f64::NAN)]).1.is_nan());
    let set = |first, second, a, b| PairedSet {
        images: 8,
        first,
        first_replicates: a,
        second,
        second_replicates: b,
    };
    // Eight groups of one image, Tukey's formula.
    let a = [1.0, 2.0, 1.5, 1.2, 0.7, 1.9, 1.4, 1.1];
    let b = [1.5, 3.1, 1.7, 1.9, 0.9, 2.0, 2.2, 1.6];
    let sets = [set(1.5, 2.3, &a[..], &b[..]), set(2.0, 1.6, &b[..], &a[..])];
    let found = paired_difference(&sets).unwrap();
    close(found.difference, (0.8 - 0.4) / 2.0, "difference");
    let apart: Vec<f64> = a.iter().zip(b).map(|(a, b)| b - a).collect();
    let mean = apart.iter().sum::<f64>() / 8.0;
    let squares: f64 = apart.iter().map(|d| (d - mean).powi(2)).sum();
    let one = (7.0 / 8.0 * squares).sqrt();
    close(found.error, (2.0 * one * one).sqrt() / 2.0, "error");
    let few = PairedSet {
        images: 7,
        ..set(1.5, 2.3, &a[..7], &b[..7])
    };
    let few = paired_difference(&[few]).unwrap();
    assert!(few.difference > 0.79 && few.error.is_nan());
    close(
        PairedDifference {
            difference: 3.0,
            error: 1.5,
        }
        .sigma(),
        2.0,
        "sigma",
    );
    assert!(paired_difference(&[]).is_none());
    assert!(paired_difference(&[set(1.0, 2.0, &a[..], &b[..1])]).is_none());
}

/// Plain DFT of a real field on an n × n grid.
fn transform(field: &Array2<f64>) -> Array2<Complex64> {
    let n = field.nrows();
    Array2::from_shape_fn((n, n), |(k1, k2)| {
        let phase = |(x, y): (usize, usize)| -2.0 * PI * ((k1 * x + k2 * y) % n) as f64 / n as f64;
        field
            .indexed_iter()
            .map(|(at, value)| Complex64::from_polar(1.0, phase(at)) * value)
            .sum()
    })
}

/// Mean powers of E and B modes in rings of |ℓ| as wide as the bins: of every mode, then of the four lowest
/// rings' E modes.
fn rings(n: usize, e: &Array2<Complex64>, b: &Array2<Complex64>) -> (Array2<(f64, f64)>, f64) {
    let width = 36.0 * (n as f64 - 1.0) / 19.0;
    let ring = |mode: &Mode| ((mode.l - 36.0) / width).round().max(0.0) as usize;
    let all = modes(n);
    let mut of_mode = Array2::from_elem((n, n), (f64::NAN, f64::NAN));
    for mode in &all {
        let same: Vec<&Mode> = all.iter().filter(|m| ring(m) == ring(mode)).collect();
        let mean = |field: &Array2<Complex64>| {
            same.iter().map(|m| field[m.at].norm_sqr()).sum::<f64>() / same.len() as f64
        };
        of_mode[mode.at] = (mean(e), mean(b));
    }
    let lowest: Vec<f64> = all
        .iter()
        .filter(|m| ring(m) < 4)
        .map(|m| e[m.at].norm_sqr())
        .collect();
    let mean = lowest.iter().sum::<f64>() / lowest.len() as f64;
    of_mode[(0, 0)] = (mean, mean);
    (of_mode, mean)
}

#[test]
fn errors_agree_with_their_formulae() {
    let n = 14;
    let grid = Grid::great10(n).unwrap();
    let shear = field(&grid, Content::E, 6);
    let (g1, g2) = (shear.mapv(|g| g.re), shear.mapv(|g| g.im));
    let decomposer = Decomposer::new(grid);
    let mut images = SetImages::new(&grid);
    let mut normal = Normal(3);
    for image in 0..4 {
        let shapes = field(&grid, Content::B, 40 + image);
        let mut kept = Vec::new();
        for (k, row) in rows(&grid, &shear).into_iter().enumerate() {
            let shape = shapes[(k / n, k % n)];
            if k % 11 != 3 {
                kept.push(Row {
                    e1: 1.05 * row.e1 + shape.re + 0.003 * normal.draw(),
                    e2: 1.05 * row.e2 + shape.im + 0.003 * normal.draw() + 0.001,
                    ..row
                });
            }
        }
        images.add(&sum_of(&grid, &kept).0).unwrap();
    }
    let total = images.total();
    for definition in [Definition::Leaderboard, Definition::Corrected] {
        for noise in [Noise::Measured, Noise::Given(1e-5)] {
            let options = Options {
                definition,
                noise,
                choice: Choice::Insist(Convention::STANDARD),
            };
            let score = SetScorer::new(grid, truth(&shear), options)
                .unwrap()
                .score(&images)
                .unwrap();
            let (f, errors) = (score.metrics, score.errors);
            // The averaged field and the truth, through the same gaps in the corrected definition.
            let weight = match definition {
                Definition::Leaderboard => Array2::from_elem((n, n), 1.0),
                Definition::Corrected => &total.count / 4.0,
            };
            let scale = match definition {
                Definition::Leaderboard => 1.0,
                Definition::Corrected => weight.mapv(|w| w * w).mean().unwrap().sqrt().recip(),
            };
            let complex = |a: &Array2<f64>, b: &Array2<f64>| {
                Array2::from_shape_fn((n, n), |at| Complex64::new(a[at], b[at]))
            };
            let field = complex(&(&total.e1 * (scale / 4.0)), &(&total.e2 * (scale / 4.0)));
            let found = decomposer.decompose(field).unwrap();
            let t = decomposer
                .decompose(complex(&(&g1 * &weight * scale), &(&g2 * &weight * scale)))
                .unwrap()
                .e;
            let signal = t.mapv(|t| t * (1.0 + f.m_cross));
            let (nu, _) = rings(n, &(&found.e - &signal), &found.b);
            let bins = binned(n, definition);
            let w = |bin: usize, mode: &Mode| match definition {
                Definition::Leaderboard => {
                    mode.l / (36.0 * (n as f64 - 1.0) / 19.0) / (n as f64).powi(4)
                }
                Definition::Corrected => {
                    let side = 10.0 * PI / 180.0;
                    (mode.l * side).powi(2)
                        / (2.0 * PI * bins[bin].len() as f64 * (n as f64).powi(4))
                }
            };
            let scored = |of: &dyn Fn(usize, &Mode) -> f64| -> Vec<f64> {
                SCORED
                    .map(|b| bins[b].iter().map(|mode| of(b, mode)).sum())
                    .collect()
            };
            let own = |factor: f64| {
                scored(&|b, m| {
                    let (nu, s) = (nu[m.at].0, signal[m.at].norm_sqr());
                    2.0 * w(b, m).powi(2) * (2.0 * s * nu + factor * nu * nu)
                })
            };
            let variance = own(1.0);
            // m by cross-correlation.
            let power: f64 = scored(&|_, m| t[m.at].norm_sqr()).iter().sum();
            let cross: f64 = scored(&|_, m| t[m.at].norm_sqr() * nu[m.at].0).iter().sum();
            close(errors.m_cross, cross.sqrt() / power, "m cross");
            // Linear in bandpowers.
            let to_c_l: Vec<f64> = SCORED.map(|b| score.bins.to_c_l(b)).collect();
            let mean_c_l = |variance: Vec<f64>| {
                let sum: f64 = variance.iter().zip(&to_c_l).map(|(v, c)| v * c * c).sum();
                sum.sqrt() / 8.0 * 1e9
            };
            let bb = scored(&|b, m| 2.0 * (w(b, m) * nu[m.at].1).powi(2));
            close(errors.b_power, mean_c_l(bb), "B");
            let eb = scored(&|b, m| {
                let (e, b_power) = nu[m.at];
                w(b, m).powi(2) * b_power * (signal[m.at].norm_sqr() + e)
            });
            close(errors.eb_power, mean_c_l(eb), "EB");
            let x: Vec<f64> = SCORED
                .map(|b| score.bins.power(&t, &t).unwrap()[b] * score.bins.to_c_l(b))
                .collect();
            let mean = x.iter().sum::<f64>() / 8.0;
            let sxx: f64 = x.iter().map(|x| (x - mean).powi(2)).sum();
            let (mut m, mut a) = (0.0, 0.0);
            for (k, x) in x.iter().enumerate() {
                let c_l = variance[k] * to_c_l[k] * to_c_l[k];
                m += ((x - mean) / sxx).powi(2) * c_l;
                a += (1.0 / 8.0 - mean * (x - mean) / sxx).powi(2) * c_l;
            }
            close(errors.m_half, m.sqrt() / 2.0, "M/2");
            let fit = score.spectra().fit.cl;
            match fit.A.abs() >= 2.0 * a.sqrt() {
                true => close(
                    errors.sqrt_a,
                    a.sqrt() / (2.0 * fit.A.abs().sqrt()) * 1e4,
                    "A",
                ),
                false => assert!(errors.sqrt_a.is_nan()),
            }
            // Q: a sum of moduli, whose scatter is found by drawing.
            let true_power = score.bins.power(&t, &t).unwrap();
            let folded = |apart: f64, variance: f64| {
                let (centre, spread) =
                    ((apart * apart - variance).max(0.0).sqrt(), variance.sqrt());
                // Moments of |centre + spread·z| by sums over z.
                let (mut first, mut second, mut norm) = (0.0, 0.0, 0.0);
                for step in -4000..4000 {
                    let z = (f64::from(step) + 0.5) * 2e-3;
                    let density = (-z * z / 2.0).exp();
                    let value = (centre + spread * z).abs();
                    first += density * value;
                    second += density * value * value;
                    norm += density;
                }
                second / norm - (first / norm).powi(2)
            };
            let of_q = |q: f64, measured: &dyn Fn(usize) -> f64, variance: &[f64]| {
                let (mut sigma, mut total) = (0.0, 0.0);
                for (k, b) in SCORED.enumerate() {
                    let apart = measured(b) - true_power[b];
                    sigma += apart.abs() * score.bins.dln_l[b];
                    total += folded(apart, variance[k]) * score.bins.dln_l[b].powi(2);
                }
                let relative = total.sqrt() / sigma;
                q * relative / (1.0 + relative * relative)
            };
            let near = |found: f64, expected: f64, what: &str| {
                // The sums over z.
                assert!(
                    (found / expected - 1.0).abs() < 1e-4,
                    "{what}: {found} {expected}"
                );
            };
            let ee = score.spectra().ee;
            near(errors.q, of_q(f.q, &|b| ee[b], &variance), "Q");
            // The same with the response divided out, which moves all bandpowers together.
            let r = 1.0 + f.m_cross;
            assert!(r > 3.0 * errors.m_cross, "a response that is known");
            let of_bin =
                |b: usize, of: &dyn Fn(&Mode) -> f64| -> f64 { bins[b].iter().map(of).sum() };
            let apart = |b: usize| ee[b] / r.powi(2) - true_power[b];
            let covariance = |b: usize, c: usize| {
                let g = |b: usize| 2.0 * ee[b] / r.powi(3);
                let k = |b: usize| {
                    of_bin(b, &|mode| {
                        2.0 * w(b, mode) * t[mode.at].norm_sqr() * nu[mode.at].0 / (r * power)
                    })
                };
                let own = of_bin(b, &|mode| {
                    let (nu, t2) = (nu[mode.at].0, t[mode.at].norm_sqr());
                    2.0 * w(b, mode).powi(2) * (2.0 * t2 * nu / r.powi(2) + nu * nu / r.powi(4))
                });
                f64::from(b == c) * own + g(b) * g(c) * cross / power.powi(2)
                    - g(b) * k(c)
                    - g(c) * k(b)
            };
            // How the mean of a modulus follows that of its number.
            let follows = |b: usize| {
                let (x, own) = (apart(b), covariance(b, b));
                let mean = (x * x - own).max(0.0).sqrt();
                x.signum() * libm::erf(mean / (2.0 * own).sqrt())
            };
            let (mut sigma, mut variance) = (0.0, 0.0);
            for b in SCORED {
                sigma += apart(b).abs() * score.bins.dln_l[b];
                for c in SCORED {
                    let lengths = score.bins.dln_l[b] * score.bins.dln_l[c];
                    variance += lengths
                        * match b == c {
                            true => folded(apart(b), covariance(b, b)),
                            false => follows(b) * follows(c) * covariance(b, c),
                        };
                }
            }
            let relative = variance.sqrt() / sigma;
            let expected = f.q_calibrated * relative / (1.0 + relative * relative);
            near(errors.q_calibrated, expected, "Q calibrated");
            let relative = errors.sigma_sys_1e4 / f.sigma_sys_1e4;
            let damped = relative / (1.0 + relative * relative);
            close(errors.q, f.q * damped, "σ_sys");
            let noise_power = score.noise.unwrap();
            let groups = match noise {
                Noise::Measured => 4.0 / 3.0,
                Noise::Given(_) => 1.0,
            };
            let clean = |b: usize| ee[b] - noise_power[b];
            near(errors.q_dn, of_q(f.q_dn, &clean, &own(groups)), "Q_dn");
        }
    }
    // m and c of the galaxies: sums over cells of the residuals.
    let options = Options {
        choice: Choice::Insist(Convention::STANDARD),
        ..Options::default()
    };
    let score = SetScorer::new(grid, truth(&shear), options)
        .unwrap()
        .score(&images)
        .unwrap();
    let (f, errors) = (score.metrics, score.errors);
    let residual = |e: &Array2<f64>, g: &Array2<f64>, m: f64, c: f64| {
        e - &(g.mapv(|g| (1.0 + m) * g + c) * &total.count)
    };
    let (r1, r2) = (
        residual(&total.e1, &g1, f.m1, f.c1),
        residual(&total.e2, &g2, f.m2, f.c2),
    );
    let left = decomposer
        .decompose(Array2::from_shape_fn((n, n), |at| {
            Complex64::new(r1[at], r2[at])
        }))
        .unwrap();
    let (nu, _) = rings(n, &left.e, &left.b);
    let galaxies = total.count.sum();
    for (component, g, m, c) in [
        (0, &g1, errors.m1, errors.c1),
        (1, &g2, errors.m2, errors.c2),
    ] {
        let mean = (g * &total.count).sum() / galaxies;
        let apart = g - mean;
        let square = (&apart * &apart * &total.count).sum();
        let error = |u: Array2<f64>| {
            let modes = transform(&u);
            let sum: f64 = modes
                .indexed_iter()
                .map(|(at, u)| {
                    let f = |k: usize| {
                        if 2 * k >= n {
                            k as f64 - n as f64
                        } else {
                            k as f64
                        }
                    };
                    let phi = f(at.1).atan2(f(at.0));
                    let (cos2, sin2) = ((2.0 * phi).cos().powi(2), (2.0 * phi).sin().powi(2));
                    let (of_e, of_b) = if component == 0 {
                        (cos2, sin2)
                    } else {
                        (sin2, cos2)
                    };
                    u.norm_sqr() * (of_e * nu[at].0 + of_b * nu[at].1)
                })
                .sum();
            sum.sqrt() / (n * n) as f64
        };
        let near = |found: f64, expected: f64| {
            // Waves are 10⁻¹⁰ off the modes' centres in the scorer.
            assert!(
                (found / expected - 1.0).abs() < 1e-9,
                "{component}: {found} {expected}"
            );
        };
        near(m, error(&apart / square));
        let of_c = error(apart.mapv(|a| 1.0 / galaxies - mean * a / square));
        let each: Vec<f64> = score
            .replicates
            .iter()
            .map(|r| if component == 0 { r.c1 } else { r.c2 })
            .collect();
        let centre = each.iter().sum::<f64>() / 4.0;
        let jackknife = (0.75 * each.iter().map(|c| (c - centre).powi(2)).sum::<f64>()).sqrt();
        near(c, of_c.max(jackknife));
    }
}
