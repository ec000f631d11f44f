//! How much galaxies of low S/N count.
//!
//! What is added to the divisor of the moments makes a galaxy respond less. Divisors go as the square of the flux, as the
//! square of the S/N ν does: where half of the response is left at ν₀ it is ν²/(ν² + ν₀²). What ν₀ is in flux follows from
//! the PSF and the noise, for galaxies as broad as the window is for, by the S/N that the best filter has. Noise of the
//! autocorrelation, which grows much faster with the PSF's width, would have galaxies behind broad PSFs count for too
//! little: in sets with a PSF for each galaxy that costs 0.4 % of the scatter at S/N 20, and 0.8 % for large galaxies.
//! The galaxy is taken as if it were deconvolved to the target, which few iterations or λ > 0 do not do.

use shearq_submissions::{LinearDeconvolution, LinearMethod};

use crate::deconvolve::{Spectral, SpectralPsf};
use crate::shape::{AdaptiveMoments, Breadth};

/// S/N at which half of a size is that of a typical galaxy. See docs/constants.md.
const FAINT_SNR: f32 = 5.0;

/// The added divisor of a plan, for the galaxies that its window is for.
pub(super) struct Softening {
    /// What halves the response of such a galaxy of flux one, times the square of the S/N ν₀. In px⁴ times the unit of the
    /// autocorrelation, as divisors are.
    halving: f32,
    /// Its power in each mode, as `Spectral::light` has it.
    galaxy: Vec<f32>,
    /// P₀ of such a galaxy of flux one, times the square of its S/N, for [`Breadth`].
    faint: f32,
    /// Its T.
    pub(super) typical: f32,
}

impl Softening {
    /// Of `method` as `spectral` and `moments` are planned for it, and round Gaussian galaxies with a mean square of
    /// `extent` px² per axis.
    pub(super) fn new(
        method: &LinearMethod,
        extent: f64,
        spectral: &Spectral,
        moments: &AdaptiveMoments,
        breadth: &Breadth,
    ) -> Self {
        let LinearDeconvolution {
            target_sigma,
            window_sigma,
            ..
        } = method.deconvolution;
        let side = 2 * spectral.reach() as i32 + 1;
        let variance = extent + target_sigma * target_sigma;
        // Behind the window.
        let seen = 1.0 / (1.0 / variance + 1.0 / (window_sigma * window_sigma));
        let peak = seen / (4.0 * std::f64::consts::PI * variance * variance);
        let acf: Vec<f32> = (0..=spectral.reach() as i32)
            .flat_map(|y| (0..side).map(move |x| (x - side / 2, y)))
            .map(|(x, y)| {
                let square = f64::from(x * x + y * y) * spectral.spacing().powi(2);
                (peak * (-square / (4.0 * seen)).exp()) as f32
            })
            .collect();
        let halving = moments.halving(&acf);
        let [zero, two] = breadth.sums(&acf);
        Softening {
            halving: halving * method.shape.half_snr.powi(2) as f32,
            galaxy: spectral.light(extent),
            faint: zero * FAINT_SNR * FAINT_SNR,
            typical: two / zero,
        }
    }

    /// What is added to the divisor of galaxies behind `psf`, in px⁴ times the unit of the autocorrelation, in noise of level
    /// one, and what is added to P₀ for the size; not finite where the PSF leaves nothing.
    pub(super) fn behind(&self, psf: &SpectralPsf) -> [f32; 2] {
        // Squared S/N of the galaxy of flux one.
        let seen = self.galaxy.iter().zip(psf.clarity());
        let seen = seen.map(|(light, clarity)| light * clarity).sum::<f32>();
        [self.halving / seen, self.faint / seen]
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use ndarray::Array2;
    use shearq_quantities::Shear;
    use shearq_submissions::{Configuration, Method, Registry};

    use super::super::window;
    use crate::extent::Moments;
    use crate::galaxy::Measurer;
    use crate::noise::{StampNoise, Survey};
    use crate::worker::ImageNoise;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    /// `48/linear/star` with a PSF as large as the stamp.
    fn configuration(half_snr: f64) -> Configuration {
        let registry = Registry::embedded().unwrap();
        let mut configuration = registry.get("48/linear/star").unwrap().configuration;
        configuration.psf.size = 48;
        if let Method::Linear(linear) = &mut configuration.method {
            linear.shape.half_snr = half_snr;
        }
        configuration
    }

    /// A nearly round Gaussian of a mean square of `extent` px² per axis behind a round Gaussian PSF of `variance` px².
    fn stamp(extent: f64, variance: f64) -> Array2<f32> {
        let (along, across) = (1.01 * extent + variance, 0.99 * extent + variance);
        Array2::from_shape_fn((48, 48), |(y, x)| {
            let (y, x) = (y as f64 - 23.5, x as f64 - 23.5);
            (-0.5 * (x * x / along + y * y / across)).exp() as f32
        })
    }

    fn gaussian(fwhm: f64) -> FunctionalPsf {
        // A Moffat of large exponent.
        let profile = PsfProfile::Moffat { beta: 60.0 };
        FunctionalPsf::new(profile, fwhm, Shear::new(0.0, 0.0)).unwrap()
    }

    #[test]
    fn a_galaxy_of_half_snr_counts_half_behind_any_psf_and_window() {
        let half_snr = 15.0;
        let mut workers =
            [half_snr, 0.0].map(|snr| Measurer::new(&configuration(snr), 48).unwrap().worker());
        let mut moments = Moments::default();
        for (fwhm, place) in [
            (2.4, window::OWN),
            (3.4, window::OWN),
            (3.4, 0),
            (3.4, window::COUNT - 1),
            (5.5, window::OWN),
            (5.5, window::COUNT - 1),
        ] {
            let psf = gaussian(fwhm).stamp(48);
            let extent = window::extent(8.8, 8.0, place);
            let stamp = stamp(extent, (fwhm / 2.354_82_f64).powi(2) + 1.0 / 12.0);
            let light = stamp.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
            let seen = extent + moments.of_psf(psf.view()).unwrap();
            // ν²/(ν² + ν₀²).
            for (snr, share) in [(half_snr, 0.5), (2.0 * half_snr, 0.8)] {
                let survey = Arc::new(Survey {
                    noise: StampNoise::white(light.sqrt() / snr),
                    extent: Some(seen),
                    sky: None,
                });
                let [soft, hard] = workers.each_mut().map(|worker| {
                    let mut image = worker.image(ImageNoise::Survey(&survey));
                    let mut worker = image.psf(psf.view()).unwrap();
                    worker.measure(stamp.view()).unwrap().e1
                });
                // The mean of noise is subtracted from a stamp without: its share of the light goes as 1/ν².
                let tolerance = 0.02 * (half_snr / snr).powi(2);
                assert!(
                    (soft / hard / share - 1.0).abs() < tolerance,
                    "{fwhm} {place} {snr}: {soft} of {hard}"
                );
            }
        }
    }
}
