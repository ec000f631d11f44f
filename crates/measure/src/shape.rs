//! Ellipticities and sizes from autocorrelations.
//!
//! The autocorrelation of a stamp has the ellipticity of the stamp and is centred exactly on zero lag; its quadrupole moments
//! give the distortion. The network follows the paper: moments inside the radius that encloses a share of the light
//! ([`ClippedAcf`]). The linear method takes moments under a weight that adapts to the galaxy ([`AdaptiveMoments`]), and the
//! size before the PSF from a round weight ([`SizeMoments`]).
//!
//! # Adaptive moments
//!
//! The weight is a Moffat profile with the fixed scale r and the ellipticity χ of the galaxy itself,
//!
//! ```text
//! W = (1 + q)^(−3/2),  q = [(1 − χ₁)x² + (1 + χ₁)y² − 2χ₂xy] / (√(1 − |χ|²) r²).
//! ```
//!
//! Moments need the weights in proportion to how an autocorrelation changes with shear over how noisy
//! it is; galaxies have cusps and wide wings, and so has this. A Gaussian loses some 3 % more.
//!
//! χ is where the weighted moments (Eqs. 13 and 14) have the ellipticity of the weight, found by
//! Newton's method (Bernstein & Jarvis 2002 do this to images; an autocorrelation needs no centring,
//! and the noise at zero lag does not enter). The same derivatives give the response of χ to a change
//! of the autocorrelation.
//!
//! # Second derivatives of adaptive moments
//!
//! With the integrals L_T, L₁ and L₂ of the bases x² + y², x² − y² and 2xy, χ is where F_i(χ, A) = L_i − χ_i(L_T + s) = 0 for a
//! regularisation s. F is linear in A, so that implicit differentiation along changes a and b of A gives
//!
//! ```text
//! χ′(a) = K φ(a),   K = (−∂F/∂χ)⁻¹,   φ_i(a) = L_i(a) − χ_i L_T(a),
//! χ″(a, b) = K [F_χχ(χ′(a), χ′(b)) + φ_χ(b) χ′(a) + φ_χ(a) χ′(b)].
//! ```
//!
//! The four φ_χ = ∂φ_i/∂χ_j are sums over lags, as φ is.
//!
//! # Sizes
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
use shearq_quantities::Distortion;
use shearq_quantities::linear::LANES;
use shearq_submissions::{AcfKind, Background, ClippedShape, ShareOf};

use crate::error::{MeasureError, length};
use crate::measurement::Flag;
use crate::transform::{
    HexLattice, LagsScratch, Plane, Spectrum, ToLags, ToModes, TransformScratch,
};

// Chosen by hand.
const MAX_NEWTON_STEPS: usize = 30;
// Largest |χ| of a weight. Chosen by hand.
const MAX_WEIGHT_MODULUS: f32 = 0.98;
// Chosen by hand.
const MAX_NEWTON_STEP: f32 = 0.3;
// Change of χ at which the iteration ends. Resolution of sums of a few hundred single-precision terms.
const CONVERGED_STEP: f32 = 3e-6;
// Least determinant of 1 − ∂m/∂χ; near zero the moments follow the weight. Chosen by hand.
const MIN_DETERMINANT: f32 = 1e-3;

/// Moments for one size of weight.
#[derive(Debug, Clone)]
pub struct AdaptiveMoments {
    square: f32,
    /// Number of lags in half the plane.
    lags: usize,
    /// Where the lags within the circle are, row by row: first place and count. Of the first row those from zero on.
    runs: Vec<(usize, usize)>,
    /// Area in px² that a lag stands for, its opposite's too; zero for filling.
    area: Vec<f32>,
    /// x² + y², x² − y² and 2xy.
    bases: [Vec<f32>; 3],
}

/// Buffers for one thread, for the moments that made them. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct AdaptiveScratch {
    /// Lags within the circle, filled up.
    values: Vec<f32>,
    /// Weights W of the lags times their area, for the ellipticity `chi`.
    weights: Vec<f32>,
    chi: [f32; 2],
    /// Gradients on the same lags.
    gradients: [Vec<f32>; 6],
}

/// What was found on an autocorrelation.
#[derive(Debug, Clone, Copy)]
pub struct AdaptiveShape {
    /// χ.
    pub distortion: Distortion,
    /// Ellipticity of the weight, which is χ.
    chi: [f32; 2],
    /// Weighted integral of x² + y², regularised.
    trace: f32,
    /// (1 − ∂m/∂χ)⁻¹.
    inverse: [[f32; 2]; 2],
}

/// F_χχ of both components in units of the trace: for χ₁ twice, for χ₁ and χ₂, for χ₂ twice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Curvature([[f32; 3]; 2]);

impl AdaptiveShape {
    /// Mean of χ″(a, b) over changes a and b, from the means of the products χ′_j(a) χ′_k(b) for the pairs 11, 12 and 22, and of
    /// Σ_k χ′_k(a) ∂φ_i(b)/∂χ_k, which is the same if a and b are exchanged, in units of the trace.
    pub(crate) fn mean_second_derivative(
        &self,
        curvature: &Curvature,
        products: [f32; 3],
        mixed: [f32; 2],
    ) -> [f64; 2] {
        let Curvature(curvature) = curvature;
        let along = [0, 1].map(|i| {
            let terms = curvature[i].iter().zip([1.0, 2.0, 1.0]).zip(products);
            terms.map(|((f, count), p)| f * count * p).sum::<f32>() + 2.0 * mixed[i]
        });
        self.inverse
            .map(|row| f64::from(row[0] * along[0] + row[1] * along[1]))
    }
}

/// Integrals over lags, weighted with W: the bases a, b, c; weighted with −2 ∂W/∂q: the products aa, ab,
/// ac, bb, bc, cc.
type WeightedSums = [f32; 9];

impl AdaptiveMoments {
    /// Plans for a weight of `scale` px and autocorrelations on `lattice`; lags within the circle count.
    pub fn new(scale: f64, lattice: HexLattice) -> Self {
        let mut moments = AdaptiveMoments {
            square: (scale * scale) as f32,
            lags: lattice.count(),
            runs: Vec::new(),
            area: Vec::new(),
            bases: Default::default(),
        };
        let places: Vec<[f64; 2]> = lattice.places().collect();
        for (row, places) in places.chunks_exact(lattice.width()).enumerate() {
            let used = |&[x, y]: &[f64; 2]| lattice.contains([x, y]) && (y > 0.0 || x >= 0.0);
            let first = places.iter().position(used).unwrap_or(0);
            let before = moments.area.len();
            for &[x, y] in places.iter().filter(|place| used(place)) {
                let count = if x == 0.0 && y == 0.0 { 1.0 } else { 2.0 };
                let bases = [x * x + y * y, x * x - y * y, 2.0 * x * y];
                moments.push(
                    (count * lattice.area()) as f32,
                    bases.map(|basis| basis as f32),
                );
            }
            let count = moments.area.len() - before;
            moments.runs.push((row * lattice.width() + first, count));
        }
        while !moments.area.len().is_multiple_of(LANES) {
            moments.push(0.0, [0.0; 3]);
        }
        moments
    }

