//! The size of a galaxy before the PSF, from its autocorrelation under a round Gaussian weight.
//!
//! With P₀ and P₂ the integrals of the autocorrelation and of it times x² + y² under the weight exp(−(x² + y²)/2τ²),
//!
//! ```text
//! T = (P₂ + s·T₀)/(P₀ + s),
//! ```
//!
//! where s is the P₀ of a galaxy of low S/N and T₀ the T of a typical galaxy: noise alone has a typical size. For a round
//! Gaussian galaxy of standard deviation r per axis, behind a target of σ_Γ and a window of σ_W,
//!
//! ```text
//! 4/T = 2/τ² + 1/(r² + σ_Γ²) + 1/σ_W²,
//! ```
//!
//! by which T becomes r for any galaxy.

use multiversion::multiversion;
use shearq_quantities::product::LANES;

use crate::transform::HexLattice;

/// Scale τ of the weight in units of the window's σ.
// Chosen by hand: wide enough that sizes up to 10 px differ.
const WEIGHT_SCALE: f64 = 0.6;
/// Largest size that is reported, in units of the window's σ.
// Beyond it the window, not the galaxy, sets the size.
const LARGEST_SIZE: f64 = 2.0;
/// Smallest size that is reported, in units of the target's σ.
// Far below the noise of a size, 0.24 px at S/N 20.
const SMALLEST_SIZE: f64 = 0.1;

/// Weights for one window and target.
#[derive(Debug, Clone)]
pub(crate) struct SizeMoments {
    /// Of P₀ and P₂, laid out as `Lags`; of both lags that each place stands for.
    weights: [Vec<f32>; 2],
    target: f64,
    /// 2/τ² + 1/σ_W².
    rest: f64,
    window: f64,
    width: usize,
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct MeanSquare {
    pub(crate) square: f32,
    /// P₀ + s.
    divisor: f32,
}

impl SizeMoments {
    /// For the lags of `lattice`, a target of `target` px and a window of `window` px.
    pub(crate) fn new(target: f64, window: f64, lattice: HexLattice) -> Self {
        let tau = WEIGHT_SCALE * window;
        let mut weights = [Vec::new(), Vec::new()];
        for [x, y] in lattice.places() {
            let square = x * x + y * y;
            let within = f64::from(u8::from(lattice.contains([x, y])));
            let count = within * if y == 0.0 { 1.0 } else { 2.0 };
            let weight = count * lattice.area() * (-0.5 * square / (tau * tau)).exp();
            weights[0].push(weight as f32);
            weights[1].push((weight * square) as f32);
        }
        SizeMoments {
            weights,
            target,
            rest: 2.0 / (tau * tau) + 1.0 / (window * window),
            window,
            width: lattice.width(),
        }
    }

    /// P₀ and P₂ of an autocorrelation or of its change.
    pub(crate) fn sums(&self, lags: &[f32]) -> [f32; 2] {
        let [zero, two] = &self.weights;
        sums(lags, zero, two)
    }

    /// T of an autocorrelation, with `regularisation` and the typical T.
    pub(crate) fn measure(&self, acf: &[f32], regularisation: f32, typical: f32) -> MeanSquare {
        let [zero, two] = self.sums(acf);
        let divisor = zero + regularisation;
        MeanSquare {
            square: (two + regularisation * typical) / divisor,
            divisor,
        }
    }

    /// Change of T with a change of the autocorrelation.
    pub(crate) fn response(&self, found: &MeanSquare, change: &[f32]) -> f32 {
        Self::combine(found, self.sums(change))
    }

    /// Weights of the lags, each for itself, whose sum with a change of the autocorrelation is the change of P₀, or of P₂.
    pub(crate) fn gradients(&self) -> [Vec<f32>; 2] {
        // Rows y > 0 stand for both signs.
        let each = |weights: &[f32]| {
            let rows = weights.chunks_exact(self.width).enumerate();
            rows.flat_map(|(y, row)| row.iter().map(move |w| if y == 0 { *w } else { 0.5 * w }))
                .collect()
        };
        [each(&self.weights[0]), each(&self.weights[1])]
    }

    /// Mean of T″(a, b) over changes a and b, from the mean product of P₀(a) and T′(b), which is the same if a and b are exchanged.
    pub(crate) fn mean_second_derivative(found: &MeanSquare, product: f32) -> f64 {
        f64::from(-2.0 * product / found.divisor)
    }

    /// Gradient of T from those of P₀ and P₂.
    pub(crate) fn combine(found: &MeanSquare, [zero, two]: [f32; 2]) -> f32 {
        (two - found.square * zero) / found.divisor
    }

    /// T of a round Gaussian galaxy of standard deviation `r` px per axis.
    pub(crate) fn square_of(&self, r: f64) -> f64 {
        4.0 / (self.rest + 1.0 / (r * r + self.target * self.target))
    }

