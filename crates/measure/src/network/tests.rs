//! The network against the matrices of the paper, in double precision and without short cuts.

use ndarray::{Array1, Array2, ArrayView2, arr2};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// The n²×n² matrix of the convolution of an n×n image with `kernel` under a zero boundary: a block
/// Toeplitz matrix of Toeplitz blocks (Sect. 2.1, Fig. 1).
fn toeplitz(n: usize, kernel: ArrayView2<'_, f64>) -> Array2<f64> {
    let (cy, cx) = (kernel.nrows() / 2, kernel.ncols() / 2);
    let mut matrix = Array2::zeros((n * n, n * n));
    for (y, x) in (0..n * n).map(|at| (at / n, at % n)) {
        for ((j, i), &value) in kernel.indexed_iter() {
            // (Hv)[y, x] takes v[y − (j − c), x − (i − c)].
            let (sy, sx) = ((y + cy).wrapping_sub(j), (x + cx).wrapping_sub(i));
            if sy < n && sx < n {
                matrix[(y * n + x, sy * n + sx)] = value;
            }
        }
    }
    matrix
}

struct Matrices {
    h: Array2<f64>,
    /// W + λG (Eq. 8).
    weights: Array2<f64>,
    /// TH_i (Eq. 11).
    thresholds: Array1<f64>,
}

impl Matrices {
    fn new(n: usize, psf: ArrayView2<'_, f64>, lambda: f64) -> Self {
        let h = toeplitz(n, psf);
        let mut weights = h.t().dot(&h);
        if lambda != 0.0 {
            let d = toeplitz(n, arr2(&SUN_KERNEL).view());
            weights.scaled_add(lambda, &d.t().dot(&d));
        }
        let thresholds = weights.diag().mapv(|w| 0.5 * w.abs());
        Matrices {
            h,
            weights,
            thresholds,
        }
    }

    fn deconvolve(&self, rule: &Rule, u0: &Array2<f64>) -> (Array1<f64>, Descent) {
        let u0: Array1<f64> = u0.iter().copied().collect();
        let q = self.h.t().dot(&u0);
        // Eq. 7.
        let energy_of = |v: &Array1<f64>| 0.5 * v.dot(&self.weights.dot(v)) - q.dot(v);
        let mut v = match rule.start {
            Start::Data => u0.clone(),
            Start::ClippedData => u0.mapv(|u| u.max(0.0)),
            Start::Flat => Array1::from_elem(u0.len(), u0.mean().unwrap().max(0.0)),
            Start::Zero => Array1::zeros(u0.len()),
        };
        let first_energy = energy_of(&v);
        let mut descent = Descent {
            iterations: 0,
            stop: Stop::MaxIterations,
            first_energy,
            energy: first_energy,
            updated: 0,
        };
        // With momentum: the update of the iteration before, and Nesterov's t.
        let mut last = v.clone();
        let mut momentum: f64 = 1.0;
        for _ in 0..rule.max_iterations {
            // Eq. 13.
            let f = &q - &self.weights.dot(&v);
            let mut moved = v.clone();
            descent.updated = 0;
            for i in 0..v.len() {
                let threshold = self.thresholds[i] * rule.unit;
                let change = match rule.step {
                    Step::Adaptive(c) | Step::Accelerated(c) => c * f[i].abs(),
                    Step::Constant(delta) => delta,
                };
                // Eq. 6.
                if f[i] < -threshold {
                    moved[i] -= change;
                    descent.updated += 1;
                } else if f[i] > threshold {
                    moved[i] += change;
                    descent.updated += 1;
                }
                // Eq. 14.
                if rule.clipping == Clipping::BeforeTest {
                    moved[i] = moved[i].max(0.0);
                }
            }
            if descent.updated == 0 {
                descent.stop = Stop::Stable;
                break;
            }
            let mut next = moved.clone();
            let mut beta: f64 = 0.0;
            if let Step::Accelerated(_) = rule.step {
                let on = &moved - &last;
                if (&v - &moved).dot(&on) > 0.0 {
                    momentum = 1.0;
                }
                let grown = 0.5 * (1.0 + (1.0 + 4.0 * momentum * momentum).sqrt());
                beta = (momentum - 1.0) / grown;
                momentum = grown;
                next = &moved + &(on * beta);
                if rule.clipping == Clipping::BeforeTest {
                    next.mapv_inplace(|v| v.max(0.0));
                }
            }
            let mut energy = energy_of(&next);
            if beta > 0.0 && (energy.is_nan() || energy >= descent.energy) {
                momentum = 1.0;
                next = moved.clone();
                energy = energy_of(&next);
            }
            if energy.is_nan() || energy >= descent.energy {
                descent.stop = Stop::EnergyRise;
                if rule.kept == Kept::Last {
                    v = next;
                    descent.energy = energy;
                    descent.iterations += 1;
                }
                break;
            }
            if rule.clipping == Clipping::AfterTest {
                next.mapv_inplace(|v| v.max(0.0));
                energy = energy_of(&next);
            }
            v = next;
            last = moved;
            descent.energy = energy;
            descent.iterations += 1;
        }
        (v, descent)
    }
}

