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

/// Scale τ of the weight in units of the window's σ. See docs/constants.md.
const SCALE: f64 = 0.6;
/// Largest size that is reported, in units of the window's σ. See docs/constants.md.
const LARGEST: f64 = 2.0;
/// Smallest size that is reported, in units of the target's σ. See docs/constants.md.
const SMALLEST: f64 = 0.1;

/// Weights for one window and target.
#[derive(Debug, Clone)]
pub(crate) struct Breadth {
    /// Of P₀ and P₂, laid out as `Lags`; of both lags that each place stands for.
    weights: [Vec<f32>; 2],
    target: f64,
    /// 2/τ² + 1/σ_W².
    rest: f64,
    /// σ_W.
    window: f64,
    /// Lags in a row.
    width: usize,
}

/// Size as found on an autocorrelation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FoundBreadth {
    /// T.
    pub(crate) square: f32,
    /// P₀ + s.
    divisor: f32,
}

impl Breadth {
    /// For lags up to `reach` steps of `spacing` px, a target of `target` px and a window of `window` px.
    pub(crate) fn new(target: f64, window: f64, spacing: f64, reach: usize) -> Self {
        let tau = SCALE * window;
        let side = reach as i32;
        let mut weights = [Vec::new(), Vec::new()];
        for y in 0..=side {
            for x in -side..=side {
                let square = f64::from(x * x + y * y) * spacing * spacing;
                let within = x * x + y * y <= side * side;
                let count = f64::from(u8::from(within)) * if y == 0 { 1.0 } else { 2.0 };
                let weight = count * spacing * spacing * (-0.5 * square / (tau * tau)).exp();
                weights[0].push(weight as f32);
                weights[1].push((weight * square) as f32);
            }
        }
        Breadth {
            weights,
            target,
            rest: 2.0 / (tau * tau) + 1.0 / (window * window),
            window,
            width: 2 * reach + 1,
        }
    }

    /// P₀ and P₂ of an autocorrelation or of its change.
    pub(crate) fn sums(&self, lags: &[f32]) -> [f32; 2] {
        let [zero, two] = &self.weights;
        let mut lanes = [[0.0f32; 16]; 2];
        let chunks = lags.chunks_exact(16);
        let at = lags.len() - chunks.remainder().len();
        for ((v, a), b) in chunks.zip(zero.chunks_exact(16)).zip(two.chunks_exact(16)) {
            for l in 0..16 {
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

    /// T of an autocorrelation, with `softening` and the typical T.
    pub(crate) fn measure(&self, acf: &[f32], softening: f32, typical: f32) -> FoundBreadth {
        let [zero, two] = self.sums(acf);
        let divisor = zero + softening;
        FoundBreadth {
            square: (two + softening * typical) / divisor,
            divisor,
        }
    }

    /// Change of T with a change of the autocorrelation.
    pub(crate) fn response(&self, found: &FoundBreadth, change: &[f32]) -> f32 {
        let [zero, two] = self.sums(change);
        (two - found.square * zero) / found.divisor
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

    /// Gradient of T from those of P₀ and P₂.
    pub(crate) fn combine(found: &FoundBreadth, [zero, two]: [f32; 2]) -> f32 {
        (two - found.square * zero) / found.divisor
    }

    /// T of a round Gaussian galaxy of standard deviation `r` px per axis.
    pub(crate) fn square_of(&self, r: f64) -> f64 {
        4.0 / (self.rest + 1.0 / (r * r + self.target * self.target))
    }

    /// The size r in px of a galaxy of this T, with its first and second derivative; both are zero beyond the bounds.
    pub(crate) fn size(&self, square: f64) -> [f64; 3] {
        let (least, most) = (SMALLEST * self.target, LARGEST * self.window);
        if !(square > self.square_of(least)) {
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
