//! How noise couples quantities of a galaxy to each other: means of products of their changes with noise.
//!
//! A quantity a that depends on the windowed result v_W changes with noise n by a′(n) = Σ_k conj(h_a)·n̂, where n̂ is the
//! deconvolved noise before the window and h_a the gradient of a, taken through the window. Modes of noise are independent,
//! so that the mean of a′(n)·b′(tn), with each mode of the second times t, is Σ_k |n̂|² t conj(h_a)·h_b: no field of noise is
//! drawn.

use super::parities::{sums, twice_scaled};
use super::{Spectral, SpectralPsf, SpectralScratch};

/// Means of a product for four kinds t: the change of noise with γ₁, its change with γ₂, what noise lacks to be that
/// of a PSF turned by 90 degrees, and one, for the noise itself.
pub(crate) type Kinds = [f32; 4];

/// Weights of the lags whose sum with an autocorrelation's change is the change of a quantity.
#[derive(Debug, Clone)]
pub(crate) struct Gradients {
    /// Of two quantities; laid out as `Lags`, of both lags that each place stands for.
    pub(crate) pair: [Vec<f32>; 2],
    /// Of a third one, as its spectrum by parity.
    pub(crate) third: Vec<f32>,
}

impl Spectral {
    /// Room for gradients.
    pub(crate) fn gradients(&self) -> Gradients {
        Gradients {
            pair: [self.lags().acf, self.lags().acf],
            third: vec![0.0; self.target.len()],
        }
    }

    /// The spectrum of weights of the lags, for [`Gradients::third`].
    pub(crate) fn spectrum_of(&self, weights: &[f32], scratch: &mut SpectralScratch) -> Vec<f32> {
        let mut spectrum = scratch.even.clone();
        let correlation = &mut scratch.correlation;
        self.correlation
            .spectrum(weights, correlation, &mut spectrum);
        spectrum
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
            windowed,
            stamp,
            even,
            smooth,
            correlation,
            ..
        } = scratch;
        let [first, second, third] = &mut *windowed;
        for (weights, out) in gradients.pair.iter().zip([first, second]) {
            self.correlation.spectrum(weights, correlation, even);
            twice_scaled(stamp, even, &self.scale, out);
        }
        twice_scaled(stamp, &gradients.third, &self.scale, third);
        for gradient in &mut *windowed {
            self.window.apply(gradient, smooth);
        }
        let [first, second, third] = windowed;
        // The flux is the sum under the window.
        let gradients = [first, second, third, &self.window_modes];
        let mut found = [[0.0; 4]; 10];
        let pairs = (0..4).flat_map(|a| (a..4).map(move |b| [a, b]));
        for (found, [a, b]) in found.iter_mut().zip(pairs) {
            *found = sums(gradients[a], gradients[b], &psf.powers);
        }
        found
    }
}