fn random(rng: &mut ChaCha8Rng, n: usize) -> Array2<f64> {
    Array2::from_shape_fn((n, n), |_| rng.random_range(-1.0..1.0))
}

/// A lopsided PSF of sum one: an asymmetric blob and noise, so that a turned or transposed
/// operator shows.
fn psf(rng: &mut ChaCha8Rng, p: usize) -> Array2<f64> {
    let centre = p as f64 / 2.0;
    let blob = Array2::from_shape_fn((p, p), |(y, x)| {
        let (dy, dx) = (y as f64 - centre, x as f64 - centre + 0.7);
        (-(dx * dx + 0.6 * dy * dy + 0.5 * dx * dy) / 4.0).exp()
    });
    let psf = blob + random(rng, p).mapv(|v| 0.01 * v.abs());
    let sum = psf.sum();
    psf / sum
}

/// A galaxy-like stamp with noise of σ = 1.
fn stamp(rng: &mut ChaCha8Rng, n: usize) -> Array2<f64> {
    let centre = (n as f64 - 1.0) / 2.0 + 0.3;
    random(rng, n) * 1.7
        + Array2::from_shape_fn((n, n), |(y, x)| {
            let (dy, dx) = (y as f64 - centre, x as f64 - centre);
            6.0 * (-(dx * dx + dy * dy - 0.6 * dx * dy) / 12.0).exp()
        })
}

fn single(image: &Array2<f64>) -> Vec<f32> {
    image.iter().map(|&v| v as f32).collect()
}

/// The rule of the paper.
fn rule(step: Step, unit: f64, max_iterations: usize) -> Rule {
    Rule {
        step,
        unit,
        max_iterations,
        start: Start::ClippedData,
        clipping: Clipping::BeforeTest,
        kept: Kept::Lowest,
    }
}

fn network(n: usize, psf: &Array2<f64>, lambda: f64) -> Network {
    let mut network = Network::plan(n, psf.nrows(), lambda).unwrap();
    network.set_psf(psf.view(), PsfScale::Sum).unwrap();
    network
}

/// Deconvolves with buffers in which other data, and none, have left their traces.
fn run(network: &Network, rule: &Rule, u0: &Array2<f64>) -> (Vec<f32>, Descent) {
    let (mut scratch, data) = (network.scratch(), single(u0));
    let mut out = vec![0.0; data.len()];
    let missing = vec![f32::NAN; data.len()];
    let unclipped = Rule {
        start: Start::Data,
        ..*rule
    };
    let dirt: Vec<f32> = data.iter().rev().map(|v| 9.0 * v).collect();
    for (rule, u0) in [(&unclipped, &missing), (rule, &dirt)] {
        network
            .deconvolve(rule, u0, &mut scratch, &mut out)
            .unwrap();
    }
    let descent = network.deconvolve(rule, &data, &mut scratch, &mut out);
    (out, descent.unwrap())
}

