//! One galaxy: from its postage stamp and PSF to an ellipticity. Serial; allocates nothing.

use ndarray::{Array2, ArrayView2};
use shearq_scoring::{Distortion, Shear};
use shearq_submissions::{DenoiseMethod, EllipticityType, NoiseSource, Submission};

use crate::deconvolve::reference::convolve;
use crate::deconvolve::{Network, NetworkScratch, OperatorError, Outcome, Rule, Stop};
use crate::denoise::{DenoiseScratch, WaveletWiener, border_noise};
use crate::psf::star::cut_start;
use crate::shape::{AcfScratch, Autocorrelation, ClippedMoments, Unmeasurable};

/// Why a galaxy could not be measured, as bits of the catalogue's `flag`. Zero is a good galaxy;
/// with any bit set, e1 and e2 are NaN.
pub mod flag {
    /// A pixel is not a finite number.
    pub const NOT_FINITE: u32 = 1;
    /// The galaxy's PSF cannot be used.
    pub const BAD_PSF: u32 = 2;
    /// No positive pixel, or a noise level of zero where one is needed: no unit of brightness.
    pub const NO_SCALE: u32 = 4;
    /// Nothing is left after deconvolution.
    pub const NO_LIGHT: u32 = 8;
    /// The moments have no extent.
    pub const NO_EXTENT: u32 = 16;
    /// The distortion exceeds 1 and has no shear-type ellipticity.
    pub const NO_SHEAR: u32 = 32;

    /// Meaning of each bit, for tables and documentation.
    pub const MEANINGS: [(u32, &str); 6] = [
        (NOT_FINITE, "a pixel is not a finite number"),
        (BAD_PSF, "the PSF cannot be used"),
        (NO_SCALE, "no positive pixel or no noise to scale by"),
        (NO_LIGHT, "nothing left after deconvolution"),
        (NO_EXTENT, "moments without extent"),
        (NO_SHEAR, "distortion above 1"),
    ];
}

/// What was measured on one galaxy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Reported ellipticity, of the submission's type; NaN if flagged.
    pub e1: f64,
    /// Second component.
    pub e2: f64,
    /// Bits of [`flag`].
    pub flag: u32,
    /// How the network ran; `None` if it did not.
    pub outcome: Option<Outcome>,
    /// Noise level used, in image units; NaN if unknown.
    pub noise: f64,
    /// Sum of the deconvolved stamp, in image units.
    pub flux: f64,
    /// Radius of the clipped ACF in pixels.
    pub radius: f64,
    /// Qxx + Qyy of the clipped ACF in px².
    pub size: f64,
}

impl Measurement {
    /// A galaxy with nothing measured.
    pub(crate) fn flagged(flag: u32) -> Self {
        Measurement {
            e1: f64::NAN,
            e2: f64::NAN,
            flag,
            outcome: None,
            noise: f64::NAN,
            flux: f64::NAN,
            radius: f64::NAN,
            size: f64::NAN,
        }
    }

    /// Code of the stop reason in catalogues; −1 if the network did not run.
    pub fn stop_code(&self) -> i64 {
        self.outcome.map_or(-1, |o| i64::from(o.stop.code()))
    }

    /// Why the network stopped.
    pub fn stop(&self) -> Option<Stop> {
        self.outcome.map(|o| o.stop)
    }
}

/// Everything planned for one submission and one size of full stamps. Not changed by measuring, so
/// one serves all threads.
pub struct Measurer {
    submission: Submission,
    full: usize,
    denoise: Option<WaveletWiener>,
    network: Network<f32>,
    acf: Autocorrelation,
    moments: ClippedMoments,
}

/// One thread's buffers, its PSF among them.
pub struct MeasureScratch {
    network: Network<f32>,
    network_scratch: NetworkScratch<f32>,
    denoise: Option<DenoiseScratch>,
    acf_scratch: AcfScratch,
    /// Full stamp, denoised in place.
    full: Vec<f32>,
    /// Cut stamp.
    cut: Vec<f32>,
    deconvolved: Vec<f32>,
    acf: Vec<f32>,
    border: Vec<f32>,
    usable_psf: bool,
}

