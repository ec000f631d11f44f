//! Mean products of what noise does to two quantities of a galaxy.

use shearq_quantities::linear::Symmetric;

use crate::measurement::QUANTITIES;
use crate::transform::Spectrum;

use super::deconvolution::{Spectral, SpectralPsf, SpectralScratch};
use super::noise::{NoiseChanges, sums_of_products, twice_scaled};

/// Mean products of the changes with noise of σ = 1 of five quantities, and those that their second derivatives consist of.
pub(crate) struct Products {
    /// Of e₁, e₂, the flux, the size's T and the light of the ring, in this order.
    pub(crate) pairs: Symmetric<QUANTITIES, NoiseChanges<f32>>,
    /// e₁′ · A₀ and e₂′ · A₀ of `RoundMoments`, and T′ · P₀ of `SizeMoments`.
    pub(crate) with_divisors: [NoiseChanges<f32>; 3],
}

impl Spectral {
    /// Mean products for the stamp last given. `weights` are the spectra by parity of the weights of e₁, e₂, A₀, T and P₀.
    ///
    /// A quantity a that depends on the windowed result changes with noise n by a′(n) = Σ_k conj(h_a)·n̂, where n̂ is the
    /// deconvolved noise before the window and h_a the gradient of a, taken through the window. Modes of noise are
    /// independent, so that the mean of a′(n)·b′(tn), with each mode of the second times t, is Σ_k |n̂|² t conj(h_a)·h_b.
    pub(crate) fn products(
        &self,
        psf: &SpectralPsf,
        weights: [&[f32]; 5],
        scratch: &mut SpectralScratch,
    ) -> Products {
        let SpectralScratch {
            gradients,
            stamp,
            quarter,
            ..
        } = scratch;
        for (weights, out) in weights.into_iter().zip(&mut *gradients) {
            twice_scaled(stamp, weights, &self.scale, out);
        }
        for gradient in &mut *gradients {
            self.window.apply(gradient, quarter);
        }
        let [e1, e2, light, square, zero] = &*gradients;
        // The flux is the sum under the window.
        let (flux, ring) = (&self.window_spectrum, &self.ring_spectrum);
        let mean = |a: &Spectrum, b: &Spectrum| sums_of_products(a, b, &psf.powers);
        let quantities = [e1, e2, flux, square, ring];
        Products {
            pairs: Symmetric::from_fn(|a, b| mean(quantities[a], quantities[b])),
            with_divisors: [mean(e1, light), mean(e2, light), mean(square, zero)],
        }
    }
}