#[test]
fn states_are_those_of_the_matrices() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let sides = [3, 4, 5, 7, 14, 16, 23, 33, 48];
    let sizes = sides.into_iter().zip([2, 48, 4, 25, 6, 15, 25, 21, 15]);
    let mut stops = Vec::new();
    for (k, (n, p)) in sizes.enumerate() {
        let psf = psf(&mut rng, p);
        let u0 = stamp(&mut rng, n);
        let lambdas: &[f64] = if n > 30 { &[0.3] } else { &[0.0, 1e-4, 1.0] };
        for &lambda in lambdas {
            let matrices = Matrices::new(n, psf.view(), lambda);
            let network = network(n, &psf, lambda);
            for (j, (step, unit)) in [
                (Step::Adaptive(0.9), 0.03),
                (Step::Adaptive(0.05), 0.03),
                (Step::Constant(0.03), 0.03),
                (Step::Accelerated(0.8), 0.03),
                // Without thresholds, no decision depends on rounding.
                (Step::Adaptive(0.9), 1e-30),
                (Step::Accelerated(0.8), 1e-30),
                (Step::Constant(0.4), 0.03),
                (Step::Adaptive(3.0), 0.03),
                (Step::Accelerated(0.8), 0.03),
                (Step::Accelerated(3.0), 0.03),
                // No gradient reaches its threshold.
                (Step::Adaptive(0.5), 1e6),
            ]
            .into_iter()
            .enumerate()
            {
                // The first four are the paper's; all readings come with each of the others.
                let clipping = match (j < 4, (j + k) % 3) {
                    (true, _) | (_, 0) => Clipping::BeforeTest,
                    (_, 1) => Clipping::AfterTest,
                    _ => Clipping::Never,
                };
                let rule = Rule {
                    start: [Start::ClippedData, Start::Flat, Start::Zero, Start::Data][k % 4],
                    clipping,
                    kept: [Kept::Lowest, Kept::Last][usize::from(j >= 4) * (k % 2)],
                    ..rule(step, unit, 12)
                };
                let (expected, reference) = matrices.deconvolve(&rule, &u0);
                let (found, descent) = run(&network, &rule, &u0);
                let label = format!("n {n}, p {p}, λ {lambda}, {rule:?}");
                assert_eq!(descent.iterations, reference.iterations, "{label}");
                assert_eq!(descent.stop, reference.stop, "{label}");
                stops.push(descent.stop);
                // A neuron within rounding of its threshold may be updated or not, and moves by its threshold then, or by
                // a constant step.
                let flipped = descent.updated.abs_diff(reference.updated);
                assert!(flipped as usize <= n * n / 300, "{label}: {flipped}");
                let scale = expected.fold(1.0f64, |most, v| most.max(v.abs()));
                let apart = found.iter().zip(&expected);
                let apart = apart.map(|(a, b)| (f64::from(*a) - b).abs() / scale);
                let beyond = apart.filter(|apart| *apart > 3e-6).count();
                // f32 resolves 6·10⁻⁸; sums of a few hundred terms, through twelve iterations.
                let most = if unit < 1e-9 { 0 } else { n * n / 100 };
                assert!(beyond <= most, "{label}: {beyond}");
                let size = reference.energy.abs().max(1.0);
                assert!(
                    (descent.energy - reference.energy).abs() < 1e-5 * size,
                    "{label}"
                );
                assert!((descent.first_energy - reference.first_energy).abs() < 1e-5 * size);
            }
        }
    }
    for stop in [Stop::Stable, Stop::EnergyRise, Stop::MaxIterations] {
        assert!(stops.contains(&stop), "{stop:?}");
    }
}

#[test]
fn a_trace_shows_every_iteration_of_the_same_run() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let network = network(15, &psf(&mut rng, 7), 0.0);
    let u0 = single(&stamp(&mut rng, 15));
    let mut scratch = network.scratch();
    for (step, unit, clipping, kept) in [
        (0.5, 0.01, Clipping::BeforeTest, Kept::Lowest),
        (0.5, 1.0, Clipping::BeforeTest, Kept::Lowest),
        (50.0, 0.01, Clipping::BeforeTest, Kept::Lowest),
        (50.0, 0.01, Clipping::BeforeTest, Kept::Last),
        (0.5, 0.01, Clipping::AfterTest, Kept::Last),
        (2.6, 0.01, Clipping::Never, Kept::Last),
    ] {
        let rule = Rule {
            clipping,
            kept,
            ..rule(Step::Adaptive(step), unit, 30)
        };
        let (mut whole, mut traced) = (vec![0.0; 225], vec![0.0; 225]);
        let expected = network.deconvolve(&rule, &u0, &mut scratch, &mut whole);
        let expected = expected.unwrap();
        let mut shown = 0;
        let found = network.trace(&rule, &u0, &mut scratch, &mut traced, |before, after| {
            shown += 1;
            assert_ne!(before, after);
        });
        assert_eq!(found.unwrap(), expected);
        assert_eq!(whole, traced);
        let left = expected.stop == Stop::EnergyRise && kept == Kept::Lowest;
        assert_eq!(shown, expected.iterations + u32::from(left));
    }
}

