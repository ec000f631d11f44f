//! Products of small matrices, against sums.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use shearq_quantities::linear::{Matrix, ROWS, multiply, multiply_rows};

/// Whether this processor has fused multiply-adds, so that [`multiply`] has the bits of fused sums.
fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    return is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    return cfg!(target_arch = "aarch64");
}

/// The product as a plain sum, and the sum of moduli.
fn plain(left: Matrix<'_>, right: Matrix<'_>, inner: usize, at: [usize; 2]) -> [f64; 2] {
    let terms = (0..inner).map(|i| {
        let (a, b) = (
            left.values[at[0] * left.stride + i],
            right.values[i * right.stride + at[1]],
        );
        f64::from(a) * f64::from(b)
    });
    terms.fold([0.0; 2], |[sum, size], term| {
        [sum + term, size + term.abs()]
    })
}

#[test]
fn products_are_plain_sums_for_all_sizes_and_strides() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for (rows, inner, width, more) in [
        (8, 1, 16, 0),
        (16, 24, 16, 16),
        (48, 24, 32, 8),
        (8, 0, 16, 1),
        (24, 17, 48, 5),
        (16, 12, 16, 4),
        (8, 16, 32, 0),
        (8, 45, 16, 3),
    ] {
        let mut numbers = |count: usize| -> Vec<f32> {
            (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
        };
        let (a, b) = (
            numbers(rows * (inner + more)),
            numbers(inner * (width + more) + width),
        );
        let left = Matrix::new(&a, inner + more);
        let right = Matrix::new(&b, width + more);
        let mut all = vec![vec![f32::NAN; rows * width]; 4];
        multiply(left, right, inner, &mut all[0], width);
        multiply_rows::<ROWS, true>(left, right, inner, &mut all[1], width);
        multiply_rows::<4, true>(left, right, inner, &mut all[2], width);
        multiply_rows::<4, false>(left, right, inner, &mut all[3], width);
        // The number of rows at a time does not matter.
        assert_eq!(all[1], all[2]);
        if fuses() {
            assert_eq!(all[0], all[1]);
        }
        for (found, at) in all.iter().flat_map(|all| all.iter().zip(0..)) {
            let [sum, size] = plain(left, right, inner, [at / width, at % width]);
            // As many roundings as terms, of half a bit of 24 each.
            let tolerance = (inner as f64 + 1.0) * size * f64::from(f32::EPSILON) / 2.0;
            assert!(
                (f64::from(*found) - sum).abs() <= tolerance,
                "{found} {sum}"
            );
        }
    }
}