    fn push(&mut self, area: f32, bases: [f32; 3]) {
        self.area.push(area);
        for (basis, value) in self.bases.iter_mut().zip(bases) {
            basis.push(value);
        }
    }

    /// Buffers that fit.
    pub fn scratch(&self) -> AdaptiveScratch {
        AdaptiveScratch {
            values: vec![0.0; self.area.len()],
            weights: vec![0.0; self.area.len()],
            chi: [f32::NAN; 2],
            gradients: [(); 6].map(|()| vec![0.0; self.area.len()]),
        }
    }

    /// Finds χ of `acf`, laid out as `spectral::Lags`.
    ///
    /// `regularisation`, in px⁴ times the unit of `acf`, is added to the integral of x² + y² by which the
    /// moments are divided. Of an autocorrelation that is all noise that integral is anything; with a
    /// few times its noise added, χ is smaller and less noisy.
    ///
    /// # Errors
    /// Where no ellipticity matches: the weighted moments are not positive, or the iteration does not
    /// settle.
    pub fn measure(
        &self,
        acf: &[f32],
        regularisation: f32,
        scratch: &mut AdaptiveScratch,
    ) -> Result<AdaptiveShape, Flag> {
        debug_assert_eq!(acf.len(), self.lags);
        self.gather(acf, &mut scratch.values);
        let mut chi = [0.0f32; 2];
        for _ in 0..MAX_NEWTON_STEPS {
            let s = self.sums(scratch, chi);
            let [extent, n1, n2, ..] = s;
            let t = extent + regularisation;
            if !(t > 0.0 && t.is_finite()) {
                return Err(Flag::NoExtent);
            }
            let moment = [n1 / t, n2 / t];
            let rest = [moment[0] - chi[0], moment[1] - chi[1]];
            let slope = self.derivative(&s, chi, moment, t);
            let [[a, b], [c, d]] = [
                [1.0 - slope[0][0], -slope[0][1]],
                [-slope[1][0], 1.0 - slope[1][1]],
            ];
            let determinant = a * d - b * c;
            if determinant.is_nan() || determinant.abs() < MIN_DETERMINANT {
                return Err(Flag::NoExtent);
            }
            let inverse = [
                [d / determinant, -b / determinant],
                [-c / determinant, a / determinant],
            ];
            let mut step = [
                inverse[0][0] * rest[0] + inverse[0][1] * rest[1],
                inverse[1][0] * rest[0] + inverse[1][1] * rest[1],
            ];
            let length = step[0].hypot(step[1]);
            if length < CONVERGED_STEP {
                return Ok(AdaptiveShape {
                    distortion: Distortion::new(f64::from(chi[0]), f64::from(chi[1])),
                    chi,
                    trace: t,
                    inverse,
                });
            }
            let short = (MAX_NEWTON_STEP / length).min(1.0);
            step = step.map(|s| s * short);
            chi = [chi[0] + step[0], chi[1] + step[1]];
            let modulus = chi[0].hypot(chi[1]);
            if modulus > MAX_WEIGHT_MODULUS {
                chi = chi.map(|e| e * MAX_WEIGHT_MODULUS / modulus);
            }
        }
        Err(Flag::NoExtent)
    }

    /// The regularisation that halves the effect of a small distortion of the round `acf`.
    ///
    /// The weight follows the galaxy: with m = aχ′ + bχ the moments of a galaxy of distortion χ′ under a weight of χ,
    /// χ = aχ′/(1 − b) is aχ′T/((1 − b)T + s) after regularisation by s.
    pub fn halving_regularisation(&self, acf: &[f32]) -> f32 {
        let mut scratch = self.scratch();
        self.gather(acf, &mut scratch.values);
        let sums = self.sums(&mut scratch, [0.0; 2]);
        let extent = sums[0];
        let [[slope, _], _] = self.derivative(&sums, [0.0; 2], [0.0; 2], extent);
        (1.0 - slope) * extent
    }

    /// Change of χ with a change `change` of the autocorrelation that `shape` was found on.
    pub fn response(
        &self,
        shape: &AdaptiveShape,
        change: &[f32],
        scratch: &mut AdaptiveScratch,
    ) -> [f64; 2] {
        self.gather(change, &mut scratch.values);
        self.weigh(shape, scratch);
        let [a, b, c] = &self.bases;
        let [t, n1, n2] = plain_sums(&scratch.values, &scratch.weights, [a, b, c]);
        let moved = [
            (n1 - shape.chi[0] * t) / shape.trace,
            (n2 - shape.chi[1] * t) / shape.trace,
        ];
        shape
            .inverse
            .map(|row| f64::from(row[0] * moved[0] + row[1] * moved[1]))
    }

    /// Writes the weights of the lags, each for itself, whose sums with a change of the autocorrelation are χ′₁, χ′₂ and, in
    /// units of the trace, ∂φ₁/∂χ₁, ∂φ₁/∂χ₂, ∂φ₂/∂χ₁ and ∂φ₂/∂χ₂; laid out as `spectral::Lags`. Lags beyond the circle
    /// are left as they are. Returns F_χχ on `acf`.
    pub(crate) fn second_order(
        &self,
        shape: &AdaptiveShape,
        acf: &[f32],
        scratch: &mut AdaptiveScratch,
        out: &mut [Vec<f32>; 6],
    ) -> Curvature {
        let AdaptiveScratch {
            values, gradients, ..
        } = scratch;
        self.gather(acf, values);
        let [a, b, c] = &self.bases;
        let scale = self.scale(shape.chi);
        let found = second_order_sums(values, &self.area, [a, b, c], shape, scale, gradients);
        // Lags of the row y = 0 are stored with both signs, lags of other rows with one.
        for (out, gradient) in out.iter_mut().zip(gradients) {
            let mut from = 0;
            for &(first, count) in &self.runs {
                out[first..first + count].copy_from_slice(&gradient[from..from + count]);
                from += count;
            }
            // Zero lag stands for itself alone, and so twice for half of it; but its bases are zero.
            let (left, right) = out.split_at_mut(self.runs[0].0);
            for (left, right) in left.iter_mut().rev().zip(&right[1..]) {
                *left = *right;
            }
        }
        let [first, second, [t1, t2, _]] = found.map(|sums| sums.map(|sum| sum / shape.trace));
        // F_i = L_i − χ_i T: second derivatives of the weights, and of the product.
        Curvature([
            [first[0] - 2.0 * t1, first[1] - t2, first[2]],
            [second[0], second[1] - t1, second[2] - 2.0 * t2],
        ])
    }

