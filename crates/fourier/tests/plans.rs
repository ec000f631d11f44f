//! Signs and scales of the plans, against sums. The tests use the crate as others do: in its own test build, all
//! transforms would be compiled again.

use shearq_fourier::{Complex32, Complex64, Planner32, Planner64};

/// Σ_j exp(sign · 2πi jk/n) x_j.
fn slow(values: &[Complex64], sign: f64) -> Vec<Complex64> {
    let n = values.len();
    let turn = |j: usize, k: usize| sign * std::f64::consts::TAU * ((j * k) % n) as f64 / n as f64;
    (0..n)
        .map(|k| (0..n).map(|j| values[j] * Complex64::cis(turn(j, k))).sum())
        .collect()
}

fn values(n: usize) -> Vec<Complex64> {
    (0..n)
        .map(|j| Complex64::new((j * j % 7) as f64 - 3.0, (j % 5) as f64))
        .collect()
}

/// Rounding of sums of `n` numbers below 8 in units of `epsilon`, with a margin of ten.
fn tolerance(n: usize, epsilon: f64) -> f64 {
    10.0 * 8.0 * n as f64 * epsilon
}

#[test]
fn complex_plans_have_the_stated_sign_and_scale() {
    for n in [1, 2, 3, 8, 15, 20, 48] {
        let given = values(n);
        let mut planner = Planner64::new();
        for (plan, sign) in [(planner.forward(n), -1.0), (planner.inverse(n), 1.0)] {
            let mut found = given.clone();
            plan.process(&mut found);
            for (a, b) in found.iter().zip(slow(&given, sign)) {
                assert!((a - b).norm() < tolerance(n, f64::EPSILON), "{n} {sign}");
            }
        }
        let mut planner = Planner32::new();
        for (plan, sign) in [(planner.forward(n), -1.0), (planner.inverse(n), 1.0)] {
            let mut found: Vec<Complex32> = given
                .iter()
                .map(|v| Complex32::new(v.re as f32, v.im as f32))
                .collect();
            plan.process(&mut found);
            for (a, b) in found.iter().zip(slow(&given, sign)) {
                let apart = Complex64::new(f64::from(a.re), f64::from(a.im)) - b;
                assert!(
                    apart.norm() < tolerance(n, f64::from(f32::EPSILON)),
                    "{n} {sign}"
                );
            }
        }
    }
}

#[test]
fn real_plans_are_halves_of_the_complex_ones() {
    for n in [2, 6, 15, 48] {
        let real: Vec<f32> = (0..n).map(|j| (j * 3 % 11) as f32 - 5.0).collect();
        let whole: Vec<Complex64> = real
            .iter()
            .map(|&v| Complex64::from(f64::from(v)))
            .collect();
        let mut planner = Planner32::new();
        let mut half = vec![Complex32::ZERO; n / 2 + 1];
        planner
            .real_forward(n)
            .process(&mut real.clone(), &mut half)
            .unwrap();
        for (a, b) in half.iter().zip(slow(&whole, -1.0)) {
            let apart = Complex64::new(f64::from(a.re), f64::from(a.im)) - b;
            assert!(apart.norm() < tolerance(n, f64::from(f32::EPSILON)), "{n}");
        }
        let mut back = vec![0.0; n];
        planner
            .real_inverse(n)
            .process(&mut half, &mut back)
            .unwrap();
        for (a, b) in back.iter().zip(&real) {
            let apart = (a / n as f32 - b).abs();
            assert!(
                f64::from(apart) < tolerance(n, f64::from(f32::EPSILON)),
                "{n}"
            );
        }
    }
}
