//! The working network: planned once per stamp and PSF size, run per galaxy.

use ndarray::ArrayView2;
use shearq_submissions::{Kept, PsfScale, Start};

use super::descent::{Descent, Stop};
use super::kernel::{Buffers, Wide};
use super::operator::Operator;
use super::rule::Rule;
use crate::error::{MeasureError, length};
use crate::pixel::check_psf;

/// A network for one stamp size, PSF size and λ, holding one PSF at a time.
///
/// Running it needs a [`NetworkScratch`] of the caller and allocates nothing. The network itself is
/// not changed by a run, so one can serve many threads.
#[derive(Debug, Clone)]
pub struct Network<T> {
    operator: Operator<T>,
}

/// Buffers for one thread's runs. Their content between runs does not matter.
#[derive(Debug, Clone)]
pub struct NetworkScratch<T> {
    n: usize,
    p: usize,
    buffers: Buffers<T>,
}

impl<T: Wide> Network<T> {
    /// Plans for n×n stamps and p×p PSFs; the PSF is zero until [`Network::set_psf`].
    ///
    /// # Errors
    /// If a size is out of range.
    pub fn plan(n: usize, p: usize, lambda: f64) -> Result<Self, MeasureError> {
        Ok(Network {
            operator: Operator::new(n, p, lambda)?,
        })
    }