    /// The size r in px of a galaxy of this T, with its first and second derivative; both are zero beyond the bounds.
    pub(crate) fn size(&self, square: f64) -> [f64; 3] {
        let (least, most) = (SMALLEST_SIZE * self.target, LARGEST_SIZE * self.window);
        if square.is_nan() || square <= self.square_of(least) {
            return [least, 0.0, 0.0];
        }
        if square >= self.square_of(most) {
            return [most, 0.0, 0.0];
        }
        let compact = 4.0 / square - self.rest;
        let r = (1.0 / compact - self.target * self.target).sqrt();
        // r² = 1/κ − σ_Γ², dκ/dT = −4/T².
        let first = 4.0 / (square * square * compact * compact);
        let second = first * (2.0 * 4.0 / (square * square * compact) - 2.0 / square);
        [
            r,
            first / (2.0 * r),
            (second - first * first / (2.0 * r * r)) / (2.0 * r),
        ]
    }
}

// Sums of products with both weights.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sums(lags: &[f32], zero: &[f32], two: &[f32]) -> [f32; 2] {
    let mut lanes = [[0.0f32; LANES]; 2];
    let chunks = lags.chunks_exact(LANES);
    let at = lags.len() - chunks.remainder().len();
    for ((v, a), b) in chunks
        .zip(zero.chunks_exact(LANES))
        .zip(two.chunks_exact(LANES))
    {
        for l in 0..LANES {
            lanes[0][l] += v[l] * a[l];
            lanes[1][l] += v[l] * b[l];
        }
    }
    let mut sums = lanes.map(|lane| lane.iter().sum::<f32>());
    for k in at..lags.len() {
        sums[0] += lags[k] * zero[k];
        sums[1] += lags[k] * two[k];
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    const LATTICE: HexLattice = HexLattice {
        row_spacing: 4.0 / 3.0,
        reach: 15,
    };
    const TARGET: f64 = 1.5;
    const WINDOW: f64 = 8.0;

    /// Autocorrelation of a windowed round Gaussian galaxy of standard deviation `r` and flux one.
    fn acf(r: f64) -> Vec<f32> {
        let variance = 1.0 / (1.0 / (r * r + TARGET * TARGET) + 1.0 / (WINDOW * WINDOW));
        let lags = LATTICE.places().map(|[x, y]| {
            let square = x * x + y * y;
            (-square / (4.0 * variance)).exp() as f32
        });
        lags.collect()
    }

    #[test]
    fn the_size_of_a_gaussian_is_its_standard_deviation() {
        let moments = SizeMoments::new(TARGET, WINDOW, LATTICE);
        for r in [1.0, 2.0, 3.0, 5.0, 8.0] {
            let found = moments.measure(&acf(r), 0.0, 0.0);
            let [size, first, second] = moments.size(f64::from(found.square));
            // The lags end at 20 px, four standard deviations of the weight.
            assert!((size / r - 1.0).abs() < 0.01, "{r}: {size}");
            assert!((moments.square_of(size) / f64::from(found.square) - 1.0).abs() < 1e-9);
            let step = 1e-4 * f64::from(found.square);
            let side = |by: f64| moments.size(f64::from(found.square) + by)[0];
            let (plus, minus) = (side(step), side(-step));
            // Truncation and rounding of differences of 10⁻⁴.
            assert!(((plus - minus) / (2.0 * step) / first - 1.0).abs() < 1e-5);
            let curved = (plus - 2.0 * size + minus) / (step * step);
            assert!(
                (curved - second).abs() < 1e-3 * (second.abs() + first),
                "{r}"
            );
        }
        assert_eq!(moments.size(0.0), [SMALLEST_SIZE * TARGET, 0.0, 0.0]);
        assert_eq!(moments.size(1e9), [LARGEST_SIZE * WINDOW, 0.0, 0.0]);
        assert_eq!(moments.size(f64::NAN), [SMALLEST_SIZE * TARGET, 0.0, 0.0]);
    }

    #[test]
    fn responses_are_differences_and_noise_has_the_typical_size() {
        let moments = SizeMoments::new(TARGET, WINDOW, LATTICE);
        let (galaxy, other) = (acf(2.0), acf(4.0));
        let found = moments.measure(&galaxy, 3.0, 20.0);
        let step = 1e-3;
        let moved: Vec<f32> = galaxy
            .iter()
            .zip(&other)
            .map(|(a, b)| a + step * b)
            .collect();
        let change = (moments.measure(&moved, 3.0, 20.0).square - found.square) / step;
        let response = moments.response(&found, &other);
        // Single precision over a step of 10⁻³.
        assert!(
            (change / response - 1.0).abs() < 0.02,
            "{change} {response}"
        );
        let product = moments.sums(&other)[0] * response;
        let curved = SizeMoments::mean_second_derivative(&found, product);
        let side = |step: f32| {
            let moved: Vec<f32> = galaxy
                .iter()
                .zip(&other)
                .map(|(a, b)| a + step * b)
                .collect();
            f64::from(moments.response(&moments.measure(&moved, 3.0, 20.0), &other))
        };
        let expected = (side(0.01) - side(-0.01)) / 0.02;
        assert!(
            (curved / expected - 1.0).abs() < 0.02,
            "{curved} {expected}"
        );
        let nothing = vec![0.0; galaxy.len()];
        assert_eq!(moments.measure(&nothing, 3.0, 20.0).square, 20.0);
        let [zero, two] = moments.gradients();
        let each = |weights: &[f32]| -> f32 {
            let width = LATTICE.width();
            let rows = weights.iter().zip(&other).enumerate();
            rows.map(|(at, (w, v))| w * v * if at < width { 1.0 } else { 2.0 })
                .sum()
        };
        let combined = SizeMoments::combine(&found, [each(&zero), each(&two)]);
        assert!((combined / response - 1.0).abs() < 1e-4);
    }
}
