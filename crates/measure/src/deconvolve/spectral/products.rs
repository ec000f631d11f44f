//! How noise couples quantities of a galaxy to each other: means of products of their changes with noise.
//!
//! A quantity a that depends on the windowed result v_W changes with noise n by a′(n) = Σ_k conj(h_a)·n̂, where n̂ is the
//! deconvolved noise before the window and h_a the gradient of a, taken through the window. Modes of noise are independent,
//! so that the mean of a′(n)·b′(tn), with each mode of the second times t, is Σ_k |n̂|² t conj(h_a)·h_b: no field of noise is
//! drawn.

use multiversion::multiversion;
use shearq_fourier::Complex32;

use super::{Spectral, SpectralPsf, SpectralScratch};

/// Numbers that are summed side by side. See docs/constants.md.
const LANES: usize = 16;

/// Means of a product for three kinds t: the change of noise with γ₁, its change with γ₂, and what noise lacks to be that
/// of a PSF turned by 90 degrees.
pub(crate) type Kinds = [f32; 3];

/// Weights of the lags whose sum with an autocorrelation's change is the change of a quantity.
#[derive(Debug, Clone)]
pub(crate) struct Gradients {
    /// Of two quantities, as real and imaginary part; laid out as `Lags`, of both lags that each place stands for.
    pub(crate) pair: Vec<Complex32>,
    /// Of a third one, as its spectrum.
    pub(crate) third: Vec<f32>,
}

impl Spectral {
    /// Room for gradients.
    pub(crate) fn gradients(&self) -> Gradients {
        Gradients {
            pair: vec![Complex32::ZERO; (self.reach + 1) * (2 * self.reach + 1)],
            third: vec![0.0; self.waves.len()],
        }
    }

    /// The spectrum of weights of the lags, for [`Gradients::third`].
    pub(crate) fn spectrum_of(&self, weights: &[f32], scratch: &mut SpectralScratch) -> Vec<f32> {
        let values: Vec<Complex32> = weights.iter().map(|&w| Complex32::new(w, 0.0)).collect();
        self.plane
            .spectra_of_lags(0, self.reach, &mut scratch.plane, &values);
        scratch.plane.half[0].iter().map(|value| value.re).collect()
    }

    /// Mean products of the changes with noise of σ = 1 of four quantities of the stamp last given: the three of
    /// `gradients`, and `Lags::flux`. Of each pair in the order 00, 01, 02, 03, 11, 12, 13, 22, 23, 33.
    pub(crate) fn products(
        &self,
        psf: &SpectralPsf,
        gradients: &Gradients,
        scratch: &mut SpectralScratch,
    ) -> [Kinds; 10] {
        let SpectralScratch {
            plane,
            stamp,
            windows: [across, down],
            window_modes,
            ..
        } = scratch;
        self.plane
            .spectra_of_lags(0, self.reach, plane, &gradients.pair);
        let [first, second, third] = &mut plane.half;
        for (at, value) in stamp.iter().enumerate() {
            let twice = 2.0 * self.scale[at];
            let pair = first[at];
            first[at] = value * (twice * pair.re);
            second[at] = value * (twice * pair.im);
            third[at] = value * (twice * gradients.third[at]);
        }
        self.plane.window(across, down, plane);
        self.plane.window_modes(across, down, plane, window_modes);
        let [first, second, third] = &plane.half;
        let half = [first, second, third, window_modes];
        let mut found = [[0.0; 3]; 10];
        let pairs = (0..4).flat_map(|a| (a..4).map(move |b| [a, b]));
        for (found, [a, b]) in found.iter_mut().zip(pairs) {
            *found = products_of(half[a], half[b], &psf.powers);
        }
        found
    }
}

/// Σ t·Re(conj(a)·b) over modes, for three kinds t.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn products_of(a: &[Complex32], b: &[Complex32], kinds: &[Vec<f32>; 3]) -> Kinds {
    let mut lanes = [[0.0f32; LANES]; 3];
    let whole = a.len() / LANES * LANES;
    let [first, second, third] = kinds;
    let chunks = a.chunks_exact(LANES).zip(b.chunks_exact(LANES));
    let kinds = first
        .chunks_exact(LANES)
        .zip(second.chunks_exact(LANES))
        .zip(third.chunks_exact(LANES));
    for ((a, b), ((first, second), third)) in chunks.zip(kinds) {
        for l in 0..LANES {
            let product = a[l].re * b[l].re + a[l].im * b[l].im;
            lanes[0][l] += first[l] * product;
            lanes[1][l] += second[l] * product;
            lanes[2][l] += third[l] * product;
        }
    }
    let mut sums = lanes.map(|lanes| lanes.iter().sum());
    for at in whole..a.len() {
        let product = a[at].re * b[at].re + a[at].im * b[at].im;
        sums[0] += first[at] * product;
        sums[1] += second[at] * product;
        sums[2] += third[at] * product;
    }
    sums
}