    /// Takes a PSF; it is used as it is, so it should sum to one.
    ///
    /// # Errors
    /// If its size is not the planned one or a pixel is not finite.
    pub fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), MeasureError> {
        check_psf(psf, self.operator.p)?;
        T::set_psf(&mut self.operator, psf, 1.0);
        Ok(())
    }

    /// Takes a PSF of sum one, scaled. Returns the factor on it, which is also that from the network's
    /// states to the light of the galaxy.
    ///
    /// # Errors
    /// As [`Network::set_psf`], and if no pixel is positive.
    pub fn set_scaled_psf(
        &mut self,
        psf: ArrayView2<'_, f64>,
        scale: PsfScale,
    ) -> Result<f64, MeasureError> {
        let factor = psf_factor(psf, scale)?;
        check_psf(psf, self.operator.p)?;
        T::set_psf(&mut self.operator, psf, factor);
        Ok(factor)
    }

    /// Stamp side n.
    pub fn stamp_size(&self) -> usize {
        self.operator.n
    }

    /// Thresholds TH_i (Eq. 9) for a unit of brightness of one, row-major.
    pub fn thresholds(&self) -> &[T] {
        let Operator { n, thresholds, .. } = &self.operator;
        &thresholds[..n * n]
    }

    /// Buffers that fit this network.
    pub fn scratch(&self) -> NetworkScratch<T> {
        let Operator { n, p, .. } = self.operator;
        NetworkScratch {
            n,
            p,
            buffers: Buffers::new(&self.operator),
        }
    }

    /// Deconvolves the row-major n×n stamp `u0` into `out`.
    ///
    /// # Errors
    /// If `u0` or `out` does not have n² pixels, or the scratch is of another network's sizes.
    pub fn deconvolve(
        &self,
        rule: &Rule,
        u0: &[T],
        scratch: &mut NetworkScratch<T>,
        out: &mut [T],
    ) -> Result<Descent, MeasureError> {
        self.check(u0, scratch, out)?;
        let n = self.operator.n;
        let b = &mut scratch.buffers;
        Self::start(n, rule, u0, b);
        let descent = T::descend(&self.operator, rule, b);
        out.copy_from_slice(&b.state[..n * n]);
        Ok(descent)
    }

    /// Like [`Network::deconvolve`], one iteration at a time, showing `observe` the state before and
    /// after each, row-major. The last one shown may be an update that raised the energy and is not
    /// kept. For studies: it allocates, repeats part of the work, and an accelerated update loses its
    /// momentum in each.
    ///
    /// # Errors
    /// As [`Network::deconvolve`].
    pub fn trace(
        &self,
        rule: &Rule,
        u0: &[T],
        scratch: &mut NetworkScratch<T>,
        out: &mut [T],
        mut observe: impl FnMut(&[T], &[T]),
    ) -> Result<Descent, MeasureError> {
        self.check(u0, scratch, out)?;
        let n = self.operator.n;
        let b = &mut scratch.buffers;
        Self::start(n, rule, u0, b);
        let one = Rule {
            max_iterations: 1,
            ..*rule
        };
        let image = |padded: &[T]| padded[..n * n].to_vec();
        let none = Rule {
            max_iterations: 0,
            ..*rule
        };
        let mut total = Descent {
            iterations: 0,
            ..T::descend(&self.operator, &none, b)
        };
        for _ in 0..rule.max_iterations {
            let before = image(&b.state);
            let descent = T::descend(&self.operator, &one, b);
            match descent.stop {
                Stop::Stable => {}
                Stop::EnergyRise if rule.kept == Kept::Lowest => observe(&before, &image(&b.next)),
                Stop::EnergyRise | Stop::MaxIterations => observe(&before, &image(&b.state)),
            }
            total = Descent {
                iterations: total.iterations + descent.iterations,
                first_energy: total.first_energy,
                ..descent
            };
            if descent.stop != Stop::MaxIterations {
                break;
            }
        }
        out.copy_from_slice(&b.state[..n * n]);
        Ok(total)
    }

    /// Checks the sizes of a run.
    fn check(&self, u0: &[T], scratch: &NetworkScratch<T>, out: &[T]) -> Result<(), MeasureError> {
        let Operator { n, p, .. } = self.operator;
        length("a stamp", u0.len(), n * n)?;
        length("a deconvolved stamp", out.len(), n * n)?;
        if (scratch.n, scratch.p) == (n, p) {
            return Ok(());
        }
        Err(MeasureError::Shape {
            what: "buffers for a network",
            found: format!(
                "{0} × {0} pixels and a PSF of {1} × {1}",
                scratch.n, scratch.p
            ),
            expected: format!("{n} × {n} and {p} × {p}"),
        })
    }

    /// Takes the stamp and sets the first state.
    fn start(n: usize, rule: &Rule, u0: &[T], b: &mut Buffers<T>) {
        let flat = match rule.start {
            Start::Flat => {
                let mean = u0.iter().map(|u| u.to_f64()).sum::<f64>() / (n * n) as f64;
                T::from_f64(mean.max(0.0))
            }
            Start::Data | Start::ClippedData | Start::Zero => T::ZERO,
        };
        b.data[..n * n].copy_from_slice(u0);
        let state = &mut b.state[..n * n];
        match rule.start {
            Start::Data => state.copy_from_slice(u0),
            Start::ClippedData => {
                for (v, &u) in state.iter_mut().zip(u0) {
                    *v = if u > T::ZERO { u } else { T::ZERO };
                }
            }
            Start::Flat | Start::Zero => state.fill(flat),
        }
    }
}

