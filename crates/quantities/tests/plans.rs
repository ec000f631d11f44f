//! Signs and scales of the plans, against sums. The tests use the crate as others do: in its own test build, all
//! transforms would be compiled again.

use shearq_quantities::fourier::{Complex64, Planner64};

/// Σ_j exp(sign · 2πi jk/n) x_j.
fn slow(values: &[Complex64], sign: f64) -> Vec<Complex64> {
    let n = values.len();
    let turn = |j: usize, k: usize| sign * std::f64::consts::TAU * ((j * k) % n) as f64 / n as f64;
    (0..n)
        .map(|k| (0..n).map(|j| values[j] * Complex64::cis(turn(j, k))).sum())
        .collect()
}

#[test]
fn plans_have_the_stated_sign_and_scale() {
    for n in [1, 2, 3, 8, 15, 20, 48] {
        let given: Vec<Complex64> = (0..n)
            .map(|j| Complex64::new((j * j % 7) as f64 - 3.0, (j % 5) as f64))
            .collect();
        let mut planner = Planner64::new();
        for (plan, sign) in [(planner.forward(n), -1.0), (planner.inverse(n), 1.0)] {
            let mut found = given.clone();
            plan.process(&mut found);
            for (a, b) in found.iter().zip(slow(&given, sign)) {
                // Rounding of sums of n numbers below 8, with a margin of ten.
                let tolerance = 10.0 * 8.0 * n as f64 * f64::EPSILON;
                assert!((a - b).norm() < tolerance, "{n} {sign}");
            }
        }
    }
}