    /// The weight W at lag (x, y), in pixels, that `shape` was found with.
    pub fn weight(&self, shape: &AdaptiveShape, x: f64, y: f64) -> f64 {
        let [chi1, chi2] = shape.chi.map(f64::from);
        let q = f64::from(self.scale(shape.chi))
            * ((1.0 - chi1) * x * x + (1.0 + chi1) * y * y - 2.0 * chi2 * x * y);
        (1.0 + q).powf(-1.5)
    }

    // Takes the lags within the circle.
    fn gather(&self, acf: &[f32], values: &mut [f32]) {
        let mut to = 0;
        for &(first, count) in &self.runs {
            values[to..to + count].copy_from_slice(&acf[first..first + count]);
            to += count;
        }
        values[to..].fill(0.0);
    }

    // Makes sure that the weights are those that `shape` was found with: it may not be the one that was found last.
    fn weigh(&self, shape: &AdaptiveShape, scratch: &mut AdaptiveScratch) {
        if scratch.chi != shape.chi {
            self.sums(scratch, shape.chi);
        }
    }

    // Sums over the values that were taken; leaves their weights.
    fn sums(&self, scratch: &mut AdaptiveScratch, chi: [f32; 2]) -> WeightedSums {
        let [a, b, c] = &self.bases;
        let AdaptiveScratch {
            values,
            weights,
            chi: of,
            ..
        } = scratch;
        *of = chi;
        weighted_sums(values, &self.area, [a, b, c], chi, self.scale(chi), weights)
    }

    // 1/(√(1 − |χ|²) r²).
    fn scale(&self, chi: [f32; 2]) -> f32 {
        let rest = 1.0 - chi[0] * chi[0] - chi[1] * chi[1];
        1.0 / (rest.sqrt() * self.square)
    }

    // ∂m_i/∂χ_j of the moments' ellipticity m, whose divisor is `t`, with that of the weight.
    fn derivative(
        &self,
        s: &WeightedSums,
        chi: [f32; 2],
        moment: [f32; 2],
        t: f32,
    ) -> [[f32; 2]; 2] {
        let [_, _, _, aa, ab, ac, bb, bc, cc] = *s;
        let k = self.scale(chi);
        let rest = 1.0 - chi[0] * chi[0] - chi[1] * chi[1];
        // Σ A V q·(a, b, c), for V = −2 ∂W/∂q and q = k(a − χ₁b − χ₂c).
        let q = |xa: f32, xb: f32, xc: f32| k * (xa - chi[0] * xb - chi[1] * xc);
        let (qa, qb, qc) = (q(aa, ab, ac), q(ab, bb, bc), q(ac, bc, cc));
        // ∂W/∂χ_j = ½V[k·(b, c)_j − q χ_j/(1 − |χ|²)].
        let with = [[ab, bb, bc], [ac, bc, cc]];
        let mut slope = [[0.0; 2]; 2];
        for j in 0..2 {
            let turn = chi[j] / rest;
            let dt = 0.5 * (k * with[j][0] - turn * qa);
            let d1 = 0.5 * (k * with[j][1] - turn * qb);
            let d2 = 0.5 * (k * with[j][2] - turn * qc);
            slope[0][j] = (d1 - moment[0] * dt) / t;
            slope[1][j] = (d2 - moment[1] * dt) / t;
        }
        slope
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weighted_sums(
    values: &[f32],
    area: &[f32],
    bases: [&[f32]; 3],
    chi: [f32; 2],
    scale: f32,
    weights: &mut [f32],
) -> WeightedSums {
    let mut lanes = [[0.0f32; LANES]; 9];
    let [a, b, c] = bases.map(|basis| basis.chunks_exact(LANES));
    let chunks = values.chunks_exact(LANES).zip(area.chunks_exact(LANES));
    let chunks = chunks.zip(a).zip(b).zip(c);
    for (kept, ((((v, area), a), b), c)) in weights.chunks_exact_mut(LANES).zip(chunks) {
        let (mut w, mut bend) = ([0.0f32; LANES], [0.0f32; LANES]);
        for l in 0..LANES {
            let inverse = 1.0 / (1.0 + scale * (a[l] - chi[0] * b[l] - chi[1] * c[l]));
            kept[l] = area[l] * inverse * inverse.sqrt();
            w[l] = v[l] * kept[l];
            bend[l] = 3.0 * w[l] * inverse;
        }
        for l in 0..LANES {
            lanes[0][l] += w[l] * a[l];
            lanes[1][l] += w[l] * b[l];
            lanes[2][l] += w[l] * c[l];
            let (va, vb, vc) = (bend[l] * a[l], bend[l] * b[l], bend[l] * c[l]);
            lanes[3][l] += va * a[l];
            lanes[4][l] += va * b[l];
            lanes[5][l] += va * c[l];
            lanes[6][l] += vb * b[l];
            lanes[7][l] += vb * c[l];
            lanes[8][l] += vc * c[l];
        }
    }
    lanes.map(|lane| lane.iter().sum())
}

// The first three of them, with weights that are known.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn plain_sums(values: &[f32], weights: &[f32], bases: [&[f32]; 3]) -> [f32; 3] {
    let mut lanes = [[0.0f32; LANES]; 3];
    let [a, b, c] = bases.map(|basis| basis.chunks_exact(LANES));
    let chunks = values.chunks_exact(LANES).zip(weights.chunks_exact(LANES));
    for ((((v, w), a), b), c) in chunks.zip(a).zip(b).zip(c) {
        for l in 0..LANES {
            let weighted = v[l] * w[l];
            lanes[0][l] += weighted * a[l];
            lanes[1][l] += weighted * b[l];
            lanes[2][l] += weighted * c[l];
        }
    }
    lanes.map(|lane| lane.iter().sum())
}

// Sums over the values of φ₁ and φ₂ with the second derivatives of W for χ₁ twice, χ₁ and χ₂, and χ₂ twice; and of L_T with the
// first derivatives. Writes gradients of the lags.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn second_order_sums(
    values: &[f32],
    area: &[f32],
    bases: [&[f32]; 3],
    shape: &AdaptiveShape,
    scale: f32,
    out: &mut [Vec<f32>; 6],
) -> [[f32; 3]; 3] {
    let [chi1, chi2] = shape.chi;
    let per_rest = 1.0 / (1.0 - chi1 * chi1 - chi2 * chi2);
    let (turn1, turn2) = (chi1 * per_rest, chi2 * per_rest);
    // ∂²q/∂χ_j∂χ_k in units of q, but for the terms with the bases.
    let own1 = per_rest + 3.0 * turn1 * turn1;
    let own2 = per_rest + 3.0 * turn2 * turn2;
    let cross = 3.0 * turn1 * turn2;
    // Each lag for itself: half of an area, which is of both.
    let unit = 0.5 / shape.trace;
    let [[i11, i12], [i21, i22]] = shape.inverse;
    let mut lanes = [[0.0f32; LANES]; 8];
    for at in (0..values.len()).step_by(LANES) {
        let part =
            |all: &'_ [f32]| -> [f32; LANES] { std::array::from_fn(|l| all[at..][..LANES][l]) };
        let [values, area] = [values, area].map(part);
        let [a, b, c] = bases.map(part);
        let mut gradients = [[0.0f32; LANES]; 6];
        for l in 0..LANES {
            let q = scale * (a[l] - chi1 * b[l] - chi2 * c[l]);
            let inverse = 1.0 / (1.0 + q);
            // W, −∂W/∂q and ∂²W/∂q².
            let weight = area[l] * inverse * inverse.sqrt();
            let bend = 1.5 * weight * inverse;
            let bend2 = 2.5 * bend * inverse;
            // −∂q/∂χ_j.
            let (p1, p2) = (scale * b[l] - q * turn1, scale * c[l] - q * turn2);
            let (along, across) = (b[l] - chi1 * a[l], c[l] - chi2 * a[l]);
            let (moved1, moved2) = (bend * p1, bend * p2);
            gradients[0][l] = unit * weight * (i11 * along + i12 * across);
            gradients[1][l] = unit * weight * (i21 * along + i22 * across);
            gradients[2][l] = unit * (moved1 * along - weight * a[l]);
            gradients[3][l] = unit * moved2 * along;
            gradients[4][l] = unit * moved1 * across;
            gradients[5][l] = unit * (moved2 * across - weight * a[l]);
            let v = values[l];
            let (tb, tc) = (scale * turn1, scale * turn2);
            let w11 = v * (bend2 * p1 * p1 + bend * (2.0 * tb * b[l] - own1 * q));
            let w12 = v * (bend2 * p1 * p2 + bend * (tc * b[l] + tb * c[l] - cross * q));
            let w22 = v * (bend2 * p2 * p2 + bend * (2.0 * tc * c[l] - own2 * q));
            lanes[0][l] += w11 * along;
            lanes[1][l] += w12 * along;
            lanes[2][l] += w22 * along;
            lanes[3][l] += w11 * across;
            lanes[4][l] += w12 * across;
            lanes[5][l] += w22 * across;
            lanes[6][l] += v * moved1 * a[l];
            lanes[7][l] += v * moved2 * a[l];
        }
        for (out, gradient) in out.iter_mut().zip(gradients) {
            out[at..][..LANES].copy_from_slice(&gradient);
        }
    }
    let [s0, s1, s2, s3, s4, s5, t1, t2] = lanes.map(|lane| lane.iter().sum());
    [[s0, s1, s2], [s3, s4, s5], [t1, t2, 0.0]]
}