#[test]
fn momentum_is_nesterovs() {
    // Without a PSF each pixel goes from zero to its light u by itself: an update leaves (1 − c) of the distance, and momentum goes on by
    // β of the last change, with β = (t − 1)/t⁺ and t⁺ = ½(1 + √(1 + 4t²)) from t = 1 (Nesterov 1983).
    let betas = [0.0, 0.281_754, 0.434_043, 0.531_063, 0.598_779];
    let c = 0.05;
    let mut delta = Array2::zeros((3, 3));
    delta[(1, 1)] = 1.0;
    let network = network(8, &delta, 0.0);
    let light = Array2::from_shape_fn((8, 8), |(y, x)| 1.0 + y as f64 + 0.1 * x as f64);
    let (mut from, mut last) = (0.0, 0.0);
    for (k, beta) in betas.into_iter().enumerate() {
        let moved = from + c * (1.0 - from);
        from = moved + beta * (moved - last);
        last = moved;
        let rule = Rule {
            start: Start::Zero,
            ..rule(Step::Accelerated(c), 1e-30, k + 1)
        };
        let (found, _) = run(&network, &rule, &light);
        for (found, light) in found.iter().zip(&light) {
            // f32, and β to six digits.
            assert!(
                (f64::from(*found) / light - from).abs() < 1e-5,
                "{k}: {found}"
            );
        }
    }
}

#[test]
fn a_psf_of_peak_one_is_a_larger_unit_and_step() {
    // H/p: with states p times as large, thresholds 1/p² and c p² give the same run.
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let psf = psf(&mut rng, 7);
    let u0 = stamp(&mut rng, 15);
    let mut network = Network::plan(15, 7, 0.0).unwrap();
    let factor = network.set_psf(psf.view(), PsfScale::Peak).unwrap();
    let peak = psf.iter().copied().fold(0.0, f64::max);
    assert!((factor * peak - 1.0).abs() < 1e-15);
    let from_zero = |step, unit| Rule {
        start: Start::Zero,
        ..rule(Step::Adaptive(step), unit, 9)
    };
    let (scaled, a) = run(&network, &from_zero(0.8 * peak * peak, 0.1 * peak), &u0);
    assert_eq!(network.set_psf(psf.view(), PsfScale::Sum).unwrap(), 1.0);
    let (plain, b) = run(&network, &from_zero(0.8, 0.1), &u0);
    assert_eq!(
        (a.iterations, a.stop, a.updated),
        (b.iterations, b.stop, b.updated)
    );
    let most = plain.iter().copied().fold(0.0, f32::max);
    for (a, b) in scaled.iter().zip(&plain) {
        assert!((a * factor as f32 - b).abs() < 3e-6 * most);
    }
    let dark = Array2::zeros((7, 7));
    assert!(network.set_psf(dark.view(), PsfScale::Peak).is_err());
}

#[test]
fn unusable_psfs_are_refused() {
    let mut network = Network::plan(15, 5, 0.0).unwrap();
    let mut psf = Array2::from_elem((5, 5), 0.04);
    psf[(1, 2)] = f64::NAN;
    for scale in [PsfScale::Sum, PsfScale::Peak] {
        let other = Array2::from_elem((5, 7), 0.04);
        assert!(network.set_psf(other.view(), scale).is_err());
        let message = network.set_psf(psf.view(), scale).unwrap_err().to_string();
        assert!(message.contains("(3, 2)"), "{message}");
    }
    assert!(Network::plan(2, 5, 0.0).is_err());
    assert!(Network::plan(15, 49, 0.0).is_err());
}

#[test]
fn wrong_sizes_are_refused_with_what_was_expected() {
    let plan = |n, p| Network::plan(n, p, 0.0).unwrap();
    let network = plan(15, 5);
    let run = |pixels: usize, room: usize, of: &Network| {
        let (u0, mut out) = (vec![1.0; pixels], vec![0.0; room]);
        let rule = rule(Step::Adaptive(0.5), 1.0, 1);
        let run = network.deconvolve(&rule, &u0, &mut of.scratch(), &mut out);
        run.map_err(|error| error.to_string())
    };
    assert!(run(225, 225, &network).is_ok());
    let expected = Err("a stamp of 224 values; expected 225".to_owned());
    assert_eq!(run(224, 225, &network), expected);
    assert!(run(225, 226, &network).is_err());
    assert!(run(225, 225, &plan(23, 5)).unwrap_err().contains("23 × 23"));
    assert!(run(225, 225, &plan(15, 7)).unwrap_err().contains("7 × 7"));
}

#[test]
fn the_limit_of_settings_is_the_largest_square_of_d() {
    let waves = || (0..=64).map(|k| std::f64::consts::PI * f64::from(k) / 64.0);
    let squares = waves().flat_map(|kx| waves().map(move |ky| high_pass(kx, ky).powi(2)));
    let largest = squares.fold(0.0, f64::max);
    let limit = shearq_submissions::limits::MAX_ROUGHNESS;
    assert!(largest <= limit && limit < 1.01 * largest, "{largest}");
}
