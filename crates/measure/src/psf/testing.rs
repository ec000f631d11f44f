//! Stars that tests of PSFs share.

use ndarray::{Array2, ArrayView2};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};
use shearq_submissions::PsfCut;

use super::star::Star;
use crate::pixels::Pixel;

/// A star of sum one on a stamp of `side` pixels.
pub(super) fn drawn(profile: PsfProfile, fwhm: f64, shear: Shear, side: usize) -> Array2<f64> {
    FunctionalPsf::new(profile, fwhm, shear)
        .unwrap()
        .stamp(side)
}

/// The star with white noise, again of sum one.
pub(super) fn noisy(psf: &Array2<f64>, snr: f64, rng: &mut ChaCha8Rng) -> Array2<f64> {
    let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
    let star = psf.mapv(|value| {
        let noise: f64 = StandardNormal.sample(rng);
        value + sigma * noise
    });
    let sum = star.sum();
    star / sum
}

/// Power of the transform at wave vector (kx, ky), in units of the square of the light.
pub(super) fn power(psf: ArrayView2<'_, f64>, [kx, ky]: [f64; 2]) -> f64 {
    let (mut re, mut im) = (0.0, 0.0);
    for ((y, x), value) in psf.indexed_iter() {
        let phase = kx * x as f64 + ky * y as f64;
        re += value * phase.cos();
        im += value * phase.sin();
    }
    (re * re + im * im) / psf.sum().powi(2)
}

pub(super) fn moffat(fwhm: f64) -> FunctionalPsf {
    let profile = PsfProfile::Moffat { beta: 3.0 };
    FunctionalPsf::new(profile, fwhm, Shear::new(0.05, -0.03)).unwrap()
}

pub(super) fn limits(size: usize, least: usize, centred: bool) -> PsfCut {
    PsfCut {
        size,
        least,
        centred,
    }
}

pub(super) fn cut<P: Pixel>(stamp: ArrayView2<'_, P>, cut: impl Into<PsfCut>) -> Array2<f64> {
    Star::cut(stamp, cut).unwrap().psf
}
