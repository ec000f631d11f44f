//! Mean products of what noise does to two quantities of a galaxy.

use crate::transform::Spectrum;

use super::deconvolution::{Spectral, SpectralPsf, SpectralScratch};
use super::noise::{NoiseChanges, sums_of_products, twice_scaled};

/// Mean products of the changes with noise of σ = 1 of e₁, e₂, the size's T, the flux and the light of the ring, and those that
/// their second derivatives consist of.
pub(crate) struct Products {
    /// e₁ and e₁, e₁ and e₂, e₂ and e₂.
    pub(crate) e_e: [NoiseChanges<f32>; 3],
    pub(crate) e_square: [NoiseChanges<f32>; 2],
    pub(crate) e_flux: [NoiseChanges<f32>; 2],
    pub(crate) square_square: NoiseChanges<f32>,
    pub(crate) square_flux: NoiseChanges<f32>,
    pub(crate) flux_flux: NoiseChanges<f32>,
    pub(crate) ring_e: [NoiseChanges<f32>; 2],
    pub(crate) ring_square: NoiseChanges<f32>,
    pub(crate) ring_flux: NoiseChanges<f32>,
    pub(crate) ring_ring: NoiseChanges<f32>,
    /// e₁′ · A₀ and e₂′ · A₀ of `RoundMoments`.
    pub(crate) e_light: [NoiseChanges<f32>; 2],
    /// T′ · P₀ of `SizeMoments`.
    pub(crate) square_zero: NoiseChanges<f32>,
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
        Products {
            e_e: [mean(e1, e1), mean(e1, e2), mean(e2, e2)],
            e_square: [mean(e1, square), mean(e2, square)],
            e_flux: [mean(e1, flux), mean(e2, flux)],
            square_square: mean(square, square),
            square_flux: mean(square, flux),
            flux_flux: mean(flux, flux),
            ring_e: [mean(e1, ring), mean(e2, ring)],
            ring_square: mean(square, ring),
            ring_flux: mean(flux, ring),
            ring_ring: mean(ring, ring),
            e_light: [mean(e1, light), mean(e2, light)],
            square_zero: mean(square, zero),
        }
    }
}
