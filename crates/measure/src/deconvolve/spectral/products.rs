//! How noise couples quantities of a galaxy to each other: means of products of their changes with noise.
//!
//! A quantity a that depends on the windowed result v_W changes with noise n by a′(n) = Σ_k conj(h_a)·n̂, where n̂ is the
//! deconvolved noise before the window and h_a the gradient of a, taken through the window. Modes of noise are independent,
//! so that the mean of a′(n)·b′(tn), with each mode of the second times t, is Σ_k |n̂|² t conj(h_a)·h_b: no field of noise is
//! drawn.

use shearq_fourier::Complex32;

use super::{Spectral, SpectralPsf, SpectralScratch};

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
        let side = self.plane.side;
        let [along, upright] = window_modes;
        let mut sums = [[0.0f32; 3]; 10];
        for at in 0..stamp.len() {
            // Columns with k_x > 0 stand for those with k_x < 0 too.
            let twice = if at < side { 1.0 } else { 2.0 };
            let powers = psf.powers[at].map(|power| twice * power);
            let flux = along[at / side] * upright[at % side];
            let half = [
                plane.half[0][at],
                plane.half[1][at],
                plane.half[2][at],
                flux,
            ];
            let mut number = 0;
            for a in 0..4 {
                for b in a..4 {
                    let product = half[a].re * half[b].re + half[a].im * half[b].im;
                    for (sum, power) in sums[number].iter_mut().zip(powers) {
                        *sum += power * product;
                    }
                    number += 1;
                }
            }
        }
        sums
    }
}

/// Writes the transform of a window along an axis of the coarse grid.
pub(super) fn window_modes(window: &[f32], out: &mut [Complex32]) {
    let side = window.len();
    for (mode, out) in out.iter_mut().enumerate() {
        let terms = window.iter().enumerate().map(|(place, value)| {
            let phase = std::f32::consts::TAU * ((mode * place) % side) as f32 / side as f32;
            Complex32::from_polar(*value, -phase)
        });
        *out = terms.sum();
    }
}