impl Measurer {
    /// Plans for full stamps of `full` pixels a side.
    ///
    /// # Errors
    /// Where a size is out of range. A cut larger than the full stamp is the caller's to refuse, see
    /// [`Measurer::fits`].
    pub fn new(submission: &Submission, full: usize) -> Result<Self, OperatorError> {
        let n = submission.stamp.size.min(full);
        let d = &submission.deconvolution;
        Ok(Measurer {
            full,
            denoise: match submission.denoise.method {
                DenoiseMethod::None => None,
                DenoiseMethod::WaveletWiener => Some(WaveletWiener::new(full, &submission.denoise)),
            },
            network: Network::plan(n, submission.psf.size, d.lambda)?,
            acf: Autocorrelation::new(n),
            moments: ClippedMoments::new(n, submission.shape.acf_share),
            submission: submission.clone(),
        })
    }

    /// Whether the submission's cut fits into full stamps of `full` pixels.
    pub fn fits(submission: &Submission, full: usize) -> bool {
        submission.stamp.size <= full
    }

    /// The submission.
    pub fn submission(&self) -> &Submission {
        &self.submission
    }

    /// Buffers for one thread.
    pub fn scratch(&self) -> MeasureScratch {
        let n = self.network.stamp_size();
        MeasureScratch {
            network: self.network.clone(),
            network_scratch: self.network.scratch(),
            denoise: self.denoise.as_ref().map(WaveletWiener::scratch),
            acf_scratch: self.acf.scratch(),
            full: vec![0.0; self.full * self.full],
            cut: vec![0.0; n * n],
            deconvolved: vec![0.0; n * n],
            acf: vec![0.0; self.acf.len()],
            border: Vec::with_capacity(self.full * self.full),
            usable_psf: false,
        }
    }

    /// Takes the PSF for the galaxies that follow; `None`, or one the network refuses, flags them.
    pub fn set_psf(&self, scratch: &mut MeasureScratch, psf: Option<ArrayView2<'_, f64>>) {
        scratch.usable_psf = psf.is_some_and(|psf| scratch.network.set_psf(psf).is_ok());
    }

    /// Measures the galaxy whose full stamp's row `y` is `pixels[y·stride..]`. `header_noise` is the
    /// image's NOISESIG.
    pub fn measure(
        &self,
        pixels: &[f32],
        stride: usize,
        header_noise: Option<f64>,
        scratch: &mut MeasureScratch,
    ) -> Measurement {
        let full = self.full;
        for (y, row) in scratch.full.chunks_exact_mut(full).enumerate() {
            row.copy_from_slice(&pixels[y * stride..y * stride + full]);
        }
        if scratch.full.iter().any(|v| !v.is_finite()) {
            return Measurement::flagged(flag::NOT_FINITE);
        }
        if !scratch.usable_psf {
            return Measurement::flagged(flag::BAD_PSF);
        }
        let noise = match (self.submission.noise.source, header_noise) {
            (NoiseSource::Header, Some(sigma)) => sigma,
            _ => border_noise(
                &scratch.full,
                full,
                self.submission.noise.border,
                &mut scratch.border,
            )
            .map_or(f64::NAN, f64::from),
        };
        if let (Some(filter), Some(buffers)) = (&self.denoise, &mut scratch.denoise) {
            filter.apply(&mut scratch.full, noise as f32, buffers);
        }
        let n = self.network.stamp_size();
        let start = cut_start(full, n).unwrap_or(0);
        for (y, row) in scratch.cut.chunks_exact_mut(n).enumerate() {
            let from = (start + y) * full + start;
            row.copy_from_slice(&scratch.full[from..from + n]);
        }
        let peak = scratch.cut.iter().copied().fold(0.0f32, f32::max);
        let Some(rule) = Rule::new(&self.submission.deconvolution, f64::from(peak), noise) else {
            return Measurement {
                noise,
                ..Measurement::flagged(flag::NO_SCALE)
            };
        };
        let outcome = scratch.network.deconvolve(
            &rule,
            &scratch.cut,
            &mut scratch.network_scratch,
            &mut scratch.deconvolved,
        );
        let flux: f64 = scratch.deconvolved.iter().map(|&v| f64::from(v)).sum();
        self.acf.compute(
            &scratch.deconvolved,
            &mut scratch.acf_scratch,
            &mut scratch.acf,
        );
        let measured = self.moments.measure(&scratch.acf, flux);
        let (radius, size) = measured.map_or((f64::NAN, f64::NAN), |m| (m.radius, m.xx + m.yy));
        let shape = measured.and_then(|moments| moments.distortion());
        let (e1, e2, flag) = match shape {
            Ok(distortion) => self.report(distortion),
            Err(Unmeasurable::NoLight) => (f64::NAN, f64::NAN, flag::NO_LIGHT),
            Err(Unmeasurable::NoExtent) => (f64::NAN, f64::NAN, flag::NO_EXTENT),
        };
        Measurement {
            e1,
            e2,
            flag,
            outcome: Some(outcome),
            noise,
            flux,
            radius,
            size,
        }
    }