// Scale τ of the weight in units of the window's σ. Chosen by hand: wide enough that sizes up to 10 px differ.
const SIZE_WEIGHT_SCALE: f64 = 0.6;
// Largest size that is reported, in units of the window's σ. Beyond it the window, not the galaxy, sets the size.
const LARGEST_SIZE: f64 = 2.0;
// Smallest size that is reported, in units of the target's σ. Far below the noise of a size, 0.24 px at S/N 20.
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

/// A size r, and its first and second derivative with T.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Size {
    pub(crate) px: f64,
    pub(crate) slope: f64,
    pub(crate) curvature: f64,
}

impl Size {
    fn bound(px: f64) -> Self {
        Size {
            px,
            slope: 0.0,
            curvature: 0.0,
        }
    }
}

impl SizeMoments {
    /// For the lags of `lattice`, a target of `target` px and a window of `window` px.
    pub(crate) fn new(target: f64, window: f64, lattice: HexLattice) -> Self {
        let tau = SIZE_WEIGHT_SCALE * window;
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

    /// Gradient of T from the gradients of P₀ and P₂.
    pub(crate) fn combine(found: &MeanSquare, [zero, two]: [f32; 2]) -> f32 {
        (two - found.square * zero) / found.divisor
    }

    /// T of a round Gaussian galaxy of standard deviation `r` px per axis.
    pub(crate) fn square_of(&self, r: f64) -> f64 {
        4.0 / (self.rest + 1.0 / (r * r + self.target * self.target))
    }

    /// The size of a galaxy of this T; the derivatives are zero beyond the bounds.
    pub(crate) fn size(&self, square: f64) -> Size {
        let (least, most) = (SMALLEST_SIZE * self.target, LARGEST_SIZE * self.window);
        if square.is_nan() || square <= self.square_of(least) {
            return Size::bound(least);
        }
        if square >= self.square_of(most) {
            return Size::bound(most);
        }
        let compact = 4.0 / square - self.rest;
        let r = (1.0 / compact - self.target * self.target).sqrt();
        // r² = 1/κ − σ_Γ², dκ/dT = −4/T².
        let first = 4.0 / (square * square * compact * compact);
        let second = first * (2.0 * 4.0 / (square * square * compact) - 2.0 / square);
        Size {
            px: r,
            slope: first / (2.0 * r),
            curvature: (second - first * first / (2.0 * r * r)) / (2.0 * r),
        }
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

// Chosen by hand.
const BORDER_PX: usize = 3;

/// Quadrupole moments of the clipped autocorrelation (Eq. 14), in px² relative to its light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moments {
    /// Qxx.
    pub xx: f64,
    /// Qyy.
    pub yy: f64,
    /// Qxy.
    pub xy: f64,
    /// Radius of the clipping in pixels.
    pub radius: f64,
}

impl Moments {
    /// (Qxx − Qyy)/(Qxx + Qyy) and 2Qxy/(Qxx + Qyy) (Eq. 13): a distortion χ.
    ///
    /// # Errors
    /// Where Qxx + Qyy is not positive.
    pub fn distortion(&self) -> Result<Distortion, Flag> {
        let size = self.xx + self.yy;
        if !(size > 0.0 && size.is_finite()) {
            return Err(Flag::NoExtent);
        }
        Ok(Distortion::new(
            (self.xx - self.yy) / size,
            2.0 * self.xy / size,
        ))
    }
}

/// One lag of the half plane kept.
#[derive(Debug, Clone, Copy)]
struct Lag {
    at: u32,
    dx: i32,
    dy: i32,
    square: i32,
    /// 2 for a lag that stands for its opposite too, 1 for zero lag; half of it for each component of n/2
    /// where lags wrap around and −n/2 is the same lag.
    weight: f32,
}

/// Autocorrelation A(dx, dy) = Σ v(x, y)·v(x + dx, y + dy) of n×n stamps, zero outside the stamp or the stamp again, and its
/// moments inside the radius that encloses a share of its light.
///
/// Lags are kept for dy = 0…R, dx = −R…R, as `[dy·(2R+1) + dx + R]`; the other half follows from A(−dx, −dy) = A(dx, dy).
/// R is n − 1, or n/2 where the stamp goes on beyond its edges as it begins: what a transform without padding gives.
#[derive(Debug, Clone)]
pub struct ClippedAcf {
    n: usize,
    settings: ClippedShape,
    plane: Plane,
    to_modes: ToModes,
    to_lags: ToLags,
    reach: usize,
    /// By distance. Lags of equal distance are taken or left together, so that the clipped region is as round as the
    /// pixel grid allows and has no preferred direction.
    lags: Vec<Lag>,
    /// Number of lags, of both half planes.
    count: f64,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct ClippedAcfScratch {
    stamp: Vec<f32>,
    transform: TransformScratch,
    spectrum: Spectrum,
    power: Vec<f32>,
    lags: LagsScratch,
    acf: Vec<f32>,
}

impl ClippedAcfScratch {
    /// The autocorrelation last measured, laid out as [`ClippedAcf`] has it.
    pub fn acf(&self) -> &[f32] {
        &self.acf
    }
}

impl ClippedAcf {
    /// Plans for n×n stamps.
    pub fn new(n: usize, settings: &ClippedShape) -> Self {
        let circular = settings.acf == AcfKind::Circular;
        // At 2n − 1 pixels no lag wraps onto another.
        let (period, reach) = if circular {
            (n, n / 2)
        } else {
            (2 * n - 1, n - 1)
        };
        let plane = Plane::with_all_modes(period);
        let side = reach as i32;
        // −n/2 and n/2 are one lag of a circular autocorrelation, which both components share.
        let half = |d: i32| {
            if circular && 2 * d.unsigned_abs() as usize == n {
                0.5
            } else {
                1.0
            }
        };
        let places = (0..=side).flat_map(|dy| (-side..=side).map(move |dx| (dy, dx)));
        let mut lags: Vec<Lag> = places
            .enumerate()
            .filter(|(_, (dy, dx))| *dy > 0 || *dx >= 0)
            .map(|(at, (dy, dx))| {
                let both = if dx == 0 && dy == 0 { 1.0 } else { 2.0 };
                Lag {
                    at: at as u32,
                    dx,
                    dy,
                    square: dx * dx + dy * dy,
                    weight: both * half(dx) * half(dy),
                }
            })
            .collect();
        lags.sort_by_key(|lag| (lag.square, lag.dy, lag.dx));
        ClippedAcf {
            n,
            settings: settings.clone(),
            to_modes: ToModes::new(n, &plane, false),
            to_lags: ToLags::new(reach, period, &plane, 1.0 / (period * period) as f64),
            plane,
            reach,
            count: lags.iter().map(|lag| f64::from(lag.weight)).sum(),
            lags,
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> ClippedAcfScratch {
        ClippedAcfScratch {
            stamp: vec![0.0; self.n * self.n],
            transform: self.to_modes.scratch(),
            spectrum: self.plane.spectrum(),
            power: vec![0.0; 2 * self.plane.quarter()],
            lags: self.to_lags.scratch(),
            acf: vec![0.0; self.to_lags.len()],
        }
    }

    /// Largest component R of a lag in pixels.
    pub fn reach(&self) -> usize {
        self.reach
    }

    /// Moments of the autocorrelation of `stamp`, whose pixels sum to `light`, or why there are none.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn measure(
        &self,
        stamp: &[f32],
        light: f64,
        scratch: &mut ClippedAcfScratch,
    ) -> Result<Result<Moments, Flag>, MeasureError> {
        let level = self.autocorrelate(stamp, scratch)?;
        let light = light - level * (self.n * self.n) as f64;
        Ok(self.moments(&scratch.acf, light))
    }

    /// Writes the autocorrelation of `stamp` less the level of its background to [`ClippedAcfScratch::acf`]; returns the level.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn autocorrelate(
        &self,
        stamp: &[f32],
        scratch: &mut ClippedAcfScratch,
    ) -> Result<f64, MeasureError> {
        length("a stamp", stamp.len(), self.n * self.n)?;
        let what = "buffers for an autocorrelation";
        length(what, scratch.acf.len(), self.to_lags.len())?;
        length(what, scratch.stamp.len(), stamp.len())?;
        let level = match self.settings.background {
            Background::StampFrame => frame_mean(stamp, self.n),
            Background::None | Background::AcfEdge => 0.0,
        };
        let ClippedAcfScratch {
            stamp: above,
            transform,
            spectrum,
            power,
            lags,
            acf,
        } = scratch;
        for (above, value) in above.iter_mut().zip(stamp) {
            *above = value - level as f32;
        }
        self.to_modes.transform(above, transform, spectrum);
        spectrum.power(power);
        self.to_lags.lags(power, lags, acf);
        Ok(level)
    }

    /// Moments of an autocorrelation; `light` is the sum of the stamp, whose square is the sum of the autocorrelation.
    ///
    /// # Errors
    /// Where there is no light.
    pub fn moments(&self, acf: &[f32], light: f64) -> Result<Moments, Flag> {
        if !(light > 0.0 && light.is_finite()) {
            return Err(Flag::NoLight);
        }
        // The squared light less the background of every lag is the sum of the lags.
        let background = self.background(acf);
        let wanted = self.settings.acf_share
            * match self.settings.share_of {
                ShareOf::Total => light * light - background * self.count,
                ShareOf::Maximum => self.most_enclosed(acf, background),
            };
        let mut sum = 0.0;
        let mut radius_square = None;
        let mut q = [0.0f64; 3];
        for lag in &self.lags {
            if radius_square.is_some_and(|square| lag.square > square) {
                break;
            }
            let value = light_of(lag, acf, background);
            sum += value;
            q[0] += value * f64::from(lag.dx * lag.dx);
            q[1] += value * f64::from(lag.dy * lag.dy);
            q[2] += value * f64::from(lag.dx * lag.dy);
            if radius_square.is_none() && sum >= wanted {
                radius_square = Some(lag.square);
            }
        }
        if sum.is_nan() || sum <= 0.0 {
            return Err(Flag::NoLight);
        }
        // A share of 1 may be missed by rounding: then everything is inside.
        let square = radius_square.or(self.lags.last().map(|lag| lag.square));
        Ok(Moments {
            xx: q[0] / sum,
            yy: q[1] / sum,
            xy: q[2] / sum,
            radius: f64::from(square.unwrap_or(0)).sqrt(),
        })
    }

    // Mean of the outermost lags, where it is to be subtracted: a pedestal of the deconvolved stamp, which clipping at zero
    // makes of noise, would enter the circle of 90 % of the light and make the shape rounder.
    fn background(&self, acf: &[f32]) -> f64 {
        if self.settings.background != Background::AcfEdge {
            return 0.0;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        for lag in &self.lags {
            if lag.dx.abs().max(lag.dy) == self.reach as i32 {
                sum += light_of(lag, acf, 0.0);
                count += f64::from(lag.weight);
            }
        }
        sum / count
    }

    fn most_enclosed(&self, acf: &[f32], background: f64) -> f64 {
        let (mut sum, mut most) = (0.0, 0.0f64);
        for ring in self.lags.chunk_by(|a, b| a.square == b.square) {
            for lag in ring {
                sum += light_of(lag, acf, background);
            }
            most = most.max(sum);
        }
        most
    }
}

fn light_of(lag: &Lag, acf: &[f32], background: f64) -> f64 {
    f64::from(acf[lag.at as usize] * lag.weight) - background * f64::from(lag.weight)
}

// Mean of the frame of an n×n stamp; of all its pixels where it is too small to have an inside.
fn frame_mean(stamp: &[f32], n: usize) -> f64 {
    let inside = BORDER_PX..n.saturating_sub(BORDER_PX);
    let (mut sum, mut count) = (0.0, 0);
    for (at, &value) in stamp.iter().enumerate() {
        if !(inside.contains(&(at / n)) && inside.contains(&(at % n))) {
            sum += f64::from(value);
            count += 1;
        }
    }
    sum / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::EllipticityType;

    use super::*;
    use crate::testing::close;

    const REACH: usize = 16;

    fn lattice(row_spacing: f64) -> HexLattice {
        HexLattice {
            row_spacing,
            reach: REACH,
        }
    }

    fn moments(scale: f64) -> AdaptiveMoments {
        AdaptiveMoments::new(scale, lattice(1.0))
    }

    /// Autocorrelation of a Gaussian galaxy of distortion (e1, e2) and Qxx + Qyy = size, on rows of lags `spacing` apart.
    fn gaussian(spacing: f64, size: f64, e1: f64, e2: f64) -> Vec<f32> {
        let (qxx, qyy, qxy) = (
            0.5 * size * (1.0 + e1),
            0.5 * size * (1.0 - e1),
            0.5 * size * e2,
        );
        let det = qxx * qyy - qxy * qxy;
        let acf = lattice(spacing).places().map(|[x, y]| {
            let q = (x * x * qyy + y * y * qxx - 2.0 * x * y * qxy) / det;
            (-0.5 * q).exp() as f32
        });
        acf.collect()
    }

    #[test]
    fn the_weight_is_that_of_the_moments() {
        let (spacing, scale) = (1.5, 3.0);
        let lattice = lattice(spacing);
        let moments = AdaptiveMoments::new(scale, lattice);
        let mut scratch = moments.scratch();
        let acf = gaussian(spacing, 20.0, 0.3, -0.2);
        let shape = moments.measure(&acf, 0.0, &mut scratch).unwrap();
        let (mut extent, mut e2) = (0.0, 0.0);
        for (&value, [x, y]) in acf.iter().zip(lattice.places()) {
            if !lattice.contains([x, y]) {
                continue;
            }
            // Rows beyond the first stand for both signs.
            let count = if y == 0.0 { 1.0 } else { 2.0 };
            let weighted = count * f64::from(value) * moments.weight(&shape, x, y);
            extent += weighted * (x * x + y * y);
            e2 += weighted * 2.0 * x * y;
        }
        // Sums of hundreds of f32 terms.
        assert!((extent * lattice.area() / f64::from(shape.trace) - 1.0).abs() < 1e-5);
        assert!((e2 / extent - shape.distortion.e2).abs() < 1e-5);
    }

    #[test]
    fn the_distortion_of_a_gaussian_is_found_with_its_sign() {
        for (spacing, scale) in [(1.0, 2.0), (1.5, 3.0)] {
            let moments = AdaptiveMoments::new(scale, lattice(spacing));
            let mut scratch = moments.scratch();
            for size in [8.0, 16.0, 30.0] {
                for (e1, e2) in [(0.0, 0.0), (0.3, 0.0), (-0.2, 0.4), (0.0, -0.4), (0.3, 0.3)] {
                    scratch.values.fill(f32::NAN);
                    let acf = gaussian(spacing, size, e1, e2);
                    let shape = moments.measure(&acf, 0.0, &mut scratch).unwrap();
                    // What the cut at 16 px leaves out of the largest, which the plain sums have too.
                    let apart = (shape.distortion.e1 - e1).hypot(shape.distortion.e2 - e2);
                    assert!(apart < 5e-3, "{size} {e1} {e2}: {:?}", shape.distortion);
                }
            }
        }
    }

    #[test]
    fn distortions_along_an_axis_and_between_axes_are_the_same() {
        // As far apart for the weight as in the submissions, and farther.
        for spacing in [4.0 / 3.0, 2.0] {
            let moments = AdaptiveMoments::new(1.5, lattice(spacing));
            let mut scratch = moments.scratch();
            // Six axes prefer one of two opposite distortions, to second order.
            let mut response = |e1, e2| {
                let [plus, minus] = [1.0, -1.0].map(|sign| {
                    let acf = gaussian(spacing, 16.0, sign * e1, sign * e2);
                    let Distortion { e1, e2 } =
                        moments.measure(&acf, 0.0, &mut scratch).unwrap().distortion;
                    e1 + e2
                });
                plus - minus
            };
            let apart = response(0.01, 0.0) / response(0.0, 0.01) - 1.0;
            // The resolution of single precision.
            assert!(apart.abs() < 5e-4, "{spacing}: {apart}");
        }
    }

    #[test]
    fn halving_leaves_half_of_a_small_distortion() {
        let moments = moments(1.5);
        let mut scratch = moments.scratch();
        for variance in [9.0, 16.0, 30.0] {
            let halving = moments.halving_regularisation(&gaussian(1.0, variance, 0.0, 0.0));
            for (e1, e2) in [(0.01, 0.0), (0.0, 0.01)] {
                let acf = gaussian(1.0, variance, e1, e2);
                let [hard, soft] = [0.0, halving].map(|regularisation| {
                    let shape = moments.measure(&acf, regularisation, &mut scratch).unwrap();
                    shape.distortion.e1 + shape.distortion.e2
                });
                // Of second order in the distortion.
                assert!((soft / hard - 0.5).abs() < 1e-3, "{soft} of {hard}");
            }
        }
    }

    #[test]
    fn the_response_is_the_finite_difference() {
        let moments = moments(1.5);
        let mut scratch = moments.scratch();
        let acf = gaussian(1.0, 20.0, 0.3, -0.2);
        let other = gaussian(1.0, 14.0, -0.1, 0.4);
        for regularisation in [0.0, 20.0] {
            let shape = moments.measure(&acf, regularisation, &mut scratch).unwrap();
            let response = moments.response(&shape, &other, &mut scratch);
            let mut moved = |h: f32| {
                let acf: Vec<f32> = acf.iter().zip(&other).map(|(a, o)| a + h * o).collect();
                let shape = moments.measure(&acf, regularisation, &mut scratch);
                shape.unwrap().distortion
            };
            let (plus, minus) = (moved(0.01), moved(-0.01));
            let slope = [(plus.e1 - minus.e1) / 0.02, (plus.e2 - minus.e2) / 0.02];
            for (found, expected) in response.iter().zip(slope) {
                // f32 resolves χ to 3e-6, divided by 0.02; the third derivative is smaller.
                assert!((found - expected).abs() < 5e-4, "{found} {expected}");
            }
        }
    }

    #[test]
    fn second_derivatives_are_differences_of_responses() {
        let moments = moments(1.5);
        let mut scratch = moments.scratch();
        let width = lattice(1.0).width();
        // Over all lags: those below the first row stand for two.
        let sum = |weights: &[f32], change: &[f32]| -> f32 {
            let lags = weights.iter().zip(change).enumerate();
            lags.map(|(at, (w, v))| w * v * if at < width { 1.0 } else { 2.0 })
                .sum()
        };
        let other = gaussian(1.0, 14.0, -0.1, 0.4);
        for (e1, e2, regularisation) in [(0.0, 0.0, 0.0), (0.3, -0.2, 20.0), (-0.1, 0.6, 0.0)] {
            let acf = gaussian(1.0, 20.0, e1, e2);
            let shape = moments.measure(&acf, regularisation, &mut scratch).unwrap();
            let response = moments.response(&shape, &other, &mut scratch);
            let mut gradients = [(); 6].map(|()| vec![0.0; acf.len()]);
            let curvature = moments.second_order(&shape, &acf, &mut scratch, &mut gradients);
            let [x1, x2, g11, g12, g21, g22] = gradients.map(|weights| sum(&weights, &other));
            for (found, expected) in [x1, x2].into_iter().zip(response) {
                assert!((f64::from(found) - expected).abs() < 1e-4 * (1.0 + expected.abs()));
            }
            let found = shape.mean_second_derivative(
                &curvature,
                [x1 * x1, x1 * x2, x2 * x2],
                [x1 * g11 + x2 * g12, x1 * g21 + x2 * g22],
            );
            let mut moved = |h: f32| {
                let acf: Vec<f32> = acf.iter().zip(&other).map(|(a, o)| a + h * o).collect();
                let shape = moments.measure(&acf, regularisation, &mut scratch).unwrap();
                moments.response(&shape, &other, &mut scratch)
            };
            let (plus, minus) = (moved(0.02), moved(-0.02));
            for k in 0..2 {
                let expected = (plus[k] - minus[k]) / 0.04;
                // f32 resolves responses to some 10⁻⁵, divided by 0.04.
                assert!(
                    (found[k] - expected).abs() < 2e-3 * (1.0 + expected.abs()),
                    "{e1} {e2}: {found:?} {expected}"
                );
            }
        }
    }

    #[test]
    fn an_autocorrelation_without_extent_is_refused() {
        let moments = moments(1.5);
        let lags = lattice(1.0).count();
        let mut scratch = moments.scratch();
        for acf in [vec![0.0; lags], vec![-1.0; lags], vec![f32::NAN; lags]] {
            assert!(moments.measure(&acf, 0.0, &mut scratch).is_err());
        }
    }

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
            let Size {
                px: size,
                slope: first,
                curvature: second,
            } = moments.size(f64::from(found.square));
            // The lags end at 20 px, four standard deviations of the weight.
            assert!((size / r - 1.0).abs() < 0.01, "{r}: {size}");
            assert!((moments.square_of(size) / f64::from(found.square) - 1.0).abs() < 1e-9);
            let step = 1e-4 * f64::from(found.square);
            let side = |by: f64| moments.size(f64::from(found.square) + by).px;
            let (plus, minus) = (side(step), side(-step));
            // Truncation and rounding of differences of 10⁻⁴.
            assert!(((plus - minus) / (2.0 * step) / first - 1.0).abs() < 1e-5);
            let curved = (plus - 2.0 * size + minus) / (step * step);
            assert!(
                (curved - second).abs() < 1e-3 * (second.abs() + first),
                "{r}"
            );
        }
        // A tenth of the target's width at least, and two window widths at most.
        for (square, bound) in [
            (0.0, 0.1 * TARGET),
            (f64::NAN, 0.1 * TARGET),
            (1e9, 2.0 * WINDOW),
        ] {
            assert_eq!(moments.size(square), Size::bound(bound));
        }
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
        close(change / response, 1.0, 0.02);
        let nothing = vec![0.0; galaxy.len()];
        assert_eq!(moments.measure(&nothing, 3.0, 20.0).square, 20.0);
    }

    fn settings(acf: AcfKind, background: Background, acf_share: f64) -> ClippedShape {
        ClippedShape {
            acf,
            background,
            acf_share,
            share_of: ShareOf::Total,
            ellipticity: EllipticityType::Distortion,
        }
    }

    /// Every lag (dx, dy) with its value and how often it counts, by plain sums: a lag of n/2 of a circular one is its own
    /// opposite.
    fn lags_naive(kind: AcfKind, stamp: &Array2<f64>) -> Vec<(i64, i64, f64, f64)> {
        let n = stamp.nrows() as i64;
        let mut lags = Vec::new();
        let reach = match kind {
            AcfKind::Full => n - 1,
            AcfKind::Circular => n / 2,
        };
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let mut sum = 0.0;
                for ((y, x), value) in stamp.indexed_iter() {
                    let (mut y, mut x) = (y as i64 + dy, x as i64 + dx);
                    if kind == AcfKind::Circular {
                        (y, x) = (y.rem_euclid(n), x.rem_euclid(n));
                    }
                    let other = stamp.get((y as usize, x as usize));
                    sum += value * other.copied().unwrap_or(0.0);
                }
                let twice = |d: i64| kind == AcfKind::Circular && 2 * d.abs() == n;
                let weight = [dx, dy].map(|d| if twice(d) { 0.5 } else { 1.0 });
                lags.push((dx, dy, sum, weight[0] * weight[1]));
            }
        }
        lags
    }