/// The factor that gives a PSF of sum one the scale `scale`.
///
/// # Errors
/// If no pixel is positive.
pub fn psf_factor(psf: ArrayView2<'_, f64>, scale: PsfScale) -> Result<f64, MeasureError> {
    match scale {
        PsfScale::Sum => Ok(1.0),
        PsfScale::Peak => {
            let peak = psf.iter().copied().fold(0.0, f64::max);
            if peak > 0.0 {
                Ok(1.0 / peak)
            } else {
                Err(MeasureError::DarkPsf(psf.sum()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, ArrayView2};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::{Clipping, Start};

    use super::*;
    use crate::deconvolve::reference::Matrices;
    use crate::deconvolve::rule::Step;
    use shearq_quantities::product::{ROWS, fuses};

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

    struct Case {
        n: usize,
        p: usize,
        lambda: f64,
        rule: Rule,
    }

    fn run<T: Wide>(
        case: &Case,
        psf: ArrayView2<'_, f64>,
        u0: &Array2<f64>,
    ) -> (Vec<f64>, Descent) {
        let mut network = Network::<T>::plan(case.n, case.p, case.lambda).unwrap();
        network.set_psf(psf).unwrap();
        let mut scratch = network.scratch();
        let mut out = vec![T::ZERO; case.n * case.n];
        let data: Vec<T> = u0.iter().map(|&v| T::from_f64(v)).collect();
        // First runs on other data, and on none, leave their traces in the scratch.
        let missing = vec![T::from_f64(f64::NAN); data.len()];
        let rule = Rule {
            start: Start::Data,
            ..case.rule
        };
        network
            .deconvolve(&rule, &missing, &mut scratch, &mut out)
            .unwrap();
        let dirt: Vec<T> = data
            .iter()
            .rev()
            .map(|v| T::from_f64(9.0 * v.to_f64()))
            .collect();
        network
            .deconvolve(&case.rule, &dirt, &mut scratch, &mut out)
            .unwrap();
        let descent = network
            .deconvolve(&case.rule, &data, &mut scratch, &mut out)
            .unwrap();
        (out.iter().map(|v| v.to_f64()).collect(), descent)
    }

    fn largest(a: &[f64], b: &Array2<f64>) -> f64 {
        a.iter()
            .zip(b)
            .map(|(x, y)| (x - y).abs())
            .fold(0.0, f64::max)
    }

    #[test]
    fn matches_the_matrices_over_sizes_updates_and_regularisation() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let sizes = [
            (3, 2),
            (4, 48),
            (5, 3),
            (5, 4),
            (5, 15),
            (7, 25),
            (11, 5),
            (14, 6),
            (16, 15),
            (17, 16),
            (19, 15),
            (23, 15),
            (23, 25),
            (29, 15),
            (32, 8),
            (33, 21),
            (48, 15),
            (48, 25),
        ];
        for (k, (n, p)) in sizes.into_iter().enumerate() {
            let psf = psf(&mut rng, p);
            let u0 = stamp(&mut rng, n);
            let lambdas = if n > 30 {
                vec![0.3]
            } else {
                vec![0.0, 1e-4, 1.0]
            };
            for lambda in lambdas {
                let matrices = Matrices::new(n, psf.view(), lambda);
                for (j, step) in [
                    Step::Adaptive(0.9),
                    Step::Adaptive(0.05),
                    Step::Constant(0.03),
                    Step::Accelerated(0.8),
                    Step::Adaptive(0.9),
                    Step::Constant(0.4),
                    Step::Adaptive(3.0),
                    Step::Accelerated(0.8),
                    Step::Accelerated(3.0),
                ]
                .into_iter()
                .enumerate()
                {
                    let start = [Start::ClippedData, Start::Flat, Start::Zero, Start::Data][k % 4];
                    // The first four are the paper's; all readings come with each of the others.
                    let clipping = match (j < 4, (j + k) % 3) {
                        (true, _) | (_, 0) => Clipping::BeforeTest,
                        (_, 1) => Clipping::AfterTest,
                        _ => Clipping::Never,
                    };
                    let kept = [Kept::Lowest, Kept::Last][usize::from(j >= 4) * (k % 2)];
                    let rule = Rule {
                        step,
                        unit: 0.03,
                        max_iterations: 12,
                        start,
                        clipping,
                        kept,
                    };
                    let case = Case { n, p, lambda, rule };
                    let (expected, reference) = matrices.deconvolve(&rule, u0.view()).unwrap();
                    let (found, descent) = run::<f64>(&case, psf.view(), &u0);
                    let label = format!("n {n}, p {p}, λ {lambda}, {rule:?}");
                    assert_eq!(descent.iterations, reference.iterations, "{label}");
                    assert_eq!(descent.stop, reference.stop, "{label}");
                    assert_eq!(descent.updated, reference.updated, "{label}");
                    // Same operations in another order: f64 rounding of sums of 10³ terms of
                    // order ten, carried through twelve steps.
                    assert!(largest(&found, &expected) < 1e-11, "{label}");
                    let scale = reference.energy.abs().max(1.0);
                    assert!(
                        (descent.energy - reference.energy).abs() < 1e-10 * scale,
                        "{label}"
                    );
                    assert!((descent.first_energy - reference.first_energy).abs() < 1e-10 * scale);
                }
            }
        }
    }

    #[test]
    fn thresholds_are_half_the_diagonal_of_the_weights() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for (n, p) in [(5, 9), (12, 4), (13, 7)] {
            let psf = psf(&mut rng, p);
            let matrices = Matrices::new(n, psf.view(), 0.7);
            let mut network = Network::<f64>::plan(n, p, 0.7).unwrap();
            network.set_psf(psf.view()).unwrap();
            for (a, b) in network.thresholds().iter().zip(matrices.thresholds()) {
                assert!((a - b).abs() < 1e-14);
            }
        }
    }

    #[test]
    fn single_precision_stays_within_its_rounding() {
        // Without thresholds (a vanishing unit) no decision can flip, and the difference is the
        // rounding of f32 (6e-8) over sums of a few hundred terms of order ten, times the steps.
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (n, p) in [(19, 15), (23, 15), (29, 15), (48, 25)] {
            let psf = psf(&mut rng, p);
            let u0 = stamp(&mut rng, n);
            let rule = Rule {
                step: Step::Adaptive(0.9),
                unit: 1e-30,
                max_iterations: 20,
                start: Start::ClippedData,
                clipping: Clipping::BeforeTest,
                kept: Kept::Lowest,
            };
            let case = Case {
                n,
                p,
                lambda: 1e-4,
                rule,
            };
            let (double, a) = run::<f64>(&case, psf.view(), &u0);
            let (single, b) = run::<f32>(&case, psf.view(), &u0);
            assert_eq!((a.iterations, a.stop), (b.iterations, b.stop));
            let peak = double.iter().copied().fold(0.0, f64::max);
            let mut apart = double.iter().zip(&single).map(|(x, y)| (x - y).abs());
            let most = 3e-6 * peak;
            assert!(apart.all(|d| d < most), "n {n}: beyond {most}");
        }
    }

    #[test]
    fn every_stop_occurs_and_is_reported() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let psf = psf(&mut rng, 7);
        let u0 = stamp(&mut rng, 15);
        let descent = |step, unit, max_iterations| {
            let rule = Rule {
                step,
                unit,
                max_iterations,
                start: Start::ClippedData,
                clipping: Clipping::BeforeTest,
                kept: Kept::Lowest,
            };
            run::<f32>(
                &Case {
                    n: 15,
                    p: 7,
                    lambda: 0.0,
                    rule,
                },
                psf.view(),
                &u0,
            )
            .1
        };
        let all = descent(Step::Adaptive(0.5), 0.01, 5);
        assert_eq!((all.stop, all.iterations), (Stop::MaxIterations, 5));
        assert!(all.energy < all.first_energy);
        // A unit so large that no gradient reaches its threshold.
        let stable = descent(Step::Adaptive(0.5), 1e6, 50);
        assert_eq!(
            (stable.stop, stable.iterations, stable.updated),
            (Stop::Stable, 0, 0)
        );
        // A step beyond the stability limit of 2 over the largest eigenvalue.
        let rise = descent(Step::Adaptive(50.0), 0.01, 50);
        assert_eq!(rise.stop, Stop::EnergyRise);
        assert!(rise.energy <= rise.first_energy);
    }

    #[test]
    fn fused_and_unfused_products_agree_and_the_number_of_rows_at_a_time_does_not_matter() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for (n, p) in [(5, 15), (11, 4), (19, 15), (23, 15), (33, 3), (64, 48)] {
            let psf = psf(&mut rng, p);
            let u0: Vec<f32> = stamp(&mut rng, n).iter().map(|&v| v as f32).collect();
            for (step, lambda) in [
                (Step::Adaptive(0.9), 1e-4),
                (Step::Adaptive(0.5), 0.0),
                (Step::Accelerated(0.9), 1e-4),
                (Step::Constant(0.02), 0.3),
            ] {
                // A vanishing unit: no neuron is near its threshold, where rounding would decide.
                let rule = Rule {
                    step,
                    unit: 1e-30,
                    max_iterations: 10,
                    start: Start::ClippedData,
                    clipping: Clipping::BeforeTest,
                    kept: Kept::Lowest,
                };
                let mut network = Network::<f32>::plan(n, p, lambda).unwrap();
                network.set_psf(psf.view()).unwrap();
                let mut scratch = network.scratch();
                let kernels: [Kernel; 3] =
                    [run_in::<4, false>, run_in::<4, true>, run_in::<ROWS, true>];
                let [plain, four, eight] = kernels.map(|kernel| {
                    let b = &mut scratch.buffers;
                    Network::start(n, &rule, &u0, b);
                    let descent = kernel(&network.operator, &rule, b);
                    (b.state.clone(), descent)
                });
                assert_eq!(four, eight);
                if fuses() {
                    let mut out = vec![f32::NAN; n * n];
                    let found = network.deconvolve(&rule, &u0, &mut scratch, &mut out);
                    assert_eq!((&out[..], found.unwrap()), (&four.0[..n * n], four.1));
                }
                assert_eq!(plain.1.iterations, four.1.iterations);
                // Fused and unfused products differ by f32 rounding; a constant step is taken
                // the other way where that decides on a gradient's sign.
                let apart = |(a, b): &(&f32, &f32)| (*a - *b).abs() > 1e-4;
                let flipped = four.0.iter().zip(&plain.0).filter(apart).count();
                let most = match step {
                    Step::Adaptive(_) | Step::Accelerated(_) => 0,
                    Step::Constant(_) => 1 + n * n / 200,
                };
                let label = format!("n {n}, p {p}, {step:?}, λ {lambda}");
                assert!(flipped <= most, "{label}: {flipped}");
            }
        }
    }

    type Kernel = fn(&Operator<f32>, &Rule, &mut Buffers<f32>) -> Descent;

    fn run_in<const R: usize, const FUSED: bool>(
        operator: &Operator<f32>,
        rule: &Rule,
        b: &mut Buffers<f32>,
    ) -> Descent {
        crate::deconvolve::kernel::run::<f32, R, FUSED>(operator, rule, b)
    }

    #[test]
    fn momentum_reaches_a_lower_energy_in_as_many_iterations() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let psf = psf(&mut rng, 15);
        let u0 = stamp(&mut rng, 23);
        let energy = |step, max_iterations| {
            let rule = Rule {
                step,
                unit: 1e-3,
                max_iterations,
                start: Start::ClippedData,
                clipping: Clipping::BeforeTest,
                kept: Kept::Lowest,
            };
            let case = Case {
                n: 23,
                p: 15,
                lambda: 1e-4,
                rule,
            };
            run::<f64>(&case, psf.view(), &u0).1.energy
        };
        let (plain, fast) = (Step::Adaptive(1.0), Step::Accelerated(1.0));
        assert!(energy(fast, 15) < energy(plain, 40));
        // And both go to the same minimum: where the plain one is after 3000 iterations.
        let (slow, quick) = (energy(plain, 3000), energy(fast, 300));
        assert!((slow - quick).abs() < 1e-3 * slow.abs(), "{slow} {quick}");
    }

    #[test]
    fn a_trace_shows_every_iteration_of_the_same_run() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        let psf = psf(&mut rng, 7);
        let u0: Vec<f64> = stamp(&mut rng, 15).iter().copied().collect();
        let mut network = Network::<f64>::plan(15, 7, 0.0).unwrap();
        network.set_psf(psf.view()).unwrap();
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
                step: Step::Adaptive(step),
                unit,
                max_iterations: 30,
                start: Start::ClippedData,
                clipping,
                kept,
            };
            let (mut whole, mut traced) = (vec![0.0; 225], vec![0.0; 225]);
            let expected = network
                .deconvolve(&rule, &u0, &mut scratch, &mut whole)
                .unwrap();
            let mut shown = 0;
            let found = network
                .trace(&rule, &u0, &mut scratch, &mut traced, |before, after| {
                    shown += 1;
                    assert_ne!(before, after);
                })
                .unwrap();
            assert_eq!(found, expected);
            assert_eq!(whole, traced);
            let left = expected.stop == Stop::EnergyRise && kept == Kept::Lowest;
            let attempted = u32::from(left);
            assert_eq!(shown, expected.iterations + attempted);
        }
    }

    #[test]
    fn a_psf_of_peak_one_is_a_larger_unit_and_step() {
        // H/p: with states p times as large, thresholds 1/p² and c p² give the same run.
        let mut rng = ChaCha8Rng::seed_from_u64(8);
        let psf = psf(&mut rng, 7);
        let u0: Vec<f64> = stamp(&mut rng, 15).iter().copied().collect();
        let mut network = Network::<f64>::plan(15, 7, 0.0).unwrap();
        let factor = network.set_scaled_psf(psf.view(), PsfScale::Peak).unwrap();
        let peak = psf.iter().copied().fold(0.0, f64::max);
        assert!((factor * peak - 1.0).abs() < 1e-15);
        let run = |network: &Network<f64>, step, unit| {
            let rule = Rule {
                step: Step::Adaptive(step),
                unit,
                max_iterations: 9,
                start: Start::Zero,
                clipping: Clipping::BeforeTest,
                kept: Kept::Lowest,
            };
            let mut out = vec![0.0; 225];
            let descent = network
                .deconvolve(&rule, &u0, &mut network.scratch(), &mut out)
                .unwrap();
            (out, descent)
        };
        let (scaled, a) = run(&network, 0.8 * peak * peak, 0.1 * peak);
        let factor_of_sum = network.set_scaled_psf(psf.view(), PsfScale::Sum);
        assert_eq!(factor_of_sum.unwrap(), 1.0);
        let (plain, b) = run(&network, 0.8, 0.1);
        assert_eq!(
            (a.iterations, a.stop, a.updated),
            (b.iterations, b.stop, b.updated)
        );
        for (a, b) in scaled.iter().zip(&plain) {
            assert!((a * factor - b).abs() < 1e-12);
        }
        let dark = Array2::zeros((7, 7));
        assert!(network.set_scaled_psf(dark.view(), PsfScale::Peak).is_err());
    }

    #[test]
    fn unusable_psfs_are_refused() {
        let mut network = Network::<f32>::plan(15, 5, 0.0).unwrap();
        assert!(network.set_psf(Array2::zeros((5, 7)).view()).is_err());
        let mut psf = Array2::from_elem((5, 5), 0.04);
        psf[(1, 2)] = f64::NAN;
        for scale in [PsfScale::Sum, PsfScale::Peak] {
            let other = Array2::from_elem((5, 7), 0.04);
            assert!(network.set_scaled_psf(other.view(), scale).is_err());
            for found in [
                network.set_psf(psf.view()),
                network.set_scaled_psf(psf.view(), scale).map(|_| ()),
            ] {
                let message = found.unwrap_err().to_string();
                assert!(message.contains("(3, 2)"), "{message}");
            }
        }
        assert!(Network::<f32>::plan(2, 5, 0.0).is_err());
        assert!(Network::<f32>::plan(15, 49, 0.0).is_err());
    }

    #[test]
    fn wrong_sizes_are_refused_with_what_was_expected() {
        let network = Network::<f32>::plan(15, 5, 0.0).unwrap();
        let other = Network::<f32>::plan(23, 5, 0.0).unwrap();
        let rule = Rule {
            step: Step::Adaptive(0.5),
            unit: 1.0,
            max_iterations: 1,
            start: Start::Zero,
            clipping: Clipping::BeforeTest,
            kept: Kept::Lowest,
        };
        let run = |pixels: usize, room: usize, of: &Network<f32>| {
            let (u0, mut out) = (vec![1.0; pixels], vec![0.0; room]);
            let run = network.deconvolve(&rule, &u0, &mut of.scratch(), &mut out);
            run.map_err(|error| error.to_string())
        };
        assert!(run(225, 225, &network).is_ok());
        let expected = Err("a stamp of 224 values; expected 225".to_owned());
        assert_eq!(run(224, 225, &network), expected);
        assert!(run(225, 226, &network).is_err());
        assert!(run(225, 225, &other).unwrap_err().contains("23 × 23"));
        let wider = Network::<f32>::plan(15, 7, 0.0).unwrap();
        assert!(run(225, 225, &wider).unwrap_err().contains("7 × 7"));
    }
}