    /// The ellipticity of the submission's type.
    fn report(&self, distortion: Distortion) -> (f64, f64, u32) {
        match self.submission.shape.ellipticity {
            EllipticityType::Distortion => (distortion.e1, distortion.e2, 0),
            EllipticityType::Shear => match distortion.to_shear() {
                Some(Shear { e1, e2 }) => (e1, e2, 0),
                None => (f64::NAN, f64::NAN, flag::NO_SHEAR),
            },
        }
    }
}

/// The steps of one measurement as images, for pictures.
pub struct Steps {
    /// The stamp as cut from the data, before any denoising.
    pub stamp: Array2<f64>,
    /// The deconvolved stamp.
    pub deconvolved: Array2<f64>,
    /// Data minus the deconvolved stamp convolved with the PSF.
    pub residual: Array2<f64>,
    /// Full autocorrelation, (2n−1)×(2n−1), zero lag in the middle.
    pub acf: Array2<f64>,
    /// The same, NaN beyond the clipping radius.
    pub clipped: Array2<f64>,
}

impl Measurer {
    /// The steps behind the last call of [`Measurer::measure`] with this scratch and `psf`.
    pub fn steps(
        &self,
        pixels: &[f32],
        stride: usize,
        psf: ArrayView2<'_, f64>,
        measurement: &Measurement,
        scratch: &MeasureScratch,
    ) -> Steps {
        let n = self.network.stamp_size();
        let start = cut_start(self.full, n).unwrap_or(0);
        let image =
            |values: &[f32]| Array2::from_shape_fn((n, n), |(y, x)| f64::from(values[y * n + x]));
        let stamp = Array2::from_shape_fn((n, n), |(y, x)| {
            f64::from(pixels[(start + y) * stride + start + x])
        });
        let deconvolved = image(&scratch.deconvolved);
        let reconvolved = convolve(deconvolved.view(), psf);
        let side = 2 * n - 1;
        let acf = Array2::from_shape_fn((side, side), |(y, x)| {
            // The half with dy < 0 follows from A(−dx, −dy) = A(dx, dy).
            let (y, x) = if y + 1 < n {
                (side - 1 - y, side - 1 - x)
            } else {
                (y, x)
            };
            f64::from(scratch.acf[(y + 1 - n) * side + x])
        });
        let clipped = Array2::from_shape_fn((side, side), |at| {
            let (dy, dx) = (
                at.0 as f64 - (n as f64 - 1.0),
                at.1 as f64 - (n as f64 - 1.0),
            );
            if dy.hypot(dx) <= measurement.radius {
                acf[at]
            } else {
                f64::NAN
            }
        });
        Steps {
            residual: &stamp - &reconvolved,
            stamp,
            deconvolved,
            acf,
            clipped,
        }
    }
}