    /// The moments by plain sums over all pairs of pixels, in f64, with the autocorrelation as an image of its
    /// own. `None` where there is no light.
    fn moments_naive(settings: &ClippedShape, stamp: &Array2<f64>) -> Option<Moments> {
        let n = stamp.nrows() as i64;
        let mut stamp = stamp.clone();
        if settings.background == Background::StampFrame {
            let frame = |y: usize, x: usize| {
                let edge = |k: usize| k < BORDER_PX || k + BORDER_PX >= n as usize;
                edge(y) || edge(x)
            };
            let all: Vec<f64> = stamp
                .indexed_iter()
                .filter(|((y, x), _)| frame(*y, *x))
                .map(|(_, v)| *v)
                .collect();
            stamp -= all.iter().sum::<f64>() / all.len() as f64;
        }
        if stamp.sum() <= 0.0 {
            return None;
        }
        let mut lags = lags_naive(settings.acf, &stamp);
        let reach = lags.iter().map(|lag| lag.0).max()?;
        if settings.background == Background::AcfEdge {
            let outermost = |l: &&mut (i64, i64, f64, f64)| l.0.abs().max(l.1.abs()) == reach;
            let (mut sum, mut count) = (0.0, 0.0);
            for lag in lags.iter_mut().filter(outermost) {
                sum += lag.2 * lag.3;
                count += lag.3;
            }
            lags.iter_mut().for_each(|lag| lag.2 -= sum / count);
        }
        let square = |lag: &(i64, i64, f64, f64)| lag.0 * lag.0 + lag.1 * lag.1;
        let mut squares: Vec<i64> = lags.iter().map(square).collect();
        squares.sort_unstable();
        squares.dedup();
        let inside = |of: i64, what: fn(&(i64, i64, f64, f64)) -> f64| -> f64 {
            let lags = lags.iter().filter(|lag| square(lag) <= of);
            lags.map(|lag| what(lag) * lag.2 * lag.3).sum()
        };
        let enclosed: Vec<f64> = squares.iter().map(|s| inside(*s, |_| 1.0)).collect();
        let whole = match settings.share_of {
            ShareOf::Total => *enclosed.last()?,
            ShareOf::Maximum => enclosed.iter().copied().fold(0.0, f64::max),
        };
        let at = enclosed
            .iter()
            .position(|e| *e >= settings.acf_share * whole)?;
        let of = squares[at];
        let moment = |what| inside(of, what) / enclosed[at];
        Some(Moments {
            xx: moment(|lag| (lag.0 * lag.0) as f64),
            yy: moment(|lag| (lag.1 * lag.1) as f64),
            xy: moment(|lag| (lag.0 * lag.1) as f64),
            radius: (of as f64).sqrt(),
        })
    }

    #[test]
    fn every_reading_equals_plain_sums_on_dirty_scratch() {
        let mut rng = ChaCha8Rng::seed_from_u64(15);
        for n in [8, 11, 16, 19, 23, 32] {
            let centre = (n as f64 - 1.0) / 2.0 + 0.3;
            let stamp = Array2::from_shape_fn((n, n), |(y, x)| {
                let (dy, dx) = (y as f64 - centre, x as f64 - centre);
                let noise: f64 = rng.random_range(-0.5..1.0);
                0.3 * noise.max(0.0) + 4.0 * (-(dx * dx + dy * dy - 0.6 * dx * dy) / 7.0).exp()
            });
            let single: Vec<f32> = stamp.iter().map(|v| *v as f32).collect();
            let stamp = Array2::from_shape_fn((n, n), |(y, x)| f64::from(single[y * n + x]));
            for acf in [AcfKind::Full, AcfKind::Circular] {
                for background in [
                    Background::None,
                    Background::AcfEdge,
                    Background::StampFrame,
                ] {
                    for share_of in [ShareOf::Total, ShareOf::Maximum] {
                        for acf_share in [0.5, 0.9] {
                            let settings = ClippedShape {
                                share_of,
                                ..settings(acf, background, acf_share)
                            };
                            let plan = ClippedAcf::new(n, &settings);
                            let mut scratch = plan.scratch();
                            scratch.acf.fill(f32::NAN);
                            scratch.power.fill(f32::NAN);
                            let dirt: Vec<f32> = single.iter().rev().map(|v| 9.0 * v).collect();
                            plan.measure(&dirt, 1.0, &mut scratch).unwrap().ok();
                            let light = stamp.sum();
                            let found = plan.measure(&single, light, &mut scratch).unwrap();
                            let expected = moments_naive(&settings, &stamp);
                            let (Ok(found), Some(expected)) = (found, expected) else {
                                panic!("{settings:?}: no light");
                            };
                            // f32 transforms: 1e-6 of the peak in each of up to 10³ lags, whose r² are up to
                            // 10², over a sum of some ten peaks.
                            let label = format!("n {n}, {settings:?}: {found:?} {expected:?}");
                            assert!((found.radius - expected.radius).abs() < 1e-12, "{label}");
                            for (a, b) in [
                                (found.xx, expected.xx),
                                (found.yy, expected.yy),
                                (found.xy, expected.xy),
                            ] {
                                assert!((a - b).abs() <= 1e-4 * expected.xx.abs(), "{label}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn moments_without_light_have_no_distortion() {
        let plan = ClippedAcf::new(5, &settings(AcfKind::Full, Background::None, 0.9));
        assert_eq!(plan.moments(&[0.0; 45], 0.0), Err(Flag::NoLight));
        assert_eq!(plan.moments(&[0.0; 45], f64::NAN), Err(Flag::NoLight));
        let mut acf = [0.0; 45];
        acf[4] = 1.0;
        let point = plan.moments(&acf, 1.0).unwrap();
        assert_eq!(point.distortion(), Err(Flag::NoExtent));
        let elongated = Moments {
            xx: 5.0,
            yy: 3.0,
            xy: -1.0,
            radius: 4.0,
        };
        assert_eq!(elongated.distortion(), Ok(Distortion::new(0.25, -0.25)));
    }
}
